"""The noise of accelerometers, against what is declared of it.

At standstill nearly all that a sensor shows is its noise; lines of an engine are few, and the
median over frequencies does not see them. While driving only what lies above the wheels' motion is
noise, of a sensor of at least 400 Hz.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import MICRO_G_M_PER_S2
from services.inspection.finding import Finding, State, judged

Floats = NDArray[np.float64]

_PIECE_S: Final = 1.0
_FEWEST_PIECES: Final = 5
_LOUDER, _LOUDER_DRIVING, _QUIETER = 1.15, 1.3, 0.77
"""Density over the declared one: beyond these a fit says `noise_above_declared`, or below. What a
truck does above the wheels' motion made 10 µg/√Hz look like 11.9 in one of 18 drives."""
_STANDING_BAND_HZ: Final = 20.0
_DRIVING_BAND: Final = 0.3
_TOP_OF_BAND: Final = 0.42
"""Of the rate: above it a sensor's own filter takes its noise away."""
_MEDIAN_OF_POWER: Final = 0.71
"""Of the median over a dozen pieces, over frequencies, to the mean: ln 2 of ever so many."""
_FALLS: Final = 1.2
_WHEELS_HZ: Final = 120.0
"""Wheels hop at ten hertz, and what frames and brackets do has died away."""


class Still(NamedTuple):
    """A stretch of samples (n,) of one channel, gaps left out, and whether the truck stood."""

    values: Floats
    rate_hz: float
    is_standing: bool


class Density(NamedTuple):
    """One-sided density of a stretch."""

    ug_per_rthz: float
    falls: float
    """Power in the lower half of the band over that in the upper half: 1 of a sensor's noise, more
    of what wheels and frames do."""


def density(still: Still) -> Density | None:
    """Of one channel; None where too little, or nothing but motion, can be seen."""
    low = _STANDING_BAND_HZ if still.is_standing else _DRIVING_BAND * still.rate_hz
    high = _TOP_OF_BAND * still.rate_hz
    if high <= low or (not still.is_standing and low < _WHEELS_HZ):
        return None
    size = round(_PIECE_S * still.rate_hz)
    count = still.values.size // size
    pieces = still.values[: count * size].reshape(count, size)
    pieces = pieces[np.isfinite(pieces).all(axis=1)]
    if pieces.shape[0] < _FEWEST_PIECES:
        return None
    window = np.hanning(size)
    centred = window * (pieces - pieces.mean(axis=1, keepdims=True))
    power = np.abs(np.fft.rfft(centred, axis=1)) ** 2
    power *= 2.0 / (still.rate_hz * float(window @ window))
    frequency = np.fft.rfftfreq(size, 1.0 / still.rate_hz)
    middle = 0.5 * (low + high)
    # An impact is in some pieces, an engine's line at some frequencies: medians see neither.
    typical = np.median(power, axis=0)
    lower = typical[(frequency >= low) & (frequency < middle)]
    upper = typical[(frequency >= middle) & (frequency <= high)]
    whole = float(np.median(np.concatenate([lower, upper]))) / _MEDIAN_OF_POWER
    return Density(
        float(np.sqrt(whole)) / MICRO_G_M_PER_S2,
        float(np.median(lower) / max(np.median(upper), np.finfo(float).tiny)),
    )


def noise_of(name: str, still: Still | None, declared_ug: float) -> Finding:
    """What is to be said of one channel's noise."""
    found = None if still is None else density(still)
    if still is None or found is None:
        return Finding(
            "noise",
            State.OPEN,
            f"{name}: noise cannot be told from this recording",
            "record a minute at standstill, engine off",
        )
    ratio = found.ug_per_rthz / declared_ug if declared_ug > 0.0 else np.inf
    measured = f"{found.ug_per_rthz:.3g} µg/√Hz"
    if not still.is_standing and ratio > _LOUDER_DRIVING and found.falls > _FALLS:
        return Finding(
            "noise",
            State.OPEN,
            f"{name}: noise at most {measured}, {declared_ug:g} declared: the truck's own motion "
            "hides it",
            "record a minute at standstill, engine off",
        )
    where = "at standstill" if still.is_standing else "while driving"
    return judged(
        "noise",
        f"{name}: noise {measured} {where}, {declared_ug:g} declared",
        "declare what it is, or look for a loose mount, a cable or another sensor"
        if ratio > 1.0
        else "declare what it is: intervals would be too wide, and a misfit could hide in it",
        is_wrong=not _QUIETER <= ratio <= (_LOUDER if still.is_standing else _LOUDER_DRIVING),
    )
