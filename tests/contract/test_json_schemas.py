"""The published JSON schemas are those of the models, and accept the files that programs write."""

import gzip
import json
import tomllib
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from schemas.json.generate import FOLDER, MODELS, schema, schema_text
from schemas.site_file import load_site, site_toml

jsonschema = pytest.importorskip("jsonschema")
ROOT = Path(__file__).parents[2]
SITES = (
    "docs/site.example.toml",
    "docs/examples/two_spans/site.toml",
    "tests/data/csv_example/site.toml",
    "tests/data/before/0.1.0/paper.toml",
)
RESULTS = ("exact-result", "pre-result", "rejected-result")
RATIO = """
damping_ratio = 0.02
first_frequency_hz = 3.3
"""
AXLES = """
[[vehicle.axles]]
position_m = 0.0
unsprung_mass_kg = 500.0
suspension_stiffness_n_per_m = 5e5
suspension_damping_ns_per_m = 2e4
tyre_stiffness_n_per_m = 1.5e6
load_kg = 4000.0
"""


def faults(name: str, content: Any) -> list[str]:
    found = jsonschema.Draft202012Validator(schema(name)).iter_errors(content)
    return [error.message for error in found]


def stored(name: str) -> dict[str, Any]:
    path = ROOT / f"tests/data/before/0.1.0/{name}.json.gz"
    content: dict[str, Any] = json.loads(gzip.decompress(path.read_bytes()))
    return content


@pytest.mark.parametrize("name", MODELS)
def test_schema_file_is_that_of_the_model(name: str) -> None:
    path = FOLDER / f"{name}.schema.json"
    assert path.read_text("utf-8") == schema_text(name), "old: run make tables"


@pytest.mark.parametrize("name", SITES)
def test_valid_site_file_is_accepted_as_written_and_spelt_out(name: str) -> None:
    assert faults("site", tomllib.loads((ROOT / name).read_text())) == []
    assert faults("site", tomllib.loads(site_toml(load_site(ROOT / name)))) == []


def test_other_spellings_of_a_site_file_are_accepted() -> None:
    table = tomllib.loads((ROOT / "docs/site.example.toml").read_text())
    bridge, vehicle = table["bridge"], table["vehicle"]
    for key in ("rayleigh_alpha_per_s", "rayleigh_beta_s"):
        bridge.pop(key, None)
    bridge |= tomllib.loads(RATIO)
    vehicle |= {"tyre_width_m": 0.25, "twin_tyre_distance_m": 0, "track_m": 2.0}
    table |= {"bridge": [bridge], "vehicle": [vehicle]}
    assert faults("site", table) == []
    axle = tomllib.loads(AXLES)["vehicle"]["axles"][0]
    short = {key: vehicle[key] for key in ("id", "gps_antenna_to_front_axle_m")}
    two = [axle, axle | {"position_m": 4.0}]
    assert faults("site", table | {"vehicle": short | {"axles": two}}) == []


def test_misspelt_key_and_wrong_type_are_refused() -> None:
    table = tomllib.loads((ROOT / "docs/site.example.toml").read_text())
    for key, value in (("spam_m", 30.0), ("span_m", "thirty"), ("span_m", -1.0)):
        wrong = deepcopy(table)
        wrong["bridge"][key] = value
        assert faults("site", wrong)
    assert faults("settings", {"method": "other"})
    assert faults("results", stored("pre-result") | {"seed": -1})


@pytest.mark.parametrize("name", RESULTS)
def test_stored_results_are_accepted(name: str) -> None:
    assert faults("results", stored(name)) == []


def test_keys_of_a_site_file_are_described() -> None:
    keys = schema("site")["$defs"]["Bridge"]["properties"]
    assert keys["interior_supports_m"]["description"].startswith("Chainages of the supports")
