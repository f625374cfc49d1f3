"""The thread that writes and syncs the logger's files, behind a bounded, counted queue.

Only this thread writes to the open files, and it rotates between two messages, so that none is lost
or repeated.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping

from schemas.events import Event, EventKind
from schemas.proto import driveby_pb2 as pb
from schemas.topics import Key, Message
from services.common.disk import DISK, Disk
from services.logger.backlog import Backlog
from services.logger.disk_room import DiskRoom, NoRoomError
from services.logger.drops import FAILED, QUEUE_IS_FULL, Drop
from services.logger.file_layout import FileName, RecordingTarget
from services.logger.open_file import WriteError
from services.logger.open_files import OpenFiles, RotationLimits
from services.logger.own_events import OwnEvents

_log = logging.getLogger(__name__)
SYNC_PERIOD_S = 0.5
"""Sync interval, half of the guarantee, so that a slow disk does not break it."""
_LOOK_S = 0.05
"""Interval of polling for messages after an empty queue."""
_DISK_CHECK_S = 1.0
"""Interval of checks of free space."""


class FileWriter:
    """A thread that writes messages, so that a slow disk does not delay the bus."""

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
        own = own or OwnEvents("logger", time.time_ns())
        self._files = OpenFiles(place, limits, own, disk)
        self.withdrawn = self._files.withdrawn
        """Messages that were in files which are gone, and may come again; the caller empties it."""
        self.unwritten = self._files.unwritten
        """Messages for which there was no file: they may come again. The caller empties it."""
        self.unpublished = self._files.unpublished
        """Events that this thread has written itself and that are to be published."""
        self.limits = limits
        self.room = DiskRoom(place.top, limits.min_free_bytes, disk)
        self._rotation_asked = threading.Event()
        self._backlog = Backlog() if backlog is None else backlog
        self._end: tuple[str, Mapping[str, int]] = ("", {})
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
    def written(self) -> int:
        """The number of messages on disk."""
        return self._files.written

    @property
    def dropped(self) -> int:
        """The number of messages without room or file, or after a failure (`drops`)."""
        return self._files.drops.total

    def count_drop(self, where: Key | None, why: str = QUEUE_IS_FULL) -> None:
        """Count a message that is not written, with its cause."""
        self._files.drops.count(where, why)

    def drops(self) -> list[Drop]:
        """Return the drops since the last call, by source and cause."""
        return self._files.drops.drain()

    def take_figures(self) -> dict[str, float]:
        """Return counts for `health`, and the longest time to disk since the last call."""
        return {
            "queue": len(self._backlog),
            "queue_bytes": self._backlog.bytes,
            "written": self.written,
            "files": len(self._files),
            "durable_lag_s": self._files.durable.take_lag_s(),
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
        self._files.durable.mark_accounted(where, boot_id, first, last, on_disk=on_disk)

    def forget(self, names: Iterable[tuple[Key, int]]) -> None:
        """Remove these streams and boots from `durable` after a long silence."""
        self._files.durable.forget(names)

    def durable(self) -> tuple[int, dict[str, pb.Durable]]:
        """Return the sequences on disk as messages by realm, and a version of the content."""
        return self._files.durable.messages()

    def durable_version(self) -> int:
        """Return only the version of `durable`, which costs nothing."""
        return self._files.durable.version

    def _run(self) -> None:
        try:
            self._write_all()
            reason, counts = self._end
            self._files.finish(reason, counts)
        except WriteError as failed:
            self._stop(failed.name, f"recording stopped: {failed.reason}", failed.kind)
        except Exception as error:  # any error must be reported, and no thread left waiting
            _log.exception("writing failed; recording stops")
            self._stop(None, f"recording stopped: {error}", EventKind.WRITE_ERROR)
        finally:
            self._files.shut_down()

    def _write_all(self) -> None:
        synced_s = time.monotonic()
        looked_s = 0.0
        while not self._backlog.is_over:
            message = self._backlog.pop()
            now_s = time.monotonic()
            if message is not None:
                self._files.write(message, now_s)
            else:
                self._backlog.wait(_LOOK_S)
            if self._rotation_asked.is_set():
                self._rotation_asked.clear()
                self._files.rotate()
            if now_s - synced_s >= SYNC_PERIOD_S:
                synced_s = now_s
                self._files.sync()
                self._files.close_old(now_s)
            if now_s - looked_s >= _DISK_CHECK_S:
                looked_s = now_s
                self._look_at_disk()
        self._files.sync()

    def _look_at_disk(self) -> None:
        try:
            left = self.room.check()
        except NoRoomError as error:
            raise WriteError(None, str(error), EventKind.DISK_LOW) from None
        if left is not None:
            self._files.write_event(Event(EventKind.DISK_LOW, time.time_ns(), left))

    def _stop(self, failed: FileName | None, failure: str, kind: EventKind) -> None:
        """Close every file as well as possible, count the losses and accept nothing any more."""
        _log.error("%s", failure)
        try:
            self._files.close_after_failure(failed, failure, Event(kind, time.time_ns(), failure))
        finally:
            self.failure = failure
        while not self._backlog.is_over:
            waited = self._backlog.pop()
            if waited is not None:
                self.count_drop(waited.key, FAILED)
            else:
                self._backlog.wait(SYNC_PERIOD_S)


def count_all(intake: Counter[str], writer: FileWriter) -> dict[str, int]:
    """Return every figure of the logger by name."""
    names = ("received", "accepted", "refused", "duplicates", "recovered", "lost", "missing")
    return {name: intake[name] for name in names} | {"dropped": writer.dropped}
