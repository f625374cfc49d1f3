"""Publishers that keep their last messages.

They block instead of dropping, keep as many messages as the topic table requires and announce the
number of the last one twice a second, so that a subscriber can request missing ones.
"""

import threading
import time
from collections import Counter
from typing import Any

import zenoh
from zenoh import ext, handlers

from schemas.signals import Identity, encode_identity
from schemas.topics import key, parse_key, topic

_HEARTBEAT_S = 0.5
"""Longest delay until a subscriber notices that it missed the last message."""
_POLL_S = 0.005
"""Interval of polling for a subscriber."""
_QUERIES_WAITING = 100
"""Queue length for queries of latched messages, which are answered at once."""


class Publisher:
    """A publisher of the topic table's messages in one realm, each with its identity.

    A Zenoh publisher is declared at the first put to a key and kept until `close()`. Thread-safe.
    """

    def __init__(
        self, session: zenoh.Session | None, realm: str, boot_id: int | None = None
    ) -> None:
        """Publish through a session; with None, nothing can be put before `connect`."""
        self.realm = realm
        self.boot_id = time.time_ns() if boot_id is None else boot_id
        """The start of this process unless given: higher after every restart."""
        self._opened = session
        self._publishers: dict[str, ext.AdvancedPublisher] = {}
        self._next_sequence: Counter[str] = Counter()
        self._latest: dict[str, tuple[bytes, bytes]] = {}
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._answering: list[threading.Thread] = []
        self._lock = threading.Lock()

    def put(
        self,
        owner: str,
        identifier: str,
        stream: str,
        payload: bytes,
        identity: Identity | None = None,
    ) -> Identity:
        """Publish one message and return its identity.

        Without `identity` it gets this publisher's boot_id and the next sequence of its key, from
        0. Block while the connection is congested. The last message of a latched topic is kept for
        late subscribers and answers `session.get(key)`. Raise ValueError if the key is not in the
        table or the payload larger than it allows.
        """
        where = key(self.realm, owner, identifier, stream)
        row = topic(owner, stream)
        if not row.message or len(payload) > row.max_bytes:
            raise ValueError(f"{where}: {len(payload)} bytes; at most {row.max_bytes}")
        with self._lock:
            if identity is None:
                identity = Identity(self.boot_id, self._next_sequence[where])
                self._next_sequence[where] += 1
            attachment = encode_identity(*identity)
            publisher = self._declare(where)
            if row.latched:
                self._latest[where] = (payload, attachment)
            # Inside the lock, otherwise two threads could send two messages in the wrong order.
            publisher.put(payload, attachment=attachment)
        return identity

    def connect(self, session: zenoh.Session) -> None:
        """Provide the session of a publisher that was created without one."""
        self._opened = session

    @property
    def _session(self) -> zenoh.Session:
        if self._opened is None:
            raise RuntimeError("the publisher has no session yet")
        return self._opened

    def declare(self, owner: str, identifier: str, stream: str) -> None:
        """Declare the publisher of a key before its first message.

        Subscribers ask a new publisher for its history; doing so before the data flow keeps the
        streams of one truck synchronous from the first message.
        """
        with self._lock:
            self._declare(key(self.realm, owner, identifier, stream))

    def wait_for_subscriber(
        self, owner: str, identifier: str, stream: str, timeout_s: float
    ) -> bool:
        """Wait for a subscriber to a key; return False on timeout."""
        probe = self._session.declare_publisher(key(self.realm, owner, identifier, stream))
        try:
            deadline = time.monotonic() + timeout_s
            while not is_matched(probe):
                if time.monotonic() >= deadline:
                    return False
                time.sleep(_POLL_S)
            return True
        finally:
            probe.undeclare()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Undeclare all; messages that were not fetched are lost (see `DeliveryTracker`)."""
        with self._lock:
            for queryable in self._queryables:
                queryable.undeclare()  # type: ignore[no-untyped-call]
            for thread in self._answering:
                thread.join()
            for publisher in self._publishers.values():
                publisher.undeclare()  # type: ignore[no-untyped-call]
            self._queryables.clear()
            self._publishers.clear()

    def _declare(self, where: str) -> ext.AdvancedPublisher:
        publisher = self._publishers.get(where)
        if publisher is None:
            parsed = parse_key(where)
            row = topic(parsed.owner, parsed.stream)
            publisher = self._publishers[where] = _declare_publisher(self._session, where)
            if row.latched:
                self._answer_queries(where)
        return publisher

    def _answer_queries(self, where: str) -> None:
        # A thread of our own: one of Zenoh's that calls Python while the interpreter ends
        # would crash the process.
        queryable = self._session.declare_queryable(
            where, handlers.FifoChannel(_QUERIES_WAITING), complete=True
        )
        thread = threading.Thread(
            target=self._answer, args=(where, queryable.handler), name="answer", daemon=True
        )
        thread.start()
        self._queryables.append(queryable)
        self._answering.append(thread)

    def _answer(self, where: str, queries: handlers.Handler[zenoh.Query]) -> None:
        while True:
            try:
                query = queries.recv()
            except zenoh.ZError:  # undeclared
                return
            latest = self._latest.get(where)
            with query:
                if latest is not None:
                    query.reply(where, latest[0], attachment=latest[1])


def _declare_publisher(session: zenoh.Session, where: str) -> ext.AdvancedPublisher:
    parsed = parse_key(where)
    row = topic(parsed.owner, parsed.stream)
    reliable = row.delivery == "reliable"
    block, drop = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
    return ext.declare_advanced_publisher(
        session,
        where,
        encoding=zenoh.Encoding("application/protobuf").with_schema(row.message),
        congestion_control=block if reliable else drop,
        reliability=zenoh.Reliability.RELIABLE,
        cache=ext.CacheConfig(
            row.cache, replies_config=ext.RepliesConfig(congestion_control=block)
        ),
        sample_miss_detection=ext.MissDetectionConfig(
            heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
        ),
        publisher_detection=True,
    )


def is_matched(publisher: zenoh.Publisher) -> bool:
    """Return whether anything subscribes to the key of a publisher."""
    # An object with a flag, which is always true itself; the type stubs call it a bool.
    status: Any = publisher.matching_status
    return bool(getattr(status, "matching", status))
