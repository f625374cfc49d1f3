"""Start times of tables, and agreement between the clocks of one run's files."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.language import utc_day
from services.drives.tables.findings import Findings, Target
from services.drives.tables.mapping import OPEN_ZONE
from services.drives.tables.parts import TablePart
from services.drives.tables.stamps import start_of, to_utc, zone_of

_MAX_QUARTERS: Final = 4 * 14
"""Largest difference between UTC and a country's clocks, in quarters of an hour."""
_LONG_S: Final = 3600.0
"""First time beyond which a count from the start is not that of a drive."""
_GPS_LESS_UTC_S: Final = 18.0
_ORDERS: Final = {"ymd": "year, month, day", "dmy": "day, month, year", "mdy": "month, day, year"}
_EPOCHS_S: Final = {"gps_s": 315_964_782.0, "labview_s": 2_082_844_800.0}


def begins(
    parts: Sequence[TablePart], run: str, runs: int, target: Target, found: Findings
) -> dict[str, float]:
    """Return the seconds to be added to the times of each file."""
    add_s: dict[str, float] = {}
    zoned = [p for p in parts if not p.times.is_relative and not p.times.needs_zone]
    for part in parts:
        given_time = part.given.time
        where = str(part.sheet.path)
        add_s[part.name] = given_time.offset_s or 0.0
        if part.times.is_relative:
            add_s[part.name] += _start(part, run, runs, target, found, _day_of(zoned))
        elif part.times.needs_zone and target.zone is None and given_time.zone is None:
            is_known = any(_overlap(part, other) for other in zoned)
            if not is_known and not target.is_draft:
                raise InputError(
                    f"{where}: times have no zone: give --zone UTC, --zone +01:00 or --zone "
                    "Europe/Berlin (in a map: zone in [file.time])"
                )
            found.time(part, zone="UTC" if is_known else OPEN_ZONE)
            if is_known:
                found.guess(part, "times without a zone are UTC, as the other file's are")
            else:
                found.guess(part, "times have no zone: shown as UTC, give --zone", "open")
        elif part.times.needs_zone:  # days of a spreadsheet
            first_s = np.array([np.nanmin(part.times.time_s)])
            zone = zone_of(given_time.zone or target.zone or "", where)
            add_s[part.name] += float(to_utc(first_s, zone)[0] - first_s[0])
        if part.times.is_relative and len(parts) > 1 and all(p.times.is_relative for p in parts):
            found.guess(part, "times count from the same start as those of the other files", "lost")
        if target.zone is not None and given_time.zone is None and part.times.format in (
            "date", "excel_days",
        ):  # fmt: skip
            found.time(part, zone=target.zone)
        if part.times.format == "date" and part.times.order is not None:
            found.guess(part, _dates_in_words(part, target), "form")
    return add_s


def _dates_in_words(part: TablePart, target: Target) -> str:
    order = _ORDERS[part.times.order or "ymd"]
    zone = part.given.time.zone or target.zone
    if zone is not None:
        return f"dates are {order}, in {zone} where they name no zone"
    return f"dates are {order}" + ("" if part.times.needs_zone else ", in the zone that they name")


def _day_of(parts: Sequence[TablePart]) -> str | None:
    """Return the day, UTC, of files that have dates; None without any."""
    first_s = [float(np.nanmin(part.times.time_s)) for part in parts]
    return utc_day(first_s[0]) if first_s else None


def _start(
    part: TablePart, run: str, runs: int, target: Target, found: Findings, day: str | None
) -> float:
    """Return the start of a drive whose times count from it; `day` is that of its other files."""
    given_time = part.given.time.start
    first_s = float(np.nanmin(part.times.time_s))
    if isinstance(given_time, dict):
        given_time = given_time.get(run)
    where = f"{part.sheet.path}: start"
    zone = None if target.zone is None else zone_of(target.zone, "--zone")
    if given_time is not None:
        return start_of(given_time, zone, where)
    if target.start is None or runs > 1:
        several = f'of each run in [file.time] of a map, start = {{ {run} = "…" }} (--map)'
        how = several if runs > 1 else "with --start 2026-05-01T09:30:00+02:00"
        if part.times.format == "clock" and first_s > _LONG_S:
            midnight = "2026-05-01T00:00:00+02:00"
            if day is not None:
                midnight = f"{day}T00:00:00Z (in UTC; or with the receiver's zone for Z)"
            raise InputError(
                f"{part.sheet.path}: times of day have no date: give the midnight before them "
                f"with --start {midnight}"
            )
        ahead = "" if first_s < _LONG_S else f" (its first row is {first_s:.0f} s after it)"
        noted = "" if part.sheet.start_text is None else f'; the file has "{part.sheet.start_text}"'
        raise InputError(
            f"{part.sheet.path}: times count from the start of the drive, give that {how}{ahead}"
            f"{noted}"
        )
    start_s = start_of(target.start, zone, "--start")
    if part.times.format == "clock" and first_s > _LONG_S and not _is_midnight(target.start):
        raise InputError(
            f"--start: is {target.start}, it must be the midnight before the times of day of "
            f"{part.name}, as 2026-05-01T00:00:00+02:00"
        )
    if part.times.format != "clock" and first_s > _LONG_S:
        found.guess(part, f"times begin {first_s:.0f} s after --start")
    text = target.start
    if zone is not None and not re.search(r"(Z|[+-]\d\d:?\d\d)$|^[\d.]+$", text):
        text = str(start_s)
    found.time(part, start=text)
    return start_s


def _is_midnight(text: str) -> bool:
    return (
        re.fullmatch(r"\d{4}-\d\d-\d\d([T ]00:00(:00(\.0+)?)?(Z|[+-]\d\d:?\d\d)?)?", text)
        is not None
    )


def _overlap(one: TablePart, other: TablePart) -> bool:
    a, b = one.times.time_s, other.times.time_s
    return bool(np.nanmin(a) <= np.nanmax(b) and np.nanmin(b) <= np.nanmax(a))


def check_overlap(
    source: str, time_s: Floats, part: TablePart, fixes: Mapping[str, Floats]
) -> None:
    """Raise InputError if positions and accelerations are not of one time."""
    other_s = fixes["time_s"]
    if other_s[0] <= time_s[-1] and time_s[0] <= other_s[-1]:
        return
    apart_s = float(other_s[0] - time_s[0])
    quarters = round(apart_s / 900.0)
    for form, between_s in _EPOCHS_S.items():
        if abs(abs(apart_s) - between_s) < 1000.0:
            raise InputError(
                f"{part.sheet.path}: begins {apart_s:+.0f} s from {Path(source).name}, the clocks "
                f'must agree: format = "{form}" in [file.time] of the other one in a map (--map)?'
            )
    name = Path(source).name
    if not 0 < abs(quarters) <= _MAX_QUARTERS or abs(apart_s - 900.0 * quarters) > 60.0:
        hint = _leap_hint(apart_s)
        option = " (--map)" if hint else ""
        raise InputError(
            f"{part.sheet.path}: begins {apart_s:+.3f} s from {name}, the clocks of both must "
            f"agree{hint}; offset_s in [file.time] of a map{option} corrects one"
        )
    side = "after" if quarters > 0 else "before"
    raise InputError(
        f"{part.sheet.path}: begins {abs(quarters) / 4:g} h {side} {name}, which looks "
        "like another time zone; the clocks must agree: give a map (--map) of [[file]], "
        f'name = "{part.sheet.path.name}", [file.time], offset_s = {-900.0 * quarters:.0f} if the '
        f'positions are wrong, or of "{name}" with {900.0 * quarters:.0f} if it is'
    )


def _leap_hint(apart_s: float) -> str:
    is_leap = abs(abs(apart_s) - _GPS_LESS_UTC_S) < 1.0
    return f" ({_GPS_LESS_UTC_S:.0f} s is GPS time less UTC)" if is_leap else ""


def clock_note(time_s: Floats, other_s: Floats) -> str | None:
    """Return a note where positions begin and end late by the same time, as other clocks do."""
    first_s, last_s = float(other_s[0] - time_s[0]), float(other_s[-1] - time_s[-1])
    if min(abs(first_s), abs(last_s)) < 1.0 or abs(first_s - last_s) > 0.5:
        return None
    return (
        f"positions begin and end {abs(first_s):.1f} s {'after' if first_s > 0 else 'before'} the "
        f"accelerations: do the clocks agree{_leap_hint(first_s)}? offset_s in [file.time] of a "
        "map (--map) corrects one"
    )
