"""Listing of the spools of all trucks, requested at once.

Answers are read and decoded in a thread of their own, because a truck may list thousands of boots
and answer a query any number of times. In each round only each stream's first answer counts, bytes
per vehicle are limited, and the queue is bounded.
"""

import logging
import threading
from collections import Counter
from collections.abc import Sequence
from typing import Any

import zenoh
from zenoh import handlers

from schemas.spool import SpoolBoot, decode_contents, parse_spool_key, spool_selector
from schemas.topics import Key
from services.logger.rate_limited_log import RateLimitedLog

_log = logging.getLogger(__name__)
_TIMEOUT_S = 1.5
"""Timeout of a round, after which trucks are asked again in the next, every two seconds."""
_PAUSE_S = 0.005
"""Interval of polling for answers."""
_REPLIES_WAITING = 200
"""Capacity for unread answers before the bus blocks others."""
_MAX_BYTES = 1 << 20
"""Largest answer of one vehicle in one round; 10,000 ranges take a sixth of it."""


class SpoolListing:
    """Rounds of queries; each ends when the next one begins."""

    def __init__(
        self, bus: zenoh.Session, realms: Sequence[str], complaints: RateLimitedLog
    ) -> None:
        self._bus = bus
        self._realms = realms
        self._complaints = complaints
        self._answers: dict[Key, list[SpoolBoot]] = {}
        self._lock = threading.Lock()
        self._is_over = threading.Event()
        """Set when the round that is going on is to end, each round having its own."""
        self._thread: threading.Thread | None = None

    def ask(self) -> None:
        """Begin a round; trucks without an answer in the previous one are asked again."""
        self._is_over.set()
        self._is_over = threading.Event()
        self._thread = threading.Thread(
            target=self._ask_all, args=(self._is_over,), name="spools", daemon=True
        )
        self._thread.start()

    def next_answer(self) -> tuple[Key, list[SpoolBoot]] | None:
        """Return a truck's contents of a stream, oldest boot first; None if there is no news."""
        with self._lock:
            if not self._answers:
                return None
            where = next(iter(self._answers))
            return where, self._answers.pop(where)

    def close(self) -> None:
        """Stop all queries."""
        self._is_over.set()
        if self._thread is not None:
            self._thread.join()

    def _ask_all(self, is_over: threading.Event) -> None:
        try:
            listings = [self._query(realm) for realm in self._realms]
        except zenoh.ZError as error:  # the session is closing
            _log.debug("spool query: %s", error)
            return
        read: set[Key] = set()
        sizes: Counter[str] = Counter()
        while listings and not is_over.is_set():
            is_idle = True
            for listing in list(listings):
                try:
                    reply = listing.try_recv()
                except zenoh.ZError:  # all have answered, or the time is over
                    listings.remove(listing)
                    continue
                if reply is not None:
                    is_idle = False
                    if reply.ok is not None:
                        self._read(reply.ok, read, sizes)
            if is_idle:
                is_over.wait(_PAUSE_S)

    def _query(self, realm: str) -> Any:
        return self._bus.get(
            spool_selector(realm),
            handlers.FifoChannel(_REPLIES_WAITING),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=_TIMEOUT_S,
        )

    def _read(self, sample: zenoh.Sample, read: set[Key], sizes: Counter[str]) -> None:
        try:
            where = parse_spool_key(str(sample.key_expr))
            if where in read:
                raise ValueError(f"{where.identifier} answers more than once for {where.stream}")
            read.add(where)
            size = len(sample.payload)
            sizes[where.identifier] += size
            if sizes[where.identifier] > _MAX_BYTES:
                raise ValueError(f"{where.identifier} lists more than {_MAX_BYTES} bytes")
            boots = decode_contents(sample.payload.to_bytes())
        except ValueError as error:
            self._complaints.warn("spool contents", "spool contents: %s", error)
            return
        with self._lock:
            self._answers[where] = boots
