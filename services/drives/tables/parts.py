"""One file of a drive as numbers: its columns by quantity, its times, and the guesses."""

from collections.abc import Sequence
from datetime import tzinfo
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.drives.tables.columns import DATE, TIME, WEEK, Placed, placed_columns
from services.drives.tables.dialect import Dialect, Sheet, described, is_number
from services.drives.tables.mapping import (
    POSITION_COLUMNS,
    ColumnMap,
    FileMap,
    TimeMap,
)
from services.drives.tables.stamps import (
    EARLIEST_S,
    LATEST_S,
    Steps,
    Times,
    date_times,
    gps_times,
    numeric_times,
)
from services.drives.tables.units import unit_of

Floats = NDArray[np.float64]

_PLAIN: Final = ("utf-8", ",", ".", 1, 0, 2)
"""Dialect of the contract."""


class Guess(NamedTuple):
    """An interpretation that the files do not state explicitly."""

    text: str
    kind: Literal["form", "lost", "converts"]
    """Effect of the guess: form of the text, data left out, or changed numbers to be confirmed."""


class TablePart(NamedTuple):
    """Content of one file."""

    sheet: Sheet
    given: FileMap
    """Map of the file as given."""
    found: FileMap
    """Map of the file with all findings, but for units and gravity."""
    placed: dict[str, Placed]
    times: Times
    columns: dict[str, Floats]
    """Numbers as in the file (n,), NaN where a cell is empty, by quantity."""

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.sheet.path.name

    def has_fixes(self) -> bool:
        """Return whether it has positions."""
        return "latitude_deg" in self.columns and "longitude_deg" in self.columns

    def channels(self) -> list[str]:
        """Return the names of its accelerations."""
        return [name for name in self.columns if name not in POSITION_COLUMNS]


def read_part(
    sheet: Sheet,
    given: FileMap,
    channels: Sequence[str],
    declared_hz: float,
    zone: tzinfo | None,
    guesses: list[Guess],
) -> TablePart:
    """Read the numbers of a table; InputError in one line if something is undetermined."""
    name = sheet.path.name
    placed, unused = placed_columns(sheet, given, channels)
    if tuple(sheet.dialect) != _PLAIN and not _is_given(sheet.dialect, given):
        guesses.append(Guess(f"{name}: {described(sheet.dialect)}", "form"))
    if unused:
        absent = [one for one in channels if one not in placed]
        if len(placed) > len(absent) > 0 and set(placed) & set(channels) and not given.columns:
            raise InputError(
                f'{sheet.path}: no column is {absent[0]}, and "{unused[0][:40]}" is not known: '
                "assign them in [file.columns] of a map (--map)"
            )
        guesses.append(Guess(f"{name}: not used: {', '.join(unused)[:80]}", "form"))
    for why, how in (("name", "their names"), ("order", "the order of the columns")):
        read = [
            f"{quantity} is {sheet.column_name(one.column)}"
            for quantity, one in placed.items()
            if one.why == why and quantity not in (TIME, DATE, WEEK)
        ]
        if read:
            guesses.append(Guess(f"{name}: by {how} {', '.join(read)}", "converts"))
    quantities = [q for q in placed if q not in (TIME, DATE, WEEK)]
    holds_samples = any(q not in POSITION_COLUMNS for q in quantities)
    times = _times(sheet, given.time, placed, declared_hz if holds_samples else 0.0, zone, guesses)
    found = _found(sheet, given, placed, times)
    columns = {q: sheet.values(placed[q].column) for q in quantities}
    return TablePart(sheet, given, found, placed, times, columns)


def _is_given(dialect: Dialect, given: FileMap) -> bool:
    keys = ("encoding", "delimiter", "decimal", "header_line", "units_line", "first_line")
    return all(getattr(given, key) == value for key, value in zip(keys, dialect, strict=True))


def _found(sheet: Sheet, given: FileMap, placed: dict[str, Placed], times: Times) -> FileMap:
    """Return the map with all findings on text, columns and times."""
    dialect = sheet.dialect

    def column(quantity: str) -> int | str | None:
        if quantity not in placed:
            return None
        number = placed[quantity].column
        is_named = number < len(sheet.header) and sheet.header.count(sheet.header[number]) == 1
        return sheet.header[number] if is_named and sheet.header[number] else number + 1

    time = given.time.model_copy(
        update={
            "column": column(TIME),
            "date_column": column(DATE),
            "week_column": column(WEEK),
            "format": times.format,
            "order": times.order or given.time.order,
        }
    )
    columns = {
        quantity: given.columns.get(quantity, ColumnMap()).model_copy(
            update={"column": column(quantity)}
        )
        for quantity in placed
        if quantity not in (TIME, DATE, WEEK)
    }
    return given.model_copy(
        update={
            "name": sheet.path.name,
            "encoding": dialect.encoding,
            "delimiter": dialect.delimiter,
            "decimal": dialect.decimal,
            "header_line": dialect.header_line,
            "units_line": dialect.units_line,
            "first_line": dialect.first_line,
            "time": time,
            "columns": columns,
        }
    )


def _times(
    sheet: Sheet,
    given: TimeMap,
    placed: dict[str, Placed],
    declared_hz: float,
    zone: tzinfo | None,
    guesses: list[Guess],
) -> Times:
    """Return the times of all rows."""
    where, name = str(sheet.path), sheet.path.name
    if TIME not in placed and DATE not in placed:
        raise InputError(
            f"{where}: no column of times is known by its name ({', '.join(sheet.header[:8])}): "
            "give column in [file.time] of a map (--map)"
        )
    if TIME not in placed:
        placed[TIME] = placed.pop(DATE)
    if WEEK in placed:
        weeks = sheet.values(placed[WEEK].column)
        if np.nanmin(weeks) < 1043:
            raise InputError(
                f"{where}: GPS week {np.nanmin(weeks):.0f} is before 2000: counted from a "
                "rollover? weeks since 1980 are expected"
            )
        return Times(gps_times(weeks, sheet.values(placed[TIME].column)), "gps", is_relative=False)
    texts = sheet.texts(placed[TIME].column)
    if DATE in placed:
        days = sheet.texts(placed[DATE].column)
        texts = [f"{day} {text}" for day, text in zip(days, texts, strict=True)]
    if given.format == "start_samples" and not declared_hz:
        raise InputError(
            f"{where}: the map's format start_samples is for accelerations, positions need a time"
        )
    if all(is_number(text) for text in texts[:20]) or given.format not in (None, "date"):
        values = sheet.values(placed[TIME].column)
        steps = np.diff(values[np.isfinite(values)])
        usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        unit = unit_of(placed[TIME].unit or "")
        times = numeric_times(values, given.format, Steps(usual, declared_hz, unit))
        if times.format.startswith("unix"):
            _check_years(sheet, placed[TIME].column, times.time_s)
        if given.format is None and times.format not in ("unix_s", "start_s"):
            shown = times.format.replace("_", " in ").replace("unix", "since 1970")
            guesses.append(Guess(f"{name}: times are {shown}", "converts"))
        return times
    try:
        times = date_times(texts, given.order, zone)
    except ValueError as error:
        row = error.args[0] if error.args and isinstance(error.args[0], int) else 0
        raise InputError(
            f"{where}: line {sheet.numbers[row]}: {sheet.column_name(placed[TIME].column)} is "
            f'"{texts[row][:40]}", it must be a number or a date with a time as '
            "2026-05-01T09:30:00.000"
        ) from error
    if times.order is None:
        raise InputError(
            f'{where}: "{texts[0][:40]}" may be day or month first, give order = "dmy" or "mdy" '
            "in [file.time] of a map (--map)"
        )
    return times


def _check_years(sheet: Sheet, column: int, time_s: Floats) -> None:
    """Raise InputError if a time since 1970 is outside this century and the next."""
    is_far = (time_s < EARLIEST_S) | (time_s > LATEST_S)
    if is_far.any():
        row = int(np.argmax(is_far))
        raise InputError(
            f"{sheet.path}: line {sheet.numbers[row]}: {sheet.column_name(column)} is "
            f"{sheet.texts(column)[row][:40]}, it must be a time since 1970 as the others are"
        )
