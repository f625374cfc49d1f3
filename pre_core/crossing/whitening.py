"""Whitening: the banded Cholesky factor of the noise covariance, and its application to residuals.

The residuals' noise (`crossing.noise`) is stationary with a covariance that vanishes beyond the
filter's length and the noise's own correlation time, so a banded factor whitens it exactly, ends
included.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import mismatch as _mismatch
from pre_core.crossing.lines import project_out
from pre_core.crossing.mismatch import Mismatch
from pre_core.crossing.noise import NoisePath, noise_spectrum
from pre_core.crossing.rows import RESIDUALS, RowFilter, filter_rows, phases
from pre_core.crossing.suspension_noise import FORCE_MEMORY_S
from pre_core.kernels.lanes import summing

_SETTLED = 1e-12
"""Relative change below which rows of the factor repeat to rounding."""
_RIDGES = (1e-10, 1e-7, 1e-5, 1e-3)
"""Relative white noise added against rounding; more where the profiles of a truck that is not yet
found differ so much that sensor noise is lost in the covariance's rounding."""


class Whitener(NamedTuple):
    """Lower banded Cholesky factor of the noise covariance of interleaved filtered residuals."""

    factor: FloatArray  # (3 m, band + 1): row i holds columns i - band … i
    reciprocal: FloatArray  # (3 m,) of the diagonal
    lines: FloatArray = np.zeros((0, 0))
    """(3 m, w) orthonormal columns that are removed from white residuals, see `lines`."""
    low_rank: FloatArray = np.zeros((0, 0))
    """(3 m, k) columns C that make w - C C'w white, see `front_axle`."""


def project_out_noise(noise: Whitener, white: FloatArray) -> FloatArray:
    """Return white residuals (k, 3 m) without the removed lines, whitened for noise of low rank."""
    for columns in (noise.lines, noise.low_rank):
        if columns.size:
            white = project_out(columns, white)
    return white


def whitener(
    rows: RowFilter,
    count: int,
    truck: NoisePath,
    density: FloatArray,
    force: FloatArray,
    mismatch: Mismatch | None = None,
) -> Whitener:
    """Return the factor for `count` filtered residuals; `density` (4,) is one-sided, in m/s²/√Hz.

    `force` (2, shapes) is the suspension noise in N²/Hz (`no_suspension_noise` without any).
    Raise ValueError where the densities leave some residual without noise, or if the mismatch on
    the bridge is that of another number of residuals.
    """
    has_pavement = mismatch is not None and mismatch.pavement is not None
    everywhere = None if has_pavement else mismatch
    spectrum = noise_spectrum(truck, density, force, everywhere, rows.omega) * rows.power
    memory = FORCE_MEMORY_S + truck.lag_s if force.any() else 0.0
    if mismatch is not None:
        memory = max(memory, _mismatch.correlation_time_s(mismatch))
    turn = phases(rows, memory)
    covariance = np.real(spectrum @ turn)  # E[e_i(t + lag) e_j(t)]
    lags = covariance.shape[2]
    band = RESIDUALS * lags - 1
    one = np.zeros((RESIDUALS, band + 1))
    for lag in range(lags):
        for i in range(RESIDUALS):
            for j in range(RESIDUALS):
                offset = RESIDUALS * lag + i - j  # row (k + lag, i) against column (k, j)
                if 0 <= offset <= band:
                    one[i, band - offset] = covariance[i, j, lag]
    differing, weight = np.zeros((0, lags)), np.zeros((0, count))
    if mismatch is not None and mismatch.pavement is not None:
        differing, weight = _off_and_on_bridge(mismatch, rows, turn)
        if weight.shape[1] != count:
            raise ValueError(f"the pavement is that of {weight.shape[1]} residuals, not {count}")
    diagonal = one[:, band].copy()
    for more in _RIDGES:
        one[:, band] = diagonal * (1.0 + more)
        ridged = differing.copy()
        ridged[:, 0] *= 1.0 + more
        factor = np.zeros((RESIDUALS * count, band + 1))
        if _cholesky(one, ridged, weight, factor):
            return Whitener(factor, 1.0 / factor[:, band])
    raise ValueError("the noise covariance is not positive: are all densities above zero?")


def _off_and_on_bridge(
    mismatch: Mismatch, rows: RowFilter, turn: NDArray[np.complex128]
) -> tuple[FloatArray, FloatArray]:
    """Return the autocovariances (2, lags) of the mismatch off and on the bridge, and weights.

    The mismatch of a filtered residual is the sum of two independent ones with weights (2, m).
    """
    if mismatch.pavement is None:
        raise ValueError("the bridge has the road's pavement")
    both = np.stack(
        [_mismatch.spectrum(one, rows.omega) for one in (mismatch, _mismatch.on_bridge(mismatch))]
    )
    share = mismatch.pavement.share
    covariance = np.ascontiguousarray(((both * rows.omega**4 * rows.power) @ turn).real)
    return covariance, np.sqrt(np.stack([1.0 - share, share]))


@summing
def _cholesky(one: FloatArray, differing: FloatArray, weight: FloatArray, a: FloatArray) -> bool:
    """Factor a banded covariance into `a` (n, band + 1); it repeats the rows `one` (3, band + 1).

    Covariances `differing` (k, lags) with weights (k, m) are added to the first kind of rows. Rows
    of the factor converge to rows that repeat too; from there on they are copied until the weights
    change. Return False if the covariance is not positive definite.
    """
    n, width = a.shape
    band = width - 1
    kinds = one.shape[0]
    settled = False
    for i in range(n):
        group = i // kinds
        if settled and i % kinds == 0:
            for p in range(weight.shape[0]):
                if weight[p, group] != weight[p, group - 1]:
                    settled = False
        if settled:
            for j in range(width):
                a[i, j] = a[i - kinds, j]
            continue
        change = 0.0
        for j in range(max(0, i - band), i + 1):
            low = max(0, i - band)  # columns before it are zero in row i
            total = one[i % kinds, j - i + band]
            if i % kinds == 0 and j % kinds == 0:
                for p in range(weight.shape[0]):
                    both = weight[p, group] * weight[p, j // kinds]
                    total += both * differing[p, group - j // kinds]
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
        if i >= band + kinds and i % kinds == kinds - 1:
            for back in range(kinds):
                for j in range(width):
                    step = a[i - back, j] - a[i - back - kinds, j]
                    change = max(change, abs(step) / a[i - back, band])
            settled = change < _SETTLED
    return True


@summing
def solve(factor: FloatArray, reciprocal: FloatArray, b: FloatArray) -> None:
    """Forward-substitute one right-hand side b (n,) in place."""
    n, width = factor.shape
    band = width - 1
    for i in range(n):
        low = max(0, i - band)
        x = factor[i, low - i + band : band]
        y = b[low:i]
        total = b[i]
        for k in range(x.size):
            total -= x[k] * y[k]
        b[i] = total * reciprocal[i]


@summing
def solve_transposed(factor: FloatArray, reciprocal: FloatArray, b: FloatArray) -> None:
    """Back-substitute one right-hand side b (n,) of the transposed factor in place."""
    n, width = factor.shape
    band = width - 1
    for i in range(n - 1, -1, -1):
        value = b[i] * reciprocal[i]
        b[i] = value
        low = max(0, i - band)
        x = factor[i, low - i + band : band]
        y = b[low:i]
        for k in range(x.size):
            y[k] -= x[k] * value


@summing
def whiten_into(
    rows: RowFilter, noise: Whitener, residuals: FloatArray, row: FloatArray, out: FloatArray
) -> None:
    """Filter and interleave residuals (3, n), and whiten them to `out` (3 m,).

    `row` (m,) is a work array.
    """
    for i in range(RESIDUALS):
        filter_rows(rows.taps, rows.every, residuals[i], row)
        for k in range(row.size):
            out[RESIDUALS * k + i] = row[k]
    solve(noise.factor, noise.reciprocal, out)
