"""New draws of a distribution: its marginals and rank correlations, nothing repeated."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.response_surface import POINTS
from pre_core.crossing.surface_posterior import _BEYOND_DRAWS, _widened, copula_draws
from pre_core.crossing.weighted_draws import WeightedDraws
from pre_core.search.importance import SmoothedWeights


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


def test_points_of_a_surface_are_a_wider_posterior() -> None:
    """About its weighted median; what must not be negative is reflected, as a spring's rate."""
    rng = np.random.default_rng(8)
    y = np.stack([3.0 + rng.standard_normal(40_000), 0.2 * rng.random(40_000)], axis=1)
    weight = np.exp(-0.5 * (y[:, 0] - 3.0))  # moves the mean of the normal by -0.5
    weights = SmoothedWeights(weight / weight.sum(), 0.1, 30_000.0)
    points = _widened(WeightedDraws(y, weights), np.array([1]), rng)
    assert points.shape == (POINTS, 2)
    assert points[:, 0].mean() == pytest.approx(2.5, abs=0.1)
    assert points[:, 0].std() == pytest.approx(_BEYOND_DRAWS, rel=0.05)
    assert points[:, 1].min() >= 0.0
    assert points[:, 1].max() == pytest.approx(0.1 + 0.1 * _BEYOND_DRAWS, rel=0.05)
