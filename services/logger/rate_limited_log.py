"""Rate-limited log: a few warnings of each kind, the rest as a count."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Mapping

_PERIOD_S = 60.0
"""Period of the count of further warnings, which one line reports."""


class RateLimitedLog:
    """A thread-safe log of a limited number of warnings of each kind per minute.

    Kinds are defined by this program, not by received data, so there are few.
    """

    def __init__(self, log: logging.Logger, most: int = 5) -> None:
        self._log = log
        self._most = most
        self._since_s: dict[str, float] = {}
        self._numbers: Counter[str] = Counter()
        self._lock = threading.Lock()

    def warn(
        self, kind: str, text: str, *arguments: object, extra: Mapping[str, str] | None = None
    ) -> None:
        """Log a warning, or only count it; `extra` are its fields (`about`)."""
        with self._lock:
            self._since_s.setdefault(kind, time.monotonic())
            self._numbers[kind] += 1
            is_logged = self._numbers[kind] <= self._most
        if is_logged:
            self._log.warning(text, *arguments, extra=extra)

    def flush(self, *, closing: bool = False) -> None:
        """Log the counts of kinds whose minute is over, and restart these."""
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
