"""Sensors that lean measure how the truck shakes along the road: all of them, at the same time."""

import pytest

from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from tests.verdicts import faults
from tests.verdicts.faults import Fault, Truth

SETTINGS = IdentificationSettings(method="pre", seed=0, draws=300)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("band_hz", [(0.5, 10.0), (1.0, 5.0), (5.0, 20.0)])
def test_leaning_sensors_on_a_shaking_truck_are_named(band_hz: tuple[float, float]) -> None:
    fault = faults.tilted(5.0, 0.1, band_hz)
    result = faults.identified(faults.crossing(Truth(), fault), SETTINGS)
    assert result.verdict != "good"
    assert Reason.COMMON_DISTURBANCE in result.reasons


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_friction_is_no_common_disturbance() -> None:
    fault = Fault(car=lambda car: car._replace(dry_friction_n=(1000.0, 1300.0)))
    result = faults.identified(faults.crossing(Truth(), fault), SETTINGS)
    assert Reason.COMMON_DISTURBANCE not in result.reasons
    assert Reason.CHANNEL_SLIPPED not in result.reasons
