"""The vehicle and the bridge that `driveby simulate` takes."""

from pathlib import Path

import pytest

from schemas.site import Site
from schemas.site_file import load_site, site_toml
from services.catalogue.contents import summarise_recording
from services.cli.main import main
from services.simulation.drive import paper_site


@pytest.fixture
def two() -> Site:
    """Return a site of two trucks and two bridges of unlike lengths, far from each other."""
    site = paper_site()
    truck, bridge = site.vehicles[0], site.bridges[0]
    heavy = truck.model_copy(update={"id": "truck-2", "total_mass_kg": 12_000.0})
    shift_deg = 0.1
    short = bridge.model_copy(
        update={
            "id": "bridge-2",
            "start_latitude_deg": bridge.start_latitude_deg + shift_deg,
            "end_latitude_deg": bridge.end_latitude_deg + shift_deg,
        }
    )
    return site.model_copy(update={"vehicles": (truck, heavy), "bridges": (bridge, short)})


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ([], ("truck-1", "bridge-1")),
        (["--vehicle", "truck-2"], ("truck-2", "bridge-1")),
        (["--bridge", "bridge-2"], ("truck-1", "bridge-2")),
        (["--vehicle", "truck-2", "--bridge", "bridge-2"], ("truck-2", "bridge-2")),
    ],
)
def test_chosen_vehicle_crosses_chosen_bridge(
    two: Site, chosen: list[str], expected: tuple[str, str], tmp_path: Path
) -> None:
    site, out = tmp_path / "two.toml", tmp_path / "drive.mcap"
    site.write_text(site_toml(two))
    fast = ["--rate", "200", "--speed", "20"]
    given = ["simulate", "--site", str(site), "--scenario", "1", *fast, *chosen, "-o", str(out)]
    assert main(given) == 0
    summary = summarise_recording(out, load_site(site))
    assert [(one.vehicle, one.bridge) for one in summary.passings] == [expected]


@pytest.mark.parametrize("kind", ["vehicle", "bridge"])
def test_unknown_pair_is_one_line(
    two: Site, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site, out = tmp_path / "two.toml", tmp_path / "drive.mcap"
    site.write_text(site_toml(two))
    prefix = {"vehicle": "truck", "bridge": "bridge"}[kind]
    line = f"--{kind}: the site has no other, it has {prefix}-1, {prefix}-2"
    given = ["simulate", "--site", str(site), "--scenario", "1", f"--{kind}", "other"]
    assert main([*given, "-o", str(out)]) == 2
    assert capsys.readouterr().err.endswith(f"{line}\n")
