"""A queue from a thread that must never wait to a worker: bounded in messages and bytes.

A new item displaces the oldest ones, which are counted. Zenoh's own ring counts messages only, so a
hostile sender with messages of 10 MB could fill the memory.
"""

import threading
from collections import deque
from typing import Generic, NamedTuple, TypeVar

ItemT = TypeVar("ItemT")


class DroppedItems(NamedTuple):
    """Items that were displaced or too large."""

    messages: int
    size_bytes: int


class BoundedQueue(Generic[ItemT]):
    """A thread-safe queue of items in the order of their arrival."""

    def __init__(self, most_messages: int, most_bytes: int) -> None:
        self._most_messages = most_messages
        self._most_bytes = most_bytes
        self._items: deque[tuple[ItemT, int]] = deque()
        self._waiting_bytes = 0
        self._dropped = DroppedItems(0, 0)
        self._lock = threading.Lock()

    def put(self, item: ItemT, size_bytes: int) -> None:
        """Append an item; an item larger than the whole queue is dropped itself."""
        with self._lock:
            if size_bytes > self._most_bytes:
                self._drop(size_bytes)
                return
            self._items.append((item, size_bytes))
            self._waiting_bytes += size_bytes
            while len(self._items) > self._most_messages or self._waiting_bytes > self._most_bytes:
                _, oldest_bytes = self._items.popleft()
                self._waiting_bytes -= oldest_bytes
                self._drop(oldest_bytes)

    def get(self) -> ItemT | None:
        """Return the oldest item, or None if the queue is empty."""
        with self._lock:
            if not self._items:
                return None
            item, size_bytes = self._items.popleft()
            self._waiting_bytes -= size_bytes
            return item

    def dropped(self) -> DroppedItems:
        """Return the items dropped since the last call."""
        with self._lock:
            dropped, self._dropped = self._dropped, DroppedItems(0, 0)
            return dropped

    def __len__(self) -> int:
        return len(self._items)

    def _drop(self, size_bytes: int) -> None:
        messages, before_bytes = self._dropped
        self._dropped = DroppedItems(messages + 1, before_bytes + size_bytes)
