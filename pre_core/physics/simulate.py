"""The coupled forward problem: a half-car drives over a rough road and a bridge.

Vehicle and bridge are each marched with Newmark's average acceleration; within every step they
exchange wheel displacement and contact force until the forces converge (paper section 2.1).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.kernels.lanes import compiled
from pre_core.physics import bridge as _bridge
from pre_core.physics import vehicle as _vehicle
from pre_core.physics.torsional_modes import quasi_static_twist, torsional_modes

FloatArray = NDArray[np.float64]


class Motion(NamedTuple):
    """Motion of the front axle at the times 0, step, 2 step, …: (steps,) each.

    `position_m` is the chainage x_1; driving from the bridge's end to its start it decreases.
    """

    position_m: FloatArray
    speed_m_per_s: FloatArray
    """Velocity dx_1/dt, negative when the chainage decreases."""
    acceleration_m_per_s2: FloatArray
    """Rate of change of the magnitude of the speed: positive when the truck speeds up."""


class WheelRoad(NamedTuple):
    """Height of the road under each wheel (steps, 2) and its rate of change (steps, 2)."""

    height_m: FloatArray
    rate_m_per_s: FloatArray


class CoupledResponse(NamedTuple):
    """Response of truck and bridge; `converged` is False if the forces of a step did not."""

    displacement_m: FloatArray  # (steps, 4): z_s1, z_s2, z_u1, z_u2
    velocity_m_per_s: FloatArray  # (steps, 4)
    acceleration_m_per_s2: FloatArray  # (steps, 4)
    contact_force_n: FloatArray  # (steps, 2), up positive on the bridge: negative while loaded
    wheel_deflection_m: FloatArray  # (steps, 2): the bridge under each wheel
    modal_displacement: FloatArray  # (steps, modes), in bending
    modal_velocity: FloatArray  # (steps, modes)
    friction_n: FloatArray  # (steps, 2) of the springs, positive where it resists lengthening
    modes: _bridge.Modes
    converged: bool
    iterations: int


def constant_speed(start_m: float, speed_m_per_s: float, steps: int, step_s: float) -> Motion:
    """Return the motion from x_1 = start at a constant (signed) speed."""
    position = start_m + speed_m_per_s * step_s * np.arange(steps, dtype=np.float64)
    return Motion(position, np.full(steps, speed_m_per_s), np.zeros(steps))


def constant_acceleration(
    start_m: float,
    speed_m_per_s: float,
    acceleration_m_per_s2: float,
    steps: int,
    step_s: float,
) -> Motion:
    """Return the motion from x_1 = start; the sign of the speed is the direction of travel."""
    t = step_s * np.arange(steps)
    sign = np.sign(speed_m_per_s)
    position = start_m + speed_m_per_s * t + 0.5 * sign * acceleration_m_per_s2 * t**2
    speed = speed_m_per_s + sign * acceleration_m_per_s2 * t
    return Motion(position, speed, np.full(steps, acceleration_m_per_s2))


def rear_position_m(front_position_m: FloatArray, wheelbase_m: float, direction: int) -> FloatArray:
    """Return x_2 (steps,): x_1 - D from start to end (direction 1), x_1 + D in the other (-1)."""
    return front_position_m - direction * wheelbase_m


@compiled(error_model="numpy")
def _march(
    step_s: float,
    inverse_mass: FloatArray,
    inverse_effective: FloatArray,
    damping: FloatArray,
    stiffness: FloatArray,
    bilinear_n_s_per_m: FloatArray,
    friction_level: FloatArray,
    friction_length: float,
    friction_growth: float,
    air_exponent: float,
    spring_load: FloatArray,
    tyre_stiffness: FloatArray,
    tyre_damping: FloatArray,
    static_load: FloatArray,
    load_transfer: FloatArray,
    eigenvalues: FloatArray,
    modal_damping: FloatArray,
    cubics: FloatArray,
    quasi_static: FloatArray,
    element_lengths: FloatArray,
    element: NDArray[np.int64],
    place: FloatArray,
    wheel_speed: FloatArray,
    road: FloatArray,
    road_rate: FloatArray,
    swing: FloatArray,
    swing_step: int,
    tolerance: float,
    max_iterations: int,
    z: FloatArray,
    zd: FloatArray,
    zdd: FloatArray,
    contact: FloatArray,
    deflection: FloatArray,
    q: FloatArray,
    qd: FloatArray,
    friction: FloatArray,
) -> int:
    steps = road.shape[0]
    count = eigenvalues.size
    qdd = np.zeros(count)
    modal_effective = 1.0 + 0.5 * step_s * modal_damping + 0.25 * step_s**2 * eigenvalues
    effective = np.ones(count)
    shape = np.zeros((2, count))
    slope = np.zeros((2, count))
    q_guess = np.zeros(count)
    qd_guess = np.zeros(count)
    q_new = np.zeros(count)
    qd_new = np.zeros(count)
    qdd_new = np.zeros(count)
    z_guess = np.zeros(4)
    zd_guess = np.zeros(4)
    z_new = np.zeros(4)
    zd_new = np.zeros(4)
    zdd_new = np.zeros(4)
    free = np.zeros(4)
    force = np.zeros(4)
    p = np.zeros(2)
    y = np.zeros(2)
    yd = np.zeros(2)
    step_rate = np.zeros(2)
    rubbing = np.zeros(2)
    worst = 0
    # At time 0 displacement and velocity are given (zero) and only accelerations are unknown.
    # The same holds for the modes when initial vibration begins; before, the bridge is at rest.
    quarter = 0.0
    half = 0.0
    inverse = inverse_mass
    for n in range(steps):
        if n == 1:
            quarter = 0.25 * step_s**2
            half = 0.5 * step_s
            inverse = inverse_effective
        is_given = n in (0, swing_step)
        modal_quarter = 0.0 if is_given else quarter
        modal_half = 0.0 if is_given else half
        for k in range(count):
            effective[k] = 1.0 if is_given else modal_effective[k]
        for i in range(4):
            if n > 0:
                z_guess[i] = z[n - 1, i] + step_s * zd[n - 1, i] + quarter * zdd[n - 1, i]
                zd_guess[i] = zd[n - 1, i] + half * zdd[n - 1, i]
        for k in range(count):
            if n == swing_step:
                q_guess[k] = swing[0, k]
                qd_guess[k] = swing[1, k]
            elif n > 0:
                q_guess[k] = q[n - 1, k] + step_s * qd[n - 1, k] + quarter * qdd[k]
                qd_guess[k] = qd[n - 1, k] + half * qdd[k]
        on_bridge = False
        for w in range(2):
            e = element[n, w]
            if e >= 0:
                on_bridge = True
                xi = place[n, w]
                length = element_lengths[e]
                for k in range(count):
                    c0, c1, c2, c3 = (
                        cubics[e, 0, k],
                        cubics[e, 1, k],
                        cubics[e, 2, k],
                        cubics[e, 3, k],
                    )
                    shape[w, k] = ((c3 * xi + c2) * xi + c1) * xi + c0
                    slope[w, k] = ((3.0 * c3 * xi + 2.0 * c2) * xi + c1) / length
            else:
                shape[w, :] = 0.0
                slope[w, :] = 0.0
            step_rate[w] = 0.0
            was = element[n - 1, w] if n > 0 else e
            if (e >= 0) != (was >= 0):
                # The bridge's end is compliant: the wheel passes a step, which its tyre's damper
                # transmits. A rate at one sample has the impulse of one time step.
                near = max(e, was)
                end = 0.0
                for k in range(count):
                    at_end = cubics[near, 0, k]
                    if near > 0:
                        at_end += cubics[near, 1, k] + cubics[near, 2, k] + cubics[near, 3, k]
                    # Initial vibration displaces the bridge from its position at rest.
                    end += at_end * (q_guess[k] if n == swing_step else q[n - 1, k])
                step_rate[w] = end / step_s if e >= 0 else -end / step_s
        for i in range(4):
            free[i] = 0.0
            for j in range(4):
                free[i] -= damping[i, j] * zd_guess[j] + stiffness[i, j] * z_guess[j]
        free[0] += load_transfer[n]
        free[1] -= load_transfer[n]
        if n > 0:
            for w in range(2):
                p[w] = contact[n - 1, w]
        else:
            for w in range(2):
                p[w] = -static_load[w]
        zd_new[:] = zd_guess
        z_new[:] = z_guess
        iterations = 0
        while True:
            iterations += 1
            # The bridge under the latest contact forces.
            for w in range(2):
                y[w] = 0.0
                yd[w] = step_rate[w]
            if on_bridge:
                for k in range(count):
                    load = shape[0, k] * p[0] + shape[1, k] * p[1]
                    acceleration = (
                        load - modal_damping[k] * qd_guess[k] - eigenvalues[k] * q_guess[k]
                    ) / effective[k]
                    qdd_new[k] = acceleration
                    q_new[k] = q_guess[k] + modal_quarter * acceleration
                    qd_new[k] = qd_guess[k] + modal_half * acceleration
                    for w in range(2):
                        y[w] += shape[w, k] * q_new[k]
                        yd[w] += shape[w, k] * qd_new[k] + slope[w, k] * wheel_speed[n] * q_new[k]
            else:
                for k in range(count):
                    acceleration = (
                        -modal_damping[k] * qd_guess[k] - eigenvalues[k] * q_guess[k]
                    ) / effective[k]
                    qdd_new[k] = acceleration
                    q_new[k] = q_guess[k] + modal_quarter * acceleration
                    qd_new[k] = qd_guess[k] + modal_half * acceleration
            if quasi_static.shape[0] > 0:
                for w in range(2):
                    y[w] += quasi_static[n, w, 0] * p[0] + quasi_static[n, w, 1] * p[1]
            # The truck on the road and the deflected bridge.
            for i in range(4):
                force[i] = free[i]
            for w in range(2):
                force[2 + w] += tyre_stiffness[w] * (road[n, w] + y[w]) + tyre_damping[w] * (
                    road_rate[n, w] + yd[w]
                )
                # Forces of damper and spring beyond their linear parts, positive in extension.
                stroke_rate = zd_new[w] - zd_new[2 + w]
                strut = bilinear_n_s_per_m[w] * abs(stroke_rate)
                stroke = z_new[w] - z_new[2 + w]
                spring = -stiffness[w, w] * stroke
                if air_exponent > 0.0:
                    excess = _vehicle.air_spring_excess_n(
                        -stroke, stiffness[w, w], spring_load[w], air_exponent
                    )
                    spring += excess
                    strut -= excess
                if friction_level[w] > 0.0:
                    load = max(1.0 + friction_growth * spring / spring_load[w], 0.0)
                    rubbing[w] = _vehicle.dahl_friction_n(
                        friction[n - 1, w] if n > 0 else 0.0,
                        stroke - (z[n - 1, w] - z[n - 1, 2 + w]) if n > 0 else 0.0,
                        friction_level[w] * load,
                        friction_length,
                    )
                    strut += rubbing[w]
                force[w] -= strut
                force[2 + w] += strut
            for i in range(4):
                acceleration = 0.0
                for j in range(4):
                    acceleration += inverse[i, j] * force[j]
                zdd_new[i] = acceleration
                z_new[i] = z_guess[i] + quarter * acceleration
                zd_new[i] = zd_guess[i] + half * acceleration
            change = 0.0
            for w in range(2):
                u = road[n, w] + y[w]
                ud = road_rate[n, w] + yd[w]
                latest = -(
                    static_load[w]
                    + tyre_stiffness[w] * (u - z_new[2 + w])
                    + tyre_damping[w] * (ud - zd_new[2 + w])
                )
                change = max(change, abs(latest - p[w]) / static_load[w])
                p[w] = latest
            if iterations > 1 and change <= tolerance:
                break
            if iterations >= max_iterations:
                return -1
        worst = max(worst, iterations)
        for i in range(4):
            z[n, i] = z_new[i]
            zd[n, i] = zd_new[i]
            zdd[n, i] = zdd_new[i]
        for k in range(count):
            q[n, k] = q_new[k]
            qd[n, k] = qd_new[k]
            qdd[k] = qdd_new[k]
        for w in range(2):
            contact[n, w] = p[w]
            deflection[n, w] = y[w]
            friction[n, w] = rubbing[w]
    return worst


def simulate(
    car: _vehicle.HalfCar,
    beam: _bridge.Beam,
    motion: Motion,
    road: WheelRoad,
    step_s: float,
    *,
    modes: int | None = None,
    swing: FloatArray | None = None,
    tolerance: float = 1e-12,
    max_iterations: int = 50,
    gravity_m_per_s2: float = STANDARD_GRAVITY_M_PER_S2,
    swing_step: int | None = None,
) -> CoupledResponse:
    """Drive the truck along `motion` and return accelerations, forces and deflections.

    The truck starts at rest in static equilibrium on a flat road at height zero, without spring
    friction, and the bridge at rest, unloaded. `swing` (2, modes) is the initial vibration:
    displacement and velocity of the modes (`bridge.modes` of this beam and number) at `swing_step`,
    by default when the first wheel enters, or time 0 if none does; until then the bridge is at
    rest.

    All `modes` of the mesh are kept unless fewer are requested. `tolerance` is the largest change
    of a contact force between two iterations, relative to the static axle load; the paper uses
    1e-3.

    Integrating the accelerations by the same scheme from zero gives the displacements to rounding.
    """
    basis = _bridge.modes(beam, modes)
    fixed = _bridge.supported_nodes(beam)
    cubics = _bridge.element_cubics(beam.element_lengths_m, fixed, basis.shapes)
    direction = 1 if motion.speed_m_per_s[0] >= 0.0 else -1
    wheels = np.stack(
        [
            motion.position_m,
            rear_position_m(motion.position_m, car.wheelbase_m, direction),
        ],
        axis=1,
    )
    element, place = _bridge.locate_element(beam.element_lengths_m, wheels)
    mass, damping, stiffness = _vehicle.matrices(car)
    transfer = (
        _vehicle.total_mass_kg(car)
        * motion.acceleration_m_per_s2
        * car.cg_height_m
        / car.wheelbase_m
    )
    effective = mass + 0.5 * step_s * damping + 0.25 * step_s**2 * stiffness
    steps = motion.position_m.size
    bending = basis.eigenvalues_per_s2.size
    twist = torsional_modes(beam)
    eigenvalues = np.concatenate([basis.eigenvalues_per_s2, twist.eigenvalues_per_s2])
    damping_of_modes = np.concatenate([basis.damping_per_s, twist.damping_per_s])
    cubics = np.concatenate([cubics, twist.cubics], axis=2)
    count = eigenvalues.size
    state = np.zeros((2, count))
    if swing is not None:
        state[:, :bending] = swing
    z, zd, zdd = (np.zeros((steps, 4)) for _ in range(3))
    contact, deflection, friction = (np.zeros((steps, 2)) for _ in range(3))
    static_load = np.array(_vehicle.static_axle_loads_n(car, gravity_m_per_s2))
    is_on = (element >= 0).any(axis=1)
    q, qd = np.zeros((steps, count)), np.zeros((steps, count))
    iterations = _march(
        step_s,
        np.asarray(np.linalg.inv(mass), dtype=np.float64),
        np.asarray(np.linalg.inv(effective), dtype=np.float64),
        damping,
        stiffness,
        car.bilinear_damping * np.array(car.suspension_damping_ns_per_m),
        np.array(car.dry_friction_n),
        car.friction_length_m,
        car.friction_load_growth,
        car.air_spring_exponent,
        static_load - gravity_m_per_s2 * np.array(car.unsprung_mass_kg),
        np.array(car.tyre_stiffness_n_per_m),
        np.array(car.tyre_damping_ns_per_m),
        static_load,
        transfer,
        eigenvalues,
        damping_of_modes,
        cubics,
        quasi_static_twist(beam, wheels),
        beam.element_lengths_m,
        element,
        place,
        motion.speed_m_per_s,
        np.ascontiguousarray(road.height_m),
        np.ascontiguousarray(road.rate_m_per_s),
        state,
        -1 if swing is None else int(is_on.argmax()) if swing_step is None else swing_step,
        tolerance,
        max_iterations,
        z,
        zd,
        zdd,
        contact,
        deflection,
        q,
        qd,
        friction,
    )
    return CoupledResponse(
        z,
        zd,
        zdd,
        contact,
        deflection,
        q[:, :bending],
        qd[:, :bending],
        friction,
        basis,
        iterations > 0,
        max(iterations, 0),
    )


def deflection_m(beam: _bridge.Beam, run: CoupledResponse, x_m: FloatArray) -> FloatArray:
    """Return the deflection (steps, m) of the bridge at m fixed chainages, up positive."""
    shapes = _bridge.interpolation_matrix(beam, x_m) @ run.modes.shapes
    return np.asarray(run.modal_displacement @ shapes.T)
