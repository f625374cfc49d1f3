"""Listing of the spools of all trucks, requested at once.

Answers are read and decoded in a thread of their own, because a truck may list thousands of boots
and answer a query any number of times. Several trucks may share a name by mistake: of their answers
for one stream in a round a few count. Bytes per vehicle are limited, and the queue is bounded.
"""

import logging
import threading
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

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
SHARERS = 4
"""Largest number of trucks of one name whose spools are read."""


class SpoolListed(NamedTuple):
    """The answers of one round for one stream."""

    where: Key
    boots: list[SpoolBoot]
    """Contents, oldest boot first."""
    is_shared: bool
    """Whether several trucks of this name have answered, so that none lists all boots."""


class SpoolListing:
    """Rounds of queries; each ends when the next one begins."""

    def __init__(
        self, bus: zenoh.Session, realms: Sequence[str], complaints: RateLimitedLog
    ) -> None:
        self._bus = bus
        self._realms = realms
        self._complaints = complaints
        self._answers: dict[Key, SpoolListed] = {}
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

    def next_answer(self) -> SpoolListed | None:
        """Return the contents of a stream; None if there is no news."""
        with self._lock:
            if not self._answers:
                return None
            return self._answers.pop(next(iter(self._answers)))

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
        read: dict[Key, dict[bytes, list[SpoolBoot]]] = {}
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

    def _read(
        self,
        sample: zenoh.Sample,
        read: dict[Key, dict[bytes, list[SpoolBoot]]],
        sizes: Counter[str],
    ) -> None:
        try:
            where = parse_spool_key(str(sample.key_expr))
            answers = read.setdefault(where, {})
            payload = sample.payload.to_bytes()
            if payload in answers or len(answers) >= SHARERS:
                raise ValueError(f"{where.identifier} answers more than once for {where.stream}")
            answers[payload] = []  # a malformed one counts as well
            sizes[where.identifier] += len(payload)
            if sizes[where.identifier] > _MAX_BYTES:
                raise ValueError(f"{where.identifier} lists more than {_MAX_BYTES} bytes")
            boots = decode_contents(payload)
        except ValueError as error:
            self._complaints.warn("spool contents", "spool contents: %s", error)
            return
        answers[payload] = boots
        merged = {boot.boot_id: boot for one in reversed(answers.values()) for boot in one}
        listed = [merged[boot_id] for boot_id in sorted(merged)]
        is_shared = sum(map(bool, answers.values())) > 1
        with self._lock:
            self._answers[where] = SpoolListed(where, listed, is_shared)
