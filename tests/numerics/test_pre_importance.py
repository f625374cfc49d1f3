"""Weighted draws against quadrature, against ArviZ's Pareto smoothing, and when they give up."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from pre_core.arrays import FloatArray
from pre_core.crossing import surrogate, weighted_draws
from pre_core.search import importance

COUNT = 4000
WANTED = weighted_draws.WantedDraws(1200)
SPARE = surrogate._NUISANCES
"""Coordinates that are not watched: as many as their principal directions that are."""


LogDensity = Callable[[FloatArray], FloatArray]
DEVIATIONS = 4.5


def gaussian(centre: FloatArray, matrix: FloatArray) -> LogDensity:
    precision = np.linalg.inv(matrix)

    def log_density(y: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.einsum("ki,ij,kj->k", y - centre, precision, y - centre))

    return log_density


def some_covariance(f: int, seed: int = 1) -> FloatArray:
    root = np.random.default_rng(seed).standard_normal((f, 2 * f)) / np.sqrt(2 * f)
    return np.asarray(root @ root.T + 0.2 * np.eye(f))


def shares_of_parts(
    centre: FloatArray, matrix: FloatArray, odds: FloatArray
) -> dict[tuple[bool, bool], float]:
    """How likely each of the first two coordinates, positive, is zero: by quadrature.

    The third is integrated over: of a normal the first two are normal by themselves.
    """
    density = multivariate_normal(centre[:2], matrix[:2, :2]).pdf
    top = np.maximum(centre[:2], 0.0) + 9.0 * np.sqrt(np.diag(matrix)[:2])
    both, _ = dblquad(lambda b, a: density([a, b]), 0.0, top[0], 0.0, top[1], epsabs=1e-8)
    weights = {
        (False, False): both,
        (True, False): odds[0] * quad(lambda b: density([0.0, b]), 0.0, top[1])[0],
        (False, True): odds[1] * quad(lambda a: density([a, 0.0]), 0.0, top[0])[0],
        (True, True): odds[0] * odds[1] * density([0.0, 0.0]),
    }
    total = sum(weights.values())
    return {which: weight / total for which, weight in weights.items()}


def coordinates(f: int, **changes: object) -> surrogate.SurrogateCoordinates:
    """Return coordinates of which none is curved, cut off or absent, and all are watched."""
    none = np.zeros(0, dtype=np.int64)
    plain = surrogate.SurrogateCoordinates(
        none, np.zeros(0), none, np.full(f, -np.inf), np.arange(f - SPARE), 1.0
    )
    return plain._replace(**changes)


def of_normal(centre: FloatArray, matrix: FloatArray) -> surrogate.Surrogate:
    precision = np.linalg.inv(matrix)
    return surrogate.Surrogate(precision, precision @ centre)


def wide(matrix: FloatArray) -> FloatArray:
    """Return a covariance with `SPARE` more coordinates of unit variance."""
    f = matrix.shape[0]
    return np.block([[matrix, np.zeros((f, SPARE))], [np.zeros((SPARE, f)), np.eye(SPARE)]])


# On a day's first import it replaces a file in the home; two at once would fail.
@pytest.mark.xdist_group("arviz")
@pytest.mark.parametrize("heaviness", [0.3, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("count", [60, 1200])
def test_smoothed_weights_are_those_of_arviz(heaviness: float, count: int) -> None:
    import arviz

    log_weight = heaviness * np.random.default_rng(count).standard_normal(count)
    ours = importance.pareto_smooth(log_weight - 700.0)
    log_theirs, k = arviz.psislw(log_weight.copy())
    theirs = np.exp(log_theirs)
    assert ours.pareto_k == pytest.approx(float(k), abs=1e-9)
    np.testing.assert_allclose(ours.weight, theirs, rtol=1e-9)
    assert ours.ess == pytest.approx(1.0 / np.sum(theirs**2), rel=1e-9)


def test_weights_of_equal_and_of_impossible_points() -> None:
    equal = importance.pareto_smooth(np.full(400, 3.0))
    assert equal.ess == pytest.approx(400.0)
    nearly_all = np.full(400, -np.inf)
    nearly_all[:5] = 0.0
    assert importance.pareto_smooth(nearly_all).pareto_k == np.inf


def test_evenly_is_as_often_as_the_share() -> None:
    share = np.array([0.5, 0.0, 0.3, 0.2])
    for seed in range(20):
        places = importance.systematic_resample(share, 101, np.random.default_rng(seed))
        counts = np.bincount(places, minlength=4)
        assert np.abs(counts - 101 * share).max() < 1.0
    assert np.any(np.diff(places) < 0)  # in no order


def test_weights_of_a_mixture_know_its_shares() -> None:
    """Two normals with other constants, one of them far too narrow: shares by the known constants.

    Of the constants only the ratio counts, and its error is that of some thousand draws.
    """
    rng = np.random.default_rng(7)
    spreads, constants = np.array([0.6, 1.5]), np.array([40.0, -300.0])
    counts = np.array([3000, 1000])
    x = np.concatenate([s * rng.standard_normal(n) for s, n in zip(spreads, counts, strict=True)])
    normal = -0.5 * (x[:, None] / spreads) ** 2
    log_target = -0.5 * x**2 + 5.0
    found = importance.mixture_log_weights(log_target, normal + constants, counts)
    shares = counts / counts.sum() / spreads
    expected = log_target - np.log(np.exp(normal) @ shares)
    assert np.ptp(found - expected) < 0.1
    weights = importance.pareto_smooth(found)
    assert float(weights.weight @ x**2) == pytest.approx(
        1.0, abs=DEVIATIONS * np.sqrt(2 / weights.ess)
    )
    alone = importance.pareto_smooth(found[:3000])  # with the narrow one alone
    assert abs(float(alone.weight @ x[:3000] ** 2) - 1.0) > 0.1


@pytest.mark.parametrize("far", [1.0, 2.0, 300.0])
def test_densities_of_a_mixture_have_their_shares_whatever_their_constants(far: float) -> None:
    """Every density's share of the weights is its share of the draws: Shirts and Chodera's (11)."""
    rng = np.random.default_rng(3)
    counts = np.array([300, 400, 500])
    centres = far * np.array([0.0, 0.7, -1.0])
    which = np.repeat(np.arange(3), counts)
    x = centres[which] + rng.standard_normal(which.size)
    log_density = -0.5 * (x[:, None] - centres) ** 2 + far * np.array([0.0, 40.0, -900.0])
    found = importance.mixture_log_weights(np.zeros(x.size), log_density, counts)
    # With a target of one, the weights are the inverse of the mixture.
    shares = np.array([logsumexp(found + log_density[:, r]) for r in range(3)])
    scaled = log_density - shares + np.log(counts)
    np.testing.assert_allclose(np.ptp(logsumexp(scaled, axis=1) + found), 0.0, atol=1e-5)


def test_impossible_points_weigh_nothing_in_a_mixture() -> None:
    x = np.random.default_rng(0).standard_normal(400)
    log_target = np.where(x > 0.0, -0.5 * x**2, -np.inf)
    log_density = np.column_stack([-0.5 * x**2, -0.5 * x**2 + 3.0])
    found = importance.mixture_log_weights(log_target, log_density, np.array([200, 200]))
    assert np.all(np.isneginf(found[x <= 0.0]))
    assert np.ptp(found[x > 0.0]) < 1e-6


def test_how_likely_a_coordinate_is_nothing() -> None:
    """Both of two correlated ones, one of them, or none."""
    matrix = some_covariance(3)
    centre, odds = np.array([0.6, -0.2, 0.4]), np.array([0.8, 2.0])
    of = coordinates(3, half_normal=np.array([0, 1]), log_odds=np.array([*np.log(odds), -np.inf]))
    poor = of_normal(centre + 0.06, 1.3 * matrix)
    y = surrogate.draw(poor, of, centre, COUNT, 11, 0)
    weights = importance.pareto_smooth(
        gaussian(centre, matrix)(y) - surrogate.log_likelihood(poor, y)
    )
    assert weights.pareto_k < 0.5
    for which, expected in shares_of_parts(centre, matrix, odds).items():
        there = np.all((y[:, :2] == 0.0) == np.array(which), axis=1)
        error = np.sqrt(expected * (1.0 - expected) / weights.ess)
        share = float(weights.weight @ there)
        assert abs(share - expected) < DEVIATIONS * error, (which, expected)
        assert abs(share - 1.5 * expected) > DEVIATIONS * error  # it would be noticed


def test_a_surrogate_is_refined_by_weighted_draws() -> None:
    """Moved, stretched and turned by the weights of draws, with a coordinate cut off at zero."""
    matrix, centre = wide(some_covariance(4)), np.zeros(4 + SPARE)
    centre[:4] = 0.5, 0.3, -0.2, 0.4
    of = coordinates(4 + SPARE, half_normal=np.array([0]))
    target = gaussian(centre, matrix)
    moved = centre + np.array([0.0, 0.3, 0.0, -0.3, *np.zeros(SPARE)])
    poor = of_normal(moved, matrix * 1.4)
    y = surrogate.draw(poor, of, centre, COUNT, 5, 0)
    better = surrogate.refine(poor, of, y, target(y), COUNT)
    effective = []
    for one in (poor, better):
        y = surrogate.draw(one, of, centre, COUNT, 6, 0)
        assert y[:, 0].min() >= 0.0
        log_weight = target(y) - surrogate.log_likelihood(one, y)
        effective.append(importance.pareto_smooth(log_weight).ess)
    assert effective[0] < 0.8 * COUNT
    assert effective[1] > 0.9 * COUNT


def test_weights_make_room_for_a_tail() -> None:
    """A coordinate whose tail is wider than normal: without weights the regression misses it."""
    f = 4 + SPARE
    of, start = coordinates(f), of_normal(np.zeros(f), np.eye(f))

    def target(y: FloatArray) -> FloatArray:
        return np.asarray(-4.5 * np.log1p(y[:, 0] ** 2 / 8.0) - 0.5 * np.sum(y[:, 1:] ** 2, axis=1))

    y = surrogate.draw(start, of, np.zeros(f), COUNT, 5, 0)
    plain, weighted = (
        surrogate.refine(start, of, y, target(y), COUNT, is_weighted=is_weighted)
        for is_weighted in (False, True)
    )
    assert weighted.precision[0, 0] < 0.97 * plain.precision[0, 0]
    np.testing.assert_allclose(np.diag(weighted.precision)[1:], 1.0, atol=0.1)


def test_scatter_does_not_refine_a_surrogate() -> None:
    matrix = wide(some_covariance(4))
    of, right = coordinates(4 + SPARE), of_normal(np.zeros(4 + SPARE), matrix)
    y = surrogate.draw(right, of, np.zeros(4 + SPARE), 800, 5, 0)
    noise = 0.5 * np.random.default_rng(1).standard_normal(800)
    same = surrogate.refine(right, of, y, surrogate.log_likelihood(right, y) + noise, 800)
    ratio = np.linalg.eigvals(np.linalg.solve(right.precision, same.precision)).real
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)
    mean = np.linalg.solve(same.precision, same.linear)
    assert np.sqrt(mean @ right.precision @ mean) < 0.15


def silent(stage: str, fraction: float) -> None:
    """Progress that nobody watches."""


def test_weighted_draws_of_a_posterior_that_leans() -> None:
    """A likelihood nearly normal in exp(-y/2), with a normal prior of y, against quadrature."""
    f, spread = 1 + SPARE, 0.3

    def log_density(y: FloatArray) -> FloatArray:
        z = (np.exp(-0.5 * y) - 0.7) / spread
        return np.asarray(-0.5 * z**2 - 0.05 * z**4 - 0.5 * y**2)

    def target(y: FloatArray) -> FloatArray:
        return np.asarray(log_density(y[:, 0]) - 0.5 * np.sum(y[:, 1:] ** 2, axis=1))

    of = coordinates(f, curved=np.array([0]), sigma=np.array([0.5]))
    centre = np.array([0.9, *np.zeros(SPARE)])  # not where it should be
    first = of_normal(centre, np.diag([1.3 * spread**2, *np.ones(SPARE)]))
    y, weights = weighted_draws.importance_draws(target, of, first, np.zeros(f), WANTED, 1, silent)
    assert weighted_draws.is_enough(weights, 1200)
    grid = np.linspace(-8.0, 6.0, 20_001)
    density = np.exp(log_density(grid))
    density /= density.sum()
    for power in (1.0, -1.0):
        expected = float(density @ np.exp(power * grid))
        scatter = np.sqrt(float(density @ np.exp(2.0 * power * grid)) - expected**2)
        mean = float(weights.weight @ np.exp(power * y[:, 0]))
        assert abs(mean - expected) < DEVIATIONS * scatter / np.sqrt(weights.ess)


ACCEPTED = pytest.mark.xfail(
    reason="accepted with some seeds, without what lies beyond ten scales: no weight shows it",
    strict=False,
)


@pytest.mark.parametrize("degrees", [0.5, pytest.param(1.0, marks=[ACCEPTED, pytest.mark.slow])])
def test_weighted_draws_give_up_where_tails_are_heavy(degrees: float) -> None:
    """Student's t in each of twenty coordinates; a posterior has normal priors, no such tails."""

    def target(y: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * (degrees + 1.0) * np.sum(np.log1p(y**2), axis=1))

    of, narrow = coordinates(20), of_normal(np.zeros(20), 0.5 * np.eye(20))
    found = weighted_draws.importance_draws(target, of, narrow, np.zeros(20), WANTED, 3, silent)
    assert not weighted_draws.is_enough(found.weights, 1200)
    assert found.y.shape[0] == 400 * weighted_draws._MAX_BATCHES


def test_a_surrogate_stays_where_hardly_any_draw_is_possible() -> None:
    of, plain = coordinates(4 + SPARE), of_normal(np.zeros(4 + SPARE), np.eye(4 + SPARE))
    y = surrogate.draw(plain, of, np.zeros(4 + SPARE), 40, 5, 0)
    log_target = np.full(40, -np.inf)
    log_target[:3] = 1.0
    assert surrogate.refine(plain, of, y, log_target, 40) is plain
