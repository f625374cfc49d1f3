"""Stretches of a signal without a measurement: held at one value, or interpolated linearly.

Noise and motion change every sample and every difference of samples, but a coarse converter often
gives equal neighbours. A stretch counts if it is longer than chance produces in one of a hundred
thousand records. After a held stretch of a coarse signal, the signal must also jump by several
steps of the converter: a signal that merely stays within one step does not.
"""

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray

_SHORTEST_S, _LONG_S = 0.01, 0.04
"""Shortest stretch that counts, and shortest held stretch that counts for any share of equal
neighbours."""
_FEWEST = 5
"""Fewest samples of a stretch that counts."""
_CHANCE = 1e-9
"""Probability of a random stretch at one place; a record has some ten thousand samples."""
_COARSE_SHARE = 0.02
"""Share of equal neighbours above which a signal is coarse."""
_JUMP = 4.0
"""Smallest jump after a held stretch, in steps of the converter."""
_LOW_STEPS = 0.05
"""Probability of the quantile that estimates one step from the changes of a coarse signal."""
_STRAIGHT = 1e-3
"""Largest second difference on a line, relative to the median second difference."""
_ON_GRID = 1e-3
"""Tolerance of changes of a quantised signal, relative to a step."""
_ROUNDING = 1e-9
"""Floating-point tolerance, relative to the largest value."""
_BLOCKS = 8
"""Number of parts of a record, each with a share of equal neighbours: calm parts have more."""


def longest_hold_s(values: FloatArray, step_s: float) -> float:
    """Return the duration in s of the longest stretch of a signal (n,) with one value, or 0.

    The largest and the smallest value are excluded: there a sensor is saturated, not stuck.
    """
    change = np.diff(values)
    is_equal = change == 0.0
    begin, length = _runs(is_equal)
    if begin.size == 0:
        return 0.0
    share = _largest_share(is_equal, begin, length)
    fewest = max(_fewest(step_s), min(_by_chance(share) + 1, round(_LONG_S / step_s)))
    is_end = (values[begin] == values.max()) | (values[begin] == values.min())
    length = np.where(is_end, 0, length)
    if share > _COARSE_SHARE:
        after = np.minimum(begin + length, change.size - 1)
        step = np.quantile(np.abs(change[~is_equal]), _LOW_STEPS)
        length = np.where(np.abs(change[after]) > _JUMP * step, length, 0)
    held = int(length.max()) + 1
    return held * step_s if held >= fewest else 0.0


def longest_line_s(values: FloatArray, step_s: float) -> float:
    """Return the duration in s of the longest sloping line in a signal (n,), or 0."""
    change = np.diff(values)
    bend = np.abs(np.diff(change))
    is_bent = bend > _ROUNDING * np.abs(values).max()
    if not is_bent.any():
        return 0.0
    flat = max(_STRAIGHT * float(np.median(bend[is_bent])), float(bend[~is_bent].max(initial=0.0)))
    is_straight = (bend <= flat) & (np.abs(change[1:]) > flat) & (np.abs(change[:-1]) > flat)
    # A quantised signal may rise by one step at every sample; an interpolated line does not.
    step = float(np.quantile(np.abs(change[np.abs(change) > flat]), _LOW_STEPS))
    off_grid = np.abs(change / step - np.round(change / step))
    if float(np.median(off_grid)) < _ON_GRID:
        is_straight &= off_grid[1:] > _ON_GRID
    begin, length = _runs(is_straight)
    if length.size == 0:
        return 0.0
    share = _largest_share(is_straight, begin, length)
    line = int(length.max()) + 2
    return line * step_s if line >= max(_fewest(step_s), _by_chance(share) + 2) else 0.0


def _fewest(step_s: float) -> int:
    return max(_FEWEST, round(_SHORTEST_S / step_s))


def _runs(is_true: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the runs of true flags (n,) begin, and their lengths."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_true, [False]]).astype(np.int8)))
    return edges[::2], np.diff(edges)[::2]


def _largest_share(
    is_true: NDArray[np.bool_], begin: NDArray[np.int64], length: NDArray[np.int64]
) -> float:
    """Return the largest share of true flags (n,) in a part of it, but for its longest run."""
    worst = int(np.argmax(length))
    others = is_true.astype(np.float64)
    others[begin[worst] : begin[worst] + length[worst]] = 0.0
    return max(float(part.mean()) for part in np.array_split(others, _BLOCKS))


def _by_chance(share: float) -> int:
    """Return the length that a run of flags of a given probability practically never has."""
    return int(np.ceil(np.log(_CHANCE) / np.log(min(max(share, 1e-9), 0.999))))
