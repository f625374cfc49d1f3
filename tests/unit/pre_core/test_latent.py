"""Coordinates of values that may be zero: unexplained by each other, with their probability."""

import numpy as np
import pytest
from scipy.stats import norm

from pre_core.search.latent import latent_coordinates

PLACES = np.array([1, 3, 4])


def some_covariance(d: int = 6) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    root = np.random.default_rng(2).standard_normal((d, d))
    return np.asarray(root @ root.T + 0.1 * np.eye(d))


def test_nothing_is_correlated_with_what_must_not_be_negative() -> None:
    covariance = some_covariance()
    of = latent_coordinates(PLACES, np.full(6, -np.inf), np.arange(6.0), covariance)
    unexplained = of.unexplained(np.asarray(np.linalg.cholesky(covariance)))
    left = unexplained @ unexplained.T
    left[np.diag_indices(6)] = 0.0
    assert np.abs(left[PLACES]).max() < 1e-10


def test_positive_values_are_undone() -> None:
    of = latent_coordinates(PLACES, np.zeros(6), np.arange(6.0), some_covariance())
    y = np.abs(np.random.default_rng(3).standard_normal((20, 6)))
    v = of.unexplained(y.T).T
    np.testing.assert_allclose(of.values(v), y, atol=1e-12)
    assert not of.log_share(v).any()


def test_others_stay_where_a_value_that_is_zero_moves_on() -> None:
    of = latent_coordinates(np.array([0]), np.zeros(3), np.ones(3), some_covariance(3))
    v = np.array([[-0.1, 0.4, 0.5], [-3.0, 0.4, 0.5]])
    y = of.values(v)
    assert y[0].tolist() == y[1].tolist() == [0.0, 0.4, 0.5]


@pytest.mark.parametrize("log_odds", [-1.0, 0.5])
def test_mass_below_zero_is_the_odds(log_odds: float) -> None:
    of = latent_coordinates(np.array([0]), np.full(1, log_odds), np.ones(1), np.full((1, 1), 0.04))
    v = np.linspace(-3.0, 0.0, 60_001)[:, None]
    mass = float(np.sum(np.exp(of.log_share(v))) * (v[1, 0] - v[0, 0]))
    assert mass == pytest.approx(np.exp(log_odds), rel=1e-3)


def test_a_value_that_is_always_or_never_zero() -> None:
    odds = np.array([np.inf, -np.inf])
    of = latent_coordinates(np.array([0, 1]), odds, np.ones(2), np.eye(2))
    v = np.array([[1.0, -2.0], [-1.0, 2.0]])
    assert of.values(v).tolist() == [[0.0, 2.0], [0.0, 2.0]]
    assert of.log_share(v) == pytest.approx(norm.logpdf(1.0) - norm.logpdf(0.0))
