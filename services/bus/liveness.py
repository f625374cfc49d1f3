"""Detection of stale connections.

Zenoh may accept a client that it had cut off into a session that it is about to close
(eclipse-zenoh/zenoh#1886): the connection is up, but never delivers anything. A process that only
listens would mistake that for silence.
"""

from collections.abc import Set
from typing import Any

import zenoh

_SILENCE_S = 20.0
"""Silence before the first question, and time from an answer to the next."""
_ANSWER_S = 5.0
_MISSES = 3
"""Number of unanswered questions in a row that show a stale connection."""


class StaleConnectionError(Exception):
    """A connection that is up and delivers nothing."""


class LivenessProbe:
    """A probe that asks the router, after a silence, for known tokens; for one thread."""

    def __init__(self, session: zenoh.Session, selector: str, there: Set[str]) -> None:
        """Create a probe; `there` holds the known tokens of `selector`, updated by its owner."""
        self._session = session
        self._selector = selector
        self._there = there
        self._heard_s: float | None = None
        self._missed = 0
        self._replies: Any = None

    def heard(self, now_s: float) -> None:
        """Note that a message arrived."""
        self._heard_s, self._missed, self._replies = now_s, 0, None

    def poll(self, now_s: float) -> None:
        """Send a question or read an answer without waiting.

        Raise StaleConnectionError after several questions without answer. Without known tokens or a
        router, nothing is asked.
        """
        if self._heard_s is None or not self._there or not self._session.info.routers_zid():
            self.heard(now_s)
            return
        if self._replies is None:
            if now_s - self._heard_s >= _SILENCE_S:
                self._replies = self._session.liveliness().get(self._selector, timeout=_ANSWER_S)
            return
        try:
            if self._replies.try_recv() is not None:
                self.heard(now_s)
        except zenoh.ZError:  # every token has answered
            self._missed += 1
            self._heard_s, self._replies = now_s, None
            if self._missed == _MISSES:
                raise StaleConnectionError(
                    "the connection is up but delivers nothing: "
                    f"{', '.join(sorted(self._there))} should answer and do not"
                ) from None
