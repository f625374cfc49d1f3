"""Counts of messages that were not written, by source and cause."""

import threading
from collections import Counter
from typing import NamedTuple

from schemas.topics import Key

QUEUE_IS_FULL = "found the writer's queue full"
FAILED = "could not be written any more"
_MAX_SOURCES = 100
"""Largest number of sources with a count of their own in a report; others are counted together."""


class Drop(NamedTuple):
    """Dropped messages of one source and cause, with the realm of the first."""

    realm: str
    vehicle: str
    why: str
    messages: int


class Drops:
    """Thread-safe counts in bounded memory, because sources can be invented."""

    def __init__(self, realm: str) -> None:
        """Create counts; `realm` is that of causes without a vehicle."""
        self.total = 0
        self._realm = realm
        self._of: Counter[tuple[str, str]] = Counter()
        self._untold: dict[tuple[str, str], Drop] = {}
        self._lock = threading.Lock()

    def count(self, where: Key | None, why: str) -> None:
        """Count a message that is not written."""
        realm, vehicle = self._realm, ""
        if where is not None and where.owner == "vehicle" and why != QUEUE_IS_FULL:
            realm, vehicle = where.realm, where.identifier
        with self._lock:
            self.total += 1
            if (vehicle, why) not in self._untold and len(self._untold) >= _MAX_SOURCES:
                realm, vehicle = self._realm, ""
            before = self._untold.get((vehicle, why), Drop(realm, vehicle, why, 0))
            self._untold[(vehicle, why)] = before._replace(messages=before.messages + 1)
            if where is not None:
                self._of[(where.realm, where.identifier)] += 1

    def of(self, realm: str, identifier: str) -> int:
        """Return the number of dropped messages of a vehicle, bridge or service in a realm."""
        return self._of[(realm, identifier)]

    def drain(self) -> list[Drop]:
        """Return the counts since the last call."""
        with self._lock:
            untold, self._untold = self._untold, {}
        return list(untold.values())
