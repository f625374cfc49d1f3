"""The spacing of what is published again, by a clock of its own."""

import os
import signal
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import pytest

from schemas.topics import Key, Message
from services.bus import playback
from services.bus.delivery import DeliveryTracker
from services.common.errors import FailureError
from tests.waiting import LONGEST_S

WHERE = Key("live", "vehicle", "truck-1", "gnss")


class Clock(threading.Event):
    """Time goes on only while something waits for the event."""

    now_s = 1000.0

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        assert timeout > 0.0
        self.now_s += timeout
        return self.is_set()


class Delivered:
    has_logger = False

    def missing(self) -> int:
        return 0


def recorded(*times_s: float) -> Iterator[Message]:
    for number, time_s in enumerate(times_s):
        yield Message(WHERE, b"", 1, number, round(time_s * 1e9), 0)


@pytest.mark.parametrize("speed", [0.5, 1.0, 5.0])
def test_the_spacing_is_kept(monkeypatch: pytest.MonkeyPatch, speed: float) -> None:
    clock = Clock()
    monkeypatch.setattr("services.bus.playback.time.monotonic", lambda: clock.now_s)
    came_s: list[float] = []

    def put(message: Message) -> None:
        came_s.append(clock.now_s - 1000.0)
        if message.sequence == 2:
            clock.now_s += 0.3 / speed  # is held up, and makes up for it afterwards

    times_s = (50.0, 50.1, 50.2, 50.3, 50.2, 51.0, 53.0)
    number = playback.publish_paced(recorded(*times_s), put, Delivered(), speed=speed, stop=clock)  # type: ignore[arg-type]
    assert number == len(times_s)
    due_s = (0.0, 0.1, 0.2, 0.5, 0.5, 1.0, 3.0)  # the fifth stands late in the recording
    assert came_s == pytest.approx([due / speed for due in due_s])


def test_without_a_speed_nothing_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("services.bus.playback.time.monotonic", lambda: clock.now_s)
    put: list[Message] = []
    playback.publish_paced(recorded(0.0, 100.0), put.append, Delivered(), speed=0.0, stop=clock)  # type: ignore[arg-type]
    assert (len(put), clock.now_s) == (2, 1000.0)


def test_a_signal_that_comes_while_one_waits_for_it_stops_nothing_else() -> None:
    """In the same thread, in any moment: a lock that both took would be waited for for ever."""
    for _ in range(50):
        with playback.stopped_by_signals() as stop:
            sender = threading.Thread(target=lambda: os.kill(os.getpid(), signal.SIGTERM))
            sender.start()
            while not stop.is_set():
                stop.wait(1e-6)
            sender.join()
    with playback.stopped_by_signals() as stop:
        assert not stop.wait(0.001)
        stop.set()
        assert stop.wait(LONGEST_S)
        assert stop.wait()


@pytest.mark.parametrize("is_spooled", [True, False])
def test_unconfirmed_messages_are_in_the_spool_if_there_is_one(is_spooled: bool) -> None:
    tracker = SimpleNamespace(has_logger=True, wait=lambda timeout_s: 302)
    with pytest.raises(FailureError, match="only 58 of 360 messages were confirmed") as caught:
        playback.confirm(cast("DeliveryTracker", tracker), 360, is_spooled=is_spooled)
    assert str(caught.value).endswith("offers them at the next start") is is_spooled
