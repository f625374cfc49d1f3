"""The live picture, read back from a file: what is drawn when, how much of it, and from what."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult, ResultHeader, lowest_element
from schemas.results_on_the_wire import bridge_to_protobuf, crossing_to_protobuf
from schemas.signals import (
    CHANNELS,
    AccelBatch,
    AccelChannel,
    GnssFix,
    Identity,
    encode_accel,
    encode_gnss,
)
from schemas.site import Site
from schemas.topics import Key
from services.bus.realm_listener import BusMessage
from services.cli import main as cli
from services.common.errors import FailureError
from services.viewer.crossing_view import elements_of_result
from services.viewer.live import APPLICATION, live_command
from services.viewer.live_layout import live_blueprint
from services.viewer.live_parts import PERIOD_S, extremes
from services.viewer.live_view import MAX_TRUCKS, LiveView
from services.viewer.settings import ViewSettings
from tests.endpoints import free_port
from tests.unit.cli.watching import alarm
from tests.unit.viewer.found import results_of, some_crossing

START_NS = 1_790_000_000_000_000_000
"""When the truck of `found.some_crossing` comes onto the bridge."""
EXIT_NS = START_NS + 4_000_000_000
HEADER = ResultHeader("0.1.0", 1.79e9, "hash", {}, 1)


class Live(NamedTuple):
    """A picture that is drawn into a file, and its clock."""

    picture: LiveView
    recording: rr.RecordingStream
    clock: list[float]
    path: Path

    def hears(self, owner: Any, stream: str, payload: bytes, name: str = "truck-1") -> None:
        self.picture.ingest(BusMessage(Key("live", owner, name, stream), Identity(1, 0), payload))

    def drawn(self) -> list[Chunk]:
        """All that has been drawn; nothing more can be."""
        self.picture.flush()
        self.recording.flush()
        self.recording.disconnect()
        chunks: list[Chunk] = list(RrdReader(self.path).stream())
        return chunks


def made(path: Path, site: Site | None) -> Live:
    recording = rr.RecordingStream(APPLICATION)
    recording.save(path)
    clock = [100.0]
    return Live(LiveView(recording, site, lambda: clock[0]), recording, clock, path)


@pytest.fixture
def live(tmp_path: Path, site: Site) -> Iterator[Live]:
    one = made(tmp_path / "live.rrd", site)
    yield one
    one.recording.disconnect()


def batch(number: int) -> bytes:
    """50 ms of four channels at 1 kHz, with a peak of one sample in each."""
    samples = np.full(50, 0.1)
    samples[7 + number % 30] = 9.0
    first_ns = START_NS + number * 50_000_000
    channels = {name: AccelChannel(1000.0, samples) for name in CHANNELS}
    return encode_accel(AccelBatch(1, number, number * 50_000_000, first_ns, channels))


def fix(number: int) -> bytes:
    time_ns = START_NS + number * 100_000_000
    place = 36.1106 + 2e-6 * number, 140.1010 + 5e-6 * number
    return encode_gnss(GnssFix(1, number, number * 100_000_000, time_ns, *place, 24.0, 10.0))


def drives(live: Live, seconds: int, name: str = "truck-1") -> None:
    for number in range(20 * seconds):
        live.hears("vehicle", "accel", batch(number), name)
        if number % 2 == 0:
            live.hears("vehicle", "gnss", fix(number // 2), name)


def state(which: pb.CrossingState, bridge: str = "bridge-1") -> bytes:
    return pb.Crossing(
        schema_version=1,
        crossing_id="a",
        vehicle="truck-1",
        bridge=bridge,
        direction=pb.START_TO_END,
        state=which,
        time_ns=START_NS if which == pb.DETECTED else EXIT_NS,
        entry_time_ns=START_NS,
        exit_time_ns=EXIT_NS,
    ).SerializeToString()


def result(site: Site, **changes: Any) -> CrossingResult:
    return results_of(site, some_crossing("a", **changes)).crossings[0]


def estimate(crossing: CrossingResult) -> bytes:
    return crossing_to_protobuf(crossing, HEADER).SerializeToString()


def rows(chunks: list[Chunk], entity: str) -> pa.Table:
    found = [
        chunk.to_record_batch()
        for chunk in chunks
        if chunk.entity_path == f"/{entity}" and not chunk.is_static
    ]
    assert found, f"{entity} is not there, but {sorted({c.entity_path for c in chunks})}"
    return pa.concat_tables(
        map(pa.Table.from_batches, ([one] for one in found)), promote_options="default"
    )


def values(table: pa.Table, ending: str) -> list[Any]:
    (name,) = [name for name in table.column_names if name.endswith(ending)]
    return [None if not one else one[0] for one in table[name].to_pylist()]


def times_s(table: pa.Table) -> list[float]:
    """Seconds since the entry."""
    return [(t - START_NS) / 1e9 for t in table["time"].cast(pa.int64()).to_pylist()]


def test_peaks_are_kept_and_gaps_stay_gaps() -> None:
    time_ns = np.arange(2000) * 1_000_000
    samples = np.sin(np.arange(2000) / 50.0)
    samples[777], samples[1234], samples[500] = 50.0, -60.0, np.nan
    times, few = extremes(time_ns, samples, 1000.0)
    assert few.size <= 2 * 2.0 / PERIOD_S
    assert np.all(np.diff(times) > 0)
    assert (few[times == 777_000_000], few[times == 1_234_000_000]) == (50.0, -60.0)
    assert np.isnan(few[times == 500_000_000]).all()
    assert np.isnan(few).sum() == 1
    for slow in (time_ns, samples), (time_ns[:1], samples[:1]):
        assert extremes(*slow, 100.0)[1].size == slow[1].size  # nothing to be spared


def test_a_truck_is_moved_once_a_second(live: Live) -> None:
    for number in range(25):  # a fix and a look every eighth of a second
        live.hears("vehicle", "gnss", fix(number))
        live.picture.flush()
        live.clock[0] += 0.125
    places = [c for c in live.drawn() if c.entity_path == "/map/position/truck-1"]
    looks = [chunk.to_record_batch().num_rows for chunk in places if not chunk.is_static]
    assert looks == [1, 8, 8, 8]


def test_a_drive_is_drawn_with_bounded_rates(live: Live) -> None:
    drives(live, 5)
    chunks = live.drawn()
    drawn = rows(chunks, "vehicle/truck-1/acceleration/unsprung_rear")
    assert drawn.num_rows <= 2 * 5 / PERIOD_S
    assert max(values(drawn, "Scalars:scalars")) == 9.0
    assert rows(chunks, "map/position/truck-1").num_rows == 50
    assert rows(chunks, "map/track/truck-1").num_rows == 1
    # The plan of the bridge that it is near, which nobody had to name.
    along = [x for (x, _) in values(rows(chunks, "plan/bridge-1/truck/truck-1"), "positions")]
    assert len(along) == 50
    assert np.all(np.diff(along) > 0.0)
    # Its name is above the track, as the bridge is below.
    names = values(rows(chunks, "plan/bridge-1/truck/truck-1/name"), "positions")
    truck = values(rows(chunks, "plan/bridge-1/truck/truck-1"), "positions")
    assert all(name[1] < dot[1] - 3.0 for name, dot in zip(names, truck, strict=True))


def test_nothing_for_all_times_but_looks(live: Live, site: Site) -> None:
    """What is static a server keeps for ever: that must not grow with crossings."""
    drives(live, 1)
    live.hears("bridge", "estimate", estimate(result(site)))
    before = {c.entity_path for c in made_static(live)}
    assert "/latest/bridge-1/strip/density" not in before
    assert not any(path.startswith(("/latest", "/newest", "/map/track")) for path in before)


def made_static(live: Live) -> list[Chunk]:
    return [chunk for chunk in live.drawn() if chunk.is_static]


def test_the_states_of_a_crossing_last_as_long_as_they_did(live: Live, site: Site) -> None:
    drives(live, 5)
    live.hears("bridge", "crossing", state(pb.DETECTED))
    live.hears("bridge", "crossing", state(pb.COMPLETE))
    live.hears("bridge", "crossing", state(pb.IDENTIFYING))
    live.clock[0] += 7.0
    live.hears("bridge", "estimate", estimate(result(site)))
    live.hears("bridge", "crossing", state(pb.DONE))
    live.clock[0] += 3.0
    chunks = live.drawn()
    lane = rows(chunks, "crossings/bridge-1/truck-1")
    output = values(lane, "StateChange:state")
    assert output == ["on the bridge", "complete", "identifying", "good"]
    newest_s = 4.95
    assert times_s(lane) == pytest.approx([0.0, 4.0, newest_s, newest_s + 7.0], abs=1e-6)
    # Time goes on, so that the last state is seen.
    assert times_s(rows(chunks, "now"))[-1] == pytest.approx(newest_s + 10.0, abs=1e-6)


def test_time_stands_still_where_nothing_is_heard(live: Live) -> None:
    drives(live, 1)
    for _ in range(200):
        live.clock[0] += 1.0
        live.picture.flush()
    assert 10.0 < times_s(rows(live.drawn(), "now"))[-1] < 30.0


def test_what_is_heard_late_is_where_it_belongs(live: Live, site: Site) -> None:
    """Of a drive of long ago, or by who begins to look later."""
    live.hears("bridge", "crossing", state(pb.DETECTED))
    live.hears("bridge", "crossing", state(pb.IDENTIFYING))
    live.hears("bridge", "estimate", estimate(result(site)))
    lane = rows(live.drawn(), "crossings/bridge-1/truck-1")
    assert times_s(lane) == pytest.approx([0.0, 4.0, 4.001], abs=1e-6)


def a_day_later(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = START_NS + 86_400_000_000_000
    monkeypatch.setattr(live.picture._time, "_wall_clock_ns", lambda: now_ns)


def test_crossing_of_a_recording_is_not_on_the_bridge_now(
    live: Live, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    a_day_later(live, monkeypatch)
    live.hears("bridge", "crossing", state(pb.DETECTED))
    live.hears("bridge", "crossing", state(pb.IDENTIFYING))
    live.hears("bridge", "estimate", estimate(result(site)))
    chunks = live.drawn()
    lane = values(rows(chunks, "crossings/bridge-1/truck-1"), "StateChange:state")
    assert lane == ["from a recording", "identifying", "good"]
    texts = values(rows(chunks, "newest/bridge-1"), "TextDocument:text")
    line = "From a recording: truck-1 crossed on 2026-09-21 14:13:20 UTC. No result yet."
    assert line in texts
    assert line not in texts[-1]


def test_driving_truck_of_a_replay_is_on_the_bridge(
    live: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    a_day_later(live, monkeypatch)
    drives(live, 2)
    live.hears("bridge", "crossing", state(pb.DETECTED))
    lane = values(rows(live.drawn(), "crossings/bridge-1/truck-1"), "StateChange:state")
    assert lane == ["on the bridge"]


def test_a_result_is_drawn_and_the_next_takes_its_place(live: Live, site: Site) -> None:
    live.hears("bridge", "estimate", estimate(result(site)))
    weak_before = "latest/bridge-1/strip/weak"
    even = results_of(site, some_crossing("b", entry=60.0), ratios=np.ones(7)).crossings[0]
    live.hears("bridge", "estimate", estimate(even))
    live.hears("bridge", "estimate", estimate(result(site)))  # an older one comes again
    chunks = live.drawn()
    assert times_s(rows(chunks, weak_before)) == [4.0]
    assert times_s(rows(chunks, "latest/bridge-1/strip/road/front")) == [4.0, 64.0]
    cleared = times_s(rows(chunks, "latest/bridge-1"))
    assert cleared == pytest.approx([4.0, 64.0], abs=1e-5)
    assert all(clear < drawn for clear, drawn in zip(cleared, (4.0, 64.0), strict=True))
    texts = values(rows(chunks, "newest/bridge-1"), "TextDocument:text")
    assert "No result yet" in texts[0]
    assert "60 % less stiff than the other elements" in texts[1]
    assert "No element differs clearly from the others" in texts[2]


def test_unresolved_elements_of_a_result_are_not_called_alike(live: Live, site: Site) -> None:
    wide = results_of(site, some_crossing("a"), ratios=np.ones(7)).crossings[0]
    content = wide.model_dump(mode="json")
    for n in (1, 7):
        content["parameters"][f"EI_{n}"] |= {"std": 0.5 * content["parameters"][f"EI_{n}"]["mean"]}
    level = {"unit": "1", "mean": 0.97, "std": 0.1, "q025": 0.8, "q50": 0.97, "q975": 1.2}
    content["derived"] |= {"ei_level": level}
    live.hears("bridge", "estimate", estimate(CrossingResult.model_validate(content)))
    text = values(rows(live.drawn(), "newest/bridge-1"), "TextDocument:text")[-1]
    assert "2 of 7 elements not resolved" in text
    assert "differs clearly" not in text


def test_rejected_crossing_names_reason_and_source_of_numbers(live: Live, site: Site) -> None:
    bad = result(site, verdict="rejected", reasons=("channel_missing",), entry=-60.0)
    live.hears("bridge", "estimate", estimate(bad))
    live.hears("bridge", "estimate", estimate(result(site)))
    again = result(site, verdict="rejected", reasons=("channel_missing",), entry=60.0)
    live.hears("bridge", "estimate", estimate(again))
    chunks = live.drawn()
    for drawn in ("density", "ratio", "road/rear"):
        assert times_s(rows(chunks, f"latest/bridge-1/strip/{drawn}")) == [4.0]
    first, _, last = values(rows(chunks, "newest/bridge-1"), "TextDocument:text")[1:]
    for text in (first, last):
        assert text.startswith("### Rejected: truck-1 → bridge-1\n")
        assert bad.reason_texts[0] in text
        assert "EI_" not in text
    assert "Below" not in first
    assert last.endswith("Below is still the crossing of 2026-09-21 14:13:20 UTC.")


def test_the_state_of_a_bridge_over_the_day(live: Live, site: Site) -> None:
    found = results_of(site, some_crossing("a"), used="a")
    for hours in range(3):
        when_ns = EXIT_NS + hours * 3_600_000_000_000
        message = bridge_to_protobuf("bridge-1", when_ns, found.bridges["bridge-1"])
        live.hears("bridge", "state", message.SerializeToString(), "bridge-1")
    chunks = live.drawn()
    assert values(rows(chunks, "fused/bridge-1/EI_4"), "scalars") == pytest.approx([0.4] * 3)
    lowest = [
        values(rows(chunks, f"fused/bridge-1/lowest/{n}"), "scalars")[0] for n in ("low", "high")
    ]
    assert lowest == pytest.approx([0.943 * 0.4, 1.06 * 0.4])


def test_an_alarm_heads_the_text_of_its_bridge_while_it_stands(live: Live, site: Site) -> None:
    live.picture.ingest(alarm())
    live.picture.ingest(alarm("elsewhere"))
    assert live.picture.is_empty  # nobody drives: an alarm of months ago is no reason for a tab
    live.hears("bridge", "estimate", estimate(result(site)))
    live.picture.ingest(alarm(by="owner"))
    live.picture.ingest(alarm())
    chunks = live.drawn()
    heads = (
        "### Alarm\n\n**Element 4 is 10 % less stiff than before 2026-08-27 "
        "(95 % interval 8 to 12 %).**"
    )
    raised = f"{heads} Raised 2026-09-20, not acknowledged.\n\n"
    texts = values(rows(chunks, "newest/bridge-1"), "TextDocument:text")
    assert "No result yet" in texts[0]
    assert [text.startswith(raised) for text in texts] == [True, True, False, True]
    assert all("60 % less stiff than the other" in text for text in texts[1:])
    assert not any("elsewhere" in chunk.entity_path for chunk in chunks)


def test_result_defines_the_elements_without_a_site_file(tmp_path: Path, site: Site) -> None:
    nominal = site.bridges[0].nominal_flexural_rigidity_nm2[0]
    prior = {"distribution": "log_normal", "location": nominal, "scale": 0.55}
    given = result(site).model_dump()
    for name, value in given["parameters"].items():
        value["prior"] = prior if name.startswith("EI_") else None
    outcome = CrossingResult.model_validate(given)
    elements = elements_of_result(outcome)
    assert elements is not None
    assert sum(elements.lengths_m) == pytest.approx(30.0)
    live = made(tmp_path / "told.rrd", None)
    live.hears("bridge", "estimate", estimate(outcome))
    drawn = rows(live.drawn(), "latest/bridge-1/strip/ratio")
    (name,) = [name for name in drawn.column_names if name.endswith("Points2D:labels")]
    assert drawn[name].to_pylist() == [
        ["1.000", "0.980", "1.010", "0.400", "1.020", "1.000", "0.990"]
    ]
    assert str(lowest_element(outcome)) == "EI_4 0.400 of nominal (95 % interval 0.377 to 0.424)"
    assert elements_of_result(result(site)) is None  # no priors in it
    assert lowest_element(result(site)) is None


def test_meaningless_interval_is_not_printed(site: Site) -> None:
    given = result(site, reasons=("no_noise_model",), verdict="suspect").model_dump()
    for value in given["parameters"].values():
        value["prior"] = {"distribution": "uniform", "location": 1.56e10, "scale": 0.2}
    assert str(lowest_element(CrossingResult.model_validate(given))) == "EI_4 0.400 of nominal"


def test_of_many_trucks_all_have_positions_and_some_accelerations(live: Live) -> None:
    for number in range(MAX_TRUCKS + 3):
        drives(live, 1, f"truck-{number}")
    paths = {chunk.entity_path for chunk in live.drawn()}
    assert sum(path.endswith("/acceleration/sprung_front") for path in paths) == MAX_TRUCKS
    assert sum(path.startswith("/map/position/") for path in paths) == MAX_TRUCKS + 3


def test_what_cannot_be_read_is_left_out(live: Live) -> None:
    for owner, stream in (
        ("vehicle", "accel"), ("vehicle", "gnss"), ("bridge", "crossing"), ("bridge", "estimate"),
        ("bridge", "state"), ("bridge", "alarm"),
    ):  # fmt: skip
        live.hears(owner, stream, b"\xff\x00nonsense")
    assert live.picture.is_empty


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["--listen", "localhost"], "--listen localhost: is not an IPv4 address"),
        (["--realm", "monday"], "realm 'monday' must be live"),
        (["--site", "missing.toml"], "missing.toml"),
        (["--endpoint", "nowhere"], "endpoint 'nowhere'"),
        (["--port", "70000"], "it must be a port"),
    ],
)
def test_bad_options_are_one_line(
    arguments: list[str], output: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["view", "live", "--serve", *arguments]) == 2
    err = capsys.readouterr().err
    assert output in err
    assert err.count("\n") == 1


def test_a_port_that_is_taken_is_not_shared(tmp_path: Path) -> None:
    """Rerun would take the other's server for its own, and show it."""
    import socket

    with socket.socket() as other:
        port = free_port()
        other.bind(("127.0.0.1", port))
        other.listen()
        asked = ViewSettings(target="live", endpoint="tcp/127.0.0.1:1", serve=True, port=port)
        with pytest.raises(FailureError, match=f"port {port}: .*; give another --port"):
            live_command(asked, print)


def test_the_name_of_a_state_of_three_seconds_fits_into_its_lane() -> None:
    root: Any = live_blueprint({"truck-1": {"sprung_front"}}, ["bridge-1"], []).root_container
    left = root.contents[0]
    window = left.contents[-1].properties["TimeAxis"].view_range.as_arrow_array().to_pylist()[0]
    shown_s = (window["end"] - window["start"]) / 1e9
    width = 1400 * root.column_shares[0] / sum(root.column_shares)
    assert width * 3.0 / shown_s > 85.0  # "on the bridge" in pixels
