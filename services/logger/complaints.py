"""Warnings of which strangers can cause any number: a few of each kind, the rest as a count."""

import logging
import threading
import time
from collections import Counter

_PERIOD_S = 60.0
"""What is beyond the first few of a kind is counted for so long and told in one line."""


class Complaints:
    """Logs at most so many warnings of a kind in a minute; thread-safe.

    Kinds are ours, not of what was received, so that there are few.
    """

    def __init__(self, log: logging.Logger, most: int = 5) -> None:
        self._log = log
        self._most = most
        self._since_s: dict[str, float] = {}
        self._numbers: Counter[str] = Counter()
        self._lock = threading.Lock()

    def warn(self, kind: str, text: str, *arguments: object) -> None:
        """Log a warning, or count it only."""
        with self._lock:
            self._since_s.setdefault(kind, time.monotonic())
            self._numbers[kind] += 1
            is_told = self._numbers[kind] <= self._most
        if is_told:
            self._log.warning(text, *arguments)

    def flush(self, *, closing: bool = False) -> None:
        """Say of kinds whose minute is over how many were counted only, and begin anew."""
        now_s = time.monotonic()
        with self._lock:
            over = [
                kind for kind, at_s in self._since_s.items() if closing or now_s - at_s >= _PERIOD_S
            ]
            untold = {kind: self._numbers.pop(kind) - self._most for kind in over}
            lasted_s = {kind: now_s - self._since_s.pop(kind) for kind in over}
        for kind, number in untold.items():
            if number > 0:
                self._log.warning(
                    "%s: %d more warnings of this kind in %.0f s", kind, number, lasted_s[kind]
                )
