"""Kaiser-windowed sinc: low-pass, interpolation and delay of evenly spaced samples in one.

Oppenheim and Schafer, Discrete-Time Signal Processing, section 7.5.3. Between pass band and stop
band such a filter needs a transition of (A - 7.95)/(14.36 (taps - 1)) cycles per sample for a stop
band of -A dB.
"""

import numpy as np

from pre_core.arrays import FloatArray


def kaiser_beta(stop_band_db: float) -> float:
    """Return the window's parameter beta for a stop band of -`stop_band_db`, 50 dB or more."""
    return 0.1102 * (stop_band_db - 8.7)


def windowed_sinc(
    distance: FloatArray, cutoff: float, reach: float, beta: float, pedestal: float = 0.0
) -> FloatArray:
    """Return the weights (…) of samples at a `distance` (…) in samples from the wanted time.

    They are not normalised. `cutoff`, in cycles per sample, is the frequency of half amplitude; the
    window ends at `reach` samples. The window is I_0(beta) in the middle and 1 at its ends: a
    `pedestal` of 1 is subtracted to avoid a jump where a sample comes into reach.
    """
    inside = np.maximum(0.0, 1.0 - (distance / reach) ** 2)
    window = np.i0(beta * np.sqrt(inside)) - pedestal
    return np.asarray(np.sinc(2.0 * cutoff * distance) * window)
