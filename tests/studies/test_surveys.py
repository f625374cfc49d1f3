"""Whole surveys: what is the same in all crossings, what is run again, and what is counted."""

from pathlib import Path

import numpy as np
import pytest

from schemas.settings import IdentificationSettings
from services.common.errors import InputError
from services.simulation.drawn import draw_truth
from services.simulation.survey_kinds import KINDS
from studies.simulation.truths import default_site
from studies.validation import surveys
from studies.validation.calibration import Record
from studies.validation.surveys import (
    HEADINGS,
    Forecast,
    FusedSurvey,
    fused_surveys,
    rows,
    run_surveys,
    survey_checks,
)
from tests.unit.identification.test_fusing import ELEMENTS, NOMINAL, crossing


def test_a_survey_has_one_truck_one_bridge_and_one_road() -> None:
    site = default_site()
    kind = KINDS["twin"]._replace(changes=0.05)
    of = surveys.site_of_truck(site, kind, 0)
    one, other = (surveys.crossing_truth(of, kind, 3, number, 0) for number in (0, 1))
    assert one[0].car == other[0].car
    assert one[0].conditions.road_seed == other[0].conditions.road_seed == 3
    assert one[1] != other[1]
    assert one[0].conditions.speed_m_per_s != other[0].conditions.speed_m_per_s
    assert abs(one[0].conditions.speed_m_per_s / 10.0 - 1.0) <= 0.15
    change = one[0].beam.flexural_rigidity_nm2 / other[0].beam.flexural_rigidity_nm2
    assert 0.0 < np.abs(np.log(change)).max() < 0.4
    assert np.ptp(np.log(change)) == pytest.approx(0.0, abs=1e-12)  # common in every other survey
    assert surveys.crossing_truth(of, kind, 4, 0, 0)[0].car != one[0].car


def test_trucks_take_turns() -> None:
    site = default_site()
    loaded, empty = (surveys.site_of_truck(site, KINDS["loaded-and-empty"], k) for k in (0, 1))
    assert loaded.vehicles[0].total_mass_kg > 3.0 * empty.vehicles[0].total_mass_kg
    assert loaded.vehicles[0].id != empty.vehicles[0].id
    three = surveys.site_of_truck(site, KINDS["three-elements"], 0)
    assert len(three.bridges[0].lengths_m) == 3


def test_a_scenario_is_at_a_level_of_its_own_in_every_survey() -> None:
    site, kind = default_site(), KINDS["scenario-11"]
    nominal = np.array(site.bridges[0].nominal_flexural_rigidity_nm2)
    levels = set()
    for survey in range(4):
        truth, _ = surveys.crossing_truth(site, kind, survey, 5, 0)
        ratio = truth.beam.flexural_rigidity_nm2 / nominal
        assert np.array_equal(
            truth.beam.flexural_rigidity_nm2, surveys._survey_truth(site, kind, survey)
        )
        assert ratio / ratio[0] == pytest.approx([1.0] * 6 + [0.7])
        assert truth.conditions.noise_ug_per_rthz == 100.0
        levels.add(float(ratio[0]))
    assert len(levels) == 4
    # The same truck, bearings and road as with another scenario: only EI differs.
    other, _ = surveys.crossing_truth(site, KINDS["scenario-1"], 3, 5, 0)
    assert other.car == truth.car
    assert other.conditions == truth.conditions
    assert surveys.sites_of(site, kind)[0].sensor.noise_density_ug_per_rthz == (100.0,) * 4


def test_what_was_driven_before_has_its_truth_still() -> None:
    """Of kinds without weak elements EI comes from the seeds it always came from."""
    site = default_site()
    for name, kind in KINDS.items():
        if surveys.weak_ratios(site.bridges[0], kind) is None and not kind.elements:
            of = surveys.site_of_truck(site, kind, 0)
            drawn = draw_truth(of, 3000).beam.flexural_rigidity_nm2
            assert np.array_equal(surveys._survey_truth(of, kind, 3), drawn), name


def test_trucks_of_a_mixed_fleet_cross_the_same_bridge() -> None:
    site, kind = default_site(), KINDS["mixed-fleet"]
    of_trucks = [surveys.site_of_truck(site, kind, truck) for truck in (0, 1)]
    assert [one.vehicles[0].tandem is None for one in of_trucks] == [False, True]
    truths = [
        surveys.crossing_truth(of, kind, 2, truck, truck)[0] for truck, of in enumerate(of_trucks)
    ]
    tandem, lorry = truths
    rigidity = tandem.beam.flexural_rigidity_nm2
    np.testing.assert_array_equal(rigidity, lorry.beam.flexural_rigidity_nm2)
    # The simulation with two sides has wheel paths of its own.
    assert tandem.paths is None
    assert lorry.paths is not None
    declared = surveys.sites_of(site, kind)
    assert [one.vehicles[0].tandem is None for one in declared] == [False, True]


def record(kind: str, survey: int, number: int) -> Record:
    return {
        "effect": kind,
        "seed": survey,
        "number": number,
        "verdict": "good",
        "truth": [NOMINAL * r for r in (1.0, 1.0, 0.6, 1.0, 1.0)],
        "result": crossing(number).model_dump(mode="json"),
    }


def test_surveys_are_fused_beside_their_truth() -> None:
    found = fused_surveys([record("steady", 0, n) for n in range(4)])
    (one,) = found
    assert (one.used, one.out, one.verdict) == (4, 0, "good")
    assert one.inside.sum() >= ELEMENTS - 1
    assert np.abs(one.z).max() < 3.0
    ((name, *cells),) = rows(found, {})
    assert name == "steady"
    assert len(cells) == len(HEADINGS) - 1
    ((*_, element, _, level, _),) = rows(found, {"steady": Forecast(0.123, 0.045)})
    assert (element, level) == ("12.3 %", "4.5 %")
    assert np.array_equal(one.truth, record("steady", 0, 0)["truth"])
    assert all(check.is_met for check in survey_checks(found))
    wrong = FusedSurvey(*one._replace(z=one.z + 5.0, inside=np.zeros(ELEMENTS, dtype=np.bool_)))
    assert not any(check.is_met for check in survey_checks([wrong]))


def test_what_was_driven_is_not_driven_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = []

    def one(site: object, kind: str, survey: int, number: int, settings: object) -> Record:
        assert isinstance(settings, IdentificationSettings)
        driven.append((kind, survey, number))
        of = surveys.site_of_truck(default_site(), KINDS[kind], 0)
        return record(kind, survey, number) | {"identity": surveys.survey_identity(of, settings)}

    monkeypatch.setattr(surveys, "one_crossing", one)
    path = tmp_path / "surveys.jsonl"
    first = run_surveys(default_site(), ["single-10"], 1, path, 1)
    assert len(first) == len(driven) == 8
    again = run_surveys(default_site(), ["single-10"], 2, path, 1)
    assert (len(again), len(driven)) == (16, 16)
    path.write_text("something else\n")
    with pytest.raises(InputError, match="no record"):
        run_surveys(default_site(), ["single-10"], 1, path, 1)
