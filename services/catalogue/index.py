"""The catalogue of a folder of recordings: a row for each closed one, in small Parquet files.

They are stored as `_catalog/DAY/HASH.parquet` below the folder, never change, and are named by
their content: two processes that write the same row write the same file. The process that closes a
recording writes a file of one row; `update_catalog` packs the rows of a day into one file and then
removes those that it has read. A crash between the two steps leaves duplicate rows, which are read
once.
"""

import hashlib
import itertools
import json
import logging
import math
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from services.catalogue.deletions import CATALOG as CATALOG
from services.catalogue.deletions import noted_deletions, remove_notes
from services.catalogue.row import CatalogRow, StillOpenError, details_text, file_sha256, row_of
from services.common.errors import FailureError, InputError
from services.common.extras import check_extras
from services.common.files import is_unicode
from services.common.parquet_files import arrow, decoded, encoded
from services.common.stores import (
    Entry,
    Folder,
    files_below,
    folder_at,
    opened,
    put,
    read,
    remove,
)
from services.finding.bridges import Box

_log = logging.getLogger(__name__)
FORMAT_VERSION: Final = "1"
_KEY = "driveby.catalog"
_LATEST_NS = (1 << 63) - 1
"""The latest valid time, in the year 2262."""
ValueT = TypeVar("ValueT")


class CatalogContents(NamedTuple):
    """The catalogue as it is stored."""

    rows: dict[str, CatalogRow]
    """Row by path of the recording."""
    files: dict[str, tuple[CatalogRow, ...]]
    """Rows by file of the catalogue."""
    problems: tuple[str, ...]
    """Unreadable files of the catalogue, one line each."""


class CatalogUpdate(NamedTuple):
    """The catalogue after an update, with what changed."""

    rows: dict[str, CatalogRow]
    added: int
    still_open: int
    """Number of recordings that are being written: they have no row yet."""
    problems: tuple[str, ...]
    """Lost, changed or unreadable recordings and invalid files of rows, one line each."""
    without_row: int
    """Number of closed recordings that could not be read, each of which is among the problems."""
    deleted: int
    """Number of recordings deleted on purpose since the last update; that is no problem."""


def read_catalog(folder: Folder) -> CatalogContents:
    """Read the catalogue of a folder; empty where there is none yet.

    Of two rows of one recording the one of the newer file counts.
    """
    files: dict[str, tuple[CatalogRow, ...]] = {}
    problems: list[str] = []
    for entry in files_below(folder, ".parquet", CATALOG):
        try:
            files[entry.name] = tuple(_rows_of(read(folder, entry.name)))
        except InputError as error:
            problems.append(str(error))
        except ValueError as error:
            problems.append(f"{folder.name}/{entry.name}: left out: {error}")
    rows: dict[str, CatalogRow] = {}
    for row in (row for some in files.values() for row in some):
        before = rows.get(row.path)
        if before is None or (before.modified_ns, before.content) < (row.modified_ns, row.content):
            rows[row.path] = row
    return CatalogContents(rows, files, tuple(problems))


def add(folder: Folder, row: CatalogRow) -> bool:
    """Write a row as a file of its own; return False if it exists already."""
    return _put(folder, [row])[1]


def catalog_closed(folder: Path, recording: Path) -> None:
    """Add the row of a recording that was just closed; a failure is a warning.

    The recording matters more: `driveby catalog` adds a missing row.
    """
    if not has_packages():
        return
    try:
        name = recording.resolve().relative_to(folder.resolve()).as_posix()
        status = recording.stat()
        here = folder_at(str(folder))
        add(here, row_of(here, Entry(name, status.st_size, status.st_mtime_ns)))
    except FileNotFoundError:
        _log.info("%s disappeared; it gets no row in the catalogue", recording.name)
    except (InputError, FailureError, OSError, ValueError) as error:
        _log.warning("%s is not in the catalogue yet: %s", recording.name, error)


@cache
def has_packages() -> bool:
    """Return whether rows can be written; log once how to install the packages otherwise.

    No package is imported.
    """
    try:
        check_extras("the catalogue of recordings", ("history",))
    except InputError as error:
        _log.info("%s; recording without it", error)
        return False
    return True


def catalog_above(recording: Path) -> Path | None:
    """Return the nearest folder above a recording that has a catalogue; None if none has."""
    above = recording.absolute().parents
    return next((folder for folder in above if (folder / CATALOG).is_dir()), None)


def update_catalog(
    folder: Folder, *, verify: bool = False, must_write: bool = True
) -> CatalogUpdate:
    """Update the catalogue to the contents of the folder, and pack it.

    Missing rows are added; rows of lost or changed recordings are reported and dropped, and
    computed again where there is a file. Rows of recordings deleted on purpose are only dropped.
    A file with the size and time of its row is taken to be that file, unless `verify`: then its
    content is read and compared.

    Raise FailureError or InputError if the catalogue cannot be written. Without `must_write` that
    is a warning, for a caller that only needs the rows and may only read the folder.
    """
    before = read_catalog(folder)
    problems = list(before.problems)
    recordings = {e.name: e for e in files_below(folder, ".mcap")}
    rows: dict[str, CatalogRow] = {}
    added = still_open = 0
    gone = before.rows.keys() - recordings.keys()
    deleted = noted_deletions(folder, gone)
    gone -= deleted
    problems += [f"{folder.name}/{path}: is gone; its row is dropped" for path in sorted(gone)]
    for path, entry in recordings.items():
        old = before.rows.get(path)
        if not is_unicode(path):
            problems.append(f"{folder.name}/{path}: the name is not UTF-8; rename it")
            continue
        try:
            if old is not None and (wrong := _contradiction(folder, entry, old, verify=verify)):
                problems.append(
                    f"{folder.name}/{path}: {wrong}; its row is computed again if it can be read"
                )
                old = None
            elif old is not None and old.modified_ns != entry.modified_ns:
                old = old._replace(modified_ns=entry.modified_ns)
            if old is None:
                rows[path] = row_of(folder, entry)
                added += 1
            else:
                rows[path] = old
        except StillOpenError:
            still_open += 1
        except InputError as error:
            problems.append(str(error))
    try:
        _pack(folder, rows, before)
        remove_notes(folder, deleted)
    except (FailureError, InputError) as error:
        if must_write:
            raise
        _log.warning(
            "%s: cannot write its catalogue; the next identification reads these recordings again "
            "(%s)",
            *(folder.name, error),
        )
    without_row = len(recordings) - len(rows) - still_open
    return CatalogUpdate(rows, added, still_open, tuple(problems), without_row, len(deleted))


def _contradiction(folder: Folder, entry: Entry, row: CatalogRow, *, verify: bool) -> str | None:
    """Return how a row contradicts its file; None if it does not."""
    if entry.size_bytes != row.size_bytes:
        return f"has {entry.size_bytes} bytes, not {row.size_bytes} as in its row"
    if entry.modified_ns == row.modified_ns and not verify:
        return None
    with opened(folder, entry.name) as file:
        if file_sha256(file) != row.content:
            return "is not the file of its row, but of the same size"
    if verify:
        now = row_of(folder, entry)
        for what in CatalogRow._fields:
            if what != "modified_ns" and getattr(now, what) != getattr(row, what):
                return f"does not agree with its row: {what} is another"
    return None


def _pack(folder: Folder, rows: dict[str, CatalogRow], before: CatalogContents) -> None:
    """Write the rows of each day into one file, then remove the files that were packed.

    Files that other processes have written meanwhile were not read, and stay.
    """
    days: defaultdict[str, list[CatalogRow]] = defaultdict(list)
    for row in rows.values():
        days[row.day].append(row)
    kept = set()
    for day in sorted(days):
        kept.add(_put(folder, days[day])[0])
    for name in before.files:
        if name not in kept:
            remove(folder, name)


def _put(folder: Folder, rows: list[CatalogRow]) -> tuple[str, bool]:
    """Write rows as a file; return its name, and whether it is new.

    An unreadable file of that name stays where it is; the rows then get another name.
    """
    ordered = sorted(rows, key=lambda row: row.path)
    content = _file_of(ordered)
    for number in itertools.count(1):
        name = _name(ordered, number)
        if put(folder, name, content):
            return name, True
        try:
            _rows_of(read(folder, name))
        except ValueError:  # InputError is one
            continue
        return name, False
    raise AssertionError("numbers do not end")


def _name(ordered: list[CatalogRow], number: int) -> str:
    digest = hashlib.sha256(repr([tuple(row) for row in ordered]).encode()).hexdigest()[:20]
    of_day = digest if number == 1 else f"{digest}-{number}"
    return f"{CATALOG}/{ordered[0].day}/{of_day}.parquet"


def _file_of(rows: list[CatalogRow]) -> bytes:
    pa = arrow()

    boxes = [row.box for row in rows]
    table = pa.table(
        {
            "path": [row.path for row in rows],
            "size_bytes": pa.array([row.size_bytes for row in rows], pa.int64()),
            "modified_ns": pa.array([row.modified_ns for row in rows], pa.int64()),
            "content": pa.array([row.content for row in rows], pa.binary()),
            "first_ns": pa.array([row.first_ns for row in rows], pa.int64()),
            "last_ns": pa.array([row.last_ns for row in rows], pa.int64()),
            **{
                name: pa.array([None if b is None else b[n] for b in boxes], pa.float64())
                for n, name in enumerate(Box._fields)
            },
            "details": [details_text(row) for row in rows],
        }
    )
    return encoded(table, _KEY, FORMAT_VERSION, compression="zstd" if len(rows) > 1 else "none")


def _rows_of(content: bytes) -> list[CatalogRow]:
    """Return the rows of a file; ValueError if it is not of this format version."""
    try:
        return [_row(one) for one in decoded(content, _KEY, FORMAT_VERSION).to_pylist()]
    except KeyError as error:
        raise ValueError(f"is not a file of {_KEY} (lacks {error})") from None
    except (TypeError, AttributeError) as error:
        raise ValueError(f"is not a file of {_KEY} ({error})") from None


def _row(fields: dict[str, Any]) -> CatalogRow:
    """Return a row of a file; KeyError, TypeError or ValueError if it is none."""
    details = json.loads(fields["details"])
    sides = [fields[name] for name in Box._fields]
    row = CatalogRow(
        _of(fields, "path", str),
        _of(fields, "size_bytes", int),
        _of(fields, "modified_ns", int),
        _of(fields, "content", bytes),
        tuple(_of(details, "realms", list)),
        tuple(_of(details, "vehicles", list)),
        _of(fields, "first_ns", int),
        _of(fields, "last_ns", int),
        _of(details, "messages", int),
        _of(details, "rates_hz", dict),
        _of(details, "gaps", int),
        float(details["gap_s"]),
        None if sides[0] is None else Box(*map(float, sides)),
    )
    if not 0 <= row.first_ns <= row.last_ns <= _LATEST_NS:
        raise ValueError(f"{row.path}: has the times {row.first_ns} and {row.last_ns} ns")
    if row.box is not None and not all(map(math.isfinite, row.box)):
        raise ValueError(f"{row.path}: has a box that is not finite")
    return row


def _of(fields: dict[str, Any], name: str, kind: type[ValueT]) -> ValueT:
    value = fields[name]
    if not isinstance(value, kind):
        raise TypeError(f"{name} is {value!r}")
    return value
