"""A sinc in Kaiser's window: low-pass, interpolation and delay of even samples, in one.

Oppenheim and Schafer, Discrete-Time Signal Processing, section 7.5.3. Between its pass band and its
stop band such a filter needs a width of (A - 7.95)/(14.36 (taps - 1)) cycles per sample for a stop
band of -A dB.
"""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def kaiser_beta(stop_band_db: float) -> float:
    """The window's shape for a stop band of -`stop_band_db`, of more than 50 dB."""
    return 0.1102 * (stop_band_db - 8.7)


def windowed_sinc(
    distance: FloatArray, cutoff: float, reach: float, beta: float, pedestal: float = 0.0
) -> FloatArray:
    """Weights of samples at a `distance` (…) in samples from the wanted moment; not normalised.

    `cutoff`, in cycles per sample, is where half the amplitude is left; `reach` is where the window
    ends. Kaiser's window is one there (and I_0(beta) in the middle): with that as `pedestal` taken
    off, a sample that comes into reach changes nothing.
    """
    inside = np.maximum(0.0, 1.0 - (distance / reach) ** 2)
    window = np.i0(beta * np.sqrt(inside)) - pedestal
    return np.asarray(np.sinc(2.0 * cutoff * distance) * window)
