"""Speeds that contradict positions: a Doppler, or a unit, that is off by a few percent."""

import numpy as np
import pytest

from pre_core.diagnostics.receiver import speed_scale
from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from tests.verdicts import faults
from tests.verdicts.faults import Fault, Truth

SETTINGS = IdentificationSettings(method="pre", seed=0, draws=300)


@pytest.mark.parametrize(
    ("seed", "factor"),
    [
        (1, 1.03),
        pytest.param(2, 0.97, marks=pytest.mark.slow),
        pytest.param(2, 1.03, marks=pytest.mark.slow),
        pytest.param(3, 1.03, marks=pytest.mark.slow),
    ],
)
def test_speeds_that_are_off_by_three_percent_are_named(seed: int, factor: float) -> None:
    result = faults.identified(faults.crossing(Truth(seed=seed), Fault(speeds=factor)), SETTINGS)
    assert Reason.SPEED_INCONSISTENT in result.reasons
    assert result.verdict != "good"


def scale_of(seed: int, factor: float, slow_m: float = 1.5) -> tuple[float, float]:
    """Of ten fixes a second over ten seconds at 10 m/s."""
    rng = np.random.default_rng(seed)
    time_s = np.linspace(0.0, 10.0, 101)
    drift = slow_m * np.sqrt(2.0 * 0.1 / 300.0) * np.cumsum(rng.standard_normal(101))
    position = 10.0 * time_s + drift + 0.4 * rng.standard_normal(101)
    speed = factor * (10.0 + 0.07 * rng.standard_normal(101))
    return speed_scale(time_s, position, speed, noise_m=0.4, spread_m=1.5)


def test_speed_scale_is_what_the_speeds_are_off_by() -> None:
    found = [scale_of(seed, 1.03) for seed in range(400)]
    error = np.array([(scale - 0.03) / spread for scale, spread in found])
    assert abs(error.mean()) < 0.2
    assert error.std() == pytest.approx(1.0, abs=0.15)


def test_speed_scale_of_few_fixes_is_unknown() -> None:
    three = np.arange(3.0)
    assert speed_scale(three, three, three, noise_m=0.4, spread_m=1.5) == (0.0, np.inf)
