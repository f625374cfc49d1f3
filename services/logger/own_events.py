"""Events of the logger itself, with one numbering for all of its threads."""

import threading
from collections import Counter

from schemas.events import Event, encode_event
from schemas.topics import Key, Message


class OwnEvents:
    """A source of messages of the topic `event` with identities of this boot of the logger."""

    def __init__(self, service_id: str, boot_id: int) -> None:
        self.service_id = service_id
        self.boot_id = boot_id
        self._numbers: Counter[str] = Counter()
        self._lock = threading.Lock()

    def message(self, realm: str, event: Event) -> Message:
        """Return the event as a message of a realm, with the next number there."""
        with self._lock:
            number = self._numbers[realm]
            self._numbers[realm] += 1
        where = Key(realm, "service", self.service_id, "event")
        return Message(
            where, encode_event(event), self.boot_id, number, event.time_ns, event.time_ns
        )
