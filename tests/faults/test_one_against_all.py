"""What one truck with a certificate can do to the others: nothing."""

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from schemas.events import EventKind, decode_event
from schemas.signals import GnssFix, Identity, encode_gnss
from schemas.topics import Key, Message
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.logger.drops import Drop
from services.logger.file_layout import MAX_FILES_OF_ONE, RecordingTarget
from services.logger.rate_limited_log import RateLimitedLog
from services.logger.writer import FileWriter
from services.recordings.recording import read_messages
from tests.waiting import LONGEST_S

NOW_NS = 1_700_000_000_000_000_000


def payload(boot_id: int, sequence: int) -> bytes:
    return encode_gnss(GnssFix(boot_id, sequence, sequence, time.time_ns(), 50.0, 8.0, 100.0, 10.0))


def fix(vehicle: str, realm: str, sequence: int) -> Message:
    where = Key(realm, "vehicle", vehicle, "gnss")
    return Message(where, payload(1, sequence), 1, sequence, NOW_NS, NOW_NS)


def test_files_of_one_vehicle_in_many_realms_leave_room_for_the_others(tmp_path: Path) -> None:
    """A message without a file is reported with its cause, and may come again."""
    writer = FileWriter(RecordingTarget(tmp_path, None, None, None))
    for number in range(300):
        for sequence in range(3):
            writer.put(fix("truck-evil", f"sim-{number}", sequence))
    for number in range(100):
        writer.put(fix(f"truck-{number}", "live", 0))
    writer.finish("done", {})
    assert len(list(tmp_path.glob("live/*/*.mcap"))) == 100
    assert len(list(tmp_path.glob("sim-*/*/*.mcap"))) == MAX_FILES_OF_ONE
    dropped = 3 * (300 - MAX_FILES_OF_ONE)
    assert writer.dropped == dropped
    [drop] = writer.drops()
    why = "had no file: 4 files of this vehicle are open, one for each realm"
    assert drop[1:] == ("truck-evil", why, dropped)
    unwritten = {name: numbers.size for one in writer.unwritten for name, numbers in one.items()}
    assert len(unwritten) == 300 - MAX_FILES_OF_ONE
    assert set(unwritten.values()) == {3}
    assert writer.drops() == []


def test_too_many_vehicles_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.logger.file_layout.MAX_OPEN_FILES", 5)
    writer = FileWriter(RecordingTarget(tmp_path, None, None, None))
    for number in range(6):
        writer.put(fix(f"truck-{number}", "live", 0))
    writer.finish("done", {})
    why = "had no file: 5 files of all vehicles are open"
    assert writer.drops() == [Drop("live", "truck-5", why, 1)]


@pytest.mark.process
def test_a_truck_in_300_realms_costs_another_one_nothing(fleet: Callable[..., Any]) -> None:
    """889 of 1,669 messages of others were lost, because 256 files were open, without a report."""
    one = fleet()
    one.start_logger()
    with open_session(connect=one.logger_endpoint, timeout_s=LONGEST_S) as session:
        publishers = [Publisher(session, f"sim-{number}") for number in range(300)]
        for sequence in range(3):
            for publisher in publishers:
                identity = Identity(publisher.boot_id, sequence)
                publisher.put("vehicle", "truck-evil", "gnss", payload(*identity), identity)
        truck = one.start_truck("truck-1", rate=100.0)
        truck.wait_for(60)
        truck.stop()
        truck.wait()
        for publisher in publishers:
            publisher.close()
    one.logger.terminate()
    assert one.logger.wait(timeout=LONGEST_S) == 1  # something was dropped, and is reported
    numbers, twice = one.recorded()
    assert twice == 0
    for (vehicle, _, _), found in numbers.items():
        assert found == set(range(len(found))), vehicle
    [boot_id] = truck.output
    assert len(numbers[("truck-1", "accel", boot_id)]) == truck.output[boot_id] + 1
    events = [
        decode_event(message.payload)
        for path in (one.folder / "recordings").glob("*/*/*.mcap")
        for message in read_messages(path)
        if message.key.stream == "event"
    ]
    assert not [event for event in events if event.kind == EventKind.QUEUE_FULL]
    causes = {event.kind for event in events if event.vehicle == "truck-evil"}
    assert causes >= {EventKind.DROPPED, EventKind.REFUSED}
    assert {event.vehicle for event in events} <= {"truck-evil", ""}


def test_warnings_of_a_kind_are_counted_rather_than_repeated(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("services.logger.rate_limited_log.time.monotonic", lambda: now[0])
    complaints = RateLimitedLog(logging.getLogger("test"))
    for number in range(5113):
        complaints.warn("spool", "number %d", number)
    complaints.warn("other", "another kind")
    complaints.flush()
    assert [record.getMessage() for record in caplog.records] == [
        *(f"number {n}" for n in range(5)),
        "another kind",
    ]
    now[0] = 60.0
    caplog.clear()
    complaints.flush()
    complaints.warn("spool", "again")
    assert [record.getMessage() for record in caplog.records] == [
        "spool: 5108 more warnings of this kind in 60 s",
        "again",
    ]
