"""Importance sampling: draws of known densities, weighted by the target over their mixture.

The upper weights are replaced by the quantiles of the generalised Pareto distribution that fits
them. Its shape k is the test of reliability (Vehtari, Simpson, Gelman, Yao and Gabry 2024: below
0.7).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from pre_core.arrays import FloatArray

LogDensity = Callable[[FloatArray], FloatArray]
"""Function from points (k, d) to the logarithm (k,) of a density there, up to a constant."""

_MAX_ROUNDS, _SAME_SCALE = 50, 1e-6
"""Largest number of rounds that scale the densities to each other, and the change of a log scale
that ends them."""
_NOTHING = 1e-300
"""Density, relative to the highest at the same point, below which it does not matter."""


class SmoothedWeights(NamedTuple):
    """Weights (k,) with sum one, the shape of their tail and the effective number of draws."""

    weight: FloatArray
    pareto_k: float
    ess: float


def mixture_log_weights(
    log_target: FloatArray, log_density: FloatArray, counts: NDArray[np.int64]
) -> FloatArray:
    """Return the log weights (k,) of draws from several densities, as draws of their mixture.

    `log_target` (k,) and `log_density` (k, r) are values at all draws, ordered by the density that
    they were drawn from, `counts` (r,) of each. Densities need not be normalised: they are scaled
    so that each has its share of the mixture (Shirts and Chodera 2008, equation 11).
    """
    stops = np.cumsum(counts)
    log_counts = np.log(counts)
    log_scale = np.zeros(counts.size)
    for r, (count, stop) in enumerate(zip(counts, stops, strict=True)):
        own = slice(stop - count, stop)
        log_mean = logsumexp(log_target[own] - log_density[own, r]) - log_counts[r]
        log_scale[r] = -log_mean if np.isfinite(log_mean) else np.median(log_density[own, r])
    # Each density is taken relative to the highest at its draw, so that no round needs logarithms.
    scaled = log_density - log_scale
    highest = scaled.max(axis=1)
    density = np.maximum(np.exp(scaled - highest[:, None]), _NOTHING)
    moved = np.zeros(counts.size)
    for _ in range(_MAX_ROUNDS):
        mixture = density @ (counts * np.exp(moved.min() - moved))
        last, moved = moved, np.log(density.T @ (1.0 / mixture))
        if np.ptp(moved - last) < _SAME_SCALE:
            break
    return np.asarray(log_target - highest - np.log(mixture))


def systematic_resample(
    share: FloatArray, count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return `count` shuffled indices (count,) in proportion to the shares (k,)."""
    steps = (np.arange(count) + rng.uniform()) / count
    upto = np.cumsum(share) / np.sum(share)
    return rng.permutation(np.minimum(np.searchsorted(upto, steps), share.size - 1))


def pareto_smooth(log_weight: FloatArray) -> SmoothedWeights:
    """Return Pareto-smoothed weights of log weights (k,).

    If too few are finite, the weights are equal, `pareto_k` is infinite and `ess` zero. If the
    largest are equal, there is no tail to fit, and `pareto_k` is zero.
    """
    count = log_weight.size
    tail = int(np.ceil(min(0.2 * count, 3.0 * np.sqrt(count))))
    order = np.argsort(log_weight)
    if tail < 5 or not np.isfinite(log_weight[order[-tail - 1]]):
        return SmoothedWeights(np.full(count, 1.0 / count), np.inf, 0.0)
    log = log_weight - log_weight[order[-1]]
    largest, cut = order[-tail:], float(np.exp(log[order[-tail - 1]]))
    weight, k = np.exp(log), 0.0
    if weight[largest[0]] > cut:
        k, scale = _generalised_pareto(weight[largest] - cut)
        part = (np.arange(tail) + 0.5) / tail
        weight[largest] = np.minimum(cut + _quantiles(part, k, scale), 1.0)
    weight /= weight.sum()
    return SmoothedWeights(weight, k, float(1.0 / np.sum(weight**2)))


def _quantiles(part: FloatArray, k: float, scale: float) -> FloatArray:
    log_tail = -np.log1p(-part)
    return np.asarray(scale * (np.expm1(k * log_tail) / k if k != 0.0 else log_tail))


def _generalised_pareto(x: FloatArray) -> tuple[float, float]:
    """Return shape k and scale of x (n,) > 0, ascending (Zhang and Stephens 2009).

    A prior worth ten draws with k = 1/2 stabilises the shape for small n.
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
