"""Kernels for a truck whose tandem axles are compared, and for any number of wheels.

The two axles of the tandem take the places of the front and the rear axle of `residuals`; the
truck's front axles are further loads ahead of them. Their own forces, m_u z'' and the difference of
their springs' forces from their shares of the sum, are small: they follow from the profile that the
tandem measured at the same place (`front_axles`), and are corrected as the estimate of truck and
bridge improves.
"""

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.arguments import Buffers, GriddedCrossing
from pre_core.crossing.suspension_noise import REDUCED_WEIGHT_SPRING_N_PER_M
from pre_core.crossing.tyre_damping import add_tyre_damping
from pre_core.kernels.lanes import Lanes, fma, fma_scalar, inner, kernel, load, mul, store
from pre_core.parameters import C_S1, C_U1, K_S1, K_U1, M_U1, SHARE
from pre_core.physics.tandem import (
    FrontAxles,
    axle_response,
    own_springs,
    shared_load,
)

_MOTION_BAND_HZ = (0.2, 0.4)
"""Band from which on an axle's motion is computed; below it the axle follows the road, whose
curvature is negligible there."""
_SMOOTH_S = 0.5
"""Duration of the tapers at both ends of the record, against the wrap of the filter."""


@inner
def is_loaded(part: NDArray[np.int64], i: int) -> bool:
    """Return whether any wheel of `part` (wheels, n) is on the bridge at sample i."""
    loaded = False
    for w in range(part.shape[0]):
        loaded = loaded or part[w, i] >= 0
    return loaded


@inner
def are_parts_equal(part: NDArray[np.int64], i: int, j: int) -> bool:
    """Return whether each wheel of `part` (wheels, n) is in the same part at samples i and j."""
    equal = True
    for w in range(part.shape[0]):
        equal = equal and part[w, i] == part[w, j]
    return equal


@inner
def wheels(
    crossing: GriddedCrossing,
    work: Buffers,
    theta: FloatArray,
    gap: float,
    gravity: float,
    speeding: FloatArray,
) -> None:
    """Compute minus the profile (`road`) and `load` of the tandem, and the other axles' `load`.

    They are for theta (p,) and longitudinal accelerations `speeding` (n,) of the truck. `body` is
    zero, except for the second row if the tandem's axles have their own springs: the moment about
    the front spring force that the springs' law does not explain, divided by `lever_m` and
    `REDUCED_WEIGHT_SPRING_N_PER_M`. (The front springs have no such equation, because the motion of
    their axles is not measured.) `gravity` is 1/common gain.
    """
    front = crossing.tandem.front
    on = shared_load(crossing.tandem, theta, crossing.total_mass_kg, gap)
    weight = gravity * crossing.gravity_m_per_s2
    transfer = crossing.total_mass_kg * crossing.cg_height_m / on.lever_m * gravity
    work.body[0, :] = 0.0
    work.body[1, :] = 0.0
    if crossing.tandem.is_equalised:
        _shared_force(crossing, work, theta, gap, transfer, speeding)
    else:
        _own_forces(crossing, work, theta, gap, transfer, speeding)
    n = speeding.size
    for j in range(front.share.size):
        of_axle, own = work.load[2 + j], crossing.front_force_n[j]
        static = weight * (front.share[j] * on.front_kg + front.unsprung_mass_kg[j])
        for i in range(n):
            of_axle[i] -= static + own[i]
    for w in range(2):
        share = theta[SHARE] if w == 0 else 1.0 - theta[SHARE]
        m_u, k_u = theta[M_U1 + w], theta[K_U1 + w]
        z_u, a_u = work.corrected[2 + w, 0], work.corrected[2 + w, 2]
        static = weight * (share * on.bogie_kg + m_u)
        road, of_wheel, force = work.road[w], work.load[w], work.precompensated[w]
        soft = 1.0 / k_u
        for i in range(n):
            force[i] += m_u * a_u[i]
        for i in range(n):
            of_wheel[i] = -static - force[i]
        for i in range(n):
            road[i] = -z_u[i] - force[i] * soft
        add_tyre_damping(force, theta[C_U1 + w] / k_u / crossing.step_s, soft, road)


@inner
def _shared_force(
    crossing: GriddedCrossing,
    work: Buffers,
    theta: FloatArray,
    gap: float,
    transfer: float,
    speeding: FloatArray,
) -> None:
    """Write the axles' shares of the spring force, and minus the front axles' forces to `load`.

    The shares are in `precompensated` until the loads are precompensated.
    """
    on = shared_load(crossing.tandem, theta, crossing.total_mass_kg, gap)
    a_1, a_2 = work.corrected[0, 2], work.corrected[1, 2]
    first, second = work.precompensated[0], work.precompensated[1]
    moment = crossing.front_moment_nm
    short = 1.0 / on.lever_m
    share = theta[SHARE]
    rest = 1.0 - share
    for j in range(crossing.tandem.front.share.size):
        of_axle, part = work.load[2 + j], crossing.tandem.front.share[j]
        for i in range(speeding.size):
            of_all = transfer * speeding[i] - on.front_1 * a_1[i] - on.front_2 * a_2[i]
            of_axle[i] = part * (of_all - short * moment[i])
    for i in range(speeding.size):
        bogie = on.bogie_1 * a_1[i] + on.bogie_2 * a_2[i] + transfer * speeding[i]
        bogie -= short * moment[i]
        first[i] = share * bogie
        second[i] = rest * bogie


@inner
def _own_forces(
    crossing: GriddedCrossing,
    work: Buffers,
    theta: FloatArray,
    gap: float,
    transfer: float,
    speeding: FloatArray,
) -> None:
    """Write the forces of both axles' own springs, and minus the front axles' forces to `load`.

    The forces are in `precompensated` until the loads are precompensated.
    """
    on = shared_load(crossing.tandem, theta, crossing.total_mass_kg, gap)
    own = own_springs(crossing.tandem, gap)
    at_1 = own.lever_1_m / crossing.tandem.readings_apart_m
    at_2 = own.lever_2_m / crossing.tandem.readings_apart_m
    a_1, a_2 = work.corrected[0, 2], work.corrected[1, 2]
    z_1, z_2, v_1, v_2 = (
        work.corrected[0, 0],
        work.corrected[1, 0],
        work.corrected[0, 1],
        work.corrected[1, 1],
    )
    z_3, z_4, v_3, v_4 = (
        work.corrected[2, 0],
        work.corrected[3, 0],
        work.corrected[2, 1],
        work.corrected[3, 1],
    )
    first, second, unexplained = (
        work.precompensated[0],
        work.precompensated[1],
        work.body[1],
    )
    k_1, k_2, c_1, c_2 = theta[K_S1], theta[K_S1 + 1], theta[C_S1], theta[C_S1 + 1]
    for i in range(speeding.size):
        first[i] = k_1 * (z_3[i] - z_1[i] - at_1 * (z_2[i] - z_1[i]))
        first[i] += c_1 * (v_3[i] - v_1[i] - at_1 * (v_2[i] - v_1[i]))
    for i in range(speeding.size):
        second[i] = k_2 * (z_4[i] - z_1[i] - at_2 * (z_2[i] - z_1[i]))
        second[i] += c_2 * (v_4[i] - v_1[i] - at_2 * (v_2[i] - v_1[i]))
    hard = 1.0 / (on.lever_m * REDUCED_WEIGHT_SPRING_N_PER_M)
    of_front = crossing.front_moment_nm
    for i in range(speeding.size):
        bogie = on.bogie_1 * a_1[i] + on.bogie_2 * a_2[i] + transfer * speeding[i]
        moment = on.lever_m * bogie - own.lever_1_m * first[i] - own.lever_2_m * second[i]
        moment -= of_front[i]
        first[i] += own.weight_1 * moment
        second[i] += own.weight_2 * moment
        unexplained[i] = moment * hard
    whole_1, whole_2 = on.front_1 + on.bogie_1, on.front_2 + on.bogie_2
    for j in range(crossing.tandem.front.share.size):
        of_axle, share = work.load[2 + j], crossing.tandem.front.share[j]
        for i in range(speeding.size):
            of_axle[i] = share * (first[i] + second[i] - whole_1 * a_1[i] - whole_2 * a_2[i])


@inner
def _cubic(cubics: FloatArray, part: int, group: int) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Return the coefficients of a group of modes in a part; zeros for a wheel off the bridge."""
    zero = (0.0, 0.0, 0.0, 0.0)
    if part < 0:
        return zero, zero, zero, zero
    here = cubics[part, group]
    return load(here, 0), load(here, 1), load(here, 2), load(here, 3)


@inner
def _value(c: tuple[Lanes, Lanes, Lanes, Lanes], x: float) -> Lanes:
    return fma_scalar(fma_scalar(fma_scalar(c[3], x, c[2]), x, c[1]), x, c[0])


@kernel
def advance(work: Buffers, begin: int, stop: int) -> None:
    """Advance all modes under all wheels, each in one part, over samples `begin` to `stop`.

    Like `modal_response.advance` and `advance_with_ends` it updates `work.state` and adds the
    deflections under the wheels to `work.lanes`.
    """
    part = work.part[:, begin]
    last = work.cubics.shape[0] - 1
    at_end = work.at_end[begin]
    for g in range(work.feedback.shape[0]):
        of_1, of_2 = _cubic(work.cubics, part[0], g), _cubic(work.cubics, part[1], g)
        of_3 = _cubic(work.cubics, part[2], g)
        for j in range(3, part.size):
            of_axle, place = _cubic(work.cubics, part[j], g), work.place[j]
            for n in range(stop - begin):
                store(work.shape[j - 3], n, _value(of_axle, place[begin + n]))
        first, final = _cubic(work.cubics, 0, g), _cubic(work.cubics, last, g)
        at_first, at_last = _value(first, 0.0), _value(final, 1.0)
        feedback, state = work.feedback[g], work.state[g]
        f_1, f_2 = load(feedback, 0), load(feedback, 1)
        n_0, n_1, n_2 = load(feedback, 2), load(feedback, 3), load(feedback, 4)
        w_1, w_2 = load(state, 0), load(state, 1)
        for n in range(stop - begin):
            i = begin + n
            a, b = _value(of_1, work.place[0, i]), _value(of_2, work.place[1, i])
            p = fma(a, load(work.force[0], n), mul(b, load(work.force[1], n)))
            c = _value(of_3, work.place[2, i])
            p = fma(c, load(work.force[2], n), p)
            for j in range(3, part.size):
                p = fma(load(work.shape[j - 3], n), load(work.force[j], n), p)
            if at_end:
                p = fma_scalar(at_first, work.end_force[0, i], p)
                p = fma_scalar(at_last, work.end_force[1, i], p)
                a_0, a_1 = work.end_share[0, 0, i], work.end_share[0, 1, i]
                b_0, b_1 = work.end_share[1, 0, i], work.end_share[1, 1, i]
                a = fma_scalar(at_first, a_0, fma_scalar(at_last, a_1, a))
                b = fma_scalar(at_first, b_0, fma_scalar(at_last, b_1, b))
            w = fma(f_1, w_1, fma(f_2, w_2, p))
            q = fma(n_0, w, fma(n_1, w_1, mul(n_2, w_2)))
            w_2 = w_1
            w_1 = w
            store(work.lanes[0], n, fma(a, q, load(work.lanes[0], n)))
            store(work.lanes[1], n, fma(b, q, load(work.lanes[1], n)))
            if at_end:
                c_0, c_1 = work.end_share[2, 0, i], work.end_share[2, 1, i]
                c = fma_scalar(at_first, c_0, fma_scalar(at_last, c_1, c))
            store(work.lanes[2], n, fma(c, q, load(work.lanes[2], n)))
            for j in range(3, part.size):
                d = load(work.shape[j - 3], n)
                if at_end:
                    d_0, d_1 = work.end_share[j, 0, i], work.end_share[j, 1, i]
                    d = fma_scalar(at_first, d_0, fma_scalar(at_last, d_1, d))
                store(work.lanes[j], n, fma(d, q, load(work.lanes[j], n)))
        store(state, 0, w_1)
        store(state, 1, w_2)


def axle_motion(
    front: FrontAxles, j: int, step_s: float, profile: FloatArray, force: FloatArray
) -> FloatArray:
    """Return the acceleration (n,) of axle j over a profile (n,) in m, at even samples.

    `profile` includes the deflection of a bridge under the axle. `force` (n,) is that of its
    springs on the body, known by inertia: whatever friction there is, m_u z'' + k_u z = k_u u - F.
    Near the resonance of axle and tyre, where this amplifies errors of the profile, the response is
    attenuated; waves below `_MOTION_BAND_HZ` are left out.
    """
    n = profile.size
    ground = profile - force / front.tyre_stiffness_n_per_m[j]
    curvature = np.zeros(n)
    curvature[1:-1] = (ground[2:] - 2.0 * ground[1:-1] + ground[:-2]) / step_s**2
    passed = motion_band(n, step_s)
    hz = np.fft.rfftfreq(n, step_s)
    response = axle_response(front, j, np.asarray(2.0 * np.pi * hz))
    return np.asarray(
        np.fft.irfft(passed * response * np.fft.rfft(record_taper(n, step_s) * curvature), n)
    )


def record_taper(n: int, step_s: float) -> FloatArray:
    """Return weights (n,) that fall to zero at both ends of a record."""
    taper = np.ones(n)
    ramp = min(n // 2, round(_SMOOTH_S / step_s))
    taper[:ramp] = 0.5 - 0.5 * np.cos(np.pi * np.arange(ramp) / ramp)
    taper[-ramp:] = taper[:ramp][::-1]
    return taper


def motion_band(n: int, step_s: float) -> FloatArray:
    """Return the factors (f,) of the frequencies of a record of n samples in an axle's motion."""
    low, high = _MOTION_BAND_HZ
    return np.clip((np.fft.rfftfreq(n, step_s) - low) / (high - low), 0.0, 1.0)
