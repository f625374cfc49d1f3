"""One file of a drive as numbers: its columns by quantity, its times, and the guesses."""

from collections.abc import Callable, Sequence
from datetime import tzinfo
from typing import Final, NamedTuple

import numpy as np

from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.naming import count_of
from services.drives.tables.angles import SIDES, angles, sides_of
from services.drives.tables.columns import DATE, TIME, WEEK, ColumnChoice, placed_columns, words_of
from services.drives.tables.dates import (
    date_times,
    is_compact,
    is_time_of_day,
    times_of_day,
)
from services.drives.tables.dialect import Dialect, Sheet, described, is_number
from services.drives.tables.guesses import Guess
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
    gps_times,
    numeric_times,
)
from services.drives.tables.units import is_raw, unit_of

_SECONDS_OF_WEEK: Final = {"tow", "itow", "sow", "gpstow", "gpssow"}
_LONGEST_UPTIME_S: Final = 1e8
_PLAIN: Final = ("utf-8", ",", ".", 1, 0, 2)
"""Dialect of the contract."""


class TablePart(NamedTuple):
    """Content of one file."""

    sheet: Sheet
    given: FileMap
    """Map of the file as given."""
    found: FileMap
    """Map of the file with all findings, but for units and gravity."""
    placed: dict[str, ColumnChoice]
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
        guesses.append(Guess(name, described(sheet.dialect), "form"))
    if sheet.left_out:
        words = (
            f"left out: {count_of(sheet.left_out, 'line')} of comments, end text or a cut-off row"
        )
        guesses.append(Guess(name, words, "lost"))
    _check_headers(sheet, placed, given)
    unused = [head for head in unused if head]
    if unused:
        absent = [one for one in channels if one not in placed]
        if len(placed) > len(absent) > 0 and set(placed) & set(channels) and not given.columns:
            raise InputError(
                f'{sheet.path}: no column is {absent[0]}, and "{unused[0][:40]}" is not known: '
                "assign them in [file.columns] of a map (--map)"
            )
        guesses.append(Guess(name, f"not used: {', '.join(unused)[:80]}", "form"))
    for why, how in (("name", "their names"), ("order", "the order of the columns")):
        read = [
            f"{quantity} is {sheet.column_name(one.column)}"
            for quantity, one in placed.items()
            if one.why == why and quantity not in (TIME, DATE, WEEK)
        ]
        if read:
            guesses.append(Guess(name, f"by {how}: {', '.join(read)}", "columns"))
    quantities = [q for q in placed if q not in (TIME, DATE, WEEK)]
    holds_samples = any(q not in POSITION_COLUMNS for q in quantities)
    times = _times(sheet, given.time, placed, declared_hz if holds_samples else 0.0, zone, guesses)
    found = _found(sheet, given, placed, times)
    columns = {q: _numbers(sheet, q, placed[q].column, given) for q in quantities}
    sides = sides_of(sheet, given, placed) if "latitude_deg" in columns else {}
    for quantity, (column, signs) in sides.items():
        columns[quantity] = columns[quantity] * signs
        found.columns[quantity] = found.columns[quantity].model_copy(update={"side": column})
    return TablePart(sheet, given, found, placed, times, columns)


def _numbers(sheet: Sheet, quantity: str, column: int, given: FileMap) -> Floats:
    """Return the numbers of a column; those of a latitude or longitude may be written as angles."""
    values = angles(sheet, column) if quantity in SIDES else None
    values = sheet.values(column) if values is None else values
    factor = given.columns.get(quantity, ColumnMap()).factor
    return values if factor is None else values * factor


def _check_headers(sheet: Sheet, placed: dict[str, ColumnChoice], given: FileMap) -> None:
    """Raise InputError for an acceleration in a converter's unit without a factor."""
    for quantity, one in placed.items():
        own = given.columns.get(quantity, ColumnMap())
        if (
            quantity in (*POSITION_COLUMNS, TIME, DATE, WEEK)
            or one.unit is None
            or not is_raw(one.unit)
            or own.factor is not None
            or own.unit is not None
        ):
            continue
        raise InputError(
            f"{sheet.path}: {sheet.column_name(one.column)} is in {one.unit}, no acceleration: "
            f'give {quantity} = {{ factor = 0.01, unit = "g" }}, the calibrated factor, in '
            "[file.columns] of a map (--map)"
        )


def _is_given(dialect: Dialect, given: FileMap) -> bool:
    keys = ("encoding", "delimiter", "decimal", "header_line", "units_line", "first_line")
    return all(getattr(given, key) == value for key, value in zip(keys, dialect, strict=True))


def _found(sheet: Sheet, given: FileMap, placed: dict[str, ColumnChoice], times: Times) -> FileMap:
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
    placed: dict[str, ColumnChoice],
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
    of_weeks = _times_of_weeks(sheet, given, placed)
    if of_weeks is not None:
        return of_weeks
    texts = sheet.texts(placed[TIME].column)
    if DATE in placed:
        days = sheet.texts(placed[DATE].column)
        texts = [f"{day} {text}" for day, text in zip(days, texts, strict=True)]
    if given.format == "start_samples" and not declared_hz:
        raise InputError(
            f"{where}: the map's format start_samples is for accelerations, positions need a time"
        )
    shown = [text for text in texts if text][:20]
    is_date = given.format in (None, "date") and shown and all(is_compact(t) for t in shown)
    if given.format == "clock" or (shown and all(is_time_of_day(text) for text in shown)):
        return _read(sheet, placed[TIME].column, texts, times_of_day, texts)
    if not is_date and (
        all(is_number(text) for text in shown) or given.format not in (None, "date")
    ):
        values = sheet.values(placed[TIME].column)
        steps = np.diff(values[np.isfinite(values)])
        usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        unit = unit_of(placed[TIME].unit or "")
        times = numeric_times(values, given.format, Steps(usual, declared_hz, unit))
        _check_scale(sheet, placed[TIME].column, times, given)
        if times.format.startswith("unix"):
            _check_years(sheet, placed[TIME].column, times.time_s)
        if given.format is None and times.format not in ("unix_s", "start_s"):
            form = times.format.replace("_", " in ").replace("unix", "since 1970")
            form = form.replace("labview", "since 1904")
            guesses.append(Guess(name, f"times are {form}", "converts"))
        return times
    times = _read(sheet, placed[TIME].column, texts, date_times, texts, given.order, zone)
    if times.order is None:
        raise InputError(
            f'{where}: "{texts[0][:40]}" may be day or month first, give order = "dmy" or "mdy" '
            "in [file.time] of a map (--map)"
        )
    return times


def _times_of_weeks(sheet: Sheet, given: TimeMap, placed: dict[str, ColumnChoice]) -> Times | None:
    """Return the times of GPS weeks and the seconds in them; None for other times."""
    head = words_of(sheet, placed[TIME].column)
    if WEEK in placed or given.week is not None:
        size = len(sheet.lines)
        weeks = np.full(size, float(given.week or 0))
        if given.week is None:
            weeks = sheet.values(placed[WEEK].column)
        if np.nanmin(weeks) < 1043:
            raise InputError(
                f"{sheet.path}: GPS week {np.nanmin(weeks):.0f} is before 2000: counted from a "
                "rollover? weeks since 1980 are expected"
            )
        return Times(gps_times(weeks, sheet.values(placed[TIME].column)), "gps", is_relative=False)
    if given.format is None and head & _SECONDS_OF_WEEK and DATE not in placed:
        raise InputError(
            f"{sheet.path}: {sheet.column_name(placed[TIME].column)} is seconds of a GPS week "
            "without its number: give week = 2437 in [file.time] of a map (--map)"
        )
    return None


def _read(
    sheet: Sheet, column: int, texts: Sequence[str], read: Callable[..., Times], *options: object
) -> Times:
    """Return the times that `read` makes of texts; InputError with the line that is none."""
    try:
        return read(*options)
    except ValueError as error:
        row = error.args[0] if error.args and isinstance(error.args[0], int) else 0
        raise InputError(
            f"{sheet.path}: line {sheet.numbers[row]}: {sheet.column_name(column)} is "
            f'"{texts[row][:40]}", it must be a number or a date with a time as '
            "2026-05-01T09:30:00.000, with a zone as Z or +02:00, if any"
        ) from error


def _check_scale(sheet: Sheet, column: int, times: Times, given: TimeMap) -> None:
    """Raise InputError for numbers that no known start explains, or two of them do."""
    if given.format is not None:
        return
    first = float(np.nanmin(times.time_s)) if np.isfinite(times.time_s).any() else 0.0
    where = f"{sheet.path}: {sheet.column_name(column)}"
    if times.is_relative and first > _LONGEST_UPTIME_S:
        raise InputError(
            f"{where} is {sheet.texts(column)[0][:30]}, no known kind of time: give format in "
            "[file.time] of a map (--map), or convert it to seconds since 1970 UTC"
        )
    if times.format == "unix_s" and words_of(sheet, column) & {"gps", "gpst", "gpstime"}:
        raise InputError(
            f"{where} is in seconds since 1970 UTC, or since 1980 by GPS: give format = "
            '"unix_s" or "gps_s" in [file.time] of a map (--map)'
        )


def _check_years(sheet: Sheet, column: int, time_s: Floats) -> None:
    """Raise InputError if a time since 1970 is outside this century and the next."""
    is_far = (time_s < EARLIEST_S) | (time_s > LATEST_S)
    if is_far.any():
        row = int(np.argmax(is_far))
        raise InputError(
            f"{sheet.path}: line {sheet.numbers[row]}: {sheet.column_name(column)} is "
            f"{sheet.texts(column)[row][:40]}, it must be a time since 1970 as the others are"
        )
