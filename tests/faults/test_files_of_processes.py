"""Real loggers and trucks: rotation under load, and files after `kill -9`."""

import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from schemas.events import EventKind, decode_event
from services.common.recording import is_closed, read_info, read_messages

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
    for truck in trucks:
        truck.finish()
    one.stop_logger()
    assert one.assert_complete() == 0
    ends = [(read_info(path).end or {}) for path in files(one) if "truck" in path.name]
    assert all(end["dropped"] == "0" for end in ends)
    reasons = [end["reason"] for end in ends]
    assert reasons.count("rotated: on request") >= 6  # two signals may come as one
    assert set(reasons) <= {"rotated: on request", "stopped by a signal"}
    for path in files(one):
        if "truck" in path.name:
            assert "info" in {message.key.stream for message in read_messages(path)}, path


def kill_and_recover(one: Fleet, rng: random.Random, kills: int) -> None:
    one.start_logger()
    trucks = [one.start_truck(f"truck-{n}") for n in (1, 2, 3)]
    for kill in range(1, kills + 1):
        for truck in trucks:
            truck.wait_for(30 * kill)
        time.sleep(rng.uniform(0.0, 1.0))
        one.kill(one.logger)
        one.start_logger()
    deadline = time.monotonic() + 60.0
    while not all(is_closed(p) or is_new(p, one) for p in files(one)):
        assert time.monotonic() < deadline, one.logs()
        time.sleep(0.1)
    for truck in trucks:
        truck.finish()
    one.stop_logger()
    assert one.assert_complete() == 0
    assert all(is_closed(path) for path in files(one))
    recovered = [path for path in files(one) if path.name.endswith(".recovered.mcap")]
    crashed = list((one.folder / "recordings").glob("*/*/*.crashed"))
    assert len(recovered) == len(crashed) >= 3
    told = [
        decode_event(message.payload)
        for path in files(one)
        for message in read_messages(path)
        if message.key.stream == "event" and message.key.identifier == "logger"
    ]
    named = [event for event in told if event.kind == EventKind.RECORDING_RECOVERED]
    assert len(named) >= len(recovered)


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
