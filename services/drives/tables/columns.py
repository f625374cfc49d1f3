"""Assignment of a table's columns to quantities: by name, or by position without names."""

import re
import unicodedata
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.drives.tables.dialect import Sheet, is_number
from services.drives.tables.mapping import POSITION_COLUMNS, ColumnName, FileMap
from services.drives.tables.units import unit_in

TIME: Final = "time_s"
DATE: Final = "date"
WEEK: Final = "week"

_EXACT: Final = {name: name for name in (TIME, *POSITION_COLUMNS)}
_WORDS: Final = {
    TIME: "time timestamp t zeit zeitstempel utc uhrzeit epoch datetime datumzeit unixtime tow "
    "itow sow gpstime gpssow gpstow temps horodatage heure horodate tiempo hora orario tijd",
    DATE: "date datum fecha",
    WEEK: "week gpsweek wn woche gpswoche semaine",
    "latitude_deg": "latitude lat breite breitengrad latitud latitudine",
    "longitude_deg": "longitude lon long lng laenge laengengrad länge längengrad longitud "
    "longitudine",
    "altitude_m": "altitude alt height elevation ele hoehe höhe h msl hmsl altitud quota hauteur",
    "speed_mps": "speed velocity geschwindigkeit geschw sog v vel groundspeed gspeed tempo "
    "speedoverground vitesse velocidad velocità velocita snelheid kmh mph kph",
}
_COUNTERS: Final = {"sample", "samples", "index", "scan", "scans", "n", "nr", "no", "row", "zeile"}
"""Names of counters, which are times only where no column has times."""
_BODY: Final = {"body", "sprung", "aufbau", "frame", "chassis", "rahmen", "cabin", "oben", "upper",
                "caisse", "carrosserie", "cassa", "carrozzeria", "carrocería"}  # fmt: skip
_AXLE: Final = {"axle", "unsprung", "wheel", "achse", "rad", "hub", "radtraeger", "unten", "lower",
                "essieu", "roue", "assale", "ruota", "eje", "rueda", "radträger"}  # fmt: skip
_FRONT: Final = {"front", "vorn", "vorne", "va", "f", "v", "fr", "fl", "vl", "vr", "vorderachse",
                 "avant", "av", "anteriore", "delantero", "delantera"}  # fmt: skip
_REAR: Final = {"rear", "back", "hinten", "hinter", "ha", "r", "h", "re", "rl", "rr", "hl", "hr",
                "hinterachse", "arriere", "arrière", "ar", "posteriore", "trasero", "trasera",
                }  # fmt: skip
_VERTICAL: Final = {"z", "az", "vertical", "vertikal", "vert", "verticale", "up", "senkrecht"}
_LEVEL: Final = {"x", "y", "ax", "ay", "lateral", "longitudinal", "quer", "längs", "laengs"}
_FILLERS: Final = {"gps", "gnss", "acc", "accel", "acceleration", "beschleunigung", "deg", "m", "s",
                   "z", "az", "value", "wgs84", "ms", "utc", "unix", "of", "the", "in", "seconds",
                   }  # fmt: skip
_JOINS: Final = {"und", "and", "et", "y", "e", "en"}
_DAY: Final = re.compile(r"\d{1,4}[-./]\w{1,9}[-./]\d{1,4}")
_FEWEST_S: Final = 9e8
"""Smallest number of seconds since 1970 of a drive; numbers from a start are smaller."""


class ColumnChoice(NamedTuple):
    """Column of a quantity, from 0, the unit in its header, and the reason for the choice."""

    column: int
    unit: str | None
    why: str
    """One of "exact", "given", "name" and "order"."""


def placed_columns(
    sheet: Sheet, given: FileMap, channels: Sequence[str]
) -> tuple[dict[str, ColumnChoice], list[str]]:
    """Return the column of each quantity, and the names of unused columns.

    Columns of a table without known names are assigned by their order if their number fits: a time
    and the accelerations, or a time, latitude, longitude, and further altitude and speed.
    """
    found = _given(sheet, given, channels)
    taken = {one.column for one in found.values()}
    candidates = _candidates(sheet, channels, taken)
    for quantity, several in candidates.items():
        if quantity not in found:
            found[quantity] = _only(sheet, quantity, several, channels)
    if TIME not in found and DATE not in found:
        found |= _counter(sheet, found)
    if not set(found) - {TIME, DATE, WEEK}:
        found |= _by_order(sheet, found, channels)
    used = {one.column for one in found.values()}
    unused = [head for column, head in enumerate(sheet.header) if column not in used]
    return found, unused


def _candidates(
    sheet: Sheet, channels: Sequence[str], taken: set[int]
) -> dict[str, list[ColumnChoice]]:
    """Return the columns that a quantity may be by their names, those with exact names alone."""
    found: dict[str, list[ColumnChoice]] = {}
    for column, head in enumerate(sheet.header):
        if column in taken or not sheet.has_cells(column):
            continue
        name, unit = unit_in(head)
        if column < len(sheet.units) and sheet.units[column]:
            unit = sheet.units[column]
        quantity, why = _quantity(head, name, channels)
        if quantity is not None:
            found.setdefault(quantity, []).append(ColumnChoice(column, unit, why))
    for quantity, several in found.items():
        exact = [one for one in several if one.why == "exact"]
        found[quantity] = exact or several
    return found


def _only(
    sheet: Sheet, quantity: str, several: list[ColumnChoice], channels: Sequence[str]
) -> ColumnChoice:
    """Return the one column that a quantity is; InputError where several accelerations may be."""
    if len(several) > 1 and quantity in channels:
        upward = [one for one in several if set(_words(sheet.header[one.column])) & _VERTICAL]
        if len(upward) != 1:
            names = ", ".join(sheet.column_name(one.column) for one in several[:4])
            raise InputError(
                f"{sheet.path}: {quantity} may be {names}: choose one in [file.columns] of a map "
                "(--map)"
            )
        several = upward
    if quantity == TIME:
        return next((one for one in several if _is_absolute(sheet, one.column)), several[0])
    return several[0]


def _is_absolute(sheet: Sheet, column: int) -> bool:
    """Return whether a column has dates, or numbers as large as those since 1970."""
    for row, line in enumerate(sheet.lines):
        if text := line.split(sheet.separator)[column].strip():
            is_large = is_number(text) and abs(sheet.value(row, column)) > _FEWEST_S
            return is_large or _DAY.search(text) is not None
    return False


def _counter(sheet: Sheet, found: dict[str, ColumnChoice]) -> dict[str, ColumnChoice]:
    """Return a column that counts samples, or whose name begins with a word for time."""
    used = {one.column for one in found.values()}
    heads = [(n, _words(unit_in(h)[0])) for n, h in enumerate(sheet.header) if n not in used]
    times = [n for n, words in heads if words and words[0] in _WORDS[TIME].split()]
    times.sort(key=lambda column: not _is_absolute(sheet, column))
    counters = [n for n, words in heads if words and "".join(words) in _COUNTERS]
    chosen = (times + counters)[:1]
    return {TIME: ColumnChoice(chosen[0], _head_unit(sheet, chosen[0]), "name")} if chosen else {}


def column_number(sheet: Sheet, column: ColumnName, key: str) -> int:
    """Return the number, from 0, of a column that a map names; InputError if it does not exist."""
    if isinstance(column, int):
        if column > sheet.width:
            raise InputError(
                f"{sheet.path}: {key} of the map is column {column}, the file has {sheet.width}"
            )
        return column - 1
    if column not in sheet.header:
        known = ", ".join(sheet.header[:12]) or "no header"
        raise InputError(
            f'{sheet.path}: {key} of the map is column "{column}", the file has {known}'
        )
    return sheet.header.index(column)


def _given(sheet: Sheet, given: FileMap, channels: Sequence[str]) -> dict[str, ColumnChoice]:
    """Return the columns that the map names."""
    known = (*POSITION_COLUMNS, *channels)
    found = {}
    for quantity, one in given.columns.items():
        if quantity not in known:
            raise InputError(
                f"{sheet.path}: the map's columns.{quantity} is not known, it must be one of "
                f"{', '.join(known)}"
            )
        if one.column is not None:
            number = column_number(sheet, one.column, f"columns.{quantity}")
            found[quantity] = ColumnChoice(number, _head_unit(sheet, number), "given")
        elif quantity in sheet.header:
            number = sheet.header.index(quantity)
            found[quantity] = ColumnChoice(number, _head_unit(sheet, number), "exact")
    for quantity, column in (
        (TIME, given.time.column),
        (DATE, given.time.date_column),
        (WEEK, given.time.week_column),
    ):
        if column is not None:
            number = column_number(sheet, column, f"time of {quantity}")
            found[quantity] = ColumnChoice(number, _head_unit(sheet, number), "given")
    return found


def _head_unit(sheet: Sheet, column: int) -> str | None:
    if column < len(sheet.units) and sheet.units[column]:
        return sheet.units[column]
    return unit_in(sheet.header[column])[1] if column < len(sheet.header) else None


def _quantity(head: str, name: str, channels: Sequence[str]) -> tuple[str | None, str]:
    """Return the quantity of a column by its name, and how certain that is."""
    if head in channels or head in _EXACT:
        return head, "exact"
    words = _words(name)
    plain = "".join(words)
    for channel in channels:
        if plain == "".join(_words(channel)):
            return channel, "name"
    words_used = [word for word in words if word not in _FILLERS] or words
    if not words_used:
        return None, ""
    if _has_date_and_time(words):
        return TIME, "name"
    for quantity, known in _WORDS.items():
        if "".join(words_used) in known.split() or (
            len(words_used) == 1 and words_used[0] in known.split()
        ):
            return quantity, "name"
    sides = [
        [part for part, known in pair if known & set(words)]
        for pair in (
            (("sprung", _BODY), ("unsprung", _AXLE)),
            (("front", _FRONT), ("rear", _REAR)),
        )
    ]
    if all(len(side) == 1 for side in sides) and not set(words) & _LEVEL:
        channel = f"{sides[0][0]}_{sides[1][0]}"
        if channel in channels:
            return channel, "name"
    return None, ""


def _has_date_and_time(words: Sequence[str]) -> bool:
    """Return whether a name is of both, such as Date/Time or Datum und Uhrzeit."""
    dates, times = set(_WORDS[DATE].split()), set(_WORDS[TIME].split())
    named = set(words)
    return bool(named & dates and named & times) and named <= dates | times | _JOINS | _FILLERS


def _by_order(
    sheet: Sheet, found: dict[str, ColumnChoice], channels: Sequence[str]
) -> dict[str, ColumnChoice]:
    """Return columns by their order; InputError if their number does not fit."""
    used = {one.column for one in found.values()}
    free = [column for column in range(sheet.width) if column not in used]
    wanted: list[str] = [] if TIME in found else [TIME]
    first = sheet.values(free[len(wanted)]) if len(free) > len(wanted) else None
    is_fixed = first is not None and _is_smooth(first)
    if len(free) - len(wanted) == len(channels) and not (is_fixed and len(channels) == 4):
        wanted += channels
    elif is_fixed and 2 <= len(free) - len(wanted) <= 4:
        wanted += POSITION_COLUMNS[: len(free) - len(wanted)]
    else:
        heads = ", ".join(sheet.header[:8]) or f"{sheet.width} columns without names"
        raise InputError(
            f"{sheet.path}: no column is known by its name ({heads}): assign them in "
            "[file.columns] of a map (--map), or skip = true in its [[file]]"
        )
    return {
        name: ColumnChoice(column, _head_unit(sheet, column), "order")
        for name, column in zip(wanted, free, strict=False)
    }


def _is_smooth(values: NDArray[np.float64]) -> bool:
    """Return whether a column hardly changes against its size, as a latitude does."""
    known = values[np.isfinite(values)]
    return known.size > 1 and bool(np.ptp(known) < 0.02 * np.abs(known).max())


def words_of(sheet: Sheet, column: int) -> set[str]:
    """Return the words in the name of a column, counted from 0."""
    return set(_words(sheet.header[column])) if column < len(sheet.header) else set()


def _words(name: str) -> list[str]:
    plain = unicodedata.normalize("NFC", name).lower()
    plain = re.sub(r"(?<=[a-zäöüß])(?=[0-9])|(?<=[0-9])(?=[a-zäöüß])", " ", plain)
    return [word for word in re.split(r"[\W_]+", plain) if word]
