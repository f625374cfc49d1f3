"""The residuals of one crossing at given parameters: profile mismatch and two body equations.

Everything that method `pre` estimates may change here from one evaluation to the next: truck,
bridge, wheelbase, trajectory, and each channel's gain, delay, initial state and bias. Residuals
follow the samples of the rear wheel: residual n compares the profile under the rear wheel at sample
n with that under the front wheel at the same place; the front body equation is evaluated at that
time too, so that the noise of all three is in phase. All of it happens at the model's own rate
(channels.py), in which every signal is smooth; the residuals are then whitened (whitening.py).

This module is long: an evaluation is a chain of kernels over the same work arrays, and numba
notices a changed kernel only in the same file.
"""

from collections.abc import Callable
from threading import Thread
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing import tandem
from pre_core.crossing.channels import A_1, A_2, A_3, A, V, Z
from pre_core.crossing.rows import RESIDUALS, RowFilter, row_count
from pre_core.crossing.step_tables import PHASES as _PHASES
from pre_core.crossing.step_tables import SINC_TAPS as _SINC_TAPS
from pre_core.crossing.step_tables import STEP_REACH as _STEP_REACH
from pre_core.crossing.suspension_noise import REDUCED_WEIGHT_SPRING_N_PER_M
from pre_core.crossing.whitening import Whitener, project_out_noise, whiten_into
from pre_core.kernels.lanes import LANES, kernel, summing
from pre_core.parameters import (
    C_S1,
    C_U1,
    D_1,
    EI_1,
    FIRST_OF_BRIDGE,
    K_S1,
    K_U1,
    KAPPA,
    M_U1,
    RHO_A,
    TORSION,
)
from pre_core.physics import modal_response
from pre_core.physics.beam_basis import BeamBasis, ModalFilters
from pre_core.physics.tandem import NO_LEAD, Lead
from pre_core.physics.torsion import (
    GROUPS,
    NO_TORSION,
    TorsionBasis,
    flexibility_remainder,
    torsion_filters,
)
from pre_core.physics.vehicle import masses_above_axles, masses_on_axles

FloatArray = NDArray[np.float64]

_LONGEST_STRETCH = 128
"""Steps marched at a time, so that their work arrays stay in the cache."""
SWING_MODES = 3
"""Number of modes with initial vibration; a load excites the j-th by 1/j^2 of the first."""
_FEW = 4  # points that are not worth starting a thread
_WHITE, _PLAIN, _DEFLECTIONS = range(3)
"""Outputs of `_evaluate`: whitened (3 m or more,), residuals (3 rows,), or deflections (2 n,)."""
_NOTHING = np.zeros(0)
_NO_ROWS = RowFilter(_NOTHING, 1, 0.0, _NOTHING, _NOTHING, np.zeros((0, 0), dtype=np.complex128))
_NO_FILTERS = (_NO_ROWS, Whitener(np.zeros((0, 0)), _NOTHING))


class GriddedCrossing(NamedTuple):
    """The data of one crossing on an even grid of n samples."""

    step_s: float
    signals: FloatArray  # (4, 6, n): see channels.py
    direction: int
    span_m: float
    total_mass_kg: float
    cg_height_m: float
    gravity_m_per_s2: float
    basis: BeamBasis
    edges_m: FloatArray  # (parts + 1,)
    first_row: int
    rows: int
    """Samples first_row … first_row + rows - 1 of the rear wheel are compared."""
    sinc: FloatArray  # (phases + 1, 2, taps): see `sinc_table`
    step: FloatArray  # (phases + 1, 2 reach): see `step_table`
    is_inertial: bool
    """Whether the tyre force is computed from the masses above it rather than from springs, dampers
    and axle; the results differ by the body equations."""
    swing_sample: int
    """Sample of `EvaluationPoints.swing`, more than a step's reach before the entry."""
    torsion: TorsionBasis = NO_TORSION
    lead: Lead = NO_LEAD
    """Front axle of a truck whose tandem is compared: "front" and "rear" are then the tandem's."""
    lead_acceleration: FloatArray = _NOTHING  # (n,) of that axle, zero without one: see tandem.py


class EvaluationPoints(NamedTuple):
    """Points (k) at which to evaluate; see `evaluate`.

    A gain common to all sensors scales all measurements and changes no residual except by the
    static load, which is not measured: residuals stay in the sensors' own scale, and known loads
    (weight, load transfer) are converted to it.
    """

    theta: FloatArray  # (k, p): truck and bridge, as in parameters.py
    wheelbase_m: FloatArray  # (k,)
    position_m: FloatArray  # (k, n): chainage of the front axle
    acceleration_m_per_s2: FloatArray  # (k, n): positive when speeding up
    gain: FloatArray  # (k, 4): relative corrections, of mean zero
    common_gain: FloatArray  # (k,): factor by which all four sensors read too little
    delay_s: FloatArray  # (k, 4): corrections, read from Taylor's series
    initial: FloatArray  # (k, 4, 3): displacement, velocity, bias to be added
    swing: FloatArray  # (k, 2 modes): see `_set_initial_vibration`


class Buffers(NamedTuple):
    """Work arrays of one thread; modified in place."""

    matrix: FloatArray  # (m, m)
    vectors: FloatArray  # (m, m)
    cubics: FloatArray  # (parts, groups, 4, 4)
    feedback: FloatArray  # (groups, 5, 4)
    state: FloatArray  # (groups, 2, 4)
    force: FloatArray  # (wheels, stretch, 4)
    lanes: FloatArray  # (wheels, stretch, 4)
    place: FloatArray  # (wheels, n): the compared two, and that ahead of a tandem
    part: NDArray[np.int64]  # (wheels, n)
    corrected: FloatArray  # (4, 3, n)
    load: FloatArray  # (wheels, n)
    sharp: FloatArray  # (wheels, n)
    road: FloatArray  # (2, n)
    body: FloatArray  # (2, n)
    begin: NDArray[np.int64]  # (rows,)
    between: FloatArray  # (rows,)
    residual: FloatArray  # (3, rows)
    row: FloatArray  # (filtered rows,)
    modes_of: FloatArray  # (p,) the bridge whose modes are in `cubics`
    modes: FloatArray  # (m, 3): see `modal_filters`
    end_force: FloatArray  # (2 ends, n)
    end_share: FloatArray  # (wheels, 2 ends, n)
    at_end: NDArray[np.bool_]  # (n,) whether one of these is not zero
    under_lead: FloatArray  # (n,) deflection under the axle ahead of a tandem


def allocate_buffers(crossing: GriddedCrossing, parameters: int, rows: RowFilter) -> Buffers:
    """Allocate the work arrays for this crossing."""
    parts, _, m = crossing.basis.cubics.shape
    groups = (m + LANES - 1) // LANES + GROUPS * crossing.torsion.ends_m.shape[0]
    n = crossing.signals.shape[2]
    wheels = 3 if crossing.lead.ahead_m > 0.0 else 2
    return Buffers(
        np.zeros((m, m)),
        np.zeros((m, m)),
        np.zeros((parts, groups, 4, LANES)),
        np.zeros((groups, modal_response.COEFFICIENTS, LANES)),
        np.zeros((groups, 2, LANES)),
        np.zeros((wheels, _LONGEST_STRETCH, LANES)),
        np.zeros((wheels, _LONGEST_STRETCH, LANES)),
        np.zeros((wheels, n)),
        np.zeros((wheels, n), dtype=np.int64),
        np.zeros((4, 3, n)),
        np.zeros((wheels, n)),
        np.zeros((wheels, n)),
        np.zeros((2, n)),
        np.zeros((2, n)),
        np.zeros(crossing.rows, dtype=np.int64),
        np.zeros(crossing.rows),
        np.zeros((RESIDUALS, crossing.rows)),
        np.zeros(row_count(rows, crossing.rows)),
        np.full(parameters, np.nan),
        np.zeros((m, 3)),
        np.zeros((2, n)),
        np.zeros((wheels, 2, n)),
        np.full(n, False),
        np.zeros(n if wheels == 3 else 0),
    )


@kernel
def _correct(
    signals: FloatArray,
    step: float,
    gain: FloatArray,
    delay: FloatArray,
    initial: FloatArray,
    out: FloatArray,
) -> None:
    """Compute displacement, velocity and acceleration (4, 3, n) above and on the axles."""
    n = signals.shape[2]
    middle = n // 2
    for c in range(4):
        g = 1.0 + gain[c]
        d = delay[c]
        d1, d2, d3 = g * d, g * 0.5 * d * d, g * d * d * d / 6.0
        z0, v0, b = initial[c, 0], initial[c, 1], initial[c, 2]
        z, v, a = signals[c, Z], signals[c, V], signals[c, A]
        a1, a2, a3 = signals[c, A_1], signals[c, A_2], signals[c, A_3]
        out_z, out_v, out_a = out[c, 0], out[c, 1], out[c, 2]
        # One store a loop: more keep the compiler from using the vector registers.
        for i in range(n):
            t = step * (i - middle)
            out_z[i] = g * z[i] + d1 * v[i] + d2 * a[i] + d3 * a1[i] + z0 + t * (v0 + 0.5 * b * t)
        for i in range(n):
            t = step * (i - middle)
            out_v[i] = g * v[i] + d1 * a[i] + d2 * a1[i] + d3 * a2[i] + v0 + b * t
        for i in range(n):
            out_a[i] = g * a[i] + d1 * a1[i] + d2 * a2[i] + d3 * a3[i] + b


@kernel
def _wheels(
    crossing: GriddedCrossing,
    work: Buffers,
    theta: FloatArray,
    wheelbase: float,
    gravity: float,
    speeding: FloatArray,
) -> None:
    """Compute `road` (minus the profile), `load`, `body`; `gravity` is divided by common gain."""
    m_s = crossing.total_mass_kg - theta[M_U1] - theta[M_U1 + 1]
    m_11, m_22, m_12 = masses_above_axles(m_s, theta[D_1], wheelbase, theta[KAPPA])
    on_axles = masses_on_axles(m_s, theta[D_1], wheelbase, theta[M_U1], theta[M_U1 + 1])
    transfer = crossing.total_mass_kg * crossing.cg_height_m / wheelbase * gravity
    n = work.road.shape[1]
    step = crossing.step_s
    for w in range(2):
        sign = 1.0 - 2.0 * w
        m_ii = m_11 if w == 0 else m_22
        m_u = theta[M_U1 + w]
        c, k, k_u = theta[C_S1 + w], theta[K_S1 + w], theta[K_U1 + w]
        # delta = (F - tau F' + tau^2 F'')/k_u solves k_u delta + c_u delta' = F for small tau.
        tau = theta[C_U1 + w] / k_u
        slope, bend = tau / (12.0 * step), (tau / step) ** 2
        weight = gravity * crossing.gravity_m_per_s2 * on_axles[w]
        z_s, v_s, a_s = work.corrected[w, 0], work.corrected[w, 1], work.corrected[w, 2]
        z_u, v_u, a_u = work.corrected[2 + w, 0], work.corrected[2 + w, 1], work.corrected[2 + w, 2]
        a_other = work.corrected[1 - w, 2]
        road, load, body = work.road[w], work.load[w], work.body[w]
        soft = 1.0 / k_u
        hard = 1.0 / REDUCED_WEIGHT_SPRING_N_PER_M if crossing.is_inertial else 1.0 / k
        for i in range(n):
            inertial = m_ii * a_s[i] + m_12 * a_other[i]
            load[i] = sign * transfer * speeding[i] - weight - inertial - m_u * a_u[i]
        # The tyre force accelerates the masses above it, whatever springs are between; where these
        # are linear, they give the same with far less noise of the body sensors.
        force = work.sharp[w]  # not in use yet
        if crossing.is_inertial:
            for i in range(n):
                force[i] = -load[i] - weight
        else:
            for i in range(n):
                force[i] = m_u * a_u[i] + c * (v_u[i] - v_s[i]) + k * (z_u[i] - z_s[i])
        for i in range(n):
            road[i] = -z_u[i] - force[i] * soft
        if tau != 0.0:
            tandem.add_tyre_damping(force, slope, bend, soft, road)
        for i in range(n):
            spring = c * (v_u[i] - v_s[i]) + k * (z_u[i] - z_s[i])
            inertial = m_ii * a_s[i] + m_12 * a_other[i]
            body[i] = (inertial - spring - sign * transfer * speeding[i]) * hard


@kernel
def _locate(crossing: GriddedCrossing, work: Buffers, front: FloatArray, wheelbase: float) -> None:
    edges = crossing.edges_m
    parts = edges.size - 1
    n = front.size
    for w in range(work.part.shape[0]):
        offset = 0.0 if w == 0 else -crossing.direction * wheelbase
        if w == 2:
            offset = crossing.direction * crossing.lead.ahead_m
        e = 0 if crossing.direction > 0 else parts - 1
        for i in range(n):
            x = front[i] + offset
            if x < 0.0 or x > edges[parts]:
                work.part[w, i] = -1
                work.place[w, i] = 0.0
                continue
            while e < parts - 1 and x > edges[e + 1]:
                e += 1
            while e > 0 and x < edges[e]:
                e -= 1
            work.part[w, i] = e
            work.place[w, i] = (x - edges[e]) / (edges[e + 1] - edges[e])


@kernel
def _bridge(crossing: GriddedCrossing, work: Buffers, theta: FloatArray) -> bool:
    """Compute the modes of this bridge in the work arrays, unless they are there already."""
    same = True
    for i in range(FIRST_OF_BRIDGE, theta.size):
        if theta[i] != work.modes_of[i]:
            same = False
    if same:
        return True
    filters = ModalFilters(work.cubics, work.feedback, work.state)
    if not modal_response.modal_filters(
        crossing.basis, theta, crossing.step_s, work.matrix, work.vectors, filters, work.modes
    ):
        work.modes_of[:] = np.nan
        return False
    if not torsion_filters(crossing.torsion, theta, crossing.step_s, work.cubics, work.feedback):
        work.modes_of[:] = np.nan
        return False
    work.modes_of[:] = theta
    return True


@kernel
def _soften_ends(
    crossing: GriddedCrossing,
    front: FloatArray,
    part: NDArray[np.int64],
    place: FloatArray,
    force: FloatArray,
) -> None:
    """Weight a wheel's force at its first and last sample on the bridge.

    Between the bearing and that sample, f of a step away, the load on a mode grows over f of the
    step: a weight of (1 + f)/2 keeps its impulse, so that the deflection is independent of the
    entry's phase.
    """
    n = part.size
    parts = crossing.edges_m.size - 1
    for i in range(1, n - 1):
        if part[i] < 0 or (part[i - 1] >= 0 and part[i + 1] >= 0):
            continue
        length = crossing.edges_m[part[i] + 1] - crossing.edges_m[part[i]]
        from_start = place[i] * length if part[i] == 0 else np.inf
        from_end = (1.0 - place[i]) * length if part[i] == parts - 1 else np.inf
        step = np.abs(front[i + 1] - front[i - 1]) * 0.5
        force[i] *= 0.5 + 0.5 * min(1.0, min(from_start, from_end) / step)


@kernel
def _apply_end_steps(
    crossing: GriddedCrossing, work: Buffers, front: FloatArray, offset: float, w: int
) -> None:
    """Apply the steps of wheel w's entry and exit where the ends are compliant.

    With Theta_n the samples at which the wheel is on the bridge and S_n the band-limited step, the
    force on the bridge's end is P S, of which the samples on the bridge have P Theta: the rest is a
    force at the end (`end_force`). The wheel follows S of the end's deflection, not Theta
    (`end_share`). Call it after the wheel's force has been precompensated and softened.
    """
    n = work.part.shape[1]
    load, sharp, part = work.load[w], work.sharp[w], work.part[w]
    length = crossing.edges_m[crossing.edges_m.size - 1]
    values = np.empty(2 * _STEP_REACH + 2)
    for i in range(_STEP_REACH + 1, n - _STEP_REACH):
        is_on, was_on = part[i] >= 0, part[i - 1] >= 0
        if is_on == was_on:
            continue
        near_start = 2.0 * (front[i] + offset) < length
        end = 0 if near_start else 1
        bearing = 0.0 if near_start else length
        since = (front[i] + offset - bearing) / (front[i] - front[i - 1])
        place = min(max(since, 0.0), 1.0) * _PHASES
        phase = min(int(place), _PHASES - 1)
        share = place - phase
        low, high = crossing.step[phase], crossing.step[phase + 1]
        begin = i - _STEP_REACH
        # P S at the samples of the window and one to each side.
        for m in range(2 * _STEP_REACH + 2):
            rising = 0.0
            if m > 2 * _STEP_REACH:
                rising = 1.0
            elif m > 0:
                rising = low[m - 1] + share * (high[m - 1] - low[m - 1])
            values[m] = (rising if is_on else 1.0 - rising) * load[begin + m - 1]
        for m in range(2 * _STEP_REACH):
            j = begin + m
            before, at, after = values[m], values[m + 1], values[m + 2]
            there = sharp[j] if part[j] >= 0 else 0.0
            work.end_force[end, j] += at - (before - 2.0 * at + after) / 12.0 - there
            rising = low[m] + share * (high[m] - low[m])
            present = rising if is_on else 1.0 - rising
            work.end_share[w, end, j] += present - (1.0 if part[j] >= 0 else 0.0)
            work.at_end[j] = True


@kernel
def _set_initial_vibration(
    crossing: GriddedCrossing, work: Buffers, rho_a: float, amplitude: FloatArray
) -> None:
    """Set the initial vibration of the bridge's lowest modes.

    `amplitude` (2 modes) in m: displacement and velocity over omega at a mode's largest point.
    """
    length = crossing.edges_m[crossing.edges_m.size - 1]
    size = np.sqrt(0.5 * rho_a * length)
    for k in range(min(SWING_MODES, work.modes.shape[0])):
        q = size * amplitude[2 * k]
        v = size * amplitude[2 * k + 1] * np.sqrt(max(work.modes[k, 0], 0.0))
        modal_response.add_free_vibration(work.feedback, work.state, work.modes[k], k, q, v)


@kernel
def _deflect(crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int) -> None:
    """Add the bridge's deflection to `road` (which is minus the input profile)."""
    front = points.position_m[k]
    n = work.road.shape[1]
    gives = crossing.basis.stiffness.shape[0] - (points.theta.shape[1] - EI_1) > 2
    if gives:
        work.end_force[:] = 0.0
        work.end_share[:] = 0.0
        work.at_end[:] = False
    for w in range(work.part.shape[0]):
        modal_response.precompensate_force(work.load[w], work.sharp[w])
        _soften_ends(crossing, front, work.part[w], work.place[w], work.sharp[w])
        if gives:
            offset = 0.0 if w == 0 else -crossing.direction * points.wheelbase_m[k]
            if w == 2:
                offset = crossing.direction * crossing.lead.ahead_m
            _apply_end_steps(crossing, work, front, offset, w)
    work.state[:] = 0.0
    _set_initial_vibration(crossing, work, points.theta[k, RHO_A], points.swing[k])
    last = n  # nothing is needed after the last sample with a wheel on the bridge
    while last > 0 and not (tandem.is_loaded(work.part, last - 1) or work.at_end[last - 1]):
        last -= 1
    begin = 0
    while begin < last and begin < crossing.swing_sample and not work.at_end[begin]:
        if tandem.is_loaded(work.part, begin):
            break
        begin += 1
    while begin < last:
        stop = begin + 1
        while (
            stop < last
            and stop - begin < _LONGEST_STRETCH
            and tandem.are_parts_equal(work.part, begin, stop)
            and work.at_end[stop] == work.at_end[begin]
        ):
            stop += 1
        for w in range(work.part.shape[0]):
            for i in range(begin, stop):
                p = work.sharp[w, i]
                for lane in range(LANES):
                    work.force[w, i - begin, lane] = p
                    work.lanes[w, i - begin, lane] = 0.0
        _advance(work, begin, stop)
        for w in range(2):
            for i in range(begin, stop):
                y = work.lanes[w, i - begin]
                work.road[w, i] += (y[0] + y[1]) + (y[2] + y[3])
        if work.part.shape[0] == 3:
            for i in range(begin, stop):
                y = work.lanes[2, i - begin]
                work.under_lead[i] = (y[0] + y[1]) + (y[2] + y[3])
        begin = stop
    if crossing.torsion.ends_m.shape[0] > 0:
        _quasi_static_twist(crossing, work, points, k, last)


@kernel
def _advance(work: Buffers, begin: int, stop: int) -> None:
    """March all modes over the samples of a stretch in which each wheel stays in one part."""
    if work.part.shape[0] == 3:
        tandem.advance(work, begin, stop)
        return
    filters = ModalFilters(work.cubics, work.feedback, work.state)
    place, front, rear = work.place[:, begin:stop], work.part[0, begin], work.part[1, begin]
    wheels = modal_response.LoadedStretch(front, rear, place, work.force, work.lanes)
    if work.at_end[begin]:
        force, share = work.end_force[:, begin:stop], work.end_share[:, :, begin:stop]
        modal_response.advance_with_ends(filters, wheels, modal_response.EndStretch(force, share))
    else:
        modal_response.advance(filters, wheels)


@kernel
def _quasi_static_twist(
    crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int, last: int
) -> None:
    """Add the quasi-static twist, beyond the marched modes, to `road`."""
    torsion = crossing.torsion
    flexibility = max(points.theta[k, TORSION], 0.0) * torsion.load_factor
    if flexibility == 0.0:
        return
    back = crossing.direction * points.wheelbase_m[k]
    for i in range(last):
        e1, e2 = work.part[0, i], work.part[1, i]
        if e1 < 0 and e2 < 0:
            continue
        x1 = points.position_m[k, i]
        x2 = x1 - back
        p1, p2 = work.place[0, i], work.place[1, i]
        across = flexibility_remainder(torsion, e1, p1, x1, e2, p2, x2)
        if e1 >= 0:
            own = flexibility_remainder(torsion, e1, p1, x1, e1, p1, x1)
            work.road[0, i] += flexibility * (own * work.load[0, i] + across * work.load[1, i])
        if e2 >= 0:
            own = flexibility_remainder(torsion, e2, p2, x2, e2, p2, x2)
            work.road[1, i] += flexibility * (own * work.load[1, i] + across * work.load[0, i])
        if work.part.shape[0] == 3 and work.part[2, i] >= 0:
            e3, p3 = work.part[2, i], work.place[2, i]
            x3 = x1 + crossing.direction * crossing.lead.ahead_m
            pushed = flexibility * work.load[2, i]
            work.road[0, i] += pushed * flexibility_remainder(torsion, e1, p1, x1, e3, p3, x3)
            work.road[1, i] += pushed * flexibility_remainder(torsion, e2, p2, x2, e3, p3, x3)


@kernel
def _locate_front_sample(
    crossing: GriddedCrossing,
    front: FloatArray,
    wheelbase: float,
    begin: NDArray[np.int64],
    between: FloatArray,
) -> bool:
    """Find when the front wheel was at the rear wheel's place; return False if it is unknown.

    Outputs by residual: first weighted sample (`begin`), place between its neighbours (`between`).
    """
    sign = 1.0 if crossing.direction > 0 else -1.0
    n = front.size
    ahead = _SINC_TAPS // 2
    j = ahead - 1
    for row in range(begin.size):
        i = crossing.first_row + row
        wanted = sign * front[i] - wheelbase
        while j < n - ahead - 1 and sign * front[j + 1] < wanted:
            j += 1
        x1, x2 = sign * front[j], sign * front[j + 1]
        if not (x1 <= wanted <= x2) or x2 <= x1:
            return False
        # Inverse of the parabola through the samples around, to first order in its curvature, which
        # is a few thousandths of its slope; what is left out is a millionth of a sample.
        slope = 1.0 / (x2 - x1)
        f = (wanted - x1) * slope
        curvature = 0.5 * (sign * (front[j + 2] + front[j - 1]) - x1 - x2) * slope
        f -= 0.5 * f * (f - 1.0) * curvature
        begin[row] = j - ahead + 1
        between[row] = min(max(f, 0.0), 1.0)
    return True


@summing
def _read(
    sinc: FloatArray, place: float, begin: int, wheel: int, road: FloatArray, body: FloatArray
) -> tuple[float, float]:
    """Return `road` and `body` (2, n) of a wheel at `place` (0 to 1) between the middle two taps.

    Samples start at `begin`. Indices are unsigned: with signed ones every access would test for
    counting from the end, and the compiler would not use the vector registers, four times as slow.
    """
    phase = min(int(place * _PHASES), _PHASES - 1)
    share = place * _PHASES - phase
    low, first, w = np.uintp(phase), np.uintp(begin), np.uintp(wheel)
    high = low + np.uintp(1)
    rest = 1.0 - share
    value_high = share * share * (3.0 - 2.0 * share)
    value_low = 1.0 - value_high
    slope_low = share * rest * rest
    slope_high = -share * share * rest
    sum_road = sum_body = 0.0
    for k in range(np.uintp(_SINC_TAPS)):
        weight = (value_low * sinc[low, 0, k] + value_high * sinc[high, 0, k]) + (
            slope_low * sinc[low, 1, k] + slope_high * sinc[high, 1, k]
        )
        sum_road += weight * road[w, first + k]
        sum_body += weight * body[w, first + k]
    return sum_road, sum_body


@kernel
def _compare(crossing: GriddedCrossing, work: Buffers, out: FloatArray) -> None:
    """Compute all residuals to `out` (3, rows), at the times of `_locate_front_sample`."""
    road, body = work.road, work.body
    first = np.uintp(crossing.first_row)
    for row in range(np.uintp(crossing.rows)):
        front_road, front_body = _read(
            crossing.sinc, work.between[row], work.begin[row], 0, road, body
        )
        out[0, row] = road[1, first + row] - front_road  # both hold y - u, minus the road
        out[1, row] = front_body
        out[2, row] = body[1, first + row]


@kernel
def _evaluate(
    crossing: GriddedCrossing,
    filters: tuple[RowFilter, Whitener],
    work: Buffers,
    points: EvaluationPoints,
    part: tuple[int, int],
    what: int,
    out: FloatArray,
) -> None:
    """Compute the requested output of points `part` to their rows of `out`; NaN if impossible.

    One kernel for all three: each would hold a copy of the model, and take as long to load.
    """
    rows, noise = filters
    for k in range(part[0], part[1]):
        row = out[k]
        if not (
            _is_possible(points.theta[k], points.wheelbase_m[k], crossing.lead.readings_apart_m)
            and _roads(crossing, work, points, k)
        ):
            row[:] = np.nan
            continue
        road = work.road.reshape(work.road.size)
        if what == _DEFLECTIONS:
            row[:] = road
        elif not _locate_front_sample(
            crossing, points.position_m[k], points.wheelbase_m[k], work.begin, work.between
        ):
            row[:] = np.nan
            continue
        _deflect(crossing, work, points, k)
        if what == _DEFLECTIONS:
            for i in range(row.size):
                row[i] = road[i] - row[i]
            continue
        _compare(crossing, work, work.residual)
        if what == _PLAIN:
            row[:] = work.residual.reshape(work.residual.size)
        else:
            whiten_into(rows, noise, work.residual, work.row, row[: noise.reciprocal.size])


@kernel
def _is_possible(theta: FloatArray, wheelbase_m: float, lead_base_m: float) -> bool:
    for i in range(theta.size):
        if not np.isfinite(theta[i]):
            return False
    return theta[D_1] < max(wheelbase_m, lead_base_m)


@kernel
def _roads(crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int) -> bool:
    """Compute the work arrays of point k up to the deflection; return False if impossible."""
    _correct(
        crossing.signals,
        crossing.step_s,
        points.gain[k],
        points.delay_s[k],
        points.initial[k],
        work.corrected,
    )
    gravity = 1.0 / points.common_gain[k]
    speeding = points.acceleration_m_per_s2[k]
    if work.part.shape[0] == 3:
        gap = points.wheelbase_m[k]
        tandem.wheels(crossing, work, points.theta[k], gap, gravity, speeding)
    else:
        _wheels(crossing, work, points.theta[k], points.wheelbase_m[k], gravity, speeding)
    _locate(crossing, work, points.position_m[k], points.wheelbase_m[k])
    return _bridge(crossing, work, points.theta[k])


def evaluate(
    crossing: GriddedCrossing, works: tuple[Buffers, ...], points: EvaluationPoints
) -> FloatArray:
    """Return residuals (k, 3, rows) in m: R_1 - R_2, front and rear body equation over k_s.

    NaN for an impossible point or a trajectory that turns back. `works`: one per thread.
    """
    out = np.empty((points.theta.shape[0], RESIDUALS * crossing.rows))

    def part(work: Buffers, begin: int, stop: int) -> None:
        _evaluate(crossing, _NO_FILTERS, work, points, (begin, stop), _PLAIN, out)

    _in_threads(part, works, out.shape[0])
    return out.reshape(-1, RESIDUALS, crossing.rows)


def evaluate_white(
    crossing: GriddedCrossing,
    rows: RowFilter,
    noise: Whitener,
    works: tuple[Buffers, ...],
    points: EvaluationPoints,
    out: FloatArray,
) -> None:
    """Compute whitened residuals of points to columns of `out` (k, 3 m or more); NaN as above."""

    def part(work: Buffers, begin: int, stop: int) -> None:
        _evaluate(crossing, (rows, noise), work, points, (begin, stop), _WHITE, out)

    _in_threads(part, works, out.shape[0])
    if noise.lines.size or noise.low_rank.size:
        white = out[:, : noise.reciprocal.size]
        white[:] = project_out_noise(noise, white)


def _in_threads(
    part: Callable[[Buffers, int, int], None],
    works: tuple[Buffers, ...],
    count: int,
) -> None:
    if count < _FEW or len(works) == 1:
        part(works[0], 0, count)
        return
    bounds = [count * i // len(works) for i in range(len(works) + 1)]
    others = [
        Thread(target=part, args=(works[i], bounds[i], bounds[i + 1])) for i in range(1, len(works))
    ]
    for thread in others:
        thread.start()
    part(works[0], 0, bounds[1])
    for thread in others:
        thread.join()


def roads_and_deflections(
    crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int
) -> tuple[FloatArray, FloatArray]:
    """Return profile heights (2, n) in m under both wheels at every sample, and deflections (2, n).

    Raise FloatingPointError for an impossible point.
    """
    deflection = _deflections(crossing, work, points, k)
    if np.isnan(deflection[0, 0]):
        raise FloatingPointError("the bridge of this point has no modes")
    gain = points.common_gain[k]
    return -gain * work.road, gain * deflection


def largest_deflections(
    crossing: GriddedCrossing, works: tuple[Buffers, ...], points: EvaluationPoints
) -> FloatArray:
    """Return the largest deflection (k,) in m under a wheel, positive downwards; NaN as above."""
    out = np.empty(points.theta.shape[0])

    def part(work: Buffers, begin: int, stop: int) -> None:
        for k in range(begin, stop):
            out[k] = -_deflections(crossing, work, points, k).min()

    _in_threads(part, works, out.size)
    return points.common_gain * out


def _deflections(
    crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int
) -> FloatArray:
    """Return the deflections of point k (2, n), `work.road` its negated profiles; or NaN."""
    one = EvaluationPoints(*(of[k : k + 1] for of in points))
    out = np.empty((1, work.road.size))
    _evaluate(crossing, _NO_FILTERS, work, one, (0, 1), _DEFLECTIONS, out)
    return out.reshape(work.road.shape)
