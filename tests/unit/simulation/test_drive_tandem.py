"""`driveby simulate` drives a truck with a tandem, and what is identified of it holds the truth."""

from pathlib import Path

import numpy as np
import pytest

from schemas.errors import InputError
from schemas.reasons import Reason
from schemas.results import first_compared_axle
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import parse_site
from services.cli.main import main
from services.common.geodesy import bridge_frame, to_chainage
from services.execution.offline import site_of
from services.finding.placed import middle_site
from services.simulation.drawn import draw_truth, drive
from services.simulation.drawn_tandem import TandemEffects, drawn_tandem, drawn_vehicle
from services.simulation.drive_tandem import TandemDrive, tandem_case
from services.simulation.two_sided import static_axle_loads_n
from services.simulation.usual_trucks import usual_four_axles, usual_tandem
from services.simulation.wheel_paths import SurfaceOptions
from services.simulation.wide_crossings import drive_case, site_text
from studies.simulation.tandem_cases import draw_tandem
from tests.identifications import identify_recordings

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
        (["--axles", "2"], "--axles: is 2, but tandem-truck has 3 axles"),
        (["--axles", "4"], "--axles: is 4, but tandem-truck has 3 axles"),
        (["--tyres", "twin"], "--tyres: the site file declares the tyres of each axle"),
    ],
)
def test_options_that_a_tandem_excludes_are_refused(
    site_file: Path, capsys: pytest.CaptureFixture[str], options: list[str], line: str
) -> None:
    out = str(site_file.with_name("a.mcap"))
    given = ["simulate", "--site", str(site_file), "--ei", "1,1,1,1,1", "-o", out, *options]
    assert main(given) == 2
    assert line in capsys.readouterr().err


def test_survey_on_springs_of_their_own_is_refused_in_one_line(
    site_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site_file.write_text(TEXT.replace("equalised = true", "equalised = false"))
    assert main(["survey", "--site", str(site_file), "--loss", "0.2"]) == 2
    error = capsys.readouterr().err
    assert "tandem-truck: the axles of its tandem have springs of their own" in error
    assert error.count("\n") == 1


def test_three_axles_are_those_of_a_usual_tipper(tmp_path: Path) -> None:
    path = tmp_path / "tandem.mcap"
    given = ["simulate", "--scenario", "6", "--axles", "3", "--noise", "25", "--rate", "200"]
    assert main([*given, "-o", str(path)]) == 0
    site = site_of([path], None)
    assert site.vehicles[0].total_mass_kg == usual_tandem(25.0).total_mass_kg
    assert {one.noise_density_ug_per_rthz for one in site.vehicles[0].sensors} == {25.0}


def test_two_steered_axles_are_simulated_and_identified(tmp_path: Path) -> None:
    path = tmp_path / "four.mcap"
    given = ["simulate", "--ei", "1,1,.4,1,1,1,1", "--axles", "4", "--noise", "25", "--rate", "200"]
    assert main([*given, "--road-surface", "--friction", "0.08", "-o", str(path)]) == 0
    site = site_of([path], None)
    vehicle = site.vehicles[0]
    assert vehicle.total_mass_kg == usual_four_axles(25.0).total_mass_kg
    assert [one.channel for one in vehicle.sensors if one.axle] == ["unsprung_3", "unsprung_4"]
    (result,) = identify_recordings([path], site, IdentificationSettings(method="pre")).crossings
    assert result.verdict == "good"
    assert result.parameters is not None
    assert {"k_u3", "k_u4", "m_u3", "m_u4", "share"} <= result.parameters.keys()
    assert first_compared_axle(result) == 3
    for number in range(1, 8):
        element = result.parameters[f"EI_{number}"]
        true = 0.4 if number == 3 else 1.0
        nominal = site.bridges[0].nominal_flexural_rigidity_nm2[number - 1]
        error = np.log(element.mean / (true * nominal))
        assert abs(error) < 4.0 * element.std / element.mean


def test_four_axles_carry_what_the_site_declares() -> None:
    site = SITE.model_copy(update={"vehicles": (usual_four_axles(25.0),)})
    vehicle = site.vehicles[0]
    case = tandem_case(site, np.ones(site.bridges[0].elements), TandemDrive(("A", 1)))
    assert [bogie.axles for bogie in case.truck.bogies] == [(2, 3)]
    loads = static_axle_loads_n(case.truck) / G
    np.testing.assert_allclose(loads, [axle.load_kg or 0.0 for axle in vehicle.axles], rtol=0.02)
    drawn = drawn_vehicle(vehicle, 3)
    assert drawn.tandem is not None
    assert drawn.tandem.gap_m != 1.35 != drawn.tandem.share
    assert drawn.bogies[0].axles == (3, 4)
    assert drawn.axles[1].position_m == 1.95


def test_springs_of_their_own_carry_their_weighed_loads() -> None:
    site = parse_site(TEXT.replace("equalised = true", "equalised = false"), "site.toml")
    vehicle = site.vehicles[0]
    case = tandem_case(site, np.ones(site.bridges[0].elements), TandemDrive(("A", 1)))
    assert case.truck.bogies == ()
    weighed = np.array([axle.load_kg or 0.0 for axle in vehicle.axles])
    weighed *= vehicle.total_mass_kg / weighed.sum()
    np.testing.assert_allclose(static_axle_loads_n(case.truck) / G, weighed, rtol=0.02)


def test_antenna_and_latency_are_in_the_positions() -> None:
    ones = np.ones(SITE.bridges[0].elements)
    front = tandem_case(SITE, ones, TandemDrive(("A", 1)))._replace(rate_hz=200.0)
    behind = front._replace(antenna_to_front_axle_m=2.0, latency_s=0.25)
    at_front, at_antenna = (drive_case(case, 0).run.gnss for case in (front, behind))
    frame = bridge_frame(SITE.bridges[0])
    along = [to_chainage(frame, g.latitude_deg, g.longitude_deg)[0] for g in (at_front, at_antenna)]
    np.testing.assert_allclose(along[0] - along[1], 2.0, atol=1e-3)
    np.testing.assert_allclose(at_antenna.time_s - at_front.time_s, 0.25, atol=1e-6)


def test_drawn_truck_varies_about_the_declared_one() -> None:
    vehicle = SITE.vehicles[0]
    drawn = [drawn_vehicle(vehicle, seed) for seed in range(200)]
    assert drawn_vehicle(vehicle, 3) == drawn[3]
    for key, spread in (
        ("total_mass_kg", vehicle.total_mass_kg_spread),
        ("front_axle_to_cg_m", vehicle.front_axle_to_cg_m_spread),
        ("tandem_share", vehicle.tandem_share_spread),
    ):
        logs = np.log([getattr(one, key) / getattr(vehicle, key) for one in drawn])
        assert abs(logs.mean()) < 4.0 * spread / np.sqrt(200)
        assert logs.std() == pytest.approx(spread, rel=0.2)
    stiffness = np.array([[a.tyre_stiffness_n_per_m for a in one.axles] for one in drawn])
    nominal = [axle.tyre_stiffness_n_per_m for axle in vehicle.axles]
    np.testing.assert_allclose(np.log(stiffness / nominal).std(axis=0), 0.15, rtol=0.2)
    assert np.abs(np.corrcoef(stiffness.T) - np.eye(3)).max() < 0.3


def test_drawn_crossing_has_the_errors_of_the_truth() -> None:
    site = middle_site(SITE)
    truth = draw_truth(site, 5)
    how = truth.conditions._replace(rate_hz=200.0, speed_m_per_s=12.0, change_m_per_s=0.0)
    truth = truth._replace(conditions=how)
    effects = TandemEffects(friction_share=0.08, offset_m=0.02, outer_share=0.55, wander_m=0.0)
    drawn = drawn_tandem(site, truth, 7, 1, effects)
    case = drawn.case
    np.testing.assert_allclose(case.deck.flexural_rigidity_nm2, truth.beam.flexural_rigidity_nm2)
    assert [one.delay_s for one in case.sensors] == truth.channels.delay_s.tolist()
    assert (case.truck.axles[2].offset_m, case.truck.axles[2].outer_share) == (0.02, 0.55)
    assert case.truck.axles[1].friction_n > 0.0
    assert drawn_tandem(site, truth, 7, 1, effects).case == case
    run, declared = drawn.recorded
    assert run.rate_hz == 200.0
    assert {one.rate_hz for one in declared.vehicles[0].sensors} == {200.0}
    with pytest.raises(InputError, match="has a tandem, it must be a truck of two axles"):
        drive(site, truth, 7)
    own = parse_site(TEXT.replace("equalised = true", "equalised = false"), "site.toml")
    with pytest.raises(InputError, match="the axles of its tandem have springs of their own"):
        drawn_tandem(own, truth, 7, 1)


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
