"""Recordings that are deleted, cut or moved while the logger writes them."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from schemas.events import Event, EventKind, decode_event
from schemas.proto import driveby_pb2 as pb
from schemas.signals import GnssFix, VehicleInfo, encode_gnss, encode_info
from schemas.topics import Key, Message
from services.logger.file_layout import RecordingTarget
from services.logger.writer import FileWriter
from services.recordings.recording import read_info, read_messages
from tests.waiting import LONGEST_S, until

NOW_NS = 1_700_000_000_000_000_000


def fix(sequence: int) -> Message:
    payload = encode_gnss(GnssFix(1, sequence, 0, NOW_NS, 50.0, 8.0, 100.0, 10.0))
    return Message(Key("live", "vehicle", "truck-1", "gnss"), payload, 1, sequence, NOW_NS, NOW_NS)


def info() -> Message:
    payload = encode_info(VehicleInfo(1, 0, 0, NOW_NS, "truck-1", ""))
    return Message(Key("live", "vehicle", "truck-1", "info"), payload, 1, 0, NOW_NS, NOW_NS)


def events_of(paths: list[Path]) -> list[Event]:
    messages = [m for path in paths for m in read_messages(path)]
    return [decode_event(m.payload) for m in messages if m.key.stream == "event"]


def delete(path: Path) -> None:
    path.unlink()


def replace(path: Path) -> None:
    """As `recover -o` did."""
    other = path.with_name("other")
    other.write_bytes(bytes(10_000_000))
    other.replace(path)


def cut_short(path: Path) -> None:
    os.truncate(path, 100)


def move(path: Path) -> None:
    path.rename(path.parents[3] / "moved.mcap")


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("harm", [delete, replace, cut_short, move])
def test_what_was_in_a_file_that_is_gone_is_not_called_durable(
    tmp_path: Path, harm: Callable[[Path], None], single: bool
) -> None:
    folder = tmp_path / "recordings"
    file = folder / "live" / "day" / "all.mcap" if single else None
    writer = FileWriter(RecordingTarget(folder, file, None, None))

    def durable(stream: str = "gnss") -> Any:
        streams = writer.durable()[1].get("live", pb.Durable()).streams
        return next((one for one in streams if one.stream == stream), None)

    for message in (info(), *(fix(n) for n in range(100))):
        writer.put(message)
    until(lambda: writer.written == 101)
    [path] = folder.glob("live/*/*.mcap")
    harm(path)
    until(lambda: writer.unpublished)
    for sequence in range(100, 150):
        writer.put(fix(sequence))
    until(lambda: (found := durable()) and found.count in (50, 150))
    found = durable()
    writer.finish("done", {})
    assert writer.failure is None
    assert found is not None
    [published] = [decode_event(message.payload) for message in writer.unpublished]
    assert published.kind == EventKind.RECORDING_GONE
    ours = [p for p in folder.glob("live/*/*.mcap") if p.read_bytes()[:5] == b"\x89MCAP"]
    if harm is move:
        assert f"{path.name} was moved by another process" in published.text
        assert (found.count, found.sequence) == (150, 149)
        moved = tmp_path / "moved.mcap"
        assert (read_info(moved).end or {})["reason"] == "moved"
        ours.append(moved)
    else:
        assert published.messages == 100
        assert "100 messages lost, 100 of them confirmed as durable" in published.text
        assert found.count == 50
        assert not found.HasField("sequence")
        [gone] = writer.withdrawn
        assert gone[(fix(0).key, 1)].ranges() == [(0, 99)]
        if harm is cut_short:
            ours.remove(path)
    on_disk = {m.sequence for p in ours for m in read_messages(p) if m.key.stream == "gnss"}
    assert on_disk == set(range(150) if harm is move else range(100, 150))
    # What is latched stands at the beginning of the next file, and is durable.
    [last] = [p for p in ours if "the file before it" in read_info(p).start["reason"]]
    assert next(iter(read_messages(last))) == info()
    assert [event.kind for event in events_of([last])] == [EventKind.RECORDING_GONE]
    assert (kept := durable("info")) is not None
    assert kept.sequence == 0


@pytest.mark.process
def test_a_live_recording_that_is_deleted_comes_again_from_the_trucks(
    fleet: Callable[..., Any],
) -> None:
    """Trucks keep for a while what `durable` had reported to be on the disk."""
    one = fleet()
    one.start_logger()
    truck = one.start_truck(rate=50.0)
    truck.wait_for(200)
    [path] = (one.folder / "recordings").glob("live/*/truck-1-*.mcap")
    path.unlink()
    truck.wait_for(250)
    assert one.finish() == 0
    [event] = [
        event
        for event in events_of(sorted((one.folder / "recordings").glob("live/*/*.mcap")))
        if event.kind == EventKind.RECORDING_GONE
    ]
    assert event.messages > 200
    assert event.vehicle == "truck-1"


@pytest.mark.process
def test_a_deleted_recording_of_a_truck_that_has_gone_is_a_failure(
    fleet: Callable[..., Any],
) -> None:
    one = fleet()
    one.start_logger()
    truck = one.start_truck()
    truck.wait_for(20)
    truck.stop()
    truck.wait()
    [path] = (one.folder / "recordings").glob("live/*/truck-1-*.mcap")
    path.unlink()
    assert one.logger is not None
    one.logger.terminate()
    assert one.logger.wait(timeout=LONGEST_S) == 1, one.logs()
    assert "was deleted by another process while it was being written" in one.logs()
