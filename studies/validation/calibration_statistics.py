"""Calibration of a method's intervals by many crossings of known truth.

Each function takes errors or ranks and returns their deviation from calibrated ones. Ranks and
standardised errors of one crossing are dependent (its elements share the common scale uncertainty,
errors of neighbours are anticorrelated), so standard errors are taken between crossings, and a
group of parameters is tested parameter by parameter.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, log_ndtr, ndtr

from pre_core.arrays import FloatArray
from pre_core.constants import NORMAL_975


class Scores(NamedTuple):
    """Errors of the rigidities in all usable crossings, (crossings, elements) each."""

    seeds: NDArray[np.int64]  # (crossings,)
    is_good: NDArray[np.bool_]  # (crossings,)
    z: FloatArray
    """Standardised error (mean - truth)/std of EI."""
    z_log: FloatArray
    """Standardised error of ln EI, whose mean and std come from the quantiles."""
    is_covered: NDArray[np.bool_]
    """Whether the truth lies between the 2.5 and 97.5 % quantiles."""
    std_log: FloatArray
    bound: FloatArray
    """Cramér-Rao bound of ln EI with the common scale uncertainty."""


class Share(NamedTuple):
    """A share of cases and its standard error between crossings."""

    value: float
    error: float
    cases: int


def pooled_share(hits: FloatArray) -> Share:
    """Return the share of hits (crossings, parameters), each 0 or 1.

    Crossings are independent, hits in one crossing are not.
    """
    per_crossing = hits.mean(axis=1)
    n = per_crossing.size
    error = float(per_crossing.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
    return Share(float(per_crossing.mean()), error, hits.size)


def root_mean_square(z: FloatArray) -> float:
    """Return the root mean square of standardised errors (…): 1 for calibrated intervals."""
    return float(np.sqrt(np.mean(z * z)))


def rank(draws: FloatArray, truth: FloatArray, ties: FloatArray) -> FloatArray:
    """Return the share (p,) of draws (n, p) below the truth (p,): uniform for a true posterior.

    Of the draws that equal the truth the share `ties` (p,) counts as below. Where a posterior has a
    point mass, ranks are uniform only if it is drawn between 0 and 1 (randomised probability
    integral transform); with half of them ranks pile up in the middle.
    """
    below = np.mean(draws < truth, axis=0)
    return np.asarray(below + ties * np.mean(draws == truth, axis=0))


def rank_from_quantiles(truth: float, low: float, middle: float, high: float) -> float:
    """Return the rank of the truth from the 2.5, 50 and 97.5 % quantiles.

    The standardised error is interpolated between and beyond them, linearly in the logarithm if all
    are positive, linearly otherwise: exact for a log-normal posterior, and for a normal one that
    reaches below zero. Draws (`rank`) need no such shape.
    """
    values = np.array([low, middle, high, truth])
    if np.all(values > 0.0):
        low, middle, high, truth = np.log(values)
    width = (middle - low) if truth < middle else (high - middle)
    score = NORMAL_975 * (truth - middle) / max(width, 1e-300)
    return float(ndtr(score))


class Uniformity(NamedTuple):
    """Chi-square test of ranks against the uniform distribution."""

    statistic: float
    p_value: float
    counts: NDArray[np.int64]


def uniformity(ranks: FloatArray, bins: int = 10) -> Uniformity:
    """Test independent ranks (n,) between 0 and 1; at least five in a bin are expected."""
    bins = max(2, min(bins, ranks.size // 5))
    counts, _ = np.histogram(np.clip(ranks, 0.0, 1.0), bins, (0.0, 1.0))
    expected = ranks.size / bins
    statistic = float(np.sum((counts - expected) ** 2) / expected) if ranks.size else 0.0
    return Uniformity(statistic, float(chdtrc(bins - 1, statistic)), counts)


def bonferroni_p_value(p_values: FloatArray) -> float:
    """Return the probability of the worst of p-values (k,) under any dependence (Bonferroni)."""
    return float(min(1.0, p_values.size * p_values.min()))


def truncated_covariance(covariance: FloatArray, i: int, centre: float) -> FloatArray:
    """Return the covariance (f, f) if coordinate i, normal about `centre`, cannot be negative.

    Its variance becomes that of the truncated normal; the others keep their regression on it.
    """
    variance = float(covariance[i, i])
    std = np.sqrt(variance)
    lowest = -centre / std
    # Inverse Mills ratio of the part above `lowest`.
    mills = float(np.exp(-0.5 * lowest**2 - 0.5 * np.log(2.0 * np.pi) - log_ndtr(-lowest)))
    share = 1.0 + lowest * mills - mills**2
    column = covariance[:, i]
    return np.asarray(covariance - np.outer(column, column) * ((1.0 - share) / variance))
