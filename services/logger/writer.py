"""The logger's files: a thread that writes and syncs them, behind a bounded, counted queue.

A file is closed, with END and the reason, when it is old or large enough, on request, and when its
truck has been quiet for long; the next message of that truck begins a new one. Only this thread
writes, and it rotates between two messages, so that none is lost or repeated.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

from schemas.events import Event, EventKind
from schemas.proto import driveby_pb2 as pb
from schemas.topics import Key, Message, topic
from services.common.disk import DISK, Disk
from services.common.intervals import Intervals
from services.logger.backlog import Backlog
from services.logger.cataloguing import Cataloguing
from services.logger.disk_room import DiskRoom, NoRoomError
from services.logger.drops import FAILED, QUEUE_IS_FULL, Drop, Drops
from services.logger.durable import DurableStreams
from services.logger.file_layout import (
    SERVICE_FILE,
    FileName,
    RecordingTarget,
    file_of,
    file_slot,
    free_path,
)
from services.logger.latched import LatchedMessages
from services.logger.open_file import (
    OpenFile,
    WriteFailed,
    close_after_failure,
    failing,
    failure_of,
    synced,
)
from services.logger.own_events import OwnEvents
from services.recordings.recording import Identities
from services.recordings.writer import Misplaced, RecordingOrigin, RecordingWriter

_log = logging.getLogger(__name__)
SYNC_PERIOD_S = 0.5
"""Sync interval, half of the guarantee, so that a slow disk does not break it."""
_SYNCS_AT_ONCE = 8
"""Number of parallel syncs, so that many open files are synced within a period."""
_LOOK_S = 0.05
"""Interval of polling for messages after an empty queue."""
QUIET_S = 300.0
"""Silence of a truck after which it gets a new file."""
_DISK_CHECK_S = 1.0
"""Interval of checks of free space."""


class RotationLimits(NamedTuple):
    """Limits for closing a file, and minimum free space."""

    age_s: float = 900.0
    bytes: int = 1 << 30
    min_free_bytes: int = 0
    """Free space below which the logger does not start, and warns while it runs; it stops at an
    eighth."""


class FileWriter:
    """A thread that writes messages, so that a slow disk does not hold up the bus."""

    def __init__(
        self,
        place: RecordingTarget,
        limits: RotationLimits = RotationLimits(),  # noqa: B008  # a tuple does not change
        *,
        own: OwnEvents | None = None,
        disk: Disk = DISK,
        backlog: Backlog | None = None,
    ) -> None:
        """Open the single file, if requested; raise InputError if that fails."""
        self.failure: str | None = None
        """Set once when writing failed; nothing is written after that."""
        self.written = 0
        self.withdrawn: deque[Identities] = deque()
        """Messages that were in files which are gone, and may come again; the caller empties it."""
        self.unwritten: deque[Identities] = deque()
        """Messages for which there was no file: they may come again. The caller empties it."""
        self._without_file: Identities = {}
        self._drops = Drops(place.realm or "live")
        self.said: deque[Message] = deque()
        """Events that this thread has written down itself and that are to be published."""
        self._place = place
        self.limits = limits
        self._disk = disk
        self.room = DiskRoom(self._folder(), limits.min_free_bytes, disk)
        self._own = own or OwnEvents("logger", time.time_ns())
        self._files: dict[FileName, OpenFile] = {}
        self._closed_names: dict[FileName, str] = {}
        self._latched = LatchedMessages()
        self._rotation_asked = threading.Event()
        self._backlog = Backlog() if backlog is None else backlog
        self._unsynced: list[tuple[FileName, Message]] = []
        self._durable = DurableStreams()
        self._end: tuple[str, Mapping[str, int]] = ("", {})
        self._syncing = ThreadPoolExecutor(_SYNCS_AT_ONCE, "sync")
        self._cataloguing = Cataloguing(self._folder())
        if place.file is not None:
            self._open(("", ""), place.file, "logger started")
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)
        self._thread.start()

    def has_room(self, payload_bytes: int) -> bool:
        """Return whether `put` would accept a message of that size."""
        return self.failure is None and self._backlog.has_room(payload_bytes)

    def put(self, message: Message, *, always: bool = False) -> bool:
        """Queue a message; return False (and count) if the queue is full or writing failed.

        `always` is for messages that must be written because the queue is full.
        """
        if self.failure is None and self._backlog.put(message, always=always):
            return True
        self.count_drop(message.key, QUEUE_IS_FULL if self.failure is None else FAILED)
        return False

    @property
    def dropped(self) -> int:
        """The number of messages without room or file, or after a failure (`drops`)."""
        return self._drops.total

    def count_drop(self, where: Key | None, why: str = QUEUE_IS_FULL) -> None:
        """Count a message that is not written, with its cause."""
        self._drops.count(where, why)

    def drops(self) -> list[Drop]:
        """Return the drops since the last call, by source and cause."""
        return self._drops.drain()

    def take_figures(self) -> dict[str, float]:
        """Return counts for `health`, and the longest time to disk since the last call."""
        return {
            "queue": len(self._backlog),
            "queue_bytes": self._backlog.bytes,
            "written": self.written,
            "files": len(self._files),
            "durable_lag_s": self._durable.take_lag_s(),
        }

    def rotate(self) -> None:
        """Request the closing of all files; the next message of each truck begins a new one."""
        self._rotation_asked.set()
        self._backlog.wake()

    def finish(self, reason: str, counts: Mapping[str, int]) -> None:
        """Write waiting messages, then every file's END with reason and counts; wait for that."""
        self._end = (reason, counts)
        self._backlog.close()
        self._thread.join()

    def mark_accounted(
        self, where: Key, boot_id: int, first: int, last: int, *, on_disk: bool
    ) -> None:
        """Mark sequences as accounted for in `durable`: on disk earlier, or lost or refused."""
        self._durable.mark_accounted(where, boot_id, first, last, on_disk=on_disk)

    def forget(self, names: Iterable[tuple[Key, int]]) -> None:
        """Remove these streams and boots from `durable` after a long silence."""
        self._durable.forget(names)

    def durable(self) -> tuple[int, dict[str, pb.Durable]]:
        """Return the sequences on disk as messages by realm, and a version of the content."""
        return self._durable.messages()

    def durable_version(self) -> int:
        """Return only the version of `durable`, which costs nothing."""
        return self._durable.version

    def _run(self) -> None:
        try:
            self._write_all()
            reason, counts = self._end
            for name in list(self._files):
                self._close(name, reason, counts)
        except WriteFailed as failed:
            self._stop(failed.name, f"recording stopped: {failed.reason}", failed.kind)
        except Exception as error:  # any error must be reported, and no thread left waiting
            _log.exception("writing failed; recording stops")
            self._stop(None, f"recording stopped: {error}", EventKind.WRITE_ERROR)
        finally:
            self._syncing.shutdown()
            self._cataloguing.close()

    def _write_all(self) -> None:
        synced_s = time.monotonic()
        looked_s = 0.0
        while not self._backlog.is_over:
            message = self._backlog.pop()
            now_s = time.monotonic()
            if message is not None:
                self._write(message, now_s)
            else:
                self._backlog.wait(_LOOK_S)
            if self._rotation_asked.is_set():
                self._rotation_asked.clear()
                self._rotate_on_request()
            if now_s - synced_s >= SYNC_PERIOD_S:
                synced_s = now_s
                self._sync()
                self._close_old(now_s)
            if now_s - looked_s >= _DISK_CHECK_S:
                looked_s = now_s
                self._look_at_disk()
        self._sync()

    def _write(self, message: Message, now_s: float) -> None:
        name = file_of(self._place, message, self._files)
        opened = self._files.get(name)
        if opened is None:
            room = file_slot(name, {one: self._files[one].last_s for one in self._files}, now_s)
            if room.why_not:
                self.count_drop(message.key, room.why_not)
                identity = (message.key, message.boot_id)
                self._without_file.setdefault(identity, Intervals()).add(message.sequence)
                return
            if room.close is not None:
                self._close(room.close, "quiet, and too many files are open")
            opened = self._begin(name, message.key)
        opened.last_s = now_s
        self._unsynced.append((name, message))
        try:
            opened.file.write(message)
        except OSError as error:
            raise failure_of(name, error) from error
        if topic(message.key.owner, message.key.stream).latched:
            self._latched.add(message)
        if self._place.file is None and opened.file.tell() >= self.limits.bytes:
            self._close(name, "rotated: size")

    def _sync(self) -> None:
        # In parallel: a disk syncs many in little more time than one.
        done = [self._syncing.submit(synced, *item) for item in self._files.items()]
        wait(done)
        misplaced = {name: one.result() for name, one in zip(self._files, done, strict=True)}
        gone = {name for name, what in misplaced.items() if what in ("deleted", "cut short")}
        safe = [message for name, message in self._unsynced if name not in gone]
        self._unsynced.clear()
        if self._without_file:
            self.unwritten.append(self._without_file)
            self._without_file = {}
        if safe:
            self._durable.add(safe)
            self.written += len(safe)
        for name, what in misplaced.items():
            if what is not None:
                self._replace(name, what)

    def _begin(self, name: FileName, where: Key) -> OpenFile:
        """Open the next file of a truck."""
        previous = self._closed_names.get(name)
        with failing(name):
            return self._open(
                name,
                free_path(self._place, *name),
                "logger started" if previous is None else "rotated",
                previous,
                # The message that begins the file follows by itself.
                self._latched.of_file(name, without=where),
            )

    def _open(
        self,
        name: FileName,
        path: Path,
        reason: str,
        previous: str | None = None,
        latched: list[Message] | None = None,
    ) -> OpenFile:
        realm, vehicle = (self._place.realm, None) if name == ("", "") else name
        writer = RecordingWriter(
            path,
            reason=reason,
            origin=RecordingOrigin(
                realm, None if vehicle == SERVICE_FILE else vehicle, self._place.site_toml
            ),
            previous=previous,
            latched=latched or (),
            disk=self._disk,
        )
        _log.info("recording to %s", path)
        now_s = time.monotonic()
        opened = self._files[name] = OpenFile(writer, now_s, now_s, self._drops.of(*name))
        return opened

    def _close(self, name: FileName, reason: str, counts: Mapping[str, int] | None = None) -> None:
        opened = self._files[name]
        with failing(name):
            what = opened.file.displacement()
        if what in ("deleted", "cut short"):
            self._replace(name, what)
            opened = self._files[name]
        if counts is None:
            counts = {"dropped": self._drops.of(*name) - opened.dropped_before}
        with failing(name):
            opened.file.finish(reason, counts)
        del self._files[name]
        self._closed_names[name] = opened.file.path.name
        _log.info("closed %s: %s", opened.file.path, reason)
        if self._place.file is None:  # a single requested file belongs to no collection
            self._cataloguing.add(opened.file.path)

    def _replace(self, name: FileName, what: Misplaced) -> None:
        """Begin a new file for one that was deleted, cut or moved, and write an event."""
        file = self._files.pop(name).file
        latched = self._latched.among(file.identities)
        text = f"{file.path.name} was {what} by somebody else while it was being written"
        number = 0
        if what == "moved":
            text += f"; it holds {file.messages} messages"
            with failing(name):
                file.finish("moved", {})
        else:
            file.abandon()
            gone = file.identities
            for message in latched:  # they are in the next file, too
                gone[(message.key, message.boot_id)].remove_range(
                    message.sequence, message.sequence
                )
            number = sum(numbers.size for numbers in gone.values())
            confirmed = self._durable.withdraw(gone)
            self._unsynced = [(n, m) for n, m in self._unsynced if n != name]
            self.withdrawn.append(gone)
            text += f": {number} messages are gone, {confirmed} of them were confirmed as durable"
        with failing(name):
            path = free_path(self._place, *name)
            self._open(name, path, f"the file before it was {what}", file.path.name, latched)
        self._durable.add(latched)
        vehicle = name[1] if name[1] != SERVICE_FILE else ""
        event = Event(
            EventKind.RECORDING_GONE, time.time_ns(), text, vehicle=vehicle, messages=number
        )
        _log.error("%s: %s", event.kind, text)
        said = self._own.message(name[0] or self._place.realm or "live", event)
        self.said.append(said)
        self._write(said, time.monotonic())

    def _close_old(self, now_s: float) -> None:
        if self._place.file is not None:
            return
        for name, opened in list(self._files.items()):
            if now_s - opened.since_s >= self.limits.age_s:
                self._close(name, "rotated: age")
            elif name[1] != SERVICE_FILE and now_s - opened.last_s >= QUIET_S:
                self._close(name, "the truck is quiet")

    def _rotate_on_request(self) -> None:
        if self._place.file is not None:
            _log.warning("%s is the only file (--file) and is not rotated", self._place.file)
            return
        for name in list(self._files):
            self._close(name, "rotated: on request")

    def _folder(self) -> Path:
        return self._place.file.parent if self._place.file is not None else self._place.folder

    def _look_at_disk(self) -> None:
        try:
            left = self.room.check()
        except NoRoomError as error:
            raise WriteFailed(None, str(error), EventKind.DISK_LOW) from None
        if left is not None:
            self._write_event(Event(EventKind.DISK_LOW, time.time_ns(), left))

    def _write_event(self, event: Event) -> None:
        """Write an event to the file of every realm, and queue it for publication."""
        _log.warning("%s: %s", event.kind, event.text)
        realms = {realm for realm, _ in self._files if realm} or {self._place.realm or "live"}
        for realm in sorted(realms):
            message = self._own.message(realm, event)
            self.said.append(message)
            self._write(message, time.monotonic())

    def _stop(self, failed: FileName | None, failure: str, kind: EventKind) -> None:
        """Close every file as well as possible, count the losses and accept nothing any more."""
        _log.error("%s", failure)
        try:
            self._close_all_after_failure(failed, failure, Event(kind, time.time_ns(), failure))
        finally:
            self.failure = failure
        while not self._backlog.is_over:
            waited = self._backlog.pop()
            if waited is not None:
                self.count_drop(waited.key, FAILED)
            else:
                self._backlog.wait(SYNC_PERIOD_S)

    def _close_all_after_failure(self, failed: FileName | None, failure: str, event: Event) -> None:
        saved: list[Message] = []
        lost: list[Message] = []
        for name, opened in self._files.items():
            message = self._own.message(name[0] or self._place.realm or "live", event)
            self.said.append(message)
            mine = [m for n, m in self._unsynced if n == name]
            counts = {"dropped": self._drops.of(*name) - opened.dropped_before}
            at_fault = name == failed
            number = close_after_failure(opened, failure, counts, message, is_failed=at_fault)
            number = len(mine) if number is None else min(number, len(mine))
            saved += mine[: len(mine) - number]
            lost += mine[len(mine) - number :]
        # Messages for a file that could not even be opened.
        lost += [m for n, m in self._unsynced if n not in self._files]
        self._files.clear()
        self._unsynced.clear()
        self._durable.add(saved)
        self.written += len(saved)
        for dropped in lost:
            self.count_drop(dropped.key, FAILED)


def count_all(intake: Counter[str], writer: FileWriter) -> dict[str, int]:
    """Return every figure of the logger by name."""
    names = ("received", "accepted", "refused", "duplicates", "recovered", "lost", "missing")
    return {name: intake[name] for name in names} | {"dropped": writer.dropped}
