"""Method `pre`: from one crossing's signals to the problem that is to be solved, and its noise."""

from typing import NamedTuple

import numpy as np

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.crossing.channels import channel_signals
from pre_core.crossing.mismatch import Mismatch, shapes_of
from pre_core.crossing.posterior import (
    Fixes,
    Priors,
    Problem,
    filtered_rear_road,
    filtered_rows,
    layout,
    points,
    start,
    trajectory_basis,
    truck_at,
)
from pre_core.crossing.residuals import Crossing, Points, sinc_table, step_table, workspace
from pre_core.crossing.whitening import (
    DOUBTED,
    Truck,
    force_noise,
    linear_springs,
    mismatch_levels,
    mismatch_power,
    noise_power,
    row_count,
    row_filter,
    truck_of,
    whitener,
)
from pre_core.physics.beam_basis import beam_basis, rebased
from pre_core.physics.bridge import FloatArray
from pre_core.physics.simulate import rear_position_m
from pre_core.physics.surface import COMMON_LORRY, Footprint
from pre_core.physics.torsion import NO_TORSION, torsion_basis
from pre_core.unknowns import FIRST_OF_BRIDGE, TORSION

_KNOT_S = 0.4
"""Between knots of the trajectory: a driver changes the speed more slowly."""
_SLOPE_STEP = 1e-3
"""Step of the one-sided difference for how the noise's power changes with the truck and the
gains."""
_SWING_BEFORE_S = 0.1
"""The bridge's swing is told at this time before the truck comes, to leave the search room."""
_MARGIN_M = 3.0  # of road before the first row, for the trajectory to move


_SILENCED = 100.0
"""Where springs are doubted their noise is taken for so many times its level. It is not noise: it
follows the truck's motion, and what of it looks like a heavier end or another centre of gravity
would be believed. With it as found EI was 0.34 standard deviations too low (the median of 36
crossings with friction) and 93 % of the intervals held the truth; so 0.09 and 97 %, and the
intervals are as wide as before."""


_FEWEST_ROWS = 24
"""Off the bridge, in one stretch, that tell something of the mismatch."""
_STEP_SAMPLES = 9
MISMATCHED = 30.0
"""So much must twice the log-likelihood of the rows off the bridge gain."""


class Inputs(NamedTuple):
    """One crossing as method `pre` takes it; times in s on one clock, chainage in m."""

    acceleration_m_per_s2: FloatArray  # (4, n)
    start_s: float
    step_s: float
    direction: int
    span_m: float
    element_lengths_m: FloatArray
    interior_supports: tuple[int, ...]
    """Between which elements the bridge is held up: after so many of them."""
    total_mass_kg: float
    cg_height_m: float
    density_m_per_s2_per_rthz: FloatArray  # (4,) one-sided
    slowest_rate_hz: float
    fixes: Fixes
    priors: Priors
    parts: int
    threads: int
    footprints: tuple[Footprint, Footprint] = COMMON_LORRY
    """Where the front and the rear axle stand on the road."""
    torsional_wave_speed_m_per_s: float = 0.0
    """Positive where the deck may twist."""
    lane_factor: float = 1.0
    """Square of this run's distance from the bridge's axis over that of the torsion's prior."""


def prepare(inputs: Inputs) -> tuple[Problem, FloatArray]:
    """Return the problem and the coordinates of its nominal start.

    Raises ValueError if torsion is estimated and no speed of its waves is given.
    """
    model = channel_signals(inputs.acceleration_m_per_s2, inputs.step_s, inputs.slowest_rate_hz)
    n = model.signals.shape[2]
    basis = beam_basis(
        inputs.element_lengths_m,
        inputs.parts,
        interior_supports=inputs.interior_supports,
        bearings_give=True,
    )
    position, speeding, rows, values, best = trajectory_basis(
        inputs.fixes, inputs.start_s + model.start_s, model.step_s, n, inputs.direction, _KNOT_S
    )
    front = position @ best[:-1]
    travel = front if inputs.direction > 0 else inputs.span_m - front
    wheelbase = inputs.priors.wheelbase_m
    first = int(np.searchsorted(travel - wheelbase, travel[0] + _MARGIN_M))
    torsion = NO_TORSION
    if inputs.priors.estimated[TORSION]:
        if not inputs.torsional_wave_speed_m_per_s > 0.0:
            raise ValueError("torsion is estimated, so its waves need a speed")
        torsion = torsion_basis(
            basis.lengths_m,
            tuple(inputs.parts * node for node in inputs.interior_supports),
            inputs.torsional_wave_speed_m_per_s,
            inputs.lane_factor,
        )
    crossing = Crossing(
        model.step_s,
        model.signals,
        inputs.direction,
        inputs.span_m,
        inputs.total_mass_kg,
        inputs.cg_height_m,
        STANDARD_GRAVITY_M_PER_S2,
        rebased(basis, inputs.priors.theta),
        np.concatenate([[0.0], np.cumsum(basis.lengths_m)]),
        first,
        n - first,
        sinc_table(),
        step_table(),
        False,
        0,
        torsion,
    )
    crossing = crossing._replace(swing_sample=swing_sample(crossing, front))
    row = row_filter(model.step_s)
    theta = inputs.priors.theta
    count = row_count(row, crossing.rows)
    noise = whitener(
        row,
        count,
        truck_of(theta, crossing.total_mass_kg, wheelbase, False),
        inputs.density_m_per_s2_per_rthz,
        linear_springs(),
    )
    shapes = shapes_of(*inputs.footprints)
    speed = float(np.ptp(front)) / ((n - 1) * model.step_s)
    problem = Problem(
        crossing,
        inputs.priors,
        row,
        noise,
        inputs.density_m_per_s2_per_rthz,
        linear_springs(),
        Mismatch(shapes, np.zeros(shapes.density.shape[0]), speed),
        position,
        speeding,
        rows,
        values,
        np.zeros(0),
        tuple(workspace(crossing, theta.size, row) for _ in range(inputs.threads)),
    )
    return problem, start(problem, best)


def swing_sample(crossing: Crossing, front: FloatArray) -> int:
    """The sample a little before the front axle, at front (n,), comes to the bridge."""
    begin, sign = (0.0, 1.0) if crossing.direction > 0 else (crossing.span_m, -1.0)
    entry = int(np.searchsorted(sign * front, sign * begin))
    return max(0, entry - round(_SWING_BEFORE_S / crossing.step_s))


def with_noise_at(
    problem: Problem,
    y: FloatArray,
    force: FloatArray | None = None,
    doubted: float = DOUBTED,
    mismatch: FloatArray | None = None,
) -> Problem:
    """The problem with the noise as it is for the truck at y, and coordinates for its bridge.

    The noise of springs and dampers is `force`, by default what the body equations leave at y if
    that is at least `doubted` (`force_noise`). Levels of the roads' mismatch are `mismatch`, by
    default what the rows off the bridge show at y if the problem has such levels already.
    """
    where = layout(problem)
    unknowns = where.gains.stop
    if force is None:
        body = filtered_rows(problem, y)[1:]
        force = force_noise(problem.rows, *truck_at(problem, y), body, doubted)
    if mismatch is None:
        mismatch = problem.mismatch.level_m3
        if mismatch.any():
            mismatch = levels_at(problem, y)
    road = problem.mismatch._replace(level_m3=mismatch)
    is_inertial = bool(force.any())
    at, trucks = _aside(problem, y, unknowns, is_inertial=is_inertial)
    density = problem.density * (1.0 + at.gain)
    count = row_count(problem.rows, problem.crossing.rows)
    silenced = _SILENCED * force
    differs = road if mismatch.any() else None
    noise = whitener(problem.rows, count, trucks[0], density[0], silenced, differs)
    truck = int(problem.priors.estimated[:FIRST_OF_BRIDGE].sum())
    changing = [*range(truck), *range(where.wheelbase, unknowns)]
    slope = np.zeros(unknowns)
    power = noise_power(problem.rows, trucks, density, silenced, changing, differs)
    slope[changing] = 0.5 * count * power / _SLOPE_STEP
    if differs is not None:
        slope = np.concatenate([slope, np.zeros(where.delays.stop - unknowns)])
        slope += slope_of_mismatch(problem._replace(force=force, mismatch=road), y)
    basis = rebased(problem.crossing.basis, at.theta[0])
    for work in problem.works:
        work.modes_of[:] = np.nan
    return problem._replace(
        noise=noise,
        force=force,
        mismatch=road,
        noise_slope=slope,
        crossing=problem.crossing._replace(basis=basis, is_inertial=is_inertial),
    )


def with_mismatch_alone(problem: Problem, y: FloatArray, mismatch: Mismatch) -> Problem:
    """The problem with another mismatch in its noise at y, all else as it is, the slope too."""
    truck, density = truck_at(problem, y)
    noise = whitener(
        problem.rows,
        row_count(problem.rows, problem.crossing.rows),
        truck,
        density,
        _SILENCED * problem.force,
        mismatch,
    )
    return problem._replace(noise=noise)


def _aside(
    problem: Problem, y: FloatArray, count: int, *, is_inertial: bool
) -> tuple[Points, list[Truck]]:
    """Points and trucks at y, and a step aside in each of the first `count` coordinates."""
    near = np.repeat(y[None, :], 1 + count, axis=0)
    near[np.arange(1, 1 + count), np.arange(count)] += _SLOPE_STEP
    at = points(problem, near)
    total = problem.crossing.total_mass_kg
    return at, [
        truck_of(theta, total, float(wheelbase), is_inertial)
        for theta, wheelbase in zip(at.theta, at.wheelbase_m, strict=True)
    ]


def slope_of_mismatch(problem: Problem, y: FloatArray) -> FloatArray:
    """What the roads' mismatch alone makes of the objective's slope at y: (first coordinates,)."""
    where = layout(problem)
    is_inertial = bool(problem.force.any())
    at, trucks = _aside(problem, y, where.delays.stop, is_inertial=is_inertial)
    changing = [
        *range(int(problem.priors.estimated[:FIRST_OF_BRIDGE].sum())),
        *range(where.wheelbase, where.gains.stop),
        *range(where.delays.start, where.delays.stop),
    ]
    power = mismatch_power(
        problem.rows,
        trucks,
        at.gain,
        at.delay_s,
        problem.density * (1.0 + at.gain[0]),
        _SILENCED * problem.force,
        problem.mismatch,
        float(at.wheelbase_m[0]),
        changing,
    )
    slope = np.zeros(where.delays.stop)
    slope[changing] = row_count(problem.rows, problem.crossing.rows) * power / _SLOPE_STEP
    return slope


def levels_at(problem: Problem, y: FloatArray) -> FloatArray:
    """Levels (s,) of the roads' mismatch that the rows off the bridge show at y.

    Nothing where these are too few, or explained as well without (`MISMATCHED`).
    """
    level, gain, _ = _levels_off_bridge(problem, y)
    return level if gain > MISMATCHED else np.zeros_like(level)


def mismatch_excess(problem: Problem, y: FloatArray) -> float:
    """Return the power of the mismatch off the bridge over what the declared axles would have.

    Of waves of ten metres, on a surface as rough as the road at y; 0 where nothing is told.
    """
    level, _, expected = _levels_off_bridge(problem, y)
    return float(level.sum() / expected.sum()) if expected.sum() > 0.0 else 0.0


def _levels_off_bridge(problem: Problem, y: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Return what `mismatch_levels` does, of the stretches before and behind the bridge."""
    some = [one for one in off_bridge(problem, y) if one.stop - one.start >= _FEWEST_ROWS]
    if not some:
        nothing = np.zeros_like(problem.mismatch.level_m3)
        return nothing, 0.0, nothing
    differ, felt = filtered_rows(problem, y)[0], filtered_rear_road(problem, y)
    return mismatch_levels(
        problem.rows,
        *truck_at(problem, y),
        problem.mismatch,
        [differ[one] for one in some],
        [felt[one] for one in some],
    )


def in_spreads(priors: Priors, theta: FloatArray) -> FloatArray:
    """The coordinates (t,) in y of values (p,) of truck and bridge that are estimated."""
    values = np.zeros(theta.size)
    logs = np.flatnonzero(priors.estimated & ~priors.half_normal)
    values[logs] = np.log(theta[logs] / priors.theta[logs]) / priors.spread[logs]
    zero = np.flatnonzero(priors.estimated & priors.half_normal)
    values[zero] = theta[zero] / priors.spread[zero]
    return values[priors.estimated]


def rear_at_rows_m(problem: Problem, y: FloatArray) -> FloatArray:
    """Where the rear axle is at the middle of each filtered row (m,), of one point y (size,)."""
    crossing, rows = problem.crossing, problem.rows
    at = points(problem, y[None, :])
    rear = rear_position_m(at.position_m[0], float(at.wheelbase_m[0]), crossing.direction)
    count = row_count(rows, crossing.rows)
    return rear[crossing.first_row + rows.taps.size // 2 + rows.every * np.arange(count)]


def off_bridge_m(problem: Problem, y: FloatArray) -> float:
    """How many metres of road the rows off the bridge compare, in stretches that tell something."""
    rows = [one.stop - one.start for one in off_bridge(problem, y)]
    apart_m = problem.rows.every * problem.rows.step_s * problem.mismatch.speed_m_per_s
    return apart_m * sum(one for one in rows if one >= _FEWEST_ROWS)


def off_bridge(problem: Problem, y: FloatArray) -> tuple[slice, slice]:
    """Filtered rows that compare the roads before and behind the bridge alone."""
    at = points(problem, y[None, :])
    crossing, rows = problem.crossing, problem.rows
    rear = rear_position_m(at.position_m[0], float(at.wheelbase_m[0]), crossing.direction)
    travel = (rear if crossing.direction > 0 else crossing.span_m - rear)[crossing.first_row :]
    on, left = np.searchsorted(travel, [0.0, crossing.span_m])
    count = row_count(rows, crossing.rows)
    # A bearing that gives is felt some samples before and behind the end.
    last = (int(on) - _STEP_SAMPLES - rows.taps.size) // rows.every + 1
    first = -((-int(left) - _STEP_SAMPLES) // rows.every)
    return slice(0, min(max(0, last), count)), slice(min(max(0, first), count), count)
