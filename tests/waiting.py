"""Waiting for what must come. No test depends on how quick the machine is."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LONGEST_S = 300.0
"""A guard against waiting for ever, not a limit of speed: what takes a second on a quiet machine
took twenty under a load average of 14."""


def until(is_so: Callable[[], object], what: str = "what must come") -> None:
    """Ask again and again until it is so."""
    deadline = time.monotonic() + LONGEST_S
    while not is_so():
        assert time.monotonic() < deadline, f"{what} has not come within {LONGEST_S:.0f} s"
        time.sleep(0.01)


@contextmanager
def hesitation() -> Iterator[Callable[[], float]]:
    """Give what returns for how many seconds, at most, a thread of this process woke too late.

    A limit of a delay that another process causes is no less than some times that.
    """
    latest_s = 0.0
    is_over = threading.Event()

    def sleep() -> None:
        nonlocal latest_s
        while not is_over.is_set():
            due_s = time.monotonic() + 0.01
            is_over.wait(0.01)
            latest_s = max(latest_s, time.monotonic() - due_s)

    thread = threading.Thread(target=sleep, name="hesitation", daemon=True)
    thread.start()
    try:
        yield lambda: latest_s
    finally:
        is_over.set()
        thread.join()
