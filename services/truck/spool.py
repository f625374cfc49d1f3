"""The spool: a truck's messages on its own disk until a logger has them.

A folder of segments, one boot after the other, `{boot_id}-{number}.spool`. A segment is appended to
and never changed: a header (magic, boot_id, CRC), then records

    CRC-32 of the rest | length of the rest | sequence | length of the name | stream | payload

all big-endian. Messages passed to `append` survive `kill -9` of the process; those before a `sync`
survive a power cut. The end that a cut left incomplete is removed when the folder is opened.
`state.json` records the fate of messages whose segments are gone: up to where loggers have
confirmed them, and which were dropped for space. It is replaced before a segment is deleted, so
that every message is always accounted for.
"""

import contextlib
import json
import logging
import os
import struct
import threading
import time
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from schemas.spool import PAGE_BYTES, PAGE_MESSAGES, SpoolBoot
from services.common.errors import FailureError, InputError
from services.common.files import lock_folder, write_atomically
from services.common.intervals import Intervals

DEFAULT_BUDGET_BYTES = 4 << 30
"""Default size, more than a day of four channels at 1 kHz."""

_log = logging.getLogger(__name__)
_MAGIC = b"DBSPOOL1"
_HEADER = struct.Struct("!8sQI")
_RECORD = struct.Struct("!IIQB")
_RECORD_PREFIX = 8  # CRC and length, which the length does not count
_SMALLEST_BUDGET_BYTES = 1 << 20
"""Smallest size; segments of a smaller one would hold few messages."""
_LARGEST_SEGMENT_BYTES = 4 << 20
"""Largest file; whole files are freed."""
_SEGMENTS_IN_BUDGET = 16
"""Fewest files in the budget, so that freeing one drops only a small part."""
_STATE = "state.json"
_LOCK = "lock"
_IN_USE = "another truck uses this spool; give every truck a folder of its own"
_BOOTS_REMEMBERED = 100
"""Boots with remembered losses, although none of their messages is held."""


class SpooledMessage(NamedTuple):
    """One message of a stream and boot as it was or should have been published."""

    sequence: int
    payload: bytes


class Page(NamedTuple):
    """A part of an answer, in ascending order."""

    messages: list[SpooledMessage]
    next_sequence: int | None
    """Sequence to continue from; None at the end. Lower ones that are missing are not held."""


class Spool:
    """The spool of one truck in one folder, for a boot that begins with its opening.

    Thread-safe. `append` and `sync` may raise OSError; the spool stays usable.
    """

    def __init__(self, folder: Path, *, budget_bytes: int = DEFAULT_BUDGET_BYTES) -> None:
        """Open or create the folder; raise InputError if unusable or another process has it."""
        if budget_bytes < _SMALLEST_BUDGET_BYTES:
            least = _SMALLEST_BUDGET_BYTES >> 20
            raise InputError(f"spool budget of {budget_bytes} bytes; at least {least} MiB")
        self.folder = folder
        self.budget_bytes = budget_bytes
        self.discarded_bytes = 0
        """Bytes removed at the opening, because they were cut off or damaged."""
        self._segment_bytes = min(_LARGEST_SEGMENT_BYTES, budget_bytes // _SEGMENTS_IN_BUDGET)
        self._lock = threading.Lock()
        self._lock_file = lock_folder(folder, _LOCK, _IN_USE)
        with _closed_on_error(self._lock_file, folder):
            highest, self._past = _read_state(folder / _STATE)
            self._segments = []
            for path in sorted(folder.glob("*.spool")):
                segment, discarded_bytes = _load(path)
                self.discarded_bytes += discarded_bytes
                self._segments += [segment] if segment is not None else []
        boots = [highest, *(segment.boot_id for segment in self._segments)]
        self.boot_id = max(time.time_ns(), max(boots) + 1)
        """Higher than any before, also where the wall clock went back in between."""
        self._next: dict[str, int] = {}
        self._file: int | None = None
        self._unsynced: list[int] = []
        self._number = 0

    def append(self, stream: str, sequence: int, payload: bytes) -> None:
        """Add a message of this boot; the sequences of each stream ascend. May raise OSError."""
        name = stream.encode("ascii")
        body = _RECORD.pack(0, _RECORD.size - _RECORD_PREFIX + len(name) + len(payload), sequence,
                            len(name))[4:] + name + payload  # fmt: skip
        record = zlib.crc32(body).to_bytes(4, "big") + body
        with self._lock:
            self._next[stream] = sequence + 1
            if self._file is None or self._segments[-1].size >= self._segment_bytes:
                self._begin_segment()
            segment = self._segments[-1]
            self._write(segment, record)
            segment.streams.setdefault(stream, Intervals()).add(sequence)

    def sync(self) -> None:
        """Sync everything appended so far to the disk, and keep to the budget."""
        with self._lock:
            self._enforce_budget()
            files, self._unsynced = self._unsynced, []
            if self._file is not None:
                files.append(os.dup(self._file))
        for file in files:
            try:
                os.fsync(file)
            finally:
                os.close(file)

    def read(
        self,
        stream: str,
        boot_id: int,
        first: int,
        last: int,
        *,
        max_messages: int = PAGE_MESSAGES,
        max_bytes: int = PAGE_BYTES,
    ) -> Page:
        """Return the held messages from first to last, as many as a page takes."""
        with self._lock:
            segments = [
                (segment.path, segment.size)
                for segment in self._segments
                if segment.boot_id == boot_id and segment.holds_any(stream, first, last)
            ]
        found: list[SpooledMessage] = []
        used = 0
        for path, size in segments:
            for record in _records(_read_file(path, size)):
                if record.stream != stream or not first <= record.sequence <= last:
                    continue
                if found and (len(found) >= max_messages or used + len(record.payload) > max_bytes):
                    return Page(found, record.sequence)
                found.append(SpooledMessage(record.sequence, record.payload))
                used += len(record.payload)
        return Page(found, None)

    def contents(self, stream: str) -> list[SpoolBoot]:
        """Return the held ranges of a stream, boot by boot, oldest first."""
        with self._lock:
            return self._contents(stream)

    def streams(self) -> list[str]:
        """Return the names of all known streams."""
        with self._lock:
            names = {name for segment in self._segments for name in segment.streams}
            return sorted(names | set(self._next) | {name for name, _ in self._past})

    def confirm(self, durable: Mapping[tuple[str, int], int]) -> None:
        """Free messages on a logger's disk: highest contiguous sequence by (stream, boot_id)."""
        with self._lock:
            changed = False
            for name, sequence in durable.items():
                past = self._past.get(name)
                known = past is not None or any(
                    segment.boot_id == name[1] and name[0] in segment.streams
                    for segment in self._segments
                )
                if known and (past is None or sequence > past.durable):
                    self._past.setdefault(name, _BootTotals()).durable = sequence
                    changed = True
            if not changed:
                return
            # The current boot keeps its open segment.
            done = [
                segment
                for segment in (self._segments if self._file is None else self._segments[:-1])
                if self._is_durable(segment)
            ]
            self._delete(done)

    def dropped(self) -> int:
        """Return the number of messages dropped for space before any logger had them."""
        with self._lock:
            return sum(past.dropped.size for past in self._past.values())

    def close(self) -> None:
        """Sync, and unlock the folder. Nothing can be appended any more."""
        try:
            self.sync()
        finally:
            with self._lock:
                if self._file is not None:
                    os.close(self._file)
                    self._file = None
                self._delete([segment for segment in self._segments if self._is_durable(segment)])
                os.close(self._lock_file)

    def _contents(self, stream: str) -> list[SpoolBoot]:
        by_boot: dict[int, Intervals] = {}
        for segment in self._segments:
            if stream in segment.streams:
                numbers = by_boot.setdefault(segment.boot_id, Intervals())
                for first, last in segment.streams[stream].ranges():
                    numbers.add_range(first, last)
        boots = set(by_boot) | {boot_id for name, boot_id in self._past if name == stream}
        if stream in self._next:
            boots.add(self.boot_id)
        contents = []
        for boot_id in sorted(boots):
            numbers = by_boot.get(boot_id, Intervals())
            past = self._past.get((stream, boot_id), _BootTotals())
            highest = max(numbers.highest or 0, past.durable, past.dropped.highest or 0)
            next_sequence = self._next.get(stream, 0) if boot_id == self.boot_id else highest + 1
            contents.append(
                SpoolBoot(boot_id, next_sequence, numbers.ranges(), past.durable, past.dropped.size)
            )
        return contents

    def _begin_segment(self) -> None:
        path = self.folder / f"{self.boot_id:020d}-{self._number:06d}.spool"
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        self._number += 1
        if self._file is not None:
            self._unsynced.append(self._file)
        self._file = file
        segment = _Segment(path, self.boot_id)
        self._segments.append(segment)
        header = _HEADER.pack(_MAGIC, self.boot_id, zlib.crc32(_MAGIC + _boot(self.boot_id)))
        self._write(segment, header)
        folder = os.open(self.folder, os.O_RDONLY)
        self._unsynced.append(folder)

    def _write(self, segment: "_Segment", data: bytes) -> None:
        assert self._file is not None  # noqa: S101  # narrowed for the type checker
        try:
            written = os.write(self._file, data)
            if written != len(data):
                raise OSError(28, "No space left on device")
        except OSError:
            # An incomplete record in the middle would hide those after it.
            os.ftruncate(self._file, segment.size)
            raise
        segment.size += written

    def _is_durable(self, segment: "_Segment") -> bool:
        return all(
            (numbers.highest or 0) <= self._past.get((name, segment.boot_id), _BootTotals()).durable
            for name, numbers in segment.streams.items()
        )

    def _enforce_budget(self) -> None:
        total = sum(segment.size for segment in self._segments)
        doomed = []
        for segment in self._segments[:-1]:
            if total <= self.budget_bytes:
                break
            total -= segment.size
            doomed.append(segment)
            lost = 0
            for name, numbers in segment.streams.items():
                past = self._past.setdefault((name, segment.boot_id), _BootTotals())
                for first, last in numbers.ranges():
                    lost += past.dropped.add_range(max(first, past.durable + 1), last)
            if lost:
                _log.error("%s: full, %d messages that no logger has were lost", self.folder, lost)
        self._delete(doomed)

    def _delete(self, doomed: list["_Segment"]) -> None:
        if not doomed:
            return
        gone = {id(segment) for segment in doomed}
        self._segments = [segment for segment in self._segments if id(segment) not in gone]
        self._forget_old_boots()
        _write_state(self.folder / _STATE, self.boot_id, self._past)
        for segment in doomed:
            segment.path.unlink(missing_ok=True)

    def _forget_old_boots(self) -> None:
        """Forget boots without held and without lost messages."""
        held = {(name, segment.boot_id) for segment in self._segments for name in segment.streams}
        for name, past in list(self._past.items()):
            settled = not past.dropped.size or (past.dropped.highest or 0) <= past.durable
            if name not in held and (name[1] != self.boot_id or self._file is None) and settled:
                del self._past[name]
        boots = sorted({boot_id for _, boot_id in self._past})
        for boot_id in boots[:-_BOOTS_REMEMBERED]:
            for name in [name for name in self._past if name[1] == boot_id and name not in held]:
                del self._past[name]


@dataclass
class _BootTotals:
    durable: int = -1
    dropped: Intervals = field(default_factory=Intervals)


@dataclass
class _Segment:
    path: Path
    boot_id: int
    size: int = 0
    streams: dict[str, Intervals] = field(default_factory=dict)

    def holds_any(self, stream: str, first: int, last: int) -> bool:
        numbers = self.streams.get(stream)
        return numbers is not None and any(a <= last and b >= first for a, b in numbers.ranges())


def _load(path: Path) -> tuple[_Segment | None, int]:
    """Return a segment of an earlier boot, None if nothing is left, and the number of cut bytes."""
    content = _read_file(path, path.stat().st_size)
    boot_id = _boot_of(path, content)
    if boot_id is None:
        _log.warning("%s: not a segment of a spool, removed (%d bytes)", path, len(content))
        path.unlink()
        return None, len(content)
    segment = _Segment(path, boot_id, _HEADER.size)
    for record in _records(content):
        segment.streams.setdefault(record.stream, Intervals()).add(record.sequence)
        segment.size = record.end
    torn = len(content) - segment.size
    if torn:
        _log.warning("%s: removed %d incomplete bytes at its end", path, torn)
        os.truncate(path, segment.size)
    if not segment.streams:
        path.unlink()
        return None, torn
    return segment, torn


class _Record(NamedTuple):
    stream: str
    sequence: int
    payload: bytes
    end: int


def _records(content: bytes) -> Iterator[_Record]:
    """Yield the intact records; skip a damaged one if the next one can be found."""
    at = _HEADER.size
    while at + _RECORD.size <= len(content):
        crc, length, sequence, name_length = _RECORD.unpack_from(content, at)
        end = at + _RECORD_PREFIX + length
        if end > len(content) or end < at + _RECORD.size:
            return
        if zlib.crc32(memoryview(content)[at + 4 : end]) == crc:
            start = at + _RECORD.size
            name = content[start : start + name_length].decode("ascii", errors="replace")
            yield _Record(name, sequence, content[start + name_length : end], end)
        at = end


def _boot(boot_id: int) -> bytes:
    return boot_id.to_bytes(8, "big")


def _boot_of(path: Path, content: bytes) -> int | None:
    """Return the boot of a segment; raise InputError if its format is another program's."""
    if len(content) < _HEADER.size:
        return None
    magic, boot_id, crc = _HEADER.unpack_from(content)
    if zlib.crc32(magic + _boot(boot_id)) != crc or magic[:7] != _MAGIC[:7]:
        return None
    if magic != _MAGIC:
        raise InputError(f"{path}: is of spool format {magic!r}, this program knows {_MAGIC!r}")
    return int(boot_id)


def _read_file(path: Path, size: int) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(size)
    except FileNotFoundError:  # freed in the meantime
        return b""


@contextlib.contextmanager
def _closed_on_error(file: int, folder: Path) -> Iterator[None]:
    try:
        yield
    except BaseException as error:
        os.close(file)
        if isinstance(error, OSError):
            raise FailureError(f"{folder}: cannot be read: {error.strerror}") from None
        raise


def _read_state(path: Path) -> tuple[int, dict[tuple[str, int], _BootTotals]]:
    """Return the boot that wrote it, and the fate of messages by (stream, boot_id)."""
    if not path.exists():
        return 0, {}
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        entries: list[dict[str, Any]] = content["streams"]
        state = {}
        for entry in entries:
            past = _BootTotals(int(entry["durable"]))
            for first, last in entry["dropped"]:
                past.dropped.add_range(int(first), int(last))
            state[(str(entry["stream"]), int(entry["boot_id"]))] = past
        return int(content["boot_id"]), state
    except (ValueError, KeyError, TypeError) as error:
        _log.warning("%s: unreadable (%s), confirmed messages will be offered again", path, error)
        return 0, {}


def _write_state(path: Path, boot_id: int, past: Mapping[tuple[str, int], _BootTotals]) -> None:
    entries = [
        {
            "stream": stream,
            "boot_id": boot_id,
            "durable": one.durable,
            "dropped": one.dropped.ranges(),
        }
        for (stream, boot_id), one in sorted(past.items())
    ]
    write_atomically(path, json.dumps({"boot_id": boot_id, "streams": entries}))
