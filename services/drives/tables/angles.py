"""Latitudes and longitudes as texts: degrees and minutes, hemispheres next to or within them."""

import re
from collections.abc import Mapping
from typing import Final

import numpy as np

from services.common.arrays import Floats
from services.common.errors import InputError
from services.drives.tables.columns import ColumnChoice, column_number
from services.drives.tables.dialect import Sheet, is_number
from services.drives.tables.mapping import ColumnMap, FileMap

SIDES: Final = {"latitude_deg": {"N": 1.0, "S": -1.0}, "longitude_deg": {"E": 1.0, "W": -1.0}}
"""Letters of hemispheres with their signs."""
_ANGLE: Final = re.compile(
    r"(?P<before>[NSEW])?\s*(?P<sign>[+-])?(?P<deg>\d+(?:[.,]\d+)?)\s*[°d:]?"
    r"(?:\s*(?P<min>\d+(?:[.,]\d+)?)\s*(?:['′:m]\s*)?)?"
    r"(?:\s*(?P<sec>\d+(?:[.,]\d+)?)\s*(?:\"|″|''|s)?)?\s*(?P<after>[NSEW])?",
    re.IGNORECASE,
)
_MANY: Final = 20
"""Number of cells that show the form of a column."""


def angles(sheet: Sheet, column: int) -> Floats | None:
    """Return the angles of a column in degrees (n,), NaN for empty cells; None for plain numbers.

    Raise InputError, with the line, for a cell that is no angle.
    """
    texts = sheet.texts(column)
    filled = [text for text in texts if text][:_MANY]
    if all(is_number(text) for text in filled) or not any(
        character.isdigit() for text in filled for character in text
    ):
        return None
    found = np.full(len(texts), np.nan)
    for row, text in enumerate(texts):
        if not text or text.lower() in ("nan", "na", "n/a", "-"):
            continue
        match = _ANGLE.fullmatch(text)
        if match is None:
            raise InputError(
                f"{sheet.path}: line {sheet.numbers[row]}: {sheet.column_name(column)} is "
                f'"{text[:40]}", it must be an angle in degrees, as 48.137 or 48°08.22\' N'
            )
        found[row] = _degrees(match)
    return found


def _degrees(match: re.Match[str]) -> float:
    parts = [float((match[name] or "0").replace(",", ".")) for name in ("deg", "min", "sec")]
    letter = (match["before"] or match["after"] or "").upper()
    sign = -1.0 if match["sign"] == "-" or letter in ("S", "W") else 1.0
    return sign * (parts[0] + parts[1] / 60.0 + parts[2] / 3600.0)


def sides_of(
    sheet: Sheet, given: FileMap, placed: Mapping[str, ColumnChoice]
) -> dict[str, tuple[int | str, Floats]]:
    """Return column and signs (n,) of the hemispheres, of latitude and longitude with one.

    A column counts whose every filled cell is N or S, or E or W, if the map names none.
    """
    used = {one.column for one in placed.values()}
    found: dict[str, tuple[int | str, Floats]] = {}
    for quantity, signs in SIDES.items():
        side = given.columns.get(quantity, ColumnMap()).side
        if side is not None:
            columns = [column_number(sheet, side, f"columns.{quantity}.side")]
        else:
            columns = [n for n in range(sheet.width) if n not in used and _has(sheet, n, signs)]
        for column in columns[:1]:
            texts = [text.upper() for text in sheet.texts(column)]
            wrong = next((n for n, text in enumerate(texts) if text and text not in signs), None)
            if wrong is not None:
                raise InputError(
                    f"{sheet.path}: line {sheet.numbers[wrong]}: {sheet.column_name(column)} is "
                    f'"{texts[wrong][:40]}", it must be {" or ".join(signs)}'
                )
            values = np.array([signs.get(text, np.nan) for text in texts])
            name = sheet.header[column] if column < len(sheet.header) else ""
            is_single = bool(name) and sheet.header.count(name) == 1
            found[quantity] = (name if is_single else column + 1, values)
    return found


def _has(sheet: Sheet, column: int, signs: Mapping[str, float]) -> bool:
    filled = [text.upper() for text in sheet.texts(column) if text]
    return bool(filled) and all(text in signs for text in filled)
