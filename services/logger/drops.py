"""How many messages were not written, whom they concern, and why."""

import threading
from collections import Counter
from typing import NamedTuple

from schemas.topics import Key

QUEUE_IS_FULL = "found the writer's queue full"
FAILED = "could not be written any more"
_MAX_SOURCES = 100
"""Sources with a count of their own until they are told; what others lose is counted together."""


class Drop(NamedTuple):
    """Messages that were dropped: whom they concern, in which realm the first was, and why."""

    realm: str
    vehicle: str
    why: str
    messages: int


class Drops:
    """Counts, from any thread; takes a bounded amount of memory, as sources can be made up."""

    def __init__(self, realm: str) -> None:
        """`realm` is where causes are told that concern no vehicle."""
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
        """Return how many messages of one vehicle, bridge or service in a realm were dropped."""
        return self._of[(realm, identifier)]

    def untold(self) -> list[Drop]:
        """Return what was counted since the last call."""
        with self._lock:
            untold, self._untold = self._untold, {}
        return list(untold.values())
