"""Posterior draws that are proposed by surfaces of the residuals and weighted by the residuals.

With tyres of one kind the posterior is so narrow that a surface fitted once is off by more than its
width. So draws on a surface (`search.tempering`) are weighted by the residuals there, to which the
surface is then fitted too, until the weights hardly vary. All draws are weighted as draws of the
mixture of the surfaces (adaptive multiple importance sampling: Cornuet, Marin, Mira and Robert
2012).
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from pre_core.arrays import FloatArray
from pre_core.crossing.fit import Optimum
from pre_core.crossing.response_surface import (
    ParabolaSums,
    added,
    parabola_terms,
    parabolas,
    sums_of,
)
from pre_core.crossing.weighted_draws import WeightedDraws, is_enough
from pre_core.search import importance, tempering
from pre_core.search.latent import latent_coordinates
from pre_core.search.loop import Report

_MAX_ROUNDS = 12
"""Largest number of rounds, each of which fits a surface and draws on it."""
_BATCH_POINTS = 100
"""Number of points evaluated together: their residuals take some megabytes."""
_MAX_LOG_WEIGHT = 30.0
"""Limit of the absolute logarithm of a point's weight in a fit; the likeliest first point has 1."""
_IMPOSSIBLE_RESIDUAL = 1e6
"""Residual of a point that is not possible."""
_LEAST_SIZE = 1e-9
"""Smallest spread of a coordinate, which replaces zero."""
_MOVES = (90,)
"""Number of moves of every draw on a surface."""
_START_SPREAD = 2.0
"""Width of the normal from which draws on a surface begin, relative to the points'."""


class DrawnDensity(NamedTuple):
    """The posterior of a crossing's curved coordinates and offset, by its residuals."""

    residuals: Callable[[FloatArray], FloatArray]
    """Function from points (k, d) to the residuals (m, k) there."""
    prior_squares: Callable[[FloatArray], FloatArray]
    """Function from points (k, d) to the sums of squares (k,) of their priors."""
    half_normal: NDArray[np.int64]
    """Indices of the coordinates that must not be negative."""
    log_odds: FloatArray  # (d,) of zero, as in `latent_coordinates`
    inflation: float
    completed: Callable[[FloatArray], "CompletedDraws"] | None = None
    """Function from draws (k, d) to draws of more coordinates; None to weight the draws alone."""


class CompletedDraws(NamedTuple):
    """Draws of a few coordinates, completed with all others from a known density given these."""

    residuals: FloatArray  # (m, k) as those of `DrawnDensity`, for the surface
    y: FloatArray  # (k, f)
    squares: FloatArray
    """Minus twice the logarithm (k,) of the likelihood over the density of the completion."""


class _Frame(NamedTuple):
    """Coordinates u = (y - centre)/size of all fits, and the log density of a point of weight 1."""

    centre: FloatArray  # (d,)
    size: FloatArray  # (d,)
    level: float


class _FittedSurface(NamedTuple):
    """A surface of sums of squares, with mean and covariance of its points."""

    frame: _Frame
    rows: FloatArray
    """Coefficients (p, p) of the fewest residuals with these sums of squares."""
    mean: FloatArray  # (d,)
    root: FloatArray  # (d, d) lower triangular root of the covariance

    def squares(self, y: FloatArray) -> FloatArray:
        """Return sums of squares (k,) at points y (k, d)."""
        terms = parabola_terms((y - self.frame.centre) / self.frame.size)
        return np.asarray(np.sum((terms @ self.rows.T) ** 2, axis=1))


class _Points(NamedTuple):
    """Points at which residuals have been evaluated, and sums of these for fits."""

    y: FloatArray  # (k, d)
    squares: FloatArray  # (k,) sums of squares, by which draws are weighted
    weight: FloatArray  # (k,) in fits
    sums: ParabolaSums
    completed: FloatArray
    """Completed draws (k, f); otherwise `y`."""


def residual_draws(
    density: DrawnDensity,
    first: FloatArray,
    draws: int,
    rng: np.random.Generator,
    report: Report,
    rounds: int = _MAX_ROUNDS,
) -> WeightedDraws:
    """Return weighted draws (k, d) or (k, f), in rounds of n, the number of `first` points (n, d).

    Rounds end as soon as the effective size of all draws suffices for `draws` (`is_enough`), after
    `rounds` at the latest.
    """
    residuals = _residuals(density, first)
    level = float(log_density(density, first, np.sum(residuals**2, axis=0)).max())
    # A parameter that the site file excludes has the size zero.
    frame = _Frame(first.mean(axis=0), np.maximum(first.std(axis=0), _LEAST_SIZE), level)
    batches, used = [_evaluated(density, frame, first, residuals)], list[_FittedSurface]()
    while True:
        report("weighting draws of the posterior", 0.5 + 0.04 * len(used))
        used.append(_fit(frame, batches))
        new = _draws_on(density, used[-1], first.shape[0], rng)
        batches.append(_drawn(density, frame, new))
        weighted = _weighted(density, used, batches[1:])
        if is_enough(weighted.weights, draws) or len(used) == rounds:
            return weighted


def _residuals(density: DrawnDensity, y: FloatArray) -> FloatArray:
    """Return residuals (m, k) at points y (k, d), huge where they are not finite."""
    return _finite(np.hstack([density.residuals(some) for some in _parts(y)]))


def _parts(y: FloatArray) -> list[FloatArray]:
    return [y[i : i + _BATCH_POINTS] for i in range(0, y.shape[0], _BATCH_POINTS)]


def _finite(residuals: FloatArray) -> FloatArray:
    return np.nan_to_num(
        residuals,
        nan=_IMPOSSIBLE_RESIDUAL,
        posinf=_IMPOSSIBLE_RESIDUAL,
        neginf=_IMPOSSIBLE_RESIDUAL,
    )


def _drawn(density: DrawnDensity, frame: _Frame, y: FloatArray) -> _Points:
    """Return evaluated draws y (k, d), completed if there is a function for it."""
    if density.completed is None:
        return _evaluated(density, frame, y, _residuals(density, y))
    found = [density.completed(some) for some in _parts(y)]
    points = _evaluated(density, frame, y, _finite(np.hstack([one.residuals for one in found])))
    squares = np.concatenate([one.squares for one in found])
    return points._replace(
        squares=np.nan_to_num(squares, nan=_IMPOSSIBLE_RESIDUAL**2, posinf=_IMPOSSIBLE_RESIDUAL**2),
        completed=np.concatenate([one.y for one in found]),
    )


def prior_centres(found: Optimum, coordinates: NDArray[np.int64]) -> FloatArray:
    """Return the centres (n,) of the priors of coordinates (n,) (`posterior.all_rows`)."""
    centres = np.pad(found.problem.noise_slope, (0, found.state.y.size))
    return np.asarray(centres[coordinates])


def prior_squares(centres: FloatArray, y: FloatArray) -> FloatArray:
    """Return the priors' sums of squares (k,) at points y (k, n + 1); the offset has no prior."""
    return np.asarray(np.sum((y[:, :-1] - centres) ** 2, axis=1))


def log_density(density: DrawnDensity, y: FloatArray, squares: FloatArray) -> FloatArray:
    """Return the log posterior (k,) at points y (k, d) with these sums of squares (k,)."""
    return -0.5 / density.inflation**2 * (squares + density.prior_squares(y))


def _evaluated(
    density: DrawnDensity, frame: _Frame, y: FloatArray, residuals: FloatArray
) -> _Points:
    squares = np.sum(residuals**2, axis=0)
    log_weight = (log_density(density, y, squares) - frame.level) / y.shape[1]
    weight = np.exp(np.clip(log_weight, -_MAX_LOG_WEIGHT, _MAX_LOG_WEIGHT))
    sums = sums_of((y - frame.centre) / frame.size, residuals, weight)
    return _Points(y, squares, weight, sums, y)


def _fit(frame: _Frame, batches: list[_Points]) -> _FittedSurface:
    """Return the surface of the residuals at all points, which count by their weights."""
    rows, _ = parabolas(reduce(added, (one.sums for one in batches)))
    y = np.concatenate([one.y for one in batches])
    weight = np.concatenate([one.weight for one in batches])
    covariance = np.cov(y.T, aweights=weight) + _LEAST_SIZE**2 * np.eye(y.shape[1])
    (triangle,) = qr(rows, mode="r")
    return _FittedSurface(
        frame,
        np.asarray(triangle[: rows.shape[1]]),
        np.average(y, axis=0, weights=weight),
        np.asarray(np.linalg.cholesky(covariance)),
    )


def _draws_on(
    density: DrawnDensity, fitted: _FittedSurface, count: int, rng: np.random.Generator
) -> FloatArray:
    """Return draws y (count, d) of the posterior with a surface in place of the residuals."""
    covariance = fitted.root @ fitted.root.T
    latent = latent_coordinates(density.half_normal, density.log_odds, fitted.mean, covariance)

    def target(v: FloatArray) -> FloatArray:
        y = latent.values(v)
        return log_density(density, y, fitted.squares(y)) + latent.log_share(v)

    mean, root = latent.unexplained(fitted.mean), latent.unexplained(fitted.root)
    start = _START_SPREAD**2 * root @ root.T
    return latent.values(tempering.tempered_draws(target, mean, start, count, _MOVES, rng))


def _weighted(
    density: DrawnDensity, used: list[_FittedSurface], batches: list[_Points]
) -> WeightedDraws:
    """Return all draws on the surfaces `used`, weighted as draws of their mixture."""
    y = np.concatenate([one.y for one in batches])
    squares = np.concatenate([one.squares for one in batches])
    half = -0.5 / density.inflation**2
    of_used = half * np.stack([one.squares(y) for one in used], axis=1)
    counts = np.array([one.y.shape[0] for one in batches])
    log_weight = importance.mixture_log_weights(half * squares, of_used, counts)
    completed = np.concatenate([one.completed for one in batches])
    return WeightedDraws(completed, importance.pareto_smooth(log_weight))
