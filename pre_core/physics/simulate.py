"""The coupled forward problem: a half-car drives over a rough road and a bridge.

Vehicle and bridge are each integrated with Newmark's average acceleration; within every step they
exchange wheel displacement and contact force until the forces converge (paper section 2.1).
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.physics import bridge as _bridge
from pre_core.physics import vehicle as _vehicle
from pre_core.physics.march import (
    MarchOutputs,
    MarchScheme,
    ModalBridge,
    TruckMatrices,
    WheelForces,
    WheelTrack,
    march,
)
from pre_core.physics.torsional_modes import quasi_static_twist, torsional_modes


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


class Discretisation(NamedTuple):
    """Time step, modes of the bridge, and the criteria that end the iterations within a step."""

    step_s: float
    modes: int | None = None
    """Number of modes; None: all of the mesh."""
    tolerance: float = 1e-12
    """Largest change of a contact force between two iterations, relative to the static axle load;
    the paper uses 1e-3."""
    max_iterations: int = 50


class InitialVibration(NamedTuple):
    """Vibration of the bridge, which is at rest until it begins."""

    state: FloatArray  # (2, modes): displacement and velocity of `bridge.modes`
    step: int | None = None
    """Time step at which it begins; None: entry of the first wheel, or step 0 if none enters."""


class CoupledResponse(NamedTuple):
    """Response of truck and bridge; not `converged` if the forces of a step did not converge.

    Later steps are zero then.
    """

    displacement_m: FloatArray  # (steps, 4): z_s1, z_s2, z_u1, z_u2
    velocity_m_per_s: FloatArray  # (steps, 4)
    acceleration_m_per_s2: FloatArray  # (steps, 4)
    contact_force_n: FloatArray  # (steps, 2), up positive on the bridge: negative while loaded
    wheel_deflection_m: FloatArray  # (steps, 2): the bridge under each wheel
    modal_displacement: FloatArray  # (steps, modes), in bending
    modal_velocity: FloatArray  # (steps, modes)
    friction_n: FloatArray  # (steps, 2) of the suspension, positive where it resists extension
    modes: _bridge.Modes
    converged: bool
    iterations: int


def constant_speed(start_m: float, speed_m_per_s: float, steps: int, step_s: float) -> Motion:
    """Return the motion from x_1 = start at a constant (signed) speed."""
    position = start_m + speed_m_per_s * step_s * np.arange(steps, dtype=np.float64)
    return Motion(position, np.full(steps, float(speed_m_per_s)), np.zeros(steps))


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


def simulate(
    car: _vehicle.HalfCar,
    beam: _bridge.Beam,
    motion: Motion,
    road: WheelRoad,
    scheme: Discretisation,
    *,
    swing: InitialVibration | None = None,
    gravity_m_per_s2: float = STANDARD_GRAVITY_M_PER_S2,
) -> CoupledResponse:
    """Drive the truck along `motion` and return accelerations, forces and deflections.

    The truck starts at rest in static equilibrium on a flat road at height zero, without suspension
    friction. The bridge is at rest and unloaded until `swing`, its initial vibration, begins, which
    has a state for each of the modes of `scheme`.

    Integrating the accelerations by the same scheme from zero gives the displacements to rounding.
    """
    basis = _bridge.modes(beam, scheme.modes)
    bending, steps = basis.eigenvalues_per_s2.size, motion.position_m.size
    direction = 1 if motion.speed_m_per_s[0] >= 0.0 else -1
    rear = rear_position_m(motion.position_m, car.wheelbase_m, direction)
    wheels = np.stack([motion.position_m, rear], axis=1)
    element, place = _bridge.locate_element(beam.element_lengths_m, wheels)
    if swing is not None and swing.step is None:
        swing = swing._replace(step=int((element >= 0).any(axis=1).argmax()))
    bridge = _modal_bridge(beam, basis, swing)
    track = WheelTrack(
        element,
        place,
        motion.speed_m_per_s,
        _vehicle.total_mass_kg(car)
        * motion.acceleration_m_per_s2
        * car.cg_height_m
        / car.wheelbase_m,
        np.ascontiguousarray(road.height_m),
        np.ascontiguousarray(road.rate_m_per_s),
        quasi_static_twist(beam, wheels),
    )
    count = bridge.eigenvalues.size
    widths = (4, 4, 4, 2, 2, count, count, 2)
    out = MarchOutputs(*(np.zeros((steps, width)) for width in widths))
    truck = _truck_matrices(car, scheme.step_s, gravity_m_per_s2)
    steps_of = MarchScheme(scheme.step_s, scheme.tolerance, scheme.max_iterations)
    iterations = march(truck, bridge, track, steps_of, out)
    bent = out._replace(q=out.q[:, :bending], qd=out.qd[:, :bending])
    return CoupledResponse(*bent, basis, iterations > 0, max(iterations, 0))


def _truck_matrices(car: _vehicle.HalfCar, step_s: float, gravity_m_per_s2: float) -> TruckMatrices:
    mass, damping, stiffness = _vehicle.matrices(car)
    effective = mass + 0.5 * step_s * damping + 0.25 * step_s**2 * stiffness
    static_load = _vehicle.static_axle_loads_n(car, gravity_m_per_s2)
    front, rear = (
        # numba would compile `march` again for each combination of integers among them.
        WheelForces._make(
            float(constant)
            for constant in (
                stiffness[w, w],
                static_load[w] - gravity_m_per_s2 * car.unsprung_mass_kg[w],
                car.bilinear_damping * car.suspension_damping_ns_per_m[w],
                car.air_spring_exponent,
                car.dry_friction_n[w],
                car.friction_length_m,
                car.friction_load_growth,
                car.tyre_stiffness_n_per_m[w],
                car.tyre_damping_ns_per_m[w],
                static_load[w],
            )
        )
        for w in range(2)
    )
    return TruckMatrices(
        np.asarray(np.linalg.inv(mass), dtype=np.float64),
        np.asarray(np.linalg.inv(effective), dtype=np.float64),
        damping,
        stiffness,
        (front, rear),
    )


def _modal_bridge(
    beam: _bridge.Beam, basis: _bridge.Modes, swing: InitialVibration | None
) -> ModalBridge:
    """Return the bridge in its modes of bending, followed by those of torsion."""
    twist = torsional_modes(beam)
    fixed = _bridge.supported_nodes(beam)
    cubics = _bridge.element_cubics(beam.element_lengths_m, fixed, basis.shapes)
    eigenvalues = np.concatenate([basis.eigenvalues_per_s2, twist.eigenvalues_per_s2])
    vibration, vibration_step = np.zeros((2, eigenvalues.size)), -1
    if swing is not None and swing.step is not None:
        vibration[:, : basis.eigenvalues_per_s2.size] = swing.state
        vibration_step = swing.step
    return ModalBridge(
        eigenvalues,
        np.concatenate([basis.damping_per_s, twist.damping_per_s]),
        np.concatenate([cubics, twist.cubics], axis=2),
        beam.element_lengths_m,
        vibration,
        vibration_step,
    )


def deflection_m(beam: _bridge.Beam, run: CoupledResponse, x_m: FloatArray) -> FloatArray:
    """Return the deflection (steps, m) of the bridge at m fixed chainages, up positive."""
    shapes = _bridge.interpolation_matrix(beam, x_m) @ run.modes.shapes
    return np.asarray(run.modal_displacement @ shapes.T)
