"""Messages in, crossings out: each once as it begins and once with its data."""

from collections.abc import Iterable

import numpy as np
import pytest

from schemas.topics import Message
from services.finding.crossing_data import Complete, Detection, close_window, wide_window
from services.finding.finder import Finder, Found, Name, Recognise, crossings_in
from services.identification.engine import Engine
from services.identification.outputs import IdentificationTask
from tests.unit.identification.test_engine_resume import HEADER, SETTINGS, SITE, TWO


def found(finder: Finder) -> list[Found]:
    events = [one for m in TWO for one in finder.feed(m.key, m.payload)]
    return [*events, *finder.finish()]


def named(name: str, *, is_decided: bool) -> Recognise:
    return lambda detection: Name(name, is_decided)


def test_each_crossing_is_detected_once_and_complete_once() -> None:
    events = found(Finder(SITE, wide_window))
    assert [type(one) for one in events] == [Detection, Complete] * 2
    for detection, complete in zip(events[::2], events[1::2], strict=True):
        assert isinstance(detection, Detection)
        assert isinstance(complete, Complete)
        assert complete.data.crossing_id == detection.crossing_id
        assert complete.detection.crossing_id == detection.crossing_id
        assert complete.detection.entry_ns < complete.detection.exit_ns


def test_a_finder_gives_the_data_that_an_engine_works_on() -> None:
    engine = Engine(SITE, SETTINGS, HEADER)
    output = [one for m in TWO for one in engine.feed(m.key, m.payload)]
    works = [one.data for one in output if isinstance(one, IdentificationTask)]
    alone = list(crossings_in(((m.key, m.payload) for m in TWO), SITE, close_window))
    assert [one.crossing_id for one in alone] == [one.crossing_id for one in works]
    assert [one.stay for one in alone] == [one.stay for one in works]
    for one, other in zip(alone, works, strict=True):
        assert one.samples is not None
        assert other.samples is not None
        for name, values in one.samples.channels.items():
            np.testing.assert_array_equal(values, other.samples.channels[name])


def test_a_stay_that_is_known_keeps_its_name() -> None:
    events = found(Finder(SITE, wide_window, named("known", is_decided=False)))
    names = {e.crossing_id if isinstance(e, Detection) else e.data.crossing_id for e in events}
    assert names == {"known"}


def test_a_stay_that_is_decided_elsewhere_is_not_found_again() -> None:
    finder = Finder(SITE, wide_window, named("known", is_decided=True))
    assert found(finder) == []
    assert not finder.has_undecided(TWO[0].key.realm, TWO[0].key.identifier)


ALWAYS_NS = 1 << 62


def batch_on_bridge() -> Message:
    """Return the accelerations of a time at which the truck is on the bridge for the first time."""
    (first, *_) = (one for one in found(Finder(SITE, wide_window)) if isinstance(one, Detection))
    middle_ns = (first.entry_ns + first.exit_ns) // 2
    return min(
        (m for m in TWO if m.key.stream == "accel"), key=lambda m: abs(m.log_time_ns - middle_ns)
    )


def complete(finder: Finder, messages: Iterable[Message]) -> list[Complete]:
    events = [one for m in messages for one in finder.feed(m.key, m.payload)]
    return [one for one in (*events, *finder.finish()) if isinstance(one, Complete)]


@pytest.mark.parametrize(
    ("until_ns", "crossings"), [({}, 2), ({"truck-1": ALWAYS_NS}, 1), ({"truck-1": 0}, 2)]
)
def test_what_began_before_is_left_to_a_recording(until_ns: dict[str, int], crossings: int) -> None:
    finder = Finder(SITE, wide_window)
    finder.leave_to_recordings(until_ns)
    first_ns = TWO[0].log_time_ns
    rest = [m for m in TWO if m.log_time_ns > first_ns + 7_500_000_000]
    assert len(complete(finder, rest)) == crossings


@pytest.mark.parametrize(
    ("until_ns", "crossings"), [({}, 2), ({"truck-1": ALWAYS_NS}, 0), ({"truck-1": 0}, 2)]
)
def test_positions_that_came_alone_are_left_to_a_recording(
    until_ns: dict[str, int], crossings: int
) -> None:
    """As where the connection broke after them; without a recording nothing more will come."""
    finder = Finder(SITE, wide_window)
    finder.leave_to_recordings(until_ns)
    assert len(complete(finder, [m for m in TWO if m.key.stream != "accel"])) == crossings


@pytest.mark.parametrize(
    ("until_ns", "crossings"), [({}, 2), ({"truck-1": ALWAYS_NS}, 1), ({"truck-1": 0}, 2)]
)
def test_a_crossing_with_a_hole_is_left_to_a_recording(
    until_ns: dict[str, int], crossings: int
) -> None:
    """A message may be damaged on the bus, and whole in the recording."""
    finder = Finder(SITE, wide_window)
    finder.leave_to_recordings(until_ns)
    lost = batch_on_bridge()
    assert len(complete(finder, [m for m in TWO if m is not lost])) == crossings
    assert not finder.has_undecided(TWO[0].key.realm, TWO[0].key.identifier)


@pytest.mark.parametrize("is_late", [False, True])
def test_what_is_left_to_a_recording_is_not_tracked(*, is_late: bool) -> None:
    """Unless what was missing comes in time."""
    finder = Finder(SITE, wide_window)
    finder.leave_to_recordings({"truck-1": ALWAYS_NS})
    lost = batch_on_bridge()
    messages = [m for m in TWO if m is not lost]
    if is_late:
        messages.insert(messages.index(TWO[TWO.index(lost) + 40]), lost)
    events = [one for m in messages for one in finder.feed(m.key, m.payload)]
    first = next(one for one in events if isinstance(one, Detection))
    key = TWO[0].key
    assert (
        finder.is_tracking(
            *(key.realm, key.identifier, TWO[0].boot_id, first.bridge, first.stay.entry_s)
        )
        == is_late
    )
    decided = [one for one in events if isinstance(one, Complete)]
    assert any(one.detection.crossing_id == first.crossing_id for one in decided) == is_late
