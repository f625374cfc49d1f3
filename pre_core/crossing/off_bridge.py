"""Residuals off the bridge: their location, and the profile mismatch estimated from them."""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.mismatch import TRACK_SHAPES, has_equal_tyres
from pre_core.crossing.noise import mismatch_levels
from pre_core.crossing.posterior import (
    PosteriorProblem,
    filtered_rear_road,
    filtered_rows,
    has_tandem,
    noise_path_at,
    points,
)
from pre_core.crossing.rows import row_count
from pre_core.physics.simulate import rear_position_m

FEWEST_ROWS = 24
"""Fewest residuals in one segment that determine the mismatch."""
_STEP_SAMPLES = 9
"""Samples before and after an end of the bridge that a compliant bearing affects."""
MIN_MISMATCH_STATISTIC = 30.0
"""Smallest likelihood-ratio statistic (`whittle`) of the residuals off the bridge."""


def levels_at(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return the mismatch levels (s,) of the residuals off the bridge at y (f,).

    They are zero where too few residuals exist, or where a mismatch explains them no better
    (`MIN_MISMATCH_STATISTIC`).
    """
    level, statistic, _ = _levels_off_bridge(problem, y)
    return level if statistic > MIN_MISMATCH_STATISTIC else np.zeros_like(level)


def mismatch_excess(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the ratio of the mismatch's power off the bridge to that of declared axles, y (f,).

    The ratio refers to waves of ten metres on a surface as rough as the road at y; it is 0 without
    an estimate.
    """
    level, _, expected = _levels_off_bridge(problem, y)
    return float(level[:TRACK_SHAPES].sum() / expected.sum()) if expected.sum() > 0.0 else 0.0


def surface_level_at(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return Phi k^3 in m² of the surface off the bridge at y (f,), 0 without an estimate."""
    _, _, expected = _levels_off_bridge(problem, y)
    return float(expected[1] / problem.mismatch.shapes.expected_m[1])


def _levels_off_bridge(
    problem: PosteriorProblem, y: FloatArray
) -> tuple[FloatArray, float, FloatArray]:
    """Return the results of `mismatch_levels` for the segments before and after the bridge.

    The axles of a tandem with equal tyres differ by an offset only. Wear has a similar spectrum in
    the short waves that a run resolves and half its power in long ones: most likely levels of both
    had a sixth to a half of the true power at 0.05 cycles/m in three of six crossings.
    """
    some = [one for one in off_bridge_residuals(problem, y) if one.stop - one.start >= FEWEST_ROWS]
    if not some:
        nothing = np.zeros_like(problem.mismatch.level_m3)
        return nothing, 0.0, nothing
    differ, rear_profile = filtered_rows(problem, y)[0], filtered_rear_road(problem, y)
    return mismatch_levels(
        problem.rows,
        *noise_path_at(problem, y),
        problem.mismatch,
        [differ[one] for one in some],
        [rear_profile[one] for one in some],
        has_only_offset=has_tandem(problem)
        and has_equal_tyres(*problem.mismatch.shapes.footprints),
    )


def rear_axle_samples_m(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return the rear axle's chainage at each sample (n,) of the residuals at y (f,)."""
    crossing = problem.crossing
    at = points(problem, y[None, :])
    rear = rear_position_m(at.position_m[0], float(at.wheelbase_m[0]), crossing.direction)
    return rear[crossing.first_row : crossing.first_row + crossing.rows]


def rear_axle_chainage_m(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return the rear axle's chainage at the middle of each filtered residual (m,) at y (f,)."""
    rows = problem.rows
    middles = rows.taps.size // 2 + rows.every * np.arange(row_count(rows, problem.crossing.rows))
    return rear_axle_samples_m(problem, y)[middles]


def compared_length_m(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the length of road compared by usable residuals off the bridge, at y (f,)."""
    rows = [one.stop - one.start for one in off_bridge_residuals(problem, y)]
    apart_m = problem.rows.every * problem.rows.step_s * problem.mismatch.speed_m_per_s
    return apart_m * sum(one for one in rows if one >= FEWEST_ROWS)


def off_bridge_residuals(problem: PosteriorProblem, y: FloatArray) -> tuple[slice, slice]:
    """Return the slices of filtered residuals before and after the bridge, at y (f,)."""
    crossing, rows = problem.crossing, problem.rows
    rear = rear_axle_samples_m(problem, y)
    travel = rear if crossing.direction > 0 else crossing.span_m - rear
    on, left = np.searchsorted(travel, [0.0, crossing.span_m])
    count = row_count(rows, crossing.rows)
    # A compliant bearing affects some samples before and after the end.
    last = (int(on) - _STEP_SAMPLES - rows.taps.size) // rows.every + 1
    first = -((-int(left) - _STEP_SAMPLES) // rows.every)
    return slice(0, min(max(0, last), count)), slice(min(max(0, first), count), count)
