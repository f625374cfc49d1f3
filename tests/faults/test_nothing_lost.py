"""Trucks, loggers and routers are killed and frozen: everything is on disk in the end, once."""

import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from schemas.events import EventKind, decode_event
from services.recordings.recording import read_messages
from tests.waiting import hesitation

KILLS_ENV = "DRIVEBY_SOAK_KILLS"
MINUTES_ENV = "DRIVEBY_SOAK_MINUTES"
pytestmark = pytest.mark.process

MakeFleet = Callable[..., Any]
_MOST_LOAD = 4.0
"""Load average of a processor beyond which others, and not the logger, decide what it achieves."""
_SWITCHES = 10
"""From thread to thread on a message's way, each of which a busy machine delays."""


@pytest.mark.faults  # the next but one does the same, and more
def test_killed_truck_publishes_the_rest_after_its_restart(fleet: MakeFleet) -> None:
    """There is no logger while it drives: only its spool knows."""
    one = fleet(router=True)
    one.start_router()
    drive_twice_before_there_is_a_logger(one)


def test_a_truck_that_starts_where_there_is_no_router(fleet: MakeFleet) -> None:
    """It drives, is killed, starts again, and meets router and logger only then."""
    drive_twice_before_there_is_a_logger(fleet())


def drive_twice_before_there_is_a_logger(one: Any) -> None:
    """The first drive ends with a kill."""
    truck = one.start_truck(rate=100.0)
    truck.wait_for(30)
    truck.kill()
    again = one.start_truck(rate=100.0)
    again.wait_for(30)
    one.start_logger()
    again.wait_for(60)
    assert one.finish() == 0
    assert list((one.folder / "spool").glob("*/*.spool")) == []


def test_a_truck_killed_while_the_logger_listens(fleet: MakeFleet) -> None:
    one = fleet()
    one.start_logger()
    truck = one.start_truck(rate=100.0)
    truck.wait_for(150)
    truck.kill()
    again = one.start_truck(rate=20.0)
    again.wait_for(20)
    assert one.finish() == 0


@pytest.mark.faults
def test_an_outage_longer_than_the_cache(fleet: MakeFleet) -> None:
    """The publisher keeps 6000 batches; 8000 are made while there is no logger."""
    one = fleet()
    one.start_logger()
    truck = one.start_truck(rate=1000.0)
    truck.wait_for(100)
    one.kill(one.logger)
    truck.wait_for(8500)
    one.start_logger()
    assert one.finish() == 0


def kill_at_random(fleet: MakeFleet, seed: int, kills: int, *, what: str) -> int:
    moments = random.Random(seed)
    one = fleet(router=what != "logger")
    one.start_logger()
    if one.truck_endpoint != one.logger_endpoint:
        one.start_router()
    trucks = [one.start_truck(f"truck-{n}") for n in (1, 2, 3)]
    for truck in trucks:
        truck.wait_for(5)
    for _ in range(kills):
        time.sleep(moments.uniform(0.3, 3.0))
        if what in ("logger", "both"):
            one.kill(one.logger)
        if what in ("router", "both"):
            one.kill(one.router)
        if what == "truck":
            at = moments.randrange(3)
            trucks[at].kill()
        time.sleep(moments.uniform(0.0, 1.0))
        if what == "truck":
            trucks[at] = one.start_truck(f"truck-{at + 1}")
            trucks[at].wait_for(5)
        if what in ("logger", "both"):
            one.start_logger()
        if what in ("router", "both"):
            one.start_router()
    time.sleep(1.0)
    twice: int = one.finish()
    return twice


@pytest.mark.parametrize(
    "what",
    ["both", *(pytest.param(one, marks=pytest.mark.faults) for one in ("logger", "router"))],
)
def test_killed_at_a_random_moment(fleet: MakeFleet, what: str) -> None:
    assert kill_at_random(fleet, 1, 1, what=what) == 0


@pytest.mark.faults
@pytest.mark.timeout(600)
@pytest.mark.parametrize("what", ["logger", "router", "both", "truck"])
def test_killed_ten_times(fleet: MakeFleet, what: str) -> None:
    assert kill_at_random(fleet, 2, 10, what=what) == 0


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("what", ["logger", "router", "both", "truck"])
def test_killed_fifty_times(fleet: MakeFleet, what: str) -> None:
    assert kill_at_random(fleet, 3, int(os.environ.get(KILLS_ENV, "50")), what=what) == 0


@pytest.mark.soak
@pytest.mark.timeout(3 * 3600)
def test_an_hour_at_the_rated_load(tmp_path: Path) -> None:
    """100 trucks; nothing is missing or there twice, and the memory stays what it is."""
    from tests.benchmarks.logger_load import measure

    minutes = float(os.environ.get(MINUTES_ENV, "60"))
    figures = measure(tmp_path, trucks=100, seconds=60.0 * minutes, warm_up_s=120.0)
    print("\n".join(f"{name:40} {value}" for name, value in figures.items()))
    first, last = (figures[f"logger's memory, {when} minute, MB"] for when in ("first", "last"))
    failures = [
        f"{what} {figures[what]}"
        for what in ("not in the files", "twice in the files", "dropped by the logger")
        if figures[what] != 0
    ]
    if float(last) > 1.05 * float(first):
        failures.append(f"memory grew from {first} to {last} MB")
    load, most = float(figures["load average, mean"]), _MOST_LOAD * (os.cpu_count() or 1)
    if failures and load > most:
        pytest.skip(f"the machine cannot be rated, its load average was {load}: {failures}")
    assert not failures


@pytest.mark.faults
@pytest.mark.parametrize("seconds", [12.0])
@pytest.mark.parametrize("what", ["truck", "logger", "router"])
def test_frozen_for_longer_than_its_time_outs(fleet: MakeFleet, what: str, seconds: float) -> None:
    """Zenoh gives up a silent connection after 10 s."""
    one = fleet(router=True)
    one.start_logger()
    one.start_router()
    frozen, healthy = one.start_truck("truck-1"), one.start_truck("truck-2")
    frozen.wait_for(20)
    healthy.wait_for(20)
    process = {"truck": frozen.process, "logger": one.logger, "router": one.router}[what]
    process.send_signal(signal.SIGSTOP)
    before = max(healthy.output.values())
    time.sleep(seconds)
    # The caller of a gateway is never held up by the network: it would say nothing any more.
    healthy.wait_for(before + round(10 * seconds))
    process.send_signal(signal.SIGCONT)
    time.sleep(2.0)
    assert one.finish() == 0


@pytest.mark.parametrize("router", [False, pytest.param(True, marks=pytest.mark.faults)])
def test_a_frozen_truck_delays_no_other(fleet: MakeFleet, router: bool) -> None:
    one = fleet(router=router)
    with hesitation() as own_delay_s:
        one.start_logger()
        if router:
            one.start_router()
        frozen, healthy = one.start_truck("truck-1"), one.start_truck("truck-2")
        frozen.wait_for(20)
        frozen.process.send_signal(signal.SIGSTOP)
        healthy.wait_for(max(healthy.output.values(), default=0) + 60)
        late = one.start_truck("truck-3")
        late.wait_for(40)
        frozen.process.send_signal(signal.SIGCONT)
        one.finish()
        machine_s = _SWITCHES * own_delay_s()
    for vehicle in ("truck-2", "truck-3"):
        found_s = lags_s(one, vehicle)
        assert sorted(found_s)[len(found_s) // 2] < max(0.5, machine_s)
        # The first ones, while the logger meets the truck.
        assert max(found_s) < max(4.0, machine_s), vehicle


def lags_s(one: Any, vehicle: str = "truck-*") -> list[float]:
    """Between what was sent and what was received, of every batch."""
    return [
        (message.publish_time_ns - message.log_time_ns) * 1e-9
        for path in (one.folder / "recordings").glob(f"*/*/{vehicle}-*.mcap")
        for message in read_messages(path)
        if message.key.stream == "accel"
    ]


@pytest.mark.parametrize("jump_s", [-3600, pytest.param(86_400, marks=pytest.mark.faults)])
def test_a_truck_whose_wall_clock_jumps(fleet: MakeFleet, jump_s: int) -> None:
    one = fleet()
    one.start_logger()
    truck = one.start_truck(rate=100.0, DRIVEBY_TEST_CLOCK_STEP=f"30:{jump_s}")
    truck.wait_for(50)
    one.finish()
    [path] = (one.folder / "recordings").glob("*/*/truck-1-*.mcap")
    events = [decode_event(m.payload) for m in read_messages(path) if m.key.stream == "event"]
    steps = [event for event in events if event.kind == EventKind.CLOCK_STEP]
    assert [(step.vehicle, step.first_sequence) for step in steps] == [("truck-1", 30)]
    accel = [m.sequence for m in read_messages(path) if m.key.stream == "accel"]
    assert accel == sorted(accel)


@pytest.mark.faults
def test_a_frozen_subscriber_holds_up_the_logger_for_seconds_only(fleet: MakeFleet) -> None:
    one = fleet()
    one.start_logger()
    viewer = one.python("subscriber_process.py", one.logger_endpoint, env={})
    assert viewer.stdout.readline() == "ready\n"
    trucks = [one.start_truck(f"truck-{n}", rate=1000.0) for n in (1, 2)]
    for truck in trucks:
        truck.wait_for(500)
    viewer.send_signal(signal.SIGSTOP)
    with hesitation() as own_delay_s:
        for truck in trucks:
            truck.wait_for(max(truck.output.values()) + 12_000)
        assert one.finish() == 0
        machine_s = _SWITCHES * own_delay_s()
    assert max(lags_s(one)) < max(5.0, machine_s)  # Zenoh's own patience made it 10
