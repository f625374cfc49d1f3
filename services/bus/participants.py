"""Participants that a router's access control ignores, seen from both ends of a link.

A router without a rule for a certificate keeps its link and drops all of its messages silently. Its
own process sees which certificates are connected; a publisher sees that nothing subscribes to it.
"""

from collections import Counter
from collections.abc import Set

import zenoh
from zenoh import handlers

from schemas.topics import Key, key, selector
from services.bus.publisher import is_matched

_EVENTS_WAITING = 1_000
"""Queue length for links, more than connect between two calls."""


class UnlistedParticipants:
    """The certificates connected to a router that its access control does not list."""

    def __init__(self, session: zenoh.Session, listed: Set[str]) -> None:
        """Watch the links of a router that admits the common names `listed`."""
        self._listed = listed
        self._links: Counter[str] = Counter()
        self._events = session.info.declare_link_events_listener(
            handlers.RingChannel(_EVENTS_WAITING), history=True
        )

    def arrivals(self) -> list[str]:
        """Return the unlisted common names that have connected since the last call."""
        arrived: dict[str, None] = {}
        while (event := self._events.try_recv()) is not None:
            name = event.link.auth_identifier
            if name is None or name in self._listed:
                continue
            if event.kind == zenoh.SampleKind.PUT:
                self._links[name] += 1
                arrived[name] = None
            elif self._links[name] > 1:
                self._links[name] -= 1
            else:
                del self._links[name]
        return list(arrived)

    @property
    def connected(self) -> list[str]:
        """The unlisted common names that are connected, as of the last call of `arrivals`."""
        return sorted(self._links)

    def close(self) -> None:
        """Stop watching."""
        self._events.undeclare()  # type: ignore[no-untyped-call]


class SubscriberCheck:
    """A check whether anything subscribes to a key of a publisher, with the likely reason if not.

    It needs some 0.1 s after its creation to learn of subscribers.
    """

    def __init__(self, session: zenoh.Session, where: Key) -> None:
        self._session = session
        self._where = where
        self._own = session.declare_publisher(key(*where))
        self._any_realm = session.declare_publisher(selector(None, where.owner, where.stream))

    def complaint(self) -> str | None:
        """Return why nothing subscribes; None if something does, or without a connection."""
        router = next((link.auth_identifier for link in self._session.info.links()), "")
        if router == "" or is_matched(self._own):
            return None
        who, realm = self._where.identifier, self._where.realm
        if is_matched(self._any_realm):
            return f"nothing subscribes to {who} in realm {realm}, only in others (--realm)"
        if router is None:
            return f"nothing subscribes to {who} in realm {realm}; start `driveby logger`"
        is_logger = router.partition("/")[0] == "logger"
        other = "" if is_logger else "no logger is connected to it, or "
        return (
            f"nothing at {router} subscribes to {who}: {other}its list of participants lacks this "
            "certificate, which is new or revoked, see docs/security.md#changes"
        )

    def close(self) -> None:
        """Undeclare the publishers."""
        for publisher in (self._own, self._any_realm):
            publisher.undeclare()  # type: ignore[no-untyped-call]
