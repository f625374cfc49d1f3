"""Profile mismatch of a crossing for fusion: its long waves, and its values off the bridge.

Long waves are coefficients of cubic splines along the road; the mismatch off the bridge is given at
places that all crossings share.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.fit import Optimum
from pre_core.crossing.mismatch import (
    CORRELATION_LENGTH_M,
    Mismatch,
    has_alike_tyres,
    long_wave_power,
)
from pre_core.crossing.off_bridge import off_bridge_residuals, rear_axle_samples_m
from pre_core.crossing.residuals import evaluate
from pre_core.crossing.rows import RESIDUALS, filter_rows, row_count
from pre_core.crossing.splines import basis
from pre_core.crossing.whitening import project_out_noise, solve
from pre_core.fusion.short_waves import BESIDE_M

KNOT_M, ALIKE_KNOT_M = 1.25, 0.5
"""Spacing of the cubic splines' knots, for different and for equal footprints."""
_BOUNDARY_CYCLES_PER_KNOT = 0.25
"""Spatial frequency at the boundary of the long waves, in cycles per knot spacing. With different
tyres 80 to 97 % of the information about a bridge lies below half of this frequency. Equal tyres
that run on laterally shifted paths leave short waves as large as long ones, so that waves of two
metres are informative too."""
_LONG_SHARE = 0.97
"""Share of the power of the longest waves that is described by coefficients; the rest stays noise
of the crossing, because the covariance of the residuals must be positive definite."""
_CUBIC = 3
OFF_BRIDGE_STEP_M = 0.25
"""Spacing of the mismatch values off the bridge."""
_FARTHEST_OFF_M = 60.0
"""Greatest distance from the bridge of the mismatch values off the bridge."""


class OffBridgeMismatch(NamedTuple):
    """Mismatch in m at begin_m, begin_m + `OFF_BRIDGE_STEP_M`, …; NaN where it is unknown.

    It is scaled to the level on the bridge, where the pavement may differ.
    """

    begin_m: float
    value_m: FloatArray


def knot_spacing_m(mismatch: Mismatch) -> float:
    """Return the knot spacing for axles with these tyres, the same in all runs of a truck."""
    return ALIKE_KNOT_M if has_alike_tyres(mismatch) else KNOT_M


def long_share(cycles_per_m: FloatArray, knot_m: float) -> FloatArray:
    """Return the share (g,) of the mismatch's power at spatial frequencies (g,) in long waves."""
    return np.asarray(
        _LONG_SHARE * np.exp(-((cycles_per_m * knot_m / _BOUNDARY_CYCLES_PER_KNOT) ** 2))
    )


def covariance_of_coefficients(
    knots_m: FloatArray, cycles_per_m: FloatArray, density: FloatArray
) -> FloatArray:
    """Return the covariance (q, q) in mm² of the spline coefficients for a density (g,) in m³."""
    knot_m = float(knots_m[1] - knots_m[0])
    seen = np.sinc(cycles_per_m * knot_m) ** (2 * (_CUBIC + 1))
    within = cycles_per_m < 0.5 / knot_m
    long_density = long_share(cycles_per_m, knot_m) * density
    of = np.where(within, long_density, 0.0) / np.where(within, seen, 1.0)
    step = cycles_per_m[1] - cycles_per_m[0]
    weight = np.full(cycles_per_m.size, step)
    weight[0] *= 0.5
    lags = np.arange(knots_m.size) * knot_m
    row = 1e6 * np.cos(2.0 * np.pi * np.outer(lags, cycles_per_m)) @ (weight * of)
    row[lags > CORRELATION_LENGTH_M + 3.0 * knot_m / _BOUNDARY_CYCLES_PER_KNOT] = 0.0
    row[0] *= 1.0 + 1e-6
    places = np.arange(knots_m.size)
    return np.asarray(row[np.abs(places[:, None] - places[None, :])])


def short_wave_part(mismatch: Mismatch) -> Mismatch:
    """Return the mismatch without the power of its long waves."""
    shapes = mismatch.shapes
    share = long_share(shapes.cycles_per_m, knot_spacing_m(mismatch))
    density = shapes.density * (1.0 - share)
    return mismatch._replace(shapes=shapes._replace(density=density))


def knots_of(
    problem: posterior.PosteriorProblem, y: FloatArray
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the knots (q,) on the whole driven road, and which of them are on or near the bridge.

    The truck is at y (f,).
    """
    rear = rear_axle_samples_m(problem, y)
    # Counted from the bridge's start, so that all crossings have the same places.
    knot_m = knot_spacing_m(problem.mismatch)
    first = int(np.floor(rear.min() / knot_m)) - 2
    last = int(np.ceil(rear.max() / knot_m)) + 2
    grid = knot_m * np.arange(first, last + 1)
    near = (grid > -BESIDE_M) & (grid < problem.crossing.span_m + BESIDE_M)
    return np.asarray(grid), np.asarray(np.flatnonzero(near), dtype=np.int64)


def covariance_of_all(mismatch: Mismatch, grid: FloatArray) -> FloatArray:
    """Return the covariance (q, q) in mm² of the coefficients at all knots."""
    shapes = mismatch.shapes
    return covariance_of_coefficients(grid, shapes.cycles_per_m, mismatch.level_m3 @ shapes.density)


def add_adjacent_prior(
    precision: FloatArray,
    mismatch: Mismatch,
    grid: FloatArray,
    inner: NDArray[np.int64],
    first: int,
) -> None:
    """Add to a precision (n, n) the prior of coefficients next to the bridge given those on it.

    The precision is modified in place; its coefficients at all knots `grid` (q,) begin at `first`.
    The prior of those on the bridge, `inner` (k,), is added in fusion.
    """
    of_all = covariance_of_all(mismatch, grid)
    places = first + np.arange(grid.size)
    precision[np.ix_(places, places)] += np.linalg.inv(of_all)
    precision[np.ix_(first + inner, first + inner)] -= np.linalg.inv(of_all[np.ix_(inner, inner)])


def white_knots(problem: posterior.PosteriorProblem, y: FloatArray, grid: FloatArray) -> FloatArray:
    """Return the effect of 1 mm of each coefficient on the whitened residuals (3 m, q).

    The truck is at y (f,); `grid` (q,) are the knots.
    """
    rows, rear = problem.rows, rear_axle_samples_m(problem, y)
    aside = float(grid[1] - grid[0]) * np.arange(1, _CUBIC)
    padded = np.concatenate([grid[0] - aside[::-1], grid, grid[-1] + aside])
    shape = 1e-3 * basis(padded, _CUBIC, rear)
    shape[(rear < padded[_CUBIC]) | (rear > padded[-_CUBIC - 1])] = 0.0
    out = np.zeros((problem.noise.reciprocal.size, grid.size))
    filtered = np.empty(row_count(rows, rear.size))
    for k in range(grid.size):
        filter_rows(rows.taps, rows.every, np.ascontiguousarray(shape[:, k]), filtered)
        column = np.zeros(out.shape[0])
        column[::RESIDUALS] = filtered
        solve(problem.noise.factor, problem.noise.reciprocal, column)
        out[:, k] = column
    return project_out_noise(problem.noise, out.T).T


def off_bridge_mismatch(found: Optimum) -> OffBridgeMismatch:
    """Return the mismatch off the bridge, at places that all crossings share."""
    problem, y = found.problem, found.state.y
    crossing, rows = problem.crossing, problem.rows
    rear = rear_axle_samples_m(problem, y)
    (residual,) = evaluate(crossing, problem.works, posterior.points(problem, y[None, :]))
    step = OFF_BRIDGE_STEP_M
    first = int(np.ceil(max(rear.min(), -_FARTHEST_OFF_M) / step))
    last = int(np.floor(min(rear.max(), crossing.span_m + _FARTHEST_OFF_M) / step))
    x = step * np.arange(first, last + 1)
    out = np.full(x.size, np.nan)
    for one in off_bridge_residuals(problem, y):
        samples = slice(one.start * rows.every, one.stop * rows.every)
        place, value = rear[samples], residual[0][samples]
        if place.size < 2:
            continue
        order = np.argsort(place)
        inside = (x > place.min()) & (x < place.max())
        out[inside] = np.interp(x[inside], place[order], value[order])
    return OffBridgeMismatch(float(x[0]), out * np.sqrt(long_wave_power(problem.mismatch)))
