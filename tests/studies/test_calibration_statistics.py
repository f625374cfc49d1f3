"""Statistics of many crossings on synthetic errors of known distribution: each can fail."""

import numpy as np
import pytest
from scipy.stats import chisquare, kstest, lognorm, norm, truncnorm

from pre_core.constants import NORMAL_975
from studies.validation.calibration_statistics import (
    bonferroni_p_value,
    pooled_share,
    rank,
    rank_from_quantiles,
    root_mean_square,
    truncated_covariance,
    uniformity,
)

HALF = np.array([0.5])


def test_rank_counts_draws_below_and_a_share_of_the_equal_ones() -> None:
    draws = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]])
    np.testing.assert_allclose(rank(draws, np.array([2.5, 0.0]), HALF), [0.5, 0.5])
    np.testing.assert_allclose(rank(draws, np.array([2.5, 0.0]), np.array([0.5, 0.2])), [0.5, 0.2])
    np.testing.assert_allclose(rank(draws, np.array([9.0, -1.0]), HALF), [1.0, 0.0])


def test_ranks_are_uniform_where_the_posterior_has_a_point_mass() -> None:
    """Truths and draws from one distribution, in which half are exactly zero."""
    rng = np.random.default_rng(5)
    drawn = np.abs(rng.standard_normal((501, 400))) * (rng.uniform(size=(501, 400)) < 0.5)
    draws, truth = drawn[1:], drawn[0]
    assert uniformity(rank(draws, truth, rng.uniform(size=400))).p_value > 0.01
    assert uniformity(rank(draws, truth, HALF)).p_value < 1e-6


def test_ranks_of_true_posteriors_are_uniform() -> None:
    """Normal prior and data: the posterior is known, and so is that of too small a noise."""
    rng = np.random.default_rng(1)
    truth = rng.standard_normal(2000)
    data = truth + 0.5 * rng.standard_normal(2000)

    def ranks(noise: float) -> np.ndarray:
        gain = 1.0 / (1.0 + noise**2)
        std = np.sqrt(1.0 - gain)
        draws = gain * data + std * rng.standard_normal((99, 2000))
        return rank(draws, truth, HALF)

    assert uniformity(ranks(0.5), 10).p_value > 0.01
    assert uniformity(ranks(0.25), 10).p_value < 1e-6  # intervals too narrow
    assert uniformity(ranks(1.0), 10).p_value < 1e-6  # too wide
    assert uniformity(ranks(0.5) ** 1.3, 10).p_value < 1e-6  # and to one side


@pytest.mark.parametrize("posterior", [norm(3.0, 0.4), lognorm(0.3, scale=2.0)])
def test_rank_from_quantiles_is_exact_for_a_log_normal_and_close_for_a_normal(
    posterior: norm,
) -> None:
    low, middle, high = posterior.ppf([0.025, 0.5, 0.975])
    for truth in posterior.ppf([0.001, 0.2, 0.5, 0.93]):
        # A normal above zero is interpolated in the logarithm too: nearly the same.
        tolerance = 1e-9 if posterior.dist.name == "lognorm" else 0.03
        found = rank_from_quantiles(float(truth), low, middle, high)
        assert found == pytest.approx(float(posterior.cdf(truth)), abs=tolerance)
    wide = norm(0.2, 1.0)
    quantiles = wide.ppf([0.025, 0.5, 0.975])
    found = rank_from_quantiles(-0.7, *quantiles)  # below zero: no logarithm, exact
    assert found == pytest.approx(float(wide.cdf(-0.7)), abs=1e-9)


def test_uniformity_is_the_chi_square_test() -> None:
    rng = np.random.default_rng(2)
    values = rng.uniform(size=200) ** 1.2
    found = uniformity(values, 10)
    counts, _ = np.histogram(values, 10, (0.0, 1.0))
    expected = chisquare(counts)
    np.testing.assert_array_equal(found.counts, counts)
    assert found.statistic == pytest.approx(expected.statistic)
    assert found.p_value == pytest.approx(expected.pvalue)


def test_p_values_of_uniform_ranks_are_uniform_and_of_a_group_not_too_small() -> None:
    rng = np.random.default_rng(3)
    p = np.array([uniformity(rng.uniform(size=200), 10).p_value for _ in range(600)])
    assert kstest(p, "uniform").pvalue > 0.001
    groups = np.array([bonferroni_p_value(row) for row in p.reshape(-1, 6)])
    # No more groups fail at 10 % than 10 %, but for chance: 100 groups.
    assert np.mean(groups < 0.1) < 0.2
    assert bonferroni_p_value(np.array([0.5, 0.001])) == pytest.approx(0.002)


def test_standard_error_of_a_share_knows_that_elements_of_a_crossing_are_alike() -> None:
    rng = np.random.default_rng(4)
    alike = np.repeat((rng.uniform(size=(400, 1)) < 0.95).astype(float), 7, axis=1)
    apart = (rng.uniform(size=(400, 7)) < 0.95).astype(float)
    one = np.sqrt(0.95 * 0.05 / 400)
    assert pooled_share(alike).error == pytest.approx(one, rel=0.25)
    assert pooled_share(apart).error == pytest.approx(one / np.sqrt(7), rel=0.25)
    assert pooled_share(apart).cases == 2800
    assert pooled_share(apart).value == pytest.approx(0.95, abs=0.02)


def test_root_mean_square_sees_intervals_that_are_too_narrow() -> None:
    z = np.random.default_rng(5).standard_normal((200, 7))
    assert 0.9 < root_mean_square(z) < 1.15
    assert not 0.9 < root_mean_square(2.0 * z) < 1.15
    assert not 0.9 < root_mean_square(0.5 * z) < 1.15
    assert not 0.93 <= float(np.mean(np.abs(2.0 * z) < NORMAL_975)) <= 0.97


@pytest.mark.parametrize("centre", [0.0, 0.7, 2.0, 9.0])
def test_covariance_of_a_normal_cut_off_at_zero(centre: float) -> None:
    covariance = np.array([[2.0, 0.9, 0.0], [0.9, 1.3, -0.4], [0.0, -0.4, 0.7]])
    found = truncated_covariance(covariance, 1, centre)
    std = np.sqrt(1.3)
    cut = truncnorm(-centre / std, np.inf, loc=centre, scale=std)
    assert found[1, 1] == pytest.approx(float(cut.var()), rel=1e-9)
    rng = np.random.default_rng(6)
    y = rng.multivariate_normal([0.0, centre, 0.0], covariance, 400_000)
    kept = y[y[:, 1] > 0.0]
    np.testing.assert_allclose(found, np.cov(kept.T), atol=0.02)
    if centre == 9.0:
        np.testing.assert_allclose(found, covariance, rtol=1e-6, atol=1e-9)
