"""Conversion of dates and times of day, as texts, to seconds."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, tzinfo
from typing import Final

import numpy as np

from services.drives.tables.mapping import Order
from services.drives.tables.stamps import Times, offset_of, to_utc

_ZONES: Final = {"CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2, "WEST": 1, "EET": 2, "EEST": 3}
"""Names of zones of one meaning, in hours east; others are refused."""
_ZONE: Final = rf"(?P<zone>Z|UTC|GMT|{'|'.join(_ZONES)}|[+-]\d{{2}}(?::?\d{{2}})?)?"
_CLOCK: Final = (
    r"(?P<hour>\d{1,3}):(?P<minute>\d{2})(?::(?P<second>\d{2})(?:[.,:](?P<fraction>\d+))?)?"
    r"(?:\s*(?P<half>[AaPp])\.?\s?[Mm]\.?)?"
)
_DATE: Final = re.compile(
    r"(?P<a>\d{1,4})(?:[-./]|\.? )(?P<b>\d{1,2}|[^\W\d]{3,9}\.?)(?:[-./]|\.? )(?P<c>\d{1,4})[T ,_]+"
    rf"{_CLOCK}\s*{_ZONE}"
)
_COMPACT: Final = re.compile(
    r"(?P<a>(?:19|20)\d{2})(?P<b>0[1-9]|1[0-2])(?P<c>[0-3]\d)[T _-]?"
    r"(?P<hour>[0-2]\d)(?P<minute>[0-5]\d)(?P<second>[0-6]\d)(?:[.,](?P<fraction>\d+))?(?P<half>)"
    rf"\s*{_ZONE}"
)
_TIME_OF_DAY: Final = re.compile(_CLOCK)
_MONTHS: Final = (
    "jan gen ene", "feb fév fev", "mar mär mrz mae", "apr avr abr", "may mai mag", "jun juin giu",
    "jul juil lug", "aug aou aoû ago", "sep set", "oct okt ott", "nov", "dec dez déc dic",
)  # fmt: skip
"""Beginnings of months' names."""
_DAY_S: Final = 86_400.0


def is_compact(text: str) -> bool:
    """Return whether a text is a date and time without separators, such as 20260501093000.5."""
    return _COMPACT.fullmatch(text) is not None


def is_time_of_day(text: str) -> bool:
    """Return whether a text is hours, minutes and seconds without a date."""
    return _TIME_OF_DAY.fullmatch(text) is not None


def times_of_day(texts: Sequence[str]) -> Times:
    """Return seconds since a midnight, past the next ones; ValueError with the row if invalid."""
    seconds = np.full(len(texts), np.nan)
    for row, text in enumerate(texts):
        match = _TIME_OF_DAY.fullmatch(text)
        if match is not None:
            seconds[row] = _second_of_day(match) + _micros(match["fraction"]) / 1e6
        elif text not in ("", "nan", "NaN"):
            raise ValueError(row)
    known = np.isfinite(seconds)
    back = np.diff(seconds[known]) < -0.5 * _DAY_S
    seconds[known] += _DAY_S * np.concatenate([[0], np.cumsum(back)])
    return Times(seconds, "clock", is_relative=True)


def date_times(texts: Sequence[str], order: Order | None, zone: tzinfo | None) -> Times:
    """Return times that are dates: ISO 8601, or days, months and years in some order.

    Without a zone, in the text or given, they are read as UTC and `needs_zone` is set. Raise
    ValueError, with the number of the row, for an invalid date.
    """
    parts = [_DATE.fullmatch(text) or _COMPACT.fullmatch(text) for text in texts]
    order = order or _order([match for match in parts if match is not None])
    micros = np.empty(len(texts))
    is_local = np.zeros(len(texts), dtype=bool)
    days: dict[tuple[str, str, str], float] = {}
    for row, match in enumerate(parts):
        if match is None:
            if texts[row] in ("", "nan", "NaN"):
                micros[row] = np.nan
                continue
            raise ValueError(row)
        a, b, c = (match[name] for name in "abc")
        offset = match["zone"]
        day = days.get((a, b, c))
        if day is None:
            day = days[(a, b, c)] = _day_s(a, b, c, order, row)
        value = day + _second_of_day(match)
        if offset is None:
            is_local[row] = True
        elif offset[0] in "+-":
            value -= offset_of(offset).total_seconds()
        elif offset in _ZONES:
            value -= 3600.0 * _ZONES[offset]
        micros[row] = value * 1e6 + _micros(match["fraction"])
    time_s = micros / 1e6
    if zone is not None and is_local.any():
        time_s[is_local] = to_utc(time_s[is_local], zone)
    return Times(time_s, "date", is_relative=False, order=order,
                 needs_zone=zone is None and bool(is_local.any()))  # fmt: skip


def _second_of_day(match: re.Match[str]) -> float:
    hour = int(match["hour"])
    if match["half"]:
        hour = hour % 12 + (12 if match["half"] in "pP" else 0)
    return 3600.0 * hour + 60.0 * int(match["minute"]) + int(match["second"] or 0)


def _micros(fraction: str | None) -> int:
    return round(int(fraction) * 10.0 ** (6 - len(fraction))) if fraction else 0


def _month(text: str) -> int:
    """Return the number of a month, by number or by its English, German or French name."""
    if text.isdigit():
        return int(text)
    name = text.lower().rstrip(".")
    for number, beginnings in enumerate(_MONTHS, start=1):
        if any(name.startswith(one) for one in beginnings.split()):
            return number
    raise ValueError(text)


def _order(matches: Sequence[re.Match[str]]) -> Order | None:
    """Return the order of the parts of dates, None if several are possible."""
    first = [match["a"] for match in matches]
    second = [match["b"] for match in matches]
    if all(len(one) == 4 for one in first):
        return "ymd"
    if matches and not second[0].isdigit():
        return "dmy"
    if (matches and "." in matches[0][0].split(":")[0]) or max(map(int, first), default=0) > 12:
        return "dmy"
    return "mdy" if max(map(int, second), default=0) > 12 else None


def _day_s(a: str, b: str, c: str, order: Order | None, row: int) -> float:
    year, month, day = {"ymd": (a, b, c), "dmy": (c, b, a), "mdy": (c, a, b)}[order or "dmy"]
    try:
        full = int(year) + (2000 if len(year) <= 2 else 0)
        return datetime(full, _month(month), int(day), tzinfo=UTC).timestamp()
    except ValueError as error:
        raise ValueError(row) from error
