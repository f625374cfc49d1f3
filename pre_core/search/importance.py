"""Weighted draws from the posterior: many at once, and no chain to wait for.

Points are drawn from the approximation and weighted by what the target is there over how often they
come. Such weights are worth as much as the largest of them are tame: the upper ones are replaced by
the quantiles of the generalised Pareto distribution that fits them, whose shape k says whether to
believe them (Vehtari, Simpson, Gelman, Yao and Gabry 2024: below 0.7).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.search.approximation import LogDensity, Mixture, mapped, weighed

FloatArray = NDArray[np.float64]

_AT_ONCE = 100
"""So many points are evaluated together: their rows take some megabytes."""


class Draws(NamedTuple):
    """Points y (k, f), the parts (k,) and normals (k, f) they come from, log weights (k,)."""

    y: FloatArray
    part: NDArray[np.int64]
    v: FloatArray
    log_weight: FloatArray


class Smoothed(NamedTuple):
    """Weights (k,) that sum to one, the shape of their tail and how many draws they are worth."""

    weight: FloatArray
    pareto_k: float
    ess: float


def draw(target: LogDensity, mixed: Mixture, count: int, number: int) -> Draws:
    """Points of the approximation, in each part as many as its share; `number` tells batches."""
    rng = np.random.default_rng(np.random.SeedSequence(mixed.seed, spawn_key=(1 << 21, number)))
    v = rng.standard_normal((count, mixed.parts[0].centre.size))
    part = evenly(np.exp([one.log_share for one in mixed.parts]), count, rng)
    y, log_q = mapped(mixed, part, v)
    log_weight = np.concatenate(
        [
            weighed(target, y[i : i + _AT_ONCE], log_q[i : i + _AT_ONCE])
            for i in range(0, count, _AT_ONCE)
        ]
    )
    return Draws(y, part, v, log_weight)


def evenly(share: FloatArray, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """`count` places, each as often as its `share` but for rounding, in random order."""
    steps = (np.arange(count) + rng.uniform()) / count
    upto = np.cumsum(share) / np.sum(share)
    return rng.permutation(np.minimum(np.searchsorted(upto, steps), share.size - 1))


def smoothed(log_weight: FloatArray) -> Smoothed:
    """Weights of draws by Pareto smoothing; k is infinite where hardly any is possible.

    Where the largest are all alike there is no tail to be fitted, and k is zero.
    """
    count = log_weight.size
    tail = int(np.ceil(min(0.2 * count, 3.0 * np.sqrt(count))))
    order = np.argsort(log_weight)
    if tail < 5 or not np.isfinite(log_weight[order[-tail - 1]]):
        return Smoothed(np.full(count, 1.0 / count), np.inf, 0.0)
    log = log_weight - log_weight[order[-1]]
    largest, cut = order[-tail:], float(np.exp(log[order[-tail - 1]]))
    weight, k = np.exp(log), 0.0
    if weight[largest[0]] > cut:
        k, scale = _generalised_pareto(weight[largest] - cut)
        part = (np.arange(tail) + 0.5) / tail
        weight[largest] = np.minimum(cut + _quantiles(part, k, scale), 1.0)
    weight /= weight.sum()
    return Smoothed(weight, k, float(1.0 / np.sum(weight**2)))


def _quantiles(part: FloatArray, k: float, scale: float) -> FloatArray:
    log_tail = -np.log1p(-part)
    return np.asarray(scale * (np.expm1(k * log_tail) / k if k != 0.0 else log_tail))


def _generalised_pareto(x: FloatArray) -> tuple[float, float]:
    """Shape k and scale of x (n,) > 0, ascending (Zhang and Stephens 2009).

    A prior of ten draws at one half keeps the shape of few from running away.
    """
    n = x.size
    points = 30 + int(np.sqrt(n))
    quarter = x[int(0.25 * n + 0.5) - 1]
    theta = 1.0 / x[-1] + (1.0 - np.sqrt(points / (np.arange(points) + 0.5))) / (3.0 * quarter)
    shape = np.mean(np.log1p(-theta[:, None] * x), axis=1)
    log_likelihood = n * (np.log(-theta / shape) - shape - 1.0)
    weight = np.exp(log_likelihood - np.logaddexp.reduce(log_likelihood))
    best = float(weight @ theta)
    k = float(np.mean(np.log1p(-best * x)))
    return (n * k + 5.0) / (n + 10.0), -k / best
