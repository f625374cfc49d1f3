"""Log lines on a router to which nothing connects, for example because clients use another port."""

import logging
import time
from typing import Final

import zenoh

_log = logging.getLogger(__name__)
_PATIENCE_S: Final = 30.0
"""Time without any connection after which a line names the address."""


class FirstConnection:
    """The wait for the first client of a router; for one thread."""

    def __init__(self, bus: zenoh.Session, address: str) -> None:
        """Start to wait."""
        self._bus, self._address = bus, address
        self._warn_at_s = time.monotonic() + _PATIENCE_S
        self._has_warned = self._is_over = False

    def log(self, now_s: float) -> None:
        """Log once that nothing has connected, and once that something has after that."""
        if self._is_over:
            return
        if self._bus.info.transports():
            self._is_over = True
            if self._has_warned:
                _log.info("%s: connected", self._address)
        elif now_s >= self._warn_at_s and not self._has_warned:
            self._has_warned = True
            _log.warning(
                "%s: nothing has connected yet; trucks and worker need this address (--endpoint)",
                self._address,
            )
