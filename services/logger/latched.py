"""Latched messages, with which every new file of their source begins."""

from collections import OrderedDict
from typing import Final

from schemas.topics import Key, Message
from services.common.intervals import Intervals
from services.logger.file_layout import FileName, belongs_to
from services.recordings.recording import Identities

_MAX_BYTES: Final = 16 << 20
"""Largest size of all messages; beyond, the oldest are omitted."""


class LatchedMessages:
    """The last message of each key."""

    def __init__(self) -> None:
        self._last: OrderedDict[Key, Message] = OrderedDict()
        self._bytes = 0

    def add(self, message: Message) -> None:
        """Keep a message in place of the previous one of its key."""
        before = self._last.pop(message.key, None)
        self._bytes -= len(before.payload) if before is not None else 0
        self._last[message.key] = message
        self._bytes += len(message.payload)
        while self._bytes > _MAX_BYTES:
            _, oldest = self._last.popitem(last=False)
            self._bytes -= len(oldest.payload)

    def of_file(self, name: FileName, without: Key) -> list[Message]:
        """Return the messages that belong to a file, except that of one key."""
        return [m for k, m in self._last.items() if k != without and belongs_to(k, name)]

    def among(self, identities: Identities) -> list[Message]:
        """Return the messages that are among those of a file."""
        return [
            message
            for key, message in self._last.items()
            if message.sequence in identities.get((key, message.boot_id), Intervals())
        ]
