"""Input of the reading of tables, and its findings for one run, file by file."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from schemas.site import Site, Vehicle
from services.drives.tables.guesses import Guess, GuessKind
from services.drives.tables.mapping import ColumnMap, FileMap
from services.drives.tables.parts import TablePart


class Target(NamedTuple):
    """Information available before the files are read: site file, truck, options."""

    site: Site
    vehicle: Vehicle
    declared_hz: float
    zone: str | None = None
    start: str | None = None
    is_draft: bool = False
    """Whether a missing zone or unit is left open in the map, and shown as UTC or m/s²."""


class Findings:
    """Guesses, and additions to the maps of one run's files."""

    def __init__(self, parts: Sequence[TablePart], guesses: list[Guess]) -> None:
        self._parts = parts
        self._guesses = guesses
        self._files: dict[str, dict[str, Any]] = {part.name: {} for part in parts}
        self._times: dict[str, dict[str, Any]] = {part.name: {} for part in parts}
        self._columns: dict[str, dict[str, ColumnMap]] = {
            part.name: dict(part.found.columns) for part in parts
        }

    def guess(self, part: TablePart, words: str, kind: GuessKind = "converts") -> None:
        """Record a guess about a file."""
        self._guesses.append(Guess(part.name, words, kind))

    def file(self, part: TablePart, **values: object) -> None:
        """Record values of a file's map."""
        self._files[part.name].update(values)

    def time(self, part: TablePart, **values: object) -> None:
        """Record values of the map of a file's times."""
        self._times[part.name].update(values)

    def column(self, part: TablePart, name: str, **values: object) -> None:
        """Record values of the map of one quantity."""
        columns = self._columns[part.name]
        columns[name] = columns[name].model_copy(update=values)

    def swap(self, part: TablePart, one: str, other: str) -> None:
        """Swap the columns of two quantities."""
        columns = self._columns[part.name]
        columns[one], columns[other] = columns[other], columns[one]

    def maps(self) -> list[FileMap]:
        """Return the map of each file with all findings."""
        return [
            part.found.model_copy(
                update={
                    **self._files[part.name],
                    "columns": self._columns[part.name],
                    "time": part.found.time.model_copy(update=self._times[part.name]),
                }
            )
            for part in self._parts
        ]
