"""Likelihood of one crossing for bridge, truck and the long waves of its profile mismatch.

It contains no prior, so that each prior counts once in a fusion. It is normal in

- the bridge's parameters, with c = EI_nominal/EI in place of ln EI (`crossing.compliances`),
- the truck's, its wheelbase and the common sensor gain, which are the same in all its runs,
- the waves of the mismatch d that are long enough to resemble a deflection, as coefficients of
  cubic splines along the road. Part of them is the same in all runs of a wheel-path group, which
  a single crossing cannot separate.

With different profiles it includes the longitudinal offset and its curvature terms with the bridge
(`fusion.curvature`).

Everything else of this crossing - trajectory, delays, gains, initial vibration, short waves of the
mismatch - is integrated out. The remainder is small and is stored with the crossing's result.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, qr

from pre_core import parameters
from pre_core.arrays import FloatArray
from pre_core.crossing import front_axle, posterior
from pre_core.crossing.arguments import EvaluationPoints, GriddedCrossing
from pre_core.crossing.compliances import (
    MISMATCH_BIAS_SPREAD,
    marginal,
    mismatch_bias,
    to_compliance_coordinates,
    without_priors,
)
from pre_core.crossing.fit import Optimum
from pre_core.crossing.mismatch import CORRELATION_LENGTH_M, Mismatch, long_wave_power
from pre_core.crossing.off_bridge import off_bridge_residuals
from pre_core.crossing.preparation import replace_mismatch
from pre_core.crossing.residuals import evaluate
from pre_core.crossing.rows import RESIDUALS, filter_rows, row_count
from pre_core.crossing.splines import basis
from pre_core.crossing.whitening import project_out_noise, solve
from pre_core.fusion.curvature import CurvatureTerms, curvature_terms
from pre_core.fusion.curvature import linearise_with_curvature as straightened_about
from pre_core.fusion.short_waves import BESIDE_M, ShortWaveResponse, short_wave_response
from pre_core.physics.simulate import rear_position_m
from pre_core.search import levenberg_marquardt

KNOT_M, ALIKE_KNOT_M = 1.25, 0.5
"""Knot spacing of the long mismatch waves, cubic between; for different and for equal footprints.
"""
_LONG_OF_KNOT = 0.25
"""Boundary of the long waves: about four knots. With different tyres 80 to 97 % of the information
about a bridge lies below half of these frequencies. Equal tyres that run on laterally shifted
paths leave short waves as large as long ones, so that waves of two metres are informative too."""
_LONG_SHARE = 0.97
"""Share of the power of the longest waves; the rest stays noise of the crossing, because the
covariance of the residuals must be positive definite."""
_CUBIC = 3
_ROUNDED = 1e-12
OFF_BRIDGE_STEP_M = 0.25
"""Spacing of the mismatch values off the bridge."""
_FARTHEST_OFF_M = 60.0


class Coordinates(NamedTuple):
    """Meaning of the first entries of x: (k,) each. EI: c = location/EI; else see `is_log`."""

    names: tuple[str, ...]
    location: FloatArray
    """Nominal values."""
    scale: FloatArray
    is_log: NDArray[np.bool_]
    """Whether x = ln(value/location)/scale; otherwise value/scale."""


class OffBridgeMismatch(NamedTuple):
    """Mismatch in m at begin_m, begin_m + `OFF_BRIDGE_STEP_M`, …; NaN where it is unknown.

    It is scaled to the level on the bridge, where the pavement may differ.
    """

    begin_m: float
    value_m: FloatArray


class CrossingLikelihood(NamedTuple):
    """The log-likelihood -|root x - target|²/2 of x = (bridge, truck, coefficients of d in mm)."""

    root: FloatArray  # (m, m) upper triangular
    target: FloatArray  # (m,)
    bridge: Coordinates
    truck: Coordinates
    knots_m: FloatArray
    """Knots (q,) of the long waves of d; empty where both axles follow one profile."""
    level_m3: FloatArray  # (s,) levels of the mismatch on the bridge as the crossing estimates them
    off_bridge: OffBridgeMismatch | None
    bends: CurvatureTerms | None = None
    """Curvature terms; with them x continues with the longitudinal offset in m and the terms."""
    short_waves: ShortWaveResponse | None = None


def knot_spacing_m(mismatch: Mismatch) -> float:
    """Return the knot spacing for axles with their tyres, the same in all runs of a truck."""
    front, rear = mismatch.shapes.footprints
    is_alike = (front.twin_distance_m > 0.0) == (rear.twin_distance_m > 0.0)
    return ALIKE_KNOT_M if is_alike else KNOT_M


def long_share(cycles_per_m: FloatArray, knot_m: float) -> FloatArray:
    """Return the share (g,) of the mismatch's power at spatial frequencies (g,) in long waves."""
    return np.asarray(_LONG_SHARE * np.exp(-((cycles_per_m * knot_m / _LONG_OF_KNOT) ** 2)))


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
    row[lags > CORRELATION_LENGTH_M + 3.0 * knot_m / _LONG_OF_KNOT] = 0.0
    row[0] *= 1.0 + 1e-6
    places = np.arange(knots_m.size)
    return np.asarray(row[np.abs(places[:, None] - places[None, :])])


def likelihood(found: Optimum, *, with_bends: bool = True) -> CrossingLikelihood:
    """Return the likelihood at an optimum.

    Without `with_bends` it has no curvature terms, offset and response to short waves.
    """
    problem, state = _in_fusion(found)
    y, where = state.y, posterior.layout(problem)
    grid, inner = np.zeros(0), np.zeros(0, dtype=np.int64)
    differs = bool(problem.mismatch.level_m3.any())
    if differs:
        grid, inner = _knots(problem, y)
    bridge = where.bridge
    truck = np.concatenate(
        [np.setdiff1d(np.arange(where.theta.stop), bridge), [where.wheelbase, where.common_gain]]
    )
    kept = np.concatenate([bridge, truck])
    rows = without_priors(problem, state.residual.size, kept)
    centre, jacobian = to_compliance_coordinates(problem, y, state.jacobian[rows])
    # The correction of the gradient is in the rows of the priors, which are excluded.
    slope = np.zeros(centre.size + grid.size)
    slope[: problem.noise_slope.size] = problem.noise_slope
    slope[np.setdiff1d(np.arange(slope.size), kept)] = 0.0
    bends = None
    if differs:
        splines = np.zeros((rows.size, grid.size))
        white = _white_knots(problem, y, grid)
        splines[: white.shape[0]] = white
        jacobian = np.hstack([jacobian, splines])
        kept = np.concatenate([kept, centre.size + inner])
        centre = np.concatenate([centre, np.zeros(grid.size)])
    if differs and with_bends:
        # The whole trajectory relative to the optimum, and its other coordinates relative to that.
        place = (where.trajectory.start + where.trajectory.stop) // 2
        bends, bent = curvature_terms(found, problem, rows, place)
        jacobian[:, place] = jacobian[:, where.trajectory].sum(axis=1)
        centre[where.trajectory] = 0.0
        jacobian = np.hstack([jacobian, bent])
        kept = np.concatenate([kept, [place], centre.size + np.arange(bent.shape[1])])
        slope = np.concatenate([slope, np.zeros(bent.shape[1])])
        centre = np.concatenate([centre, np.zeros(bent.shape[1])])
    precision = jacobian.T @ jacobian
    linear = precision @ centre - jacobian.T @ state.residual[rows] + slope
    if differs:
        _add_adjacent_prior(precision, found.problem.mismatch, grid, inner, y.size)
    precision, linear = marginal(precision, linear, kept)
    if differs:
        precision, linear = _with_mismatch_bias(found, precision, linear, truck)
    return CrossingLikelihood(
        *_as_root(precision, linear),
        _coordinates(problem, bridge),
        _coordinates(problem, truck),
        grid[inner],
        found.problem.mismatch.level_m3 * long_wave_power(found.problem.mismatch),
        _off_bridge(found) if differs else None,
        bends,
        _response_to_short_waves(found) if differs and with_bends else None,
    )


def _in_fusion(
    found: Optimum,
) -> tuple[posterior.PosteriorProblem, levenberg_marquardt.LMState]:
    """Return problem and state at an optimum with the noise of a run among others.

    Long waves of the mismatch are parameters, and the noise by a tandem's front axle is shared.
    """
    problem, y = found.problem, found.state.y
    differs = bool(problem.mismatch.level_m3.any())
    if not (differs or posterior.has_tandem(problem)):
        return problem, found.state
    short = _short_waves(problem.mismatch) if differs else None
    problem = replace_mismatch(problem, y, short, front_axle.RUNS)
    state = levenberg_marquardt.initial_state(lambda at: posterior.all_rows(problem, at), y)
    return problem, state


def _with_mismatch_bias(
    found: Optimum, precision: FloatArray, linear: FloatArray, truck: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return precision (n, n) and linear part (n,) with the bias's error of the `truck` (t,)."""
    b = posterior.layout(found.problem).bridge.size
    led = np.zeros(linear.size)
    led[b : b + truck.size] = mismatch_bias(found)[truck]
    return add_covariance(precision, linear, led[:, None], np.array([[MISMATCH_BIAS_SPREAD]]))


def linearised_likelihood(
    crossing: CrossingLikelihood, at: FloatArray, mismatch: FloatArray
) -> CrossingLikelihood:
    """Return the normal about a bridge `at` (b,) in its coordinates, without offset and terms.

    `mismatch` is the precision (q, q) of the coefficients of d, on which the offset depends.
    """
    if crossing.bends is None:
        return crossing
    truck = len(crossing.truck.names)
    q = crossing.knots_m.size
    priors = np.zeros((truck + q, truck + q))
    priors[:truck, :truck] = np.eye(truck)
    priors[truck:, truck:] = mismatch
    root, target = straightened_about(crossing.root, crossing.target, crossing.bends, at, priors)
    return crossing._replace(root=root, target=target, bends=None)


def in_coordinates(
    crossing: CrossingLikelihood, coordinates: Coordinates, elements: int
) -> CrossingLikelihood:
    """Return the likelihood for other nominal values and spreads of the bridge's parameters.

    These are the same parameters in the same order, `elements` of them last.
    """
    mine = crossing.bridge
    b = len(mine.names)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = coordinates.location / mine.location
        aside = np.where(mine.is_log, np.log(ratio) / mine.scale, 0.0)
    factor = coordinates.scale / mine.scale
    # EI is location/x, so x scales with the location.
    factor[b - elements :] = 1.0 / ratio[b - elements :]
    aside[b - elements :] = 0.0
    root = crossing.root.copy()
    root[:, :b] *= factor
    target = crossing.target - crossing.root[:, :b] @ aside
    bends = crossing.bends
    if bends is not None:
        bends = bends._replace(
            about=(bends.about - aside) / factor,
            directions=bends.directions / np.append(factor, 1.0)[:, None],
        )
    short = crossing.short_waves
    if short is not None:
        by = 1.0 / factor[:, None]
        short = short._replace(cosine=by * short.cosine, sine=by * short.sine)
    return crossing._replace(
        root=root, target=target, bridge=coordinates, bends=bends, short_waves=short
    )


def add_covariance(
    precision: FloatArray, linear: FloatArray, along: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return precision (n, n) and linear part (n,) of a normal with more covariance along columns.

    The columns `along` (n, r) add A S A' to the covariance; `root` (r, r) is a root of S, S = root
    root'. The precision may be singular.
    """
    moved = along @ root
    across = precision @ moved
    inner = np.eye(root.shape[1]) + moved.T @ across
    factor = cho_factor(inner, lower=True)
    return (
        precision - across @ cho_solve(factor, across.T),
        linear - across @ cho_solve(factor, moved.T @ linear),
    )


def _response_to_short_waves(found: Optimum) -> ShortWaveResponse:
    at = posterior.points(found.problem, found.state.y[None, :])
    return short_wave_response(found, _rear_m(found.problem.crossing, at))


def _short_waves(mismatch: Mismatch) -> Mismatch:
    shapes = mismatch.shapes
    share = long_share(shapes.cycles_per_m, knot_spacing_m(mismatch))
    density = shapes.density * (1.0 - share)
    return mismatch._replace(shapes=shapes._replace(density=density))


def _knots(
    problem: posterior.PosteriorProblem, y: FloatArray
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the knots on the whole driven road, and which of them are on or near the bridge."""
    at = posterior.points(problem, y[None, :])
    rear = _rear_m(problem.crossing, at)
    # Counted from the bridge's start, so that all crossings have the same places.
    knot_m = knot_spacing_m(problem.mismatch)
    first = int(np.floor(rear.min() / knot_m)) - 2
    last = int(np.ceil(rear.max() / knot_m)) + 2
    grid = knot_m * np.arange(first, last + 1)
    near = (grid > -BESIDE_M) & (grid < problem.crossing.span_m + BESIDE_M)
    return np.asarray(grid), np.asarray(np.flatnonzero(near), dtype=np.int64)


def _add_adjacent_prior(
    precision: FloatArray,
    mismatch: Mismatch,
    grid: FloatArray,
    inner: NDArray[np.int64],
    first: int,
) -> None:
    """Add the prior of the coefficients next to the bridge given those on it; in place.

    They begin at `first`. The prior of those on the bridge is added in fusion.
    """
    shapes = mismatch.shapes
    of_all = covariance_of_coefficients(
        grid, shapes.cycles_per_m, mismatch.level_m3 @ shapes.density
    )
    places = first + np.arange(grid.size)
    precision[np.ix_(places, places)] += np.linalg.inv(of_all)
    precision[np.ix_(first + inner, first + inner)] -= np.linalg.inv(of_all[np.ix_(inner, inner)])


def _as_root(precision: FloatArray, linear: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return upper triangular R and z with R'R the precision and R'z the linear part."""
    values, vectors = np.linalg.eigh(0.5 * (precision + precision.T))
    kept = values > _ROUNDED * values[-1]
    size = np.sqrt(np.where(kept, values, 1.0))
    rows = np.where(kept, size, 0.0)[:, None] * vectors.T
    target = np.where(kept, vectors.T @ linear, 0.0) / size
    (both,) = qr(np.column_stack([rows, target]), mode="r")
    m = linear.size
    return np.asarray(both[:m, :m]), np.asarray(both[:m, m])


def _coordinates(problem: posterior.PosteriorProblem, places: NDArray[np.int64]) -> Coordinates:
    """Return the coordinates at indices of y; wheelbase and common gain come last."""
    priors, where = problem.priors, posterior.layout(problem)
    first_axle = 2 if posterior.has_tandem(problem) else 1
    table = parameters.table(parameters.element_count(priors.theta), first_axle)
    kept = np.flatnonzero(priors.estimated)
    of_truck = {
        where.wheelbase: ("wheelbase", priors.wheelbase_m, priors.wheelbase_spread),
        where.common_gain: ("common_gain", 1.0, posterior.common_gain_spread(priors)),
    }
    rows = [
        of_truck.get(int(place))
        or (table[kept[place]].name, priors.theta[kept[place]], priors.spread[kept[place]])
        for place in places
    ]
    names, location, scale = zip(*rows, strict=True)
    zero = np.isin(places, where.half_normal)
    return Coordinates(names, np.array(location, float), np.array(scale, float), ~zero)


def _rear_m(crossing: GriddedCrossing, at: EvaluationPoints) -> FloatArray:
    """Return the chainage of the rear axle at every residual's sample: (rows,)."""
    rear = rear_position_m(at.position_m[0], float(at.wheelbase_m[0]), crossing.direction)
    return rear[crossing.first_row :]


def _white_knots(
    problem: posterior.PosteriorProblem, y: FloatArray, grid: FloatArray
) -> FloatArray:
    """Return the effect of 1 mm of each coefficient on the whitened residuals: (3 m, q)."""
    crossing, rows = problem.crossing, problem.rows
    at = posterior.points(problem, y[None, :])
    rear = _rear_m(crossing, at)
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


def _off_bridge(found: Optimum) -> OffBridgeMismatch:
    """Return the mismatch off the bridge, at places that all crossings share."""
    problem, y = found.problem, found.state.y
    crossing, rows = problem.crossing, problem.rows
    at = posterior.points(problem, y[None, :])
    rear = _rear_m(crossing, at)
    (residual,) = evaluate(crossing, problem.works, at)
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
