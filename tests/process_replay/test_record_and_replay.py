"""Truck, logger and replay as processes of their own: nothing lost, nothing changed."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.signals import decode_accel, decode_gnss
from schemas.topics import Message, selector
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.recordings.recording import read_info, read_messages
from tests.process_replay.starting import End, Start, start_logger
from tests.receiving import get_latest
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process


def by_stream(messages: list[Message]) -> dict[str, list[Message]]:
    streams: dict[str, list[Message]] = {}
    for message in messages:
        streams.setdefault(message.key.stream, []).append(message)
    return streams


@contextmanager
def heard_at(endpoint: str) -> Iterator[Iterator[RawSample]]:
    """What trucks say of their acceleration, as it comes."""

    def one_after_the_other() -> Iterator[RawSample]:
        for _ in range(round(LONGEST_S / 0.1)):
            if (one := heard.receive(0.1)) is not None:
                yield one

    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S) as session,
        Subscription(session, selector("live", "vehicle", "accel")) as heard,
    ):
        yield one_after_the_other()


def on_disk(session: zenoh.Session) -> int:
    """How many batches the logger says are on its disk."""
    output = get_latest(session, selector("live", "service", "durable"), LONGEST_S)
    streams = [one for payload in output for one in pb.Durable.FromString(payload).streams]
    return sum(one.count for one in streams if one.stream == "accel")


def test_a_truck_is_recorded_completely_and_as_a_drive_of_now(
    start: Start, finish: End, terminate: End, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    began_ns = time.time_ns()
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    truck = start(
        "services.truck",
        recording=recording,
        endpoint=endpoint,
        realm="live",
        speed=20.0,
        vehicle=None,
    )
    finish(truck)
    terminate(logger)

    recorded = list(read_messages(tmp_path / "live.mcap"))
    original = by_stream(list(read_messages(recording)))
    live = by_stream(recorded)
    assert {name: len(found) for name, found in live.items()} == {
        "info": 1,
        "accel": 200,
        "gnss": 100,
        "location": 100,
    }
    for found in live.values():
        assert [message.sequence for message in found] == list(range(len(found)))
        assert len({message.boot_id for message in found}) == 1
    # The truck is at the present, no stamp is ahead of the clock, spacing and samples are kept.
    assert all(message.key.realm == "live" for message in recorded)
    assert all(message.log_time_ns <= message.publish_time_ns for message in recorded)
    assert recorded[-1].log_time_ns > began_ns
    for one, other in zip(original["accel"], live["accel"], strict=True):
        before, now = decode_accel(one.payload), decode_accel(other.payload)
        assert (now.boot_id, now.sequence) == (other.boot_id, other.sequence)
        for name, (rate_hz, samples) in before.channels.items():
            assert now.channels[name].rate_hz == rate_hz
            np.testing.assert_array_equal(now.channels[name].samples, samples)
    times = [decode_accel(message.payload) for message in live["accel"]]
    assert {b.wall_time_ns - a.wall_time_ns for a, b in pairwise(times)} == {50_000_000}
    assert {b.device_time_ns - a.device_time_ns for a, b in pairwise(times)} == {50_000_000}
    assert decode_gnss(live["gnss"][0].payload).device_time_ns == times[0].device_time_ns

    info = read_info(tmp_path / "live.mcap")
    assert info.end is not None
    assert info.end["reason"] == "stopped by a signal"
    assert info.end["messages"] == "401"
    assert (info.end["refused"], info.end["lost"], info.end["dropped"]) == ("0", "0", "0")


@pytest.mark.parametrize("speed", [0.0, 20.0])
def test_a_recorded_replay_is_the_recording(
    start: Start,
    finish: End,
    terminate: End,
    endpoint: str,
    recording: Path,
    tmp_path: Path,
    speed: float,
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "again.mcap")
    replay = start(
        "services.replay", recordings=[str(recording)], endpoint=endpoint, speed=speed, name="x"
    )
    finish(replay)
    terminate(logger)

    def content(path: Path) -> list[tuple[str, bytes, int, int, int]]:
        return [
            (m.key.stream, m.payload, m.boot_id, m.sequence, m.log_time_ns)
            for m in read_messages(path)
        ]

    assert content(tmp_path / "again.mcap") == content(recording)
    assert {m.key.realm for m in read_messages(tmp_path / "again.mcap")} == {"replay-x"}


def test_replay_is_never_ahead_of_the_spacing(
    start: Start, finish: End, terminate: End, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "again.mcap")
    began_ns = time.time_ns()
    replay = start(
        "services.replay", recordings=[str(recording)], endpoint=endpoint, speed=5.0, name="x"
    )
    finish(replay)
    terminate(logger)
    accel = by_stream(list(read_messages(tmp_path / "again.mcap")))["accel"]
    came_s = np.array([message.publish_time_ns for message in accel]) * 1e-9
    due_s = np.array([message.log_time_ns for message in accel]) * 1e-9
    # 10 s in 2 s; how it waits for each: tests/unit/bus/test_playback.py, with a clock of its own.
    assert np.all(came_s - began_ns * 1e-9 >= (due_s - due_s[0]) / 5.0)


def test_a_subscriber_that_comes_late_gets_everything(
    start: Start, finish: End, terminate: End, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    """The truck drives while there is no logger: its publisher keeps what the logger missed."""
    router = start_logger(start, endpoint, tmp_path / "router.mcap", realms=["sim-other"])
    truck = start(
        "services.truck",
        recording=recording,
        endpoint=endpoint,
        realm="live",
        speed=2.0,
        vehicle="truck-1",
    )
    with heard_at(endpoint) as batches:
        next(batches)
    router.send_signal(signal.SIGKILL)
    router.wait()
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    finish(truck)
    terminate(logger)
    streams = by_stream(list(read_messages(tmp_path / "live.mcap")))
    for name, number in {"info": 1, "accel": 200, "gnss": 100, "location": 100}.items():
        assert sorted(message.sequence for message in streams[name]) == list(range(number))


def test_a_killed_logger_leaves_a_readable_file(
    start: Start, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    start(
        "services.truck",
        recording=recording,
        endpoint=endpoint,
        realm="live",
        speed=1.0,
        vehicle=None,
    )
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as session:
        until(lambda: on_disk(session) >= 20, "twenty batches on the disk")
        promised = on_disk(session)
    logger.send_signal(signal.SIGKILL)
    logger.wait()
    messages = list(read_messages(tmp_path / "live.mcap"))
    info = read_info(tmp_path / "live.mcap")
    assert info.end is None
    assert info.truncated
    accel = by_stream(messages)["accel"]
    assert len(accel) >= promised
    assert [message.sequence for message in accel] == list(range(len(accel)))


def test_one_file_per_vehicle_below_the_folder(
    start: Start,
    finish: End,
    terminate: End,
    endpoint: str,
    tmp_path: Path,
    recording: Path,
    drive_messages: Callable[..., Iterator[Message]],
) -> None:
    from services.recordings.writer import write_recording

    second = tmp_path / "second.mcap"
    write_recording(second, drive_messages(20, "truck-2", 78), site_toml=None, reason="test")
    logger = start_logger(start, endpoint, None, folder=tmp_path / "recordings")
    both = [str(recording), str(second)]
    finish(start("services.replay", recordings=both, endpoint=endpoint, speed=0.0, name="x"))
    terminate(logger)
    files = sorted((tmp_path / "recordings" / "replay-x").glob("*/*.mcap"))
    assert [file.name.rsplit("-", 1)[0] for file in files] == ["truck-1", "truck-2"]
    assert len(list(read_messages(files[0]))) == 401
    assert len(list(read_messages(files[1]))) == 41


def test_nobody_there_is_one_line_and_exit_code_1(
    start: Start, endpoint: str, recording: Path
) -> None:
    replay = start(
        "services.replay",
        recordings=[str(recording)],
        endpoint=endpoint,
        speed=0.0,
        name="x",
        connect_timeout_s=0.5,
    )
    _, log = replay.communicate(timeout=LONGEST_S)
    assert replay.returncode == 1
    assert log.splitlines()[-1].startswith(f"no router answers at {endpoint}")
    assert "Traceback" not in log
