"""Markov chains on targets with known answers; pass marks from their own effective sample size."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import dblquad, quad
from scipy.special import digamma, gammaln, polygamma
from scipy.stats import loggamma, multivariate_normal, truncnorm

from pre_core.search import approximation, crank_nicolson
from pre_core.search.loop import Ending

FloatArray = NDArray[np.float64]
NONE = np.array([], dtype=np.int64)
STEPS = 2000
DEVIATIONS = 4.5
"""Of an estimate: a right sampler misses it about once in 100 000 comparisons."""


def straight(
    centre: FloatArray, matrix: FloatArray, positive: NDArray[np.int64], seed: int
) -> approximation.Mixture:
    """Without any bent coordinate."""
    return approximation.mixture(centre, matrix, positive, np.zeros(centre.size), seed)


def changed(mixed: approximation.Mixture, **fields: FloatArray) -> approximation.Mixture:
    """The same with other fields in its only part."""
    (part,) = mixed.parts
    return mixed._replace(parts=(part._replace(**fields),))


class Run(NamedTuple):
    draws: FloatArray  # (n, c, f)
    acceptance: float
    state: crank_nicolson.State


def run(
    target: approximation.LogDensity,
    normal: approximation.Mixture,
    *,
    steps: int = STEPS,
    adapt: int = 0,
) -> Run:
    state = crank_nicolson.init(target, normal)
    if adapt:
        seen = []
        for _ in range(adapt):
            state, _ = crank_nicolson.step(target, normal, state)
            seen.append(state.v)
        better = approximation.adapted(normal, np.stack(seen[adapt // 3 :]))
        assert np.any(better.parts[0].shift != 0.0) or np.any(better.parts[0].scale != 1.0)
        state = crank_nicolson.moved(target, normal, better, state)
        normal = better
    draws, acceptance = [], []
    for _ in range(steps):
        state, info = crank_nicolson.step(target, normal, state)
        draws.append(state.y)
        acceptance.append(info.acceptance)
    return Run(np.stack(draws), float(np.mean(acceptance)), state)


def misses(draws: FloatArray, mean: FloatArray, variance: FloatArray) -> FloatArray:
    """How many of its own standard errors each mean and second moment is off: (2 f,)."""
    second = variance + mean**2
    both = np.concatenate([draws, draws**2], axis=2)
    expected = np.concatenate([mean, second])
    error = both.std(axis=(0, 1)) / np.sqrt(crank_nicolson.effective_sample_size(both))
    return np.asarray((both.mean(axis=(0, 1)) - expected) / error)


def gaussian(centre: FloatArray, matrix: FloatArray) -> approximation.LogDensity:
    precision = np.linalg.inv(matrix)

    def log_density(y: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * np.einsum("ki,ij,kj->k", y - centre, precision, y - centre))

    return log_density


def positive_only(
    target: approximation.LogDensity, places: NDArray[np.int64]
) -> approximation.LogDensity:
    return lambda y: np.where(np.all(y[:, places] >= 0.0, axis=1), target(y), -np.inf)


def some_covariance(f: int, seed: int = 1) -> FloatArray:
    root = np.random.default_rng(seed).standard_normal((f, 2 * f)) / np.sqrt(2 * f)
    return np.asarray(root @ root.T + 0.2 * np.eye(f))


def truncated_moments(
    centre: FloatArray, matrix: FloatArray, cut: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Means and variances of a normal cut off at zero in two coordinates, by quadrature.

    The two are integrated on a grid; the others follow by linear regression on them.
    """
    pair = np.array(cut)
    inside = matrix[np.ix_(pair, pair)]
    axes = [np.linspace(0.0, max(0.0, centre[i]) + 9.0 * np.sqrt(matrix[i, i]), 1201) for i in cut]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    off = grid - centre[pair]
    weight = np.exp(-0.5 * np.einsum("abi,ij,abj->ab", off, np.linalg.inv(inside), off))
    for axis in (0, 1):  # trapezoid rule
        ends = [slice(None), slice(None)]
        for end in (0, -1):
            ends[axis] = end  # type: ignore[call-overload]
            weight[tuple(ends)] *= 0.5
    weight /= weight.sum()
    mean_pair = np.einsum("ab,abi->i", weight, grid)
    off = grid - mean_pair
    cov_pair = np.einsum("ab,abi,abj->ij", weight, off, off)
    slope = matrix[:, pair] @ np.linalg.inv(inside)
    rest = matrix - slope @ matrix[pair]
    mean = centre + slope @ (mean_pair - centre[pair])
    covariance = slope @ cov_pair @ slope.T + rest
    return mean, np.diag(covariance)


def test_the_approximation_itself_is_always_accepted() -> None:
    matrix = some_covariance(6)
    centre = np.arange(6.0)
    target = gaussian(centre, matrix)
    done = run(target, straight(centre, matrix, NONE, 3), steps=600)
    assert done.acceptance == 1.0
    assert np.abs(misses(done.draws, centre, np.diag(matrix))).max() < DEVIATIONS


CUT = (1, 3)
CENTRE = np.array([0.3, -0.4, 1.0, 0.5, -2.0])


@pytest.mark.parametrize("order", [CUT, CUT[::-1]])
@pytest.mark.parametrize("adapt", [0, 300])
def test_normal_cut_off_in_two_of_five_dimensions(order: tuple[int, int], adapt: int) -> None:
    """One optimum below zero, one just above it, correlated: against quadrature."""
    matrix = some_covariance(5)
    places = np.array(order)
    target = positive_only(gaussian(CENTRE, matrix), places)
    mean, variance = truncated_moments(CENTRE, matrix, CUT)
    normal = straight(CENTRE, matrix, places, 5)
    if adapt:  # begin with a poor one, so that there is something to learn
        normal = straight(CENTRE + 0.5, 1.5 * matrix, places, 5)
    done = run(target, normal, adapt=adapt)
    assert done.draws[:, :, places].min() >= 0.0
    assert 0.1 < done.acceptance <= 1.0
    assert np.abs(misses(done.draws, mean, variance)).max() < DEVIATIONS
    assert crank_nicolson.split_r_hat(done.draws).max() < 1.02


def test_quadrature_of_the_cut_normal_against_one_dimension() -> None:
    """The test's own reference: uncorrelated, it is scipy's truncated normal."""
    matrix = np.diag([1.0, 0.5, 2.0, 0.3, 1.0])
    mean, variance = truncated_moments(CENTRE, matrix, CUT)
    for i in CUT:
        scale = np.sqrt(matrix[i, i])
        known = truncnorm(-CENTRE[i] / scale, np.inf, loc=CENTRE[i], scale=scale)
        assert mean[i] == pytest.approx(known.mean(), rel=1e-4)
        assert variance[i] == pytest.approx(known.var(), rel=1e-3)


# Coordinates that may be nothing


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


@pytest.mark.parametrize("stretch", [1.0, 1.3])
def test_how_often_a_coordinate_is_nothing(stretch: float) -> None:
    """Both of two correlated ones, one of them, or none; with a right and a poor approximation."""
    matrix = some_covariance(3)
    centre, odds = np.array([0.6, -0.2, 0.4]), np.array([0.8, 2.0])
    mixed = approximation.mixture(
        centre + 0.2 * (stretch - 1.0),
        stretch * matrix,
        np.array([0, 1]),
        np.zeros(3),
        11,
        np.array([*np.log(odds), -np.inf]),
    )
    assert len(mixed.parts) == 4
    done = run(gaussian(centre, matrix), mixed, steps=4000)
    assert done.draws[:, :, :2].min() == 0.0
    for which, expected in shares_of_parts(centre, matrix, odds).items():
        assert 0.03 < expected < 0.7
        there = np.all((done.draws[:, :, :2] == 0.0) == np.array(which), axis=2)[:, :, None]
        there = there.astype(np.float64)
        n = crank_nicolson.effective_sample_size(there)[0]
        error = np.sqrt(expected * (1.0 - expected) / n)
        assert abs(there.mean() - expected) < DEVIATIONS * error, (which, expected)
        assert abs(there.mean() - 1.5 * expected) > DEVIATIONS * error  # it would be noticed


def test_what_is_always_nothing_and_what_never_is() -> None:
    matrix = some_covariance(3)
    centre = np.array([0.6, -0.2, 0.4])
    mixed = approximation.mixture(
        centre, matrix, np.array([0, 1]), np.zeros(3), 3, np.array([np.inf, -np.inf, -np.inf])
    )
    assert len(mixed.parts) == 1
    draws = run(gaussian(centre, matrix), mixed).draws
    assert not draws[:, :, 0].any()
    assert draws[:, :, 1].min() > 0.0
    # Given that the first is zero the other two are normal, the second cut off at zero.
    slope = matrix[1:, 0] / matrix[0, 0]
    rest = matrix[1:, 1:] - np.outer(slope, matrix[0, 1:])
    mean = centre[1:] - slope * centre[0]
    scale = np.sqrt(rest[0, 0])
    known = truncnorm(-mean[0] / scale, np.inf, loc=mean[0], scale=scale)
    onto = rest[1, 0] / rest[0, 0]
    expected = np.array([known.mean(), mean[1] + onto * (known.mean() - mean[0])])
    spread = np.array([known.var(), rest[1, 1] + onto**2 * (known.var() - rest[0, 0])])
    assert np.abs(misses(draws[:, :, 1:], expected, spread)).max() < DEVIATIONS


SHAPE = 2.5


def log_gamma_times_normal(y: FloatArray) -> FloatArray:
    """y_0 = log of a gamma variate (it leans to the left), y_1 | y_0 normal about y_0 / 2."""
    return np.asarray(SHAPE * y[:, 0] - np.exp(y[:, 0]) - 0.5 * (y[:, 1] - 0.5 * y[:, 0]) ** 2)


def skewed_approximation(seed: int = 9, bend: float = 0.0) -> approximation.Mixture:
    """The curvature at the optimum log(shape), as method `pre` would take it."""
    mode = np.log(SHAPE)
    precision = np.array([[SHAPE + 0.25, -0.5], [-0.5, 1.0]])
    return approximation.mixture(
        np.array([mode, 0.5 * mode]), np.linalg.inv(precision), NONE, np.array([bend, 0.0]), seed
    )


@pytest.mark.parametrize("bend", [0.4, -0.3])
def test_the_bent_approximation_itself_is_always_accepted(bend: float) -> None:
    """A target that is normal in w = (1 - exp(-b (y - centre)))/b, with dw/dy = exp(-b (y - c))."""
    centre, matrix = np.array([0.7, -0.2]), np.array([[0.09, 0.05], [0.05, 0.16]])
    precision = np.linalg.inv(matrix)

    def target(y: FloatArray) -> FloatArray:
        w = y - centre
        slope = -bend * w[:, 0]
        w = np.stack([-np.expm1(slope) / bend, w[:, 1]], axis=1)
        return np.asarray(-0.5 * np.einsum("ki,ij,kj->k", w, precision, w) + slope)

    normal = approximation.mixture(centre, matrix, NONE, np.array([bend, 0.0]), 6)
    assert run(target, normal, steps=200).acceptance == 1.0
    assert run(target, straight(centre, matrix, NONE, 6), steps=200).acceptance < 0.98


def test_what_lies_beyond_the_bend_is_impossible() -> None:
    """A bent coordinate ends at w = 1/b: nothing there is accepted, and the rest stays exact."""
    normal = skewed_approximation(bend=0.9)
    normal = changed(normal, factor=3.0 * normal.parts[0].factor)
    done = run(log_gamma_times_normal, normal, steps=4000)
    assert np.all(np.isfinite(done.draws))
    assert abs(done.draws[:, :, 0].mean() - digamma(SHAPE)) < 0.1


@pytest.mark.parametrize(("adapt", "bend"), [(0, 0.0), (200, 0.0), (0, 0.2)])
def test_a_target_that_leans_to_one_side(adapt: int, bend: float) -> None:
    """Means, variances and quantiles of log-gamma times normal, before and after adapting."""
    mean = np.array([digamma(SHAPE), 0.5 * digamma(SHAPE)])
    variance = np.array([polygamma(1, SHAPE), 1.0 + 0.25 * polygamma(1, SHAPE)])
    normal = skewed_approximation(bend=bend)
    if adapt:
        normal = changed(normal, centre=normal.parts[0].centre + np.array([0.5, -0.6]))
    done = run(log_gamma_times_normal, normal, steps=6000, adapt=adapt)
    assert np.abs(misses(done.draws, mean, variance)).max() < DEVIATIONS
    for probability in (0.025, 0.25, 0.5, 0.975):
        quantile = loggamma(SHAPE).ppf(probability)
        below = (done.draws[:, :, :1] <= quantile).astype(np.float64)
        n = crank_nicolson.effective_sample_size(below)[0]
        error = np.sqrt(probability * (1.0 - probability) / n)
        assert abs(below.mean() - probability) < DEVIATIONS * error, probability


def test_reference_of_the_leaning_target() -> None:
    total, _ = quad(lambda x: np.exp(SHAPE * x - np.exp(x) - gammaln(SHAPE)), -30.0, 6.0)
    assert total == pytest.approx(1.0, rel=1e-8)


@pytest.mark.parametrize("dimension", [0, 1])
def test_a_target_moved_by_a_third_of_its_spread_is_caught(dimension: int) -> None:
    """Negative control: the very check above fails when the expectation is 0.3 spreads off."""
    mean = np.array([digamma(SHAPE), 0.5 * digamma(SHAPE)])
    variance = np.array([polygamma(1, SHAPE), 1.0 + 0.25 * polygamma(1, SHAPE)])
    shift = 0.3 * np.sqrt(variance) * (np.arange(2) == dimension)
    done = run(lambda y: log_gamma_times_normal(y - shift), skewed_approximation())
    assert np.abs(misses(done.draws, mean, variance)).max() > 2.0 * DEVIATIONS
    assert np.abs(misses(done.draws, mean + shift, variance)).max() < DEVIATIONS


def test_wrong_weights_would_be_caught() -> None:
    """Negative control: chains that take every proposal give the approximation, not the target."""

    def flat(normal: approximation.Mixture) -> approximation.LogDensity:
        # The approximation's own density as target: everything is accepted.
        (part,) = normal.parts
        return gaussian(part.centre, part.factor @ part.factor.T)

    normal = skewed_approximation()
    mean = np.array([digamma(SHAPE), 0.5 * digamma(SHAPE)])
    variance = np.array([polygamma(1, SHAPE), 1.0 + 0.25 * polygamma(1, SHAPE)])
    done = run(flat(normal), normal)
    assert np.abs(misses(done.draws, mean, variance)).max() > DEVIATIONS


def test_a_poor_approximation_is_still_exact_in_many_dimensions() -> None:
    """20 dimensions, centre 0.15 spreads off everywhere and 15 % too narrow."""
    matrix = some_covariance(20)
    centre = np.linspace(-1.0, 1.0, 20)
    wrong = centre + 0.15 * np.sqrt(np.diag(matrix))
    done = run(gaussian(centre, matrix), straight(wrong, 0.85**2 * matrix, NONE, 2), steps=6000)
    assert np.abs(misses(done.draws, centre, np.diag(matrix))).max() < DEVIATIONS


def test_adapting_never_changes_a_point() -> None:
    target = log_gamma_times_normal
    normal = skewed_approximation()
    done = run(target, normal, steps=50)
    v = np.random.default_rng(0).normal(0.6, 1.4, (100, crank_nicolson.CHAINS, 2))
    better = approximation.adapted(normal, v)
    part = better.parts[0]
    assert part.shift == pytest.approx(np.full(2, 0.6), abs=0.3)
    assert part.scale == pytest.approx(np.full(2, 1.4), abs=0.2)
    after = crank_nicolson.moved(target, normal, better, done.state)
    np.testing.assert_allclose(after.y, done.state.y, rtol=1e-12)
    # Weights are target over approximation: from the densities of both normals, written out.
    w = np.linalg.solve(part.factor, (after.y[:, part.order] - part.centre[part.order]).T).T
    z = (w - part.shift) / part.scale
    expected = target(after.y) + 0.5 * np.sum(z**2, axis=1)
    difference = after.log_weight - expected
    np.testing.assert_allclose(difference, difference[0], atol=1e-9)


def test_little_that_stands_out_is_not_learnt() -> None:
    normal = skewed_approximation()
    v = np.random.default_rng(0).standard_normal((200, crank_nicolson.CHAINS, 2))
    same = approximation.adapted(normal, v)
    assert not same.parts[0].shift.any()
    np.testing.assert_array_equal(same.parts[0].scale, 1.0)


def test_same_seed_same_draws() -> None:
    one, two, other = (
        run(log_gamma_times_normal, skewed_approximation(seed), steps=40) for seed in (4, 4, 5)
    )
    np.testing.assert_array_equal(one.draws, two.draws)
    assert not np.array_equal(one.draws, other.draws)


def test_a_run_stopped_and_resumed_is_the_same() -> None:
    normal = skewed_approximation()
    state = crank_nicolson.init(log_gamma_times_normal, normal)
    for _ in range(30):
        state, _ = crank_nicolson.step(log_gamma_times_normal, normal, state)
    resumed = crank_nicolson.State(
        state.v.copy(), state.y.copy(), state.part.copy(), state.log_weight.copy(), state.steps
    )
    for _ in range(5):
        state, _ = crank_nicolson.step(log_gamma_times_normal, normal, state)
        resumed, _ = crank_nicolson.step(log_gamma_times_normal, normal, resumed)
    np.testing.assert_array_equal(state.y, resumed.y)


def test_impossible_everywhere_is_an_ending() -> None:
    def never(y: FloatArray) -> FloatArray:
        return np.full(y.shape[0], np.nan)

    normal = skewed_approximation()
    _, info = crank_nicolson.step(never, normal, crank_nicolson.init(never, normal))
    assert info.ending is Ending.NOT_FINITE


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
    ours = crank_nicolson.effective_sample_size(autoregressive(phi, n, chains))[0]
    assert ours == pytest.approx(n * chains * (1.0 - phi) / (1.0 + phi), rel=0.12)


def test_chains_that_disagree_are_told() -> None:
    together = autoregressive(0.3, 1000, 8)
    assert crank_nicolson.split_r_hat(together)[0] < 1.01
    apart = together + 0.5 * np.arange(8)[None, :, None]
    # Between-chain variance B/n = 0.25 var(0 … 7) = 1.5, within 1: sqrt(1 + 1.5) or so.
    means = np.repeat(0.5 * np.arange(8.0), 2)
    expected = np.sqrt(1.0 + means.var(ddof=1))
    assert crank_nicolson.split_r_hat(apart)[0] == pytest.approx(expected, rel=0.05)
    drifting = together + np.linspace(0.0, 2.0, 1000)[:, None, None]
    # The halves lie one apart, a variance of 4/15 between 16 of them; within them 1 + 1/12.
    expected = np.sqrt(1.0 + (4.0 / 15.0) / (1.0 + 1.0 / 12.0))
    assert crank_nicolson.split_r_hat(drifting)[0] == pytest.approx(expected, rel=0.03)


def test_effective_sample_size_knows_of_chains_that_disagree() -> None:
    apart = autoregressive(0.3, 1000, 8) + 0.5 * np.arange(8)[None, :, None]
    assert crank_nicolson.effective_sample_size(apart)[0] < 100.0
