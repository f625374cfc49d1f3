"""A truck that was out of radio until Zenoh has forgotten it: its spool has everything."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from schemas.events import EventKind, decode_event
from schemas.topics import Message
from services.recordings.recording import read_messages
from tests.faults.logger_process import FORGETFUL_ENV
from tests.waiting import until

pytestmark = pytest.mark.process


@pytest.mark.parametrize("reboots", [False, pytest.param(True, marks=pytest.mark.faults)])
def test_silent_truck_is_fetched_from_its_spool(fleet: Callable[..., Any], reboots: bool) -> None:
    """Its link is cut while it goes on driving, and in the one case is also switched off and on.

    Another truck has a link of its own all the time.
    """
    one = fleet(router=True)
    one.start_logger(**{FORGETFUL_ENV: "1"})
    one.start_router()
    silent = one.start_truck("truck-1", rate=100.0)
    healthy = one.start_truck("truck-2", rate=100.0, endpoint=one.logger_endpoint)
    silent.wait_for(20)
    healthy.wait_for(20)
    until(lambda: "truck-1 in realm live connected" in one.said_by_logger(), "the truck")
    one.kill(one.router)
    until(
        lambda: "truck-1 in realm live disconnected" in one.said_by_logger(), "the end of its link"
    )
    (boot_id, cut_off_at), *_ = silent.said.items()
    silent.wait_for(cut_off_at + 60)
    if reboots:
        silent.kill()
        silent = one.start_truck("truck-1", rate=100.0)
        silent.wait_for(60)
    back_ns = time.time_ns()
    one.start_router()
    until(
        lambda: one.said_by_logger().count("truck-1 in realm live connected") == 2,
        "the truck again",
    )
    silent.wait_for(max(silent.said.values()) + 20)
    assert one.finish() == 0  # not one is missing, and none is there twice
    boots = {boot for truck in one.trucks if truck.vehicle == "truck-1" for boot in truck.said}
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
