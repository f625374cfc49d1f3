"""Subscribers that request missing messages.

A subscriber requests the history of every publisher that it meets and every missing number. That
alone loses a gap now and then when router and subscriber die together, so a thread requests every
lasting gap once more. Duplicates are identified by their identity; a subscriber that must not see
any uses `SeenSequences`.
"""

import logging
import queue
import threading
import time
from collections.abc import Iterator
from types import TracebackType
from typing import NamedTuple, Self

import zenoh
from zenoh import ext, handlers

from schemas.signals import Identity, decode_identity
from schemas.topics import MAX_KEY_CHARACTERS, TOPICS, Key, parse_key
from services.common.intervals import Intervals

_log = logging.getLogger(__name__)
_IDLE_POLL_S = 0.005
"""Interval of polling, because Zenoh cannot wake a thread that also waits for something else."""
_GAP_PATIENCE_S = 0.5
"""Age of a gap before it is requested again."""
_GAP_TRIES = 3
"""Number of requests after which a message is no longer in the publisher's cache."""
_GAP_QUERY_TIMEOUT_S = 5.0
"""Timeout for a publisher that answers over a mobile network."""
_MAX_GAPS_PER_ROUND = 100
"""Gaps requested in one round; the others follow in the next."""
_MAX_GAPS_PER_SOURCE = 10_000
"""Largest number of gaps noted for a publisher, because a hostile one could invent any number."""
_MAX_SOURCES = 10_000
"""Largest number of publishers noted."""
_SourceName = tuple[str, zenoh.ZenohId, int]
"""A key and a Zenoh publisher: session and number in it."""


class RawSample(NamedTuple):
    """A message from the bus, before any check.

    `key_text` may be any key, `attachment` may be missing: see `checked`.
    """

    key_text: str
    payload: bytes
    attachment: bytes | None
    recovered: bool
    """Whether it was missing and has been requested."""
    spooled: bool = False
    """Whether it came from the truck's own disk: there is no better copy."""

    def identity(self) -> Identity:
        """Return (boot_id, sequence); raise ValueError if the attachment is missing or bad."""
        return decode_identity(self.attachment)

    def key(self) -> Key:
        """Return the parts of the key; raise ValueError if it is not in the topic table."""
        return parse_key(self.key_text)


class Subscription:
    """A receiver of all messages under a key expression, old ones of living publishers first.

    A message may come twice (after a reconnection) and recovered ones come late: `SeenSequences`
    detects duplicates, and the sequence orders a stream. One thread receives.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key_expression: str,
        *,
        capacity: int | None = None,
    ) -> None:
        """Subscribe; `capacity` messages may wait (default: the largest of the topic table).

        More would block the publishers, and after a second the router cuts the connection: receive
        quickly and do long work in another thread.
        """
        self._session = session
        self._fetched: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._sources: dict[_SourceName, _PublisherGaps] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self.fetched = 0
        """Messages that the gap query brought."""
        self._subscriber = ext.declare_advanced_subscriber(
            session,
            key_expression,
            handlers.FifoChannel(capacity or max(row.queue for row in TOPICS)),
            history=ext.HistoryConfig(detect_late_publishers=True),
            recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        self._handler = self._subscriber.handler
        self._filler = threading.Thread(target=self._fill_gaps, name="gap-fill", daemon=True)
        self._filler.start()

    def receive(self, timeout_s: float = 0.0) -> RawSample | None:
        """Return the next message, or None after `timeout_s`."""
        received = self._next()
        if received is not None or timeout_s <= 0:
            return received
        deadline = time.monotonic() + timeout_s
        while received is None and (left_s := deadline - time.monotonic()) > 0:
            time.sleep(min(_IDLE_POLL_S, left_s))
            received = self._next()
        return received

    def close(self) -> None:
        """Stop receiving; `receive` still returns messages that have already arrived."""
        if not self._closing.is_set():
            self._closing.set()
            self._filler.join()
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _next(self) -> RawSample | None:
        try:
            sample = self._handler.try_recv()
        except zenoh.ZError:  # closed and empty
            sample = None
        recovered = False
        if sample is None:
            if self._fetched.empty():
                return None
            sample, recovered = self._fetched.get(), True
            self.fetched += 1
        where = str(sample.key_expr)
        self._note(where, sample)
        attachment = sample.attachment
        return RawSample(
            where,
            sample.payload.to_bytes(),
            None if attachment is None else attachment.to_bytes(),
            recovered,
        )

    def _note(self, where: str, sample: zenoh.Sample) -> None:
        """Record the publisher's own number of the sample, which reveals gaps."""
        source = sample.source_info
        if source is None:
            return
        name = (where, source.source_id.zid, source.source_id.eid)
        with self._lock:
            found = self._sources.get(name)
            if found is None:
                if len(where) > MAX_KEY_CHARACTERS:
                    return
                if len(self._sources) >= _MAX_SOURCES:
                    # The oldest: a publisher that is gone, or a hostile one that invents names.
                    del self._sources[next(iter(self._sources))]
                found = self._sources[name] = _PublisherGaps()
            if found.numbers.runs < _MAX_GAPS_PER_SOURCE:
                found.numbers.add(source.source_sn)

    def _fill_gaps(self) -> None:
        while not self._closing.wait(_GAP_PATIENCE_S):
            for name, gap in self._due_gaps():
                if self._closing.is_set():
                    return
                try:
                    self._fetch(name, gap)
                except zenoh.ZError as error:  # the session is closing or the router gone
                    _log.debug("gap query for %s: %s", name[0], error)

    def _due_gaps(self) -> list[tuple[_SourceName, tuple[int, int]]]:
        """Return gaps that have lasted a round and were not requested too often."""
        due = []
        with self._lock:
            for name, source in self._sources.items():
                gaps = source.numbers.gaps_from_zero()
                tries = {gap: source.tries.get(gap, -1) + 1 for gap in gaps}
                source.tries = tries
                due += [(name, gap) for gap, n in tries.items() if 0 < n <= _GAP_TRIES]
        return due[:_MAX_GAPS_PER_ROUND]

    def _fetch(self, name: _SourceName, gap: tuple[int, int]) -> None:
        where, zid, eid = name
        replies = self._session.get(
            f"{where}/@adv/pub/{zid}/{eid}/**?_sn={gap[0]}..{gap[1]}",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_GAP_QUERY_TIMEOUT_S,
        )
        for reply in replies:
            sample = reply.ok
            if sample is not None:
                self._fetched.put(sample)


class SeenSequences:
    """The identities of received messages; its memory grows with gaps, not with time."""

    def __init__(self) -> None:
        self.streams: dict[tuple[Key, int], Intervals] = {}
        """Received sequences by (key, boot_id)."""

    def add(self, where: Key, identity: Identity) -> bool:
        """Add a message; return False if it was present."""
        return self.numbers(where, identity.boot_id).add(identity.sequence)

    def numbers(self, where: Key, boot_id: int) -> Intervals:
        """Return the received sequences of a key and boot, to be added to."""
        name = (where, boot_id)
        numbers = self.streams.get(name)
        if numbers is None:
            numbers = self.streams[name] = Intervals()
        return numbers


def subscribe_latest(
    session: zenoh.Session, key_expression: str, capacity: int = 100, past: int = 1
) -> Iterator[RawSample | None]:
    """Yield the newest messages for a live display, and None while there are none.

    It never blocks a publisher: of more than `capacity` waiting messages the oldest are dropped.
    The last `past` messages that each publisher still keeps come first. The consumer decides how
    long to sleep on None; closing the generator ends the subscription.
    """
    subscriber = ext.declare_advanced_subscriber(
        session,
        key_expression,
        handlers.RingChannel(capacity),
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=past),
    )
    try:
        while True:
            sample = subscriber.try_recv()
            if sample is None:
                yield None
                continue
            attachment = sample.attachment
            yield RawSample(
                str(sample.key_expr),
                sample.payload.to_bytes(),
                None if attachment is None else attachment.to_bytes(),
                False,
            )
    finally:
        subscriber.undeclare()  # type: ignore[no-untyped-call]


class _PublisherGaps:
    """The received numbers of one Zenoh publisher, and the requests for its gaps."""

    def __init__(self) -> None:
        self.numbers = Intervals()
        self.tries: dict[tuple[int, int], int] = {}
