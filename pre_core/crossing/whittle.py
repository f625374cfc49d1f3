"""How loud sources of known spectra are, by what a periodogram shows (Whittle 1953)."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_PASSES = 200


def likeliest_levels(
    seen: FloatArray,
    known: FloatArray,
    shape: FloatArray,
    start: FloatArray,
    claimed: FloatArray | float = 0.0,
    enough: float = 0.0,
) -> tuple[FloatArray, float]:
    """The most likely levels (s,) of shapes (s, f) in a periodogram (f,), and what they gain.

    `known` (f,) is what is there without them. The gain, over none of them, is that of the
    log-likelihood: twice it, halved because a taper makes neighbours alike and only every other
    frequency tells something new. Every level is multiplied by the root of what it explains over
    what it claims (`claimed` more, by a prior) until none changes by more than `enough`.
    """
    level = start
    for _ in range(_PASSES):
        expected = known + level @ shape
        change = np.sqrt((shape @ (seen / expected**2)) / (claimed + shape @ (1.0 / expected)))
        level = level * change
        if np.abs(change[level > enough * level.max()] - 1.0).max(initial=0.0) < enough:
            break
    expected = known + level @ shape
    gain = np.sum(np.log(known / expected) + seen / known - seen / expected)
    return level, float(gain)
