"""The logger's files: a thread that writes and syncs them, behind a bounded, counted queue."""

import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.signals import Identity
from schemas.topics import topic
from services.common.bus import Seen
from services.common.recording import Message, RecordingWriter

_log = logging.getLogger(__name__)
QUEUE_MESSAGES = 100_000
SYNC_PERIOD_S = 0.5
"""Half of what is promised, so that a slow disk does not break the promise."""
MAX_OPEN_FILES = 256
_SERVICE_FILE = "_service"  # no vehicle can be called that


class Place(NamedTuple):
    """Where recordings go: one file, or below a folder one file per realm and vehicle."""

    folder: Path
    file: Path | None
    realm: str | None
    site_toml: str | None


class FileWriter:
    """Writes messages in a thread of its own, so that a slow disk does not hold up the bus."""

    def __init__(self, place: Place) -> None:
        """Open the single file, if one is asked for; InputError if that cannot be done."""
        self.failure: str | None = None
        """Set once when writing failed; nothing is written after that."""
        self.dropped = 0
        """Messages that found the queue full, came after a failure or from one truck too many."""
        self.written = 0
        self._place = place
        self._files: dict[tuple[str, str], RecordingWriter] = {}
        if place.file is not None:
            self._files[("", "")] = self._open(place.file, place.realm, None)
        self._queue: queue.Queue[Message | None] = queue.Queue(QUEUE_MESSAGES)
        self._unsynced: list[Message] = []
        self._durable = Seen()
        self._durable_lock = threading.Lock()
        self._durable_version = 0
        self._end: tuple[str, Mapping[str, int]] = ("", {})
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> bool:
        """Hand over a message; False (and counted) if the queue is full or writing failed."""
        if self.failure is None:
            try:
                self._queue.put_nowait(message)
                return True
            except queue.Full:
                pass
        self.dropped += 1
        return False

    def waiting(self) -> int:
        """Return how many messages wait in the queue."""
        return self._queue.qsize()

    def finish(self, reason: str, counts: Mapping[str, int]) -> None:
        """Write what waits, then every file's END with its reason and counts; wait for that."""
        self._end = (reason, counts)
        self._queue.put(None)
        self._thread.join()

    def durable(self) -> tuple[int, dict[str, pb.Durable]]:
        """Return what is on disk as messages by realm, and a number that rises with changes."""
        with self._durable_lock:
            by_realm: dict[str, pb.Durable] = {}
            for (where, boot_id), numbers in self._durable.streams.items():
                message = by_realm.setdefault(where.realm, pb.Durable(schema_version=1))
                message.streams.add(
                    owner=where.owner,
                    identifier=where.identifier,
                    stream=where.stream,
                    boot_id=boot_id,
                    sequence=numbers.contiguous_from_zero,
                    count=numbers.size,
                )
            return self._durable_version, by_realm

    def durable_version(self) -> int:
        """Return the number of `durable` alone, which costs nothing."""
        return self._durable_version

    def _run(self) -> None:
        try:
            self._write_all()
            reason, counts = self._end
            for file in self._files.values():
                file.finish(reason, counts)
        except Exception as error:  # whatever it was, it must be told and nobody left waiting
            reason = getattr(error, "strerror", None) or str(error)
            self.failure = f"recording stopped: {reason}"
            self.dropped += len(self._unsynced)
            _log.error("%s", self.failure)
            for file in self._files.values():
                file.abandon()
            self._discard()

    def _write_all(self) -> None:
        synced = time.monotonic()
        while True:
            try:
                message = self._queue.get(timeout=SYNC_PERIOD_S / 2)
            except queue.Empty:
                pass
            else:
                if message is None:
                    self._sync()
                    return
                file = self._file_of(message)
                if file is None:
                    self.dropped += 1
                else:
                    self._unsynced.append(message)
                    file.write(message)
            if self._unsynced and time.monotonic() - synced >= SYNC_PERIOD_S:
                self._sync()
                synced = time.monotonic()

    def _sync(self) -> None:
        for file in self._files.values():
            file.sync()
        with self._durable_lock:
            for message in self._unsynced:
                self._durable.add(message.key, Identity(message.boot_id, message.sequence))
            self.written += len(self._unsynced)
            self._durable_version += 1
        self._unsynced.clear()

    def _file_of(self, message: Message) -> RecordingWriter | None:
        """Return the file to write to; None if it would be one more than can be open."""
        if self._place.file is not None:
            return self._files[("", "")]
        realm, name = message.key.realm, _vehicle_of(message)
        if message.key.owner != "vehicle" and (realm, name) not in self._files:
            name = _SERVICE_FILE
        file = self._files.get((realm, name))
        if file is None:
            if len(self._files) >= MAX_OPEN_FILES:
                _log.error("%s: more than %d vehicles, not recorded", name, MAX_OPEN_FILES)
                return None
            file = self._files[(realm, name)] = self._open(
                _free_path(self._place, realm, name),
                realm,
                None if name == _SERVICE_FILE else name,
            )
        return file

    def _open(self, path: Path, realm: str | None, vehicle: str | None) -> RecordingWriter:
        writer = RecordingWriter(
            path,
            reason="logger started",
            realm=realm,
            vehicle=vehicle,
            site_toml=self._place.site_toml,
        )
        _log.info("recording to %s", path)
        return writer

    def _discard(self) -> None:
        """Empty the queue after a failure, counting, until `finish` comes."""
        while self._queue.get() is not None:
            self.dropped += 1


def _vehicle_of(message: Message) -> str:
    """Return the vehicle that a message concerns; empty if none."""
    if message.key.owner == "vehicle":
        return message.key.identifier
    name = topic(message.key.owner, message.key.stream).message
    vehicle: str = getattr(decode(name, message.payload), "vehicle", "")
    return vehicle


def _free_path(place: Place, realm: str, name: str) -> Path:
    now = datetime.now(UTC)
    folder = place.folder / realm / f"{now:%Y-%m-%d}"
    stem = f"{name}-{now:%Y%m%dT%H%M%SZ}"
    path = folder / f"{stem}.mcap"
    number = 2
    while path.exists():
        path = folder / f"{stem}-{number}.mcap"
        number += 1
    return path


def count_all(intake: Counter[str], writer: FileWriter) -> dict[str, int]:
    """Return every figure of the logger by name."""
    figures = {
        name: intake[name]
        for name in ("received", "accepted", "refused", "duplicates", "recovered", "lost")
    }
    return figures | {"dropped": writer.dropped}
