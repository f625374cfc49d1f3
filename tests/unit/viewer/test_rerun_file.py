"""The Rerun recording, read back: every series with all its samples, on the right timelines."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import Chunk, RrdReader

from schemas.results import CrossingResult, ResultHeader, results, results_json
from schemas.results_on_the_wire import crossing_to_protobuf
from schemas.signals import (
    CHANNELS,
    AccelBatch,
    AccelChannel,
    GnssFix,
    encode_accel,
    encode_gnss,
    encode_location,
)
from schemas.site import Site
from schemas.site_file import parse_site
from schemas.topics import Key, Message
from services.cli import main as cli
from services.common.errors import InputError
from services.common.language import ENGLISH
from services.recordings.writer import write_recording
from services.viewer import rerun_file
from services.viewer.crossing_scene import CrossingScene, crossing_root
from services.viewer.crossing_view import CrossingView, front_axle_chainage, view_of_crossing
from services.viewer.layout import blueprint
from services.viewer.panels import rigidity, signals
from services.viewer.panels.verdict import verdict_markdown
from services.viewer.rerun_file import RerunContent, write_rrd
from services.viewer.rerun_parts import CHAINAGE
from services.viewer.rerun_places import bridges_near_tracks, bridges_of_site
from services.viewer.strip import STRIP_HEIGHT, STRIP_WIDTH, rigidity_strip, strip_top
from services.viewer.vehicle_signals import (
    VehicleSignals,
    acceleration_series,
    signals_of_messages,
)
from services.viewer.view import (
    convert,
    view_command,
    viewer_arguments,
)
from tests.viewer_screen import complaints, open_tab, opened, picture, pixels, view_named
from tests.waiting import LONGEST_S, until

START_NS = 1_790_010_000_000_000_000
RATE_HZ, BATCH = 1000.0, 50
NOMINAL_NM2 = 15.6e9
RATIOS = (1.0, 0.4, 1.1)
SITE_TOML = """
[vehicle]
id = "truck-1"
total_mass_kg = 9530.0
wheelbase_m = 4.4
front_axle_to_cg_m = 1.215
suspension_damping_ns_per_m = [24200, 29000]
suspension_stiffness_n_per_m = [456000, 410000]
unsprung_mass_kg = [469, 751]
tyre_stiffness_n_per_m = [4790000, 4310000]
gps_antenna_to_front_axle_m = 0.0
[bridge]
id = "bridge-1"
span_m = 30.0
start_latitude_deg = 36.11060000
start_longitude_deg = 140.10100000
end_latitude_deg = 36.11072274
end_longitude_deg = 140.10129688
elements = 3
element_lengths_m = [10.0, 5.0, 15.0]
flexural_rigidity_nm2 = 15.6e9
mass_per_length_kg_per_m = 4400.0
rayleigh_alpha_per_s = 0.7024
rayleigh_beta_s = 0.0052
[sensor]
rate_hz = 1000.0
noise_density_ug_per_rthz = 25.0
"""


@pytest.fixture
def site() -> Site:
    return parse_site(SITE_TOML, "site.toml")


def accel(count: int = 40, channels: tuple[str, ...] = CHANNELS) -> list[AccelBatch]:
    batches = []
    for sequence in range(count):
        first_ns = START_NS + sequence * 50_000_000
        phase = sequence * BATCH + np.arange(BATCH)
        batches.append(
            AccelBatch(
                7,
                sequence,
                first_ns - START_NS,
                first_ns,
                {name: AccelChannel(RATE_HZ, np.sin(phase / 30.0)) for name in channels},
            )
        )
    return batches


def gnss(count: int = 20) -> list[GnssFix]:
    return [
        GnssFix(
            7,
            sequence,
            sequence * 100_000_000,
            START_NS + sequence * 100_000_000,
            36.1105 + sequence * 2e-5,
            140.1008 + sequence * 4e-5,
            24.0,
            10.0,
        )
        for sequence in range(count)
    ]


def crossing(**changes: object) -> CrossingResult:
    def parameter(value: float, unit: str) -> dict[str, object]:
        return {
            "unit": unit,
            "mean": value,
            "std": 0.02 * value,
            "q025": 0.96 * value,
            "q50": value,
            "q975": 1.04 * value,
        }

    x_m = np.linspace(-2.0, 32.0, 69)
    fields: dict[str, object] = {
        "crossing_id": "truck-1_bridge-1_20260921T170000500",
        "realm": "sim-test",
        "vehicle": "truck-1",
        "bridge": "bridge-1",
        "direction": "start_to_end",
        "entry_time": START_NS / 1e9 + 0.5,
        "exit_time": START_NS / 1e9 + 1.2,
        "speed_m_per_s": 10.0,
        "method": "least_squares",
        "verdict": "good",
        "parameters": {
            **{
                f"EI_{number}": parameter(ratio * NOMINAL_NM2, "N·m²")
                for number, ratio in enumerate(RATIOS, start=1)
            },
            "k_s1": parameter(456_000.0, "N/m"),
        },
        "road": {
            "x_m": x_m.tolist(),
            "front_m": (1e-3 * np.sin(x_m) + 1e-5).tolist(),
            "rear_m": (1e-3 * np.sin(x_m)).tolist(),
            "mean_m": (1e-3 * np.sin(x_m)).tolist(),
        },
    }
    return CrossingResult.model_validate({**fields, **changes})


def rejected() -> CrossingResult:
    return crossing(verdict="rejected", reasons=["channel_missing"], parameters=None, road=None)


def batches_of(chunks: list[Chunk], entity: str) -> list[pa.RecordBatch]:
    return [
        chunk.to_record_batch()
        for chunk in chunks
        if chunk.entity_path == f"/{entity}" and not chunk.is_static
    ]


def rows(chunks: list[Chunk], entity: str) -> pa.RecordBatch:
    """The rows over time of an entity."""
    batches = [batch for batch in batches_of(chunks, entity) if "time" in batch.schema.names]
    assert batches, f"{entity} is not in the file, there are {sorted(paths(chunks))}"
    return pa.Table.from_batches(batches).combine_chunks().to_batches()[0]


def paths(chunks: list[Chunk]) -> set[str]:
    return {chunk.entity_path.removeprefix("/") for chunk in chunks}


def scalars(batch: pa.RecordBatch) -> np.ndarray:
    column = next(name for name in batch.schema.names if name.endswith("Scalars:scalars"))
    return np.array([values[0] for values in batch.column(column).to_pylist()])


def times_ns(batch: pa.RecordBatch) -> np.ndarray:
    return batch.column("time").cast(pa.int64()).to_numpy()


@pytest.fixture
def drive(tmp_path: Path, site: Site) -> tuple[list[Chunk], CrossingView]:
    path = tmp_path / "drive.rrd"
    vehicles = {"truck-1": VehicleSignals(accel(), gnss())}
    write_rrd(path, RerunContent(vehicles, [crossing()], site))
    view = view_of_crossing(crossing(), site.bridges[0])
    return RrdReader(path).stream().to_chunks(), view


def test_every_sample_of_every_channel_is_there_at_its_time(drive):
    chunks, _ = drive
    expected = np.sin(np.arange(40 * BATCH) / 30.0)
    for channel in CHANNELS:
        batch = rows(chunks, f"vehicle/truck-1/acceleration/{channel}")
        assert scalars(batch) == pytest.approx(expected)
        assert (times_ns(batch) == START_NS + np.arange(40 * BATCH) * 1_000_000).all()


def test_named_channels_are_drawn(tmp_path: Path, site: Site) -> None:
    names = ("sprung_front", "axle_1_left", "axle_1_right")
    path = tmp_path / "named.rrd"
    vehicles = {"truck-1": VehicleSignals(accel(channels=names), gnss())}
    write_rrd(path, RerunContent(vehicles, [crossing()], site))
    chunks = RrdReader(path).stream().to_chunks()
    view = view_of_crossing(crossing(), site.bridges[0])
    for channel in names:
        assert rows(chunks, f"vehicle/truck-1/acceleration/{channel}").num_rows == 40 * BATCH
        assert rows(chunks, f"{crossing_root(view)}/acceleration/{channel}").num_rows > 0


def test_track_has_every_fix(drive):
    chunks, _ = drive
    position = rows(chunks, "map/position/truck-1")
    assert position.num_rows == 20
    column = next(name for name in position.schema.names if name.endswith(":positions"))
    assert np.array(position.column(column).to_pylist())[:, 0] == pytest.approx(
        np.array([(fix.latitude_deg, fix.longitude_deg) for fix in gnss()])
    )
    assert {"map/track/truck-1", "map/fixes/truck-1", "map/bridge/bridge-1"} <= paths(chunks)


def test_crossing_is_on_both_timelines(drive):
    chunks, view = drive
    batch = rows(chunks, f"{crossing_root(view)}/acceleration/sprung_front")
    entry_ns = START_NS + 500_000_000
    chainage_mm = batch.column("chainage_mm").to_numpy()
    assert chainage_mm == pytest.approx((times_ns(batch) - entry_ns) / 1e9 * 10.0 * 1e3, abs=1.0)
    assert 0 < batch.num_rows < 40 * BATCH + 1
    road = rows(chunks, f"{crossing_root(view)}/road/front")
    assert road.column("chainage_mm").to_numpy() == pytest.approx(np.linspace(-2000, 32000, 69))
    assert scalars(road) == pytest.approx(1e3 * view.road.front_m)
    difference = rows(chunks, f"{crossing_root(view)}/road_difference/front_minus_rear")
    assert scalars(difference) == pytest.approx(np.full(69, 1e-2))


def test_whole_drive_is_a_picture_over_its_own_time(drive):
    chunks, _ = drive
    assert "drive/truck-1/picture" in paths(chunks)


def test_play_drives_at_the_speed_of_the_truck_and_on_the_bridge(site: Site) -> None:
    view = view_of_crossing(crossing(), site.bridges[0])
    scene = CrossingScene(view, crossing_root(view), None)
    panel = blueprint({}, [scene]).time_panel
    assert panel.timeline == CHAINAGE
    assert panel.play_state == "playing"
    assert panel.fps == pytest.approx(1e3 * view.speed_m_per_s)
    assert panel.loop_mode == "selection"
    ends = panel.time_selection
    assert (ends.min.value, ends.max.value) == (0, 30_000)
    assert blueprint({}, []).time_panel.play_state == "paused"


def test_ticks_of_chainage_count_from_a_round_place(drive):
    """Rerun counts them from the first row of a plot, also from one without a value."""
    chunks, view = drive
    root = crossing_root(view)
    of_plots = {"road": ["front", "rear"], "road_difference": ["front_minus_rear"]}
    of_plots["acceleration"] = ["ends", "sprung_front", "unsprung_rear"]
    for plot, series in of_plots.items():
        places, values = [], []
        for entity in (f"{root}/{plot}/{one}" for one in series):
            for batch in batches_of(chunks, entity):
                places += batch.column("chainage_mm").to_pylist()
                values += scalars(batch).tolist()
        first_mm = min(places)
        assert first_mm % 10_000 == 0
        assert np.isnan(values[places.index(first_mm)])
        with_value = [place for place, value in zip(places, values, strict=True) if value == value]
        assert 0 <= min(with_value) - first_mm < 10_000


def test_the_title_of_the_road_has_its_scale_which_a_low_plot_lacks(site: Site) -> None:
    view = view_of_crossing(crossing(), site.bridges[0])
    scene = CrossingScene(view, "root", None)
    shown = signals.PANEL.data(scene)
    assert shown is not None
    titles = [plot.name for plot in signals.PANEL.layout(scene, shown).contents]
    assert titles == ["Road profile (± 1.0 mm)", "Front minus rear (mm)"]


def test_accelerations_say_when_the_truck_was_on_the_bridge(drive):
    chunks, view = drive
    ends = rows(chunks, f"{crossing_root(view)}/acceleration/ends")
    assert times_ns(ends) / 1e9 == pytest.approx([view.entry_time_s, view.exit_time_s])
    stay_s = view.exit_time_s - view.entry_time_s
    on_mm, off_mm = ends.column("chainage_mm").to_pylist()
    assert on_mm == 0
    assert off_mm == pytest.approx(1e3 * view.speed_m_per_s * stay_s, abs=1.0)
    assert scalars(ends).tolist() == [0.0, 0.0]


def test_bars_begin_and_end_on_their_elements(drive):
    chunks, view = drive
    chart = next(c for c in chunks if c.entity_path == f"/{crossing_root(view)}/rigidity")
    columns = {name.split(":")[-1]: name for name in chart.to_record_batch().schema.names}
    batch = chart.to_record_batch()
    values, begins = (
        np.array(batch.column(columns[name]).to_pylist()[0][0]["buffer"])
        for name in ("values", "abscissa")
    )
    widths = np.array(batch.column(columns["widths"]).to_pylist()[0])
    assert values == pytest.approx(np.array(RATIOS) * 15.6)
    edges = np.array([0.0, 10.0, 15.0, 30.0])
    assert (begins > edges[:-1]).all()
    assert (begins + widths < edges[1:]).all()
    assert widths / np.diff(edges) == pytest.approx(np.full(3, 0.9))


def test_rejected_crossing_shows_its_reason_and_no_number(tmp_path: Path, site: Site) -> None:
    path = tmp_path / "rejected.rrd"
    vehicles = {"truck-1": VehicleSignals(accel(channels=("sprung_front",)), gnss())}
    write_rrd(path, RerunContent(vehicles, [rejected()], site))
    chunks = RrdReader(path).stream().to_chunks()
    root = crossing_root(view_of_crossing(rejected(), site.bridges[0]))
    assert f"{root}/verdict" in paths(chunks)
    assert not any(path.startswith((f"{root}/rigidity", f"{root}/strip")) for path in paths(chunks))
    text = verdict_markdown(view_of_crossing(rejected(), site.bridges[0]))
    assert all(f"- {ENGLISH.advice[code]}" in text for code in rejected().reasons)
    assert text.startswith("# Rejected")
    assert "lacks one of the four accelerometers" in text
    assert "EI_" not in text


def test_table_withholds_intervals_that_mean_nothing(site: Site) -> None:
    known = view_of_crossing(crossing(), site.bridges[0])
    unknown = view_of_crossing(
        crossing(verdict="suspect", reasons=["no_noise_model"]), site.bridges[0]
    )
    assert "| EI_2 | 6.24 GN·m² | 5.99 … 6.49 | 0.400 |" in verdict_markdown(known)
    assert "| EI_2 | 6.24 GN·m² | – | 0.400 |" in verdict_markdown(unknown)
    assert "| k_s1 | 4.56e+05 N/m |" in verdict_markdown(known)


def test_gap_breaks_the_line() -> None:
    batches = accel(10)
    del batches[4:6]
    time_ns, samples = acceleration_series(batches)["sprung_rear"]
    assert len(samples) == 8 * BATCH + 1
    (hole,) = np.flatnonzero(np.isnan(samples))
    assert hole == 4 * BATCH
    assert (np.diff(time_ns) > 0).all()
    whole, _ = acceleration_series(accel(10))["sprung_rear"]
    assert len(whole) == 10 * BATCH


def test_absent_channels_stay_absent() -> None:
    assert set(acceleration_series(accel(3, ("sprung_front",)))) == {"sprung_front"}


def test_only_bridges_that_fit_on_the_map_of_the_track_are_on_it(site: Site) -> None:
    (near,) = bridges_of_site(site)
    far = near._replace(
        identifier="far",
        start_latitude_deg=37.9,
        start_longitude_deg=-122.3,
        end_latitude_deg=37.9,
        end_longitude_deg=-122.299,
    )
    signals = VehicleSignals([], gnss())
    assert bridges_near_tracks([far, near], [signals]) == [near]
    assert bridges_near_tracks([far, near], [VehicleSignals([], [])]) == [far, near]


def test_chainage_falls_when_the_truck_comes_from_the_other_end(site: Site) -> None:
    view = view_of_crossing(crossing(direction="end_to_start"), site.bridges[0])
    times = view.entry_time_s + np.array([0.0, 1.0, 3.0])
    assert front_axle_chainage(view, times) == pytest.approx([30.0, 20.0, 0.0], abs=1e-5)


def test_unresolved_element_does_not_squeeze_the_strip(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its interval goes on beyond the upper edge, in an arrow, as in the pictures."""
    view = view_of_crossing(crossing(), site.bridges[0])
    assert view.rigidity_nm2 is not None
    usual = view.rigidity_nm2[:, None] * np.array([0.9, 1.1])
    wide = usual.copy()
    wide[0, 1] *= 9.0
    drawn: list[list[tuple[float, float]]] = []
    monkeypatch.setattr(rigidity, "log_strips", lambda *given: drawn.extend(given[2]))
    at = np.arange(float(len(usual)))
    tops = []
    for interval, arrows in ((usual, 0), (wide, 1)):
        drawn.clear()
        tops.append(strip_top(view._replace(interval_nm2=interval)))
        low, high = interval.T / view.nominal_nm2
        rigidity._log_whiskers(None, "a", at, at, (low, high), tops[-1])  # type: ignore[arg-type]
        assert sum(len(strip) == 3 and strip[1][1] == 0.0 for strip in drawn) == arrows
    assert tops[1] <= tops[0] + 0.5


def test_strip_is_brightest_at_the_estimate(site: Site) -> None:
    view = view_of_crossing(crossing(), site.bridges[0])
    strip = rigidity_strip(view).astype(int).sum(axis=2)
    assert strip.shape == (STRIP_HEIGHT, STRIP_WIDTH)
    for chainage, ratio in zip((5.0, 12.5, 22.5), RATIOS, strict=True):
        column = strip[:, int(chainage / 30.0 * STRIP_WIDTH)]
        assert column.argmax() == pytest.approx(STRIP_HEIGHT * (1 - ratio / 1.5), abs=1.5)
    wide = view._replace(interval_nm2=view.rigidity_nm2[:, None] * np.array([0.6, 1.4]))
    assert rigidity_strip(wide).astype(int).sum() > strip.sum()


def messages() -> list[Message]:
    def message(stream: str, payload: bytes, sequence: int, time_ns: int) -> Message:
        key = Key("sim-test", "vehicle", "truck-1", stream)
        return Message(key, payload, 7, sequence, time_ns, time_ns)

    found = [message("accel", encode_accel(b), b.sequence, b.wall_time_ns) for b in accel()]
    for fix in gnss():
        found.append(message("gnss", encode_gnss(fix), fix.sequence, fix.wall_time_ns))
        found.append(message("location", encode_location(fix), fix.sequence, fix.wall_time_ns))
    return sorted(found, key=lambda one: one.log_time_ns)


def estimate() -> Message:
    header = ResultHeader("0", START_NS / 1e9, "0" * 16, {}, 0)
    payload = crossing_to_protobuf(crossing(), header).SerializeToString()
    time_ns = START_NS + 2_000_000_000
    return Message(
        Key("sim-test", "bridge", "bridge-1", "estimate"), payload, 1, 0, time_ns, time_ns
    )


def test_repeated_and_late_messages_are_drawn_once_and_in_order() -> None:
    mixed = [*messages()[::-1], *messages()[:10]]
    broken = messages()[0]._replace(payload=b"\xff\xff", sequence=999)
    signals = signals_of_messages([broken, *mixed])["truck-1"]
    assert [batch.sequence for batch in signals.accel] == list(range(40))
    assert [fix.sequence for fix in signals.gnss] == list(range(20))


def test_recording_with_its_results_becomes_a_rerun_file(tmp_path: Path, site: Site) -> None:
    recording, rrd = tmp_path / "run.mcap", tmp_path / "run.rrd"
    write_recording(recording, [*messages(), estimate()], site_toml=SITE_TOML, reason="test")
    convert(recording, rrd)
    found = paths(RrdReader(rrd).stream().to_chunks())
    root = crossing_root(view_of_crossing(crossing(), site.bridges[0]))
    assert {f"{root}/rigidity", f"{root}/verdict", "map/position/truck-1"} <= found


def test_results_are_drawn_with_the_site_of_the_recording_beside_them(tmp_path: Path) -> None:
    file = tmp_path / "run.json"
    header = ResultHeader("0", START_NS / 1e9, "0" * 16, {}, 0)
    file.write_text(results_json(results(header, [crossing()], {})))
    rrd = tmp_path / "out.rrd"
    with pytest.raises(InputError, match="same folder"):
        convert(file, rrd)
    assert not rrd.exists()
    write_recording(tmp_path / "run.mcap", messages(), site_toml=SITE_TOML, reason="test")
    convert(file, rrd)
    assert any(path.endswith("/rigidity") for path in paths(RrdReader(rrd).stream().to_chunks()))


@pytest.mark.parametrize("name", ["missing.rrd", "missing.mcap", "notes.txt"])
def test_what_cannot_be_opened_is_bad_input(tmp_path: Path, name: str) -> None:
    from rich.console import Console

    (tmp_path / "notes.txt").write_text("no recording")
    with pytest.raises(InputError, match=name):
        view_command(target=tmp_path / name, web=False, console=Console(quiet=True))


def test_without_a_screen_one_line_names_the_browser(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    recording = tmp_path / "run.rrd"
    recording.touch()
    for target in (str(recording), "live"):
        assert cli.main(["view", target]) == 1
        assert capsys.readouterr().err == (
            "driveby: no screen for a window (DISPLAY is not set); try --web\n"
        )


@pytest.mark.parametrize("web", [False, True])
def test_viewer_listens_on_loopback_only(web: bool) -> None:
    arguments = viewer_arguments(Path("a.rrd"), web=web)
    assert arguments[arguments.index("--bind") + 1] == "127.0.0.1"
    assert ("--web-viewer" in arguments) == web


SIGNAL_ITSELF = """
import os, signal, subprocess, time
begin = subprocess.Popen
def told_to_stop_meanwhile(arguments, **options):
    process = begin(arguments, **options)
    if "analytics" not in arguments:
        while not (started.exists() and started.read_text().endswith("\\n")):
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)
    return process
subprocess.Popen = told_to_stop_meanwhile
"""


@pytest.mark.process
@pytest.mark.parametrize("while_it_starts", [False, True])
def test_viewer_ends_with_the_command_that_started_it(
    tmp_path: Path, while_it_starts: bool
) -> None:
    """A stand-in for the viewer: the real one needs a screen."""
    started = tmp_path / "started"
    program = tmp_path / "viewer"
    program.write_text(
        f"#!/bin/sh\n[ $1 = analytics ] && exit\necho $$ > {started}\nexec sleep 3600\n"
    )
    program.chmod(0o755)
    recording = tmp_path / "run.rrd"
    recording.touch()
    code = (
        "import sys; from pathlib import Path; from rich.console import Console\n"
        "from services.viewer import view\n"
        f"view.viewer_program = lambda: Path({str(program)!r})\n"
        f"started = Path({str(started)!r})\n"
        f"{SIGNAL_ITSELF if while_it_starts else ''}"
        f"sys.exit(view.view_command(target={str(recording)!r}, web=False, console=Console()))"
    )
    screen = {**os.environ, "DISPLAY": ":0"}
    with subprocess.Popen([sys.executable, "-c", code], env=screen) as command:
        try:
            until(lambda: started.exists() and started.read_text().endswith("\n"))
            if not while_it_starts:
                command.terminate()
            assert command.wait(timeout=LONGEST_S) == 0
        finally:
            command.kill()
    with pytest.raises(ProcessLookupError):
        os.kill(int(started.read_text()), 0)


def coloured(picture: np.ndarray) -> int:
    """Number of pixels that are neither black nor grey."""
    rgb = picture[:, :, :3]
    return int((np.ptp(rgb, axis=2) > 0.2).sum())


@pytest.mark.process
def test_recording_opened_directly_is_drawn_on_a_map(tmp_path: Path) -> None:
    """By Rerun itself, from what the recording says of its messages."""
    recording = tmp_path / "run.mcap"
    write_recording(recording, messages(), site_toml=None, reason="test")
    with opened(recording, tmp_path) as viewer:
        view = view_named(viewer, "")
        assert (view.view_class, view.reports) == ("Map", [])
        assert coloured(pixels(picture(viewer, view))) > 20


@pytest.mark.process
def test_rerun_file_has_its_layout_and_draws_without_complaint(tmp_path: Path, site: Site) -> None:
    path = tmp_path / "drive.rrd"
    vehicles = {"truck-1": VehicleSignals(accel(), gnss())}
    write_rrd(path, RerunContent(vehicles, [crossing()], site))
    with opened(path, tmp_path) as viewer:
        assert {view.view_class for view in viewer.get_state().views} == {
            "BarChart",
            "2D",
            "Map",
            "TextDocument",
            "TimeSeries",
        }
        assert complaints(viewer) == []
        viewer.set_time(play_state="paused")
        open_tab(viewer, "EI (GN·m²)")
        assert coloured(pixels(picture(viewer, view_named(viewer, "EI (GN·m²)")))) > 20_000  # bars


@pytest.mark.process
def test_a_recording_is_shown_with_its_channels_places_and_crossings(tmp_path: Path) -> None:
    recording, rrd = tmp_path / "run.mcap", tmp_path / "run.rrd"
    write_recording(recording, messages(), site_toml=SITE_TOML, reason="test")
    convert(recording, rrd)
    with opened(rrd, tmp_path) as viewer:
        names = {view.name for view in viewer.get_state().views}
        assert {
            "What was recorded",
            "truck-1: Body accelerations (m/s²)",
            "truck-1: Axle accelerations (m/s²)",
            "truck-1: Speed (m/s)",
            "Plan of the drive (m, north up)",
            "Map",
        } <= names
        assert complaints(viewer) == []
        for name, least in (("truck-1: Body", 500), ("truck-1: Speed", 100), ("Plan of", 100)):
            drawn = pixels(picture(viewer, view_named(viewer, name)))
            assert coloured(drawn) > least, name


def test_a_long_drive_is_sent_in_pieces_with_every_sample_and_gap(
    tmp_path: Path, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches = accel(40)
    del batches[19:21]  # a gap between two pieces, and one inside
    del batches[5]
    whole = acceleration_series(batches)
    monkeypatch.setattr(rerun_file, "_PIECE", 9)
    path = tmp_path / "drive.rrd"
    vehicles = {"truck-1": VehicleSignals(batches, gnss())}
    write_rrd(path, RerunContent(vehicles, [crossing()], site))
    chunks = RrdReader(path).stream().to_chunks()
    for channel in CHANNELS:
        found = rows(chunks, f"vehicle/truck-1/acceleration/{channel}")
        order = np.argsort(times_ns(found), kind="stable")
        time_ns, samples = whole[channel]
        assert times_ns(found)[order].tolist() == time_ns.tolist()
        assert scalars(found)[order] == pytest.approx(samples, nan_ok=True)
    assert np.isnan(whole["sprung_front"][1]).sum() == 2
