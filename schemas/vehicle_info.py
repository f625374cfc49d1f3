"""A truck's own part of a site file (`info`), and its comparison with the owner's site file.

A driver may publish less than a whole `[vehicle]` table; only given values are compared.
"""

import math
from typing import Any, Final, NamedTuple

from schemas.errors import InputError
from schemas.signals import MAX_SITE_BYTES
from schemas.site import Vehicle
from schemas.site_axles import in_pairs
from schemas.site_file import toml_of
from schemas.toml_text import parse_toml

_LARGEST_Z: Final = 4.0
"""Largest difference of two independent values in standard deviations; one truck in 16,000 exceeds
it."""
_SMALLEST_SPREAD: Final = 1e-3
"""Smallest spread of a value, because data sheets are rounded."""
_TOO_LARGE: Final = 1e100
_COMPARED: Final = tuple(
    name for name in Vehicle.model_fields if f"{name}_spread" in Vehicle.model_fields
)


class InfoDifference(NamedTuple):
    """A field in which a truck and the site file differ by more than their spreads explain."""

    field: str
    declared: float
    known: float


def vehicle_part(site_toml: str, vehicle_id: str) -> str:
    """Return the truck's own part of a site file: [vehicle], [sensor] and [receiver].

    Text that holds nothing else is returned unchanged. Raise InputError if it is not TOML, has no
    vehicle of that id, or is longer than a message may be.
    """
    table = parse_toml(site_toml, "info")
    mine = [one for one in _vehicles(table) if one.get("id") == vehicle_id]
    if not mine:
        raise InputError(f'info: has no [vehicle] with id = "{vehicle_id}"')
    own = {"vehicle": mine[0]} | {
        name: table[name] for name in ("sensor", "receiver") if isinstance(table.get(name), dict)
    }
    is_own = set(table) == set(own) and len(_vehicles(table)) == 1
    text = site_toml
    if not is_own:
        text = toml_of(own)
        parse_toml(text, "info")  # the table may hold values that a site file cannot
    if len(text.encode()) > MAX_SITE_BYTES:
        raise InputError(
            f"info: has {len(text.encode())} bytes, at most {MAX_SITE_BYTES} are expected"
        )
    return text


def differences(info_toml: str, known: Vehicle) -> list[InfoDifference]:
    """Return the fields in which a truck's `info` contradicts the vehicle of the site file.

    Both values count as independent measurements with log-normal errors of their own spreads.
    Missing values, implausible ones and text that is not TOML are ignored.
    """
    try:
        table = parse_toml(info_toml, "info")
    except InputError:
        return []
    reported = next((one for one in _vehicles(table) if one.get("id") == known.id), {})
    try:
        reported = in_pairs(reported)
    except ValueError:
        return []
    found = []
    for name in _COMPARED:
        mine = _numbers(getattr(known, name))
        theirs = _numbers(reported.get(name))
        spreads = _numbers(reported.get(f"{name}_spread")) or [
            Vehicle.model_fields[f"{name}_spread"].default
        ]
        if len(mine) != len(theirs) or len(spreads) != 1:
            continue
        spread = max(_SMALLEST_SPREAD, math.hypot(known.spread(name), spreads[0]))
        found += [
            InfoDifference(name, b, a)
            for a, b in zip(mine, theirs, strict=True)
            if a > 0.0 and b > 0.0 and abs(math.log(b / a)) > _LARGEST_Z * spread
        ]
    return found


def _vehicles(table: dict[str, Any]) -> list[dict[str, Any]]:
    vehicles = table.get("vehicle")
    listed = vehicles if isinstance(vehicles, list) else [vehicles]
    return [one for one in listed if isinstance(one, dict)]


def _numbers(value: Any) -> list[float]:
    """Return a number or a list of them as a list; empty for anything else."""
    numbers: list[float] = []
    for one in value if isinstance(value, list | tuple) else [value]:
        if isinstance(one, bool) or not isinstance(one, int | float) or not abs(one) < _TOO_LARGE:
            return []
        numbers.append(float(one))
    return numbers
