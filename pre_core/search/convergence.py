"""Convergence of several chains of draws: split R-hat and effective sample size.

Gelman et al., Bayesian Data Analysis (3rd edition), sections 11.4 and 11.5.
"""

import numpy as np

from pre_core.arrays import FloatArray

CHAINS = 8
"""Number of chains; `split_r_hat` compares their sixteen halves."""


def split_r_hat(draws: FloatArray) -> FloatArray:
    """Return split R-hat (f,) of draws (n, c, f); infinite for fewer than four draws a chain."""
    half = draws.shape[0] // 2
    if half < 2:
        return np.full(draws.shape[2], np.inf)
    parts = np.concatenate([draws[:half], draws[half : 2 * half]], axis=1)
    within = parts.var(axis=0, ddof=1).mean(axis=0)
    between = half * parts.mean(axis=0).var(axis=0, ddof=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(((half - 1) / half * within + between / half) / within)
    return np.asarray(np.where(within > 0.0, ratio, 1.0))


def effective_sample_size(draws: FloatArray) -> FloatArray:
    """Return the effective number (f,) of draws (n, c, f): Geyer's initial positive sequence."""
    n, chains, f = draws.shape
    centred = draws - draws.mean(axis=(0, 1))
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(centred, size, axis=0)
    autocovariance = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[:n].mean(axis=1) / n
    ess = np.empty(f)
    for j in range(f):
        if autocovariance[0, j] <= 0.0:
            ess[j] = n * chains
            continue
        rho = autocovariance[:, j] / autocovariance[0, j]
        pairs = rho[: 2 * (n // 2)].reshape(-1, 2).sum(axis=1)
        negative = np.flatnonzero(pairs < 0.0)
        stop = negative[0] if negative.size else pairs.size
        tau = max(2.0 * float(np.minimum.accumulate(pairs[:stop]).sum()) - 1.0, 1.0 / (n * chains))
        ess[j] = n * chains / tau
    return ess
