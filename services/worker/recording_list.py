"""A logger's recordings that have changed, in groups to read; and trucks still being recorded."""

import logging
import re
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from schemas.signals import NS_PER_S
from schemas.topics import IDENTIFIER
from services.common.errors import InputError
from services.common.naming import count_of
from services.recordings.recording import is_being_written

_log = logging.getLogger(__name__)
_RECORDED_S: Final = 60.0
"""Age in s up to which a growing recording is active; the logger syncs twice a second."""
_FILES_AT_ONCE: Final = 4
"""Number of files read at once: an hour of a truck.

The preceding file is read too, where a crossing may have started.
"""
_NAME: Final = re.compile(rf"({IDENTIFIER})-\d{{8}}T\d{{6}}Z(?:-\d+)?(?:\.recovered)?\.mcap")
_Signature = tuple[int, int]
"""Size, and time of the last change in ns."""
_RECENT_S: Final = 600.0
"""Age in s up to which a recording is needed to decide what its truck sends again.

A truck keeps five minutes of its messages for those that were away.
"""
_GROWS_NS: Final = (1 << 63) - 1
"""Time up to which a growing recording counts as recorded: it will have all that follows."""
_QUIET_S: Final = 120.0
"""Time in s after a truck's last message from which missing data count as lost.

`arrivals` applies the same time to the bus.
"""


class BackfillSource(NamedTuple):
    """Recordings to scan."""

    folder: Path
    """The logger's folder."""
    realm: str
    age_s: float


class _File(NamedTuple):
    path: Path
    signature: _Signature
    is_growing: bool


class RecordingGroup(NamedTuple):
    """Consecutive recordings of one truck; the first may only hold the start of a crossing."""

    vehicle: str
    files: tuple[_File, ...]


class RecordingList:
    """Recordings of a realm, the parts of them to read, and the trucks that are being recorded."""

    def __init__(self, source: BackfillSource) -> None:
        self._source = source
        self._read: dict[Path, _Signature] = {}
        self._is_first = True
        self.groups: deque[RecordingGroup] = deque()
        """Groups to read."""
        self.until_ns: dict[str, int] = {}
        """Wall time in ns up to which a truck is recorded, as far as it was lately."""
        self.final: set[str] = set()
        """Trucks that are no longer being recorded."""

    def clear(self) -> None:
        """Read everything again."""
        self._read.clear()
        self.groups.clear()

    def update(self, now: float, reading: RecordingGroup | None) -> None:
        """List the recordings at `now`, the time in s since 1970; `reading` is being read."""
        by_vehicle = self._by_vehicle(now)
        growing = {v for v, files in by_vehicle.items() if any(f.is_growing for f in files)}
        last_ns = {v: max(f.signature[1] for f in files) for v, files in by_vehicle.items()}
        recent_ns = round((now - _RECENT_S) * NS_PER_S)
        self.until_ns = {v: at_ns for v, at_ns in last_ns.items() if at_ns >= recent_ns}
        self.until_ns |= dict.fromkeys(growing, _GROWS_NS)
        quiet_ns = round((now - _QUIET_S) * NS_PER_S)
        self.final = {
            vehicle
            for vehicle, at_ns in last_ns.items()
            if vehicle not in growing and at_ns < quiet_ns
        }
        seen = {file.path for files in by_vehicle.values() for file in files}
        self._read = {path: signature for path, signature in self._read.items() if path in seen}
        for vehicle, files in by_vehicle.items():
            self.groups += self._changed(vehicle, files, reading)
        if self._is_first and self.groups:
            paths = {file.path for group in self.groups for file in group.files}
            _log.info(
                "reading %s for crossings without a result", count_of(len(paths), "recording")
            )
        self._is_first = False

    def _by_vehicle(self, now: float) -> dict[str, list[_File]]:
        found: dict[str, list[_File]] = {}
        for path in sorted((self._source.folder / self._source.realm).glob("*/*.mcap")):
            named = _NAME.fullmatch(path.name)
            if named is None:
                continue
            try:
                status = path.stat()
                if now - status.st_mtime > self._source.age_s:
                    continue
                is_fresh = now - status.st_mtime < _RECORDED_S
                is_growing = is_fresh and is_being_written(path)
            except (InputError, OSError):
                continue  # it was recovered or deleted at this moment
            signature = (status.st_size, status.st_mtime_ns)
            found.setdefault(named[1], []).append(_File(path, signature, is_growing))
        return found

    def _changed(
        self, vehicle: str, files: list[_File], reading: RecordingGroup | None
    ) -> Iterator[RecordingGroup]:
        """Yield the files not read in their present state, with the preceding ones."""
        waiting = {f.path for group in self.groups for f in group.files[1:]}
        if reading is not None:
            waiting |= {f.path for f in reading.files}
        new = [
            n
            for n, file in enumerate(files)
            if self._read.get(file.path) != file.signature
            and file.path not in waiting
            and (self._is_first or not file.is_growing)
        ]
        while new:
            part = [n for n in new[:_FILES_AT_ONCE] if n - new[0] < _FILES_AT_ONCE]
            new = new[len(part) :]
            begin = max(part[0] - 1, 0)
            for n in part:
                self._read[files[n].path] = files[n].signature
            yield RecordingGroup(vehicle, tuple(files[begin : part[-1] + 1]))
