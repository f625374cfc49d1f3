"""Presence of the router and of services, as far as one session notices.

A publisher with detection declares a liveliness token beside its key (`KEY/@adv/pub/…`). The router
deletes it when the publisher's connection ends, at once for a killed process and after Zenoh's
lease of 10 s for a frozen one, long before the next `health` is overdue.
"""

from typing import Final

import zenoh
from zenoh import handlers

from schemas.topics import selector

_TOKENS_WAITING: Final = 1_000
_MAX_TOKENS: Final = 1_000
"""Largest number of remembered publishers of `health`."""
_NAME_PART: Final = 4
"""Index of the owner's identifier in the parts of a key."""


def sessions_publishing(session: zenoh.Session, where: str, timeout_s: float) -> int:
    """Return the number of other sessions that publish a key, which should have one publisher."""
    token = f"{where}/@adv/pub/"
    replies = session.liveliness().get(f"{token}**", timeout=timeout_s)
    keys = (str(reply.ok.key_expr) for reply in replies if reply.ok is not None)
    ids = {one.removeprefix(token).partition("/")[0] for one in keys}
    return len(ids - {str(session.info.zid())})


class Presence:
    """Whether a session is connected, and the services whose publishers have left."""

    def __init__(self, session: zenoh.Session, realm: str, stream: str = "health") -> None:
        """Watch the publishers of a stream: `health` of all services, `durable` of loggers."""
        self._session = session
        self._tokens = session.liveliness().declare_subscriber(
            f"{selector(realm, 'service', stream)}/@adv/pub/**",
            handlers.RingChannel(_TOKENS_WAITING),
            history=True,
        )
        self._present: dict[str, set[str]] = {}
        """Tokens of each service, several while a restarted one replaces its last process."""
        self._was_connected = False
        self.lost_s: float | None = None
        """Steady time in s at which the connection was found to be lost; None while it stands."""
        self.gone_s: dict[str, float] = {}
        """Steady time in s at which each absent service was found to have left.

        While the connection is lost, it is not updated. With the next connection it starts empty,
        because services connect again, too.
        """

    def look(self, now_s: float) -> None:
        """Process the changes since the last call."""
        if self._session.info.routers_zid():
            self._was_connected, is_lost = True, False
        else:
            is_lost = self._was_connected  # a router's own session has no router
        if is_lost and self.lost_s is None:
            self.lost_s = now_s
        elif not is_lost and self.lost_s is not None:
            self.lost_s = None
            self.gone_s = dict.fromkeys(self.gone_s, now_s)
        while (token := self._tokens.try_recv()) is not None:
            self._note(str(token.key_expr), now_s, is_there=token.kind == zenoh.SampleKind.PUT)

    @property
    def is_any_there(self) -> bool:
        """Whether any service publishes the stream, as of the last call of `look`."""
        return bool(self._present)

    def close(self) -> None:
        """Stop watching."""
        self._tokens.undeclare()  # type: ignore[no-untyped-call]

    def _note(self, token: str, now_s: float, *, is_there: bool) -> None:
        name = token.split("/")[_NAME_PART]
        tokens = self._present.setdefault(name, set())
        if is_there:
            if sum(map(len, self._present.values())) < _MAX_TOKENS:
                tokens.add(token)
            self.gone_s.pop(name, None)
            return
        tokens.discard(token)
        if not tokens:
            del self._present[name]
            if len(self.gone_s) < _MAX_TOKENS:
                self.gone_s[name] = now_s
