"""Expected squares of whitened noise, against dense covariances and drawn roads."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from pre_core.arrays import FloatArray
from pre_core.crossing.expected_squares import expected_squares
from pre_core.crossing.fit import Optimum
from pre_core.crossing.nuisances import integrated_residuals
from pre_core.crossing.posterior import PosteriorProblem, values_of
from pre_core.crossing.preparation import replace_mismatch
from pre_core.crossing.surface_posterior import nuisances_at_optimum
from pre_core.crossing.whitening import Whitener
from pre_core.parameters import C_S1, C_U1, D_1, K_S1, K_U1, M_U1
from tests.numerics.single_tyres import at_its_truth

# They share a crossing at its truth, which takes seconds.
pytestmark = pytest.mark.xdist_group("at its truth")


def dense_factor(noise: Whitener) -> FloatArray:
    """Return the lower triangle L (n, n) of the covariance L L^T."""
    n, width = noise.factor.shape
    lower = np.zeros((n, n))
    for d in range(width):
        lower += np.diag(noise.factor[d:, width - 1 - d], -d)
    return lower


def without_mismatch(found: Optimum) -> PosteriorProblem:
    road = found.problem.mismatch
    none = road._replace(level_m3=np.zeros_like(road.level_m3), pavement=None)
    return replace_mismatch(found.problem._replace(mismatch=none), found.state.y, None)


def far_trucks(found: Optimum, count: int, seed: int = 3) -> FloatArray:
    """Return points (count, f) whose trucks differ by a spread of their priors."""
    y = np.repeat(found.state.y[None, :], count, axis=0)
    y[:, :9] += np.random.default_rng(seed).standard_normal((count, 9))
    return y


def test_sensor_noise_of_far_trucks_against_dense_covariances() -> None:
    """tr(C_0^-1 C)/2 of a whole record; its ends are half a per cent of it.

    It is the sum of squares of L_0^-1 L.
    """
    found = at_its_truth()
    problem, y = without_mismatch(found), far_trucks(found, 2)
    of = expected_squares(problem, found.state.y)
    seen = of.beyond_tangent(y) + (y - of.y) @ of.tangent
    here = dense_factor(problem.noise)
    first = 0.5 * problem.noise.reciprocal.size
    true = []
    for one in y:
        there = dense_factor(replace_mismatch(problem, one, None).noise)
        true.append(0.5 * np.sum(solve_triangular(here, there, lower=True) ** 2) - first)
    assert np.abs(true).min() > 50.0
    np.testing.assert_allclose(seen, true, rtol=0.02, atol=2.0)


def test_tangent_is_what_a_search_subtracts() -> None:
    """With mismatch and without, but for gains and torsion; differences there are one-sided."""
    found = at_its_truth()
    slope = found.problem.noise_slope
    tangent = expected_squares(found.problem, found.state.y).tangent[: slope.size]
    kept = np.flatnonzero(tangent)
    assert np.abs(slope[kept]).max() > 50.0
    np.testing.assert_allclose(tangent[kept], slope[kept], atol=0.2 + 1e-3 * np.abs(slope).max())


def test_expected_squares_touch_their_tangent_at_the_optimum() -> None:
    found = at_its_truth()
    of = expected_squares(found.problem, found.state.y)
    apart = far_trucks(found, 1)[0] - found.state.y
    steps = np.array([0.0, 0.01, 0.02])
    beyond = of.beyond_tangent(found.state.y + steps[:, None] * apart)
    assert beyond[0] == 0.0
    assert beyond[2] == pytest.approx(4.0 * beyond[1], rel=0.1)
    assert abs(beyond[2]) > 1e-4


def test_a_truck_of_other_loads_and_springs_has_as_much_noise() -> None:
    """All of the front axle is 0.7 times the declared, the rear as much higher as the total allows.

    So every frequency remains, and the noise: its tangent alone would make this truck likelier.
    """
    found = at_its_truth()
    problem, y = found.problem, found.state.y.copy()
    spread, here = problem.priors.spread, values_of(problem, y[None, :])
    theta, length, total = here.theta[0], here.wheelbase_m[0], problem.crossing.total_mass_kg
    body = total - theta[M_U1] - theta[M_U1 + 1]
    load = body * np.array([length - theta[D_1], theta[D_1]]) / length
    carried = load + theta[M_U1 : M_U1 + 2]
    factor = np.array([0.7, (total - 0.7 * carried[0]) / carried[1]])
    for place in (C_S1, K_S1, M_U1, K_U1):
        y[place : place + 2] += np.log(factor) / spread[place : place + 2]
    y[[C_U1, C_U1 + 1]] *= factor
    moved = length * factor[1] * load[1] / (factor @ load)
    y[D_1] += np.log(moved / theta[D_1]) / spread[D_1]
    of = expected_squares(without_mismatch(found), found.state.y)
    along = float((y - of.y) @ of.tangent)
    assert along > 50.0
    assert along + of.beyond_tangent(y[None, :])[0] == pytest.approx(0.0, abs=0.05 * along)


class Given:
    """Expected squares as they are given, whatever the points."""

    def __init__(self, beyond: FloatArray) -> None:
        self.beyond = beyond

    def beyond_tangent(self, y: FloatArray) -> FloatArray:
        assert y.shape[0] == self.beyond.size
        return self.beyond


@pytest.mark.parametrize("has_step", [False, True])
def test_residuals_of_draws_count_expected_squares(*, has_step: bool) -> None:
    """Also where they are above their tangent, so that squares are less."""
    found = at_its_truth()
    of = nuisances_at_optimum(found, 1.0, seed=1)
    y = np.repeat(of.y[None, of.kept], 5, axis=0)
    beyond = np.linspace(-30.0, 30.0, 5)
    expected: Any = Given(beyond)
    residuals = integrated_residuals(of._replace(expected=expected), y, has_step=has_step)
    squares = np.sum(residuals**2, axis=0)
    assert squares[0] - squares == pytest.approx(2.0 * (beyond - beyond[0]))
