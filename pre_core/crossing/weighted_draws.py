"""Weighted draws of a density, from surrogates that are refined as draws are weighted."""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing import surrogate
from pre_core.search import convergence, importance
from pre_core.search.importance import LogDensity
from pre_core.search.loop import Report

MIN_EFFECTIVE_SHARE = 1.0 / 3.0
"""Required effective size of the draws, relative to the requested ones."""
_BATCH_SHARE = 1.0 / 3.0
"""Size of a batch of weighted draws, relative to the requested ones."""
_UNWEIGHTED_BATCHES = 2
"""Number of first batches whose refinement ignores the weights: their draws are too far from the
posterior for informative weights."""
_MAX_BATCHES = 25
_LARGEST_PARETO_K = 0.7
_MAX_POINTS = 100
"""Number of points evaluated together: their residuals take some megabytes."""


class WantedDraws(NamedTuple):
    """The requested number of draws, and the number of batches after which too slow draws end."""

    number: int
    patience: int = _MAX_BATCHES


class WeightedDraws(NamedTuple):
    """Points y (k, f) and their smoothed weights."""

    y: FloatArray
    weights: importance.SmoothedWeights


def importance_draws(
    target: LogDensity,
    coordinates: surrogate.SurrogateCoordinates,
    first: surrogate.Surrogate,
    start: FloatArray,
    wanted: WantedDraws,
    seed: int,
    report: Report,
) -> WeightedDraws:
    """Return weighted draws in batches, until they suffice (`is_enough`) or `_MAX_BATCHES` exist.

    After `wanted.patience` batches they also end if `_MAX_BATCHES` would not suffice at the present
    rate.

    Each batch is drawn from a surrogate that all earlier draws have refined, the `first` batch from
    the given one; its chains start about `start` (f,). All draws are weighted as draws of the
    mixture of the surrogates.
    """
    centre = surrogate.transform(coordinates, start)
    draws = wanted.number
    count = batch_size(draws)
    used: list[surrogate.Surrogate] = []
    y, x = np.empty((0, centre.size)), np.empty((0, centre.size))
    log_target = np.empty(0)
    current = first
    while True:
        report("weighting draws of the posterior", 0.5 + 0.02 * len(used))
        new = surrogate.draw(current, coordinates, centre, count, seed, len(used))
        used.append(current)
        log_posterior = _in_parts(target, new)
        y, x = np.concatenate([y, new]), np.concatenate([x, surrogate.transform(coordinates, new)])
        log_target = np.concatenate(
            [log_target, log_posterior - surrogate.log_prior(coordinates, new)]
        )
        log_density = np.stack([surrogate.log_likelihood(one, x) for one in used], axis=1)
        counts = np.full(len(used), count)
        weights = importance.pareto_smooth(
            importance.mixture_log_weights(log_target, log_density, counts)
        )
        limit = _MAX_BATCHES if _is_on_course(weights, draws, len(used)) else wanted.patience
        if is_enough(weights, draws) or len(used) >= limit:
            return WeightedDraws(y, weights)
        current = surrogate.refine(
            current, coordinates, x, log_target, count, is_weighted=len(used) > _UNWEIGHTED_BATCHES
        )


def batch_size(draws: int) -> int:
    """Return the number of draws weighted together, a multiple of the number of chains."""
    return convergence.CHAINS * -(-round(_BATCH_SHARE * draws) // convergence.CHAINS)


def _in_parts(target: LogDensity, y: FloatArray) -> FloatArray:
    """Return the target (k,) at y (k, f), minus infinity where it is not finite."""
    found = np.concatenate(
        [target(y[i : i + _MAX_POINTS]) for i in range(0, y.shape[0], _MAX_POINTS)]
    )
    return np.where(np.isfinite(found), found, -np.inf)


def _is_on_course(weights: importance.SmoothedWeights, draws: int, batches: int) -> bool:
    """Return whether `_MAX_BATCHES` would be effective enough at the rate of these batches."""
    return weights.ess * _MAX_BATCHES >= MIN_EFFECTIVE_SHARE * draws * batches


def is_enough(weights: importance.SmoothedWeights, draws: int) -> bool:
    """Return whether weighted draws have the required effective size and a light tail."""
    return weights.pareto_k <= _LARGEST_PARETO_K and weights.ess >= MIN_EFFECTIVE_SHARE * draws
