"""Sequential Monte Carlo: peaks far apart by their weights, bent densities, moments of a normal."""

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.search.tempering import tempered_draws

APART = 6.0
SHARE = 0.3


def drawn(target: object, d: int, spread: float, seed: int = 1, count: int = 2000) -> FloatArray:
    rng = np.random.default_rng(seed)
    mean, covariance = 0.5 * np.ones(d), spread**2 * np.eye(d)
    return tempered_draws(target, mean, covariance, count, (45, 45), rng)  # type: ignore[arg-type]


def test_both_of_two_peaks_have_their_share() -> None:
    """Fourteen standard deviations apart in the wider peak's, three dimensions."""

    def two(x: FloatArray) -> FloatArray:
        one = np.log(SHARE) - 0.5 * np.sum((x - APART) ** 2, axis=1)
        other = np.log(1.0 - SHARE) - 0.5 * np.sum((x + APART) ** 2 / 0.5**2, axis=1)
        return np.asarray(np.logaddexp(one, other - 3.0 * np.log(0.5)))

    shares = [np.mean(drawn(two, 3, 8.0, seed)[:, 0] > 0.0) for seed in range(4)]
    assert np.mean(shares) == pytest.approx(SHARE, abs=0.05)


def test_moments_of_a_narrow_normal_in_many_dimensions() -> None:
    rng = np.random.default_rng(3)
    d = 12
    root = rng.standard_normal((d, d)) / np.sqrt(d) + np.diag(np.linspace(0.2, 3.0, d))
    mean = rng.standard_normal(d)

    def normal(x: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.sum(np.linalg.solve(root, (x - mean).T) ** 2, axis=0))

    x = drawn(normal, d, 10.0)
    white = np.linalg.solve(root, (x - mean).T)
    assert white.mean(axis=1) == pytest.approx(np.zeros(d), abs=0.15)
    assert white.std(axis=1) == pytest.approx(np.ones(d), abs=0.12)


def test_bent_density_is_followed_to_its_ends() -> None:
    """A normal in (u, v - u²/2): quantiles of u, the mean square of what the bend leaves."""

    def bent(x: FloatArray) -> FloatArray:
        u, v = x.T
        return np.asarray(-0.5 * u**2 - 0.5 * ((v - 0.5 * u**2) / 0.2) ** 2)

    u, v = drawn(bent, 2, 6.0).T
    assert np.quantile(u, [0.025, 0.5, 0.975]) == pytest.approx([-1.96, 0.0, 1.96], abs=0.2)
    assert np.mean(((v - 0.5 * u**2) / 0.2) ** 2) == pytest.approx(1.0, abs=0.12)


def test_a_seed_repeats_the_draws() -> None:
    def normal(x: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.sum(x**2, axis=1))

    assert np.array_equal(drawn(normal, 2, 3.0, 5, 50), drawn(normal, 2, 3.0, 5, 50))
    assert not np.array_equal(drawn(normal, 2, 3.0, 5, 50), drawn(normal, 2, 3.0, 6, 50))
