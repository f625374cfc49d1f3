"""Another pavement on the bridge: noise of two levels, its level from short waves, and joints."""

import numpy as np
import pytest

from pre_core.crossing import mismatch as mm
from pre_core.crossing.mismatch import BridgePavement
from pre_core.crossing.noise import no_suspension_noise, noise_spectrum
from pre_core.crossing.pavement import RATIO_SPREAD, TILT_SPREAD, fit_ratio, parts_of
from pre_core.crossing.rows import RESIDUALS, phases, row_filter
from pre_core.crossing.whitening import whitener
from tests.numerics.test_pre_mismatch import QUIET, STEP_S, of_level, truck, true_level

COUNT = 400
SAME = np.zeros(2)


def share() -> np.ndarray:
    """The bridge in the middle, with a blend at both ends."""
    along = np.arange(COUNT)
    return np.clip(0.1 * np.minimum(along - 120, 290 - along), 0.0, 1.0)


def with_pavement(found: np.ndarray, covariance: np.ndarray | None = None) -> mm.Mismatch:
    known = np.zeros((2, 2)) if covariance is None else covariance
    return of_level(true_level("A"))._replace(pavement=BridgePavement(found, known, share()))


def mean_of(road: mm.Mismatch, n: float) -> float:
    density = road.level_m3 @ road.shapes.density
    return float(np.interp(n, road.shapes.cycles_per_m, density))


def test_factor_is_that_of_a_dense_covariance() -> None:
    rows = row_filter(STEP_S)
    road = with_pavement(np.array([np.log(2.5), 0.1]))
    noise = whitener(rows, COUNT, truck(), QUIET, no_suspension_noise(), road)
    n, width = noise.factor.shape
    factor = np.zeros((n, n))
    for i in range(n):
        low = max(0, i - width + 1)
        factor[i, low : i + 1] = noise.factor[i, low - i + width - 1 :]
    turn = phases(rows, mm.correlation_time_s(road))
    weights = [1.0 - share(), share()]
    of_sensors = (
        noise_spectrum(truck(), QUIET, no_suspension_noise(), None, rows.omega) * rows.power
    )
    lags = turn.shape[1]
    expected = np.zeros((n, n))
    covariance = (of_sensors @ turn).real
    for back in range(lags):
        for i in range(RESIDUALS):
            for j in range(RESIDUALS):
                k = np.arange(COUNT - back)
                expected[RESIDUALS * (k + back) + i, RESIDUALS * k + j] = covariance[i, j, back]
    for one, weight in zip((road, mm.on_bridge(road)), weights, strict=True):
        extra = (mm.spectrum(one, rows.omega) * rows.omega**4 * rows.power @ turn).real
        for back in range(lags):
            k = np.arange(COUNT - back)
            both = np.sqrt(weight[k] * weight[k + back])
            expected[RESIDUALS * (k + back), RESIDUALS * k] += both * extra[back]
    found = np.tril(factor @ factor.T)
    scale = np.sqrt(np.diag(expected))
    apart = np.abs(found - np.tril(expected)) / np.outer(scale, scale)
    assert apart.max() < 1e-6


def test_same_pavement_gives_the_same_noise_away_from_the_ends() -> None:
    rows, road = row_filter(STEP_S), of_level(true_level("A"))
    plain = whitener(rows, COUNT, truck(), QUIET, no_suspension_noise(), road)
    same = whitener(rows, COUNT, truck(), QUIET, no_suspension_noise(), with_pavement(SAME))
    before = slice(0, RESIDUALS * 100)
    np.testing.assert_allclose(same.factor[before], plain.factor[before], rtol=1e-6, atol=1e-9)
    # The window, which spreads the longest waves, acts twice on the spectrum of the bridge.
    middle = RESIDUALS * 210
    assert same.reciprocal[middle] == pytest.approx(plain.reciprocal[middle], rel=0.05)


def test_expected_power_of_an_uncertain_ratio() -> None:
    certain = mean_of(mm.on_bridge(with_pavement(np.array([np.log(2.0), 0.0]))), 1.0)
    assert certain == pytest.approx(4.0 * mean_of(of_level(true_level("A")), 1.0), rel=0.03)
    covariance = np.diag([0.3**2, 0.2**2])
    uncertain = mm.on_bridge(with_pavement(np.array([np.log(2.0), 0.0]), covariance))
    assert mean_of(uncertain, 1.0) == pytest.approx(np.exp(2.0 * 0.09) * certain, rel=0.03)
    # Long waves are known less than short ones.
    long = mean_of(uncertain, 0.1) / mean_of(mm.on_bridge(with_pavement(np.log([2.0, 1.0]))), 0.1)
    assert long > 1.3


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.5])
def test_ratio_is_found_in_drawn_periodograms(ratio: float) -> None:
    rng = np.random.default_rng(3)
    n = np.arange(0.3, 3.0, 1.0 / 30.0)
    shape, known = 1e-8 / (1.0 + (n / 1.4) ** 2) ** 2, np.full(n.size, 1e-11)
    z = []
    for _ in range(200):
        expected = known + ratio**2 * shape
        # Neighbours are correlated: every other frequency counts.
        seen = np.repeat(rng.exponential(size=(n.size + 1) // 2), 2)[: n.size] * expected
        found, covariance = fit_ratio(seen, known, shape, n)
        z.append((found[0] - np.log(ratio)) / np.sqrt(covariance[0, 0]))
    assert abs(np.mean(z)) < 0.5
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.2)


def test_sensor_noise_alone_leaves_the_prior() -> None:
    n = np.arange(0.3, 3.0, 0.05)
    known = np.ones(n.size)
    found, covariance = fit_ratio(known, known, 1e-6 * known, n)
    np.testing.assert_allclose(found, 0.0, atol=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [RATIO_SPREAD, TILT_SPREAD], rtol=1e-3)


def test_parts_count_all_residuals() -> None:
    off, on = parts_of(with_pavement(SAME), COUNT)
    assert off.residuals + on.residuals == pytest.approx(COUNT)
    assert on.residuals == pytest.approx(share().sum())
    assert [one.is_bridge for one in (off, on)] == [False, True]
    assert off.mismatch.pavement is None
    assert on.mismatch.pavement is None
    (whole,) = parts_of(of_level(1e-8), COUNT)
    assert whole.residuals == COUNT
