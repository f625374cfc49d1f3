"""The deflection of the bridge under the wheels of one crossing, at given parameters.

The wheels' loads drive the bridge's modes from sample to sample; the quasi-static part is added.
"""

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import tandem
from pre_core.crossing.arguments import LONGEST_STRETCH, Buffers, EvaluationPoints, GriddedCrossing
from pre_core.crossing.step_tables import PHASES as _PHASES
from pre_core.crossing.step_tables import STEP_REACH as _STEP_REACH
from pre_core.kernels.lanes import LANES, inner
from pre_core.parameters import EI_1, FIRST_OF_BRIDGE, RHO_A, TORSION
from pre_core.physics import modal_response
from pre_core.physics.beam_basis import ModalFilters
from pre_core.physics.torsion import flexibility_remainder, torsion_filters

SWING_MODES = 3
"""Number of modes with initial vibration; a load excites higher ones less (`posterior`)."""


@inner
def update_modes(crossing: GriddedCrossing, work: Buffers, theta: FloatArray) -> bool:
    """Compute the modes at `theta` (p,) in the work arrays, unless these already hold them.

    Return False if they are not finite.
    """
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
    for i in range(theta.size):
        work.modes_of[i] = theta[i]
    return True


@inner
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


@inner
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
    load, precompensated, part = work.load[w], work.precompensated[w], work.part[w]
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
            there = precompensated[j] if part[j] >= 0 else 0.0
            work.end_force[end, j] += at - (before - 2.0 * at + after) / 12.0 - there
            rising = low[m] + share * (high[m] - low[m])
            present = rising if is_on else 1.0 - rising
            work.end_share[w, end, j] += present - (1.0 if part[j] >= 0 else 0.0)
            work.at_end[j] = True


@inner
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


@inner
def add_deflection(
    crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int
) -> None:
    """Add the bridge's deflection to `road` (which is minus the input profile)."""
    front = points.position_m[k]
    n = work.road.shape[1]
    is_compliant = crossing.basis.stiffness.shape[0] - (points.theta.shape[1] - EI_1) > 2
    if is_compliant:
        work.end_force[:] = 0.0
        work.end_share[:] = 0.0
        work.at_end[:] = False
    for w in range(work.part.shape[0]):
        modal_response.precompensate_force(work.load[w], work.precompensated[w])
        _soften_ends(crossing, front, work.part[w], work.place[w], work.precompensated[w])
        if is_compliant:
            offset = 0.0 if w == 0 else -crossing.direction * points.wheelbase_m[k]
            if w >= 2:
                offset = crossing.direction * crossing.tandem.front.ahead_m[w - 2]
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
            and stop - begin < LONGEST_STRETCH
            and tandem.are_parts_equal(work.part, begin, stop)
            and work.at_end[stop] == work.at_end[begin]
        ):
            stop += 1
        for w in range(work.part.shape[0]):
            for i in range(begin, stop):
                p = work.precompensated[w, i]
                for lane in range(LANES):
                    work.force[w, i - begin, lane] = p
                    work.lanes[w, i - begin, lane] = 0.0
        _advance(work, begin, stop)
        for w in range(2):
            for i in range(begin, stop):
                y = work.lanes[w, i - begin]
                work.road[w, i] += (y[0] + y[1]) + (y[2] + y[3])
        for j in range(work.part.shape[0] - 2):
            for i in range(begin, stop):
                y = work.lanes[2 + j, i - begin]
                work.under_front[j, i] = (y[0] + y[1]) + (y[2] + y[3])
        begin = stop
    if crossing.torsion.ends_m.shape[0] > 0:
        _quasi_static_twist(crossing, work, points, k, last)


@inner
def _advance(work: Buffers, begin: int, stop: int) -> None:
    """Advance all modes over the samples of a stretch in which each wheel stays in one part."""
    if work.part.shape[0] > 2:
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


@inner
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
        for w in range(2, work.part.shape[0]):
            if work.part[w, i] < 0:
                continue
            e3, p3 = work.part[w, i], work.place[w, i]
            x3 = x1 + crossing.direction * crossing.tandem.front.ahead_m[w - 2]
            pushed = flexibility * work.load[w, i]
            work.road[0, i] += pushed * flexibility_remainder(torsion, e1, p1, x1, e3, p3, x3)
            work.road[1, i] += pushed * flexibility_remainder(torsion, e2, p2, x2, e3, p3, x3)
