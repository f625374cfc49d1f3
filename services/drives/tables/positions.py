"""Positions of tables in degrees, and speeds in m/s."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from services.common.arrays import Floats
from services.common.errors import InputError
from services.drives.runs import GnssTrack
from services.drives.tables import evidence
from services.drives.tables.findings import Findings, Target
from services.drives.tables.mapping import ColumnMap
from services.drives.tables.parts import TablePart
from services.drives.tables.units import LENGTH, SPEED, unit_of

_SPEED_TOLERANCE: Final = 0.25
"""Tolerance of the ratio of speeds to those of the positions, along a straight drive."""


def track(
    part: TablePart, fixes: Mapping[str, Floats], target: Target, found: Findings
) -> GnssTrack:
    """Return positions in degrees and speeds in m/s."""
    first, second = fixes["latitude_deg"], fixes["longitude_deg"]
    declared_unit = part.given.columns.get("latitude_deg", ColumnMap())
    unit: Any = declared_unit.unit
    given = [part.found.columns[name] for name in ("latitude_deg", "longitude_deg")]
    has_signs = any(one.factor is not None or one.side is not None for one in given)
    read = evidence.coordinates(first, second, target.site, unit, has_signs=has_signs)
    if read.is_swapped and declared_unit.column is not None:
        read = evidence.coordinates(
            first, second, target.site, unit or "deg", has_signs=has_signs
        )._replace(is_swapped=False)
    if read.unit != "deg" and unit is None:
        found.guess(part, f"coordinates are in {read.unit}, which places them near a bridge")
    latitude, longitude = evidence.degrees(first, read.unit), evidence.degrees(second, read.unit)
    if read.is_swapped:
        latitude, longitude = longitude, latitude
        found.guess(part, "latitude and longitude are swapped, which places them near a bridge")
        found.swap(part, "latitude_deg", "longitude_deg")
    latitude, longitude = read.signs[0] * latitude, read.signs[1] * longitude
    for name, sign in zip(("latitude_deg", "longitude_deg"), read.signs, strict=True):
        found.column(part, name, unit=read.unit)
        if sign < 0.0:
            found.column(part, name, factor=-1.0)
            found.guess(part, f"{name} has the wrong sign; the other one places it near a bridge")
    _check_range(part, "latitude_deg", latitude, 90.0)
    _check_range(part, "longitude_deg", longitude, 180.0)
    speed = _speed(part, latitude, longitude, fixes, found)
    altitude = fixes.get("altitude_m")
    if altitude is None:
        found.guess(part, "no altitude: it stays unknown", "form")
        altitude = np.full(latitude.size, np.nan)
    else:
        altitude = altitude * _factor(part, found, "altitude_m", LENGTH, "m")
    return GnssTrack(fixes["time_s"], latitude, longitude, altitude, speed, heading_deg=None)


def _speed(
    part: TablePart,
    latitude: Floats,
    longitude: Floats,
    fixes: Mapping[str, Floats],
    found: Findings,
) -> Floats:
    time_s, speed = fixes["time_s"], fixes.get("speed_mps")
    if speed is None or part.given.speed_from_positions:
        if part.given.speed_from_positions is None:
            found.guess(part, "no speed: slopes of the positions over 2 s are taken")
        found.file(part, speed_from_positions=True)
        return evidence.speeds_of_positions(latitude, longitude, time_s)
    ratio = evidence.speed_ratio(latitude, longitude, time_s, speed)
    unit = _speed_unit(part, ratio, found)
    if ratio is not None and abs(ratio * SPEED[unit] - 1.0) > _SPEED_TOLERANCE:
        raise InputError(
            f"{part.sheet.path}: speed in {unit} is {ratio * SPEED[unit]:.2f} times the speed of "
            "the positions: another unit? give it in a map (--map)"
        )
    found.column(part, "speed_mps", unit=unit)
    return speed * SPEED[unit]


def _speed_unit(part: TablePart, ratio: float | None, found: Findings) -> str:
    """Return the unit of the speed, from the map, the numbers, or the header."""
    declared_unit = part.given.columns.get("speed_mps", ColumnMap()).unit
    if declared_unit is not None:
        return _known_unit(part, "speed_mps", declared_unit, SPEED)
    head = unit_of(part.placed["speed_mps"].unit or "")
    if head in SPEED and head != "m/s":
        found.guess(part, f"speed is in {head}, by its header")
        return str(head)
    unit = None if ratio is None else evidence.speed_unit(ratio)
    if unit is None and head is None and part.placed["speed_mps"].why != "exact":
        seen = "" if ratio is None else f" ({ratio:.2f} times the speed of the positions)"
        raise InputError(
            f"{part.sheet.path}: the unit of the speed is undetermined{seen}, give it in a "
            f"map (--map): unit = one of {', '.join(SPEED)}"
        )
    if unit not in (None, "m/s"):
        found.guess(part, f"speed is in {unit}: {ratio:.2f} times the speed of the positions")
    return unit or "m/s"


def _factor(
    part: TablePart, found: Findings, name: str, known: Mapping[str, float], usual: str
) -> float:
    """Return the factor of a unit that the map or the header gives."""
    declared_unit = part.given.columns.get(name, ColumnMap()).unit
    head = unit_of(part.placed[name].unit or "")
    unit = head if head in known else usual
    if declared_unit is not None:
        unit = _known_unit(part, name, declared_unit, known)
    elif unit != usual:
        found.guess(part, f"{name} is in {unit}, by its header")
    found.column(part, name, unit=unit)
    return known[str(unit)]


def _known_unit(part: TablePart, name: str, unit: str, known: Mapping[str, float]) -> str:
    if unit in known:
        return unit
    raise InputError(
        f"{part.sheet.path}: {name} of the map is in {unit}, it must be one of {', '.join(known)}"
    )


def _check_range(part: TablePart, name: str, values: Floats, limit: float) -> None:
    worst = float(values[np.argmax(np.abs(values))])
    if abs(worst) > limit:
        raise InputError(
            f"{part.sheet.path}: {name} is {worst:g}, it must be an angle in degrees from "
            f"{-limit:g} to {limit:g}"
        )
