"""`driveby simulate` drives a truck with a tandem, and what is identified of it holds the truth."""

from pathlib import Path

import numpy as np
import pytest

from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import parse_site
from services.cli.main import main
from services.execution.offline import identify_recordings, site_of
from services.simulation.drive_tandem import TandemDrive, tandem_case
from services.simulation.tandem_cases import draw_tandem
from services.simulation.two_sided import static_axle_loads_n
from services.simulation.wheel_paths import SurfaceOptions
from services.simulation.wide_crossings import site_text

TEXT = site_text(draw_tandem(12))
SITE: Site = parse_site(TEXT, "site.toml")
G = 9.80665


@pytest.fixture
def site_file(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(TEXT)
    return path


def test_case_is_the_nominal_truck_of_the_site() -> None:
    how = TandemDrive(("A", 1), friction_share=0.05, surface=SurfaceOptions(rear_offset_m=0.02))
    case = tandem_case(SITE, np.ones(SITE.bridges[0].elements), how)
    vehicle = SITE.vehicles[0]
    assert case.truck.total_mass_kg == pytest.approx(vehicle.total_mass_kg)
    loads = static_axle_loads_n(case.truck) / G
    behind = vehicle.sprung_mass_kg * vehicle.front_axle_to_cg_m / vehicle.wheelbase_m
    assert loads[1:].sum() == pytest.approx(behind + vehicle.unsprung_mass_kg[1])
    assert case.truck.axles[0].friction_n == pytest.approx(
        0.05 * G * (vehicle.sprung_mass_kg - behind)
    )
    assert case.truck.axles[2].offset_m == 0.02
    assert not case.is_one_road


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--air-springs", "1.4"], "--air-springs: is not simulated for a truck with a tandem"),
        (["--speed", "9:11"], "--speed: is START:END, it must be one speed"),
    ],
)
def test_options_without_a_tandem_are_refused(
    site_file: Path, capsys: pytest.CaptureFixture[str], options: list[str], line: str
) -> None:
    out = str(site_file.with_name("a.mcap"))
    given = ["simulate", "--site", str(site_file), "--ei", "1,1,1,1,1", "-o", out, *options]
    assert main(given) == 2
    assert line in capsys.readouterr().err


def test_survey_of_a_tandem_is_refused_in_one_line(
    site_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["survey", "--site", str(site_file), "--loss", "0.2"]) == 2
    error = capsys.readouterr().err
    assert "tandem-truck: has a tandem, it must be a truck of two axles" in error
    assert error.count("\n") == 1


def test_other_methods_reject_a_tandem(site_file: Path) -> None:
    recording = _recorded(site_file)
    settings = IdentificationSettings(method="least_squares")
    (found,) = identify_recordings([recording], site_of([recording], None), settings).crossings
    assert (found.verdict, found.reasons) == ("rejected", (Reason.TANDEM,))


def test_identified_tandem_holds_the_truth(site_file: Path) -> None:
    recording = _recorded(site_file)
    (found,) = identify_recordings(
        [recording], site_of([recording], None), IdentificationSettings()
    ).crossings
    assert (found.verdict, found.reasons) == ("good", ())
    assert found.parameters is not None
    assert found.derived is not None
    assert {"m_u2", "m_u3", "k_u2", "k_u3", "c_u2", "c_u3", "share"} < set(found.parameters)
    assert not {"m_u1", "k_s1", "k_u1"} & set(found.parameters)
    assert found.derived.springs_believed == 0.0
    nominal = SITE.bridges[0].nominal_flexural_rigidity_nm2
    truth = np.array(nominal) * np.array([1.0, 1.0, 0.6, 1.0, 1.0])
    values = [found.parameters[f"EI_{e + 1}"] for e in range(5)]
    z = [(one.mean - true) / one.std for one, true in zip(values, truth, strict=True)]
    assert np.abs(z).max() < 3.5
    inner = np.median([one.std / true for one, true in zip(values, truth, strict=True)][1:-1])
    assert inner < 0.2
    assert values[2].q975 < 0.9 * nominal[2]


def _recorded(site_file: Path) -> Path:
    out = site_file.with_name("a.mcap")
    options = [
        "--ei",
        "1,1,.6,1,1",
        "--noise",
        "25",
        "--gps-noise",
        "--friction",
        "0.08",
        "--road-surface",
    ]
    assert main(["simulate", "--site", str(site_file), *options, "-o", str(out)]) == 0
    return out
