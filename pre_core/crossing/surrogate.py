"""A cheap density close to the posterior of one crossing, which is refined as draws are weighted.

Its coordinates x are those of y, with c = EI_nominal/EI in place of ln EI and the damping itself in
place of its logarithm: deflections are linear in c, and the decay of a vibration nearly so in the
damping. The density is a normal likelihood in x times the exact priors: log-normal, half-normal,
and point masses of absence. It starts as the Gauss-Newton approximation at the optimum. Where draws
of it have been weighted by the posterior, a quadratic regression of the log weights shifts and
reshapes the normal likelihood (cf. Opper and Archambeau 2009), so that the weights of the next
draws vary less.

Over draws of the surrogate such a regression minimises KL(surrogate || posterior), which neglects
regions that these seldom reach: a few draws keep large weights. Later regressions count draws by a
power of their weights, most of the way to KL(posterior || surrogate).
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import compliances
from pre_core.crossing.fit import Optimum
from pre_core.crossing.posterior import layout, log_odds_of_absence
from pre_core.parameters import ALPHA, BETA, RHO_A
from pre_core.search.convergence import CHAINS

_LOWEST = 8.0
"""Largest drop of a log weight, below the median of the latest draws, that the regression sees: far
tails are not parabolic."""
_BATCHES_SEEN, _BATCHES_SEEN_WEIGHTED = 3, 6
"""Number of latest batches that the regression uses, without and with weights."""
_WEIGHT_POWER = 0.7
"""Power of the weights by which draws count in a weighted regression."""
_LARGEST_COUNTED = 4.0
"""Largest log weight that counts, relative to the median of the latest draws: one draw alone must
not decide."""
_NUISANCES = 3
"""Number of principal directions of the other coordinates whose curvature is regressed, too."""
_SHRINKAGE = (1e1, 1e2, 1e3, 1e4, 1e5)
"""Ridge factors from which the evidence chooses, for slopes and for curvatures."""
_ROUNDING = 1e-12
"""Least share of the log weights' variance that counts as unexplained: a zero has no logarithm."""
_FLATTEST, _STEEPEST = 0.4, 6.0
"""Limits of the ratio of curvatures after and before one refinement."""


class SurrogateCoordinates(NamedTuple):
    """The coordinates x (f,) of a surrogate; `curved` are x = exp(-sigma y), the others x = y."""

    curved: NDArray[np.int64]
    sigma: FloatArray  # of `curved`; negative where x increases with y
    half_normal: NDArray[np.int64]
    log_odds: FloatArray  # (f,) as in `posterior.log_odds_of_absence`
    non_normal: NDArray[np.int64]
    """Coordinates in which the posterior deviates from a normal in x."""
    inflation: float


class Surrogate(NamedTuple):
    """The normal likelihood exp(linear x - x precision x / 2) of x (f,)."""

    precision: FloatArray  # (f, f)
    linear: FloatArray  # (f,)


def coordinates(found: Optimum, inflation: float) -> SurrogateCoordinates:
    """Return the coordinates of an optimum's posterior, for noise `inflation` times as large."""
    priors = found.problem.priors
    where = layout(found.problem)
    kept = np.flatnonzero(priors.estimated)
    damping = np.flatnonzero(np.isin(kept, (ALPHA, BETA)) & ~priors.half_normal[kept])
    spread = priors.spread[kept]
    curved = np.concatenate([where.elements, damping])
    mass = np.flatnonzero(kept == RHO_A)
    delays = np.arange(where.delays.start, where.delays.stop)
    return SurrogateCoordinates(
        curved,
        np.concatenate([spread[where.elements], -spread[damping]]),
        where.half_normal,
        log_odds_of_absence(found.problem, inflation),
        np.unique(np.concatenate([curved, mass, where.half_normal, delays])),
        inflation,
    )


def restricted(coords: SurrogateCoordinates, kept: NDArray[np.int64]) -> SurrogateCoordinates:
    """Return the coordinates of a density of `kept` (n,) alone, all of them non-normal.

    All curved and half-normal coordinates that matter are among them.
    """
    place = {int(index): n for n, index in enumerate(kept)}
    curved = [n for n, index in enumerate(coords.curved) if int(index) in place]

    def among(indices: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.array([place[int(i)] for i in indices if int(i) in place], dtype=np.int64)

    return SurrogateCoordinates(
        among(coords.curved),
        coords.sigma[curved],
        among(coords.half_normal),
        coords.log_odds[kept],
        np.arange(kept.size),
        coords.inflation,
    )


def transform(coords: SurrogateCoordinates, y: FloatArray) -> FloatArray:
    """Return the coordinates x (k, f) of points y (k, f), or of one point (f,)."""
    x = y.copy()
    x[..., coords.curved] = np.exp(-coords.sigma * y[..., coords.curved])
    return x


def log_prior(coords: SurrogateCoordinates, y: FloatArray) -> FloatArray:
    """Return the log prior (k,) of the curved coordinates of y (k, f), up to a constant."""
    return np.asarray(-0.5 * np.sum((y[:, coords.curved] / coords.inflation) ** 2, axis=1))


def log_likelihood(surrogate: Surrogate, x: FloatArray) -> FloatArray:
    """Return the surrogate's log likelihood (k,) at x (k, f), up to a constant.

    It contains the priors of all but the curved coordinates.
    """
    return np.asarray(x @ surrogate.linear - 0.5 * np.sum((x @ surrogate.precision) * x, axis=1))


def gauss_newton_surrogate(found: Optimum, coords: SurrogateCoordinates) -> Surrogate:
    """Return the surrogate that has the residuals' values and slopes at an optimum."""
    state = found.state
    kept = compliances.without_priors(found.problem, state.residual.size, coords.curved)
    centre, jacobian = transform(coords, state.y), state.jacobian[kept]
    jacobian[:, coords.curved] /= -coords.sigma * centre[coords.curved]
    precision = jacobian.T @ jacobian / coords.inflation**2
    return Surrogate(
        precision, precision @ centre - jacobian.T @ state.residual[kept] / coords.inflation**2
    )


def draw(
    surrogate: Surrogate,
    coords: SurrogateCoordinates,
    centre: FloatArray,
    count: int,
    seed: int,
    number: int,
) -> FloatArray:
    """Return draws y (count, f); `count` is a multiple of CHAINS, `number` distinguishes batches.

    The chains start about `centre` (f,) in x.
    """
    density = compliances.from_normal(
        surrogate.precision,
        surrogate.linear,
        coords.curved,
        coords.half_normal,
        coords.sigma,
        coords.log_odds,
        centre[coords.curved],
    )._replace(inflation=coords.inflation)
    first = number * CHAINS
    return np.concatenate(
        [compliances.draws(density, count // CHAINS, seed, first + k) for k in range(CHAINS)]
    )


def refine(
    surrogate: Surrogate,
    coords: SurrogateCoordinates,
    x: FloatArray,
    log_target: FloatArray,
    latest: int,
    *,
    is_weighted: bool = False,
) -> Surrogate:
    """Return the surrogate whose likelihood is closest to the target at draws x (k, f).

    `log_target` (k,) is the target's log likelihood in the sense of `log_likelihood`; the last
    `latest` draws are those of `surrogate`, and give the scale of x. Where `is_weighted`, draws
    count by a power of their weights.
    """
    count = latest * (_BATCHES_SEEN_WEIGHTED if is_weighted else _BATCHES_SEEN)
    x, log_target = x[-count:], log_target[-count:]
    excess = log_target - log_likelihood(surrogate, x)
    level = np.median(excess[-latest:])
    seen = excess > level - _LOWEST
    if not np.isfinite(level) or seen.sum() <= x.shape[1]:
        return surrogate  # too few possible draws
    mean, spread = x[-latest:].mean(axis=0), x[-latest:].std(axis=0)
    spread[spread == 0.0] = np.inf  # absent in all draws
    z = (x - mean) / spread
    along = _directions(coords, z[-latest:])
    excess = np.minimum(excess[seen] - level, _LOWEST)
    power = _WEIGHT_POWER if is_weighted else 0.0
    weight = np.exp(power * np.minimum(excess, _LARGEST_COUNTED))
    slope, curvature = _regress(z[seen], along, excess, weight / weight.mean())
    change = (along @ curvature @ along.T) / np.outer(spread, spread)
    precision = _limit_change(surrogate.precision, surrogate.precision - change)
    gradient = surrogate.linear - surrogate.precision @ mean + slope / spread
    return Surrogate(precision, gradient + precision @ mean)


def _directions(coords: SurrogateCoordinates, z: FloatArray) -> FloatArray:
    """Return directions (f, d) along which curvature is regressed, from scaled draws z (k, f)."""
    f = z.shape[1]
    others = np.setdiff1d(np.arange(f), coords.non_normal)
    of_non_normal = np.eye(f)[:, coords.non_normal]
    if others.size == 0:
        return of_non_normal
    variance, vectors = np.linalg.eigh(np.cov(z[:, others].T))
    main = np.zeros((f, _NUISANCES))
    main[others] = vectors[:, -_NUISANCES:] / np.sqrt(variance[-_NUISANCES:])
    return np.column_stack([of_non_normal, main])


def _regress(
    z: FloatArray, along: FloatArray, excess: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return slope (f,) and curvature (d, d) of log weights (k,) over z (k, f) and z @ along.

    Ridge regression in which draws count by `weight` (k,), of mean one; the factors of slopes and
    curvatures are those of the largest evidence.
    """
    u = z @ along
    first, second = np.triu_indices(along.shape[1])
    columns = np.column_stack([z, u[:, first] * u[:, second]])
    root_weight = np.sqrt(weight)
    columns = (columns - np.average(columns, axis=0, weights=weight)) * root_weight[:, None]
    excess = (excess - np.average(excess, weights=weight)) * root_weight
    gram, image, square = columns.T @ columns, columns.T @ excess, float(excess @ excess)
    f = z.shape[1]
    best, found = -np.inf, np.zeros(columns.shape[1])
    for flat, bent in product(_SHRINKAGE, _SHRINKAGE):
        if bent < flat:
            continue
        ridge = np.concatenate([np.full(f, flat), np.full(first.size, bent)])
        root = np.linalg.cholesky(gram + np.diag(ridge))
        half = np.linalg.solve(root, image)
        unexplained = max(square - float(half @ half), _ROUNDING * square)
        evidence = 0.5 * float(np.log(ridge).sum()) - float(np.log(np.diag(root)).sum())
        evidence -= 0.5 * excess.size * np.log(unexplained)
        if evidence > best:
            best, found = evidence, np.linalg.solve(root.T, half)
    curvature = np.zeros((along.shape[1], along.shape[1]))
    curvature[first, second] = found[f:]
    return found[:f], curvature + curvature.T


def _limit_change(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the precision `after` (f, f) with its ratio to the precision `before` limited."""
    root = np.linalg.cholesky(before)
    inverse = np.linalg.inv(root)
    ratio, vectors = np.linalg.eigh(inverse @ after @ inverse.T)
    half = root @ vectors
    limited = (half * np.clip(ratio, _FLATTEST, _STEEPEST)) @ half.T
    return np.asarray(0.5 * (limited + limited.T))
