"""The truck's lines when its router or logger leaves during a drive, and when it is back."""

from enum import Enum

import zenoh

from services.bus.presence import Presence

_GRACE_S = 1.0
"""Time for which a peer may be absent without a line, as while a link is renewed."""


class _Peer(Enum):
    """Peer that is absent, in the words of a line."""

    ROUTER = "connection to the router lost"
    LOGGER = "the logger has left"


class LoggerWatch:
    """Whether the realm's logger is there, once it was; a line at each change.

    Before a first logger there is no line: other checks report why nothing subscribes.
    """

    def __init__(self, session: zenoh.Session, realm: str) -> None:
        self._presence = Presence(session, realm, "durable")
        self._was_there = False
        self._absent_s: float | None = None
        """Steady time in s since which the logger is absent; None while it is there."""
        self._reported: _Peer | None = None

    def news(self, now_s: float) -> str | None:
        """Return a line on what has changed; None if nothing has."""
        self._presence.look(now_s)
        is_lost = self._presence.lost_s is not None
        if not is_lost and self._presence.is_any_there:
            was, self._reported, self._absent_s = self._reported, None, None
            self._was_there = True
            return None if was is None else "the logger is back and requests what it lacks"
        if not self._was_there:
            return None
        if self._absent_s is None:
            self._absent_s = now_s
        if self._reported is not None or now_s < self._absent_s + _GRACE_S:
            return None
        self._reported = _Peer.ROUTER if is_lost else _Peer.LOGGER
        return f"{self._reported.value}; the spool keeps all messages until it is back"

    @property
    def is_absent(self) -> bool:
        """Whether the last line reported an absence."""
        return self._reported is not None

    def close(self) -> None:
        """Stop watching."""
        self._presence.close()
