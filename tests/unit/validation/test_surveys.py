"""Whole surveys: what is the same in all crossings, what is run again, and what is counted."""

from pathlib import Path

import numpy as np
import pytest

from schemas.settings import IdentificationSettings
from services.cli import validation
from services.common.errors import InputError
from services.simulation.drawn import default_site
from services.validation import surveys
from services.validation.calibration import Record
from services.validation.surveys import (
    HEADINGS,
    KINDS,
    Fused,
    fused_surveys,
    rows,
    run_surveys,
    survey_checks,
)
from tests.unit.identification.test_fusing import ELEMENTS, NOMINAL, crossing


def test_the_kinds_are_those_of_the_command() -> None:
    assert tuple(KINDS) == validation.KINDS


def test_a_survey_has_one_truck_one_bridge_and_one_road() -> None:
    site = default_site()
    kind = KINDS["twin"]._replace(changes=0.05)
    of = surveys._site_of(site, kind, 0)
    one, other = (surveys._truth(of, kind, 3, number, 0) for number in (0, 1))
    assert one[0].car == other[0].car
    assert one[0].conditions.road_seed == other[0].conditions.road_seed == 3
    assert one[1] != other[1]
    assert one[0].conditions.speed_m_per_s != other[0].conditions.speed_m_per_s
    assert abs(one[0].conditions.speed_m_per_s / 10.0 - 1.0) <= 0.15
    change = one[0].beam.flexural_rigidity_nm2 / other[0].beam.flexural_rigidity_nm2
    assert 0.0 < np.abs(np.log(change)).max() < 0.4
    assert np.ptp(np.log(change)) == pytest.approx(0.0, abs=1e-12)  # common in every other survey
    assert surveys._truth(of, kind, 4, 0, 0)[0].car != one[0].car


def test_trucks_take_turns() -> None:
    site = default_site()
    loaded, empty = (surveys._site_of(site, KINDS["loaded-and-empty"], k) for k in (0, 1))
    assert loaded.vehicles[0].total_mass_kg > 3.0 * empty.vehicles[0].total_mass_kg
    assert loaded.vehicles[0].id != empty.vehicles[0].id
    three = surveys._site_of(site, KINDS["three-elements"], 0)
    assert len(three.bridges[0].lengths_m) == 3


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
    ((name, *cells),) = rows(found)
    assert name == "steady"
    assert len(cells) == len(HEADINGS) - 1
    assert all(check.is_met for check in survey_checks(found))
    wrong = Fused(*one._replace(z=one.z + 5.0, inside=np.zeros(ELEMENTS, dtype=np.bool_)))
    assert not any(check.is_met for check in survey_checks([wrong]))


def test_what_was_driven_is_not_driven_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven = []

    def one(site: object, kind: str, survey: int, number: int, settings: object) -> Record:
        assert isinstance(settings, IdentificationSettings)
        driven.append((kind, survey, number))
        of = surveys._site_of(default_site(), KINDS[kind], 0)
        return record(kind, survey, number) | {"identity": surveys.identity_of(of, settings)}

    monkeypatch.setattr(surveys, "one_crossing", one)
    path = tmp_path / "surveys.jsonl"
    first = run_surveys(default_site(), ["single-10"], 1, path, 1)
    assert len(first) == len(driven) == 8
    again = run_surveys(default_site(), ["single-10"], 2, path, 1)
    assert (len(again), len(driven)) == (16, 16)
    path.write_text("something else\n")
    with pytest.raises(InputError, match="no record"):
        run_surveys(default_site(), ["single-10"], 1, path, 1)
