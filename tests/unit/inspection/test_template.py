"""The site file to start from: it asks for all that is needed, and names all that there is."""

import json
import math
import re
import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel

from schemas.site import Bridge, Receiver, Sensor, Vehicle
from schemas.site_damping import rayleigh_of
from schemas.site_file import faults_of_site, load_site, parse_site
from services.cli import main as cli
from services.inspection.template import TEMPLATE
from services.simulation.usual_trucks import usual_lorry

MODELS: dict[str, type[BaseModel]] = {
    "vehicle": Vehicle, "bridge": Bridge, "sensor": Sensor, "receiver": Receiver,
}  # fmt: skip
NEEDED = re.compile(r"^(\w+) = (nan|\[nan, nan\])", re.MULTILINE)


def parts() -> dict[str, str]:
    """The text of each table."""
    split = re.split(r"^\[(\w+)\]", TEMPLATE, flags=re.MULTILINE)
    return dict(zip(split[1::2], split[2::2], strict=True))


def test_every_key_that_there_is_stands_in_its_table_and_no_other() -> None:
    assert parts().keys() == MODELS.keys()
    for name, text in parts().items():
        keys = re.findall(r"^(?:# )?([a-z]\w+) = ", text, re.MULTILINE)
        assert sorted(keys) == sorted(MODELS[name].model_fields)


def test_everything_that_is_needed_is_asked_for_at_once() -> None:
    faults = faults_of_site(TEMPLATE, "new.toml")
    for name, text in parts().items():
        for key, _ in NEEDED.findall(text):
            assert any(fault.startswith(f"new.toml: {name}.{key}") for fault in faults), key
    assert all("it must be" in fault for fault in faults)


def test_filled_in_it_is_the_site_that_was_meant(project: Path) -> None:
    example = project / "docs/site.example.toml"
    values = tomllib.loads(example.read_text())
    filled = ""
    for name, text in parts().items():
        known = values.get(name, {})
        if name == "bridge":
            known |= {"damping_ratio": 0.02, "first_frequency_hz": 3.3}
        filled += f"[{name}]" + NEEDED.sub(lambda m, of=known: f"{m[1]} = {of[m[1]]}", text)
    meant, found = load_site(example), parse_site(filled, "filled")
    bridge = found.bridges[0]
    assert tuple(coefficients(bridge).values()) == rayleigh_of(0.02, 3.3)
    assert bridge.first_frequency_hz == 3.3
    rest = coefficients(meant.bridges[0]) | {"first_frequency_hz": None}
    assert bridge.model_copy(update=rest) == meant.bridges[0]
    assert found.model_copy(update={"bridges": meant.bridges}) == meant


@pytest.mark.parametrize("tyres", ["single", "twin"])
def test_usual_truck_leaves_only_what_has_to_be_measured(tmp_path: Path, tyres: str) -> None:
    path = tmp_path / "new.toml"
    assert cli.main(["check", "--template", str(path), "--truck", f"lorry-{tyres}"]) == 0
    text = path.read_text()
    vehicle = text[: text.index("[bridge]")]
    assert [key for key, _ in NEEDED.findall(vehicle)] == [
        "total_mass_kg",
        "wheelbase_m",
        "front_axle_to_cg_m",
        "gps_antenna_to_front_axle_m",
    ]
    tables = tomllib.loads(vehicle)["vehicle"]
    truck = usual_lorry(tyres)
    for key in ("suspension_stiffness_n_per_m", "unsprung_mass_kg", "track_m"):
        assert tuple(tables[key]) == getattr(truck, key)
    assert tables["tyre_stiffness_n_per_m_spread"] == 0.3
    assert (tables["twin_tyre_distance_m"][1] > 0.0) == (tyres == "twin")
    front, behind = tables["tyre_stiffness_n_per_m"]
    assert (front == behind) == (tyres == "single")  # two tyres a side have twice the stiffness
    assert vehicle.count("a spread of 0.1 narrows the intervals") == 1


def test_usual_truck_without_a_template_is_refused() -> None:
    assert cli.main(["check", "site.toml", "--truck", "lorry-twin"]) == cli.EXIT_BAD_INPUT


def coefficients(bridge: Bridge) -> dict[str, float]:
    keys = ("rayleigh_alpha_per_s", "rayleigh_beta_s")
    return {key: getattr(bridge, key) for key in keys}


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rayleigh_beta_s", "damping_ratio = 0.02\nrayleigh_beta_s", "remove one of them"),
        ("rayleigh_", "damping_ratio = 0.02\n# ", "first_frequency_hz is missing, damping_ratio"),
        (
            "rayleigh_",
            "damping_ratio = 0.02\nfirst_frequency_hz = 90\n# ",
            "first_frequency_hz is 90, but flexural_rigidity_nm2",
        ),
        (
            "rayleigh_",
            "damping_ratio = 2.0\nfirst_frequency_hz = 4\n# ",
            "damping_ratio is 2.0, it must be",
        ),
    ],
)
def test_wrong_damping_is_named(project: Path, old: str, new: str, words: str) -> None:
    text = (project / "docs/site.example.toml").read_text()
    changed = re.sub(rf"^{old}", new, text, count=1, flags=re.MULTILINE)
    if old == "rayleigh_":
        changed = re.sub(r"^rayleigh_", "# rayleigh_", changed, flags=re.MULTILINE)
    with pytest.raises(Exception, match=re.escape(words)):
        parse_site(changed, "site.toml")


def test_damping_ratio_is_that_of_the_first_two_modes() -> None:
    alpha, beta = rayleigh_of(0.02, 3.7)
    for number in (1, 2):
        omega = 2.0 * math.pi * 3.7 * number**2
        assert 0.5 * (alpha / omega + beta * omega) == pytest.approx(0.02, rel=1e-12)


def test_defaults_that_it_shows_are_the_defaults(project: Path) -> None:
    site = load_site(project / "docs/site.example.toml")
    of = {
        "vehicle": site.vehicles[0], "bridge": site.bridges[0], "sensor": site.sensor,
        "receiver": site.receiver,
    }  # fmt: skip
    for name, text in parts().items():
        for key, value in re.findall(r"^# (\w+_spread\w*) = ([0-9.e-]+)", text, re.MULTILINE):
            if "support_rot" not in key:
                assert getattr(of[name], key) == float(value), key


def test_the_command_writes_it_and_spoils_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = tmp_path / "new.toml"
    assert cli.main(["check", "--template", str(new)]) == 0
    assert new.read_text() == TEMPLATE
    assert cli.main(["check", "--template", str(new)]) == 2
    assert "exists" in capsys.readouterr().err
    assert cli.main(["check", str(new)]) == 2
    output = capsys.readouterr()
    lines = [line for line in output.out.splitlines() if line.startswith("  wrong  ")]
    assert lines[0].startswith(
        "  wrong  vehicle.total_mass_kg is NaN (not filled in), it must be a mass"
    )
    assert output.err.endswith(f"{new}: {len(lines)} values are wrong; nothing else was checked\n")
    assert output.err.count("\n") == 1
    assert len(lines) == len(NEEDED.findall(TEMPLATE))
    assert cli.main(["check", str(new), "--json"]) == 2
    (report,) = json.loads(capsys.readouterr().out)["reports"]
    assert [one["state"] for one in report["findings"]] == ["wrong"] * len(lines)
    assert cli.main(["identify", "x.mcap", "--site", str(new)]) == 2
    error = capsys.readouterr().err
    assert f"(and {len(lines) - 1} more, driveby check lists them)" in error
    assert cli.main(["check"]) == 2
    assert "--template NEW.toml" in capsys.readouterr().err
