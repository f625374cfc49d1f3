"""Confirmation that published messages have arrived.

A put returns when Zenoh has accepted it, no more. Loggers publish on `durable` how many messages of
each stream and boot are on their disk, after fsync: `DeliveryTracker` waits for that. Without an
answer from a logger, `LINGER_S` leaves subscribers the time for two announcements and the resulting
queries.
"""

import logging
import threading
import time
from collections import Counter
from typing import Any, NamedTuple

import zenoh
from zenoh import ext, handlers

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.signals import Identity
from schemas.topics import Key, parse_key, selector

_log = logging.getLogger(__name__)
_POLL_S = 0.005
"""Interval of polling for messages of loggers."""
LINGER_S = 1.5
"""Duration of two heartbeats and of the queries that they cause."""
_DURABLES_WAITING = 100
"""Queue length, more than there are loggers in a realm."""


class DeliveryTracker:
    """Tracker of messages on the disks of a realm's loggers, after which a publisher may leave."""

    def __init__(self, session: zenoh.Session | None, realm: str) -> None:
        """Follow the loggers of a realm; without a session, from `connect` on."""
        self.realm = realm
        self._sent: Counter[tuple[str, str, str, int]] = Counter()
        self._durable: dict[str, dict[tuple[str, str, str, int], _OnDisk]] = {}
        self._lock = threading.Lock()
        self._subscriber: ext.AdvancedSubscriber[Any] | None = None
        if session is not None:
            self.connect(session)

    def connect(self, session: zenoh.Session) -> None:
        """Listen from now on, including each logger's last message."""
        # Each message is complete: of many unread ones the last few are enough.
        self._subscriber = ext.declare_advanced_subscriber(
            session,
            selector(self.realm, "service", "durable"),
            handlers.RingChannel(_DURABLES_WAITING),
            history=ext.HistoryConfig(detect_late_publishers=True),
            recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )

    def sent(self, where: Key, identity: Identity) -> None:
        """Count a published message, each identity once."""
        self._sent[(where.owner, where.identifier, where.stream, identity.boot_id)] += 1

    @property
    def has_logger(self) -> bool:
        """Whether any logger has published yet."""
        return bool(self._durable)

    def missing(self) -> int:
        """Return the number of sent messages that the most complete logger does not have yet."""
        self._read()
        by_logger = [
            sum(
                max(0, number - durable.get(name, _OnDisk(0, -1)).messages)
                for name, number in self._sent.items()
            )
            for durable in self._durable.values()
        ]
        return min(by_logger, default=self._sent.total())

    def wait(self, timeout_s: float, most_missing: int = 0) -> int:
        """Wait until at most `most_missing` messages are not on disk; return how many are not.

        Without a message from a logger within `LINGER_S` the wait ends: subscribers have had the
        time to request missing messages.
        """
        began = time.monotonic()
        while (missing := self.missing()) > most_missing:
            waited_s = time.monotonic() - began
            if waited_s >= timeout_s or (waited_s >= LINGER_S and not self.has_logger):
                break
            time.sleep(_POLL_S)
        return missing

    def confirmed(self, vehicle: str) -> dict[tuple[str, int], int]:
        """Return the last sequence that a logger has without gap, by (stream, boot_id)."""
        self._read()
        highest: dict[tuple[str, int], int] = {}
        for durable in self._durable.values():
            for (owner, identifier, stream, boot_id), on_disk in durable.items():
                if (owner, identifier) == ("vehicle", vehicle) and on_disk.sequence >= 0:
                    name = (stream, boot_id)
                    highest[name] = max(highest.get(name, -1), on_disk.sequence)
        return highest

    def close(self) -> None:
        """Stop following."""
        if self._subscriber is not None:
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _read(self) -> None:
        if self._subscriber is None:
            return
        with self._lock:
            newest: dict[str, bytes] = {}
            while (sample := self._subscriber.try_recv()) is not None:
                newest[str(sample.key_expr)] = sample.payload.to_bytes()  # each is complete
            for where, payload in newest.items():
                try:
                    message = decode("driveby.v1.Durable", payload)
                    service = parse_key(where).identifier
                except ValueError as error:
                    _log.warning("durable: %s", error)
                    continue
                if isinstance(message, pb.Durable):
                    self._durable[service] = {
                        (s.owner, s.identifier, s.stream, s.boot_id): _OnDisk(
                            s.count, s.sequence if s.HasField("sequence") else -1
                        )
                        for s in message.streams
                    }


class _OnDisk(NamedTuple):
    messages: int
    sequence: int
    """The highest sequence without a gap below it; -1: none."""
