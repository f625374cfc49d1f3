"""The noise density of an accelerometer, from a stretch of its samples.

At standstill a sensor's output is nearly all noise; an engine adds few spectral lines, which the
median over frequencies ignores. While driving, only frequencies above the wheels' motion are noise,
which needs at least 400 Hz. Even there the road remains between the frequencies at which a tyre's
contact length is a whole number of wavelengths, so the quietest part of the band bounds the noise.
"""

from typing import Final, NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.constants import MICRO_G_M_PER_S2

_PIECE_S: Final = 1.0
_FEWEST_PIECES: Final = 5
_STANDING_BAND_HZ: Final = 20.0
"""Lower end of the band at standstill."""
_DRIVING_BAND: Final = 0.3
"""Lower end of the band while driving, as a share of the sampling rate."""
_TOP_OF_BAND: Final = 0.42
"""Upper end as a share of the sampling rate: above it a sensor's own filter removes its noise."""
_MEDIAN_OF_POWER: Final = 0.71
"""Ratio of the median power over a dozen pieces to the mean; ln 2 for very many pieces."""
_PARTS: Final = 6
_LEAST_OF_POWER: Final = 0.79
"""Ratio of the smallest median of a part of the band to the whole band's, in ten pieces of white
noise."""
_WHEELS_HZ: Final = 120.0
"""Frequency above which wheel hop and vibration of frames and brackets have died away."""


class NoiseSegment(NamedTuple):
    """A stretch of samples (n,) of one channel without gaps, and whether the truck stood still."""

    values: FloatArray
    rate_hz: float
    is_standing: bool


class Density(NamedTuple):
    """One-sided noise density of a stretch of samples."""

    ug_per_rthz: float
    quietest_ug_per_rthz: float
    """Density in the quietest sixth of the band, without the bias of a minimum."""
    unevenness: float
    """Ratio of power in the loudest sixth of the band to that in the quietest: 1.6 for sensor noise
    in ten seconds at 500 Hz and less for more samples, larger for motion of wheels or frame."""


def density(segment: NoiseSegment) -> Density | None:
    """Return the noise density of one channel; None for too few samples, or only motion."""
    low = _STANDING_BAND_HZ if segment.is_standing else _DRIVING_BAND * segment.rate_hz
    high = _TOP_OF_BAND * segment.rate_hz
    if high <= low or (not segment.is_standing and low < _WHEELS_HZ):
        return None
    size = round(_PIECE_S * segment.rate_hz)
    count = segment.values.size // size
    pieces = segment.values[: count * size].reshape(count, size)
    pieces = pieces[np.isfinite(pieces).all(axis=1)]
    if pieces.shape[0] < _FEWEST_PIECES:
        return None
    window = np.hanning(size)
    centred = window * (pieces - pieces.mean(axis=1, keepdims=True))
    power = np.abs(np.fft.rfft(centred, axis=1)) ** 2
    power *= 2.0 / (segment.rate_hz * float(window @ window))
    frequency = np.fft.rfftfreq(size, 1.0 / segment.rate_hz)
    # An impact is in some pieces, an engine's line at some frequencies: medians ignore both.
    typical = np.median(power, axis=0) / _MEDIAN_OF_POWER
    edges = np.searchsorted(frequency, np.linspace(low, high, _PARTS + 1))
    parts = [float(np.median(part)) for part in np.split(typical, edges)[1:-1]]
    whole = float(np.median(typical[edges[0] : edges[-1]]))
    return Density(
        float(np.sqrt(whole)) / MICRO_G_M_PER_S2,
        float(np.sqrt(min(parts) / _LEAST_OF_POWER)) / MICRO_G_M_PER_S2,
        max(parts) / max(min(parts), float(np.finfo(float).tiny)),
    )
