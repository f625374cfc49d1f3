"""Certificates as files, and what their hash depends on."""

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from schemas import validation_records
from schemas.errors import InputError
from schemas.site import Site
from schemas.site_file import parse_site, site_toml
from schemas.validation_records import (
    VehicleBridgePair,
    load_validation,
    pair_hash,
    validation_json,
    validation_path,
)
from tests.builders.certificates import PAIR, SETTINGS, SITE, certificate, tried


def changed(part: str, **values: Any) -> Site:
    """The paper's site with other values in one table."""
    if part in ("sensor", "receiver"):
        return SITE.model_copy(update={part: getattr(SITE, part).model_copy(update=values)})
    one = getattr(SITE, part)[0].model_copy(update=values)
    return SITE.model_copy(update={part: (one,)})


@pytest.mark.parametrize(
    ("part", "values"),
    [
        ("vehicles", {"total_mass_kg": 9531.0}),
        ("vehicles", {"total_mass_kg_spread": 0.02}),
        ("vehicles", {"twin_tyre_distance_m": (0.0, 0.33)}),
        ("bridges", {"span_m": 30.1}),
        ("bridges", {"elements": 6}),
        ("bridges", {"flexural_rigidity_nm2_spread": 0.5}),
        ("bridges", {"survey_speed_m_per_s": 12.0}),
        ("bridges", {"road_class": "C"}),
        ("bridges", {"bearings": ("free", "free")}),
        ("sensor", {"rate_hz": (500.0,) * 4}),
        ("sensor", {"noise_density_ug_per_rthz": (25.0, 25.0, 25.0, 26.0)}),
        ("receiver", {"position_noise_m": 0.5}),
    ],
)
def test_what_matters_changes_the_hash(part: str, values: dict[str, Any]) -> None:
    assert pair_hash(changed(part, **values), PAIR, SETTINGS) != pair_hash(SITE, PAIR, SETTINGS)


@pytest.mark.parametrize("values", [{"owner_id": "B 17/4"}, {"baseline": "before.json"}])
def test_owner_facts_of_a_bridge_do_not_change_the_hash(values: dict[str, Any]) -> None:
    assert pair_hash(changed("bridges", **values), PAIR, SETTINGS) == pair_hash(
        SITE, PAIR, SETTINGS
    )


def test_neither_order_nor_others_change_the_hash() -> None:
    tables = f"\n{site_toml(SITE)}".split("\n[")[1:]
    turned = "".join(
        "[" + lines[0] + "\n" + "\n".join(lines[:0:-1]) + "\n"
        for lines in (table.strip().split("\n") for table in reversed(tables))
    )
    other = parse_site(turned, "turned.toml")
    assert other == SITE
    more = SITE.model_copy(
        update={
            "vehicles": (SITE.vehicles[0].model_copy(update={"id": "truck-2"}), *SITE.vehicles),
            "bridges": (SITE.bridges[0].model_copy(update={"id": "bridge-2"}), *SITE.bridges),
        }
    )
    assert {pair_hash(site, PAIR, SETTINGS) for site in (SITE, other, more)} == {
        pair_hash(SITE, PAIR, SETTINGS)
    }
    assert pair_hash(more, VehicleBridgePair("truck-2", "bridge-1"), SETTINGS) != pair_hash(
        SITE, PAIR, SETTINGS
    )


def test_another_method_needs_another_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    one = pair_hash(SITE, PAIR, SETTINGS)
    for values in ({"draws": 1300}, {"parts": 3}, {"method": "least_squares"}):
        assert pair_hash(SITE, PAIR, SETTINGS.model_copy(update=values)) != one
    for values in ({"seed": 2}, {"threads": 1}):
        assert pair_hash(SITE, PAIR, SETTINGS.model_copy(update=values)) == one
    monkeypatch.setattr(validation_records, "METHOD_EDITION", validation_records.METHOD_EDITION + 1)
    assert pair_hash(SITE, PAIR, SETTINGS) != one


def test_a_pair_that_the_site_has_not_is_an_error() -> None:
    with pytest.raises(KeyError):
        pair_hash(SITE, VehicleBridgePair("truck-1", "bridge-9"), SETTINGS)


def test_a_file_comes_back_as_it_was(tmp_path: Path) -> None:
    whole = certificate(crossings=(tried(weak_element=2), tried(1, verdict="suspect")))
    path = validation_path(tmp_path, whole.hash)
    path.write_text(validation_json(whole))
    assert load_validation(path) == whole


def test_invalid_certificate_gives_one_line(tmp_path: Path) -> None:
    good = json.loads(validation_json(certificate()))
    path = validation_path(tmp_path, good["hash"])
    for content, what in (
        ("{", "not a validation record"),
        (json.dumps(good | {"passed": None}), "passed"),
        (json.dumps(good | {"more": 1}), "more"),
        (json.dumps(good | {"hash": "0" * 16}), "hash: is 0000000000000000"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match=what) as error:
            load_validation(path)
        assert str(error.value).startswith(str(path))
    with pytest.raises(InputError, match="no such file"):
        load_validation(tmp_path / "none.json")


@pytest.mark.parametrize(
    "values",
    [
        {"verdict": "rejected"},
        {"ei_ratio_q50": (1.0,)},
        {"ei_ratio_q025": (0.8, 0.0)},
        {"ei_ratio": (1.0, float("nan"))},
        {"weak_element": 3},
    ],
)
def test_a_crossing_that_does_not_fit_together_is_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        tried(**values)


EI_OF_EDITION_14 = (1.79879, 1.52305, 1.55499, 0.63078, 1.57400, 1.56275, 1.57228)
"""Means of the elements of the sample's reference estimate, over 1e10 N·m²."""


def test_another_answer_is_another_edition(project: Path) -> None:
    """Who moves the reference estimate by a tenth of a standard deviation makes another method.

    Then raise METHOD_EDITION, and put the new numbers here.
    """
    text = (project / "tests" / "data" / "reference_estimate.json").read_text()
    estimates = json.loads(text)["sample"]["estimates"]
    assert validation_records.METHOD_EDITION == 14
    for number, mean in enumerate(EI_OF_EDITION_14, start=1):
        now = estimates[f"EI_{number}"]
        assert abs(now["mean"] / 1e10 - mean) < 0.1 * now["std"] / 1e10
