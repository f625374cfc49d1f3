"""Results in a folder, found again by what they were made from: who was killed goes on from there.

Immutable Parquet files, `HASH.parquet`, called by what is in them and written beside and renamed:
they are whole or absent. A row has the content that a result was made from (`content`), what a
table tells of the crossing, and the result itself, JSON compressed by zstd. Any number of processes
may write; a crossing that two have written is read once. A file that cannot be read is a problem
and not a loss: its crossings are identified again.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import zstandard
from pydantic import ValidationError

from schemas.results import Crossing
from services.common.errors import InputError
from services.common.files import make_folder, write_atomically
from services.common.parquet_files import FILES, decoded, encoded
from services.execution.content import content_of_all

EDITION: Final = "1"
KEY: Final = "driveby.identified"


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
        self._places: dict[str, _Place] = {}
        self._read: tuple[Path, tuple[bytes, ...]] | None = None
        for path in files_of(folder):
            try:
                contents = decoded(path, KEY, EDITION, ["content"]).column("content").to_pylist()
            except ValueError as error:
                self.problems.append(f"{path}: left out: {error}")
                continue
            self._places |= {name: _Place(path, row) for row, name in enumerate(contents)}

    def __len__(self) -> int:
        return len(self._places)

    def result(self, content: str) -> Crossing | None:
        """The result made from it; None if there is none, or what is there cannot be read."""
        place = self._places.get(content)
        if place is None:
            return None
        try:
            return Crossing.model_validate_json(
                zstandard.decompress(self._rows(place.path)[place.row])
            )
        except (ValueError, IndexError, InputError, zstandard.ZstdError, ValidationError) as error:
            line = " ".join(str(error).split())[:120]
            self.problems.append(f"{place.path}: row {place.row + 1}: left out: {line}")
            del self._places[content]
            return None

    def put(self, found: Iterable[Result]) -> Path | None:
        """Write results as one file, on the disk when this returns; None if there are none."""
        ordered = sorted(found, key=lambda one: (one.crossing.entry_time, one.content))
        if not ordered:
            return None
        path = self._folder / f"{content_of_all(one.content for one in ordered)}.parquet"
        write_atomically(path, _file_of(ordered))
        self._places |= {one.content: _Place(path, row) for row, one in enumerate(ordered)}
        return path

    def crossings(self) -> Iterator[Crossing]:
        """All results that can be read, one after another."""
        for content in sorted(self._places, key=lambda name: self._places[name]):
            crossing = self.result(content)
            if crossing is not None:
                yield crossing

    def _rows(self, path: Path) -> tuple[bytes, ...]:
        """The results of a file, which is kept: neighbours are asked for one after another."""
        if self._read is None or self._read[0] != path:
            self._read = path, tuple(decoded(path, KEY, EDITION, ["result"])["result"].to_pylist())
        return self._read[1]


def files_of(folder: Path) -> list[Path]:
    """The files of results in a folder."""
    return sorted(folder.glob(FILES))


def _file_of(results: list[Result]) -> bytes:
    import pyarrow as pa

    crossings = [one.crossing for one in results]
    table = pa.table(
        {
            "content": [one.content for one in results],
            **{
                name: [getattr(crossing, name) for crossing in crossings]
                for name in ("crossing_id", "realm", "vehicle", "bridge", "entry_time", "verdict")
            },
            "result": pa.array(
                [zstandard.compress(c.model_dump_json().encode()) for c in crossings], pa.binary()
            ),
        }
    )
    return encoded(table, KEY, EDITION, compression="none")
