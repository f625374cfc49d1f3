"""What a truck says of itself (`info`): its own part of a site file, and whether that is the truck
that the owner's site file knows under that name.

A driver may say less than a whole `[vehicle]` table; only what it says is compared.
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
"""The difference of two independent values exceeds so many of its standard deviations in one truck
of 16,000."""
_SMALLEST_SPREAD: Final = 1e-3
"""Values of a data sheet are rounded, however well they are known."""
_TOO_LARGE: Final = 1e100
_COMPARED: Final = tuple(
    name for name in Vehicle.model_fields if f"{name}_spread" in Vehicle.model_fields
)


class Difference(NamedTuple):
    """A field in which a truck and the site file differ by more than their spreads explain."""

    field: str
    said: float
    known: float


def own_part(site_toml: str, vehicle_id: str) -> str:
    """Return what of a site file is the truck's own: [vehicle], [sensor] and [receiver].

    Text that holds nothing else is returned as it is. InputError: not TOML, no vehicle of that id,
    or longer than a message may be.
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
        parse_toml(text, "info")  # what it says may be nothing that a site file can say
    if len(text.encode()) > MAX_SITE_BYTES:
        raise InputError(
            f"info: has {len(text.encode())} bytes, at most {MAX_SITE_BYTES} are expected"
        )
    return text


def differences(info_toml: str, known: Vehicle) -> list[Difference]:
    """What a truck says of itself that is not the vehicle of the site file.

    Both values are taken for independent measurements with log-normal errors of the spreads that
    go with them. Text that is no TOML, says nothing of a value, or nothing sensible, says nothing.
    """
    try:
        table = parse_toml(info_toml, "info")
    except InputError:
        return []
    said = next((one for one in _vehicles(table) if one.get("id") == known.id), {})
    try:
        said = in_pairs(said)
    except ValueError:
        return []
    found = []
    for name in _COMPARED:
        mine = _numbers(getattr(known, name))
        theirs = _numbers(said.get(name))
        spreads = _numbers(said.get(f"{name}_spread")) or [
            Vehicle.model_fields[f"{name}_spread"].default
        ]
        if len(mine) != len(theirs) or len(spreads) != 1:
            continue
        spread = max(_SMALLEST_SPREAD, math.hypot(known.spread(name), spreads[0]))
        found += [
            Difference(name, b, a)
            for a, b in zip(mine, theirs, strict=True)
            if a > 0.0 and b > 0.0 and abs(math.log(b / a)) > _LARGEST_Z * spread
        ]
    return found


def _vehicles(table: dict[str, Any]) -> list[dict[str, Any]]:
    vehicles = table.get("vehicle")
    listed = vehicles if isinstance(vehicles, list) else [vehicles]
    return [one for one in listed if isinstance(one, dict)]


def _numbers(value: Any) -> list[float]:
    """A number, or a list of them, as a list; empty if it is neither."""
    numbers: list[float] = []
    for one in value if isinstance(value, list | tuple) else [value]:
        if isinstance(one, bool) or not isinstance(one, int | float) or not abs(one) < _TOO_LARGE:
            return []
        numbers.append(float(one))
    return numbers
