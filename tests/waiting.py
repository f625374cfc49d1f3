"""Waiting for what must come. No test depends on how quick the machine is."""

import time
from collections.abc import Callable

LONGEST_S = 300.0
"""A guard against waiting for ever, not a limit of speed: what takes a second on a quiet machine
took twenty under a load average of 14."""


def until(is_so: Callable[[], object], what: str = "what must come") -> None:
    """Ask again and again until it is so."""
    deadline = time.monotonic() + LONGEST_S
    while not is_so():
        assert time.monotonic() < deadline, f"{what} has not come within {LONGEST_S:.0f} s"
        time.sleep(0.01)
