"""Format of a table: encoding, delimiter, decimal sign, header, line of units.

Where the map leaves it open it is derived from the text: the delimiter by which most lines have the
same number of cells, all of them numbers or times; the header is the last line of text before them.
"""

import csv
import re
from collections import Counter
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.common.files import read_bytes
from services.drives.tables.mapping import FileMap

Floats = NDArray[np.float64]

_DELIMITERS: Final = (";", "\t", ",", "|", " ")
_NAMES: Final = {"\t": "tab", " ": "space"}
_SAMPLE: Final = 60
"""Number of lines by which delimiter and decimal sign are judged."""
_LONGEST_HEAD: Final = 200
"""Maximum number of lines before the first row, for a logger's own description."""
_UNIT_SEPARATOR: Final = "\x1f"
"""Separator between the cells of a file with quotation marks, once these are removed."""
_NUMBER: Final = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?nan|[+-]?inf", re.I)
_TIME: Final = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}.*|\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?.*")
_COMMA: Final = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")


class Dialect(NamedTuple):
    """Format of a file's cells; lines count from 1, and 0 is no line."""

    encoding: str
    delimiter: str
    decimal: str
    header_line: int
    units_line: int
    first_line: int


class Sheet(NamedTuple):
    """Text of one table."""

    path: Path
    dialect: Dialect
    header: tuple[str, ...]
    """Names of the columns; empty where the file has none."""
    units: tuple[str, ...]
    """Cells of the line of units; empty where the file has none."""
    lines: list[str]
    """Rows, with `separator` between the cells."""
    numbers: list[int]
    """Line of each row in the file."""
    separator: str
    width: int

    def texts(self, column: int) -> list[str]:
        """Return the cells of a column, counted from 0."""
        return [line.split(self.separator, column + 1)[column].strip() for line in self.lines]

    def values(self, column: int) -> Floats:
        """Return the numbers of a column (n,); an empty cell is NaN."""
        lines = self.lines
        if self.dialect.decimal == ",":
            lines = [line.replace(",", ".") for line in lines]
        try:
            found = np.loadtxt(
                lines, delimiter=self.separator, comments=None, usecols=[column], ndmin=1
            )
        except ValueError:
            found = np.array([self._value(row, column) for row in range(len(lines))])
        if np.isinf(found).any():
            row = int(np.argmax(np.isinf(found)))
            raise InputError(
                f"{self.path}: line {self.numbers[row]}: {self.column_name(column)} is infinite"
            )
        return found

    def _value(self, row: int, column: int) -> float:
        cell = self.lines[row].split(self.separator)[column].strip()
        if cell == "" or cell.lower() in ("nan", "na", "n/a", "null", "-", "--"):
            return np.nan
        try:
            if "_" in cell:
                raise ValueError(cell)
            return float(cell.replace(self.dialect.decimal, "."))
        except ValueError as error:
            sign = "a decimal comma" if self.dialect.decimal == "," else "a decimal point"
            raise InputError(
                f"{self.path}: line {self.numbers[row]}: {self.column_name(column)} is "
                f'"{cell[:40]}", it must be a number with {sign}'
            ) from error

    def column_name(self, column: int) -> str:
        """Return the name of a column, counted from 0, for messages."""
        if column < len(self.header):
            return f'column "{self.header[column]}"'
        return f"column {column + 1}"


def read_sheet(path: Path, given: FileMap) -> Sheet:
    """Read the text of a table; InputError if it is none."""
    encoding, text = _decoded(path, given.encoding)
    lines = text.splitlines()
    used = [line for line in lines if line.strip()]
    if not used:
        raise InputError(f"{path}: is empty, a table of samples or fixes expected")
    delimiter = given.delimiter or _delimiter(path, used)
    if any('"' in line for line in lines):
        cells = list(csv.reader(lines, delimiter=delimiter))
        lines, separator = [_UNIT_SEPARATOR.join(row) for row in cells], _UNIT_SEPARATOR
    else:
        separator = delimiter
    if delimiter == " ":
        lines, separator = [_UNIT_SEPARATOR.join(line.split()) for line in lines], _UNIT_SEPARATOR
    split = [line.split(separator) for line in lines[: _LONGEST_HEAD + _SAMPLE]]
    decimal = given.decimal or _decimal(delimiter, split)
    first = given.first_line or _first_row(path, split)
    width = len(split[first - 1]) if first <= len(split) else 0
    header_line, units_line = _heads(split, first, width, given)
    rows = [(n, line) for n, line in enumerate(lines[first - 1 :], start=first) if line.strip()]
    _check_widths(path, rows, separator, width)
    dialect = Dialect(encoding, delimiter, decimal, header_line, units_line, first)
    head = tuple(c.strip() for c in split[header_line - 1]) if header_line else ()
    units = tuple(c.strip() for c in split[units_line - 1]) if units_line else ()
    return Sheet(
        path, dialect, head, units, [r for _, r in rows], [n for n, _ in rows], separator, width
    )


def described(dialect: Dialect) -> str:
    """Return a dialect in words."""
    header = f"header in line {dialect.header_line}" if dialect.header_line else "no header"
    units = f", units in line {dialect.units_line}" if dialect.units_line else ""
    sign = "comma" if dialect.decimal == "," else "point"
    name = _NAMES.get(dialect.delimiter, f'"{dialect.delimiter}"')
    return f"{dialect.encoding}, delimiter {name}, decimal {sign}, {header}{units}"


def is_number(cell: str) -> bool:
    """Return whether a cell is a number, with whatever decimal sign."""
    return _NUMBER.fullmatch(cell.strip()) is not None


def _decoded(path: Path, encoding: str | None) -> tuple[str, str]:
    content = read_bytes(path)
    if encoding is None:
        if content.startswith((b"\xff\xfe", b"\xfe\xff")):
            encoding = "utf-16"
        else:
            try:
                return "utf-8", content.decode("utf-8-sig")
            except UnicodeDecodeError:
                encoding = "latin-1"
    try:
        return encoding, content.decode("utf-8-sig" if encoding == "utf-8" else encoding)
    except (UnicodeDecodeError, LookupError) as error:
        raise InputError(
            f"{path}: is not {encoding} text, `encoding` in the map is wrong"
        ) from error


def _is_value(cell: str) -> bool:
    cell = cell.strip().strip('"')
    return cell == "" or is_number(cell) or _TIME.fullmatch(cell) is not None


def _delimiter(path: Path, lines: list[str]) -> str:
    """Return the delimiter that makes most cells of the last lines numbers or times."""
    sample = lines[-_SAMPLE:]
    best, found = 0.0, None
    for delimiter in _DELIMITERS:
        rows = list(csv.reader(sample, delimiter=delimiter, skipinitialspace=delimiter == " "))
        width, count = Counter(len(row) for row in rows).most_common(1)[0]
        if width < 2 or count < max(1, 0.8 * len(rows)):
            continue
        cells = [cell for row in rows if len(row) == width for cell in row]
        share = sum(_is_value(cell) for cell in cells) / len(cells)
        if share > best + 0.01:
            best, found = share, delimiter
    if found is None or best < 0.5:
        raise InputError(
            f"{path}: is no table of numbers: no delimiter fits, give delimiter in its [[file]] "
            "of a map (--map), or skip = true if it is no part of the drive"
        )
    return found


def _decimal(delimiter: str, rows: list[list[str]]) -> str:
    if delimiter == "," and not any("," in cell for row in rows for cell in row):
        return "."
    commas = sum(bool(_COMMA.fullmatch(cell.strip())) for row in rows for cell in row)
    points = sum("." in cell and is_number(cell) for row in rows for cell in row)
    return "," if commas > points else "."


def _first_row(path: Path, rows: list[list[str]]) -> int:
    """Return the line, from 1, of the first row of values."""
    width = Counter(len(row) for row in rows[-_SAMPLE:] if any(row)).most_common(1)[0][0]
    for number, row in enumerate(rows, start=1):
        filled = [cell for cell in row if cell.strip()]
        values = sum(_is_value(cell) for cell in filled)
        if len(row) == width and filled and values > 0.5 * len(filled):
            return number
    raise InputError(
        f"{path}: no row of numbers in its first lines, give `first_line` in a map (--map)"
    )


def _heads(rows: list[list[str]], first: int, width: int, given: FileMap) -> tuple[int, int]:
    """Return the lines of the header and of the units, 0 where there is none."""
    lines = [
        number
        for number, row in enumerate(rows[: first - 1], start=1)
        if len(row) == width and any(cell.strip() for cell in row)
    ]
    header = given.header_line
    units = given.units_line
    if header is None:
        has_two = len(lines) > 1 and lines[-2:] == [first - 2, first - 1]
        header = (lines[-2] if has_two else lines[-1]) if lines else 0
    if units is None:
        units = first - 1 if header and first - 1 > header and first - 1 in lines else 0
    return header, units


def _check_widths(path: Path, rows: list[tuple[int, str]], separator: str, width: int) -> None:
    if len(rows) < 2:
        raise InputError(f"{path}: has {len(rows)} lines of data, at least 2 expected")
    for number, line in rows:
        if line.count(separator) + 1 != width:
            raise InputError(
                f"{path}: line {number}: has {line.count(separator) + 1} fields, {width} expected"
            )
