"""The four accelerations as smooth functions of time on the model's grid.

All residuals of the model are below an eighth of its own rate M, so signals sampled at the sensors'
rate are first converted to M. A quintic spline through the samples gives velocity and displacement
by its antiderivatives and the jerk and its rates by its derivatives; samples that are too sparse
are first interpolated by a windowed sinc. All of these are then low-passed alike and decimated.
With the derivatives a channel can be shifted by a small delay without another interpolation, by
Taylor's series.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.splines import (
    Spline,
    antiderivative,
    curves_at,
    derivative,
    interpolating_spline,
)
from pre_core.kernels.windowed_sinc import kaiser_beta, windowed_sinc

Z, V, A, A_1, A_2, A_3 = range(6)
"""Indices of displacement, velocity, acceleration and its three derivatives."""

MODEL_RATE_HZ = 340.0
"""Highest rate of the model. Residuals up to 42 Hz have the same information on EI as those up to
125 Hz, within 3 % (docs/method-pre.md)."""
_RATE_SHARE = 2.0
"""Largest rate of the model relative to the slowest sensor (`PASS_BAND`, `_SENSOR_PASS`)."""
PASS_BAND, STOP = 0.215, 0.4
"""Pass and stop frequency relative to the model's rate."""
_SENSOR_PASS = 0.45
"""Pass band of the interpolation relative to a sensor's rate."""
INTERPOLATION_REACH = 32
"""Number of samples on each side of a time that `interpolate_at` needs."""
_BLOCK = 4096
"""Number of output samples interpolated at once, which bounds memory."""
_SPLINE_RATE_HZ = 800.0
"""Lowest rate of samples through which a quintic spline is exact to 1e-6 up to 70 Hz."""
_STOP_BAND_DB = 90.0
"""Stop band: the leakage is 3e-5 of a signal, below the 1e-4 error of a sine."""
_DEGREE = 5
"""Degree of the splines: delays use up to the third derivative, which is continuous for degree 5.
"""


class GainsAndDelays(NamedTuple):
    """Relative gain errors and delays in s of the four channels at k points, (k, 4) each."""

    gain: FloatArray
    delay_s: FloatArray


class ModelSignals(NamedTuple):
    """Signals (4, 6, n) on an even grid that begins `start_s` after the first sample."""

    start_s: float
    step_s: float
    signals: FloatArray


def channel_signals(
    acceleration_m_per_s2: FloatArray, step_s: float, slowest_rate_hz: float
) -> ModelSignals:
    """Return displacement, velocity, acceleration and its derivatives, from accelerations (4, n).

    `slowest_rate_hz` is that of the slowest sensor, if its samples were interpolated. Integrals are
    zero in the middle of the record, which minimises the effect of unknown initial values. Raise
    ValueError for a record shorter than the filters.
    """
    rate = 1.0 / step_s
    times = max(1, int(np.ceil(_SPLINE_RATE_HZ / rate - 1e-9)))
    fine, first = _interpolated(acceleration_m_per_s2, times)
    fine_rate = rate * times
    every = int(np.ceil(fine_rate / min(MODEL_RATE_HZ, _RATE_SHARE * slowest_rate_hz) - 1e-9))
    smooth = _derivatives(fine, 1.0 / fine_rate)
    model_rate = fine_rate / every
    taps = low_pass(PASS_BAND * model_rate / fine_rate, STOP * model_rate / fine_rate)
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
    """Return symmetric FIR taps (odd,) of unit sum, from a Kaiser window.

    `pass_share` and `stop_share` are the pass and stop frequency in cycles per sample.
    """
    width = stop_share - pass_share
    count = int(np.ceil((stop_band_db - 7.95) / (14.36 * width))) + 1
    count |= 1
    n = np.arange(count, dtype=np.float64) - count // 2
    cutoff = 0.5 * (pass_share + stop_share)
    taps = windowed_sinc(n, cutoff, count // 2 + 1, kaiser_beta(stop_band_db))
    return np.asarray(taps / taps.sum())


def _interpolated(samples: FloatArray, times: int) -> tuple[FloatArray, int]:
    """Return samples (4, n) at a rate `times` as high, and the number of the first kept one.

    Both ends, which the kernel does not cover, are removed.
    """
    if times == 1:
        return np.ascontiguousarray(samples), 0
    taps = times * low_pass(_SENSOR_PASS / times, (1.0 - _SENSOR_PASS) / times)
    sparse = np.zeros((samples.shape[0], times * (samples.shape[1] - 1) + 1))
    sparse[:, ::times] = samples
    if sparse.shape[1] < 2 * taps.size:
        raise ValueError("the record is shorter than the filters that it must pass")
    # Each phase of the kernel sums to one, which preserves a constant.
    for phase in range(times):
        taps[phase::times] /= taps[phase::times].sum()
    fine = np.stack([np.convolve(row, taps, mode="valid") for row in sparse])
    return fine, taps.size // 2


def interpolate_at(samples: FloatArray, place: FloatArray) -> FloatArray:
    """Return values (m,) of samples (n,) at `place` (m,), in steps from the first, by a sinc.

    The sinc is windowed; frequencies below 0.45 of the rate are unchanged. Values without enough
    samples on both sides (`INTERPOLATION_REACH`) are NaN.
    """
    beta = kaiser_beta(_STOP_BAND_DB)
    below = np.floor(place).astype(np.int64)
    offsets = np.arange(1 - INTERPOLATION_REACH, INTERPOLATION_REACH + 1)
    result = np.full(place.size, np.nan)
    inside = np.flatnonzero(
        (below >= INTERPOLATION_REACH - 1) & (below + INTERPOLATION_REACH < samples.size)
    )
    for begin in range(0, inside.size, _BLOCK):  # in blocks, to bound memory
        at = inside[begin : begin + _BLOCK]
        distance = offsets - (place[at] - below[at])[:, None]
        # The middle of the gap between the pass band and its image is half the rate.
        weight = windowed_sinc(distance, 0.5, INTERPOLATION_REACH, beta, pedestal=1.0)
        weight /= weight.sum(axis=1, keepdims=True)  # preserve a constant
        result[at] = np.einsum("mj,mj->m", weight, samples[below[at][:, None] + offsets])
    return result


def _derivatives(acceleration: FloatArray, step_s: float) -> FloatArray:
    """Return the six signals (4, 6, n) of a quintic spline through (4, n)."""
    n = acceleration.shape[1]
    t, middle = step_s * np.arange(n, dtype=np.float64), n // 2
    spline = interpolating_spline(t, acceleration.T, _DEGREE)
    velocity = _from_zero(antiderivative(spline), t[middle])
    displacement = _from_zero(antiderivative(velocity), t[middle])
    first = derivative(spline)
    second = derivative(first)
    z, v, a_1, a_2, a_3 = (
        curves_at(one, t).T for one in (displacement, velocity, first, second, derivative(second))
    )
    return np.stack([z, v, acceleration, a_1, a_2, a_3], axis=1)


def _from_zero(spline: Spline, x: float) -> Spline:
    """Return the curves minus their values at x."""
    return spline._replace(coefficients=spline.coefficients - curves_at(spline, np.array([x])))
