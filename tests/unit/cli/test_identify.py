"""`driveby identify`, from the recording to the numbers and files.

Most recordings here have no noise: least squares must find what was put in exactly. What method
`pre` makes of noise is tested in tests/numerics and tests/process_replay/test_reference.py. Truth
and identification share no discretisation: the simulation has 70 finite elements and steps of
0.1 ms, the identification 14 elements and samples at 1 ms.
"""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from pre_core.paper.experiment import scenario_ratios
from schemas.results import CrossingResult, Results, Thirds, load_results
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS
from schemas.site import Site
from schemas.site_file import parse_site, site_hash, site_toml
from schemas.topics import Message
from schemas.validation_records import VehicleBridgePair, pair_hash
from services.cli import main as cli
from services.cli.bridge_table import print_bridge, print_elements
from services.cli.identify import _print, identify_command, print_validation
from services.cli.settings import IdentifyOptions
from services.common.errors import InputError
from services.common.geodesy import bridge_frame, to_lat_lon
from services.common.language import ENGLISH
from services.drives.importing import import_command
from services.drives.runs import GnssTrack, Run, run_to_messages
from services.drives.settings import ImportOptions
from services.execution.offline import site_of
from services.history.validation_files import save
from services.identification.comparison import describe_level
from services.recordings.recording import read_messages, read_site
from services.recordings.writer import write_recording
from services.simulation.drive import (
    DrivenRoad,
    SimulatedDrive,
    paper_site,
    simulate_drive,
    write_drive,
)
from tests.builders.certificates import certificate
from tests.identifications import identify_recordings
from tests.unit.viewer.found import RATIOS, results_of, some_crossing, with_contradictions

SOUND_NM2 = 1.56e10
LEAST_SQUARES = IdentificationSettings(method="least_squares")


def ratios(crossing: CrossingResult, sound: float = SOUND_NM2) -> list[float]:
    assert crossing.parameters is not None, crossing.reasons
    return [crossing.parameters[f"EI_{n}"].mean / sound for n in range(1, 8)]


def identified(path: Path) -> Results:
    return identify_recordings([path], site_of([path], None), LEAST_SQUARES)


def only(found: Results) -> CrossingResult:
    assert len(found.crossings) == 1
    return found.crossings[0]


@pytest.fixture(scope="module")
def recording(scenario_6: SimulatedDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("identify") / "drive.mcap"
    write_drive(path, scenario_6, paper_site())
    return path


@pytest.fixture
def empty_recording(tmp_path: Path) -> Callable[..., Path]:
    """A recording of the truck that goes nowhere near the bridge; streams can be left out."""

    def write(*, without: tuple[str, ...] = (), vehicle: str = "truck-1") -> Path:
        rng = np.random.default_rng(1)
        site = paper_site()
        drive = simulate_free(site, rng)
        messages = [
            m._replace(key=m.key._replace(identifier=vehicle))
            for m in run_to_messages([drive], site, "sim-x", "truck-1")
            if m.key.stream not in without
        ]
        path = tmp_path / "empty.mcap"
        write_recording(path, messages, site_toml=site_toml(site), reason="test")
        return path

    return write


def simulate_free(site: Site, rng: np.random.Generator) -> Run:
    time = 1_767_225_600.0 + np.arange(2000) / 200.0
    fixes = time[::20]
    latitude, longitude = to_lat_lon(
        bridge_frame(site.bridges[0]), -900.0 + 10.0 * (fixes - fixes[0])
    )
    track = GnssTrack(
        fixes, latitude, longitude, np.zeros(fixes.size), np.full(fixes.size, 10.0), None
    )
    channels = {name: rng.standard_normal(time.size) for name in CHANNELS}
    return Run("free", time, 200.0, channels, track)


@pytest.mark.parametrize(("name", "is_usual"), [("a.csv", False), ("a.json", True)])
def test_unusual_name_of_results_is_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, is_usual: bool
) -> None:
    output = tmp_path / name
    assert cli.main(["identify", str(tmp_path / "none.mcap"), "--json", str(output)]) == 2
    warning = f"{output}: the file will hold JSON; its usual name ends in .json"
    assert (warning in capsys.readouterr().err) != is_usual


def test_scenario_6_within_one_per_cent(recording: Path) -> None:
    crossing = only(identified(recording))
    assert ratios(crossing) == pytest.approx([1, 1, 1, 0.4, 1, 1, 1], rel=0.01)
    assert (crossing.verdict, crossing.reasons) == ("suspect", ("no_noise_model",))
    assert crossing.diagnostics["relative_misfit"] < 1e-3
    truck = paper_site().vehicles[0]
    assert crossing.parameters is not None
    found = [crossing.parameters[f"k_u{wheel}"].mean for wheel in (1, 2)]
    assert found == pytest.approx(truck.tyre_stiffness_n_per_m, rel=0.01)


def test_the_road_is_the_one_that_was_driven(recording: Path, scenario_6: SimulatedDrive) -> None:
    road = only(identified(recording)).road
    assert road is not None
    x = np.array(road.x_m)
    truth = np.interp(x, scenario_6.road.x_m, scenario_6.road.height_m)
    truth -= np.polynomial.Polynomial.fit(x, truth, 1)(x)
    # Roads of class A are some millimetres high; their difference is less than a tenth of one.
    assert np.ptp(truth) > 2e-3
    for profile in (road.front_m, road.rear_m, road.mean_m):
        assert np.abs(np.array(profile) - truth).max() < 1e-4
    assert road.iso_class == "A"


def test_scenario_12_within_one_per_cent(tmp_path: Path) -> None:
    """Damage in the last element, at the edge, where the paper's search fails."""
    truth = scenario_ratios(12)
    assert truth.min() < 0.9
    drive = simulate_drive(paper_site(), truth, DrivenRoad("A", 2))
    write_drive(tmp_path / "drive.mcap", drive, paper_site())
    assert ratios(only(identified(tmp_path / "drive.mcap"))) == pytest.approx(truth, rel=0.01)


def test_elements_are_numbered_from_the_bridges_start_also_driving_the_other_way(
    tmp_path: Path,
) -> None:
    truth = np.array([1.0, 0.5, 1.0, 1.0, 0.9, 1.0, 1.0])
    drive = simulate_drive(paper_site(), truth, DrivenRoad("A", 3), forward=False)
    write_drive(tmp_path / "drive.mcap", drive, paper_site())
    crossing = only(identified(tmp_path / "drive.mcap"))
    assert crossing.direction == "end_to_start"
    assert ratios(crossing) == pytest.approx(truth, rel=0.01)


def test_an_antenna_far_from_the_front_axle_and_a_changing_speed(tmp_path: Path) -> None:
    site = paper_site()
    truck = site.vehicles[0].model_copy(
        update={"gps_antenna_to_front_axle_m": 2.5, "cg_height_m": 1.2}
    )
    site = site.model_copy(update={"vehicles": (truck,)})
    truth = scenario_ratios(6)
    drive = simulate_drive(site, truth, DrivenRoad("A", 4), speed_m_per_s=(8.0, 12.0))
    write_drive(tmp_path / "drive.mcap", drive, site)
    crossing = only(identified(tmp_path / "drive.mcap"))
    assert "accelerating_cg_unknown" not in crossing.reasons
    assert ratios(crossing) == pytest.approx(truth, rel=0.02)


def test_acceleration_with_unknown_centre_of_gravity_is_named(tmp_path: Path) -> None:
    drive = simulate_drive(
        paper_site(), scenario_ratios(6), DrivenRoad("A", 4), speed_m_per_s=(8.0, 12.0)
    )
    write_drive(tmp_path / "drive.mcap", drive, paper_site())
    assert "accelerating_cg_unknown" in only(identified(tmp_path / "drive.mcap")).reasons


def test_a_strange_truck_gets_no_number(recording: Path, tmp_path: Path) -> None:
    """The same recording with a truck of another wheelbase: it says so, and the roads show it."""
    site = paper_site()
    truck = site.vehicles[0].model_copy(update={"wheelbase_m": 4.9})
    wrong = site.model_copy(update={"vehicles": (truck,)})
    quick = LEAST_SQUARES.model_copy(update={"starts": 1})
    crossing = only(identify_recordings([recording], wrong, quick))
    assert (crossing.verdict, crossing.reasons) == ("rejected", ("vehicle_differs_from_site",))
    silent = tmp_path / "silent.mcap"
    messages = (m for m in read_messages(recording) if m.key.stream != "info")
    write_recording(silent, messages, site_toml=site_toml(site), reason="test")
    crossing = only(identify_recordings([silent], wrong, quick))
    assert {"model_misfit", "not_converged"} & set(crossing.reasons)
    assert crossing.verdict == "rejected"
    assert crossing.diagnostics["relative_misfit"] > 0.1


def test_a_truck_that_comes_later_in_the_file_was_there_all_the_same(
    recording: Path, tmp_path: Path
) -> None:
    """A recording of two that were on the bridge at once, one of them unknown to the site."""
    both = [
        message._replace(key=message.key._replace(identifier=name))
        for name in ("truck-1", "z-stranger")
        for message in read_messages(recording)
    ]
    path = tmp_path / "both.mcap"
    write_recording(path, both, site_toml=site_toml(paper_site()), reason="test")
    assert only(identified(path)).reasons == ("other_truck_on_bridge",)


def test_files_of_another_simulator(shared: Path, tmp_path: Path) -> None:
    """Nothing but the measured files is there: what is found comes from them."""
    source = shared / "crossings" / "d1_clean_const_speed"
    folder = tmp_path / "crossing"
    folder.mkdir()
    for name in ("accel_00.csv", "gps_00.csv", "site.toml"):
        shutil.copy(source / name, folder)
    recording = tmp_path / "d1.mcap"
    import_command(ImportOptions(sources=(folder,), site=folder / "site.toml"), recording)
    site = site_of([recording], None)
    found = identify_recordings([recording], site, IdentificationSettings())
    crossing = only(found)
    assert (crossing.method, crossing.direction) == ("pre", "start_to_end")
    assert (crossing.verdict, crossing.reasons) == ("good", ())
    truth = json.loads((source / "truth.json").read_text())["EI"]
    assert crossing.parameters is not None
    for number, value in enumerate(truth, start=1):
        p = crossing.parameters[f"EI_{number}"]
        assert abs(p.mean - value) < max(0.03 * value, 2.5 * p.std), number
    assert found.site_hash == site_hash(parse_site((folder / "site.toml").read_text(), "site"))
    # The same with the whole folder, truth and all.
    whole = tmp_path / "whole.mcap"
    import_command(
        ImportOptions(sources=(source,), site=source / "site.toml", realm="crossing"), whole
    )
    assert [m.payload for m in read_messages(whole)] == [
        m.payload for m in read_messages(recording)
    ]


def test_late_messages_in_a_recording_are_put_in_order(recording: Path, tmp_path: Path) -> None:
    """What the logger recovered stands at the end of the file, minutes of data later."""
    messages = list(read_messages(recording))
    rng = np.random.default_rng(7)
    late = rng.random(len(messages)) < 0.3
    moved = [m for m, is_late in zip(messages, late, strict=True) if not is_late]
    moved += [m for m, is_late in zip(messages, late, strict=True) if is_late]
    path = tmp_path / "late.mcap"
    write_recording(path, moved, site_toml=read_site(recording), reason="test")
    assert unhurried(identified(path)) == unhurried(identified(recording))


def test_parts_of_a_drive_in_any_order_and_overlapping(recording: Path, tmp_path: Path) -> None:
    messages = list(read_messages(recording))
    half = len(messages) // 2
    parts = [tmp_path / "b.mcap", tmp_path / "a.mcap"]
    write_recording(parts[0], messages[half:], site_toml=read_site(recording), reason="test")
    write_recording(parts[1], messages[: half + 60], site_toml=read_site(recording), reason="test")
    found = identify_recordings(parts, site_of(parts, None), LEAST_SQUARES)
    assert unhurried(found) == unhurried(identified(recording))


def unhurried(found: Results) -> list[CrossingResult]:
    return [
        crossing.model_copy(update={"diagnostics": crossing.diagnostics | {"seconds": 0.0}})
        for crossing in found.crossings
    ]


def test_results_are_written_as_the_contract_says(recording: Path, tmp_path: Path) -> None:
    out, rrd = tmp_path / "out.json", tmp_path / "out.rrd"
    for path in (out, rrd):
        path.write_text("of yesterday")
    console = Console(record=True, width=120)
    asked = IdentifyOptions(
        recordings=(recording,), method="least-squares", json=out, rrd=rrd, seed=5
    )
    code = identify_command(asked, None, console)
    assert code == 0
    found = load_results(out)
    assert (found.program, found.seed, found.settings["method"]) == ("driveby", 5, "least_squares")
    assert found.site_hash == site_hash(site_of([recording], None))
    crossing = only(found)
    assert re.fullmatch(r"truck-1\.bridge-1\.20260101T00000\d\.\d{3}Z", crossing.crossing_id)
    assert crossing.parameters is not None
    wheels = [f"{name}{wheel}" for name in ("c_s", "k_s", "m_u", "k_u", "m_s") for wheel in (1, 2)]
    names = ["d_1", "rhoA", "alpha", "beta", "m_s", *wheels]
    assert set(names) <= set(crossing.parameters)
    assert {f"EI_{n}" for n in range(1, 8)} <= set(crossing.parameters)
    assert crossing.parameters["EI_1"].unit == "N·m²"
    assert found.bridges["bridge-1"].crossings_used == (crossing.crossing_id,)
    assert list(found.bridges["bridge-1"].elements) == [f"EI_{n}" for n in range(1, 8)]
    assert rrd.read_bytes()[:4] == b"RRF2"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.json", "out.rrd"]
    text = console.export_text()
    assert re.search(r"EI_4\s+12\.86\s+17\.14\s+6\.2\d\s+0\.400\n", text)
    assert "no_noise_model" in text
    assert "95 %" not in text  # an interval that means nothing is not printed
    assert "common to all" not in text


def test_sensors_without_noise_are_not_for_the_method_of_noise(
    empty_recording: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    site = tmp_path / "site.toml"
    quiet = paper_site().sensor.model_copy(update={"noise_density_ug_per_rthz": (0.0,) * 4})
    site.write_text(site_toml(paper_site().model_copy(update={"sensor": quiet})))
    arguments = ["identify", str(empty_recording()), "--site", str(site), "--method"]
    assert cli.main([*arguments, "pre"]) == 0
    assert "are for --method least-squares" in capsys.readouterr().err
    assert cli.main([*arguments, "least-squares"]) == 0
    assert capsys.readouterr().err == ""


def test_a_failing_writer_leaves_the_files_of_yesterday(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.rrd"
    out.write_text("RRF2 of yesterday")

    def fail(path: Path, *_: object) -> None:
        path.write_bytes(b"half")
        raise RuntimeError("broken")

    monkeypatch.setattr("services.viewer.rerun_file.write_rrd", fail)
    arguments = ["identify", str(recording), "--method", "least-squares", "--rrd", str(out)]
    assert cli.main(arguments) == 1
    assert out.read_text() == "RRF2 of yesterday"
    assert [path.name for path in tmp_path.iterdir()] == ["out.rrd"]


def test_no_crossing_is_a_valid_answer(
    empty_recording: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.json"
    assert cli.main(["identify", str(empty_recording()), "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    assert printed == "no crossing of a known bridge (bridge-1)\n"
    found = load_results(out)
    assert found.crossings == ()
    assert found.bridges == {}


@pytest.mark.parametrize(("stream", "words"), [("accel", "accelerations"), ("gnss", "positions")])
def test_a_stream_that_is_missing_altogether(
    empty_recording: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    stream: str,
    words: str,
) -> None:
    path = empty_recording(without=(stream,))
    assert cli.main(["identify", str(path), "--json", str(tmp_path / "out.json")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"driveby: {path}: no {words} ({stream}), a recording of a truck")
    assert err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["empty.mcap"]


def test_an_unknown_vehicle(
    empty_recording: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = empty_recording(vehicle="stranger")
    assert cli.main(["identify", str(path)]) == 2
    err = capsys.readouterr().err
    assert err == f"driveby: {path}: stranger drove, but the site has no such vehicle\n"


def test_a_malformed_message_in_a_recording_is_named(recording: Path, tmp_path: Path) -> None:
    messages: list[Message] = []
    for message in read_messages(recording):
        is_it = (message.key.stream, message.sequence) == ("accel", 17)
        messages.append(message._replace(payload=b"\xff\xff") if is_it else message)
    path = tmp_path / "bad.mcap"
    write_recording(path, messages, site_toml=read_site(recording), reason="test")
    with pytest.raises(InputError, match=rf"{path}: accel 17: not a driveby\.v1\.AccelBatch"):
        identified(path)


def test_a_recording_without_a_site_needs_one(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "bare.mcap"
    write_recording(path, read_messages(recording), site_toml=None, reason="test")
    with pytest.raises(InputError, match="no site file is stored in it, give one with --site"):
        site_of([path], None)
    site = tmp_path / "site.toml"
    site.write_text(site_toml(paper_site()))
    assert site_of([path], site) == paper_site()


def test_method_and_seed_reach_the_search(recording: Path) -> None:
    """Two seeds of the random walk are two answers, the same seed is the same one."""
    settings = IdentificationSettings(method="random_walk", particles=8, steps=3)
    site = site_of([recording], None)
    answers = [
        ratios(only(identify_recordings([recording], site, chosen)))
        for chosen in (settings, settings, settings.model_copy(update={"seed": 9}))
    ]
    assert answers[0] == answers[1]
    assert answers[0] != answers[2]


@pytest.mark.parametrize("into", [False, True])
def test_csv_files_are_refused_with_the_command_that_converts_them(
    into: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    table = folder / "accel_00.csv"
    table.write_text("time_s,sprung_front\n")
    more = ["--into", str(tmp_path / "results")] if into else []
    assert cli.main(["identify", str(folder), *more]) == 2
    line = capsys.readouterr().err
    assert f"driveby import {folder} --site SITE.toml -o DRIVE.mcap makes one" in line
    assert cli.main(["identify", str(table)]) == 2
    assert "driveby import makes one of CSV files" in capsys.readouterr().err


def test_single_crossing_has_the_finding_and_its_level_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The finding states the fused level; the crossing's own is another number."""
    site = paper_site()
    found = results_of(site, some_crossing("a"), used="a")
    (crossing,), (state,) = found.crossings, found.bridges.values()
    assert state.level is not None
    assert crossing.parameters is not None
    assert crossing.derived is not None
    level = crossing.parameters["EI_4"].model_copy(update={"mean": 0.91, "std": 0.05})
    wide = crossing.parameters["EI_1"].model_copy(update={"std": 1e10})
    derived = crossing.derived.model_copy(
        update={"ei_level": level, "ei_thirds": Thirds(left=level, middle=level, right=level)}
    )
    parameters = {**crossing.parameters, "EI_1": wide}
    crossing = crossing.model_copy(update={"parameters": parameters, "derived": derived})
    for finding, times in ((describe_level(state.level), 0), ("No element differs clearly.", 1)):
        shown = state.model_copy(update={"between_crossing_std": 0.02, "finding": finding})
        bridges = {"bridge-1": shown}
        _print(
            Console(width=200),
            found.model_copy(update={"crossings": (crossing,), "bridges": bridges}),
            site,
        )
        out = capsys.readouterr().out
        assert f"the bridge: {finding}\n" in out
        assert out.count("overall stiffness / nominal: 0.91 ± 0.05") == times
        assert out.lower().count("overall stiffness") == 1
        assert "not resolved: EI_1 (standard deviation above 25 %)\n" in out
        assert "thirds of the bridge: 0.91" in out


def test_contradiction_of_the_site_file_is_a_remark(capsys: pytest.CaptureFixture[str]) -> None:
    site = paper_site()
    found = results_of(site, some_crossing("a"))
    _print(Console(width=80), found, site)
    assert "remark" not in capsys.readouterr().out
    _print(Console(width=80), with_contradictions(found, prior_z_rhoA=25.54), site)
    out = capsys.readouterr().out
    assert "\nverdict good\n" in out
    assert "\nremark: The estimate of the mass per length (rhoA) is 7,335 kg/m, declared 4,4" in out


def test_each_reason_is_followed_by_the_remedy_of_reports(
    capsys: pytest.CaptureFixture[str],
) -> None:
    reasons = ("sampler_diagnostics", "channel_inverted", "no_noise_model", "tandem")
    crossing = some_crossing("a", verdict="suspect", reasons=reasons)
    site = paper_site()
    found = results_of(site, crossing | {"reason_texts": ["A.", "B [x].", "C.", "D."]})
    _print(Console(width=200), found.model_copy(update={"bridges": {}}), site)
    lines = capsys.readouterr().out.splitlines()
    begin = lines.index("verdict suspect") + 1
    assert lines[begin : begin + 7] == [
        "  sampler_diagnostics: A.",
        f"    {ENGLISH.advice['sampler_diagnostics']}",
        "  channel_inverted: B [x].",
        f"    {ENGLISH.advice['channel_inverted']}",
        "  no_noise_model: C.",
        "    Identify with method pre.",
        "  tandem: D.",
    ]


def test_fused_state_names_the_remedy_of_its_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    site = paper_site()
    state = results_of(site, some_crossing("a"), used="a").bridges["bridge-1"]
    reasons = {"reasons": ("uses_suspect",), "reason_texts": ("A.",)}
    print_bridge(Console(width=200), site.bridges[0], state.model_copy(update=reasons))
    remedy = ENGLISH.bridge_advice["uses_suspect"]
    assert f"  uses_suspect: A.\n    {remedy}\n" in capsys.readouterr().out


def test_intervals_of_a_stiff_bridge_stay_on_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    site = paper_site()
    ratios = RATIOS.copy()
    ratios[4] = 31.0
    state = results_of(site, some_crossing("a"), used="a", ratios=ratios).bridges["bridge-1"]
    losses = {f"EI_{n}": {"10": 0.98, "20": 0.95, "30": 0.9} for n in range(1, 8)}
    for given in (None, losses):
        print_elements(Console(width=80), site.bridges[0], state.elements, True, given)
        lines = capsys.readouterr().out.splitlines()
        rows = [line for line in lines if line.lstrip().startswith("EI_")]
        assert len(rows) == len(lines) - (1 if given is None else 2)
        assert all(row.count("…") == (2 if given is None else 1) for row in rows)


def test_bridge_without_site_validation_has_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = paper_site()
    found = results_of(site, some_crossing("a"), some_crossing("b", entry=60.0))
    failed = certificate(site, passed=False)
    here = f"The folder {tmp_path} has no site validation of"
    for folder, words in ((tmp_path, here), (tmp_path, "Site validation of")):
        print_validation(Console(), found, site, folder)
        out = capsys.readouterr().out
        assert out.startswith(f"bridge-1: {words} truck-1 on this bridge")
        assert out.count("bridge-1:") == 1
        save(folder, failed)
    save(tmp_path, certificate(site))
    print_validation(Console(), found, site, tmp_path)
    out = capsys.readouterr().out
    assert out.startswith("bridge-1: Site validation of truck-1: passed; ")
    assert out.count("bridge-1:") == 1


def test_a_certificate_that_there_is_is_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site, folder, out = paper_site(), tmp_path / "certificates", tmp_path / "out.json"
    identify = ["identify", str(recording), "--method", "least-squares", "--json", str(out)]
    made = certificate(
        site, hash=pair_hash(site, VehicleBridgePair("truck-1", "bridge-1"), LEAST_SQUARES)
    )
    save(folder, made)
    assert cli.main([*identify, "--validations", str(folder)]) == 0
    assert only(load_results(out)).certificate == made.hash
    save(folder, made.model_copy(update={"passed": False}))
    assert cli.main([*identify, "--validations", str(folder)]) == 0
    assert only(load_results(out)).certificate is None
    capsys.readouterr()
    assert cli.main([*identify, "--validations", str(tmp_path / "none")]) == 2
    line = capsys.readouterr().err
    assert (
        line
        == f"driveby: --validations: {tmp_path / 'none'} is not a folder of validation records\n"
    )
