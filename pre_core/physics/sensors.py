"""Models of an accelerometer and a GNSS receiver.

An accelerometer's chain, in this order: gain and bias, low-pass and sampling at the output rate
(late by the delay), white and pink noise, saturation, quantisation. Noise is declared as the
one-sided amplitude density d in ug/sqrt(Hz) with a corner frequency f_c: its power density is

    S(f) = (d g 1e-6)^2 (1 + f_c/f),

so white noise at the output rate f_s has the standard deviation d sqrt(f_s/2).
"""

from itertools import accumulate
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.kernels.windowed_sinc import kaiser_beta, windowed_sinc

_STOP_BAND_DB = 90.0
_PASS_SHARE = 0.8  # pass band of the anti-aliasing filter, relative to half the output rate
_SMALLEST_HALF_LENGTH = 48  # input samples to either side in the interpolation kernel
_BLOCK = 2048  # output samples interpolated at once, to bound memory


class Accelerometer(NamedTuple):
    """One channel of an accelerometer; by default a perfect one that samples at `rate_hz`."""

    rate_hz: float
    noise_density_ug_per_rthz: float = 0.0
    pink_corner_hz: float = 0.0
    """Frequency at which 1/f noise has the power of the white noise."""
    bias_m_per_s2: float = 0.0
    gain_error: float = 0.0
    """Relative error: 0.01 reads 1 % too high."""
    delay_s: float = 0.0
    """Delay: a sample stamped t shows the acceleration at t - delay."""
    quantisation_m_per_s2: float = 0.0
    range_m_per_s2: float = np.inf
    """Largest reading, plus or minus."""


class ReceiverModel(NamedTuple):
    """A GNSS receiver; chainage and lateral position have equal, independent errors."""

    rate_hz: float
    position_noise_m: float = 0.0
    """Standard deviation of the white error of each fix."""
    position_spread_m: float = 0.0
    """Standard deviation of the slowly varying error (a Gauss-Markov process)."""
    correlation_s: float = np.inf
    """Time in which the slow error decorrelates to 1/e; infinite: a constant bias."""
    speed_noise_m_per_s: float = 0.0
    latency_s: float = 0.0
    """Latency: a fix stamped t shows the position at t - latency."""
    outages_s: tuple[tuple[float, float], ...] = ()
    """Time intervals without fixes, first included and last excluded."""


class SimulatedFixes(NamedTuple):
    """Fixes of a receiver model, (m,) each."""

    time_s: FloatArray
    chainage_m: FloatArray
    lateral_m: FloatArray
    speed_m_per_s: FloatArray


def measure_acceleration(
    acceleration_m_per_s2: FloatArray,
    rate_hz: float,
    sensor: Accelerometer,
    rng: np.random.Generator,
) -> FloatArray:
    """Return the readings (m,) of `sensor` for an acceleration (n,) sampled at `rate_hz`.

    Sample k is stamped k/sensor.rate_hz after the first input sample; the last does not lie beyond
    the last input sample. Before its first sample the input is constant. Raise ValueError for a
    sensor that is faster than its input.
    """
    if sensor.rate_hz > rate_hz * (1.0 + 1e-9):
        raise ValueError(
            f"a sensor of {sensor.rate_hz:g} Hz cannot be fed with samples at {rate_hz:g} Hz"
        )
    reading = resample(acceleration_m_per_s2, rate_hz, sensor.rate_hz, sensor.delay_s)
    reading = (1.0 + sensor.gain_error) * reading + sensor.bias_m_per_s2
    density = sensor.noise_density_ug_per_rthz * MICRO_G_M_PER_S2
    reading += white_noise(reading.size, sensor.rate_hz, density, rng)
    reading += pink_noise(reading.size, sensor.rate_hz, density, sensor.pink_corner_hz, rng)
    reading = np.clip(reading, -sensor.range_m_per_s2, sensor.range_m_per_s2)
    step = sensor.quantisation_m_per_s2
    return np.asarray(step * np.round(reading / step) if step > 0.0 else reading)


def resample(samples: FloatArray, rate_hz: float, new_rate_hz: float, delay_s: float) -> FloatArray:
    """Low-pass `samples` (n,) and evaluate them at times k/new_rate - delay: (m,).

    A windowed sinc in continuous time (Kaiser, 90 dB) is anti-aliasing filter, interpolation and
    delay in one. For a lower rate it passes frequencies up to 0.4 of the new rate and stops those
    from 0.5; at the same rate nothing is filtered. Its own delay is zero. Beyond its ends the
    signal is constant.
    """
    count = int(np.floor((samples.size - 1) * new_rate_hz / rate_hz + 1e-9)) + 1
    position = np.arange(count) * (rate_hz / new_rate_hz) - delay_s * rate_hz  # in input samples
    if new_rate_hz >= rate_hz * (1.0 - 1e-9):
        if delay_s == 0.0:
            return samples.copy()
        cutoff = 0.5  # cycles per input sample
        half_length = _SMALLEST_HALF_LENGTH
    else:
        stop = 0.5 * new_rate_hz / rate_hz
        width = (1.0 - _PASS_SHARE) * stop
        cutoff = stop - 0.5 * width
        taps = (_STOP_BAND_DB - 7.95) / (2.285 * 2.0 * np.pi * width)  # Kaiser's formula
        half_length = max(_SMALLEST_HALF_LENGTH, int(np.ceil(taps / 2.0)))
    beta = kaiser_beta(_STOP_BAND_DB)
    offsets = np.arange(1 - half_length, half_length + 1)
    before = int(np.floor(position[0])) + 1 - half_length
    behind = int(np.floor(position[-1])) + half_length
    constant = samples[np.clip(np.arange(before, behind + 1), 0, samples.size - 1)]
    around = np.lib.stride_tricks.sliding_window_view(constant, offsets.size)
    result = np.empty(count)
    for begin in range(0, count, _BLOCK):
        wanted = position[begin : begin + _BLOCK]
        first = np.floor(wanted).astype(np.int64)
        # At most rates the samples have few different phases between the input samples.
        place, which = np.unique(np.round(wanted - first, 9), return_inverse=True)
        distance = offsets - place[:, None]
        weight = windowed_sinc(distance, cutoff, half_length, beta)
        weight /= weight.sum(axis=1, keepdims=True)  # preserve a constant
        values = around[first + (1 - half_length - before)]  # one copy of all rows
        result[begin : begin + _BLOCK] = np.einsum("mj,mj->m", weight[which], values)
    return result


def white_noise(count: int, rate_hz: float, density: float, rng: np.random.Generator) -> FloatArray:
    """Return white noise (count,) of the one-sided amplitude density in unit/sqrt(Hz)."""
    return density * np.sqrt(0.5 * rate_hz) * rng.standard_normal(count)


def pink_noise(
    count: int, rate_hz: float, density: float, corner_hz: float, rng: np.random.Generator
) -> FloatArray:
    """Return noise (count,) of the one-sided power density density^2 corner/f.

    It is composed of random harmonics over twice the time and cut in half, so that it is not
    periodic. It has no power below the lowest harmonic.
    """
    if corner_hz <= 0.0 or density <= 0.0:
        return np.zeros(count)
    length = 2 * count
    frequency = np.fft.rfftfreq(length, 1.0 / rate_hz)
    power = np.zeros_like(frequency)
    power[1:] = density**2 * corner_hz / frequency[1:]
    parts = rng.standard_normal((2, frequency.size))
    # A one-sided density S gives each line of an rfft the mean square S rate length / 2.
    lines = np.sqrt(0.25 * power * rate_hz * length) * (parts[0] + 1j * parts[1])
    lines[-1] = np.sqrt(0.5 * power[-1] * rate_hz * length) * parts[0, -1]
    return np.asarray(np.fft.irfft(lines, length)[:count])


def gauss_markov(
    time_s: FloatArray, spread: float, correlation_s: float, rng: np.random.Generator
) -> FloatArray:
    """Return a stationary Gauss-Markov process (n,) at evenly spaced times (n,).

    e_k = phi e_(k-1) + sqrt(1 - phi^2) w_k, phi = exp(-dt/correlation): its standard deviation is
    `spread` and its autocorrelation exp(-|t|/correlation). An infinite correlation time gives a
    constant.
    """
    draws = spread * rng.standard_normal(time_s.size)
    if time_s.size < 2:
        return draws
    phi = float(np.exp(-(time_s[1] - time_s[0]) / correlation_s))
    innovations = np.sqrt(1.0 - phi**2) * draws
    innovations[0] = draws[0]
    # scipy.signal has this filter, too, and takes longer to import than a drive to simulate.
    values = accumulate(innovations.tolist(), lambda last, new: phi * last + new)
    return np.fromiter(values, dtype=np.float64, count=innovations.size)


def measure_position(
    time_s: FloatArray,
    chainage_m: FloatArray,
    lateral_m: FloatArray,
    speed_m_per_s: FloatArray,
    receiver: ReceiverModel,
    rng: np.random.Generator,
) -> SimulatedFixes:
    """Return the fixes of `receiver` on a drive given at increasing times (n,).

    Stamps are every 1/rate from the first time on; a fix whose true time, stamp minus latency, is
    outside the drive is omitted. Random errors continue during an outage, so that an outage changes
    no other fix.
    """
    count = int(np.floor((time_s[-1] - time_s[0]) * receiver.rate_hz + 1e-9)) + 1
    stamp = time_s[0] + np.arange(count) / receiver.rate_hz
    true = stamp - receiver.latency_s

    def position(truth: FloatArray) -> FloatArray:
        slow = gauss_markov(stamp, receiver.position_spread_m, receiver.correlation_s, rng)
        white = receiver.position_noise_m * rng.standard_normal(count)
        return np.interp(true, time_s, truth) + slow + white

    chainage = position(chainage_m)
    lateral = position(lateral_m)
    speed = np.interp(true, time_s, speed_m_per_s)
    speed += receiver.speed_noise_m_per_s * rng.standard_normal(count)
    kept = (true >= time_s[0] - 1e-9) & (true <= time_s[-1] + 1e-9)
    for start, stop in receiver.outages_s:
        kept &= (stamp < start) | (stamp >= stop)
    return SimulatedFixes(stamp[kept], chainage[kept], lateral[kept], speed[kept])
