"""What the logger lets in, what it reports, and how it writes."""

import contextlib
import threading
from pathlib import Path

import pytest

from schemas.events import EventKind, decode_event
from schemas.signals import GnssFix, encode_gnss, encode_identity
from schemas.topics import Key, Message
from services.bus.subscription import RawSample
from services.catalogue.index import read_catalog, update_catalog
from services.common.disk import DISK
from services.common.errors import InputError
from services.common.stores import folder_at
from services.logger import run as logger
from services.logger.backlog import Backlog
from services.logger.file_layout import RecordingTarget
from services.logger.intake import GAP_PATIENCE_S, Intake
from services.logger.settings import LoggerSettings
from services.logger.writer import FileWriter
from services.recordings.recording import read_info, read_messages
from services.recordings.writer import RecordingWriter
from tests.waiting import LONGEST_S, until

NOW_NS = 1_700_000_000_000_000_000
KEY = "driveby/v1/live/vehicle/truck-1/gnss"


def fix(sequence: int, boot_id: int = 1, **fields: float) -> bytes:
    good = GnssFix(boot_id, sequence, 0, NOW_NS + sequence, 50.0, 8.0, 100.0, 10.0)
    return encode_gnss(good._replace(**fields))


def received(
    sequence: int, *, key: str = KEY, payload: bytes | None = None, boot_id: int = 1
) -> RawSample:
    attachment = encode_identity(boot_id, sequence)
    return RawSample(key, payload or fix(sequence, boot_id), attachment, False)


def make_intake() -> Intake:
    return Intake("live", "logger", 99)


def at(now_s: float) -> tuple[int, float]:
    """Wall clock and monotonic clock, in step."""
    return NOW_NS + round(now_s * 1e9), now_s


def test_a_good_message_is_written_as_it_came() -> None:
    intake = make_intake()
    payload = fix(7)
    message = intake.accept(received(7, payload=payload), NOW_NS + 5)
    where = Key("live", "vehicle", "truck-1", "gnss")
    assert message == Message(where, payload, 1, 7, NOW_NS + 7, NOW_NS + 5)
    assert intake.report(*at(0.0)) == []


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (received(0, key="driveby/v1/live/vehicle/truck-1/speed"), "no topic"),
        (received(0, key="driveby/v1/live/vehicle/../../etc/gnss"), "is not driveby/v1"),
        (received(0, key="driveby/v1/live/vehicle/" + "a" * 10_000 + "/gnss"), "characters"),
        (received(0)._replace(attachment=None), "no attachment"),
        (received(0)._replace(attachment=b"short"), "attachment of 5 bytes"),
        (received(0, payload=b"\xff"), "not a driveby.v1.GnssFix"),
        (received(0, payload=b"\x00" * 5000), "at most 4096"),
        (received(0, key=KEY.replace("gnss", "accel")), "accel"),
    ],
)
def test_bad_messages_are_refused_counted_and_reported(bad: RawSample, reason: str) -> None:
    intake = make_intake()
    assert intake.accept(bad, NOW_NS) is None
    assert intake.accept(bad, NOW_NS) is None
    assert intake.counts["refused"] == 2
    [(where, event)] = intake.report(*at(0.0))
    assert where.realm == "live"
    assert (event.kind, event.messages) == (EventKind.REFUSED, 2)
    assert reason in event.text
    assert intake.report(*at(1.0)) == []


def test_identity_detects_duplicates() -> None:
    intake = make_intake()
    other_realm = KEY.replace("live", "sim-a")
    same = [received(0), received(0)._replace(recovered=True), received(0)]
    assert [intake.accept(one, NOW_NS) is not None for one in same] == [True, False, False]
    assert intake.counts["duplicates"] == 2
    for different in (
        received(1),
        received(0, boot_id=2),
        received(0, key=other_realm),
        received(0, key=KEY.replace("truck-1", "truck-2")),
    ):
        assert intake.accept(different, NOW_NS) is not None


def test_a_gap_is_reported_when_it_lasts_and_its_end_too() -> None:
    intake = make_intake()
    for sequence in (10, 11, 15, 16):
        intake.accept(received(sequence), NOW_NS)
    assert intake.report(*at(0.0)) == []
    assert intake.report(*at(GAP_PATIENCE_S - 0.1)) == []
    [(where, gap)] = intake.report(*at(GAP_PATIENCE_S))
    assert where == Key("live", "vehicle", "truck-1", "gnss")
    assert gap.kind == EventKind.GAP
    assert (gap.first_sequence, gap.last_sequence, gap.messages) == (12, 14, 3)
    assert (gap.vehicle, gap.stream, gap.boot_id) == ("truck-1", "gnss", 1)
    assert intake.report(*at(100.0)) == []
    for sequence in (12, 13, 14):
        assert intake.accept(received(sequence), NOW_NS) is not None
    [(_, recovered)] = intake.report(*at(101.0))
    assert (recovered.kind, recovered.messages) == (EventKind.RECOVERED, 3)


def test_a_gap_at_the_end_is_reported_before_the_file_is_closed() -> None:
    intake = make_intake()
    intake.accept(received(0), NOW_NS)
    intake.accept(received(2), NOW_NS)
    [(_, gap)] = intake.report(*at(0.0), closing=True)
    assert gap.kind == EventKind.GAP


def test_what_the_logger_says_itself_is_not_taken_twice() -> None:
    intake = make_intake()
    own = received(0, key="driveby/v1/live/service/logger/event", boot_id=99)
    assert intake.accept(own, NOW_NS) is None
    assert sum(intake.counts.values()) == 0


def place(folder: Path, file: Path | None = None) -> RecordingTarget:
    return RecordingTarget(folder, file, None, lambda: "site = 1\n")


def messages(number: int, vehicle: str = "truck-1") -> list[Message]:
    where = Key("live", "vehicle", vehicle, "gnss")
    return [Message(where, fix(n), 1, n, NOW_NS + n, NOW_NS) for n in range(number)]


def test_durable_speaks_only_of_what_was_synced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    syncing, go = threading.Event(), threading.Event()
    real = RecordingWriter.sync

    def slow(self: RecordingWriter) -> None:
        syncing.set()
        go.wait(LONGEST_S)
        real(self)

    writer = FileWriter(place(tmp_path, tmp_path / "a.mcap"))
    monkeypatch.setattr(RecordingWriter, "sync", slow)
    sent = messages(5)
    for message in (sent[0], sent[1], sent[3]):
        assert writer.put(message)
    assert syncing.wait(LONGEST_S)
    assert writer.durable() == (0, {})
    go.set()
    until(lambda: writer.durable_version() == 1)
    [stream] = writer.durable()[1]["live"].streams
    assert (stream.owner, stream.identifier, stream.stream) == ("vehicle", "truck-1", "gnss")
    assert (stream.boot_id, stream.sequence, stream.count) == (1, 1, 3)
    writer.finish("done", {"lost": 1})
    info = read_info(tmp_path / "a.mcap")
    assert info.end is not None
    assert (info.end["reason"], info.end["lost"]) == ("done", "1")


def test_durable_without_the_first_message_has_no_sequence(tmp_path: Path) -> None:
    writer = FileWriter(place(tmp_path, tmp_path / "a.mcap"))
    writer.put(messages(5)[4])
    writer.finish("done", {})
    [stream] = writer.durable()[1]["live"].streams
    assert not stream.HasField("sequence")
    assert stream.count == 1


def test_files_by_realm_date_and_vehicle(tmp_path: Path) -> None:
    writer = FileWriter(place(tmp_path))
    for message in messages(3) + messages(2, "truck-2"):
        writer.put(message)
    writer.finish("done", {})
    files = sorted(tmp_path.glob("live/*/*.mcap"))
    assert [file.name.rsplit("-", 1)[0] for file in files] == ["truck-1", "truck-2"]
    assert [len(list(read_messages(file))) for file in files] == [3, 2]
    assert all(read_info(file).site_toml == "site = 1\n" for file in files)
    assert [read_info(file).about["vehicle"] for file in files] == ["truck-1", "truck-2"]
    assert read_info(files[0]).about["realm"] == "live"


def test_a_full_queue_is_counted_and_holds_nobody_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()
    real = RecordingWriter.write

    def slow(self: RecordingWriter, message: Message) -> None:
        go.wait(LONGEST_S)
        real(self, message)

    monkeypatch.setattr(RecordingWriter, "write", slow)
    writer = FileWriter(place(tmp_path, tmp_path / "a.mcap"), backlog=Backlog(10))
    # Were one of them to wait for the writer, it would be taken in the end.
    taken = [writer.put(message) for message in messages(20)]
    assert 10 <= sum(taken) <= 11
    assert writer.dropped == 20 - sum(taken)
    go.set()
    writer.finish("done", {})
    assert len(list(read_messages(tmp_path / "a.mcap"))) == sum(taken)


def test_write_error_is_reported_and_synced_data_stay(tmp_path: Path) -> None:
    is_full = False

    def sync(descriptor: int) -> None:
        if is_full:
            raise OSError(28, "No space left on device")
        DISK.sync(descriptor)

    writer = FileWriter(place(tmp_path, tmp_path / "a.mcap"), disk=DISK._replace(sync=sync))
    sent = messages(6)
    for message in sent[:3]:
        writer.put(message)
    until(lambda: writer.durable_version() == 1)
    is_full = True
    writer.put(sent[3])
    until(lambda: writer.failure is not None)
    assert writer.failure == "recording stopped: No space left on device"
    assert not writer.put(sent[4])
    assert writer.dropped == 2
    writer.finish("done", {})
    assert list(read_messages(tmp_path / "a.mcap"))[:3] == sent[:3]
    [stream] = writer.durable()[1]["live"].streams
    assert stream.count == 3


def test_an_existing_file_is_refused_before_anything_starts(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(InputError, match="never overwritten"):
        FileWriter(place(tmp_path, tmp_path / "a.mcap"))
    assert not [thread for thread in threading.enumerate() if thread.name == "writer"]


@pytest.mark.parametrize(("drain_s", "written"), [(10.0, 50), (0.0, 0)])
def test_what_has_come_is_written_or_counted_before_the_file_is_closed(
    tmp_path: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch, drain_s: float, written: int
) -> None:
    """A backlog that only shows once the subscription is closed: the end of a busy day."""

    class Backlog:
        def __init__(self, *arguments: object) -> None:
            self.waiting: list[RawSample] = []

        def receive(self, timeout_s: float = 0.0) -> RawSample | None:
            return self.waiting.pop(0) if self.waiting else None

        def close(self) -> None:
            if first_close.is_set():
                return
            first_close.set()
            self.waiting += [received(number) for number in range(50)]

    first_close, stop = threading.Event(), threading.Event()
    stop.set()
    monkeypatch.setattr("services.logger.run.Subscription", Backlog)
    monkeypatch.setattr(
        "services.logger.run.stopped_by_signals", lambda on_second: contextlib.nullcontext(stop)
    )
    file = tmp_path / "a.mcap"
    monkeypatch.setattr("services.logger.run._DRAIN_S", drain_s)
    code = logger.run(
        LoggerSettings(listen=endpoint, folder=tmp_path, file=file, realms=("*",), site=None)
    )
    found = list(read_messages(file))
    assert [m.sequence for m in found if m.key.owner == "vehicle"] == list(range(written))
    assert code == (0 if written == 50 else 1)
    assert (read_info(file).end or {})["dropped"] == str(50 - written)
    outcome = [decode_event(m.payload) for m in found if m.key.stream == "event"]
    assert sum(e.messages for e in outcome if e.kind == EventKind.QUEUE_FULL) == 50 - written


def test_a_file_that_is_closed_has_its_row_in_the_catalogue(tmp_path: Path) -> None:
    writer = FileWriter(place(tmp_path))
    for message in messages(3) + messages(2, "truck-2"):
        assert writer.put(message)
    writer.finish("done", {})
    rows = read_catalog(folder_at(str(tmp_path))).rows
    assert sorted((row.vehicles, row.messages) for row in rows.values()) == [
        (("truck-1",), 3),
        (("truck-2",), 2),
    ]
    assert update_catalog(folder_at(str(tmp_path))) == (rows, 0, 0, (), 0, 0)
