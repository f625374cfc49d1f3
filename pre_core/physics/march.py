"""Time steps of the coupled forward problem: Newmark's scheme for the truck and for each mode.

Within a step, wheel displacement and contact force are exchanged until the forces converge. Every
operation is rounded as written: no kernel here allows contraction.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import compiled, inner_exact
from pre_core.physics.vehicle import air_spring_excess_n, dahl_friction_n


class WheelForces(NamedTuple):
    """Constants of the suspension force and the tyre force of one axle, from `HalfCar`.

    `spring_load_n` is the static load on the spring, `static_load_n` that on the road.
    """

    spring_n_per_m: float
    spring_load_n: float
    bilinear_n_s_per_m: float
    air_exponent: float
    friction_n: float
    friction_length_m: float
    friction_growth: float
    tyre_n_per_m: float
    tyre_n_s_per_m: float
    static_load_n: float


class TruckMatrices(NamedTuple):
    """The truck's equations M z'' + C z' + K z = forces in z_s1, z_s2, z_u1, z_u2."""

    inverse_mass: FloatArray  # (4, 4)
    inverse_effective: FloatArray  # (4, 4): of M + h/2 C + h^2/4 K
    damping: FloatArray  # (4, 4)
    stiffness: FloatArray  # (4, 4)
    wheels: tuple[WheelForces, WheelForces]


class ModalBridge(NamedTuple):
    """The bridge in k modes of unit mass."""

    eigenvalues: FloatArray  # (k,)
    damping: FloatArray  # (k,)
    cubics: FloatArray  # (elements, 4, k): see `bridge.element_cubics`
    element_lengths: FloatArray  # (elements,)
    vibration: FloatArray  # (2, k): initial displacement and velocity
    vibration_step: int
    """Step at which the vibration begins; until then the bridge is at rest. -1: never."""


class WheelTrack(NamedTuple):
    """Position and road height of both wheels at every step."""

    element: NDArray[np.int64]  # (steps, 2): -1 off the bridge
    place: FloatArray  # (steps, 2): 0..1 within the element
    speed: FloatArray  # (steps,)
    load_transfer: FloatArray  # (steps,): force in N, up on the body's front and down on its rear
    road: FloatArray  # (steps, 2)
    road_rate: FloatArray  # (steps, 2)
    quasi_static: FloatArray  # (steps or 0, 2, 2): m/N, see `torsional_modes.quasi_static_twist`


class MarchScheme(NamedTuple):
    """Time step, and the criteria that end the iterations within a step."""

    step_s: float
    tolerance: float
    max_iterations: int


class MarchOutputs(NamedTuple):
    """Outputs of the march at every step, as the first fields of `simulate.CoupledResponse`."""

    z: FloatArray  # (steps, 4)
    zd: FloatArray  # (steps, 4)
    zdd: FloatArray  # (steps, 4)
    contact: FloatArray  # (steps, 2)
    deflection: FloatArray  # (steps, 2)
    q: FloatArray  # (steps, k)
    qd: FloatArray  # (steps, k)
    friction: FloatArray  # (steps, 2)


@inner_exact
def _strut(
    wheel: WheelForces, stroke: float, rate: float, before: float, change: float
) -> tuple[float, float]:
    """Return the nonlinear part of the suspension force, friction included, and the friction alone.

    Forces that resist extension are positive. `before` is the friction at the previous step, from
    which the stroke has changed by `change`.
    """
    strut = wheel.bilinear_n_s_per_m * abs(rate)
    spring = -wheel.spring_n_per_m * stroke
    if wheel.air_exponent > 0.0:
        excess = air_spring_excess_n(
            -stroke, wheel.spring_n_per_m, wheel.spring_load_n, wheel.air_exponent
        )
        spring += excess
        strut -= excess
    if wheel.friction_n <= 0.0:
        return strut, 0.0
    load = max(1.0 + wheel.friction_growth * spring / wheel.spring_load_n, 0.0)
    friction = dahl_friction_n(before, change, wheel.friction_n * load, wheel.friction_length_m)
    return strut + friction, friction


@inner_exact
def _shapes(
    cubics: FloatArray, xi: float, length: float, shape: FloatArray, slope: FloatArray
) -> None:
    """Compute modes and slopes (k,) at the coordinate `xi` of an element with `cubics` (4, k)."""
    for k in range(shape.size):
        c0, c1, c2, c3 = cubics[0, k], cubics[1, k], cubics[2, k], cubics[3, k]
        shape[k] = ((c3 * xi + c2) * xi + c1) * xi + c0
        slope[k] = ((3.0 * c3 * xi + 2.0 * c2) * xi + c1) / length


@inner_exact
def _end_deflection(cubics: FloatArray, element: int, q: FloatArray) -> float:
    """Return the deflection of the end of the bridge at its first or last element."""
    end = 0.0
    for k in range(q.size):
        at_end = cubics[element, 0, k]
        if element > 0:
            at_end += cubics[element, 1, k] + cubics[element, 2, k] + cubics[element, 3, k]
        end += at_end * q[k]
    return end


@compiled(error_model="numpy")
def march(
    truck: TruckMatrices,
    bridge: ModalBridge,
    track: WheelTrack,
    scheme: MarchScheme,
    out: MarchOutputs,
) -> int:
    """Write the response at all steps to `out`; return the largest number of iterations.

    Return -1, with later steps unwritten, if the forces of a step do not converge.
    """
    step_s = scheme.step_s
    eigenvalues, modal_damping, cubics = bridge.eigenvalues, bridge.damping, bridge.cubics
    damping, stiffness, inverse = truck.damping, truck.stiffness, truck.inverse_mass
    road, road_rate, quasi_static = track.road, track.road_rate, track.quasi_static
    count = eigenvalues.size
    modal_effective = 1.0 + 0.5 * step_s * modal_damping + 0.25 * step_s**2 * eigenvalues
    effective = np.ones(count)
    shape, slope = np.zeros((2, count)), np.zeros((2, count))
    q_guess, qd_guess = np.zeros(count), np.zeros(count)
    q, qd, qdd = np.zeros(count), np.zeros(count), np.zeros(count)
    z_guess, zd_guess = np.zeros(4), np.zeros(4)
    z, zd, zdd = np.zeros(4), np.zeros(4), np.zeros(4)
    free, force = np.zeros(4), np.zeros(4)
    p, y, yd, end_rate, friction = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
    for w in range(2):
        p[w] = -truck.wheels[w].static_load_n
    worst = 0
    # At time 0 displacement and velocity are given (zero) and only accelerations are unknown.
    # The same holds for the modes when initial vibration begins; before, the bridge is at rest.
    quarter = half = 0.0
    for n in range(road.shape[0]):
        if n == 1:
            quarter, half = 0.25 * step_s**2, 0.5 * step_s
            inverse = truck.inverse_effective
        is_given = n in (0, bridge.vibration_step)
        modal_quarter = 0.0 if is_given else quarter
        modal_half = 0.0 if is_given else half
        for i in range(4):
            z_guess[i] = z[i] + step_s * zd[i] + quarter * zdd[i]
            zd_guess[i] = zd[i] + half * zdd[i]
        for k in range(count):
            effective[k] = 1.0 if is_given else modal_effective[k]
            if n == bridge.vibration_step:
                # Displace q itself, too: `_end_deflection` reads it for a wheel that enters now.
                q[k] = bridge.vibration[0, k]
                q_guess[k] = q[k]
                qd_guess[k] = bridge.vibration[1, k]
            else:
                q_guess[k] = q[k] + step_s * qd[k] + quarter * qdd[k]
                qd_guess[k] = qd[k] + half * qdd[k]
        is_on = False
        for w in range(2):
            e = track.element[n, w]
            was = track.element[n - 1, w] if n > 0 else e
            end_rate[w] = 0.0
            if (e >= 0) != (was >= 0):
                # On a compliant bearing the road has a step in height, which the tyre's damper
                # transmits. The rate of one sample has the impulse of the whole step.
                end = _end_deflection(cubics, max(e, was), q)
                end_rate[w] = end / step_s if e >= 0 else -end / step_s
            if e >= 0:
                is_on = True
                length = bridge.element_lengths[e]
                _shapes(cubics[e], track.place[n, w], length, shape[w], slope[w])
            else:
                shape[w, :] = 0.0
                slope[w, :] = 0.0
        for i in range(4):
            free[i] = 0.0
            for j in range(4):
                free[i] -= damping[i, j] * zd_guess[j] + stiffness[i, j] * z_guess[j]
            zd[i], z[i] = zd_guess[i], z_guess[i]
        free[0] += track.load_transfer[n]
        free[1] -= track.load_transfer[n]
        iterations = 0
        change = np.inf
        while iterations < 2 or not change <= scheme.tolerance:
            if iterations >= scheme.max_iterations:
                return -1
            iterations += 1
            # The bridge under the latest contact forces.
            for w in range(2):
                y[w] = 0.0
                yd[w] = end_rate[w]
            for k in range(count):
                load = shape[0, k] * p[0] + shape[1, k] * p[1] if is_on else 0.0
                load -= modal_damping[k] * qd_guess[k]
                qdd[k] = (load - eigenvalues[k] * q_guess[k]) / effective[k]
                q[k] = q_guess[k] + modal_quarter * qdd[k]
                qd[k] = qd_guess[k] + modal_half * qdd[k]
            if is_on:
                for k in range(count):
                    for w in range(2):
                        y[w] += shape[w, k] * q[k]
                        yd[w] += shape[w, k] * qd[k] + slope[w, k] * track.speed[n] * q[k]
            if quasi_static.shape[0] > 0:
                for w in range(2):
                    y[w] += quasi_static[n, w, 0] * p[0] + quasi_static[n, w, 1] * p[1]
            # The truck on the road and the deflected bridge.
            for i in range(4):
                force[i] = free[i]
            for w in range(2):
                wheel = truck.wheels[w]
                force[2 + w] += wheel.tyre_n_per_m * (road[n, w] + y[w]) + wheel.tyre_n_s_per_m * (
                    road_rate[n, w] + yd[w]
                )
                stroke, before, last = z[w] - z[2 + w], 0.0, 0.0
                if n > 0:
                    before = out.friction[n - 1, w]
                    last = stroke - (out.z[n - 1, w] - out.z[n - 1, 2 + w])
                strut, friction[w] = _strut(wheel, stroke, zd[w] - zd[2 + w], before, last)
                force[w] -= strut
                force[2 + w] += strut
            for i in range(4):
                acceleration = 0.0
                for j in range(4):
                    acceleration += inverse[i, j] * force[j]
                zdd[i] = acceleration
                z[i] = z_guess[i] + quarter * acceleration
                zd[i] = zd_guess[i] + half * acceleration
            change = 0.0
            for w in range(2):
                wheel = truck.wheels[w]
                latest = -(
                    wheel.static_load_n
                    + wheel.tyre_n_per_m * (road[n, w] + y[w] - z[2 + w])
                    + wheel.tyre_n_s_per_m * (road_rate[n, w] + yd[w] - zd[2 + w])
                )
                change = max(change, abs(latest - p[w]) / wheel.static_load_n)
                p[w] = latest
        worst = max(worst, iterations)
        for i in range(4):
            out.z[n, i], out.zd[n, i], out.zdd[n, i] = z[i], zd[i], zdd[i]
        for k in range(count):
            out.q[n, k], out.qd[n, k] = q[k], qd[k]
        for w in range(2):
            out.contact[n, w], out.deflection[n, w], out.friction[n, w] = p[w], y[w], friction[w]
    return worst
