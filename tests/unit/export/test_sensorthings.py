"""Results as SensorThings entities, held against the entity model of the standard (18-088)."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from schemas.results import results_json
from schemas.site_file import load_site, site_toml
from services.cli import main as cli
from services.export.sensorthings import sensorthings
from tests.unit.viewer.found import RATIOS, results_of, some_crossing

MANDATORY = {
    "Things": ("name", "description"),
    "Locations": ("name", "description", "encodingType", "location"),
    "Sensors": ("name", "description", "encodingType", "metadata"),
    "ObservedProperties": ("name", "definition", "description"),
    "FeaturesOfInterest": ("name", "description", "encodingType", "feature"),
    "Datastreams": ("name", "description", "unitOfMeasurement", "observationType"),
    "Observations": ("phenomenonTime", "result", "resultTime"),
}
"""Properties that an entity must have."""
ONE = {
    "Datastreams": {
        "Thing": "Things", "Sensor": "Sensors", "ObservedProperty": "ObservedProperties",
    },
    "Observations": {"Datastream": "Datastreams", "FeatureOfInterest": "FeaturesOfInterest"},
}  # fmt: skip
"""What an entity belongs to exactly one of, and in which set that is."""
INSTANT = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z"


@pytest.fixture
def sets(project: Path) -> dict[str, list[dict[str, Any]]]:
    """Two crossings, one of them rejected, and a state of the bridge."""
    site = load_site(project / "docs/site.example.toml")
    rejected = some_crossing("b", verdict="rejected", reasons=("speed_too_low",), entry=60.0)
    found = results_of(site, some_crossing("a"), rejected, used="a")
    made: dict[str, list[dict[str, Any]]] = json.loads(sensorthings(site, found))
    return made


def test_each_entity_has_what_the_standard_wants(sets: dict[str, list[dict[str, Any]]]) -> None:
    assert sets.keys() == MANDATORY.keys()
    for name, entities in sets.items():
        assert entities
        identifiers = [entity["@iot.id"] for entity in entities]
        assert len(set(identifiers)) == len(identifiers)
        for entity in entities:
            assert [key for key in MANDATORY[name] if entity.get(key) in (None, "")] == []
    for stream in sets["Datastreams"]:
        assert stream["unitOfMeasurement"].keys() == {"name", "symbol", "definition"}
        assert stream["observationType"].endswith("/OM_Measurement")  # so a result is a number
    assert all(isinstance(one["result"], float) for one in sets["Observations"])
    for one in sets["Observations"]:
        assert re.fullmatch(f"{INSTANT}/{INSTANT}", one["phenomenonTime"])
        assert re.fullmatch(INSTANT, one["resultTime"])
    for place in sets["Locations"]:
        assert (place["encodingType"], place["location"]["type"]) == (
            "application/geo+json",
            "LineString",
        )


def test_each_reference_leads_to_an_entity(sets: dict[str, list[dict[str, Any]]]) -> None:
    known = {name: {one["@iot.id"] for one in entities} for name, entities in sets.items()}
    for name, to in ONE.items():
        for entity in sets[name]:
            for reference, where in to.items():
                assert entity[reference]["@iot.id"] in known[where]
    for thing in sets["Things"]:
        (place,) = thing["Locations"]
        assert place["@iot.id"] in known["Locations"]


def test_observations_are_those_of_elements_and_none_of_what_was_rejected(
    sets: dict[str, list[dict[str, Any]]],
) -> None:
    of = {
        kind: [o for o in sets["Observations"] if o["Datastream"]["@iot.id"].endswith(f".{kind}")]
        for kind in ("crossing", "bridge")
    }
    for observations in of.values():
        results = [one["result"] for one in observations]
        assert results == pytest.approx((RATIOS * 15.6e9).tolist())
        assert observations[3]["FeatureOfInterest"] == {"@iot.id": "bridge-1.EI_4"}
        assert observations[3]["parameters"]["q025"] == pytest.approx(0.943 * 0.4 * 15.6e9)
    assert {one["parameters"]["crossing"] for one in of["crossing"]} == {"a"}
    assert of["crossing"][0]["phenomenonTime"].startswith("2026-09-21T")


def test_the_command_writes_them_or_says_what_it_wants(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = load_site(project / "docs/site.example.toml")
    (tmp_path / "site.toml").write_text(site_toml(site))
    results = tmp_path / "found.json"
    results.write_text(results_json(results_of(site, some_crossing("a"), used="a")))
    to = ["--to", str(tmp_path / "t"), "--sensorthings"]
    with_site = ["--site", str(tmp_path / "site.toml")]
    assert cli.main(["export", str(results), *with_site, *to]) == 0
    assert len(json.loads((tmp_path / "t/sensorthings.json").read_text())["Things"]) == 1
    capsys.readouterr()
    assert cli.main(["export", str(results), *to]) == 2
    assert "--sensorthings: needs a results file, and the site file" in capsys.readouterr().err
