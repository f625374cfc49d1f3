"""Weighted draws against quadrature, against ArviZ's Pareto smoothing, and when they give up."""

import arviz
import numpy as np
import pytest
from numpy.typing import NDArray

from pre_core.crossing import sampling
from pre_core.search import approximation, importance
from tests.numerics.test_pre_chains import (
    DEVIATIONS,
    NONE,
    gaussian,
    log_gamma_times_normal,
    shares_of_parts,
    skewed_approximation,
    some_covariance,
    straight,
)

FloatArray = NDArray[np.float64]
COUNT = 4000


def spread_of(
    target: approximation.LogDensity, mixed: approximation.Mixture, number: int = 0
) -> float:
    """Standard deviation of the log weights of fresh draws: nothing where both are the same."""
    return float(importance.draw(target, mixed, COUNT, number).log_weight.std())


@pytest.mark.parametrize("heaviness", [0.3, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("count", [60, 1200])
def test_smoothed_weights_are_those_of_arviz(heaviness: float, count: int) -> None:
    log_weight = heaviness * np.random.default_rng(count).standard_normal(count)
    ours = importance.smoothed(log_weight - 700.0)
    log_theirs, k = arviz.psislw(log_weight.copy())
    theirs = np.exp(log_theirs)
    assert ours.pareto_k == pytest.approx(float(k), abs=1e-9)
    np.testing.assert_allclose(ours.weight, theirs, rtol=1e-9)
    assert ours.ess == pytest.approx(1.0 / np.sum(theirs**2), rel=1e-9)


def test_weights_of_equal_and_of_impossible_points() -> None:
    equal = importance.smoothed(np.full(400, 3.0))
    assert equal.ess == pytest.approx(400.0)
    nearly_all = np.full(400, -np.inf)
    nearly_all[:5] = 0.0
    assert importance.smoothed(nearly_all).pareto_k == np.inf


def test_evenly_is_as_often_as_the_share() -> None:
    share = np.array([0.5, 0.0, 0.3, 0.2])
    for seed in range(20):
        places = importance.evenly(share, 101, np.random.default_rng(seed))
        counts = np.bincount(places, minlength=4)
        assert np.abs(counts - 101 * share).max() < 1.0
    assert np.any(np.diff(places) < 0)  # in no order


def test_how_likely_a_coordinate_is_nothing() -> None:
    """As of the chains: both of two correlated ones, one of them, or none."""
    matrix = some_covariance(3)
    centre, odds = np.array([0.6, -0.2, 0.4]), np.array([0.8, 2.0])
    mixed = approximation.mixture(
        centre + 0.06,
        1.3 * matrix,
        np.array([0, 1]),
        np.zeros(3),
        11,
        np.array([*np.log(odds), -np.inf]),
    )
    drawn = importance.draw(gaussian(centre, matrix), mixed, COUNT, 0)
    worth = importance.smoothed(drawn.log_weight)
    assert worth.pareto_k < 0.5
    for which, expected in shares_of_parts(centre, matrix, odds).items():
        there = np.all((drawn.y[:, :2] == 0.0) == np.array(which), axis=1)
        error = np.sqrt(expected * (1.0 - expected) / worth.ess)
        share = float(worth.weight @ there)
        assert abs(share - expected) < DEVIATIONS * error, (which, expected)
        assert abs(share - 1.5 * expected) > DEVIATIONS * error  # it would be noticed


def test_two_coordinates_are_looked_at_together() -> None:
    """An approximation that knows nothing of how two of five hang together, and not of the rest."""
    precision = np.eye(5)
    precision[1, 2] = precision[2, 1] = -0.7
    matrix = np.linalg.inv(precision)
    centre = np.linspace(-1.0, 1.0, 5)
    target, plain = gaussian(centre, matrix), straight(centre, np.eye(5), NONE, 2)
    alone = approximation.probed(target, plain)
    both = approximation.probed(target, plain, np.array([2, 1]))
    assert spread_of(target, alone) > 0.3
    assert spread_of(target, both) < 1e-9
    elsewhere = approximation.probed(target, plain, np.array([0, 3, 4]))
    assert spread_of(target, elsewhere) == pytest.approx(spread_of(target, alone), rel=1e-9)


def test_what_is_probed_is_counted() -> None:
    seen = 0

    def target(y: FloatArray) -> FloatArray:
        nonlocal seen
        seen += y.shape[0]
        return np.asarray(-0.5 * np.sum(y * y, axis=1))

    plain = straight(np.zeros(5), np.eye(5), np.array([0]), 2)
    together = np.array([2, 3, 4])
    approximation.probed(target, plain, together)
    assert seen == approximation.probes(plain, together)


def test_what_draws_show_is_learnt() -> None:
    """Moved, stretched and turned by the weights of draws; what is never negative stays."""
    matrix = some_covariance(4)
    centre = np.array([0.5, 0.3, -0.2, 0.4])
    target = gaussian(centre, matrix)

    def cut(y: FloatArray) -> FloatArray:
        return np.where(y[:, 0] >= 0.0, target(y), -np.inf)

    poor = straight(centre + np.array([0.0, 0.3, 0.0, -0.3]), matrix * 1.4, np.array([0]), 5)
    drawn = importance.draw(cut, poor, COUNT, 0)
    better = approximation.learnt(poor, drawn.part, drawn.v, drawn.log_weight)
    worth = [
        importance.smoothed(importance.draw(cut, mixed, COUNT, 1).log_weight).ess
        for mixed in (poor, better)
    ]
    assert worth[0] < 0.8 * COUNT
    assert worth[1] > 0.9 * COUNT
    (before,), (after,) = poor.parts, better.parts
    assert after.factor[0, 0] == before.factor[0, 0]
    assert after.shift[0] == 0.0
    assert np.array_equal(after.factor, np.tril(after.factor))


def test_scatter_is_not_learnt() -> None:
    matrix = some_covariance(4)
    target, right = gaussian(np.zeros(4), matrix), straight(np.zeros(4), matrix, NONE, 5)
    drawn = importance.draw(target, right, 300, 0)
    noise = 0.5 * np.random.default_rng(1).standard_normal(300)
    same = approximation.learnt(right, drawn.part, drawn.v, drawn.log_weight + noise)
    np.testing.assert_allclose(same.parts[0].factor, right.parts[0].factor, atol=1e-12)
    np.testing.assert_allclose(same.parts[0].shift, 0.0, atol=1e-12)


def silent(stage: str, fraction: float) -> None:
    """Progress that nobody watches."""


def test_weighted_draws_of_a_posterior_that_leans() -> None:
    weighted, _, spent = sampling._weighted(
        log_gamma_times_normal, skewed_approximation(bend=-0.2), 1200, silent
    )
    assert weighted is not None
    drawn, worth = weighted
    assert drawn.log_weight.size == spent == 1200
    mean = float(worth.weight @ np.exp(drawn.y[:, 0]))  # of a gamma variate: its shape
    assert abs(mean - 2.5) < DEVIATIONS * np.sqrt(2.5 / worth.ess)


def test_weighted_draws_give_up_where_tails_are_heavy() -> None:
    """Student's t with one degree of freedom in each of twenty coordinates."""

    def target(y: FloatArray) -> FloatArray:
        return np.asarray(-np.sum(np.log1p(y**2), axis=1))

    narrow = straight(np.zeros(20), 0.5 * np.eye(20), NONE, 3)
    drawn, _, spent = sampling._weighted(target, narrow, 1200, silent)
    assert drawn is None
    assert 2 * 1200 <= spent <= 2 * 3000


def test_from_hardly_any_possible_draw_nothing_is_learnt() -> None:
    plain = straight(np.zeros(4), np.eye(4), NONE, 5)
    drawn = importance.draw(gaussian(np.zeros(4), np.eye(4)), plain, 40, 0)
    log_weight = np.full(40, -np.inf)
    log_weight[:3] = 1.0
    assert approximation.learnt(plain, drawn.part, drawn.v, log_weight) is plain
