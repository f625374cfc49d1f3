"""The forecast beside what surveys achieve: from the plan of each kind, at the surveys' own EI."""

import numpy as np
import pytest

from services.planning.crossings import axles_of, scale_error
from services.simulation.survey_kinds import KINDS
from studies.simulation.truths import default_site
from studies.validation import forecasts
from studies.validation.forecasts import forecasts_of
from studies.validation.surveys import FusedSurvey


def fused(kind: str, ratio: float) -> FusedSurvey:
    nominal = np.array(default_site().bridges[0].nominal_flexural_rigidity_nm2)
    nothing = np.zeros(nominal.size)
    return FusedSurvey(
        kind, 0, ratio * nominal, nothing, nothing > 0, nothing, 0.0, False, 0, 0, "good"
    )


def test_each_kind_is_planned_as_it_is_driven() -> None:
    site = default_site()
    (track,) = forecasts._plan(site, KINDS["two-trucks"]).tracks
    assert len({one.site.vehicles[0].total_mass_kg for one in track}) == 2
    there, back = forecasts._plan(site, KINDS["both-ways"]).tracks
    assert [one.forward for one in (*there, *back)] == [True, True, False, False]
    single = forecasts._plan(site, KINDS["single-10"]).site.vehicles[0]
    assert single.twin_tyre_distance_m == (0.0, 0.0)
    assert single.rear_axle_offset_m == 0.01
    everything = forecasts._plan(site, KINDS["everything"]).site.sensor
    assert everything.noise_density_ug_per_rthz == (10.0, 10.0, 25.0, 25.0)
    assert everything.rate_hz == (500.0,) * 4


def test_a_forecast_knows_the_noise_and_the_bridge_of_its_kind() -> None:
    """A bridge that bends more is known better, sensors of four times the noise observe less."""
    site = default_site()
    steady = forecasts_of(site, [fused("steady", 1.0)])["steady"]
    loud = forecasts_of(site, [fused("scenario-1", 1.0)])["scenario-1"]
    soft = forecasts_of(site, [fused("scenario-1", 0.5)])["scenario-1"]
    common = scale_error(site)  # of mass and gain: no crossing shows it
    assert own(loud.element, common) == pytest.approx(4.0 * own(steady.element, common), rel=0.2)
    assert own(soft.element, common) < 0.7 * own(loud.element, common)
    assert common < steady.level < 1.1 * common


def own(std: float, common: float) -> float:
    """Without what is common to all elements."""
    return float(np.sqrt(std**2 - common**2))


def test_plan_of_a_tandem_has_its_truck_and_its_offset() -> None:
    site = default_site()
    for name, offset_m in (("tandem", 0.005), ("tandem-rubbing", 0.005), ("tandem-aside", 0.02)):
        ((slow, fast),) = forecasts._plan(site, KINDS[name]).tracks
        vehicle = slow.site.vehicles[0]
        assert vehicle == fast.site.vehicles[0]
        assert vehicle.tandem is not None
        assert vehicle.tandem.is_equalised
        assert axles_of(vehicle)[1].offset_m == offset_m
        assert slow.site.bridges == site.bridges
