"""Signal handlers for the time of a block, and steps that an interrupt must not separate."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

SignalHandler = Callable[[int, FrameType | None], object]


@contextlib.contextmanager
def handled_by(handler: SignalHandler, *numbers: signal.Signals) -> Iterator[None]:
    """Let `handler` receive signals; restore the previous handlers at the end.

    Outside the main thread, which alone may set handlers, signals are unchanged.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold SIGINT and SIGTERM back for the moments of a block, and deliver them at its end."""
    held: list[int] = []
    try:
        with handled_by(lambda number, _: held.append(number), signal.SIGINT, signal.SIGTERM):
            yield
    finally:
        for number in held:
            signal.raise_signal(number)
