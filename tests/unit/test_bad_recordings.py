"""Recordings that the bus would not take: one line before anybody is connected to."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.topics import Key, topic
from services.common.errors import InputError
from services.recordings.recording import Message, read_messages, write_recording
from services.replay import run as replay
from services.truck import run as truck

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

    monkeypatch.setattr("services.replay.open_session", connect)
    monkeypatch.setattr("services.truck.open_session", connect)


def replayed(path: Path) -> None:
    replay(recordings=[path], endpoint="tcp/127.0.0.1:1", speed=1.0, name="x")


def driven(path: Path) -> None:
    truck(recording=path, endpoint="tcp/127.0.0.1:1", realm="sim-y", speed=1000.0, vehicle=None)


@pytest.mark.parametrize("command", [replayed, driven])
@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (too_large, "accel: 7200042 bytes; at most 262144"),
        (millions_of_channels, "bytes; at most 262144"),
        (malformed, "accel: not a driveby.v1.AccelBatch"),
        (too_many_samples, "1000 samples at 100.0 Hz exceed one second"),
    ],
)
def test_a_message_that_no_logger_takes_is_named(
    tmp_path: Path, command: Callable[[Path], None], payload: Callable[[], bytes], said: str
) -> None:
    path = recording(tmp_path / "bad.mcap", payload())
    with pytest.raises(InputError) as caught:
        command(path)
    assert str(caught.value).startswith(f"{path}: message 1 of truck-1: vehicle/")
    assert said in str(caught.value)


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
    with pytest.raises(InputError, match="is no ordinary file"):
        command(pipe)
