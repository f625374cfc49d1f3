"""Conversion of times that are numbers to seconds since 1970 UTC; repeated, rounded stamps.

The size of a number shows its unit: seconds, milliseconds, … since 1970 are far apart, and small
numbers count from the start of the drive.
"""

import re
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from difflib import get_close_matches
from typing import Final, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError, available_timezones

import numpy as np
from numpy.typing import NDArray

from services.common.arrays import Floats
from services.common.errors import InputError
from services.drives.tables.mapping import Order, TimeFormat

_UNIX: Final[dict[TimeFormat, float]] = {
    "unix_s": 1.0, "unix_ms": 1e-3, "unix_us": 1e-6, "unix_ns": 1e-9,
}  # fmt: skip
_START: Final[dict[TimeFormat, float]] = {"start_s": 1.0, "start_ms": 1e-3, "start_us": 1e-6}
EARLIEST_S, LATEST_S = 946_684_800.0, 7_258_118_400.0
_EXCEL_EPOCH_DAYS: Final = 25_569.0
"""Day 1970-01-01 in days since 1899-12-30."""
_GPS_EPOCH_S: Final = 315_964_800.0
_LEAPS: Final = (
    (915_148_800.0, 13), (1_136_073_600.0, 14), (1_230_768_000.0, 15), (1_341_100_800.0, 16),
    (1_435_708_800.0, 17), (1_483_228_800.0, 18),
)  # fmt: skip
"""Times from which GPS less UTC has a value in s; none since 2017."""
_LABVIEW_EPOCH_S: Final = 2_082_844_800.0
"""Seconds from 1904, where LabVIEW and old spreadsheets begin, to 1970."""
_MATLAB_EPOCH_DAYS: Final = 719_529.0
"""Day 1970-01-01 in days of MATLAB's datenum."""
LATEST_UNIX_S: Final = EARLIEST_S + _LABVIEW_EPOCH_S
"""Year 2066: later seconds are taken to count from 1904."""
_COARSE_S: Final = 0.09
"""Resolution from which stamps were cut off rather than rounded, as whole seconds are."""
_WEEK_S: Final = 604_800.0
_OFFSET: Final = re.compile(r"([+-])(\d{1,2}):?(\d{2})?")
_FEWEST_ROUNDED: Final = 0.3
"""Share of repeated stamps where they were rounded."""
_MAX_DROPPED: Final = 0.05
"""Largest share of rows with a non-increasing time, which are left out; more is an error."""


class Times(NamedTuple):
    """Times of rows (n,), NaN where there is none, and their form."""

    time_s: Floats
    """Times since 1970 UTC, or since an undeclared start."""
    format: TimeFormat
    is_relative: bool
    order: Order | None = None
    needs_zone: bool = False


class KeptRows(NamedTuple):
    """Selected rows and their times, with counts of the others."""

    rows: NDArray[np.int64]
    time_s: Floats
    repeated: int
    late: int
    is_even: bool


def numeric_times(values: Floats, format: TimeFormat | None, step: "Steps") -> Times:  # noqa: A002
    """Return times that are numbers; their size shows the format where it is not given."""
    usual = float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan
    if format is None:
        format = _format_of(usual, step)  # noqa: A001
    if format in _UNIX:
        return Times(values * _UNIX[format], format, is_relative=False)
    if format == "excel_days":
        whole = np.floor(values)  # days and their fraction separately: fewer digits are lost
        time_s = (whole - _EXCEL_EPOCH_DAYS) * 86_400.0 + np.round((values - whole) * 86_400.0, 6)
        return Times(time_s, format, is_relative=False, needs_zone=True)
    if format == "matlab_days":
        time_s = np.round((values - _MATLAB_EPOCH_DAYS) * 86_400.0, 5)
        return Times(time_s, format, is_relative=False, needs_zone=True)
    if format == "labview_s":
        return Times(values - _LABVIEW_EPOCH_S, format, is_relative=False)
    if format == "gps_s":
        return Times(_utc_of_gps(values), format, is_relative=False)
    if format == "start_samples":
        return Times(values / step.declared_hz, format, is_relative=True)
    return Times(values * _START.get(format, 1.0), format, is_relative=True)


class Steps(NamedTuple):
    """Evidence on the unit of times since a start."""

    median: float
    """Median step between rows, in the file's unit."""
    declared_hz: float
    """Rate of the site file; 0 for positions."""
    unit: str | None
    """Unit in the header: s, ms, us, ns."""


def _format_of(usual: float, step: Steps) -> TimeFormat:
    if LATEST_UNIX_S < usual < LATEST_UNIX_S + 3.2e9:
        return "labview_s"
    for name, scale in _UNIX.items():
        if EARLIEST_S <= usual * scale <= LATEST_S:
            return name
    if 36_526 <= usual <= 73_415 and step.median * 86_400.0 < 100.0 and step.median < 1e-3:
        return "excel_days"
    if 730_486 <= usual <= 767_376 and step.median * 86_400.0 < 100.0 and step.median < 1e-3:
        return "matlab_days"
    found = _by_rate(step)
    if found is not None and (step.declared_hz or step.unit is None):
        return found
    named: dict[str | None, TimeFormat] = {"s": "start_s", "ms": "start_ms", "us": "start_us"}
    return named.get(step.unit, "start_s")


def _by_rate(step: Steps) -> TimeFormat | None:
    """Return the unit of times since a start by the usual step between rows."""
    if step.declared_hz == 0.0:
        per_row = step.median * 10.0  # receivers send some ten fixes a second
        known: tuple[tuple[TimeFormat, float, float], ...] = (
            ("start_s", 0.1, 100.0), ("start_ms", 100.0, 1e5), ("start_us", 1e5, 1e8),
        )  # fmt: skip
    else:
        per_row = step.median * step.declared_hz
        known = (
            ("start_s", 0.9, 1.1), ("start_ms", 900.0, 1100.0), ("start_us", 9e5, 1.1e6),
            ("start_samples", 0.95 * step.declared_hz, 1.05 * step.declared_hz),
        )  # fmt: skip
    return next((name for name, low, high in known if low <= per_row <= high), None)


def gps_times(weeks: Floats, seconds: Floats) -> Floats:
    """Return UTC of GPS weeks (n,) and the seconds in them (or milliseconds: beyond a week's)."""
    if np.nanmax(seconds) > _WEEK_S:
        seconds = seconds * 1e-3
    return _utc_of_gps(weeks * _WEEK_S + seconds)


def _utc_of_gps(since_gps: Floats) -> Floats:
    """Return UTC of seconds since the GPS epoch of 1980 (n,)."""
    time_s = _GPS_EPOCH_S + since_gps
    leap = np.full(time_s.shape, 13.0)
    for begin_s, count in _LEAPS:
        leap = np.where(time_s - count >= begin_s, float(count), leap)
    return np.asarray(time_s - leap)


def zone_of(name: str, where: str) -> tzinfo:
    """Return a time zone by its name or its offset; InputError that begins with `where`."""
    if name.upper() in ("UTC", "Z", "GMT"):
        return UTC
    if _OFFSET.fullmatch(name):
        return timezone(offset_of(name))
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise InputError(
            f'{where}: no time zone "{name}" is known here{_zone_meant(name)}'
        ) from error


def _zone_meant(name: str) -> str:
    """Return the end of the complaint about an unknown zone: a similar name, or what to give."""
    known = sorted(available_timezones())
    if not known:
        return " (this computer has no data of zones); give the offset to UTC, as +01:00"
    city = f"/{name.rpartition('/')[2]}".lower()
    similar = [one for one in known if one.lower().endswith(city)]
    similar += get_close_matches(name, known, 1, cutoff=0.85)
    if similar:
        return f", did you mean {similar[0]}? The offset to UTC, as +01:00, works too"
    return "; give a name such as Europe/Berlin or the offset to UTC, as +01:00"


def start_of(text: str, zone: tzinfo | None, where: str, *, has_zone_option: bool = True) -> float:
    """Return the start of a drive, given as ISO 8601 or seconds since 1970.

    Raise InputError for another text, or one without a zone, naming --zone if there is that option.
    """
    try:
        if re.fullmatch(r"\d+(\.\d+)?", text):
            return float(text)
        start = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(
            f'{where}: is "{text[:40]}", it must be a time as 2026-05-01T09:30:00+02:00'
        ) from error
    if start.tzinfo is None:
        if zone is None:
            # Only a time of day can have a zone.
            example = text if len(text) > len("2026-05-01") else f"{text}T09:30:00"
            raise InputError(
                f'{where}: is "{text}", which has no zone: add one (as {example}Z, {example}+01:00)'
                f"{', or give --zone' if has_zone_option else ''}"
            )
        start = start.replace(tzinfo=zone)
    return (start - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(seconds=1)


def kept_rows(
    time_s: Floats, values: Floats, declared_hz: float, *, even: bool | None, where: str
) -> KeptRows:
    """Return the rows whose times increase; InputError if that leaves out too many.

    `values` (n, m) distinguish a row that is written twice from samples whose stamps were rounded:
    the latter are put on an even grid at the declared rate, unless `even` is False.
    """
    same = (np.diff(time_s) == 0) & np.any(np.diff(values, axis=0) != 0, axis=1)
    if even is None:
        even = bool(declared_hz) and float(same.mean()) > _FEWEST_ROUNDED
    if even:
        increasing = np.flatnonzero(np.concatenate([[True], np.diff(time_s) >= 0]))
        return KeptRows(
            increasing, _even(time_s[increasing], declared_hz, where), 0,
            time_s.size - increasing.size, is_even=True,
        )  # fmt: skip
    latest = np.maximum.accumulate(time_s)
    is_later = np.concatenate([[True], time_s[1:] > latest[:-1]])
    rows = np.flatnonzero(is_later)
    left_out = np.flatnonzero(~is_later)
    # A row is a repetition if an earlier one with this time has the same values; other values
    # contradict.
    places = np.searchsorted(time_s[rows], time_s[left_out])
    places = np.minimum(places, rows.size - 1)
    is_again = (time_s[rows][places] == time_s[left_out]) & np.all(
        values[rows][places] == values[left_out], axis=1
    )
    repeated, late = int(is_again.sum()), int((~is_again).sum())
    if late > max(1, _MAX_DROPPED * time_s.size):
        first = int(left_out[~is_again][0])
        raise InputError(
            f"{where}: times of {late} of {time_s.size} rows are not later than the row before "
            f"(first in row {first + 1}): stamps were rounded or the clock goes back; if the "
            "samples are even, set even = true in [file.time] of a map (--map)"
        )
    return KeptRows(rows, time_s[rows], repeated, late, is_even=False)


def _even(time_s: Floats, rate_hz: float, where: str) -> Floats:
    """Return even times for rounded stamps (n,), by the mean of each segment without a gap."""
    steps = np.diff(time_s)
    resolution_s = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    gaps = np.flatnonzero(steps > 1.5 * max(resolution_s, 1.0 / rate_hz)) + 1
    even = np.empty_like(time_s)
    start_s = None
    for piece in np.split(np.arange(time_s.size), gaps):
        local = np.arange(piece.size) / rate_hz
        early = time_s[piece] - time_s[0] - local
        offset_s = float(np.max(early) if resolution_s >= _COARSE_S else np.mean(early))
        if np.abs(early - offset_s).max() > 1.5 * resolution_s:
            raise InputError(
                f"{where}: stamps are repeated, and the samples between are not even at "
                f"{rate_hz:g} Hz, as sensor.rate_hz declares"
            )
        if start_s is None:
            start_s = offset_s
        index = round((offset_s - start_s) * rate_hz)
        even[piece] = time_s[0] + start_s + index / rate_hz + local
    return even


def offset_of(text: str) -> timedelta:
    """Return an offset to UTC, as +01:00; ValueError for another text."""
    match = _OFFSET.fullmatch(text)
    if match is None:
        raise ValueError(text)
    size = timedelta(hours=int(match[2]), minutes=int(match[3] or 0))
    return -size if match[1] == "-" else size


def to_utc(local_s: Floats, zone: tzinfo) -> Floats:
    """Return UTC of local times (n,); the offset is determined once for each quarter hour."""
    quarters, which = np.unique(np.floor(local_s / 900.0), return_inverse=True)
    offsets = np.empty(quarters.size)
    for place, quarter in enumerate(quarters):
        naive = datetime(1970, 1, 1) + timedelta(seconds=float(quarter) * 900.0)
        offset = naive.replace(tzinfo=zone).utcoffset()
        other = naive.replace(tzinfo=zone, fold=1).utcoffset()
        if offset is None or offset != other:
            raise InputError(
                f"--zone: {naive:%Y-%m-%d %H:%M} exists twice or not at all in {zone}, when the "
                "clocks change; give the offset to UTC, as +01:00"
            )
        offsets[place] = offset.total_seconds()
    return np.asarray(local_s - offsets[which])
