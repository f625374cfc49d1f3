"""Errors of a site file in one line that names the field and what would be right."""

import difflib
import json
import math
import re
from collections.abc import Iterator
from typing import Any, Final

from pydantic import BaseModel, ValidationError

Tables = dict[str, type[BaseModel]]


class FieldError(ValueError):
    """A wrong value that only several fields together reveal; it names the field to correct."""

    def __init__(self, path: str, message: str) -> None:
        super().__init__(message)
        self.path = path


def error_at(path: str, message: str) -> FieldError:
    """Return the error for the field at `path`."""
    return FieldError(path, message)


# Noun and unit of a field by the end of its name; longer endings first.
_QUANTITIES: Final = (
    ("_nm_per_rad", "a rotational stiffness", "N·m/rad"),
    ("_ns_per_m", "a damping", "N·s/m"),
    ("_n_per_m", "a stiffness", "N/m"),
    ("_kg_per_m", "a mass per length", "kg/m"),
    ("_ug_per_rthz", "a noise density", "µg/√Hz"),
    ("_m_per_s", "a speed", "m/s"),
    ("_per_s", "a coefficient", "1/s"),
    ("damping_ratio", "a damping ratio", ""),
    ("first_frequency_hz", "a frequency", "Hz"),
    ("_nm2", "a flexural rigidity", "N·m²"),
    ("_offset_m_spread", "a standard deviation", "m"),
    ("_spread", "a relative standard deviation", ""),
    ("_kg", "a mass", "kg"),
    ("_hz", "a rate", "Hz"),
    ("_deg", "an angle", "degrees"),
    ("_m", "a length", "m"),
    ("_s", "a time", "s"),
    ("elements", "a whole number", ""),
)


def first_line(error: ValidationError, single: set[str], tables: Tables) -> str:
    """Return the first error to correct and the number of others.

    `single` are the tables that are not lists in the file; `tables` the models by their names.
    """
    # A misspelt field is also a missing one: the spelling is what the user can see. And a list
    # whose entry is wrong is counted by Pydantic as too short as well.
    line, *others = all_lines(error, single, tables)
    return f"{line} (and {len(others)} more, driveby check lists them)" if others else line


def all_lines(error: ValidationError, single: set[str], tables: Tables) -> list[str]:
    """Return all errors, a line each and the most specific first; arguments as in `first_line`."""
    order = {"extra_forbidden": 0, "too_short": 2}
    problems = sorted(error.errors(include_url=False), key=lambda p: order.get(p["type"], 1))
    first, *others = problems
    shown = [first, *(p for p in others if p["type"] != "too_short")]
    lines = [_describe(problem, single, tables) for problem in shown]
    # A number that stands for a whole list is wrong once for each of its entries.
    without = [re.sub(r"\[\d+\](?= is )", "", line, count=1) for line in lines]
    return [
        line if without.count(plain) == 1 else plain
        for k, (line, plain) in enumerate(zip(lines, without, strict=True))
        if without.count(plain) == 1 or plain not in without[:k]
    ]


def _describe(problem: Any, single: set[str], tables: Tables) -> str:
    location = list(problem["loc"])
    context = problem.get("ctx", {})
    cause = context.get("error")
    if isinstance(cause, FieldError):
        location += [int(part) if part.isdigit() else part for part in cause.path.split(".")]
        return f"{_path(location, single)} {cause}"
    path = _path(location, single)
    key = next((str(part) for part in reversed(location) if isinstance(part, str)), "")
    if problem["type"] == "missing":
        if len(location) == 1:
            return f"the table [{path}] is missing"
        what = _TABLE_LISTS.get(_list_key(location)) or _quantity(key)
        return f"{path} is missing" + (f", it must be {what}" if what else "")
    if problem["type"] == "extra_forbidden":
        return f"{path} is not a known field, {_suggestion(key, len(location), tables)}"
    value = problem["input"]
    if problem["type"] in ("too_short", "too_long") and _list_key(location) in _TABLE_LISTS:
        entries = "1 entry" if len(value) == 1 else f"{len(value)} entries"
        return f"{path} has {entries}, it must be {_TABLE_LISTS[_list_key(location)]}"
    return (
        f"{path} is {_shown(value)}, it must be {_expected(problem, _list_key(location), tables)}"
        f"{_meant(value, _list_key(location), problem['type'])}"
    )


_USUAL_M: Final = {
    "span_m": (3.0, 200.0), "wheelbase_m": (1.5, 12.0), "front_axle_to_cg_m": (0.3, 10.0),
    "gps_antenna_to_front_axle_m": (0.1, 20.0), "cg_height_m": (0.5, 3.0), "track_m": (1.0, 3.0),
}  # fmt: skip
"""Usual lengths, by which a value in cm or mm is recognised."""


def _meant(value: object, key: str, kind: str) -> str:
    """Return a hint in which unit a number beyond its bound may be; empty if none is likely."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return ""
    if kind == "less_than_equal" and key in _USUAL_M:
        low, high = _USUAL_M[key]
        for unit, factor in (("cm", 1e-2), ("mm", 1e-3)):
            if low <= value * factor <= high:
                return f"; in {unit}? then it is {value * factor:g}"
    if kind == "less_than_equal" and key == "damping_ratio" and value <= 20.0:
        return f"; in %? then it is {value / 100.0:g}"
    if kind == "less_than_equal" and key.endswith("_latitude_deg") and value <= 180.0:
        return "; a longitude?"
    if kind == "greater_than_equal" and key == "rate_hz" and 0.01 <= value < 1.0:
        return f"; in kHz? then it is {1e3 * value:g}"
    return ""


def _suggestion(key: str, depth: int, tables: Tables) -> str:
    if depth == 1:
        known = list(tables)
    else:
        for name, table in tables.items():
            if key in table.model_fields:
                return f"it belongs into [{name}]"
        known = [field for table in tables.values() for field in table.model_fields]
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.8)
    return f"did you mean {close[0]}?" if close else "check its spelling or remove it"


def _path(location: list[int | str], single: set[str]) -> str:
    """Return a place as the user typed it: no index for a table that is not a list."""
    parts = list(_path_parts(location, single))
    return "".join(parts).removeprefix(".") or "the file"


def _path_parts(location: list[int | str], single: set[str]) -> Iterator[str]:
    for position, part in enumerate(location):
        if isinstance(part, int):
            if position != 1 or location[0] not in single:
                yield f"[{part}]"
        else:
            yield f".{part}"


def _quantity(key: str, condition: str = "") -> str:
    for ending, noun, unit in _QUANTITIES:
        if key.endswith(ending):
            return " ".join(part for part in (noun, condition or ("in" * bool(unit)), unit) if part)
    return f"a number {condition}".strip() if condition else ""


def _expected(problem: Any, key: str, tables: Tables) -> str:
    kind, context = problem["type"], problem.get("ctx", {})
    conditions = {
        "greater_than": ("greater than", "gt"),
        "greater_than_equal": ("of at least", "ge"),
        "less_than": ("less than", "lt"),
        "less_than_equal": ("of at most", "le"),
    }
    if kind in conditions:
        words, name = conditions[kind]
        return _quantity(key, f"{words} {context[name]:g}")
    if kind == "finite_number":
        return ", ".join(part for part in (_quantity(key), "a finite number") if part)
    if key in ("id", "channel", "name"):
        return (
            'an identifier of a-z, 0-9, "_" and "-", at most 63, beginning with a letter or digit'
        )
    if key in ("topic", "gnss", "velocity"):
        return 'the whole name of a topic of ROS, e.g. "/imu/front"'
    if kind in ("float_type", "int_type", "int_from_float"):
        return _quantity(key) or "a number"
    if kind in ("tuple_type", "too_short", "too_long"):
        return _list_expected(key, tables)
    messages = {
        "bool_type": "true or false",
        "string_type": "a text in quotation marks",
        "literal_error": _CHOICES.get(key, "1 or -1"),
        "model_type": "a table",
        "model_attributes_type": "a table",
    }
    message: str = problem["msg"]
    return messages.get(kind, message[:1].lower() + message[1:])


_CHOICES: Final = {
    "bearings": '"unknown", "free" or "sprung"',
    "axis": '"x", "y" or "z", with "-" before it if that axis points down',
    "tyres": '"single", "twin" or "wide"',
    "on": '"body" or "axle"',
    "road_class": 'an ISO 8608 class, "A" to "E"',
}


_TABLE_LISTS: Final = {
    "axles": "two [[vehicle.axles]], or more with a tandem at the end",
    "bogies.axles": "a list of the numbers of its axles, [2, 3]",
    "bogies": "one [[vehicle.bogies]], with axles = [2, 3]",
    "sensors": "at most 32 [[vehicle.sensors]]",
}


def _list_key(location: list[int | str]) -> str:
    """Return the name of the last key of a place; `axles` of a bogie is `bogies.axles`."""
    keys = [str(part) for part in location if isinstance(part, str)]
    return "bogies.axles" if keys[-2:] == ["bogies", "axles"] else keys[-1] if keys else ""


def _list_expected(key: str, tables: Tables) -> str:
    if key in _TABLE_LISTS:
        return _TABLE_LISTS[key]
    if key == "shares":
        return "a list with one number for each axle of the bogie"
    if key in ("track_m", "tyre_width_m"):
        return "a length in m or a pair [front, rear]"
    if key == "twin_tyre_distance_m":
        return (
            "0 for single tyres or a pair [front, rear], such as [0, 0.33]: front tyres are single"
        )
    if key in ("vehicle", "bridge", "ros2"):
        return f"a table [{key}] or several [[{key}]]"
    if key in ("flexural_rigidity_per_element_nm2", "element_lengths_m"):
        return "a list with one number for each element"
    if key == "interior_supports_m":
        return "a list of chainages in m"
    if key == "bearings":
        return f"{_CHOICES[key]}, or a pair [start, end] of these"
    if key in tables["sensor"].model_fields:
        return (
            "a number, or a list of four in the order sprung front, sprung rear, unsprung front, "
            "rear"
        )
    return "a pair [front, rear]"


def _shown(value: object) -> str:
    """Return a value as TOML would show it, cut to fit a line; a template has nan to replace."""
    if isinstance(value, float) and math.isnan(value):
        return "NaN (not filled in)"
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):
        text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
