"""Recordings that the bus would not take, that are compressed otherwise, or that unpack to more
than the machine has: one line, and done with.
"""

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap.writer import MCAP0_MAGIC

from schemas.proto import driveby_pb2 as pb
from schemas.topics import Key, Message, topic
from services.common.errors import InputError
from services.recordings import mcap_scan
from services.recordings import recording as recording_module
from services.recordings.recording import read_info, read_messages
from services.recordings.recovery import recover_recording
from services.recordings.writer import write_recording
from services.replay.run import run as replay
from services.replay.settings import ReplaySettings
from services.truck.run import run as truck
from services.truck.settings import TruckSettings

WALL_NS = 1_767_225_600_000_000_000
ACCEL = Key("sim-x", "vehicle", "truck-1", "accel")
MIB = 1 << 20


def a_batch(number: int = 0, samples: int = 10, rate_hz: float = 100.0) -> pb.AccelBatch:
    batch = pb.AccelBatch(
        schema_version=1,
        boot_id=7,
        sequence=number,
        device_time_ns=number * 10**8,
        wall_time_ns=WALL_NS + number * 10**8,
    )
    batch.channels.add(position=1, rate_hz=rate_hz, acceleration_m_per_s2=[0.5] * samples)
    return batch


def too_large() -> bytes:
    return a_batch(1, 900_000, 50_000.0).SerializeToString()


def millions_of_channels() -> bytes:
    """Two bytes each; parsed they take a gigabyte."""
    number: int = pb.AccelBatch.DESCRIPTOR.fields_by_name["channels"].number
    return a_batch(1).SerializeToString() + bytes([number << 3 | 2, 0]) * 1_000_000


def malformed() -> bytes:
    return b"\xff\xff\xff"


def too_many_samples() -> bytes:
    return a_batch(1, 1000, 100.0).SerializeToString()


def recording(path: Path, payload: bytes, log_time_ns: int = WALL_NS + 10**8) -> Path:
    first = Message(ACCEL, a_batch().SerializeToString(), 7, 0, WALL_NS, WALL_NS)
    second = Message(ACCEL, payload, 7, 1, log_time_ns, WALL_NS)
    write_recording(path, [first, second], site_toml=None, reason="test")
    return path


@pytest.fixture(autouse=True)
def _nobody_connects(monkeypatch: pytest.MonkeyPatch) -> None:
    def connect(**_: object) -> None:
        raise AssertionError("the bus was asked before the file was looked at")

    monkeypatch.setattr("services.replay.run.open_session", connect)
    monkeypatch.setattr("services.truck.run.open_session", connect)


def replayed(path: Path) -> None:
    replay(ReplaySettings(recordings=(path,), endpoint="tcp/127.0.0.1:1", name="x"))


def driven(path: Path) -> None:
    asked = TruckSettings(recording=path, endpoint="tcp/127.0.0.1:1", realm="sim-y", speed=1000.0)
    truck(asked)


@pytest.mark.parametrize("command", [replayed, driven])
@pytest.mark.parametrize(
    ("payload", "output"),
    [
        (too_large, "accel: 7200042 bytes; at most 262144"),
        (millions_of_channels, "bytes; at most 262144"),
        (malformed, "accel: not a driveby.v1.AccelBatch"),
        (too_many_samples, "1000 samples at 100.0 Hz exceed one second"),
    ],
)
def test_a_message_that_no_logger_takes_is_named(
    tmp_path: Path, command: Callable[[Path], None], payload: Callable[[], bytes], output: str
) -> None:
    path = recording(tmp_path / "bad.mcap", payload())
    with pytest.raises(InputError) as caught:
        command(path)
    assert str(caught.value).startswith(f"{path}: message 1 of truck-1: vehicle/")
    assert output in str(caught.value)


@pytest.mark.parametrize("command", [replayed, driven])
def test_a_time_of_no_century_is_named(tmp_path: Path, command: Callable[[Path], None]) -> None:
    path = recording(tmp_path / "old.mcap", a_batch(1).SerializeToString(), log_time_ns=5)
    with pytest.raises(InputError, match="time 5 ns is not between the years 2000 and 2200"):
        command(path)


def test_what_is_far_too_large_is_not_taken_apart_by_any_reader(tmp_path: Path) -> None:
    path = recording(tmp_path / "bad.mcap", b"\0" * (topic("vehicle", "accel").max_bytes + 1))
    messages = read_messages(path)
    assert next(messages).sequence == 0
    with pytest.raises(InputError, match="at most 262144"):
        next(messages)


@pytest.mark.parametrize("command", [replayed, driven, lambda path: list(read_messages(path))])
def test_a_pipe_is_refused_and_not_waited_for(
    tmp_path: Path, command: Callable[[Path], None]
) -> None:
    pipe = tmp_path / "rec.mcap"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="is not an ordinary file"):
        command(pipe)


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk(content: bytes, compression: bytes = b"zstd", compressed: bytes | None = None) -> bytes:
    body = zstandard.compress(content) if compressed is None else compressed
    head = struct.pack("<QQQI", 0, 0, len(content), zlib.crc32(content))
    name = struct.pack("<I", len(compression)) + compression
    return record(6, head + name + struct.pack("<Q", len(body)) + body)


@pytest.fixture
def sound(tmp_path: Path) -> bytes:
    return recording(tmp_path / "sound.mcap", a_batch(1).SerializeToString()).read_bytes()


@pytest.mark.parametrize("command", [replayed, driven, read_info, lambda p: list(read_messages(p))])
def test_another_compression_is_named_and_not_called_damage(
    tmp_path: Path, sound: bytes, command: Callable[[Path], None]
) -> None:
    path = tmp_path / "lz4.mcap"
    frame = b"\x04\x22\x4d\x18" + bytes(50)
    path.write_bytes(MCAP0_MAGIC + chunk(bytes(1000), b"lz4", frame) + sound[len(MCAP0_MAGIC) :])
    with pytest.raises(InputError, match=r"lz4\.mcap: is compressed with lz4, which is not read"):
        command(path)


def test_recovery_names_another_compression_too(tmp_path: Path, sound: bytes) -> None:
    path = tmp_path / "lz4.mcap"
    frame = b"\x04\x22\x4d\x18" + bytes(50)
    path.write_bytes(sound[: len(MCAP0_MAGIC)] + chunk(bytes(1000), b"lz4", frame))
    with pytest.raises(InputError, match="is compressed with lz4"):
        recover_recording(path, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def counted_records(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Count what is taken apart: time depends on the machine."""
    seen = [0]
    unpack = mcap_scan._HEADER.unpack_from

    class Counting:
        size = mcap_scan._HEADER.size
        unpack = mcap_scan._HEADER.unpack

        @staticmethod
        def unpack_from(*arguments: object) -> tuple[int, int]:
            seen[0] += 1
            return unpack(*arguments)

    monkeypatch.setattr(mcap_scan, "_HEADER", Counting)
    return seen


@pytest.mark.parametrize("filling", [b"\0" * 9, struct.pack("<BQ", 0x90, 0)])
def test_what_unpacks_to_gigabytes_is_not_gone_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, filling: bytes
) -> None:
    """60 KB that decompress to 2 GB, of zeros or of records without content."""
    one = chunk(filling * (mcap_scan.MAX_RECORD_BYTES // 9))
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MCAP0_MAGIC + one * 30)
    seen = counted_records(monkeypatch)
    info = read_info(path)
    assert seen[0] < 900_000
    assert info.truncated
    assert info.damaged_chunks >= 1
    with pytest.raises(InputError, match="holds nothing readable of an MCAP recording"):
        recover_recording(path, tmp_path / "out.mcap")


def test_a_chunk_of_zeros_costs_nothing_of_the_rest(tmp_path: Path, sound: bytes) -> None:
    path = tmp_path / "zeros.mcap"
    path.write_bytes(sound[: len(MCAP0_MAGIC)] + chunk(bytes(MIB)) + sound[len(MCAP0_MAGIC) :])
    info = read_info(path)
    assert sum(info.messages.values()) == 2
    assert info.damaged_chunks == 1


def test_signals_that_never_change_are_no_bomb(tmp_path: Path) -> None:
    """Nothing compresses better, and its ratio must not come near the largest that is taken."""
    payloads = [a_batch(n, 1000, 10_000.0).SerializeToString() for n in range(3000)]
    path = tmp_path / "constant.mcap"
    messages = (
        Message(ACCEL, payload, 7, n, WALL_NS + n * 10**8, WALL_NS)
        for n, payload in enumerate(payloads)
    )
    write_recording(path, messages, site_toml=None, reason="test")
    assert sum(map(len, payloads)) < mcap_scan._LARGEST_RATIO * path.stat().st_size / 3
    assert sum(read_info(path).messages.values()) == 3000


def test_zeros_behind_a_recording_are_not_searched_byte_by_byte(
    tmp_path: Path, sound: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a gigabyte that was reserved and never written; on the disk it takes no room."""
    path = tmp_path / "reserved.mcap"
    with path.open("wb") as file:
        file.write(sound)
        file.truncate(len(sound) + (1 << 29))
    searched = [0]
    candidates = mcap_scan._CANDIDATE

    class Counting:
        @staticmethod
        def finditer(window: bytes) -> object:
            searched[0] += len(window)
            return candidates.finditer(window)

    monkeypatch.setattr(mcap_scan, "_CANDIDATE", Counting)
    info = read_info(path)
    assert sum(info.messages.values()) == 2
    assert info.truncated
    assert searched[0] < 8 * MIB


def test_channels_that_nobody_names_are_looked_for_once(
    tmp_path: Path, sound: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each unknown number made the whole file be read again."""
    message = struct.pack("<HIQQ", 0, 0, WALL_NS, WALL_NS)
    strangers = b"".join(record(5, struct.pack("<H", n) + message[2:]) for n in range(1000, 1200))
    path = tmp_path / "strangers.mcap"
    path.write_bytes(sound[: len(MCAP0_MAGIC)] + chunk(strangers) + sound[len(MCAP0_MAGIC) :])
    looked = []
    real = recording_module.find_channels
    monkeypatch.setattr(
        recording_module, "find_channels", lambda path: looked.append(path) or real(path)
    )
    assert sum(read_info(path).messages.values()) == 2
    assert len(looked) == 1
