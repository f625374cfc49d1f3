"""Real loggers and trucks: rotation under load, and files after `kill -9`."""

import random
import signal
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import zenoh

from schemas.events import EventKind, decode_event
from schemas.proto import driveby_pb2 as pb
from schemas.topics import selector
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.common.errors import InputError
from services.recordings.recording import is_closed, read_info, read_messages
from services.recordings.recovery import recovered_path
from tests.receiving import get_latest
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process
Fleet = Any  # of conftest.py, which tests do not import
MakeFleet = Callable[..., Fleet]


def files(fleet: Fleet) -> list[Path]:
    return sorted((fleet.folder / "recordings").glob("*/*/*.mcap"))


def test_rotation_under_load_loses_and_repeats_nothing(fleet: MakeFleet) -> None:
    one = fleet()
    one.start_logger()
    trucks = [one.start_truck(f"truck-{n}") for n in (1, 2)]
    assert one.logger is not None
    for batches in (20, 40, 60, 80):
        for truck in trucks:
            truck.wait_for(batches)
        one.logger.send_signal(signal.SIGUSR1)
    assert one.finish() == 0
    ends = [(read_info(path).end or {}) for path in files(one) if "truck" in path.name]
    assert all(end["dropped"] == "0" for end in ends)
    reasons = [end["reason"] for end in ends]
    assert reasons.count("rotated: on request") >= 6  # two signals may come as one
    assert set(reasons) <= {"rotated: on request", "stopped by a signal"}
    for path in files(one):
        if "truck" in path.name:
            assert "info" in {message.key.stream for message in read_messages(path)}, path


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_results_of_a_worker_that_outlives_the_logger_are_there_once(
    fleet: MakeFleet, how: signal.Signals
) -> None:
    """Its publishers give the next logger all that they keep."""
    one = fleet()
    one.start_logger()
    with open_session(connect=one.logger_endpoint, timeout_s=LONGEST_S) as session:
        worker = Publisher(session, "live")
        for number in range(40):
            if number == 20:
                until(lambda: on_disk(session) == 20, "the first half on the disk")
                assert one.logger is not None
                one.logger.send_signal(how)
                one.logger.wait()
                one.start_logger()
            now_ns = time.time_ns()
            crossing = pb.Crossing(
                schema_version=1, crossing_id=str(number), vehicle="truck-1", time_ns=now_ns
            )
            worker.put("bridge", "bridge-1", "crossing", crossing.SerializeToString())
        # The history, and the gap that the logger left.
        until(lambda: on_disk(session) == 40, "all of it on the disk")
        one.stop_logger()
        worker.close()
    found = [
        m.sequence for path in files(one) for m in read_messages(path) if m.key.owner == "bridge"
    ]
    assert sorted(found) == list(range(40))


def on_disk(session: zenoh.Session) -> int:
    """How many crossings the logger says are on its disk."""
    output = [
        pb.Durable.FromString(p)
        for p in get_latest(session, selector("live", "service", "durable"))
    ]
    return sum(one.count for found in output for one in found.streams if one.stream == "crossing")


def holds_something(path: Path) -> bool:
    try:
        return bool(read_info(path).messages)
    except InputError:
        return False


def kill_and_recover(one: Fleet, rng: random.Random, kills: int) -> None:
    one.start_logger()
    trucks = [one.start_truck(f"truck-{n}") for n in (1, 2, 3)]
    for kill in range(1, kills + 1):
        for truck in trucks:
            truck.wait_for(30 * kill)
        time.sleep(rng.uniform(0.0, 1.0))
        one.kill(one.logger)
        one.start_logger()
    until(lambda: is_quiet(one), "the recovery of all recordings")
    assert one.finish() == 0
    assert all(is_closed(path) for path in files(one))
    recovered = [path for path in files(one) if path.name.endswith(".recovered.mcap")]
    crashed = list((one.folder / "recordings").glob("*/*/*.crashed"))
    assert len(crashed) >= len(recovered) >= 3
    # One that was begun in the moment of the kill holds nothing, and is set aside alone.
    alone = [path for path in crashed if not recovered_path(path).exists()]
    assert not any(map(holds_something, alone))
    for path in recovered:
        assert EventKind.RECORDING_RECOVERED in reported_by("recover", [path])
    if kills == 1:  # else the logger may be killed before it has written down what it recovered
        assert reported_by("logger", files(one)).count(EventKind.RECORDING_RECOVERED) == len(
            recovered
        )


def reported_by(service: str, paths: Iterable[Path]) -> list[EventKind]:
    return [
        decode_event(message.payload).kind
        for path in paths
        for message in read_messages(path)
        if message.key.stream == "event" and message.key.identifier == service
    ]


def is_quiet(one: Fleet) -> bool:
    """Whether every recording has its end or is one that the logger of now writes."""
    try:
        return all(is_closed(path) or is_new(path, one) for path in files(one))
    except (InputError, FileNotFoundError):  # renamed or closed between the listing and the look
        return False


def is_new(path: Path, one: Fleet) -> bool:
    """Whether a recording is one that the logger of now writes."""
    assert one.logger is not None
    descriptors = Path(f"/proc/{one.logger.pid}/fd")
    return any(link.resolve() == path.resolve() for link in descriptors.iterdir())


def test_files_of_a_killed_logger_are_recovered_by_the_next(fleet: MakeFleet) -> None:
    kill_and_recover(fleet(), random.Random(1), 1)


@pytest.mark.faults
@pytest.mark.timeout(600)
def test_files_of_a_logger_killed_ten_times(fleet: MakeFleet) -> None:
    kill_and_recover(fleet(), random.Random(2), 10)
