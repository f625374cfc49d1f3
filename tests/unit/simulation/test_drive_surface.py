"""Simulated drives over a road that is a surface: what either axle feels, and from run to run."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import csd

from pre_core.physics.road import (
    contact_patch_average,
    iso_8608_profile,
    under_axles,
    under_wheels,
)
from pre_core.physics.sensors import Accelerometer, measure_acceleration
from pre_core.physics.simulate import Motion, WheelRoad, constant_speed
from pre_core.physics.surface import (
    Footprint,
    axle_profile,
    random_surface,
    spectra,
    surface_density,
)
from schemas.signals import CHANNELS
from schemas.site import Site
from schemas.site_file import site_toml
from services.catalogue.contents import summarise_recording
from services.cli import main as cli
from services.common.errors import InputError
from services.simulation import command
from services.simulation import drive as simulation
from services.simulation.command import surface_of
from services.simulation.drive import (
    LONGEST_STEP_S,
    SETTLE_S,
    DrivenRoad,
    Measurement,
    SimulatedDrive,
    paper_site,
    simulate_drive,
)
from services.simulation.schedule import BETWEEN_RUNS_S
from services.simulation.settings import SimulateOptions
from services.simulation.wheel_paths import (
    AxleRoads,
    SurfaceOptions,
    WheelPaths,
    roads_of_surface,
    wheel_paths_of,
)

SITE = paper_site()
BRIDGE = SITE.bridges[0]
RATE_HZ = 200.0
SINGLE, TWIN = Footprint(), Footprint(width_m=0.22, twin_distance_m=0.33, offset_m=0.005)
BAND_CYCLES_PER_M = (0.3, 3.0)


class Spy:
    """Inputs and outputs of the simulation."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.outcome: list[tuple[Motion, WheelRoad]] = []
        self.gave: list[Any] = []
        real = simulation.simulate

        def keeping(car: Any, beam: Any, motion: Motion, road: WheelRoad, *a: Any, **k: Any) -> Any:
            self.outcome.append((motion, road))
            self.gave.append(real(car, beam, motion, road, *a, **k))
            return self.gave[-1]

        patch.setattr(simulation, "simulate", keeping)


def driven(
    paths: WheelPaths | None = None,
    *,
    noise: float = 0.0,
    forward: bool = True,
    seed: int | tuple[int, ...] | None = None,
) -> SimulatedDrive:
    measurement = Measurement(noise, RATE_HZ, seed=seed)
    return simulate_drive(SITE, np.ones(7), DrivenRoad("A", 3, paths), measurement, forward=forward)


def roads(seed: int, paths: WheelPaths, noise_seed: int, *, sign: int = 1) -> AxleRoads:
    motion = constant_speed(15.0 - 50.0 * sign, 10.0 * sign, 1000, 0.01)
    rng = np.random.default_rng(noise_seed)
    return roads_of_surface(BRIDGE, motion, 5.0, 0.02, ("A", seed), paths, rng)


def level(one: NDArray[np.float64], spacing_m: float) -> float:
    """Sum of spectral density times n² over the band."""
    points = round(100.0 / spacing_m)
    n, density = csd(one, one, fs=1.0 / spacing_m, nperseg=points)
    within = (n >= BAND_CYCLES_PER_M[0]) & (n < BAND_CYCLES_PER_M[1])
    return float((density.real * n**2)[within].mean())


def expected_level(front: Footprint, rear: Footprint) -> float:
    """The same of their difference, by the integral."""
    n = np.arange(*BAND_CYCLES_PER_M, 0.01)
    return surface_density("A") * float((spectra(front, rear, n)[3] * n**2).mean())


def test_without_a_surface_everything_is_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit for bit: one groove under both wheels, and the same streams of noise."""
    spy = Spy(monkeypatch)
    drive = driven(noise=25.0)
    (motion, felt), fine = spy.outcome[0], spy.gave[0]
    reach = SITE.vehicles[0].wheelbase_m + 1.0
    low, high = motion.position_m.min() - reach, motion.position_m.max() + reach
    raw = iso_8608_profile(np.floor(low), np.ceil(high), 0.01, "A", 3)
    groove = contact_patch_average(raw, 0.2)
    np.testing.assert_array_equal(drive.road.height_m, groove.height_m)
    assert drive.rear_road is None
    alone = under_wheels(groove, motion, SITE.vehicles[0].wheelbase_m, 1)
    np.testing.assert_array_equal(felt.height_m, alone.height_m)
    np.testing.assert_array_equal(felt.rate_m_per_s, alone.rate_m_per_s)
    accel_rng, _ = np.random.default_rng(3).spawn(2)
    sensor = Accelerometer(RATE_HZ, noise_density_ug_per_rthz=25.0)
    settling = round(SETTLE_S / LONGEST_STEP_S)
    for i, name in enumerate(CHANNELS):
        recorded = fine.acceleration_m_per_s2[settling:, i]
        expected = measure_acceleration(recorded, 1.0 / LONGEST_STEP_S, sensor, accel_rng)
        np.testing.assert_array_equal(drive.run.channels[name], expected)


@pytest.mark.parametrize("forward", [True, False])
def test_each_axle_drives_over_the_road_that_its_tyres_feel(
    monkeypatch: pytest.MonkeyPatch, *, forward: bool
) -> None:
    """Of one surface, whichever way it is driven; the left of the way back is the other side."""
    spy = Spy(monkeypatch)
    paths = WheelPaths(SINGLE, TWIN._replace(offset_m=0.1))
    drive = driven(paths, forward=forward)
    assert drive.rear_road is not None
    sign = 1 if forward else -1
    motion, felt = spy.outcome[0]
    expected = under_axles(drive.road, drive.rear_road, motion, SITE.vehicles[0].wheelbase_m, sign)
    np.testing.assert_array_equal(felt.height_m, expected.height_m)
    np.testing.assert_array_equal(felt.rate_m_per_s, expected.rate_m_per_s)
    surface = random_surface(-150.0, 180.0, 0.01, "A", 3)
    for profile, axle in (
        (drive.road, SINGLE),
        (drive.rear_road, TWIN._replace(offset_m=0.1 * sign)),
    ):
        np.testing.assert_array_equal(profile.height_m, axle_profile(surface, axle).height_m)
    spacing = float(drive.road.x_m[1] - drive.road.x_m[0])
    apart = level(drive.road.height_m - drive.rear_road.height_m, spacing)
    assert apart == pytest.approx(expected_level(*paths[:2]), rel=0.15)


def test_the_truck_is_shaken_otherwise_by_another_rear_axle() -> None:
    """With one and the same footprint both axles feel one road; with twins the rear is calmer."""
    alike = driven(WheelPaths(SINGLE, SINGLE))
    twins = driven(WheelPaths(SINGLE, TWIN))
    assert alike.rear_road is not None
    np.testing.assert_array_equal(alike.road.height_m, alike.rear_road.height_m)
    np.testing.assert_array_equal(alike.road.height_m, twins.road.height_m)
    before = slice(0, 400)  # two seconds, the bridge is not reached yet
    rear = [d.run.channels["unsprung_rear"][before].std() for d in (alike, twins)]
    assert rear[1] < 0.95 * rear[0]
    difference = alike.run.channels["unsprung_rear"] - twins.run.channels["unsprung_rear"]
    assert difference[before].std() > 0.05 * rear[0]


def test_runs_that_wander_feel_related_roads() -> None:
    """Two places on one surface: as far apart as the integral says, and still much the same."""
    paths = WheelPaths(SINGLE, TWIN, 0.12)
    one, other = roads(5, paths, 1), roads(5, paths, 4)  # 12 cm beside one another
    places = [0.12 * np.random.default_rng(seed).standard_normal() for seed in (1, 4)]
    moved = [SINGLE._replace(offset_m=float(place)) for place in places]
    apart = level(one.front.height_m - other.front.height_m, 0.02)
    assert apart == pytest.approx(expected_level(moved[0], moved[1]), rel=0.15)
    assert apart > 0.0
    assert np.corrcoef(one.front.height_m, other.front.height_m)[0, 1] > 0.9
    same = roads(5, paths._replace(wander_m=0.0), 1), roads(5, paths._replace(wander_m=0.0), 4)
    np.testing.assert_array_equal(same[0].rear.height_m, same[1].rear.height_m)
    # By how much the axles differ is repeated far less exactly.
    differences = [road.front.height_m - road.rear.height_m for road in (one, other)]
    assert 0.1 < np.corrcoef(differences)[0, 1] < 0.8


def test_fast_and_slow_both_ways_is_one_road() -> None:
    paths = WheelPaths(SINGLE, SINGLE)
    forth, back = roads(6, paths, 1), roads(6, paths, 1, sign=-1)
    np.testing.assert_array_equal(forth.front.height_m, back.front.height_m)
    assert (forth.front.x_m[0], forth.front.x_m[-1]) == pytest.approx((-150.0, 180.0))


def a_site(**tyres: Any) -> Site:
    return SITE.model_copy(update={"vehicles": (SITE.vehicles[0].model_copy(update=tyres),)})


def test_tyres_are_the_sites_the_askers_or_common_ones() -> None:
    nothing = SITE.vehicles[0]
    assert wheel_paths_of(nothing) == WheelPaths(SINGLE, TWIN)
    asked = SurfaceOptions("single", 0.01, 0.2)
    assert wheel_paths_of(nothing, asked) == WheelPaths(SINGLE, SINGLE._replace(offset_m=0.01), 0.2)
    known = a_site(
        tyre_width_m=(0.3, 0.2),
        tyre_contact_length_m=(0.15, 0.18),
        twin_tyre_distance_m=(0.0, 0.31),
        track_m=(2.0, 1.8),
        rear_axle_offset_m=-0.02,
    ).vehicles[0]
    assert wheel_paths_of(known, SurfaceOptions(wander_m=0.1)) == WheelPaths(
        Footprint(0.3, 0.0, 0.15, 2.0), Footprint(0.2, 0.31, 0.18, 1.8, -0.02), 0.1
    )
    singles = a_site(twin_tyre_distance_m=(0.0, 0.0)).vehicles[0]
    assert wheel_paths_of(singles).rear == SINGLE._replace(offset_m=0.005)
    for asked, words in (
        (
            SurfaceOptions("twin"),
            f"--tyres: {known.id} declares twin_tyre_distance_m in the site file",
        ),
        (SurfaceOptions(None, 0.0), "--rear-offset: .* declares rear_axle_offset_m"),
    ):
        with pytest.raises(InputError, match=words):
            wheel_paths_of(known, asked)


def test_options_of_simulate_reach_the_road(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    outcome: list[tuple[object, ...]] = []

    def keeping(asked: SimulateOptions, console: object) -> int:
        outcome.append((surface_of(asked), asked.runs, asked.drive_seed))
        return 0

    monkeypatch.setattr("services.simulation.command.simulate_command", keeping)
    begin = ["simulate", "--scenario", "6", "-o", str(tmp_path / "x.mcap")]
    assert cli.main(begin) == 0
    assert cli.main([*begin, "--road-surface"]) == 0
    options = "--road-surface --tyres single --rear-offset -0.01 --wander 0.1 --runs 12"
    assert cli.main([*begin, *options.split(), "--drive-seed", "7"]) == 0
    assert outcome == [
        (None, 1, None),
        (SurfaceOptions(None, None, 0.0), 1, None),
        (SurfaceOptions("single", -0.01, 0.1), 12, 7),
    ]


def test_several_runs_over_one_surface_are_one_recording(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Minutes apart, each a crossing; the road is one, the place on it and the noise are not."""
    drives: list[SimulatedDrive] = []
    real = simulation.simulate_drive

    def keeping(*arguments: Any, **named: Any) -> SimulatedDrive:
        drives.append(real(*arguments, **named))
        return drives[-1]

    monkeypatch.setattr(command, "simulate_drive", keeping)
    path = tmp_path / "x.mcap"
    options = "--scenario 6 --seed 4 --noise 25 --rate 200 --speed 20 --road-surface --wander 0.12"
    assert cli.main(["simulate", *options.split(), "--runs", "2", "-o", str(path)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "x.mcap: 2 runs of 7." in printed
    assert printed.endswith(" messages; assumed road class A (--road)")
    one, other = drives
    correlation = np.corrcoef(one.road.height_m, other.road.height_m)[0, 1]
    assert 0.9 < correlation < 1.0 - 1e-6
    assert not np.array_equal(one.run.channels[CHANNELS[2]], other.run.channels[CHANNELS[2]])
    found = summarise_recording(path)
    first, second = found.passings
    apart_s = 1e-9 * (second.entry_ns - first.entry_ns)
    assert apart_s == pytest.approx(BETWEEN_RUNS_S, abs=0.2)


def test_the_first_of_several_runs_is_the_only_one_of_one(tmp_path: Path) -> None:
    """And a seed of the drive changes the noise and not the road."""
    alone, again = driven(noise=25.0), driven(noise=25.0, seed=3)
    other = driven(noise=25.0, seed=(3, 1))
    for name in CHANNELS:
        np.testing.assert_array_equal(alone.run.channels[name], again.run.channels[name])
        assert not np.array_equal(alone.run.channels[name], other.run.channels[name])
    np.testing.assert_array_equal(alone.road.height_m, other.road.height_m)


def test_values_of_the_site_file_are_not_requested_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "site.toml"
    site.write_text(site_toml(a_site(twin_tyre_distance_m=(0.0, 0.3))))
    output = tmp_path / "x.mcap"
    options = ["--scenario", "6", "--site", str(site), "--road-surface", "-o", str(output)]
    assert cli.main(["simulate", *options, "--tyres", "twin"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        "driveby: --tyres: truck-1 declares twin_tyre_distance_m in the site file, "
    )
    assert error.count("\n") == 1
    assert not output.exists()
