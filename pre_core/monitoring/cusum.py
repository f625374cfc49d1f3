"""Page's two-sided CUSUM of standardised innovations, and its threshold by Markov's chain.

    up_t = max(0, up_{t-1} + r_t - k),    down_t = max(0, down_{t-1} - r_t - k)

An alarm is up or down above h. r is cut off at `LARGEST`: one period alone gives no alarm, whatever
has gone wrong in it. E. S. Page, Biometrika 41 (1954); run lengths as by D. Brook and D. A. Evans,
Biometrika 59 (1972): up is looked at on a grid, and moves on it as a Markov chain.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

FloatArray = NDArray[np.float64]

ALLOWANCE = 0.5
"""k, in standard deviations: half of the change that is found soonest."""
LARGEST = 4.0
_CELLS = 160
_HALVINGS = 40


class Sums(NamedTuple):
    """Both sums of each element, (n,) each."""

    up: FloatArray
    down: FloatArray


def nothing(elements: int) -> Sums:
    """Sums of a chart that begins."""
    return Sums(np.zeros(elements), np.zeros(elements))


def moved(sums: Sums, standardised: FloatArray) -> Sums:
    """The sums after a period's innovations (n,), divided by their standard deviations."""
    r = np.clip(standardised, -LARGEST, LARGEST)
    return Sums(
        np.maximum(0.0, sums.up + r - ALLOWANCE), np.maximum(0.0, sums.down - r - ALLOWANCE)
    )


def run_length(threshold: float, shift: float = 0.0) -> float:
    """Mean number of periods until one sum passes a threshold, innovations being N(shift, 1)."""
    width = 2.0 * threshold / (2.0 * _CELLS - 1.0)
    middle = width * np.arange(_CELLS)
    # The sum after a period, before zero is put for what is below: a step to each cell's end.
    step = middle[None, :] + 0.5 * width - middle[:, None] + ALLOWANCE
    below = np.where(step >= LARGEST, 1.0, np.where(step < -LARGEST, 0.0, ndtr(step - shift)))
    moves = np.diff(below, axis=1, prepend=0.0)
    return float(np.linalg.solve(np.eye(_CELLS) - moves, np.ones(_CELLS))[0])


@lru_cache(maxsize=64)
def threshold_for(false_alarms_per_year: float, charts: int, periods_per_year: float) -> float:
    """h with which so many sums together give so many false alarms in a year.

    Each of them counted by itself, as if they were independent: more than that cannot be.
    """
    wanted = charts * periods_per_year / false_alarms_per_year
    low, high = 1.0, 30.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if run_length(middle) < wanted else (low, middle)
    return high
