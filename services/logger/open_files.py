"""The logger's open recordings: one for each truck, created, synced, closed and replaced.

A file is closed, with END and the reason, when it is old or large enough, on request, and when its
truck has been quiet for long; the next message of that truck begins a new one.
"""

import logging
import time
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

from schemas.events import Event, EventKind
from schemas.topics import Key, Message, topic
from services.common.disk import Disk
from services.common.intervals import Intervals
from services.common.naming import count_of
from services.logger.cataloguing import Cataloguing
from services.logger.drops import FAILED, Drops
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
    close_after_failure,
    failing,
    failure_of,
    finished,
    synced,
)
from services.logger.own_events import OwnEvents
from services.recordings.recording import Identities
from services.recordings.writer import Misplaced, RecordingOrigin, RecordingWriter

_log = logging.getLogger(__name__)
_SYNCS_AT_ONCE = 8
"""Number of parallel syncs, so that many open files are synced within a period."""
QUIET_S = 300.0
"""Silence of a truck after which it gets a new file."""


class RotationLimits(NamedTuple):
    """Limits for closing a file, and minimum free space."""

    age_s: float = 900.0
    bytes: int = 1 << 30
    min_free_bytes: int = 0
    """Free space below which the logger does not start, and warns while it runs; it stops at an
    eighth."""


class OpenFiles:
    """The open recordings of all trucks, for one thread; every method may raise `WriteError`.

    Other threads may read figures, empty the deques, and use `drops` and `durable`, which lock.
    """

    def __init__(
        self, place: RecordingTarget, limits: RotationLimits, own: OwnEvents, disk: Disk
    ) -> None:
        """Open the single file, if requested; raise InputError if that fails."""
        self.written = 0
        """Number of messages on disk."""
        self.withdrawn: deque[Identities] = deque()
        """Messages that were in files which are gone, and may come again."""
        self.unwritten: deque[Identities] = deque()
        """Messages for which there was no file: they may come again."""
        self.unpublished: deque[Message] = deque()
        """Events that were written here and that are to be published."""
        self.drops = Drops(place.realm or "live")
        self.durable = DurableStreams()
        self._without_file: Identities = {}
        self._place = place
        self._limits = limits
        self._disk = disk
        self._own = own
        self._files: dict[FileName, OpenFile] = {}
        self._closed_names: dict[FileName, str] = {}
        self._latched = LatchedMessages()
        self._unsynced: list[tuple[FileName, Message]] = []
        self._syncing = ThreadPoolExecutor(_SYNCS_AT_ONCE, "sync")
        self._cataloguing = Cataloguing(place.top)
        if place.file is not None:
            self._open(("", ""), place.file, "logger started")

    def __len__(self) -> int:
        return len(self._files)

    def write(self, message: Message, now_s: float) -> None:
        """Write a message to its file, which is created if needed; count it if it may have none."""
        name = file_of(self._place, message, self._files)
        opened = self._files.get(name)
        if opened is None:
            room = file_slot(name, {one: self._files[one].last_s for one in self._files}, now_s)
            if room.why_not:
                self.drops.count(message.key, room.why_not)
                identity = (message.key, message.boot_id)
                self._without_file.setdefault(identity, Intervals()).add(message.sequence)
                return
            if room.close is not None:
                self._close([room.close], "quiet, and too many files are open")
            opened = self._begin(name, message.key)
        opened.last_s = now_s
        self._unsynced.append((name, message))
        try:
            opened.file.write(message)
        except OSError as error:
            raise failure_of(name, error) from error
        if topic(message.key.owner, message.key.stream).latched:
            self._latched.add(message)
        if self._place.file is None and opened.file.tell() >= self._limits.bytes:
            self._close([name], "rotated: size")

    def sync(self) -> None:
        """Sync all files; their messages are then durable. Replace files that are gone."""
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
            self.durable.add(safe)
            self.written += len(safe)
        for name, what in misplaced.items():
            if what is not None:
                self._replace(name, what)

    def close_old(self, now_s: float) -> None:
        """Close files that are old and those of trucks that are quiet."""
        if self._place.file is not None:
            return
        age_s = self._limits.age_s
        old = [name for name, opened in self._files.items() if now_s - opened.since_s >= age_s]
        self._close(old, "rotated: age")
        trucks = [item for item in self._files.items() if item[0][1] != SERVICE_FILE]
        quiet = [name for name, opened in trucks if now_s - opened.last_s >= QUIET_S]
        self._close(quiet, "the truck is quiet")

    def rotate(self) -> None:
        """Close all files on request, unless there is a single requested one."""
        if self._place.file is not None:
            _log.warning("%s is the only file (--file) and is not rotated", self._place.file)
            return
        self.sync()  # so that a file that cannot be closed costs no message of another one
        self._close(list(self._files), "rotated: on request")

    def write_event(self, event: Event) -> None:
        """Write an event to the file of every realm, and queue it for publication."""
        _log.warning("%s: %s", event.kind, event.text)
        realms = {realm for realm, _ in self._files if realm} or {self._place.realm or "live"}
        for realm in sorted(realms):
            message = self._own.message(realm, event)
            self.unpublished.append(message)
            self.write(message, time.monotonic())

    def finish(self, reason: str, counts: Mapping[str, int]) -> None:
        """Close all files with this reason and these counts."""
        self._close(list(self._files), reason, counts)

    def close_after_failure(self, failed: FileName | None, failure: str, event: Event) -> None:
        """Close every file as well as possible, with an event, and count the losses."""
        saved: list[Message] = []
        lost: list[Message] = []
        for name, opened in self._files.items():
            message = self._own.message(name[0] or self._place.realm or "live", event)
            self.unpublished.append(message)
            mine = [m for n, m in self._unsynced if n == name]
            counts = {"dropped": self.drops.of(*name) - opened.dropped_before}
            at_fault = name == failed
            number = close_after_failure(opened, failure, counts, message, is_failed=at_fault)
            number = len(mine) if number is None else min(number, len(mine))
            saved += mine[: len(mine) - number]
            lost += mine[len(mine) - number :]
        # Messages for a file that could not even be opened.
        lost += [m for n, m in self._unsynced if n not in self._files]
        self._files.clear()
        self._unsynced.clear()
        self.durable.add(saved)
        self.written += len(saved)
        for dropped in lost:
            self.drops.count(dropped.key, FAILED)

    def shut_down(self) -> None:
        """End the threads of syncs and of the catalogue."""
        self._syncing.shutdown()
        self._cataloguing.close()

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
        read_site = self._place.site_text
        writer = RecordingWriter(
            path,
            reason=reason,
            origin=RecordingOrigin(
                realm,
                None if vehicle == SERVICE_FILE else vehicle,
                None if read_site is None else read_site(),
            ),
            previous=previous,
            latched=latched or (),
            disk=self._disk,
        )
        _log.info("recording to %s", path)
        now_s = time.monotonic()
        opened = self._files[name] = OpenFile(writer, now_s, now_s, self.drops.of(*name))
        return opened

    def _close(
        self, names: Sequence[FileName], reason: str, counts: Mapping[str, int] | None = None
    ) -> None:
        """Close files with a reason, and with these counts or those of each."""
        for name in names:
            with failing(name):
                what = self._files[name].file.displacement()
            if what in ("deleted", "cut short"):
                self._replace(name, what)
        closing = {name: self._files[name] for name in names}
        done = []
        # In parallel, as in `sync`: one after the other, a hundred on a slow disk take a minute.
        for name, opened in closing.items():
            dropped = {"dropped": self.drops.of(*name) - opened.dropped_before}
            end = dropped if counts is None else counts
            done.append(self._syncing.submit(finished, name, opened, reason, end))
        failed = [error for one in done if (error := one.result()) is not None]
        for name, opened in closing.items():
            if opened.has_failed:
                continue
            del self._files[name]
            self._closed_names[name] = opened.file.path.name
            _log.info("closed %s: %s", opened.file.path, reason)
            if self._place.file is None:  # a single requested file belongs to no collection
                self._cataloguing.add(opened.file.path)
        if failed:
            raise failed[0]

    def _replace(self, name: FileName, what: Misplaced) -> None:
        """Begin a new file for one that was deleted, cut or moved, and write an event."""
        file = self._files.pop(name).file
        latched = self._latched.among(file.identities)
        text = f"{file.path.name} was {what} by another process while it was being written"
        number = 0
        if what == "moved":
            text += f"; it holds {count_of(file.messages, 'message')}"
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
            confirmed = self.durable.withdraw(gone)
            self._unsynced = [(n, m) for n, m in self._unsynced if n != name]
            self.withdrawn.append(gone)
            text += (
                f": {count_of(number, 'message')} lost, {confirmed} of them confirmed as durable"
            )
        with failing(name):
            path = free_path(self._place, *name)
            self._open(name, path, f"the file before it was {what}", file.path.name, latched)
        self.durable.add(latched)
        vehicle = name[1] if name[1] != SERVICE_FILE else ""
        event = Event(
            EventKind.RECORDING_GONE, time.time_ns(), text, vehicle=vehicle, messages=number
        )
        _log.error("%s: %s", event.kind, text)
        message = self._own.message(name[0] or self._place.realm or "live", event)
        self.unpublished.append(message)
        self.write(message, time.monotonic())
