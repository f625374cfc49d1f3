"""What sensor noise does to the residuals, and how to make it white.

Three residuals are taken at every row, all as displacements: the mismatch of the two roads and the
two body equations divided by k_s. White acceleration noise of densities n_s, n_u enters them as

    s^2 R_i   : [1 + (m_u s^2 + c_s s + k_s)/k_u] n_u - [(c_s s + k_s)/k_u] n_s
    s^2 b_i   : [(m_ii s^2 + c_s s)/k_s + 1] n_s - [c_s s/k_s + 1] n_u

(front less rear in the mismatch). Rows are low-passed, decimated and differenced twice by one FIR
filter; the noise is then stationary with a covariance that vanishes beyond the filter's length, so
that a banded Cholesky factor whitens it exactly, ends included.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pre_core.parameters import C_S1, K_S1, K_U1, M_U1

FloatArray = NDArray[np.float64]

RESIDUALS = 3
_STOP_BAND_DB = 90.0
_TRANSITION = 0.5  # of the pass band
_ROWS_PER_CYCLE = 2.5  # decimated rate over the highest frequency that passes whole
_TABLE = 2048  # frequencies of the numerical integral over the noise spectrum


# Dot products may be summed in any order.
_blas = njit(fastmath={"contract", "nsz", "reassoc"}, cache=True, nogil=True, error_model="numpy")


class RowFilter(NamedTuple):
    """Low-pass, decimation and second difference in one: row k sees samples from k `every` on."""

    taps: FloatArray
    every: int
    step_s: float
    """Of the samples before the filter."""
    stop_hz: float
    """Nothing passes above it."""


class Whitener(NamedTuple):
    """Lower banded Cholesky factor of the noise covariance of the interleaved filtered rows."""

    factor: FloatArray  # (3 m, band + 1): row i holds columns i - band … i


def row_filter(step_s: float, highest_hz: float) -> RowFilter:
    """Pass what is below `highest_hz` whole; decimate to about two and a half times that."""
    from scipy.signal import firwin, kaiserord  # slow to import, seldom needed

    rate = 1.0 / step_s
    every = max(1, int(rate / (_ROWS_PER_CYCLE * highest_hz)))
    width = _TRANSITION * highest_hz
    count, beta = kaiserord(_STOP_BAND_DB, 2.0 * width / rate)
    count |= 1
    low_pass = firwin(count, highest_hz + 0.5 * width, window=("kaiser", beta), fs=rate)
    apart = every * step_s
    second_difference = np.zeros(2 * every + 1)
    second_difference[[0, every, 2 * every]] = np.array([1.0, -2.0, 1.0]) / apart**2
    stop = min(0.5 * rate, highest_hz + 2.0 * width)
    return RowFilter(np.convolve(low_pass, second_difference), every, step_s, stop)


def filtered(rows: RowFilter, residuals: FloatArray) -> FloatArray:
    """Filter (…, n) residuals to (…, m) rows; only rows that see no end of the record."""
    kept = (residuals.shape[-1] - rows.taps.size) // rows.every + 1
    flat = np.ascontiguousarray(residuals).reshape(-1, residuals.shape[-1])
    out = np.empty((flat.shape[0], kept))
    _filter(rows.taps, rows.every, flat, out)
    return out.reshape(*residuals.shape[:-1], kept)


@_blas
def _filter(taps: FloatArray, every: int, x: FloatArray, out: FloatArray) -> None:
    for r in range(x.shape[0]):
        for k in range(out.shape[1]):
            seen = x[r, k * every : k * every + taps.size]
            total = 0.0
            for j in range(taps.size):  # the taps are symmetric
                total += taps[j] * seen[j]
            out[r, k] = total


def _responses(
    theta: FloatArray, masses: tuple[float, float], omega: FloatArray
) -> NDArray[np.complex128]:
    """From the noise of channels s1, s2, u1, u2 to the residuals: (3, 4, f), displacements."""
    s = 1j * omega
    out = np.zeros((RESIDUALS, 4, omega.size), dtype=np.complex128)
    for w, sign in ((0, 1.0), (1, -1.0)):
        c, k = theta[C_S1 + w], theta[K_S1 + w]
        k_u, m_u = theta[K_U1 + w], theta[M_U1 + w]
        out[0, 2 + w] = sign * (1.0 + (m_u * s**2 + c * s + k) / k_u)
        out[0, w] = -sign * (c * s + k) / k_u
        out[1 + w, w] = (masses[w] * s**2 + c * s) / k + 1.0
        out[1 + w, 2 + w] = -(c * s / k + 1.0)
    return out


def whitener(
    rows: RowFilter,
    count: int,
    theta: FloatArray,
    masses_kg: tuple[float, float],
    density_m_per_s2_per_rthz: FloatArray,
) -> Whitener:
    """Factor for `count` filtered rows; `density` (4,) is one-sided, `masses` (m_11, m_22)."""
    frequency = (np.arange(_TABLE) + 0.5) * (rows.stop_hz / _TABLE)
    omega = np.asarray(2.0 * np.pi * frequency, dtype=np.float64)
    # All of it acts on accelerations, whose double integral is 1/omega^2: taps contain the second
    # difference, so that the product is finite at low frequencies.
    phase = np.exp(-1j * np.outer(omega * rows.step_s, np.arange(rows.taps.size)))
    transfer = np.abs(phase @ rows.taps) ** 2 / omega**4
    responses = _responses(theta, masses_kg, omega)
    weighted = responses * (density_m_per_s2_per_rthz**2)[None, :, None]
    spectrum = np.einsum("icf,jcf->ijf", weighted, responses.conj()) * transfer
    lags = (rows.taps.size - 1) // rows.every
    apart = rows.every * rows.step_s
    turn = np.exp(1j * np.outer(omega * apart, np.arange(lags + 1)))
    df = float(frequency[1] - frequency[0])
    covariance = np.real(spectrum @ turn) * df  # of a one-sided density: E[e_i(t + lag) e_j(t)]
    band = RESIDUALS * (lags + 1) - 1
    banded = np.zeros((RESIDUALS * count, band + 1))
    for lag in range(min(lags, count - 1) + 1):
        for i in range(RESIDUALS):
            for j in range(RESIDUALS):
                offset = RESIDUALS * lag + i - j  # row (k + lag, i) against column (k, j)
                if 0 <= offset <= band:
                    banded[RESIDUALS * lag + i :: RESIDUALS, band - offset] = covariance[i, j, lag]
    banded[:, band] *= 1.0 + 1e-10
    if not _cholesky(banded):
        raise ValueError("the noise covariance is not positive: are all densities above zero?")
    return Whitener(banded)


@_blas
def _cholesky(a: FloatArray) -> bool:
    """Factor a banded symmetric matrix (n, band + 1), lower rows, in place."""
    n, width = a.shape
    band = width - 1
    for i in range(n):
        for j in range(max(0, i - band), i + 1):
            low = max(0, i - band)  # columns before it are zero in row i
            total = a[i, j - i + band]
            x = a[i, low - i + band : j - i + band]
            y = a[j, low - j + band : band]
            for k in range(x.size):
                total -= x[k] * y[k]
            if i == j:
                if not total > 0.0:
                    return False
                a[i, band] = np.sqrt(total)
            else:
                a[i, j - i + band] = total / a[j, band]
    return True


@_blas
def _solve(factor: FloatArray, rows: FloatArray) -> None:
    """Forward substitution in place for each of the right-hand sides `rows` (k, n)."""
    n, width = factor.shape
    band = width - 1
    for r in range(rows.shape[0]):
        b = rows[r]
        for i in range(n):
            low = max(0, i - band)
            x = factor[i, low - i + band : band]
            y = b[low:i]
            total = b[i]
            for k in range(x.size):
                total -= x[k] * y[k]
            b[i] = total / factor[i, band]


def whiten(noise: Whitener, rows: FloatArray) -> FloatArray:
    """White rows (k, 3 m) of filtered residuals (k, 3, m)."""
    interleaved = np.ascontiguousarray(np.moveaxis(rows, 1, 2)).reshape(rows.shape[0], -1)
    white = interleaved.copy() if interleaved.base is rows else interleaved
    _solve(noise.factor, white)
    return white
