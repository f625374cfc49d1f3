"""New draws of a distribution: its marginals and rank correlations, nothing repeated."""

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.surface_posterior import copula_draws


def ranks(columns: FloatArray) -> NDArray[np.int64]:
    return np.asarray(columns.argsort(axis=0).argsort(axis=0))


def test_marginals_and_rank_correlations_are_those_of_the_draws() -> None:
    rng = np.random.default_rng(5)
    root = np.array([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [-0.5, 0.3, 0.81]])
    draws = rng.standard_normal((20_000, 3)) @ root.T
    draws = np.stack([np.exp(draws[:, 0]), np.abs(draws[:, 1]), draws[:, 2]], axis=1)
    new = copula_draws(draws, 20_000, rng)
    shares = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
    spread = np.quantile(draws, 0.975, axis=0) - np.quantile(draws, 0.025, axis=0)
    differ = np.quantile(new, shares, axis=0) - np.quantile(draws, shares, axis=0)
    assert np.all(np.abs(differ) < 0.02 * spread)
    assert np.allclose(np.corrcoef(ranks(new).T), np.corrcoef(ranks(draws).T), atol=0.03)


def test_repeated_draws_become_different_ones() -> None:
    rng = np.random.default_rng(6)
    draws = np.repeat(rng.standard_normal((50, 4)), 40, axis=0)
    assert np.unique(copula_draws(draws, 1000, rng), axis=0).shape[0] > 900


def test_what_is_zero_in_all_draws_stays_zero() -> None:
    rng = np.random.default_rng(7)
    draws = rng.standard_normal((100, 3))
    draws[:, 1] = 0.0
    new = copula_draws(draws, 300, rng)
    assert not new[:, 1].any()
    assert new[:, 0].std() > 0.5
