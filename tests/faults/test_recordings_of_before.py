"""What the logger does with recordings that it finds: recovers, deletes, leaves alone."""

import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from schemas.events import Event, EventKind
from schemas.proto import driveby_pb2 as pb
from schemas.signals import GnssFix, encode_gnss
from schemas.topics import Key, Message
from services.catalogue.deletions import noted_deletions
from services.catalogue.index import catalog_closed
from services.common.child_process import ChildOutput, run_gently
from services.common.disk import DISK
from services.common.stores import folder_at
from services.ledger.processed import is_processed
from services.logger import housekeeping
from services.logger.file_layout import RecordingTarget
from services.logger.housekeeping import Housekeeping, RetentionPolicy
from services.logger.writer import FileWriter
from services.recordings.recording import is_closed, read_info, read_messages, read_site
from services.recordings.recovery import put_aside, recover_recording, recovered_path
from services.recordings.writer import RecordingOrigin, RecordingWriter, write_recording
from tests.waiting import LONGEST_S, until

SAMPLE = Path(__file__).parents[2] / "recordings" / "sample" / "crossing.mcap"
NOW_NS = 1_700_000_000_000_000_000
DAY = "2026-01-01"


def fixes(number: int, vehicle: str = "truck-1", realm: str = "live") -> Iterator[Message]:
    where = Key(realm, "vehicle", vehicle, "gnss")
    for n in range(number):
        fix = GnssFix(1, n, 0, NOW_NS + n * 10**8, 10.0, 8.0, 100.0, 10.0)
        yield Message(where, encode_gnss(fix), 1, n, NOW_NS + n * 10**8, NOW_NS)


def crashed(path: Path, number: int = 50, *, every: int = 10) -> list[Message]:
    """Leave a recording as a writer does that dies: synced, without an end, torn."""
    writer = RecordingWriter(path, reason="test", origin=RecordingOrigin("live", "truck-1"))
    messages = list(fixes(number))
    for n, message in enumerate(messages):
        writer.write(message)
        if n % every == every - 1:
            writer.sync()
    writer.abandon()
    with path.open("ab") as file:
        file.write(b"\x06\x00\x10\x00\x00")
    return messages


def kept(
    folder: Path, *, budget_bytes: int | None = None, min_free_bytes: int = 0
) -> list[tuple[str, Event]]:
    """Keep house until it is idle; return what was reported."""
    reported: list[tuple[str, Event]] = []

    def report(realm: str, event: Event) -> None:
        reported.append((realm, event))

    house = RetentionPolicy(folder, ["*"], min_free_bytes, budget_bytes, report)
    keeper = Housekeeping(house)
    until(lambda: not keeper.is_busy, "the end of the housekeeping")
    keeper.close()
    return reported


def test_what_crashed_is_recovered_and_set_aside(tmp_path: Path) -> None:
    day = tmp_path / "live" / DAY
    path = day / "truck-1-20260101T000000Z.mcap"
    messages = crashed(path)
    content = path.read_bytes()
    write_recording(day / "whole.mcap", fixes(3), site_toml=None, reason="test")
    elsewhere = tmp_path / "mine" / "notes.mcap"
    elsewhere.parent.mkdir()
    elsewhere.write_bytes(content)
    (day / "truck-2-20260101T000000Z.mcap").write_bytes(b"")
    living = RecordingWriter(day / "truck-3.mcap", reason="test")
    reported = kept(tmp_path)
    living.abandon()
    assert sorted(p.name for p in day.iterdir()) == [
        "truck-1-20260101T000000Z.mcap.crashed",
        "truck-1-20260101T000000Z.recovered.mcap",
        "truck-2-20260101T000000Z.mcap.crashed",
        "truck-3.mcap",
        "whole.mcap",
    ]
    assert (day / "truck-1-20260101T000000Z.mcap.crashed").read_bytes() == content
    recovered = day / "truck-1-20260101T000000Z.recovered.mcap"
    assert [m for m in read_messages(recovered) if m.key.owner == "vehicle"] == messages
    assert is_closed(recovered)
    assert elsewhere.read_bytes() == content
    assert [(realm, event.kind, event.messages) for realm, event in reported] == [
        ("live", EventKind.RECORDING_RECOVERED, 50),
        ("live", EventKind.RECORDING_RECOVERED, 0),
    ]
    assert "50 messages recovered" in reported[0][1].text
    assert "holds nothing" in reported[1][1].text
    assert kept(tmp_path)[0][1].text.startswith("truck-3.mcap")  # whose writer is gone now


@pytest.mark.parametrize("name", ["truck-1", "_service"])
def test_what_a_killed_recovery_left_is_removed(tmp_path: Path, name: str) -> None:
    """The next logger recovers the recording again, also the one of services."""
    day = tmp_path / "live" / DAY
    path = day / f"{name}-20260101T000000Z.mcap"
    crashed(path)
    (day / f".{path.stem}.recovered.0123abcd.part.mcap").write_bytes(b"half")
    others = [f".{path.stem}-2.recovered.0123abcd.part.mcap", f".{path.stem}.0123abcd.part.json"]
    for other in others:
        (day / other).write_bytes(b"half")
    [(_, event)] = kept(tmp_path)
    assert event.kind == EventKind.RECORDING_RECOVERED
    recovered = [f"{path.stem}.recovered.mcap", f"{path.name}.crashed"]
    assert sorted(p.name for p in day.iterdir()) == sorted([*others, *recovered])


def test_no_room_to_recover_is_reported_and_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "live" / DAY / "truck-1.mcap"
    crashed(path)
    [(_, event)] = kept(tmp_path, min_free_bytes=DISK.free_bytes(tmp_path) * 2)
    assert event.kind == EventKind.DISK_LOW
    assert [p.name for p in path.parent.iterdir()] == ["truck-1.mcap"]


def test_the_name_of_what_was_set_aside_is_not_used_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or the next crash in the same second, by a clock that was set back, would replace it."""
    taken: list[str] = []

    def is_taken(path: Path) -> bool:
        taken.append(path.name)
        return len(taken) < 3

    monkeypatch.setattr("services.logger.file_layout.is_name_taken", is_taken)
    writer = FileWriter(RecordingTarget(tmp_path, None, None, None))
    writer.put(next(fixes(1)))
    writer.finish("done", {})
    [path] = tmp_path.glob("live/*/*.mcap")
    assert path.name == taken[2]
    assert path.name.endswith("Z-3.mcap")
    monkeypatch.undo()
    from services.recordings.recovery import is_name_taken

    for name in ("a.mcap", "a.recovered.mcap", "a.mcap.crashed"):
        assert not is_name_taken(tmp_path / "a.mcap")
        (tmp_path / name).touch()
        assert is_name_taken(tmp_path / "a.mcap")
        (tmp_path / name).unlink()


def crossing(state: int, recording: Path, **changes: object) -> Message:
    """Return what a worker says of the sample's crossing."""
    info = read_info(recording)
    message = pb.Crossing(
        schema_version=1,
        crossing_id="x",
        vehicle="truck-1",
        bridge="bridge-1",
        state=state,  # type: ignore[arg-type]
        time_ns=info.last_time_ns,
        entry_time_ns=info.first_time_ns + 2 * 10**9,
        exit_time_ns=info.last_time_ns - 2 * 10**9,
    )
    for name, value in changes.items():
        setattr(message, name, value)
    where = Key("sim-drive", "bridge", "bridge-1", "crossing")
    return Message(where, message.SerializeToString(), 5, 0, message.time_ns, message.time_ns)


@pytest.mark.parametrize(
    ("state", "changes", "processed"),
    [
        (pb.DONE, {}, True),
        (pb.IDENTIFYING, {}, False),
        (pb.DONE, {"bridge": "bridge-2"}, False),
        (pb.DONE, {"vehicle": "truck-2"}, False),
        (pb.DONE, {"entry_time_ns": 1, "exit_time_ns": 2}, False),
    ],
)
def test_only_an_identified_crossing_is_processed(
    tmp_path: Path, state: int, changes: dict[str, object], processed: bool
) -> None:
    site = read_site(SAMPLE)
    assert site is not None
    assert 'id = "bridge-1"' in site
    results = tmp_path / "results.mcap"
    write_recording(results, [crossing(state, SAMPLE, **changes)], site_toml=None, reason="test")
    assert is_processed(SAMPLE, [results]) == processed
    assert not is_processed(SAMPLE, [])


def test_what_cannot_be_known_is_not_processed(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    site = read_site(SAMPLE)
    write_recording(path, fixes(20), site_toml=site, reason="test")
    assert is_processed(path, [])  # far from every bridge
    write_recording(path, fixes(20), site_toml=None, reason="test", force=True)
    assert not is_processed(path, [])  # which bridges?
    write_recording(path, fixes(20, "truck-9"), site_toml=site, reason="test", force=True)
    assert not is_processed(path, [])  # which truck?
    path.write_bytes(b"damaged")
    assert not is_processed(path, [])


def test_a_budget_deletes_the_oldest_that_may_go_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(housekeeping, "_BUDGET_PERIOD_S", 0.05)
    site = read_site(SAMPLE)
    day = tmp_path / "sim-drive" / DAY
    day.mkdir(parents=True)
    shutil.copy(SAMPLE, day / "0-with-crossing.mcap")
    for n in range(1, 4):
        path = day / f"{n}-far-away.mcap"
        write_recording(path, fixes(3000, realm="sim-drive"), site_toml=site, reason="test")
    for n, path in enumerate(sorted(day.iterdir())):
        os.utime(path, (1e9 + n, 1e9 + n))
    (day / "9-outside.txt").write_bytes(bytes(1_000_000))
    living = RecordingWriter(day / "living.mcap", reason="test")
    sizes = {path.name: path.stat().st_size for path in day.glob("*.mcap")}
    assert kept(tmp_path, budget_bytes=sum(sizes.values())) == []
    folder, row = folder_at(str(tmp_path)), f"sim-drive/{DAY}/1-far-away.mcap"
    catalog_closed(tmp_path, day / "1-far-away.mcap")
    budget = sum(sizes.values()) - sizes["1-far-away.mcap"] - 10
    reported = kept(tmp_path, budget_bytes=budget)
    assert [event.kind for _, event in reported] == [EventKind.RECORDING_DELETED] * 2
    assert [event.text.split()[0] for _, event in reported] == [
        "1-far-away.mcap",
        "2-far-away.mcap",
    ]
    assert noted_deletions(folder, [row, "another.mcap"]) == {row}
    reported = kept(tmp_path, budget_bytes=1)
    assert "no worker has identified all crossings in them" in reported[-1][1].text
    assert [event.kind for _, event in reported] == [
        EventKind.RECORDING_DELETED,
        EventKind.DISK_LOW,
    ]
    assert sorted(p.name for p in day.iterdir()) == [
        "0-with-crossing.mcap",
        "9-outside.txt",
        "living.mcap",
    ]
    results = tmp_path / "sim-drive" / "results-1.mcap"
    write_recording(results, [crossing(pb.DONE, SAMPLE)], site_toml=None, reason="test")
    reported = kept(tmp_path, budget_bytes=1)
    assert "0-with-crossing.mcap" in reported[0][1].text
    assert results.exists()
    living.abandon()


def test_what_somebody_else_has_recovered_meanwhile_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "live" / DAY / "truck-1.mcap"
    crashed(path)

    def run(arguments: Sequence[str], closing: threading.Event) -> ChildOutput | None:
        recover_recording(path, recovered_path(path))
        put_aside(path)
        return run_gently(arguments, closing)

    monkeypatch.setattr("services.logger.housekeeping.run_gently", run)
    assert kept(tmp_path) == []
    assert caplog.records == []


def children(process: int) -> list[int]:
    tasks = Path(f"/proc/{process}/task")
    return [int(n) for one in tasks.glob("*/children") for n in one.read_text().split()]


def is_alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@pytest.mark.process
def test_killed_logger_leaves_no_recovery_process(fleet: Callable[..., Any]) -> None:
    """Its child would rename what the next logger is about to read."""
    one = fleet()
    path = one.folder / "recordings" / "live" / DAY / "truck-1-20260101T000000Z.mcap"
    crashed(path, 100_000, every=10_000)
    content = path.read_bytes()
    deadline = time.monotonic() + LONGEST_S
    one.start_logger()
    while not list(path.parent.glob(".*.part.mcap")):
        assert time.monotonic() < deadline, one.logs()
        time.sleep(0.005)
    [child] = children(one.logger.pid)
    one.kill(one.logger)
    while is_alive(child):
        assert time.monotonic() < deadline
        time.sleep(0.005)
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    assert path.read_bytes() == content
    one.start_logger()
    while not path.with_name(path.name + ".crashed").exists():
        assert time.monotonic() < deadline, one.logs()
        time.sleep(0.02)
    assert len(list(read_messages(recovered_path(path)))) > 100_000
    one.stop_logger()
    assert "ERROR" not in one.logs()
