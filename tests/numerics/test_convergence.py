"""Effective sample size and R-hat of chains of known correlation."""

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.search import convergence


def autoregressive(phi: float, n: int, chains: int, seed: int = 0) -> FloatArray:
    """Chains (n, c, 1) with the autocorrelation phi^lag and variance 1."""
    rng = np.random.default_rng(seed)
    x = np.empty((n, chains, 1))
    x[0] = rng.standard_normal((chains, 1))
    for i in range(1, n):
        x[i] = phi * x[i - 1] + np.sqrt(1.0 - phi**2) * rng.standard_normal((chains, 1))
    return x


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9, -0.4])
def test_effective_sample_size_of_known_autocorrelation(phi: float) -> None:
    """n (1 - phi)/(1 + phi) of an AR(1) chain."""
    n, chains = 8000, 8
    ours = convergence.effective_sample_size(autoregressive(phi, n, chains))[0]
    assert ours == pytest.approx(n * chains * (1.0 - phi) / (1.0 + phi), rel=0.12)


def test_disagreeing_chains_are_reported() -> None:
    together = autoregressive(0.3, 1000, 8)
    assert convergence.split_r_hat(together)[0] < 1.01
    apart = together + 0.5 * np.arange(8)[None, :, None]
    # Between-chain variance B/n = 0.25 var(0 … 7) = 1.5, within 1: sqrt(1 + 1.5) or so.
    means = np.repeat(0.5 * np.arange(8.0), 2)
    expected = np.sqrt(1.0 + means.var(ddof=1))
    assert convergence.split_r_hat(apart)[0] == pytest.approx(expected, rel=0.05)
    drifting = together + np.linspace(0.0, 2.0, 1000)[:, None, None]
    # The halves lie one apart, a variance of 4/15 between 16 of them; within them 1 + 1/12.
    expected = np.sqrt(1.0 + (4.0 / 15.0) / (1.0 + 1.0 / 12.0))
    assert convergence.split_r_hat(drifting)[0] == pytest.approx(expected, rel=0.03)


def test_effective_sample_size_knows_of_chains_that_disagree() -> None:
    apart = autoregressive(0.3, 1000, 8) + 0.5 * np.arange(8)[None, :, None]
    assert convergence.effective_sample_size(apart)[0] < 100.0
