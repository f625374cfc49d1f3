"""Filtered residuals (`rows`): low-passed, decimated and differenced twice by one FIR filter.

White noise of an acceleration is then stationary, with a covariance that vanishes beyond the
filter's length.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.channels import low_pass
from pre_core.kernels.lanes import summing

RESIDUALS = 3
SAMPLES_PER_RESIDUAL = 3
"""Samples of the model per residual."""
PASS_BAND = 1.0 / 8.0
"""Pass band relative to the model's rate; half amplitude at half the residuals' rate."""
_STOP_BAND_DB = 70.0
"""Stop band: the leakage is 3e-4 of a signal, which must not alias in the decimation."""
_TABLE = 1024  # frequencies of the numerical integral over the noise spectrum


class RowFilter(NamedTuple):
    """Low-pass, decimation and second difference in one: output k begins at sample k * `every`."""

    taps: FloatArray
    every: int
    step_s: float
    """Step of the samples before the filter."""
    omega: FloatArray  # (f,) midpoints of even intervals of angular frequency, to the stop band
    power: FloatArray  # (f,) from white noise of an acceleration to the rows, times the interval
    turn: NDArray[np.complex128]  # (f, lags) phase factors at each lag between residuals


def row_filter(step_s: float) -> RowFilter:
    """Return the filter that passes frequencies up to `PASS_BAND` of the model's rate."""
    stop = 1.0 / SAMPLES_PER_RESIDUAL - PASS_BAND
    apart = SAMPLES_PER_RESIDUAL * step_s
    second_difference = np.zeros(2 * SAMPLES_PER_RESIDUAL + 1)
    second_difference[[0, SAMPLES_PER_RESIDUAL, 2 * SAMPLES_PER_RESIDUAL]] = (
        np.array([1.0, -2.0, 1.0]) / apart**2
    )
    taps = np.convolve(low_pass(PASS_BAND, stop, _STOP_BAND_DB), second_difference)
    interval = 1.1 * stop / step_s / _TABLE
    omega = 2.0 * np.pi * interval * (np.arange(_TABLE) + 0.5)
    # The taps are symmetric: their response is real except for a delay.
    offsets = np.arange(taps.size) - taps.size // 2
    response = np.cos(np.outer(omega * step_s, offsets)) @ taps
    # Noise of an acceleration reaches displacements through 1/omega^2; the taps contain the second
    # difference, so that the product is finite at low frequencies.
    power = response**2 / omega**4 * interval
    lags = (taps.size - 1) // SAMPLES_PER_RESIDUAL + 1
    turn = np.exp(1j * np.outer(omega * apart, np.arange(lags)))
    return RowFilter(taps, SAMPLES_PER_RESIDUAL, step_s, np.asarray(omega), power, turn)


def row_count(rows: RowFilter, samples: int) -> int:
    """Return the number of filtered residuals that lie completely within `samples` samples."""
    return max(0, (samples - rows.taps.size) // rows.every + 1)


@summing
def filter_rows(taps: FloatArray, every: int, x: FloatArray, out: FloatArray) -> None:
    """Filter x (n,) to out (m,); the taps (odd,) are symmetric."""
    for k in range(out.size):
        seen = x[k * every : k * every + taps.size]
        total = 0.0
        for j in range(taps.size):
            total += taps[j] * seen[j]
        out[k] = total


def filter_adjoint(rows: RowFilter, y: FloatArray, samples: int) -> FloatArray:
    """Return the adjoint of `filter_rows`, from values y (m,) to `samples` values (n,)."""
    apart = np.zeros(rows.every * (y.size - 1) + 1)
    apart[:: rows.every] = y
    out = np.zeros(samples)
    out[: apart.size + rows.taps.size - 1] = np.convolve(apart, rows.taps)
    return out


def autocovariances(rows: RowFilter, spectra: FloatArray, lags: int) -> FloatArray:
    """Return autocovariances (…, lags) of filtered residuals from spectra (…, f) of accelerations.

    The spectra are one-sided, at the frequencies of `rows`.
    """
    apart_s = rows.every * rows.step_s
    waves = np.cos(np.outer(rows.omega * apart_s, np.arange(lags)))
    return np.asarray((spectra * rows.power) @ waves)


def phases(rows: RowFilter, memory_s: float) -> NDArray[np.complex128]:
    """Return phases (f, lags) between residuals, for noise of correlation time `memory_s` in s."""
    if memory_s == 0.0:
        return rows.turn
    apart = rows.every * rows.step_s
    first = rows.turn.shape[1]
    more = np.arange(first, first + int(np.ceil(memory_s / apart)))
    return np.concatenate([rows.turn, np.exp(1j * np.outer(rows.omega * apart, more))], axis=1)
