"""Publication of recorded messages at their original spacing, confirmed before leaving."""

import logging
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

from schemas.topics import Key, Message
from services.bus.delivery import DeliveryTracker
from services.bus.publisher import Publisher
from services.common.errors import EXIT_INTERRUPTED, FailureError, InputError
from services.common.interrupts import handled_by

_log = logging.getLogger(__name__)
_MAX_IN_FLIGHT = 20_000
"""Largest number of unconfirmed messages, far fewer than a logger's queue, even with `--speed 0`.
"""
_CHECK_EVERY = 1000
"""Messages between two checks of what has arrived."""
DELIVERY_TIMEOUT_S = 30.0
"""Longest silence of a logger, which may have a slow disk, before it counts as gone."""
GAP_S = 2.0
"""Longest silence of a recording that is kept where gaps are skipped."""
_SIGNAL_POLL_S = 0.05
"""Interval of checks for a signal, which does not end a sleep."""
SETTLE_S = 0.3
"""Time for the queries that every subscriber sends to a new publisher."""


def check_speed(speed: float) -> float:
    """Return the speed if it is a factor >= 0 (0: as fast as possible); raise InputError if not."""
    if not 0.0 <= speed < float("inf"):
        raise InputError(f"speed {speed}: a factor of 0 or more is expected (0: no waiting)")
    return speed


def publish_paced(
    messages: Iterable[Message],
    put: Callable[[Message], None],
    delivery: DeliveryTracker,
    *,
    speed: float,
    stop: threading.Event,
    longest_gap_s: float = math.inf,
) -> int:
    """Publish messages at their spacing divided by `speed`; return how many.

    A message whose log time is not later than the previous one follows at once (recovered messages
    stand late in a recording), and so does one after a silence longer than `longest_gap_s`. Return
    early when `stop` is set.
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
        apply_backpressure(delivery, number)
    return number


def apply_backpressure(delivery: DeliveryTracker, number: int) -> None:
    """Wait for the logger, if any, while too many of `number` messages are unconfirmed."""
    if number % _CHECK_EVERY == 0 and delivery.missing() and delivery.has_logger:
        delivery.wait(DELIVERY_TIMEOUT_S, most_missing=_MAX_IN_FLIGHT)


def declare_and_wait(publisher: Publisher, keys: Iterable[Key], timeout_s: float) -> bool:
    """Declare the publishers of all keys and wait for a subscriber; return False on timeout.

    Only then do the streams begin, so that no subscriber receives the beginning of one stream as
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


def confirm(
    delivery: DeliveryTracker,
    sent: int,
    complaint: Callable[[], str | None] = lambda: None,
    *,
    is_spooled: bool = False,
) -> None:
    """Wait until a logger has everything on disk; raise FailureError if it fails.

    Without a logger this only gives the subscribers time to fetch missing messages; `complaint`
    returns why there are none, which is a failure too, or None. `is_spooled`: a spool keeps the
    messages.
    """
    missing = delivery.wait(DELIVERY_TIMEOUT_S)
    if missing and delivery.has_logger:
        kept = "; the spool keeps the others and offers them at the next start"
        raise FailureError(
            f"only {sent - missing} of {sent} messages were confirmed by the logger within "
            f"{DELIVERY_TIMEOUT_S:.0f} s{kept if is_spooled else ''}"
        )
    if missing and (why := complaint()) is not None:
        raise FailureError(f"none of {sent} messages was received: {why}")
    if missing:
        _log.warning("no logger in realm %s: delivery was not confirmed", delivery.realm)


class _SetBySignal(threading.Event):
    """An event without a lock, so that a signal may set it while its own thread waits for it.

    The standard event's `wait` takes a lock; a signal handler that runs at that moment in the same
    thread waits for the lock in `set`: a deadlock.
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
            left = _SIGNAL_POLL_S if end is None else min(_SIGNAL_POLL_S, end - time.monotonic())
            if left <= 0.0:
                break
            time.sleep(left)
        return self._is_set


@contextmanager
def stopped_by_signals(
    on_second: Callable[[], None] | None = None,
) -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set; see `set_by_signals`."""
    with set_by_signals(signal.SIGINT, signal.SIGTERM, on_second=on_second) as stop:
        yield stop


@contextmanager
def set_by_signals(
    *numbers: signal.Signals, on_second: Callable[[], None] | None = None
) -> Iterator[threading.Event]:
    """Yield an event that signals set; restore the previous handlers at the end.

    A signal while it is set calls `on_second`. Outside the main thread signals are unchanged.
    """
    stop = _SetBySignal()

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set() and on_second is not None:
            on_second()
        stop.set()

    with handled_by(handle, *numbers):
        yield stop


def leave_at_once() -> None:
    """End the process on a second signal; files keep their current state."""
    os._exit(EXIT_INTERRUPTED)
