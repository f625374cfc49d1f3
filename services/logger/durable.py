"""The messages on disk, for `durable`, by which trucks and workers free theirs."""

import threading
import time
from collections.abc import Iterable
from typing import NamedTuple

from schemas.proto import driveby_pb2 as pb
from schemas.topics import Key, Message
from services.common.intervals import Intervals
from services.recordings.recording import Identities

_MAX_DURABLE_STREAMS = 8000
"""Largest number of streams, some 90 bytes each in a message of at most 1 MiB."""


class _Stream(NamedTuple):
    stored: Intervals
    """Sequences on disk."""
    settled: Intervals
    """Sequences on disk, or known to be lost or refused."""


class DurableStreams:
    """The sequences on disk by stream and boot, in the order of the last change."""

    def __init__(self) -> None:
        self.version = 0
        self._lag_ns = 0
        self._streams: dict[tuple[Key, int], _Stream] = {}
        self._lock = threading.Lock()

    def add(self, messages: Iterable[Message]) -> None:
        """Note messages that have been synced."""
        now_ns = time.time_ns()
        with self._lock:
            changed: dict[tuple[Key, int], _Stream] = {}
            for message in messages:
                self._lag_ns = max(self._lag_ns, now_ns - message.publish_time_ns)
                name = (message.key, message.boot_id)
                stream = changed.get(name)
                if stream is None:
                    stream = changed[name] = self._stream(name)
                stream.stored.add(message.sequence)
                stream.settled.add(message.sequence)
            self.version += 1

    def take_lag_s(self) -> float:
        """Return the longest time in s from receipt to disk since the last call."""
        with self._lock:
            lag_ns, self._lag_ns = self._lag_ns, 0
        return lag_ns * 1e-9

    def mark_accounted(
        self, where: Key, boot_id: int, first: int, last: int, *, on_disk: bool
    ) -> None:
        """Implement `FileWriter.mark_accounted`."""
        with self._lock:
            stream = self._stream((where, boot_id))
            stream.settled.add_range(first, last)
            if on_disk:
                stream.stored.add_range(first, last)
            self.version += 1

    def withdraw(self, identities: Identities) -> int:
        """Remove messages that are gone; return how many of them had been noted."""
        with self._lock:
            self.version += 1
            number = 0
            for name, numbers in identities.items():
                stream = self._streams.get(name)
                if stream is not None:
                    for first, last in numbers.ranges():
                        number += stream.stored.remove_range(first, last)
                        stream.settled.remove_range(first, last)
            return number

    def forget(self, names: Iterable[tuple[Key, int]]) -> None:
        """Implement `FileWriter.forget`."""
        with self._lock:
            for name in names:
                self._streams.pop(name, None)

    def messages(self) -> tuple[int, dict[str, pb.Durable]]:
        """Implement `FileWriter.durable`; of very many streams, those that changed last."""
        by_realm: dict[str, pb.Durable] = {}
        with self._lock:
            for (where, boot_id), stream in reversed(self._streams.items()):
                message = by_realm.setdefault(where.realm, pb.Durable(schema_version=1))
                if len(message.streams) < _MAX_DURABLE_STREAMS:
                    message.streams.add(
                        owner=where.owner,
                        identifier=where.identifier,
                        stream=where.stream,
                        boot_id=boot_id,
                        sequence=stream.settled.contiguous_from_zero,
                        count=stream.stored.size,
                    )
            return self.version, by_realm

    def _stream(self, name: tuple[Key, int]) -> _Stream:
        """Return a stream and move it to the end."""
        stream = self._streams.pop(name, None) or _Stream(Intervals(), Intervals())
        self._streams[name] = stream
        return stream
