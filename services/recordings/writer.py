"""Writers of recordings: message by message, complete after every sync, or whole files at once.

The content of a file is described in `recording`.
"""

import contextlib
import fcntl
import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Literal, NamedTuple

from schemas.messages import descriptors
from schemas.topics import Key, Message, key, topic
from services.common.disk import DISK, Disk, write_all
from services.common.errors import InputError
from services.common.files import replaced_atomically
from services.common.intervals import Intervals
from services.recordings.mcap_file import McapWriter
from services.recordings.recording import (
    ABOUT,
    END,
    FORMAT,
    IDENTITIES,
    SITE,
    START,
    Identities,
    program_version,
)

_log = logging.getLogger(__name__)
CHUNK_BYTES = 64 * 1024
_IDENTITIES_PERIOD_S = 60.0
"""Period of the identities; newer messages must be read one by one after a crash."""
Misplaced = Literal["deleted", "cut short", "moved"]
"""Kind of interference with a recording being written. A moved one still holds everything."""


class RecordingOrigin(NamedTuple):
    """The realm, truck and site of a recording's messages, where they are known."""

    realm: str | None = None
    vehicle: str | None = None
    """Name of the only truck in it."""
    site_toml: str | None = None
    """Text of the site file."""


UNKNOWN_ORIGIN = RecordingOrigin()


class RecordingWriter:
    """A writer to the final name of a recording, so that a crash leaves a readable file.

    Call `sync()` at least once a second: everything written before it survives `kill -9` and loss
    of power. Until it is closed the file is locked (flock), which distinguishes a recording being
    written from one whose writer has died. Not thread-safe. Every method may raise OSError; then
    only `fail` may follow.
    """

    def __init__(
        self,
        path: Path,
        *,
        reason: str,
        origin: RecordingOrigin = UNKNOWN_ORIGIN,
        time_ns: int | None = None,
        previous: str | None = None,
        latched: Sequence[Message] = (),
        disk: Disk = DISK,
    ) -> None:
        """Create the file; raise InputError if it exists (recordings are never overwritten).

        `previous` is the name of the recording that this one continues; the messages `latched` are
        repeated for its readers.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = disk.create(path)
        except FileExistsError:
            raise InputError(
                f"{path}: exists, and a recording is never overwritten; give another name"
            ) from None
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        self.path = path
        self.messages = 0
        """Number of messages written."""
        self.identities: Identities = {}
        self._disk = disk
        self._is_dirty = True
        self._has_failed_sync = False
        self._next_identities_s = time.monotonic() + _IDENTITIES_PERIOD_S
        fcntl.flock(self._file, fcntl.LOCK_EX)
        start = {"previous": previous} if previous else {}
        start |= {"repeated": str(len(latched))} if latched else {}
        try:
            self._mcap = _begin(
                lambda data: write_all(self._file, data),
                {"reason": reason} | start,
                origin,
                time_ns,
            )
            for message in latched:
                self.write(message)
            self.sync()
            disk.sync_folder(path.parent)
        except OSError:
            self._file.close()
            raise

    def write(self, message: Message) -> None:
        """Add one message; it is safe on disk only after `sync()`."""
        name = (message.key, message.boot_id)
        numbers = self.identities.get(name)
        if numbers is None:
            numbers = self.identities[name] = Intervals()
        numbers.add(message.sequence)
        self._is_dirty = True
        self.messages += 1
        _add(self._mcap, message)

    def sync(self) -> None:
        """Close the chunk and sync everything written so far to the disk."""
        if self._is_dirty:
            self._mcap.writer.flush()
            if time.monotonic() >= self._next_identities_s:
                self._next_identities_s = time.monotonic() + _IDENTITIES_PERIOD_S
                self._mcap.writer.add_metadata(IDENTITIES, identities_text(self.identities))
            self._sync_file()
            self._is_dirty = False

    def displacement(self) -> Misplaced | None:
        """Return an interference by another process with the file, after `sync`; else None."""
        status = os.fstat(self._file.fileno())
        if status.st_nlink == 0:
            return "deleted"
        if status.st_size < self.tell():
            return "cut short"
        try:
            there = self.path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return "moved"
        is_same = (there.st_dev, there.st_ino) == (status.st_dev, status.st_ino)
        return None if is_same else "moved"

    def tell(self) -> int:
        """Return the bytes in the file so far, without the open chunk."""
        return self._mcap.writer.offset

    def finish(
        self,
        reason: str,
        counts: Mapping[str, int] | None = None,
        time_ns: int | None = None,
    ) -> None:
        """Write the END sentinel with its reason and counts, the index, and close the file."""
        self._mcap.writer.add_metadata(IDENTITIES, identities_text(self.identities))
        _end(self._mcap.writer, reason, self.messages, counts or {}, time_ns)
        self._sync_file()
        self._file.close()

    def fail(self, reason: str, counts: Mapping[str, int], events: Iterable[Message]) -> int | None:
        """Close the file after an OSError, with END and the events if there is space.

        Half a chunk at the end is truncated, and messages outside chunks are dropped. Return their
        number, or None if messages since the last `sync` may be lost too. Never raise OSError: a
        file without END counts as crashed, and is as readable.
        """
        writer = self._mcap.writer
        discarded = writer.discard()
        self.messages -= discarded
        whole = writer.offset
        try:
            self._cut(whole)
            for event in events:
                self.messages += 1
                _add(self._mcap, event)
            counts = {**counts, "not_written": discarded}
            _end(writer, reason, self.messages, counts, None)
            self._sync_file()
        except OSError as error:
            _log.error("%s: its END could not be written either: %s", self.path, error.strerror)
            with contextlib.suppress(OSError):
                self._cut(whole)
                self._sync_file()
        self.abandon()
        # After a failure, a later success proves nothing: the system may have dropped the pages.
        return None if self._has_failed_sync else discarded

    def abandon(self) -> None:
        """Close the file as it is: synced content stays readable."""
        try:
            self._file.close()
        except OSError as error:  # the handle is closed all the same
            _log.error("%s: %s", self.path, error.strerror)

    def _sync_file(self) -> None:
        try:
            self._disk.sync(self._file.fileno())
        except OSError:
            self._has_failed_sync = True
            raise

    def _cut(self, size: int) -> None:
        self._file.truncate(size)
        self._file.seek(size)


def write_recording(
    path: Path,
    messages: Iterable[Message],
    *,
    site_toml: str | None,
    reason: str,
    force: bool = False,
) -> int:
    """Write a whole recording next to `path`, sync it and rename it; return the number of messages.

    Realm and vehicle are those of the first message. The file depends on nothing but the arguments
    and this program's version: no clock is read. Raise InputError if `path` is not writable, is a
    recording (which `force` replaces, unless a process writes it) or there is no message,
    FailureError if writing fails; then `path` is unchanged.
    """
    source = iter(messages)
    first = next(source, None)
    if first is None:
        raise InputError(f"{path}: there is no message to write")
    written = 0
    last_time_ns = first.log_time_ns
    vehicle = first.key.identifier if first.key.owner == "vehicle" else None
    origin = RecordingOrigin(first.key.realm, vehicle, site_toml)
    with replaced_atomically(path, force=force) as temporary, temporary.open("wb") as file:
        mcap = _begin(file.write, {"reason": reason}, origin, first.log_time_ns)
        for message in chain([first], source):
            _add(mcap, message)
            written += 1
            last_time_ns = max(last_time_ns, message.log_time_ns)
        _end(mcap.writer, reason, written, {}, last_time_ns)
    return written


class _Mcap(NamedTuple):
    writer: McapWriter
    schemas: dict[str, int]
    channels: dict[tuple[Key, int], int]


def _begin(
    write: Callable[[bytes], object],
    start: dict[str, str],
    origin: RecordingOrigin,
    time_ns: int | None,
) -> _Mcap:
    writer = McapWriter(write, library=f"driveby {program_version()}", chunk_bytes=CHUNK_BYTES)
    about = {"program": "driveby", "version": program_version(), "format": FORMAT}
    about |= {"realm": origin.realm} if origin.realm else {}
    about |= {"vehicle": origin.vehicle} if origin.vehicle else {}
    writer.add_metadata(ABOUT, about)
    if origin.site_toml is not None:
        writer.add_attachment(SITE, "application/toml", origin.site_toml.encode())
    now_ns = time.time_ns() if time_ns is None else time_ns
    writer.add_metadata(START, start | {"time_ns": str(now_ns)})
    return _Mcap(writer, {}, {})


def _add(mcap: _Mcap, message: Message) -> None:
    name = (message.key, message.boot_id)
    channel = mcap.channels.get(name)
    if channel is None:
        channel = mcap.channels[name] = _register(mcap, *name)
    mcap.writer.add_message(
        channel,
        message.sequence,
        message.log_time_ns,
        message.publish_time_ns,
        message.payload,
    )


def _register(mcap: _Mcap, where: Key, boot_id: int) -> int:
    name = topic(where.owner, where.stream).message
    if not name:
        raise ValueError(f"{where.owner}/{where.stream} has no message to record")
    schema = mcap.schemas.get(name)
    if schema is None:
        schema = mcap.writer.add_schema(name, "protobuf", descriptors(name))
        mcap.schemas[name] = schema
    return mcap.writer.add_channel(
        key(*where), "protobuf", schema, {"boot_id": str(boot_id), "stream": where.stream}
    )


def _end(
    writer: McapWriter, reason: str, messages: int, counts: Mapping[str, int], time_ns: int | None
) -> None:
    now_ns = time.time_ns() if time_ns is None else time_ns
    figures = {name: str(value) for name, value in counts.items()}
    known = {"reason": reason, "time_ns": str(now_ns), "messages": str(messages)}
    writer.add_metadata(END, figures | known)
    writer.finish()


def identities_text(identities: Identities) -> dict[str, str]:
    """Return the content of the metadata `driveby.identities`."""
    return {
        f"{key(*where)} {boot_id}": ",".join(f"{a}-{b}" for a, b in numbers.ranges())
        for (where, boot_id), numbers in identities.items()
    }
