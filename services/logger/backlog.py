"""Received messages that are not yet written: a queue bounded by messages and by bytes."""

import threading
from collections import deque

from schemas.topics import Message

QUEUE_MESSAGES = 200_000
"""Limit for messages so small that the limit in bytes would admit millions."""
QUEUE_BYTES = 256 << 20
"""Limit in bytes. At the rated load, 100 trucks, 4,000 messages and 4 MB a second, a disk may stall
for 50 s."""
_RESERVE_MESSAGES = 1000
"""Reserve for messages that must be written because the queue is full."""
_OVERHEAD_BYTES = 500
"""Memory of a message besides its payload."""


class Backlog:
    """A first-in first-out queue between two threads, which never blocks the first one.

    A message does not wake the second thread: at thousands of messages a second that would cost
    more than all other work on them. It polls; `wait` defines how often.
    """

    def __init__(self, messages: int = QUEUE_MESSAGES, size: int = QUEUE_BYTES) -> None:
        self._limit = messages
        self._limit_bytes = size
        self._queue: deque[Message] = deque()
        self._lock = threading.Lock()
        self._woken = threading.Event()
        self._closed = False
        self.bytes = 0
        """Bytes that wait, with what Python needs for them."""

    def __len__(self) -> int:
        return len(self._queue)

    def has_room(self, payload_bytes: int) -> bool:
        """Return whether there is room for one more message."""
        needed = payload_bytes + _OVERHEAD_BYTES
        return len(self._queue) < self._limit and self.bytes + needed <= self._limit_bytes

    def put(self, message: Message, *, always: bool = False) -> bool:
        """Add a message; return False if there is no room. `always` may use a small reserve."""
        with self._lock:
            has_room = self.has_room(len(message.payload))
            if not has_room and not (always and len(self._queue) < self._limit + _RESERVE_MESSAGES):
                return False
            self._queue.append(message)
            self.bytes += len(message.payload) + _OVERHEAD_BYTES
            return True

    def pop(self) -> Message | None:
        """Return the oldest message, or None if there is none."""
        with self._lock:
            if not self._queue:
                return None
            message = self._queue.popleft()
            self.bytes -= len(message.payload) + _OVERHEAD_BYTES
            return message

    def wait(self, timeout_s: float) -> None:
        """Wait for the timeout, or until `wake` or `close`."""
        self._woken.wait(timeout_s)
        self._woken.clear()

    def wake(self) -> None:
        """Let `wait` return at once."""
        self._woken.set()

    def close(self) -> None:
        """Declare that no message will follow."""
        self._closed = True
        self._woken.set()

    @property
    def is_over(self) -> bool:
        """Whether everything has been popped and no message will follow."""
        return self._closed and not self._queue
