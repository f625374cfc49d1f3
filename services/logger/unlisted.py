"""Log lines and a note of health on certificates that are connected and not listed."""

import logging
import time
from pathlib import Path
from typing import Final

import zenoh

from services.bus.credentials import CONFIGURATION
from services.bus.participants import UnlistedParticipants
from services.bus.session import listed_participants
from services.common.naming import first_of

_log = logging.getLogger(__name__)
_PERIOD_S: Final = 60.0
"""Shortest interval of log lines on one certificate, which may connect repeatedly."""
_MAX_NAMED: Final = 1_000
"""Number of certificates with remembered log lines; beyond, all are forgotten."""
_MAX_NOTED: Final = 3


class UnlistedLog:
    """A log of the certificates whose messages the access control drops; for one thread."""

    def __init__(self, bus: zenoh.Session, tls: Path | None) -> None:
        """Watch a router; without credentials it admits everything, and there is nothing to log."""
        self._tls = tls
        self._logged_s: dict[str, float] = {}
        self._watch = None if tls is None else UnlistedParticipants(bus, listed_participants(tls))

    def log_arrivals(self) -> None:
        """Log a line for each unlisted certificate that has connected since the last call."""
        if self._watch is None or self._tls is None:
            return
        now_s = time.monotonic()
        for name in self._watch.arrivals():
            if now_s < self._logged_s.get(name, float("-inf")) + _PERIOD_S:
                continue
            if len(self._logged_s) >= _MAX_NAMED:
                self._logged_s.clear()
            self._logged_s[name] = now_s
            _log.warning(
                "%s is connected and not listed in %s: dropping all of its messages; unless "
                "it is revoked, copy the list of `driveby certs` there and restart "
                "(docs/security.md#changes)",
                *(name, self._tls / CONFIGURATION),
            )

    @property
    def note(self) -> str:
        """Names of unlisted certificates that are connected, for `health`; empty without any."""
        names = [] if self._watch is None else self._watch.connected
        return f"connected and not listed: {first_of(names, _MAX_NOTED)}" if names else ""

    def close(self) -> None:
        """Stop watching."""
        if self._watch is not None:
            self._watch.close()
