"""Store of results in a folder, by a hash of their input: a killed command resumes from it.

Immutable Parquet files, `HASH.parquet`, named by their content, are written under another name and
renamed, so they are complete or absent. A row has the hash of the input (`content`), the crossing's
columns of a table, the result itself, and the head of its results file (`header`); the latter two
are JSON compressed by zstd. Any number of processes may write; a crossing that two have written is
read once. An unreadable file is a problem and not a loss: its crossings are identified again.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import zstandard
from pydantic import ValidationError

from schemas.results import CrossingResult, ResultHeader, Results, load_results, results
from services.common.errors import InputError
from services.common.files import check_ordinary, make_folder, write_atomically
from services.common.parquet_files import FILES, ReadLimits, arrow, decoded, encoded
from services.execution.task_hash import combined_hash
from services.identification.bridge_state import with_common_shares
from services.identification.known import search_hash

if TYPE_CHECKING:
    import pyarrow as pa

FORMAT_VERSION: Final = "1"
KEY: Final = "driveby.identified"
BRIDGES: Final = "bridges.json"
"""Results file next to the results, with the bridges alone, of the run that ended last."""
_MAX_AT_ONCE = 1000
"""Number of crossings read into memory at once, some 20 MB."""
_MOST: Final = ReadLimits(rows=1_000_000, bytes=4 << 30)
"""Limits of a file; ours have some hundred rows, and 50 kB for each."""
_MAX_BYTES: Final = 64 << 20
"""Maximum size of one result as text."""
_STRING: Final = "string"
_BINARY: Final = "binary"
_KINDS: Final = {
    "content": _STRING,
    "crossing_id": _STRING,
    "realm": _STRING,
    "result": _BINARY,
    "header": _BINARY,
}
_UNREADABLE = (ValueError, TypeError, IndexError, InputError, zstandard.ZstdError, ValidationError)


class StoredResult(NamedTuple):
    """A result, and the hash of its input."""

    content: str
    crossing: CrossingResult


class _RowLocation(NamedTuple):
    path: Path
    row: int


class ResultStore:
    """The results of a folder, which is created if it is absent.

    Raise InputError if the folder is not writable.
    """

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        self._folder = folder
        self.problems: list[str] = []
        """Unreadable files, one line each."""
        self._locations: dict[str, list[_RowLocation]] = {}
        """Rows with the result of an input: several, if one was damaged and computed again."""
        self._read: tuple[Path, tuple[tuple[bytes, bytes], ...]] | None = None
        for path, table in _tables(folder, self.problems.append, "content"):
            for row, name in enumerate(table.column("content").to_pylist()):
                if isinstance(name, str):
                    self._locations.setdefault(name, []).append(_RowLocation(path, row))

    def __len__(self) -> int:
        return len(self._locations)

    def result(self, content: str) -> CrossingResult | None:
        """Return the result of an input; None if there is none, or it is unreadable."""
        for place in list(self._locations.get(content, ())):
            try:
                header, result = self._rows(place.path)[place.row]
                _header_of(header)  # a result without a valid header is unusable
                return _crossing_of(result)
            except _UNREADABLE as error:
                self.problems.append(_line_of(place.path, place.row, error))
                self._locations[content].remove(place)
        self._locations.pop(content, None)
        return None

    def put(self, found: Iterable[StoredResult], header: ResultHeader) -> Path | None:
        """Write a run's results as one file and sync it; return None if there are none."""
        ordered = sorted(found, key=lambda one: (one.crossing.entry_time, one.content))
        if not ordered:
            return None
        path = self._folder / f"{combined_hash(one.content for one in ordered)}.parquet"
        write_atomically(path, _file_of(ordered, header))
        self._read = None
        self._locations |= {
            one.content: [_RowLocation(path, row)] for row, one in enumerate(ordered)
        }
        return path

    def crossings(self) -> Iterator[CrossingResult]:
        """Yield all readable results."""
        for content in sorted(self._locations, key=lambda name: self._locations[name]):
            crossing = self.result(content)
            if crossing is not None:
                yield crossing

    def _rows(self, path: Path) -> tuple[tuple[bytes, bytes], ...]:
        """Return the heads and results of a file, cached because neighbours are read one by one."""
        if self._read is None or self._read[0] != path:
            found = _table(path, "header", "result")
            both = (found[name].to_pylist() for name in ("header", "result"))
            self._read = path, tuple(zip(*both, strict=True))
        return self._read[1]


def files_of(folder: Path) -> list[Path]:
    """Return the files of results in a folder."""
    return sorted(folder.glob(FILES))


def kept_results(folder: Path, problem: Callable[[str], object]) -> Iterator[Results]:
    """Yield all results of a folder once, as results files of at most a thousand crossings.

    Crossings have the shares of their wheel-path groups from the folder's bridges, as in the JSON
    that `identify` writes; these then are as new as the bridges. `problem` is called with a line
    for each unreadable file or row.
    """
    bridges = _bridges_of(folder, problem)
    waiting: dict[bytes, list[CrossingResult]] = {}
    for header, crossing in _rows_of(folder, problem):
        some = waiting.setdefault(header, [])
        some.append(crossing)
        if len(some) >= _MAX_AT_ONCE:
            yield _as_file(header, waiting.pop(header), bridges)
    for header, some in waiting.items():
        yield _as_file(header, some, bridges)


def _bridges_of(folder: Path, problem: Callable[[str], object]) -> Results | None:
    try:
        return load_results(folder / BRIDGES)
    except InputError as error:
        problem(
            f"{error}; crossings lack the shared fractions of their wheel-path groups; run "
            "identify --into again"
        )
        return None


def _rows_of(
    folder: Path, problem: Callable[[str], object]
) -> Iterator[tuple[bytes, CrossingResult]]:
    """Yield the newest result of each crossing by each search, with its header.

    A recording that was longer, or recovered, gives another result of the same crossing. A result
    in two files is read from the readable one.
    """
    newest = _newest_of(folder)
    seen: set[str] = set()
    for path, table in _tables(folder, problem, "content", "header", "result"):
        for number, row in enumerate(table.to_pylist()):
            if row["content"] in seen or row["content"] not in newest:
                continue
            try:
                _header_of(row["header"])
                crossing = _crossing_of(row["result"])
            except _UNREADABLE as error:
                problem(_line_of(path, number, error))
                continue
            seen.add(row["content"])
            yield row["header"], crossing


def _newest_of(folder: Path) -> set[str]:
    """Return the hashes of the newest results; unreadable rows are reported by the caller."""
    newest: dict[tuple[str, ...], tuple[float, str]] = {}
    unknown: set[str] = set()
    columns = ("content", "crossing_id", "realm", "header")
    for _, table in _tables(folder, lambda _: None, *columns):
        for row in table.to_pylist():
            content = row["content"]
            try:
                header = _header_of(row["header"])
            except _UNREADABLE:
                unknown.add(content)
                continue
            name = (row["realm"], row["crossing_id"], *_search_of(header))
            made = (header.created, content)
            newest[name] = max(newest.get(name, made), made)
    return unknown | {content for _, content in newest.values()}


def _as_file(header: bytes, crossings: list[CrossingResult], bridges: Results | None) -> Results:
    head = _header_of(header)
    if bridges is None or _search_of(head) != _search_of(bridges):
        return head.model_copy(update={"crossings": tuple(crossings)})
    shared = with_common_shares(crossings, bridges.bridges)
    return head.model_copy(update={"crossings": tuple(shared), "created": bridges.created})


def _search_of(head: Results) -> tuple[str, str]:
    """Return the version and search by which two runs' results may be fused."""
    header = ResultHeader(head.version, head.created, head.site_hash, head.settings, head.seed)
    return head.version, search_hash(header)


@cache
def _header_of(compressed: bytes) -> Results:
    """Return a results file without crossings, which carries the head of one."""
    return Results.model_validate_json(_text_of(compressed))


def _crossing_of(compressed: bytes) -> CrossingResult:
    return CrossingResult.model_validate_json(_text_of(compressed))


def _text_of(compressed: bytes) -> bytes:
    """Return the decompressed text; ValueError if it declares a size beyond any result."""
    size = zstandard.frame_content_size(compressed)
    if not 0 <= size <= _MAX_BYTES:
        raise ValueError(f"{size} bytes are no result")
    return zstandard.decompress(compressed)


def _tables(
    folder: Path, problem: Callable[[str], object], *columns: str
) -> Iterator[tuple[Path, "pa.Table"]]:
    """Yield columns of all files of results; call `problem` with a line for an unreadable one."""
    for path in files_of(folder):
        try:
            table = _table(path, *columns)
        except ValueError as error:
            problem(f"{path}: left out: {error}")
        else:
            yield path, table


def _table(path: Path, *columns: str) -> "pa.Table":
    """Return columns of a file of results; ValueError if it is none."""
    try:
        check_ordinary(path)
    except InputError as error:
        raise ValueError(str(error).removeprefix(f"{path}: ")) from None
    table = decoded(path, KEY, FORMAT_VERSION, list(columns), _MOST)
    kinds = [(field.name, str(field.type)) for field in table.schema]
    if sorted(kinds) != sorted((name, _KINDS[name]) for name in columns):
        raise ValueError(f"has columns {kinds} where results have others")
    return table


def _line_of(path: Path, row: int, error: Exception) -> str:
    return f"{path}: row {row + 1}: left out: {' '.join(str(error).split())[:120]}"


def _file_of(found: list[StoredResult], header: ResultHeader) -> bytes:
    pa = arrow()

    crossings = [one.crossing for one in found]
    head = zstandard.compress(results(header, [], {}).model_dump_json().encode())
    table = pa.table(
        {
            "content": [one.content for one in found],
            **{
                name: [getattr(crossing, name) for crossing in crossings]
                for name in ("crossing_id", "realm", "vehicle", "bridge", "entry_time", "verdict")
            },
            "result": pa.array(
                [zstandard.compress(c.model_dump_json().encode()) for c in crossings], pa.binary()
            ),
            "header": pa.array([head] * len(found), pa.binary()),
        }
    )
    return encoded(table, KEY, FORMAT_VERSION, compression="none")
