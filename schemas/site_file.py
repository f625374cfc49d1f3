"""The text of a site file: parsed into `schemas.site` with errors to correct, and written."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ValidationError

from schemas.errors import InputError
from schemas.site import MAX_TABLES, Bridge, Receiver, Sensor, Site, Vehicle
from schemas.site_axle_tables import Axle, Bogie
from schemas.site_bridge import MAX_ELEMENTS
from schemas.site_damping import COEFFICIENTS, DAMPING_RATIO
from schemas.site_errors import Tables, all_lines, first_line
from schemas.site_import import Import
from schemas.site_ros2 import Ros2
from schemas.site_sensors import PlacedSensor
from schemas.toml_text import parse_toml, read_toml_text

_MAX_FIELDS: Final = 100
"""Largest number of fields in a table and of values in a list."""
_TABLES: Final[Tables] = {
    "vehicle": Vehicle,
    "bridge": Bridge,
    "sensor": Sensor,
    "receiver": Receiver,
    "ros2": Ros2,
    "import": Import,
    "vehicle.axles": Axle,
    "vehicle.bogies": Bogie,
    "vehicle.sensors": PlacedSensor,
}
_LISTS: Final = ("vehicle", "bridge", "ros2")
"""Tables that may occur several times."""


def load_site(path: str | Path) -> Site:
    """Read a site file; raise InputError in one line if it cannot be read or is wrong."""
    try:
        place = Path(path)
    except TypeError as error:
        kind = type(path).__name__
        raise InputError(f"site is of type {kind}, it must be the name of a site file") from error
    return parse_site(read_site_text(place), str(path))


def read_site_text(path: Path) -> str:
    """Return the text of a site file; raise InputError if it cannot be read or is too large."""
    return read_toml_text(path, "a site file")


def parse_site(toml_text: str, source_name: str) -> Site:
    """Return the site of a text; raise an InputError that begins with `source_name`."""
    return _site_of(parse_toml(toml_text, source_name), source_name)


def with_values(site: Site, values: Mapping[str, object]) -> Site:
    """Return the site with values replaced, by names such as `bridge.mass_per_length_kg_per_m`.

    Nominal values and spreads are the priors of the parameters. Where the site has several vehicles
    or bridges, the identifier takes the place of the table's name. None removes a key, so that its
    default applies; a key without a default is missing then. `damping_ratio` with
    `first_frequency_hz` replaces the Rayleigh coefficients. Raise InputError in one line for a name
    or value that a site file must not have.
    """
    if not isinstance(site, Site):
        raise InputError(
            f"site is of type {type(site).__name__}, it must be what load_site() returns"
        )
    if not isinstance(values, Mapping):
        raise InputError(
            f"values is of type {type(values).__name__}, it must be values by their names, such as "
            '{"bridge.span_m": 20.0}'
        )
    tables = parse_toml(site_toml(site), "the site")
    by_name: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for kind, found in tables.items():
        for table in found if isinstance(found, list) else [found]:
            for name in dict.fromkeys((kind, table.get("id", kind))):
                by_name.setdefault(name, []).append((kind, table))
    for name, value in values.items():
        of, _, key = str(name).rpartition(".")
        possible = by_name.get(of, [])
        if len(possible) != 1:
            known = ", ".join(one for one, found in by_name.items() if len(found) == 1)
            raise InputError(f"{name}: is unknown, it must be TABLE.KEY of a table of {known}")
        ((kind, table),) = possible
        plain = value.tolist() if hasattr(value, "tolist") else value
        if plain is None and key in _TABLES[kind].model_fields:
            table.pop(key, None)
        else:  # an unknown key is refused with its table, whatever its value
            table[key] = list(plain) if isinstance(plain, tuple) else plain
        for replaced in COEFFICIENTS if key == DAMPING_RATIO and plain is not None else ():
            if f"{of}.{replaced}" not in values:
                table.pop(replaced, None)
    return _site_of(tables, "the site")


def _site_of(table: dict[str, Any], source_name: str) -> Site:
    single = {name for name in _LISTS if isinstance(table.get(name), dict)}
    for name in single:
        table[name] = [table[name]]
    too_many = _too_many(table)
    if too_many:
        raise InputError(f"{source_name}: {too_many}")
    try:
        return Site.model_validate(table)
    except ValidationError as error:
        raise InputError(f"{source_name}: {first_line(error, single, _TABLES)}") from error


def faults_of_site(toml_text: str, source_name: str) -> list[str]:
    """Return all errors of a site file, a line each; empty if it is valid.

    Errors that concern several fields appear only when each of these is valid.
    """
    try:
        parse_site(toml_text, source_name)
    except InputError as error:
        cause = error.__cause__
        if not isinstance(cause, ValidationError):
            return [str(error)]
        table = parse_toml(toml_text, source_name)
        single = {name for name in _LISTS if isinstance(table.get(name), dict)}
        return [f"{source_name}: {line}" for line in all_lines(cause, single, _TABLES)]
    return []


def _too_many(table: dict[str, Any]) -> str | None:
    """Return an error if a table or list is too long; Pydantic would report each of its entries."""
    parts = [("the file", table)]
    for name, value in table.items():
        tables = value if isinstance(value, list) else [value]
        if len(tables) > MAX_TABLES:
            return f"has {len(tables)} [[{name}]], at most {MAX_TABLES} are expected"
        parts += [(f"[{name}]", part) for part in tables if isinstance(part, dict)]
    for name, part in parts:
        if len(part) > _MAX_FIELDS:
            return f"{name} has {len(part)} fields, most of them unknown"
        for key, value in part.items() if name != "the file" else ():
            if isinstance(value, list) and len(value) > _MAX_FIELDS:
                return f"{name} {key} has {len(value)} values, at most {MAX_ELEMENTS} are expected"
    return None


def site_hash(site: Site) -> str:
    """Return 16 hex digits that change with any value, however the file is laid out.

    `[ros2]` and `[import]` do not count: they define the source and the realm of messages, not
    their content.
    """
    values = site.model_dump(by_alias=True, exclude={"ros2", "imports", "vehicles"})
    values["vehicle"] = [vehicle.shortest() for vehicle in site.vehicles]
    canonical = json.dumps(values, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def site_toml(site: Site) -> str:
    """Return a site file with every value spelt out; parsing it gives an equal site."""
    vehicle = "[vehicle]" if len(site.vehicles) == 1 else "[[vehicle]]"
    bridge = "[bridge]" if len(site.bridges) == 1 else "[[bridge]]"
    tables: list[tuple[str, BaseModel]] = [(vehicle, table) for table in site.vehicles]
    tables += [(bridge, table) for table in site.bridges]
    tables += [("[sensor]", site.sensor), ("[receiver]", site.receiver)]
    tables += [("[[ros2]]", table) for table in site.ros2]
    if site.imports is not None:
        tables.append(("[import]", site.imports))
    return _toml(tables)


def vehicle_toml(site: Site, vehicle_id: str) -> str:
    """Return the [vehicle], [sensor] and [receiver] parts, as a truck publishes them."""
    return _toml(
        [
            ("[vehicle]", site.vehicle(vehicle_id)),
            ("[sensor]", site.sensor),
            ("[receiver]", site.receiver),
        ]
    )


def _toml(tables: list[tuple[str, BaseModel]]) -> str:
    return "".join(
        _table_text(heading, one.shortest() if isinstance(one, Vehicle) else one.model_dump())
        for heading, one in tables
    )


def toml_of(tables: dict[str, dict[str, Any]]) -> str:
    """Return the TOML text of tables of numbers, texts, booleans and lists of them."""
    return "".join(_table_text(f"[{name}]", table) for name, table in tables.items())


def _table_text(heading: str, table: dict[str, Any]) -> str:
    lines = [heading]
    for key, value in table.items():
        if value is not None:
            lines.append(f"{key} = {_value_text(value)}")
    return "\n".join(lines) + "\n"


def _value_text(value: Any) -> str:
    if isinstance(value, dict):
        pairs = (f"{key} = {_value_text(one)}" for key, one in value.items() if one is not None)
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple) and any(isinstance(one, dict) for one in value):
        return f"[{', '.join(_value_text(one) for one in value)}]"
    # JSON's numbers, strings, booleans and lists are valid TOML, except that DEL must be escaped.
    return json.dumps(value, ensure_ascii=False, default=str).replace("\x7f", "\\u007f")
