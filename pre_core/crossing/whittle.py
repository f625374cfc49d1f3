"""Levels of sources with known spectra, from a periodogram (Whittle 1953)."""

import numpy as np

from pre_core.arrays import FloatArray

_PASSES = 200


def maximum_likelihood_levels(
    periodogram: FloatArray,
    known: FloatArray,
    shape: FloatArray,
    start: FloatArray,
    prior_power: FloatArray | float = 0.0,
    tolerance: float = 0.0,
) -> tuple[FloatArray, float]:
    """Return the most likely levels (s,) of shapes (s, f) in a periodogram (f,), and a statistic.

    `known` (f,) is the spectrum without them. The statistic is the likelihood ratio 2 ln(L/L_0) of
    independent frequencies, halved because a taper correlates neighbours. The iteration begins at
    `start` (s,): every level is multiplied by the root of the ratio of its observed to its expected
    power, the latter plus `prior_power` (s,) from a prior, until none changes by more than
    `tolerance`, or for `_PASSES` passes.
    """
    level = start
    for _ in range(_PASSES):
        expected = known + level @ shape
        change = np.sqrt(
            (shape @ (periodogram / expected**2)) / (prior_power + shape @ (1.0 / expected))
        )
        level = level * change
        if np.abs(change[level > tolerance * level.max()] - 1.0).max(initial=0.0) < tolerance:
            break
    expected = known + level @ shape
    statistic = np.sum(np.log(known / expected) + periodogram / known - periodogram / expected)
    return level, float(statistic)
