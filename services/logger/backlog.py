"""What has come and is not yet written: a queue bounded by messages and by bytes."""

import threading
from collections import deque

from services.recordings.recording import Message

QUEUE_MESSAGES = 200_000
"""A bound for messages that are so small that the one in bytes would let in millions."""
QUEUE_BYTES = 256 << 20
"""At the rated load, 100 trucks, 4,000 messages and 4 MB a second: a disk may stall for 50 s."""
_RESERVE_MESSAGES = 1000
"""For what must be written down because the queue is full."""
_OVERHEAD_BYTES = 500
"""What Python takes for a message besides its payload."""


class Backlog:
    """A first-in first-out queue between two threads, which never makes the first one wait.

    Nor does a message wake the second one: at thousands of messages a second that would cost more
    than all that is done with them. It looks again and again, `wait` says how often.
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
        """Whether one more message can wait."""
        needed = payload_bytes + _OVERHEAD_BYTES
        return len(self._queue) < self._limit and self.bytes + needed <= self._limit_bytes

    def put(self, message: Message, *, always: bool = False) -> bool:
        """Add a message; False if there is no room. `always`: a small reserve may be used."""
        with self._lock:
            has_room = self.has_room(len(message.payload))
            if not has_room and not (always and len(self._queue) < self._limit + _RESERVE_MESSAGES):
                return False
            self._queue.append(message)
            self.bytes += len(message.payload) + _OVERHEAD_BYTES
            return True

    def take(self) -> Message | None:
        """Return the oldest message, or None if there is none."""
        with self._lock:
            if not self._queue:
                return None
            message = self._queue.popleft()
            self.bytes -= len(message.payload) + _OVERHEAD_BYTES
            return message

    def wait(self, timeout_s: float) -> None:
        """Wait so long, or until `wake` or `close`."""
        self._woken.wait(timeout_s)
        self._woken.clear()

    def wake(self) -> None:
        """Let `wait` return at once."""
        self._woken.set()

    def close(self) -> None:
        """Say that nothing will come any more."""
        self._closed = True
        self._woken.set()

    @property
    def is_over(self) -> bool:
        """Whether everything has been taken and nothing will come."""
        return self._closed and not self._queue
