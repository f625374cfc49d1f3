"""Whether a connection that stands still brings anything.

Zenoh may take a client back, after it had cut it off, into a session that it is about to close
(eclipse-zenoh/zenoh#1886): the connection stands, and nothing comes through it ever after. Who only
listens takes that for silence.
"""

from collections.abc import Set
from typing import Any

import zenoh

_SILENCE_S = 20.0
"""After so long without a message it is asked who is there, and so long after an answer again."""
_ANSWER_S = 5.0
_MISSES = 3
"""So many questions in a row without any answer are no accident."""


class DeafError(Exception):
    """The connection stands and brings nothing."""


class Hearing:
    """Asks the router, after a silence, for who is known to be there; from one thread."""

    def __init__(self, session: zenoh.Session, selector: str, there: Set[str]) -> None:
        """`selector` is of the tokens; `there` is who has one now, as far as its owner knows."""
        self._session = session
        self._selector = selector
        self._there = there
        self._heard_s: float | None = None
        self._missed = 0
        self._replies: Any = None

    def heard(self, now_s: float) -> None:
        """Something came."""
        self._heard_s, self._missed, self._replies = now_s, 0, None

    def look(self, now_s: float) -> None:
        """Ask or read an answer, without waiting. DeafError: none has come to several questions.

        Where nobody is known to be there, or no router either, nothing is asked.
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
        except zenoh.ZError:  # all that would answer have
            self._missed += 1
            self._heard_s, self._replies = now_s, None
            if self._missed == _MISSES:
                raise DeafError(
                    "the connection stands, but nothing comes through it: "
                    f"{', '.join(sorted(self._there))} should be there, and nobody answers"
                ) from None
