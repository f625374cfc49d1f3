"""Publishing recorded messages at their own spacing, and leaving only when they have arrived."""

import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

from schemas.topics import Key
from services.bus.delivery import Delivery
from services.bus.publisher import Publisher
from services.common.errors import EXIT_INTERRUPTED, FailureError, InputError
from services.recordings.recording import Message

_log = logging.getLogger(__name__)
_MAX_IN_FLIGHT = 20_000
"""Far fewer than a logger's queue holds, so that even `--speed 0` cannot overrun it."""
_CHECK_EVERY = 1000
"""So many messages are sent between two looks at what has arrived."""
DELIVERY_TIMEOUT_S = 30.0
"""A logger may have a slow disk; one that is silent for longer has gone."""
GAP_S = 2.0
"""A silence of a recording that is longer is passed over where gaps are skipped."""
_LOOK_S = 0.05
"""How often is looked whether a signal has come, which ends no sleep."""
SETTLE_S = 0.3
"""For the queries that every subscriber sends to a new publisher."""


def check_speed(speed: float) -> float:
    """Return the speed if it is a factor >= 0 (0: as fast as possible), else InputError."""
    if not 0.0 <= speed < float("inf"):
        raise InputError(f"speed {speed}: a factor of 0 or more is expected (0: no waiting)")
    return speed


def play(
    messages: Iterable[Message],
    put: Callable[[Message], None],
    delivery: Delivery,
    *,
    speed: float,
    stop: threading.Event,
    longest_gap_s: float = math.inf,
) -> int:
    """Put the messages with the spacing of their log times divided by `speed`; how many.

    A message whose log time is not later than that of the one before follows at once (recovered
    messages stand late in a recording), and so does one after a silence of the recording of more
    than `longest_gap_s`. Ends early when `stop` is set.
    """
    number = 0
    began: tuple[float, int] | None = None
    latest_ns = 0
    for message in messages:
        now = time.monotonic()
        if began is None or message.log_time_ns - latest_ns > longest_gap_s * 1e9:
            began = (now, message.log_time_ns)
        latest_ns = max(latest_ns, message.log_time_ns)
        if speed > 0.0:
            due = began[0] + (message.log_time_ns - began[1]) * 1e-9 / speed
            if due > now:
                stop.wait(due - now)
        if stop.is_set():
            break
        put(message)
        number += 1
        hold_back(delivery, number)
    return number


def hold_back(delivery: Delivery, number: int) -> None:
    """Wait for the logger, if there is one, where too much of so many messages is under way."""
    if number % _CHECK_EVERY == 0 and delivery.missing() and delivery.has_logger:
        delivery.wait(DELIVERY_TIMEOUT_S, most_missing=_MAX_IN_FLIGHT)


def settle(publisher: Publisher, keys: Iterable[Key], timeout_s: float) -> bool:
    """Declare the publishers of all keys and wait for a subscriber; False if none came in time.

    Only then do the streams begin, so that no subscriber gets the beginning of one stream as
    history and of another one live, in another order.
    """
    first: Key | None = None
    for name in keys:
        publisher.declare(name.owner, name.identifier, name.stream)
        first = first or name
    if first is None:
        return True
    found = publisher.wait_for_subscriber(first.owner, first.identifier, first.stream, timeout_s)
    time.sleep(SETTLE_S)
    return found


def confirm(delivery: Delivery, sent: int) -> None:
    """Wait until a logger has everything on disk; FailureError if it does not get there.

    Without a logger this only gives the subscribers time to fetch what they missed.
    """
    missing = delivery.wait(DELIVERY_TIMEOUT_S)
    if missing and delivery.has_logger:
        raise FailureError(
            f"only {sent - missing} of {sent} messages were confirmed by the logger within "
            f"{DELIVERY_TIMEOUT_S:.0f} s"
        )
    if missing:
        _log.warning("no logger in realm %s: nobody confirmed the messages", delivery.realm)


class _SetBySignal(threading.Event):
    """An event without a lock, so that a signal may set it while its own thread waits for it.

    The lock of the standard one is taken by `wait`; a signal's handler that comes in that moment
    runs in the same thread, waits for the lock in `set`, and the process stands still for ever.
    """

    def __init__(self) -> None:
        super().__init__()
        self._is_set = False

    def is_set(self) -> bool:
        return self._is_set

    def set(self) -> None:
        self._is_set = True

    def clear(self) -> None:
        self._is_set = False

    def wait(self, timeout: float | None = None) -> bool:
        end = None if timeout is None else time.monotonic() + timeout
        while not self._is_set:
            left = _LOOK_S if end is None else min(_LOOK_S, end - time.monotonic())
            if left <= 0.0:
                break
            time.sleep(left)
        return self._is_set


@contextmanager
def stopped_by_signals(
    on_second: Callable[[], None] | None = None,
) -> Iterator[threading.Event]:
    """Give an event that SIGINT and SIGTERM set; see `set_by_signals`."""
    with set_by_signals(signal.SIGINT, signal.SIGTERM, on_second=on_second) as stop:
        yield stop


@contextmanager
def set_by_signals(
    *numbers: signal.Signals, on_second: Callable[[], None] | None = None
) -> Iterator[threading.Event]:
    """Give an event that signals set; the handlers before are put back at the end.

    One that comes while it is set calls `on_second`. In another thread than the main one signals
    are left alone.
    """
    stop = _SetBySignal()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set() and on_second is not None:
            on_second()
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def leave_at_once() -> None:
    """End the process as a second signal wants it: what is on the disk stays as it is."""
    os._exit(EXIT_INTERRUPTED)
