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

from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.files import read_bytes
from services.drives.tables.mapping import FileMap

_DELIMITERS: Final = (";", "\t", ",", "|", " ")
_NAMES: Final = {"\t": "tab", " ": "space"}
_SAMPLE: Final = 60
"""Number of lines by which delimiter and decimal sign are judged."""
_LONGEST_HEAD: Final = 200
"""Maximum number of lines before the first row, for a logger's own description."""
_UNIT_SEPARATOR: Final = "\x1f"
"""Separator between the cells of a file with quotation marks, once these are removed."""
_NUMBER: Final = re.compile(
    r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][+-]?\d+)?|[+-]?nan|[+-]?inf"
    r"|[+-]?\d{1,3}((\.\d{3})+(,\d+)?|(,\d{3})+(\.\d+)?)", re.I
)  # fmt: skip
_THOUSANDS: Final = {
    ",": re.compile(r"[+-]?\d{1,3}(\.\d{3})+(,\d+)?"),
    ".": re.compile(r"[+-]?\d{1,3}(,\d{3})+(\.\d+)?"),
}
"""Numbers with separators between thousands, by the decimal sign."""
_ABSENT: Final = frozenset((
    "", "nan", "na", "n/a", "#n/a", "#na", "#nv", "null", "none", "-", "--", "---", "*", "**", "?",
    "over", "overload", "ovl", "ovr", "ol", "ovf", "err", "error", "invalid", "missing",
))  # fmt: skip
"""Cells without a value."""
_COMMENT: Final = ("#", "%", "//", "!", "*")
_KINDS: Final = (
    (b"PK\x03\x04", "a spreadsheet or archive, save it as CSV"),
    (b"\xd0\xcf\x11\xe0", "an old spreadsheet, save it as CSV"),
    (b"\x1f\x8b", "compressed, unpack it"),
    (b"$G", "a log of NMEA sentences, convert it to a table of fixes"),
)
_LONGEST_FOOT: Final = 20
"""Largest number of lines of text after the last row."""
_TIME: Final = re.compile(
    r"\d{1,4}[-./ ]\w{1,4}\.?[-./ ]\d{1,4}(\b|T).*|\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?.*|\d{8}T\d{6}.*"
    r"|[NSEW] ?\d[\d. ]*|\d[\d. ]* ?[NSEW]|[NSEW]|[NSEW]? ?\d+ ?°.*"
)
"""Times, and angles that are no plain numbers."""
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
    start_text: str | None = None
    """Line before the header that seems to hold the start of the drive."""
    left_out: int = 0
    """Lines of comments, an end of text and a last row that was cut off."""

    def has_cells(self, column: int) -> bool:
        """Return whether a column, counted from 0, has any value."""
        return any(line.split(self.separator, column + 1)[column].strip() for line in self.lines)

    def texts(self, column: int) -> list[str]:
        """Return the cells of a column, counted from 0."""
        return [line.split(self.separator, column + 1)[column].strip() for line in self.lines]

    def values(self, column: int) -> Floats:
        """Return the numbers of a column (n,); an empty cell is NaN."""
        lines = self.lines
        if self.dialect.decimal == ",":
            if any("." in text for text in self.texts(column)):
                return self._grouped(column)
            lines = [line.replace(",", ".") for line in lines]
        try:
            found = np.loadtxt(
                lines, delimiter=self.separator, comments=None, usecols=[column], ndmin=1
            )
        except ValueError:
            found = np.array([self.value(row, column) for row in range(len(lines))])
        if np.isinf(found).any():
            row = int(np.argmax(np.isinf(found)))
            raise InputError(
                f"{self.path}: line {self.numbers[row]}: {self.column_name(column)} is infinite"
            )
        return found

    def _grouped(self, column: int) -> Floats:
        """Return a column with points in a file of decimal commas; InputError if ambiguous.

        Points separate thousands where a cell has both signs; without a comma they are decimal
        points, unless three digits follow each.
        """
        cells = [cell for cell in self.texts(column) if cell.lower() not in _ABSENT]
        thousands = _THOUSANDS[","]
        if not any("," in cell for cell in cells):
            pointed = [cell for cell in cells if "." in cell]
            if all(thousands.fullmatch(cell) for cell in pointed):
                raise InputError(
                    f"{self.path}: {self.column_name(column)}, such as {pointed[0]}: points "
                    'between thousands, or decimal points? give decimal = "." in a map (--map)'
                )
            read = [cell.replace(",", ".") for cell in self.texts(column)]
            plain = self._replace(lines=read, separator="\x1e", dialect=self.dialect._replace(
                decimal="."), header=(self.column_name(column),))  # fmt: skip
            return np.array([plain.value(row, 0) for row in range(len(read))])
        return np.array([self.value(row, column) for row in range(len(self.lines))])

    def value(self, row: int, column: int) -> float:
        """Return the number in a cell, row and column counted from 0; NaN if it is empty."""
        cell = self.lines[row].split(self.separator)[column].strip()
        if cell.lower() in _ABSENT:
            return np.nan
        sign = self.dialect.decimal
        number = cell
        if _THOUSANDS[sign].fullmatch(cell):
            number = cell.replace("." if sign == "," else ",", "")
        try:
            if "_" in cell:
                raise ValueError(cell)
            number = number.replace(sign, ".")
            return float(re.sub(r"[dD](?=[+-]?\d+$)", "e", number))
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
    used = [line for line in lines if line.strip() and not line.startswith(_COMMENT)]
    if not used:
        raise InputError(f"{path}: is empty, a table of samples or fixes expected")
    delimiter = given.delimiter or _delimiter(path, used)
    if any('"' in line for line in lines):
        cells = list(csv.reader(lines, delimiter=delimiter))
        lines, separator = [_UNIT_SEPARATOR.join(row) for row in cells], _UNIT_SEPARATOR
    else:
        separator = delimiter
    if separator == delimiter:
        lines = _without_ends(lines, delimiter)
    if delimiter == " ":
        lines, separator = [_UNIT_SEPARATOR.join(line.split()) for line in lines], _UNIT_SEPARATOR
    split = [line.split(separator) for line in lines[: _LONGEST_HEAD + _SAMPLE]]
    decimal = given.decimal or _decimal(delimiter, split)
    first = given.first_line or _first_row(path, split)
    width = len(split[first - 1]) if first <= len(split) else 0
    header_line, units_line = _heads(split, first, width, given)
    if separator == "," and header_line == 0:
        _check_commas(path, split, first, width)
    rows = [(n, line) for n, line in enumerate(lines[first - 1 :], start=first) if line.strip()]
    rows, left_out = _without_text(rows, separator, width)
    _check_widths(path, rows, separator, width)
    dialect = Dialect(encoding, delimiter, decimal, header_line, units_line, first)
    head = tuple(c.strip() for c in split[header_line - 1]) if header_line else ()
    units = tuple(c.strip() for c in split[units_line - 1]) if units_line else ()
    return Sheet(
        path, dialect, head, units, [r for _, r in rows], [n for n, _ in rows], separator, width,
        _start_text(lines[: max(header_line, first) - 1], separator), left_out,
    )  # fmt: skip


def _start_text(lines: list[str], separator: str) -> str | None:
    """Return the line before a header that names a start and has a time."""
    for line in lines:
        plain = line.replace(separator, " ").strip().lstrip("#% ")
        if re.search(r"start|begin|^t0|datum|date", plain, re.I) and re.search(r"\d+:\d\d", plain):
            return plain[:60]
    return None


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
    for start, kind in _KINDS:
        if content.startswith(start):
            raise InputError(f"{path}: is {kind}")
    is_marked = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    if encoding in (None, "utf-16") and not is_marked:
        # Without its mark, every other byte of Latin text in UTF-16 is zero.
        zeros = [content[k:2000:2].count(0) for k in range(2)]
        if max(zeros) > 0.4 * min(len(content), 2000) / 2:
            content = (b"\xff\xfe" if zeros[1] > zeros[0] else b"\xfe\xff") + content
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
    return cell.lower() in _ABSENT or is_number(cell) or _TIME.fullmatch(cell) is not None


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


def _without_ends(lines: list[str], delimiter: str) -> list[str]:
    """Return lines without a delimiter after their last cell, where every row has one."""
    if delimiter == " " or not all(
        line.rstrip(" ").endswith(delimiter) for line in lines[-_SAMPLE:] if line.strip()
    ):
        return lines
    if all(line.rstrip(" ").endswith(2 * delimiter) for line in lines[-_SAMPLE:] if line.strip()):
        return lines  # an empty column, not an end
    return [line.rstrip(" ").removesuffix(delimiter) for line in lines]


def _without_text(
    rows: list[tuple[int, str]], separator: str, width: int
) -> tuple[list[tuple[int, str]], int]:
    """Return rows without comments, text after the last row and a cut-off last row, and a count."""
    found = [row for row in rows if not row[1].startswith(_COMMENT)]
    for _ in range(_LONGEST_FOOT):
        if len(found) < 3 or any(_has_value(cell) for cell in found[-1][1].split(separator)):
            break
        found.pop()
    if len(found) > 2 and found[-1][1].count(separator) + 1 < width:
        found.pop()
    return found, len(rows) - len(found)


def _has_value(cell: str) -> bool:
    return is_number(cell) or _TIME.fullmatch(cell.strip()) is not None


def _check_commas(path: Path, split: list[list[str]], first: int, width: int) -> None:
    """Raise InputError if commas seem to be both decimal signs and delimiters."""
    head = split[first - 2] if first > 1 else []
    if width / 2 <= len(head) < width and not any(_has_value(cell) for cell in head if cell):
        raise InputError(
            f"{path}: its header has {len(head)} names and its rows {width} cells: decimal commas "
            "between commas cannot be distinguished, export it with semicolons or decimal points"
        )


def _check_widths(path: Path, rows: list[tuple[int, str]], separator: str, width: int) -> None:
    if len(rows) < 2:
        raise InputError(f"{path}: has {len(rows)} lines of data, at least 2 expected")
    for number, line in rows:
        if line.count(separator) + 1 != width:
            raise InputError(
                f"{path}: line {number}: has {line.count(separator) + 1} fields, {width} expected"
            )
