"""Results in a folder, found again by what they were made from: who was killed goes on from there.

Immutable Parquet files, `HASH.parquet`, called by what is in them and written beside and renamed:
they are whole or absent. A row has the content that a result was made from (`content`), what a
table tells of the crossing, the result itself, and what a results file says at its head (`header`),
both JSON compressed by zstd. Any number of processes may write; a crossing that two have written is
read once. A file that cannot be read is a problem and not a loss: its crossings are identified
again.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import zstandard
from pydantic import ValidationError

from schemas.results import Crossing, Header, Results, load_results, results
from services.common.errors import InputError
from services.common.files import check_ordinary, make_folder, write_atomically
from services.common.parquet_files import FILES, Most, decoded, encoded
from services.execution.content import content_of_all
from services.identification.bridge_state import with_common_shares
from services.identification.known import search_hash

if TYPE_CHECKING:
    import pyarrow as pa

EDITION: Final = "1"
KEY: Final = "driveby.identified"
BRIDGES: Final = "bridges.json"
"""Beside the results: a results file with the bridges alone, by the run that ended last."""
_MOST_AT_ONCE = 1000
"""Crossings that are read before they are handed over: some 20 MB."""
_MOST: Final = Most(rows=1_000_000, bytes=4 << 30)
"""Of a file; ours have some hundred rows, and 50 kB for each."""
_MOST_BYTES: Final = 64 << 20
"""Of one result as text."""
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


class Result(NamedTuple):
    """A result, and the hash of what it was made from."""

    content: str
    crossing: Crossing


class _Place(NamedTuple):
    path: Path
    row: int


class Kept:
    """The results of a folder, which is made if there is none.

    InputError if nothing can be written there.
    """

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        self._folder = folder
        self.problems: list[str] = []
        """Files that cannot be read, a line each."""
        self._places: dict[str, list[_Place]] = {}
        """Where the result of a content is: in several files, if it was damaged and made again."""
        self._read: tuple[Path, tuple[tuple[bytes, bytes], ...]] | None = None
        for path in files_of(folder):
            try:
                contents = _table(path, "content").column("content").to_pylist()
            except ValueError as error:
                self.problems.append(f"{path}: left out: {error}")
                continue
            named = ((row, name) for row, name in enumerate(contents) if isinstance(name, str))
            for row, name in named:
                self._places.setdefault(name, []).append(_Place(path, row))

    def __len__(self) -> int:
        return len(self._places)

    def result(self, content: str) -> Crossing | None:
        """The result made from it; None if there is none, or what is there cannot be read."""
        for place in list(self._places.get(content, ())):
            try:
                header, result = self._rows(place.path)[place.row]
                _header_of(header)  # without which nobody else can read the result
                return _crossing_of(result)
            except _UNREADABLE as error:
                self.problems.append(_line_of(place.path, place.row, error))
                self._places[content].remove(place)
        self._places.pop(content, None)
        return None

    def put(self, found: Iterable[Result], header: Header) -> Path | None:
        """A run's results as one file, on the disk when this returns; None if there are none."""
        ordered = sorted(found, key=lambda one: (one.crossing.entry_time, one.content))
        if not ordered:
            return None
        path = self._folder / f"{content_of_all(one.content for one in ordered)}.parquet"
        write_atomically(path, _file_of(ordered, header))
        self._read = None
        self._places |= {one.content: [_Place(path, row)] for row, one in enumerate(ordered)}
        return path

    def crossings(self) -> Iterator[Crossing]:
        """All results that can be read, one after another."""
        for content in sorted(self._places, key=lambda name: self._places[name]):
            crossing = self.result(content)
            if crossing is not None:
                yield crossing

    def _rows(self, path: Path) -> tuple[tuple[bytes, bytes], ...]:
        """The heads and results of a file, which are kept: neighbours are asked for one after
        another."""
        if self._read is None or self._read[0] != path:
            found = _table(path, "header", "result")
            both = (found[name].to_pylist() for name in ("header", "result"))
            self._read = path, tuple(zip(*both, strict=True))
        return self._read[1]


def files_of(folder: Path) -> list[Path]:
    """The files of results in a folder."""
    return sorted(folder.glob(FILES))


def kept_results(folder: Path, problem: Callable[[str], object]) -> Iterator[Results]:
    """All results of a folder, each once, as results files of a thousand crossings at most.

    Crossings have the shares of their tracks from the folder's bridges, as in what `identify`
    writes as JSON; these then are as new as the bridges. `problem` is given a line for each file,
    or row of one, that cannot be read.
    """
    bridges = _bridges_of(folder, problem)
    waiting: dict[bytes, list[Crossing]] = {}
    for header, crossing in _rows_of(folder, problem):
        some = waiting.setdefault(header, [])
        some.append(crossing)
        if len(some) >= _MOST_AT_ONCE:
            yield _as_file(header, waiting.pop(header), bridges)
    for header, some in waiting.items():
        yield _as_file(header, some, bridges)


def _bridges_of(folder: Path, problem: Callable[[str], object]) -> Results | None:
    try:
        return load_results(folder / BRIDGES)
    except InputError as error:
        problem(f"{error}; crossings have no shares of their tracks, run identify --into again")
        return None


def _rows_of(folder: Path, problem: Callable[[str], object]) -> Iterator[tuple[bytes, Crossing]]:
    """The newest result of each crossing by each search, with its header.

    A recording that has become longer, or whole, gives another result of the same crossing. One
    that two files have counts where it can be read.
    """
    newest = _newest_of(folder)
    seen: set[str] = set()
    for path in files_of(folder):
        try:
            rows = _table(path, "content", "header", "result").to_pylist()
        except ValueError as error:
            problem(f"{path}: left out: {error}")
            continue
        for number, row in enumerate(rows):
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
    """The contents of the results that count; what cannot be read is told by who reads it all."""
    newest: dict[tuple[str, ...], tuple[float, str]] = {}
    unknown: set[str] = set()
    for path in files_of(folder):
        try:
            rows = _table(path, "content", "crossing_id", "realm", "header").to_pylist()
        except ValueError:
            continue
        for row in rows:
            content = row["content"]
            try:
                told = _header_of(row["header"])
            except _UNREADABLE:
                unknown.add(content)
                continue
            whose = (row["realm"], row["crossing_id"], *_search_of(told))
            made = (told.created, content)
            newest[whose] = max(newest.get(whose, made), made)
    return unknown | {content for _, content in newest.values()}


def _as_file(header: bytes, crossings: list[Crossing], bridges: Results | None) -> Results:
    told = _header_of(header)
    if bridges is None or _search_of(told) != _search_of(bridges):
        return told.model_copy(update={"crossings": tuple(crossings)})
    shared = with_common_shares(crossings, bridges.bridges)
    return told.model_copy(update={"crossings": tuple(shared), "created": bridges.created})


def _search_of(told: Results) -> tuple[str, str]:
    """What two runs have in common whose results may be fused."""
    header = Header(told.version, told.created, told.site_hash, told.settings, told.seed)
    return told.version, search_hash(header)


@cache
def _header_of(compressed: bytes) -> Results:
    """A results file without crossings, which says what is at the head of one."""
    return Results.model_validate_json(_text_of(compressed))


def _crossing_of(compressed: bytes) -> Crossing:
    return Crossing.model_validate_json(_text_of(compressed))


def _text_of(compressed: bytes) -> bytes:
    """What was compressed; ValueError if it says that it is larger than any result."""
    size = zstandard.frame_content_size(compressed)
    if not 0 <= size <= _MOST_BYTES:
        raise ValueError(f"{size} bytes are no result")
    return zstandard.decompress(compressed)


def _table(path: Path, *columns: str) -> "pa.Table":
    """Columns of a file of results; ValueError if it is none."""
    try:
        check_ordinary(path)
    except InputError as error:
        raise ValueError(str(error).removeprefix(f"{path}: ")) from None
    table = decoded(path, KEY, EDITION, list(columns), _MOST)
    kinds = [(field.name, str(field.type)) for field in table.schema]
    if sorted(kinds) != sorted((name, _KINDS[name]) for name in columns):
        raise ValueError(f"has columns {kinds} where results have others")
    return table


def _line_of(path: Path, row: int, error: Exception) -> str:
    return f"{path}: row {row + 1}: left out: {' '.join(str(error).split())[:120]}"


def _file_of(found: list[Result], header: Header) -> bytes:
    import pyarrow as pa

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
    return encoded(table, KEY, EDITION, compression="none")
