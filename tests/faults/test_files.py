"""The logger's files on a disk that is slow, full, or fails: nothing is dropped without a count."""

import random
import resource
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from schemas.events import EventKind, decode_event
from schemas.proto import driveby_pb2 as pb
from schemas.signals import (
    CHANNELS,
    AccelBatch,
    AccelChannel,
    GnssFix,
    VehicleInfo,
    encode_accel,
    encode_gnss,
    encode_info,
)
from schemas.topics import Key, Message
from services.common.disk import DISK, Disk
from services.common.errors import FailureError, InputError
from services.logger import file_layout, open_files
from services.logger import run as logger
from services.logger import writer as writer_module
from services.logger.backlog import QUEUE_BYTES, Backlog
from services.logger.file_layout import RecordingTarget
from services.logger.open_files import RotationLimits
from services.logger.settings import LoggerSettings
from services.logger.writer import FileWriter
from services.recordings.recording import is_closed, read_info, read_messages
from services.recordings.recovery import recover_recording
from tests.waiting import LONGEST_S, until

NOW_NS = 1_700_000_000_000_000_000


def place(folder: Path, file: Path | None = None) -> RecordingTarget:
    return RecordingTarget(folder, file, None, None)


def fixes(number: int, vehicle: str = "truck-1", *, first: int = 0) -> Iterator[Message]:
    where = Key("live", "vehicle", vehicle, "gnss")
    rng = random.Random(vehicle)
    for n in range(first, first + number):
        fix = GnssFix(1, n, 0, NOW_NS + n, 50.0 + rng.random(), rng.random(), 100.0, 10.0)
        yield Message(where, encode_gnss(fix), 1, n, NOW_NS + n, NOW_NS)


def info(vehicle: str) -> Message:
    payload = encode_info(VehicleInfo(1, 0, 0, NOW_NS, vehicle, '[vehicle]\nid = "x"\n'))
    return Message(Key("live", "vehicle", vehicle, "info"), payload, 1, 0, NOW_NS, NOW_NS)


def data_of(paths: Iterable[Path]) -> list[Message]:
    """Of trucks; a file that was full before its first message has none."""
    some = [path for path in paths if read_info(path).messages]
    return [m for path in some for m in read_messages(path) if m.key.owner == "vehicle"]


def events_of(path: Path) -> list[EventKind]:
    return [decode_event(m.payload).kind for m in read_messages(path) if m.key.stream == "event"]


class Faulty:
    """A file whose disk fails on request: the lowest place where that can happen."""

    def __init__(self, path: Path, write: Callable[[BinaryIO, memoryview], int]) -> None:
        self._file = path.open("xb", buffering=0)
        self._write = write
        self.truncate = self._file.truncate
        self.seek = self._file.seek
        self.fileno = self._file.fileno
        self.close = self._file.close

    def write(self, data: memoryview) -> int:
        return self._write(self._file, data)


def faulty_disk(write: Callable[[BinaryIO, memoryview], int], **others: object) -> Disk:
    return DISK._replace(create=lambda path: Faulty(path, write), **others)


def test_a_disk_that_stalls_for_10_s_loses_nothing_of_100_trucks(tmp_path: Path) -> None:
    """All that 100 trucks send in 10 s at 20 batches and 10 fixes a second, while it stalls."""
    go, stalled = threading.Event(), threading.Event()
    go.set()

    def write(file: BinaryIO, data: memoryview) -> int:
        if not go.is_set():
            stalled.set()
            go.wait(LONGEST_S)
        return file.write(data)

    rng = np.random.default_rng(1)
    channels = {name: AccelChannel(1000.0, rng.standard_normal(50)) for name in CHANNELS}
    payload = encode_accel(AccelBatch(1, 0, 5, NOW_NS, channels))
    small = next(fixes(1)).payload
    writer = FileWriter(place(tmp_path), disk=faulty_disk(write))
    trucks = [f"truck-{n}" for n in range(100)]
    streams = {
        name: [Key("live", "vehicle", truck, name) for truck in trucks]
        for name in ("accel", "gnss", "location")
    }

    def send(ticks: Iterable[int]) -> int:
        number = 0
        for tick in ticks:
            rows = [("accel", tick, payload)]
            rows += [(name, tick // 2, small) for name in ("gnss", "location")] * (tick % 2 == 0)
            for name, sequence, data in rows:
                for where in streams[name]:
                    assert writer.put(Message(where, data, 1, sequence, NOW_NS, NOW_NS))
                    number += 1
        return number

    sent = send(range(2))
    until(lambda: writer.take_figures()["files"] == 100)
    go.clear()
    sent += send(range(2, 4))
    assert stalled.wait(LONGEST_S)
    sent += send(range(4, 204))
    assert writer.take_figures()["queue"] > 39_000
    assert writer.take_figures()["queue_bytes"] < QUEUE_BYTES / 2
    go.set()
    writer.finish("done", {})
    assert (writer.dropped, writer.failure, writer.written) == (0, None, sent)
    files = sorted(tmp_path.glob("live/*/*.mcap"))
    assert len(files) == 100
    for path in files[::25]:
        assert Counter(m.key.stream for m in read_messages(path)) == {
            "accel": 204,
            "gnss": 102,
            "location": 102,
        }
    assert sum(sum(read_info(path).messages.values()) for path in files[1::25]) == 4 * 408


@pytest.mark.parametrize("limit", ["messages", "bytes"])
def test_a_longer_stall_is_counted_and_takes_no_more_memory(tmp_path: Path, limit: str) -> None:
    go = threading.Event()

    def write(file: BinaryIO, data: memoryview) -> int:
        go.wait(LONGEST_S)
        return file.write(data)

    backlog = Backlog(messages=50) if limit == "messages" else Backlog(size=30_000)
    # The first file is opened by the writer's thread, which is where it stalls.
    writer = FileWriter(place(tmp_path), disk=faulty_disk(write), backlog=backlog)
    taken = [writer.put(message) for message in fixes(500)]
    assert taken.count(True) in range(30, 60)
    assert writer.dropped == taken.count(False)
    assert not writer.has_room(100)
    assert writer.put(next(fixes(1, "truck-2")), always=True)
    go.set()
    until(lambda: writer.has_room(100))
    writer.finish("done", {"dropped": writer.dropped})
    assert len(data_of(tmp_path.glob("live/*/*.mcap"))) == taken.count(True) + 1


def test_short_writes_are_completed(tmp_path: Path) -> None:
    rng = random.Random(1)

    def write(file: BinaryIO, data: memoryview) -> int:
        return file.write(data[: rng.randrange(1, len(data) + 1)])

    writer = FileWriter(place(tmp_path, tmp_path / "a.mcap"), disk=faulty_disk(write))
    for message in fixes(500):
        writer.put(message)
    writer.finish("done", {})
    assert writer.failure is None
    assert list(read_messages(tmp_path / "a.mcap")) == list(fixes(500))


def full_disk(capacity: int) -> Disk:
    """A disk with room for so many bytes in all its files; what does not fit is cut."""
    paths: list[Path] = []

    def used() -> int:
        return sum(path.stat().st_size for path in paths)

    def write(file: BinaryIO, data: memoryview) -> int:
        room = capacity - used()
        if room <= 0:
            raise OSError(28, "No space left on device")
        return file.write(data[:room])

    def create(path: Path) -> Faulty:
        file = Faulty(path, write)
        paths.append(path)
        return file

    return DISK._replace(create=create)


def write_until_it_fails(tmp_path: Path, disk: Disk, trucks: int) -> tuple[FileWriter, int]:
    writer = FileWriter(place(tmp_path), disk=disk)
    return writer, send_until_it_fails(writer, trucks)


def send_until_it_fails(writer: FileWriter, trucks: int) -> int:
    sent = 0
    streams = [fixes(100_000, f"truck-{n}") for n in range(trucks)]
    while writer.failure is None and sent < 20_000:
        for stream in streams:
            writer.put(next(stream))
            sent += 1
        if sent % 100 == 0:
            time.sleep(0.001)
    writer.finish("done", {})
    return sent


SEEDS = (0, *(pytest.param(n, marks=pytest.mark.faults) for n in range(1, 60)))


@pytest.mark.parametrize("seed", SEEDS)
def test_disk_full_at_any_byte_is_reported_and_counted(
    tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Full at a random byte, with one to three trucks: what is not counted as lost is on disk."""
    monkeypatch.setattr(writer_module, "SYNC_PERIOD_S", 0.01)
    rng = random.Random(seed)
    trucks = rng.randrange(1, 4)
    disk = full_disk(rng.randrange(20_000, 200_000))
    writer, sent = write_until_it_fails(tmp_path, disk, trucks)
    assert writer.failure == "recording stopped: No space left on device"
    assert writer.dropped > 0
    assert writer.written + writer.dropped == sent
    found = data_of(sorted(tmp_path.glob("live/*/*.mcap")))
    assert len(found) == len(set(found)) == writer.written
    durable = writer.durable()[1]["live"]
    assert sum(stream.count for stream in durable.streams) == writer.written
    for stream in durable.streams:
        mine = [m.sequence for m in found if m.key.identifier == stream.identifier]
        assert mine == list(range(stream.count))
        assert stream.sequence == stream.count - 1
    assert [m for m in writer.unpublished if m.key.stream == "event"]
    for path in tmp_path.glob("live/*/*.mcap"):
        if is_closed(path):
            end = read_info(path).end
            assert end is not None
            assert end["reason"] == writer.failure
            assert EventKind.WRITE_ERROR in events_of(path)
        else:
            recovery = recover_recording(path, tmp_path / "r.mcap", force=True)
            assert recovery.damaged_bytes == 0  # what was torn has been cut off


def test_where_one_file_fails_the_others_keep_what_they_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing was synced before; closing the file of the other truck makes all of it safe."""
    monkeypatch.setattr(writer_module, "SYNC_PERIOD_S", LONGEST_S)

    def create(path: Path) -> Faulty:
        def write(file: BinaryIO, data: memoryview) -> int:
            if "truck-0" in str(path) and file.tell() > 20_000:
                raise OSError(5, "Input/output error")
            return file.write(data)

        return Faulty(path, write)

    writer, sent = write_until_it_fails(tmp_path, DISK._replace(create=create), 2)
    assert writer.failure == "recording stopped: Input/output error"
    assert writer.written + writer.dropped == sent
    safe = data_of(tmp_path.glob("live/*/truck-1-*.mcap"))
    assert len(safe) > 10
    [claimed] = [s for s in writer.durable()[1]["live"].streams if s.identifier == "truck-1"]
    assert claimed.count == len(safe)


@pytest.mark.parametrize("call", [3, 4, 9])
def test_a_failing_fsync_ends_the_recording_and_claims_nothing(
    tmp_path: Path, call: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After it nobody knows what is on the disk: what was not synced before is counted as lost."""
    monkeypatch.setattr(writer_module, "SYNC_PERIOD_S", 0.01)
    calls = 0
    safe: list[int] = []

    def sync(descriptor: int) -> None:
        nonlocal calls
        calls += 1
        if calls == call:
            safe.append(sum(stream.count for stream in durable_streams()))
            raise OSError(5, "Input/output error")
        DISK.sync(descriptor)

    def durable_streams() -> list[pb.DurableStream]:
        return [stream for output in writer.durable()[1].values() for stream in output.streams]

    writer = FileWriter(place(tmp_path), disk=DISK._replace(sync=sync))
    sent = send_until_it_fails(writer, 1)
    assert writer.failure == "recording stopped: Input/output error"
    assert writer.written + writer.dropped == sent
    assert sum(stream.count for stream in durable_streams()) == writer.written == safe[0]
    [path] = tmp_path.glob("live/*/*.mcap")
    assert len(data_of([path])) >= writer.written


def test_a_real_disk_that_is_full(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "driveby-test", str(disk)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("no right to mount a small tmpfs")
    try:
        writer, sent = write_until_it_fails(disk, DISK, 2)
        assert writer.failure == "recording stopped: No space left on device"
        assert writer.written + writer.dropped == sent
        assert len(data_of(disk.glob("live/*/*.mcap"))) == writer.written > 0
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_low_space_is_reported_and_ends_recording_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "SYNC_PERIOD_S", 0.01)
    monkeypatch.setattr(writer_module, "_DISK_CHECK_S", 0.0)
    room = 900_000
    disk = DISK._replace(free_bytes=lambda folder: room)
    writer = FileWriter(place(tmp_path), RotationLimits(min_free_bytes=800_000), disk=disk)
    sent = list(fixes(20))
    for message in sent[:10]:
        writer.put(message)
    until(lambda: writer.written == 10)
    assert not writer.room.is_low
    room = 700_000
    until(lambda: writer.unpublished)
    assert writer.room.is_low
    for message in sent[10:]:
        writer.put(message)
    until(lambda: writer.written == 21)  # with the event
    room = 99_000
    until(lambda: writer.failure is not None)
    assert writer.failure == f"recording stopped: only 0 MB left on the disk of {tmp_path}"
    writer.finish("done", {})
    assert writer.dropped == 0
    [path] = tmp_path.glob("live/*/truck-1*.mcap")
    assert data_of([path]) == sent
    end = read_info(path).end
    assert end is not None
    assert end["reason"] == writer.failure
    kinds = [kind for p in tmp_path.glob("live/*/*.mcap") for kind in events_of(p)]
    assert set(kinds) == {EventKind.DISK_LOW}


def test_logger_folder_below_proc_is_no_full_disk() -> None:
    with pytest.raises(InputError, match=r"/proc/new: cannot be created, its file system stores"):
        logger._check_room(Path("/proc/new"), 1)


def test_the_logger_does_not_start_without_room(tmp_path: Path) -> None:
    with pytest.raises(FailureError, match=r"only \d+ MB left on the disk .* \(--min-free\)"):
        logger.run(
            LoggerSettings(
                listen="tcp/127.0.0.1:1",
                folder=tmp_path / "new",
                file=None,
                realms=("*",),
                site=None,
                min_free=1e12,
            )
        )
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("why", ["size", "age", "on request"])
def test_rotation_neither_loses_nor_repeats(
    tmp_path: Path, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "SYNC_PERIOD_S", 0.01)
    limits = {
        "size": RotationLimits(bytes=20_000),
        "age": RotationLimits(age_s=0.1),
        "on request": RotationLimits(),
    }[why]
    writer = FileWriter(RecordingTarget(tmp_path, None, None, lambda: "site = 1\n"), limits)
    sent: list[Message] = []
    for truck in ("truck-1", "truck-2"):
        writer.put(info(truck))
    for first in range(0, 3000, 100):
        for truck in ("truck-1", "truck-2"):
            for message in fixes(100, truck, first=first):
                writer.put(message)
                sent.append(message)
        if why == "on request" and first % 500 == 200:
            writer.rotate()
        time.sleep(0.02)
    writer.finish("done", {})
    assert (writer.dropped, writer.failure) == (0, None)
    for truck in ("truck-1", "truck-2"):
        paths = sorted(
            tmp_path.glob(f"live/*/{truck}-*.mcap"),
            key=lambda p: next(
                (m.sequence for m in read_messages(p) if m.key.stream == "gnss"), -1
            ),
        )
        assert len(paths) >= 3
        found = [m for m in data_of(paths) if m.key.stream == "gnss"]
        assert found == [m for m in sent if m.key.identifier == truck]
        for n, path in enumerate(paths):
            about = read_info(path)
            assert about.end is not None
            assert about.site_toml == "site = 1\n"
            assert [m.sequence for m in read_messages(path) if m.key.stream == "info"] == [0]
            is_last = n + 1 == len(paths)
            assert about.end["reason"] in {f"rotated: {why}"} | ({"done"} if is_last else set())
            assert about.start.get("previous") == (paths[n - 1].name if n else None)
            assert about.start.get("repeated") == ("1" if n else None)
    kinds = {m.key.stream for m in data_of(tmp_path.glob("live/*/*.mcap"))}
    assert kinds == {"info", "gnss"}


@pytest.mark.parametrize("how", ["finish", "rotate"])
def test_files_are_closed_at_the_same_time(tmp_path: Path, how: str) -> None:
    """A disk that takes its time for each is waited for once."""
    is_ending = threading.Event()
    both = threading.Barrier(2, timeout=LONGEST_S)

    def sync(descriptor: int) -> None:
        if is_ending.is_set():
            both.wait()
        DISK.sync(descriptor)

    writer = FileWriter(place(tmp_path), disk=DISK._replace(sync=sync))
    for message in (*fixes(3), *fixes(3, "truck-2")):
        assert writer.put(message)
    until(lambda: writer.written == 6)
    is_ending.set()
    if how == "rotate":
        writer.rotate()
        until(lambda: writer.take_figures()["files"] == 0 or writer.failure)
    writer.finish("done", {})
    assert (writer.failure, writer.dropped) == (None, 0)
    paths = sorted(tmp_path.glob("live/*/*.mcap"))
    assert [len(data_of([path])) for path in paths] == [3, 3]
    reason = {"finish": "done", "rotate": "rotated: on request"}[how]
    assert [(read_info(path).end or {})["reason"] for path in paths] == [reason] * 2


def test_ends_that_cannot_be_written_cost_no_other_file_its_own(tmp_path: Path) -> None:
    is_ending = threading.Event()

    def sync(descriptor: int) -> None:
        if is_ending.is_set() and "truck-2" not in str(
            Path(f"/proc/self/fd/{descriptor}").readlink()
        ):
            raise OSError(5, "Input/output error")
        DISK.sync(descriptor)

    writer = FileWriter(place(tmp_path), disk=DISK._replace(sync=sync))
    sent = [message for n in (1, 2, 3) for message in fixes(3, f"truck-{n}")]
    for message in sent:
        assert writer.put(message)
    until(lambda: writer.written == len(sent))
    is_ending.set()
    writer.finish("done", {})
    assert writer.failure == "recording stopped: Input/output error"
    assert (writer.written, writer.dropped) == (len(sent), 0)
    paths = sorted(tmp_path.glob("live/*/*.mcap"))
    assert data_of(paths) == sent
    assert is_closed(paths[1])
    assert (read_info(paths[1]).end or {})["reason"] == "done"


def test_more_trucks_in_a_day_than_files_can_be_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(file_layout, "_SHORTEST_QUIET_S", 0.0)
    monkeypatch.setattr(file_layout, "MAX_OPEN_FILES", 5)
    writer = FileWriter(place(tmp_path))
    for n in range(12):
        writer.put(next(fixes(1, f"truck-{n}")))
    assert writer.put(next(fixes(1, "truck-0", first=1)))  # it comes back
    writer.finish("done", {})
    assert writer.dropped == 0
    assert len(data_of(tmp_path.glob("live/*/*.mcap"))) == 13
    assert len(list(tmp_path.glob("live/*/truck-0-*.mcap"))) == 2


def test_a_truck_that_is_quiet_gets_a_new_file_when_it_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer_module, "SYNC_PERIOD_S", 0.01)
    monkeypatch.setattr(open_files, "QUIET_S", 0.2)
    writer = FileWriter(place(tmp_path))
    writer.put(info("truck-1"))
    writer.put(next(fixes(1)))
    until(lambda: writer.written == 2 and writer.take_figures()["files"] == 0)
    writer.put(next(fixes(1, first=1)))
    writer.finish("done", {})
    paths = list(tmp_path.glob("live/*/*.mcap"))
    assert len(paths) == 2
    reasons = {(read_info(path).end or {})["reason"] for path in paths}
    assert reasons == {"the truck is quiet", "done"}
    assert all("info" in {m.key.stream for m in read_messages(path)} for path in paths)


def test_the_size_of_files_is_limited_by_the_system(tmp_path: Path) -> None:
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, limit[1]))
    try:
        writer, sent = write_until_it_fails(tmp_path, DISK, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert writer.failure == "recording stopped: File too large"
    assert writer.written + writer.dropped == sent
    assert len(data_of(tmp_path.glob("live/*/*.mcap"))) == writer.written
