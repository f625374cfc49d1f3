"""The four accelerations as smooth functions of time on the grid of the model.

All that the model compares lies below an eighth of its own rate M, so that signals sampled at the
sensors' rate are first brought to M. A quintic spline through the samples gives velocity and
displacement by its antiderivatives and the jerk and its rates by its derivatives; samples that are
too few for that are interpolated by a windowed sinc before. All of these are then low-passed alike
and decimated. With the derivatives a channel can be moved by a small delay without interpolating it
anew, by Taylor's series.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.splines import Spline, curves_at, integrals, slopes, through
from pre_core.kernels.windowed_sinc import kaiser_beta, windowed_sinc

FloatArray = NDArray[np.float64]

Z, V, A, A_1, A_2, A_3 = range(6)
"""Places of displacement, velocity, acceleration and its three derivatives."""

MODEL_RATE_HZ = 340.0
"""Highest rate of the model. Rows up to 42 Hz tell within 3 % as much of EI as rows up to 125 Hz
(docs/method-pre.md)."""
_RATE_SHARE = 2.0
"""The model is no quicker than this many times the slowest sensor (`PASS`, `_SENSOR_PASS`)."""
PASS, STOP = 0.215, 0.4
"""Shares of the model's rate: signals below the first pass whole, above the second nothing is
left."""
_SENSOR_PASS = 0.45
"""Up to this share of a sensor's rate its samples are interpolated as they are."""
SEEN_ASIDE = 32
"""Samples on each side of a moment that `read_between` needs."""
_BLOCK = 4096
"""Output samples that are interpolated at once, to bound memory."""
_SPLINE_RATE_HZ = 800.0
"""A quintic spline through samples at this rate is good to 1e-6 up to 70 Hz."""
_STOP_BAND_DB = 90.0
"""What leaks through at this depth is 3e-5 of a signal, below the 1e-4 that a sine comes out right
to."""
_DEGREE = 5
"""Delays are undone with up to the third derivative, which of a quintic spline has no jumps."""


class ModelSignals(NamedTuple):
    """`signals` (4, 6, n) on an even grid that begins `start_s` after the first sample."""

    start_s: float
    step_s: float
    signals: FloatArray


def channel_signals(
    acceleration_m_per_s2: FloatArray, step_s: float, slowest_rate_hz: float
) -> ModelSignals:
    """Displacement, velocity, acceleration and its three derivatives of samples (4, n).

    `slowest_rate_hz` is that of the slowest sensor, where its samples were interpolated. Integrals
    begin at zero in the middle of the record, so that what unknown initial values add is as small
    as can be. Raises ValueError for a record shorter than the filters.
    """
    rate = 1.0 / step_s
    times = max(1, int(np.ceil(_SPLINE_RATE_HZ / rate - 1e-9)))
    fine, first = _interpolated(acceleration_m_per_s2, times)
    fine_rate = rate * times
    every = int(np.ceil(fine_rate / min(MODEL_RATE_HZ, _RATE_SHARE * slowest_rate_hz) - 1e-9))
    smooth = _derivatives(fine, 1.0 / fine_rate)
    model_rate = fine_rate / every
    taps = low_pass(PASS * model_rate / fine_rate, STOP * model_rate / fine_rate)
    n = smooth.shape[2]
    count = (n - taps.size) // every + 1
    if count < 2:
        raise ValueError("the record is shorter than the filters that it must pass")
    kept = taps.size // 2 + every * np.arange(count)
    out = np.empty((*smooth.shape[:2], count))
    for channel in range(smooth.shape[0]):
        for order in range(smooth.shape[1]):
            windows = np.lib.stride_tricks.sliding_window_view(smooth[channel, order], taps.size)
            out[channel, order] = windows[::every][:count] @ taps
    # Kept sample 0 is `kept[0]` fine samples after the first fine one, which may lie later than the
    # first sample of the sensor.
    start = (first + kept[0]) / fine_rate
    return ModelSignals(float(start), every / fine_rate, out)


def low_pass(
    pass_share: float, stop_share: float, stop_band_db: float = _STOP_BAND_DB
) -> FloatArray:
    """Symmetrical taps (odd number) of unit sum; shares are cycles per sample (Kaiser's window)."""
    width = stop_share - pass_share
    count = int(np.ceil((stop_band_db - 7.95) / (14.36 * width))) + 1
    count |= 1
    n = np.arange(count, dtype=np.float64) - count // 2
    cutoff = 0.5 * (pass_share + stop_share)
    taps = windowed_sinc(n, cutoff, count // 2 + 1, kaiser_beta(stop_band_db))
    return np.asarray(taps / taps.sum())


def _interpolated(samples: FloatArray, times: int) -> tuple[FloatArray, int]:
    """Samples (4, n) interpolated to a rate `times` as high; the number of the first that is kept.

    What an interpolating kernel cannot see whole at both ends is left out.
    """
    if times == 1:
        return np.ascontiguousarray(samples), 0
    taps = times * low_pass(_SENSOR_PASS / times, (1.0 - _SENSOR_PASS) / times)
    sparse = np.zeros((samples.shape[0], times * (samples.shape[1] - 1) + 1))
    sparse[:, ::times] = samples
    if sparse.shape[1] < 2 * taps.size:
        raise ValueError("the record is shorter than the filters that it must pass")
    # Each of the phases of the kernel sums to one, so that a constant stays what it is.
    for phase in range(times):
        taps[phase::times] /= taps[phase::times].sum()
    fine = np.stack([np.convolve(row, taps, mode="valid") for row in sparse])
    return fine, taps.size // 2


def read_between(samples: FloatArray, place: FloatArray) -> FloatArray:
    """Samples (n,) read at `place` (m,), in samples from the first: a windowed sinc.

    What lies below 0.45 of the rate is read as it is. NaN where the sinc does not see enough
    samples on both sides (`SEEN_ASIDE`).
    """
    beta = kaiser_beta(_STOP_BAND_DB)
    below = np.floor(place).astype(np.int64)
    offsets = np.arange(1 - SEEN_ASIDE, SEEN_ASIDE + 1)
    result = np.full(place.size, np.nan)
    inside = np.flatnonzero((below >= SEEN_ASIDE - 1) & (below + SEEN_ASIDE < samples.size))
    for begin in range(0, inside.size, _BLOCK):  # in blocks, to bound memory
        at = inside[begin : begin + _BLOCK]
        distance = offsets - (place[at] - below[at])[:, None]
        # The middle of the gap between the pass band and its image is half the rate.
        weight = windowed_sinc(distance, 0.5, SEEN_ASIDE, beta, pedestal=1.0)
        weight /= weight.sum(axis=1, keepdims=True)  # a constant stays what it is
        result[at] = np.einsum("mj,mj->m", weight, samples[below[at][:, None] + offsets])
    return result


def _derivatives(acceleration: FloatArray, step_s: float) -> FloatArray:
    """The six signals (4, 6, n) of a quintic spline through (4, n)."""
    n = acceleration.shape[1]
    t, middle = step_s * np.arange(n, dtype=np.float64), n // 2
    spline = through(t, acceleration.T, _DEGREE)
    velocity = _from_zero(integrals(spline), t[middle])
    displacement = _from_zero(integrals(velocity), t[middle])
    first = slopes(spline)
    second = slopes(first)
    z, v, a_1, a_2, a_3 = (
        curves_at(one, t).T for one in (displacement, velocity, first, second, slopes(second))
    )
    return np.stack([z, v, acceleration, a_1, a_2, a_3], axis=1)


def _from_zero(spline: Spline, x: float) -> Spline:
    """The curves less what they are at x."""
    return spline._replace(coefficients=spline.coefficients - curves_at(spline, np.array([x])))
