"""Draws by residuals that no parabola follows, against quadrature."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from pre_core.arrays import FloatArray
from pre_core.crossing.residual_draws import DrawnDensity, residual_draws
from pre_core.crossing.weighted_draws import WeightedDraws, is_enough

Residuals = Callable[[FloatArray], FloatArray]

COUNT = 400
NONE = np.zeros(0, dtype=np.int64)
NEVER_ZERO = np.full(2, -np.inf)


def prior_squares(y: FloatArray) -> FloatArray:
    return np.asarray(np.sum(y**2, axis=1))


def bent(y: FloatArray) -> FloatArray:
    """Residuals (2, k) of third and higher order, sharp across a bend."""
    u, v = y.T
    return np.stack([(v - np.sin(u) - 0.1 * u**3) / 0.15, u - 0.5])


def drawn(
    residuals: Residuals,
    half_normal: NDArray[np.int64] = NONE,
    log_odds: FloatArray = NEVER_ZERO,
    inflation: float = 1.0,
    seed: int = 1,
) -> WeightedDraws:
    density = DrawnDensity(residuals, prior_squares, half_normal, log_odds, inflation)
    rng = np.random.default_rng(seed)
    first = np.array([0.3, 0.4]) + rng.standard_normal((COUNT, 2)) * [0.5, 0.4]
    first[:, half_normal] = np.maximum(first[:, half_normal], 0.0)
    return residual_draws(density, first, 1200, rng, lambda stage, fraction: None)


def moments(weighted: WeightedDraws) -> tuple[FloatArray, FloatArray]:
    mean = weighted.weights.weight @ weighted.y
    return mean, np.sqrt(weighted.weights.weight @ (weighted.y - mean) ** 2)


@pytest.mark.parametrize("inflation", [1.0, 1.5])
def test_bent_posterior_against_quadrature(inflation: float) -> None:
    weighted = drawn(bent, inflation=inflation)
    assert is_enough(weighted.weights, 1200)
    u, v = (np.linspace(-5.0, 5.0, n) for n in (801, 2001))
    grid = np.stack([one.ravel() for one in np.meshgrid(u, v)], axis=1)
    squares = np.sum(bent(grid) ** 2, axis=0) + prior_squares(grid)
    share = np.exp(-0.5 / inflation**2 * (squares - squares.min()))
    share /= share.sum()
    true_mean = share @ grid
    true_spread = np.sqrt(share @ (grid - true_mean) ** 2)
    mean, spread = moments(weighted)
    assert mean == pytest.approx(true_mean, abs=0.15 * true_spread.min())
    assert spread == pytest.approx(true_spread, rel=0.12)


def test_value_that_may_be_zero_is_so_by_its_odds() -> None:
    """P(0)/P(> 0) is the odds over the integral of the density above zero relative to at zero."""
    odds = 0.4

    def residuals(y: FloatArray) -> FloatArray:
        return np.stack([2.0 * (y[:, 0] - 0.5) + 0.3 * y[:, 0] ** 3, y[:, 1] - 1.0])

    weighted = drawn(residuals, np.array([0]), np.array([odds, -np.inf]))
    x = np.linspace(0.0, 5.0, 20001)
    squares = (2.0 * (x - 0.5) + 0.3 * x**3) ** 2 + x**2
    above = np.sum(np.exp(-0.5 * (squares - squares[0]))) * (x[1] - x[0])
    expected = np.exp(odds) / (np.exp(odds) + above)
    zero = float(weighted.weights.weight @ (weighted.y[:, 0] == 0.0))
    assert zero == pytest.approx(expected, abs=0.06)


def test_draws_return_from_where_a_parabola_is_deeper_than_the_residuals() -> None:
    """Flat beyond the points, a residual's parabola falls to zero at three times their distance."""

    def residuals(y: FloatArray) -> FloatArray:
        return np.stack([8.0 + 4.0 * np.tanh(y[:, 0]), 3.0 * (y[:, 1] - 0.4)])

    weighted = drawn(residuals)
    assert is_enough(weighted.weights, 1200)
    u = np.linspace(-8.0, 8.0, 4001)
    squares = (8.0 + 4.0 * np.tanh(u)) ** 2 + u**2
    share = np.exp(-0.5 * (squares - squares.min()))
    mean, spread = moments(weighted)
    true = float(share @ u / share.sum())
    assert mean[0] == pytest.approx(true, abs=0.1)
    assert spread[0] == pytest.approx(np.sqrt(share @ (u - true) ** 2 / share.sum()), rel=0.15)


def test_points_that_are_not_possible_are_never_drawn() -> None:
    def residuals(y: FloatArray) -> FloatArray:
        out = np.stack([y[:, 0], y[:, 1]])
        out[:, y[:, 0] > 1.0] = np.nan
        return out

    weighted = drawn(residuals)
    assert weighted.weights.weight @ (weighted.y[:, 0] > 1.0) < 1e-12
    assert is_enough(weighted.weights, 1200)


def test_two_bridges_are_drawn_by_their_masses() -> None:
    """Of two minima six spreads apart, the other one is found only if points lie about it."""

    def residuals(y: FloatArray) -> FloatArray:
        return np.stack([4.0 * (y[:, 0] ** 2 - 1.0), 0.8 * (y[:, 0] + 1.0), 3.0 * y[:, 1]])

    u = np.linspace(-3.0, 3.0, 6001)
    squares = 16.0 * (u**2 - 1.0) ** 2 + 0.64 * (u + 1.0) ** 2 + u**2
    share = np.exp(-0.5 * (squares - squares.min()))
    right = float(share[u > 0.0].sum() / share.sum())
    assert 0.1 < right < 0.4
    density = DrawnDensity(residuals, prior_squares, NONE, NEVER_ZERO, 1.0)
    rng = np.random.default_rng(3)
    first = rng.standard_normal((COUNT, 2)) * [0.12, 0.3] + [-1.0, 0.0]
    first[COUNT // 2 :, 0] += 2.0
    weighted = residual_draws(density, first, 1200, rng, lambda stage, fraction: None)
    assert is_enough(weighted.weights, 1200)
    assert weighted.weights.weight @ (weighted.y[:, 0] > 0.0) == pytest.approx(right, abs=0.05)


def test_a_narrow_value_that_is_often_zero() -> None:
    """Correlated with fifteen others, its spread is a tenth of its prior's.

    Moves in which all others follow a value that is zero already do not reach zero and return.
    """
    d, odds, spread, at = 16, 0.226, 0.1, 0.12
    matrix = spread**2 * (0.2 * np.eye(d) + 0.8)
    root = np.linalg.cholesky(np.linalg.inv(matrix)).T

    def residuals(y: FloatArray) -> FloatArray:
        return np.asarray(root @ (y - at).T)

    def flat(y: FloatArray) -> FloatArray:
        return np.zeros(y.shape[0])

    at_zero = np.exp(odds) * norm.pdf(0.0, at, spread)
    expected = at_zero / (at_zero + norm.sf(0.0, at, spread))
    log_odds = np.append(odds, np.full(d - 1, -np.inf))
    of = DrawnDensity(residuals, flat, np.array([0]), log_odds, 1.0)
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        first = at + rng.multivariate_normal(np.zeros(d), 1.44 * matrix, COUNT)
        first[:, 0] = np.abs(first[:, 0])
        weighted = residual_draws(of, first, 1200, rng, lambda stage, fraction: None)
        found.append(float(weighted.weights.weight @ (weighted.y[:, 0] == 0.0)))
    assert 0.3 < expected < 0.95
    assert np.mean(found) == pytest.approx(expected, abs=0.08)
