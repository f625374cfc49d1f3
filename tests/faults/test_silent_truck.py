"""A truck that was out of radio until Zenoh has forgotten it: its spool has everything."""

import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from schemas.events import EventKind, decode_event
from schemas.topics import Message
from services.recordings.recording import read_messages
from tests.faults.logger_process import FORGETFUL_ENV
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process

MINUTES_ENV = "DRIVEBY_SOAK_SILENCE_MINUTES"


@pytest.mark.parametrize("reboots", [False, pytest.param(True, marks=pytest.mark.faults)])
def test_silent_truck_is_fetched_from_its_spool(fleet: Callable[..., Any], reboots: bool) -> None:
    """Its link is cut while it goes on driving, and in the one case is also switched off and on.

    Another truck has a link of its own all the time.
    """
    check_silence(fleet(router=True), {FORGETFUL_ENV: "1"}, rate=100.0, reboots=reboots)


@pytest.mark.soak
@pytest.mark.timeout(6 * 3600)
def test_truck_silent_for_over_an_hour_is_fetched_from_its_spool(
    fleet: Callable[..., Any],
) -> None:
    """The same with Zenoh as it is: it forgets a publisher after an hour of silence."""
    minutes = float(os.environ.get(MINUTES_ENV, "70"))
    check_silence(fleet(router=True), {}, rate=10.0, at_least_s=60.0 * minutes)


def check_silence(
    one: Any, env: dict[str, str], rate: float, *, at_least_s: float = 0.0, reboots: bool = False
) -> None:
    one.start_logger(**env)
    one.start_router()
    silent = one.start_truck("truck-1", rate=rate)
    healthy = one.start_truck("truck-2", rate=rate, endpoint=one.logger_endpoint)
    silent.wait_for(20)
    healthy.wait_for(20)
    until(lambda: "truck-1 in realm live connected" in one.logger_output(), "the truck")
    one.kill(one.router)
    until(
        lambda: "truck-1 in realm live disconnected" in one.logger_output(), "the end of its link"
    )
    (boot_id, cut_off_at), *_ = silent.output.items()
    silent.wait_for(cut_off_at + max(60, round(at_least_s * rate)), LONGEST_S + 2.0 * at_least_s)
    if reboots:
        silent.kill()
        silent = one.start_truck("truck-1", rate=rate)
        silent.wait_for(60)
    back_ns = time.time_ns()
    one.start_router()
    until(
        lambda: one.logger_output().count("truck-1 in realm live connected") == 2,
        "the truck again",
    )
    silent.wait_for(max(silent.output.values()) + 20)
    assert one.finish() == 0  # not one is missing, and none is there twice
    boots = {boot for truck in one.trucks if truck.vehicle == "truck-1" for boot in truck.output}
    assert len(boots) == 1 + reboots
    found = list(messages_of(one))
    events = [decode_event(m.payload) for m in found if m.key.stream == "event"]
    assert [event for event in events if event.kind == EventKind.LOST] == []
    while_away = [
        m.publish_time_ns
        for m in found
        if m.key[2:] == ("truck-1", "accel") and m.boot_id == boot_id and m.sequence > cut_off_at
    ]
    assert len(while_away) >= 60
    assert min(while_away) >= back_ns


def messages_of(one: Any) -> Iterator[Message]:
    for path in (one.folder / "recordings").glob("*/*/*.mcap"):
        yield from read_messages(path)
