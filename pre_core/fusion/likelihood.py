"""What one crossing says of bridge, truck and the long waves of its road's mismatch.

The likelihood alone, so that each prior counts once however many crossings are fused: normal in

- the bridge's unknowns, with c = EI_nominal/EI in place of ln EI (`crossing.compliances`),
- the truck's, its wheelbase and the gain common to its sensors, which are the same in all its runs,
- the waves of the mismatch d that are long enough to look like a deflection, as coefficients of
  cubic splines along the road. Part of them is the same in all runs of a truck in one track, which
  no crossing can tell by itself.

Where the roads differ also in its place along the road, and in the bends that it and the bridge
make together (`fusion.bends`).

Everything else of this crossing - trajectory, delays, gains, how the bridge swung, the mismatch's
short waves - is integrated out. What is left is small and is stored with the crossing's result.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, qr

from pre_core import unknowns
from pre_core.crossing import posterior
from pre_core.crossing.compliances import (
    LEANING_SPREAD,
    in_compliances,
    led_by_mismatch,
    marginal,
    without_priors,
)
from pre_core.crossing.mismatch import MEMORY_M, Mismatch
from pre_core.crossing.optimum import Optimum
from pre_core.crossing.preparation import off_bridge, with_mismatch_alone
from pre_core.crossing.residuals import Crossing, Points, evaluate
from pre_core.crossing.splines import basis
from pre_core.crossing.whitening import RESIDUALS, filter_rows, row_count, solve
from pre_core.fusion.bends import Bends, bends_of
from pre_core.fusion.bends import straightened as straightened_about
from pre_core.physics.simulate import rear_position_m
from pre_core.search import levenberg_marquardt

FloatArray = NDArray[np.float64]

KNOT_M, ALIKE_KNOT_M = 1.25, 0.5
"""Between knots of the mismatch's long waves, cubic between."""
_LONG_OF_KNOT = 0.25
"""Waves longer than four knots in round numbers are told apart. Where tyres differ 80 to 97 % of
what is told of a bridge lies below half of these. Tyres that are alike and run aside of each other
leave short waves as large as long ones, so that much is told by waves of two metres too."""
_LONG_SHARE = 0.97
"""Of the power of the longest waves; the rest stays noise of the crossing's own, for the rows'
covariance must be positive."""
_BESIDE_M = 7.5
"""Before and behind the bridge as far as the mismatch there is related to that on it."""
_CUBIC = 3
_ROUNDED = 1e-12
OFF_BRIDGE_STEP_M = 0.25
"""Between the places at which the mismatch off the bridge is told."""
_FARTHEST_OFF_M = 60.0


class Coordinates(NamedTuple):
    """What the first places of x mean: (k,) each. EI: c = location/EI; else see `is_log`."""

    names: tuple[str, ...]
    location: FloatArray
    """Nominal values."""
    scale: FloatArray
    is_log: NDArray[np.bool_]
    """x = ln(value/location)/scale; elsewhere value/scale."""


class OffBridge(NamedTuple):
    """The mismatch in m at begin_m, begin_m + `OFF_BRIDGE_STEP_M`, …; NaN where it is not told."""

    begin_m: float
    value_m: FloatArray


class Likelihood(NamedTuple):
    """-|root x - target|²/2 up to a constant, of x = (bridge, truck, coefficients of d in mm)."""

    root: FloatArray  # (m, m) upper triangular
    target: FloatArray  # (m,)
    bridge: Coordinates
    truck: Coordinates
    knots_m: FloatArray
    """(q,) knots of the long waves of d; none where both axles feel one road."""
    level_m3: FloatArray  # (s,) levels of the mismatch that the crossing told
    off_bridge: OffBridge | None
    bends: Bends | None = None
    """If there are, x goes on with the place along the road in m, and with them."""


def knot_spacing_m(mismatch: Mismatch) -> float:
    """How far apart the knots are by which waves of a mismatch with levels are told."""
    return KNOT_M if mismatch.level_m3[0] > 0.0 else ALIKE_KNOT_M


def long_share(cycles_per_m: FloatArray, knot_m: float) -> FloatArray:
    """Which share of the mismatch's power counts as long waves: (g,)."""
    return np.asarray(_LONG_SHARE * np.exp(-((cycles_per_m * knot_m / _LONG_OF_KNOT) ** 2)))


def covariance_of_coefficients(
    knots_m: FloatArray, cycles_per_m: FloatArray, density: FloatArray
) -> FloatArray:
    """Covariance (q, q) in mm² of the splines' coefficients, for long waves of a density in m³."""
    knot_m = float(knots_m[1] - knots_m[0])
    seen = np.sinc(cycles_per_m * knot_m) ** (2 * (_CUBIC + 1))
    within = cycles_per_m < 0.5 / knot_m
    told = long_share(cycles_per_m, knot_m) * density
    of = np.where(within, told, 0.0) / np.where(within, seen, 1.0)
    step = cycles_per_m[1] - cycles_per_m[0]
    weight = np.full(cycles_per_m.size, step)
    weight[0] *= 0.5
    lags = np.arange(knots_m.size) * knot_m
    row = 1e6 * np.cos(2.0 * np.pi * np.outer(lags, cycles_per_m)) @ (weight * of)
    row[lags > MEMORY_M + 3.0 * knot_m / _LONG_OF_KNOT] = 0.0
    row[0] *= 1.0 + 1e-6
    places = np.arange(knots_m.size)
    return np.asarray(row[np.abs(places[:, None] - places[None, :])])


def likelihood(found: Optimum, *, with_bends: bool = True) -> Likelihood:
    """Of a crossing at its optimum; without bends and place where that is the truth."""
    problem, y = found.problem, found.state.y
    where = posterior.layout(problem)
    state = found.state
    grid, inner = np.zeros(0), np.zeros(0, dtype=np.int64)
    differs = bool(problem.mismatch.level_m3.any())
    if differs:
        problem = with_mismatch_alone(problem, y, _short_waves(problem.mismatch))
        state = levenberg_marquardt.begin(lambda at: posterior.all_rows(problem, at), y)
        grid, inner = _knots(problem, y)
    bridge = where.bridge
    truck = np.concatenate(
        [np.setdiff1d(np.arange(where.theta.stop), bridge), [where.wheelbase, where.common_gain]]
    )
    told = np.concatenate([bridge, truck])
    rows = without_priors(problem, state.residual.size, told)
    centre, jacobian = in_compliances(problem, y, state.jacobian[rows])
    # What is taken off the slope stands in the rows of the priors, which are left out.
    slope = np.zeros(centre.size + grid.size)
    slope[: problem.noise_slope.size] = problem.noise_slope
    slope[np.setdiff1d(np.arange(slope.size), truck)] = 0.0
    bends = None
    if differs:
        splines = np.zeros((rows.size, grid.size))
        white = _white_knots(problem, y, grid)
        splines[: white.shape[0]] = white
        jacobian = np.hstack([jacobian, splines])
        told = np.concatenate([told, centre.size + inner])
        centre = np.concatenate([centre, np.zeros(grid.size)])
    if differs and with_bends:
        bends, bent = bends_of(found, problem, rows)
        # The trajectory as a whole, from the optimum on, and the rest of it beside the whole.
        place = where.trajectory.start
        jacobian[:, place] = jacobian[:, where.trajectory].sum(axis=1)
        centre[where.trajectory] = 0.0
        jacobian = np.hstack([jacobian, bent])
        told = np.concatenate([told, [place], centre.size + np.arange(bent.shape[1])])
        slope = np.concatenate([slope, np.zeros(bent.shape[1])])
        centre = np.concatenate([centre, np.zeros(bent.shape[1])])
    precision = jacobian.T @ jacobian
    linear = precision @ centre - jacobian.T @ state.residual[rows] + slope
    if differs:
        _beside(precision, found.problem.mismatch, grid, inner, y.size)
    precision, linear = marginal(precision, linear, told)
    if differs:
        led = np.zeros(linear.size)
        led[bridge.size : bridge.size + truck.size] = led_by_mismatch(found)[truck]
        precision, linear = loosened(precision, linear, led[:, None], np.array([[LEANING_SPREAD]]))
    return Likelihood(
        *_as_root(precision, linear),
        _coordinates(problem, bridge),
        _coordinates(problem, truck),
        grid[inner],
        found.problem.mismatch.level_m3,
        _off_bridge(found) if differs else None,
        bends,
    )


def straightened(of: Likelihood, at: FloatArray, mismatch: FloatArray) -> Likelihood:
    """The normal about a bridge `at` (b,) in its coordinates, without place and bends.

    `mismatch` is the precision (q, q) of the coefficients of d, of which the place depends.
    """
    if of.bends is None:
        return of
    truck = len(of.truck.names)
    q = of.knots_m.size
    priors = np.zeros((truck + q, truck + q))
    priors[:truck, :truck] = np.eye(truck)
    priors[truck:, truck:] = mismatch
    root, target = straightened_about(of.root, of.target, of.bends, at, priors)
    return of._replace(root=root, target=target, bends=None)


def in_coordinates(of: Likelihood, coordinates: Coordinates, elements: int) -> Likelihood:
    """The same with other nominal values and spreads of the bridge's unknowns.

    Of the same unknowns in the same order, `elements` of them last.
    """
    mine = of.bridge
    b = len(mine.names)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = coordinates.location / mine.location
        aside = np.where(mine.is_log, np.log(ratio) / mine.scale, 0.0)
    factor = coordinates.scale / mine.scale
    # EI is location/x: with another location, x is another by their ratio.
    factor[b - elements :] = 1.0 / ratio[b - elements :]
    aside[b - elements :] = 0.0
    root = of.root.copy()
    root[:, :b] *= factor
    target = of.target - of.root[:, :b] @ aside
    bends = of.bends
    if bends is not None:
        bends = bends._replace(
            about=(bends.about - aside) / factor, size=bends.size / np.append(factor, 1.0)
        )
    return of._replace(root=root, target=target, bridge=coordinates, bends=bends)


def loosened(
    precision: FloatArray, linear: FloatArray, along: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A normal of which the coordinates move along columns (m, r) by what is unknown: r normals.

    `root` (r, r) is a root of their covariance, root root'. The precision may be singular.
    """
    moved = along @ root
    across = precision @ moved
    inner = np.eye(root.shape[1]) + moved.T @ across
    factor = cho_factor(inner, lower=True)
    return (
        precision - across @ cho_solve(factor, across.T),
        linear - across @ cho_solve(factor, moved.T @ linear),
    )


def _short_waves(mismatch: Mismatch) -> Mismatch:
    shapes = mismatch.shapes
    told = long_share(shapes.cycles_per_m, knot_spacing_m(mismatch))
    density = shapes.density * (1.0 - told)
    return mismatch._replace(shapes=shapes._replace(density=density))


def _knots(problem: posterior.Problem, y: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Knots on all of the road that was driven, and which of them are on the bridge or near it."""
    at = posterior.points(problem, y[None, :])
    rear = _rear_m(problem.crossing, at)
    # From the bridge's start on, so that all crossings have the same.
    knot_m = knot_spacing_m(problem.mismatch)
    first = int(np.floor(rear.min() / knot_m)) - 2
    last = int(np.ceil(rear.max() / knot_m)) + 2
    grid = knot_m * np.arange(first, last + 1)
    near = (grid > -_BESIDE_M) & (grid < problem.crossing.span_m + _BESIDE_M)
    return np.asarray(grid), np.asarray(np.flatnonzero(near), dtype=np.int64)


def _beside(
    precision: FloatArray,
    mismatch: Mismatch,
    grid: FloatArray,
    inner: NDArray[np.int64],
    first: int,
) -> None:
    """Add what is known of the coefficients beside the bridge given those on it; in place.

    They are from `first` on.
    The prior of those on the bridge is left for where crossings are fused.
    """
    shapes = mismatch.shapes
    of_all = covariance_of_coefficients(
        grid, shapes.cycles_per_m, mismatch.level_m3 @ shapes.density
    )
    places = first + np.arange(grid.size)
    precision[np.ix_(places, places)] += np.linalg.inv(of_all)
    precision[np.ix_(first + inner, first + inner)] -= np.linalg.inv(of_all[np.ix_(inner, inner)])


def _as_root(precision: FloatArray, linear: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Upper triangular R and z with R'R the precision and R'z the linear part."""
    values, vectors = np.linalg.eigh(0.5 * (precision + precision.T))
    kept = values > _ROUNDED * values[-1]
    size = np.sqrt(np.where(kept, values, 1.0))
    rows = np.where(kept, size, 0.0)[:, None] * vectors.T
    target = np.where(kept, vectors.T @ linear, 0.0) / size
    (both,) = qr(np.column_stack([rows, target]), mode="r")
    m = linear.size
    return np.asarray(both[:m, :m]), np.asarray(both[:m, m])


def _coordinates(problem: posterior.Problem, places: NDArray[np.int64]) -> Coordinates:
    """Of places in y, or of wheelbase and common gain, which come last."""
    priors, where = problem.priors, posterior.layout(problem)
    table = unknowns.table(unknowns.element_count(priors.theta))
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


def _rear_m(crossing: Crossing, at: Points) -> FloatArray:
    """Where the rear axle is at every row's sample: (rows,)."""
    rear = rear_position_m(at.position_m[0], float(at.wheelbase_m[0]), crossing.direction)
    return rear[crossing.first_row :]


def _white_knots(problem: posterior.Problem, y: FloatArray, grid: FloatArray) -> FloatArray:
    """What 1 mm of each coefficient does to the white rows: (3 m, q)."""
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
    return out


def _off_bridge(found: Optimum) -> OffBridge:
    """What the axles' roads differ by off the bridge, at places that all crossings have."""
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
    for one in off_bridge(problem, y):
        samples = slice(one.start * rows.every, one.stop * rows.every)
        place, value = rear[samples], residual[0][samples]
        if place.size < 2:
            continue
        order = np.argsort(place)
        inside = (x > place.min()) & (x < place.max())
        out[inside] = np.interp(x[inside], place[order], value[order])
    return OffBridge(float(x[0]), out)
