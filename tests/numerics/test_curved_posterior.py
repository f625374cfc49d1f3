"""Fused crossings whose likelihoods are curved: the density, absence, and intervals that hold."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import expit

from pre_core.arrays import FloatArray
from pre_core.fusion.curvature import CurvatureTerms
from pre_core.fusion.curved_posterior import CurvedSum, curved_draws, curved_sum
from pre_core.fusion.information import BridgePriors
from pre_core.fusion.joint import build_joint, sample_joint
from pre_core.fusion.likelihood import Coordinates, CrossingLikelihood
from pre_core.fusion.path_groups import FusionInput, path_groups
from pre_core.physics.surface import TYPICAL_FOOTPRINTS

SIGMA = 0.55
NAMES = ("rhoA", "k_rot_start", "EI_1", "EI_2", "EI_3")
BRIDGE = Coordinates(
    NAMES,
    np.array([4000.0, 0.0, 1.5e10, 1.5e10, 1.5e10]),
    np.array([0.1, 5e8, SIGMA, SIGMA, SIGMA]),
    np.array([True, False, True, True, True]),
)
GAIN = Coordinates(("common_gain",), np.ones(1), np.array([0.01]), np.array([True]))
PRIORS = BridgePriors(BRIDGE, np.zeros(5), np.full(5, -np.inf), elements=3)
ABOUT = np.array([0.0, 0.5, 1.0, 1.0, 1.0])
SIZE = np.array([1.0, 1.0, 0.6, 0.6, 0.6, 0.5])
PAIRS = np.triu_indices(6)
OF_PLACE = (PAIRS[0] == 5) | (PAIRS[1] == 5)


def terms(*, place_is_coupled: bool = False, is_strong: bool = False) -> CurvatureTerms:
    """Two terms: an end that is restrained hides its element, and one of an offset."""
    shapes = np.zeros((2, PAIRS[0].size))
    shapes[0, np.flatnonzero((PAIRS[0] == 1) & (PAIRS[1] == 2))] = 1.0
    shapes[0, np.flatnonzero((PAIRS[0] == 1) & (PAIRS[1] == 1))] = 0.5
    shapes[1] = 0.05 * np.random.default_rng(4).standard_normal(PAIRS[0].size)
    if not place_is_coupled:
        shapes[:, OF_PLACE] = 0.0
    if is_strong:
        shapes *= np.array([[4.0], [10.0]])
    return CurvatureTerms(ABOUT, np.diag(SIZE), shapes, logarithms=3)


def state(of: CurvatureTerms, y: FloatArray, gain: float, place: float) -> FloatArray:
    """Return all coordinates (9,) of a bridge y (5,) in standard deviations, pair by pair."""
    at = np.concatenate([y[:2], -SIGMA * y[2:]])
    u = np.append(at - np.concatenate([ABOUT[:2], np.log(ABOUT[2:])]), place) / SIZE
    bend = [
        sum(factor * u[i] * u[j] for factor, i, j in zip(shape, *PAIRS, strict=True))
        for shape in of.shapes
    ]
    return np.concatenate([at, [gain, place], bend])


def root(seed: int) -> FloatArray:
    """Return rows (9, 9) that know the sum of the elements and of restraint well, little else."""
    rng = np.random.default_rng(seed)
    rows = 0.3 * rng.standard_normal((9, 9))
    rows[0, :5] += [1.0, 2.0, 3.0, 2.0, 1.0]
    rows[1, 7] += 1.5
    rows += np.diag([0.3, 0.5, 1.0, 2.0, 2.0, 0.1, 3.0, 0.5, 0.5])
    return np.asarray(np.linalg.qr(rows)[1])


def crossing(
    number: int,
    y: FloatArray,
    rng: np.random.Generator,
    *,
    place_is_coupled: bool = False,
    is_strong: bool = False,
) -> FusionInput:
    of = terms(place_is_coupled=place_is_coupled, is_strong=is_strong)
    rows = root(1 + number % 3)
    x = state(of, y, 0.0, 0.2 * float(rng.standard_normal()))
    likelihood = CrossingLikelihood(
        rows,
        rows @ x + rng.standard_normal(9),
        BRIDGE,
        GAIN,
        np.zeros(0),
        np.zeros(2),
        None,
        of,
    )
    return FusionInput(f"{number:02d}", likelihood, "truck", 1, TYPICAL_FOOTPRINTS, 0.0)


def summed(parts: list[FusionInput]) -> CurvedSum:
    return curved_sum(parts, path_groups(parts), build_joint(parts, PRIORS), PRIORS, (0.0, 0.0))


def profile(parts: list[FusionInput], y: FloatArray) -> float:
    """Return the log posterior at y (5,) with the best gain and offsets, by a general search."""

    def squares(unknown: FloatArray) -> float:
        total = float(unknown[0] ** 2 + y @ y)
        for part, place in zip(parts, unknown[1:], strict=True):
            of = part.likelihood
            assert of.bends is not None
            left = of.target - of.root @ state(of.bends, y, unknown[0], place)
            total += float(left @ left)
        return total

    return -0.5 * float(minimize(squares, np.zeros(1 + len(parts)), tol=1e-12).fun)


@pytest.mark.parametrize(("place_is_coupled", "largest"), [(False, 1e-6), (True, 0.1)])
def test_density_is_the_best_fit_of_all_else(place_is_coupled: bool, largest: float) -> None:
    """What is linear is exact; an offset whose effect depends on the bridge nearly so."""
    rng = np.random.default_rng(2)
    y = np.array([0.3, 0.6, 0.5, -0.2, 0.1])
    parts = [crossing(i, y, rng, place_is_coupled=place_is_coupled) for i in range(4)]
    bridges = y + 0.3 * rng.standard_normal((6, 5))
    with ThreadPoolExecutor(2) as pool:
        found = summed(parts).log_posterior(bridges, pool)
    expected = np.array([profile(parts, one) for one in bridges])
    assert np.ptp(expected) > 3.0
    assert np.abs(found - expected - np.mean(found - expected)).max() < largest


def test_beyond_the_reach_of_the_terms_residuals_are_linear_in_compliance() -> None:
    parts = [crossing(0, np.array([0.0, 0.5, 0.0, 0.0, 0.0]), np.random.default_rng(1))]
    form = summed(parts).crossings[0].form
    at = np.repeat(ABOUT[None, :], 3, axis=0)
    at[:, 2] = [10.0, 11.0, 12.0]  # the terms reach to c = exp(2 · 0.6)
    left = form.features(at) @ form.rows.T
    assert np.allclose(left[0] - 2.0 * left[1] + left[2], 0.0, atol=1e-9)
    assert np.abs(left[1] - left[0]).max() > 0.1


@pytest.mark.parametrize("log_odds", [-1.0, 1.5])
def test_absence_has_its_probability(log_odds: float) -> None:
    """A restraint that no crossing observes: absent with its prior probability."""
    of = terms()._replace(shapes=np.zeros((1, PAIRS[0].size)))
    rows = np.asarray(np.linalg.qr(np.diag([1.0, 1e-6, 3.0, 3.0, 3.0, 1.0, 1.0, 1.0]))[1])
    likelihood = CrossingLikelihood(
        rows, rows @ np.zeros(8), BRIDGE, GAIN, np.zeros(0), np.zeros(2), None, of
    )
    part = FusionInput("0", likelihood, "truck", 1, TYPICAL_FOOTPRINTS, 0.0)
    priors = PRIORS._replace(log_odds=np.array([-np.inf, log_odds, -np.inf, -np.inf, -np.inf]))
    information = build_joint([part], priors)
    of_one = curved_sum([part], path_groups([part]), information, priors, (0.0, 0.0))
    found = curved_draws(of_one, priors, 4000, np.random.default_rng(1))
    restraint = found[:, 1]
    assert restraint.min() == 0.0
    # The half normal has the mass sqrt(pi/2) per density at zero.
    expected = expit(log_odds - 0.5 * np.log(0.5 * np.pi))
    assert np.mean(restraint == 0.0) == pytest.approx(expected, abs=0.04)
    assert np.sqrt(np.mean(restraint[restraint > 0.0] ** 2)) == pytest.approx(1.0, abs=0.08)


def test_intervals_hold_the_truth_where_likelihoods_are_curved() -> None:
    """24 bridges of the priors, eight crossings each.

    On a normal about the most likely bridge, errors of the first element are five standard
    deviations, of the restraint thirty.
    """
    rng = np.random.default_rng(8)
    inside, z = [], []
    for _ in range(24):
        y = rng.standard_normal(5)
        y[1] = abs(y[1])
        parts = [crossing(i, y, rng, place_is_coupled=True, is_strong=True) for i in range(8)]
        found = sample_joint(parts, build_joint(parts, PRIORS), PRIORS, 50, 3)
        of = found.draws.reshape(-1, 5)
        low, high = np.quantile(of, [0.025, 0.975], axis=0)
        inside.append(((low < y) & (y < high))[1:])
        z.append(((of.mean(axis=0) - y) / of.std(axis=0))[1:])
    assert 0.9 <= np.mean(inside) <= 0.99  # 96 intervals
    assert 0.85 < np.sqrt(np.mean(np.square(z))) < 1.15


def test_order_of_crossings_and_number_of_threads_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    parts = [crossing(i, np.array([0.0, 0.6, 0.5, 0.0, 0.0]), rng) for i in range(5)]
    one, other = (
        sample_joint(some, build_joint(some, PRIORS), PRIORS, 20, 1, threads=threads).draws
        for some, threads in ((parts, 1), (parts[::-1], 3))
    )
    assert np.array_equal(one, other)
