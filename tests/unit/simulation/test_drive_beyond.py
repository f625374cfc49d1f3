"""Simulated drives with what no site file has, over one and over several spans."""

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from pre_core.physics.vehicle import static_axle_loads_n
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import parse_site, site_toml
from services.cli import main as cli
from services.common.errors import InputError
from services.execution.offline import site_of
from services.simulation.command import effects_of, simulate_command
from services.simulation.drive import (
    DepartedVehicle,
    DrivenRoad,
    Measurement,
    OutOfModelEffects,
    SimulatedDrive,
    beam_of,
    paper_site,
    simulate_drive,
    truck_of,
    with_effects,
    write_drive,
)
from services.simulation.settings import SimulateOptions
from services.viewer.crossing_view import view_of_crossing
from studies.paper.scenarios import models
from studies.simulation.out_of_model import continuous
from tests.identifications import identify_recordings

BEFORE_S = 3.0


def driven(effects: OutOfModelEffects, site: Site | None = None) -> SimulatedDrive:
    known = paper_site() if site is None else site
    sound = np.ones(known.bridges[0].elements)
    return simulate_drive(
        known, sound, DrivenRoad("A", 1), Measurement(rate_hz=200.0), effects=effects
    )


@pytest.fixture(scope="module")
def plain() -> SimulatedDrive:
    return driven(OutOfModelEffects())


def differences(one: SimulatedDrive, other: SimulatedDrive) -> tuple[float, float]:
    """Largest difference of any channel before the entry, and after it. The converter's low-pass
    filter reaches less than a quarter of a second ahead."""
    entry = round(BEFORE_S * one.run.rate_hz)
    apart = np.max(
        [np.abs(one.run.channels[name] - other.run.channels[name]) for name in one.run.channels],
        axis=0,
    )
    return float(apart[: entry - 50].max()), float(apart[entry:].max())


@pytest.mark.parametrize(
    "effects",
    [
        OutOfModelEffects(support_rotational_stiffness_nm_per_rad=(5e8, 0.0)),
        OutOfModelEffects(support_compliance_m_per_n=(0.0, 3e-10)),
        OutOfModelEffects(departed=DepartedVehicle(3e5, 17.0, 0.1)),
    ],
)
def test_what_the_bridge_has_is_felt_on_the_bridge(
    plain: SimulatedDrive, effects: OutOfModelEffects
) -> None:
    before, after = differences(plain, driven(effects))
    assert before < 1e-6
    assert after > 2e-3


@pytest.mark.parametrize(
    "effects",
    [
        OutOfModelEffects(friction_share=0.05),
        OutOfModelEffects(bilinear_damping=0.2),
        OutOfModelEffects(air_spring_exponent=1.38),
    ],
)
def test_what_the_truck_has_is_felt_before_too(
    plain: SimulatedDrive, effects: OutOfModelEffects
) -> None:
    before, after = differences(plain, driven(effects))
    assert before > 1e-3
    assert after > 1e-3


def test_a_lorry_the_other_way_or_long_ago_is_another_swing(plain: SimulatedDrive) -> None:
    soon = driven(OutOfModelEffects(departed=DepartedVehicle(3e5, 17.0, 0.1)))
    back = driven(OutOfModelEffects(departed=DepartedVehicle(3e5, -17.0, 0.1)))
    late = driven(OutOfModelEffects(departed=DepartedVehicle(3e5, 17.0, 100.0)))
    # On a symmetric bridge the odd modes swing alike, the even ones the other way round.
    assert differences(soon, back)[1] > 1e-4
    assert differences(plain, late)[1] < 1e-5


def test_friction_is_a_share_of_what_the_springs_carry() -> None:
    site = paper_site()
    car, _ = with_effects(
        truck_of(site.vehicles[0]),
        beam_of(site.bridges[0], np.ones(7)),
        OutOfModelEffects(friction_share=0.08, friction_load_growth=1.0),
    )
    carried = np.array(static_axle_loads_n(car, 9.80665)) - 9.80665 * np.array(car.unsprung_mass_kg)
    np.testing.assert_allclose(car.dry_friction_n, 0.08 * carried)
    assert sum(carried) == pytest.approx(9.80665 * car.body_mass_kg)
    assert car.friction_load_growth == 1.0


@pytest.fixture(scope="module")
def two_spans() -> Site:
    site = paper_site()
    return site.model_copy(
        update={"bridges": (continuous(site.bridges[0], np.array([18.0, 14.0])),)}
    )


def test_several_spans_are_driven_and_refused_by_the_papers_methods(
    two_spans: Site, tmp_path: Path
) -> None:
    drive = driven(OutOfModelEffects(), two_spans)
    path = tmp_path / "spans.mcap"
    write_drive(path, drive, two_spans)
    for method in ("least_squares", "random_walk"):
        settings = IdentificationSettings(method=method)
        (crossing,) = identify_recordings([path], site_of([path], None), settings).crossings
        assert (crossing.verdict, crossing.reasons) == ("rejected", ("continuous_bridge",))
    view = view_of_crossing(crossing, two_spans.bridges[0])
    assert view.interior_supports_m == (18.0,)
    np.testing.assert_allclose(view.element_edges_m[[0, 5, 8]], [0.0, 18.0, 32.0])


def test_the_papers_experiments_are_for_a_single_span(two_spans: Site, tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(site_toml(two_spans).replace("elements = 8", "elements = 7"))
    with pytest.raises(InputError, match="has interior_supports_m, the paper's methods are for a"):
        models(path)


def test_few_elements_have_fewer_modes_than_are_kept() -> None:
    """Two spans of one element each: 39 freedoms of the finer mesh."""
    site = paper_site()
    bridge = site.bridges[0].model_copy(update={"elements": 2, "interior_supports_m": (15.0,)})
    drive = driven(
        OutOfModelEffects(),
        parse_site(site_toml(site.model_copy(update={"bridges": (bridge,)})), "s"),
    )
    assert np.isfinite(drive.run.channels["unsprung_front"]).all()


def test_options_of_simulate_reach_the_truth(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    outcome: list[OutOfModelEffects] = []

    def keeping(asked: SimulateOptions, console: object) -> int:
        outcome.append(effects_of(asked))
        return 0

    monkeypatch.setattr("services.simulation.command.simulate_command", keeping)
    begin = ["simulate", "--scenario", "6", "-o", str(tmp_path / "x.mcap")]
    assert cli.main(begin) == 0
    assert (
        cli.main(
            [
                *begin,
                *("--support-springs", "2e8:0", "--bearing-stiffness", "4e9:8e9"),
                *("--left", "3e5:17:0.1", "--friction", "0.08", "--friction-growth", "1"),
                *("--bilinear", "0.2", "--air-springs", "1.38"),
            ]
        )
        == 0
    )
    assert outcome == [
        OutOfModelEffects(),
        OutOfModelEffects(
            (2e8, 0.0), (2.5e-10, 1.25e-10), DepartedVehicle(3e5, 17.0, 0.1), 0.08, 1.0, 0.2, 1.38
        ),
    ]


def test_a_recording_with_all_of_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    asked = SimulateOptions(
        scenario=6,
        noise=25.0,
        direction="end_to_start",
        gps_noise=True,
        rate=200.0,
        support_springs=(2e8, 0.0),
        bearing_stiffness=(4e9, 1e15),
        departed_vehicle=(3e5, 17.0, 0.1),
        friction=0.08,
        friction_growth=1.0,
        bilinear=0.2,
        air_springs=1.38,
        output=path,
    )
    code = simulate_command(asked, Console(quiet=True))
    assert code == 0
    assert path.stat().st_size > 10_000
