"""The map of `driveby import --map`: how a vendor's files are read.

Every key is optional: open ones are derived from the files, and shown.
"""

import re
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, Strict, StrictBool, ValidationError

from schemas.toml_text import parse_toml, read_toml_text
from services.common.errors import InputError

AccelerationUnit = Literal["m/s2", "g", "mg", "ug", "cm/s2", "mm/s2", "ft/s2"]
SpeedUnit = Literal["m/s", "km/h", "knots", "mph", "ft/s", "cm/s", "mm/s"]
AngleUnit = Literal["deg", "1e-7 deg", "ddmm", "rad"]
LengthUnit = Literal["m", "ft", "cm", "mm"]
TimeFormat = Literal[
    "unix_s", "unix_ms", "unix_us", "unix_ns", "excel_days", "matlab_days", "labview_s",
    "date", "clock", "gps", "gps_s",
    "start_s", "start_ms", "start_us", "start_samples",
]  # fmt: skip
Order = Literal["ymd", "dmy", "mdy"]
ColumnName = Annotated[int, Strict(), Field(ge=1, le=1000)] | Annotated[str, Field(max_length=200)]
Line = Annotated[int, Strict(), Field(ge=0, le=100_000)]

OPEN_ZONE: Final = ""
"""Zone of times in a map that was written before it was known."""
HEAD: Final = "# How driveby import reads these files (--map)."
POSITION_COLUMNS: Final = ("latitude_deg", "longitude_deg", "altitude_m", "speed_mps")


class MapTable(BaseModel):
    """A table of a map, which refuses unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ColumnMap(MapTable):
    """Column of one quantity, by name or by number from 1, and its form."""

    column: ColumnName | None = None
    unit: AccelerationUnit | SpeedUnit | AngleUnit | LengthUnit | None = None
    factor: Annotated[float, Field(ge=-1e12, le=1e12)] | None = None
    """Factor from the file's number to its `unit`: of counts and volts, or -1 for another sign."""
    side: ColumnName | None = None
    """Column of N, S, E or W next to a latitude or longitude."""
    gravity_included: StrictBool | None = None
    """Whether an accelerometer at rest reads +g where its axis points up."""
    up: Literal[1, -1] | None = None
    """Direction of the axis; -1 points down."""


class TimeMap(MapTable):
    """Times of the rows."""

    column: ColumnName | None = None
    date_column: ColumnName | None = None
    """Column of the date, where date and time of day are separate."""
    week_column: ColumnName | None = None
    """Column of the GPS week, where `column` has the seconds of the week."""
    week: Annotated[int, Strict(), Field(ge=1043, le=9999)] | None = None
    """GPS week of all rows, where no column has it."""
    format: TimeFormat | None = None
    order: Order | None = None
    """Order of the parts of a date."""
    zone: Annotated[str, Field(max_length=100)] | None = None
    """Zone of dates without one: UTC, +01:00, Europe/Berlin."""
    start: str | dict[str, str] | None = None
    """Start from which times count, ISO 8601 with a zone; by run where there are several."""
    offset_s: float | None = None
    """Offset added to every time, to correct a clock."""
    even: StrictBool | None = None
    """Whether stamps were rounded, so that the samples are even at the declared rate."""


class FileMap(MapTable):
    """One file, or all that match `name`, in which `*` is common to the files of one run."""

    name: Annotated[str, Field(min_length=1, max_length=200)] = "*"
    run: Annotated[str, Field(max_length=100)] | None = None
    """Run of this file, where the name does not contain it."""
    skip: StrictBool | None = None
    """Whether the file is not part of the drive."""
    encoding: Literal["utf-8", "utf-16", "latin-1", "cp1252"] | None = None
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = None
    decimal: Literal[".", ","] | None = None
    header_line: Line | None = None
    units_line: Line | None = None
    first_line: Annotated[Line, Field(ge=1)] | None = None
    held_fixes: StrictBool | None = None
    """Whether a fix is repeated in the rows until the next one."""
    speed_from_positions: StrictBool | None = None
    time: TimeMap = TimeMap()
    columns: dict[str, ColumnMap] = {}

    def matches(self, name: str) -> bool:
        """Return whether the map applies to a file of that name."""
        pattern = ".*".join(re.escape(part) for part in self.name.split("*"))
        return re.fullmatch(pattern, name) is not None

    def run_of(self, name: str) -> str | None:
        """Return the common part of the names of one run's files; None if it is not defined."""
        if self.run is not None or self.name.count("*") != 1 or self.name == "*":
            return self.run
        before, after = self.name.split("*")
        return name[len(before) : len(name) - len(after)]


class ImportMap(MapTable):
    """A complete map."""

    files: Annotated[tuple[FileMap, ...], Field(alias="file", max_length=1000)] = ()

    def of(self, name: str) -> FileMap | None:
        """Return the map of a file; None if it has none."""
        return next((one for one in self.files if one.matches(name)), None)


def load_map(path: Path) -> ImportMap:
    """Read a map; InputError, in one line, if it is unreadable or wrong."""
    table = parse_toml(read_toml_text(path, "a map of files"), str(path))
    try:
        return ImportMap.model_validate(table)
    except ValidationError as error:
        raise InputError(f"{path}: {_first_line(error)}") from error


def map_text(found: ImportMap) -> str:
    """Return the TOML text of a map; reading it gives an equal one."""
    lines = [HEAD]
    for file in found.files:
        lines += ["", "[[file]]"]
        values = file.model_dump(exclude_none=True)
        time, columns = values.pop("time"), values.pop("columns")
        lines += [f"{key} = {_value(value)}" for key, value in values.items()]
        if time:
            lines.append("[file.time]")
            lines += [_time_line(key, value) for key, value in time.items()]
        if columns:
            lines.append("[file.columns]")
            lines += [_column_line(key, value) for key, value in columns.items()]
    return "\n".join(lines) + "\n"


def _time_line(key: str, value: Any) -> str:
    if (key, value) == ("zone", OPEN_ZONE):
        return '# zone = "Europe/Berlin"  # missing: fill in, or UTC, or +01:00'
    return f"{key} = {_value(value)}"


def _column_line(key: str, value: dict[str, Any]) -> str:
    line = f"{key} = {_value(value)}"
    if key in POSITION_COLUMNS or "unit" in value:
        return line
    units = ", ".join(get_args(AccelerationUnit)[1:])
    return f'{line}  # missing: add unit = "m/s2" (or {units}); of counts or volts also factor'


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        pairs = (f"{_key(key)} = {_value(one)}" for key, one in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, str):
        return '"' + "".join(_character(c) for c in value) + '"'
    return repr(value)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _character(c: str) -> str:
    if c in '"\\':
        return f"\\{c}"
    return c if c.isprintable() else f"\\u{ord(c):04x}"


def _first_line(error: ValidationError) -> str:
    """Return the first error with its remedy."""
    problems = error.errors(include_url=False)
    problem = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    place = ".".join(str(part) for part in problem["loc"] if not _is_branch(part))
    if problem["type"] == "extra_forbidden":
        return f"{place} is not a known key, check its spelling or remove it"
    shown = str(problem["input"])[:40]
    if problem["type"] == "tuple_type":
        return f'{place} is "{shown}", it must be a list: [[{place}]] before the keys of each'
    choices = [
        choice
        for one in problems
        if one["loc"][: len(problem["loc"]) - 1] == problem["loc"][:-1]
        for choice in re.findall(r"'([^']*)'", str(one.get("ctx", {}).get("expected", "")))
    ]
    words = problem["msg"].removeprefix("Input should be ")
    expected = ", ".join(choices) or words[:1].lower() + words[1:]
    return f'{place} is "{shown}", it must be {"one of " * bool(choices)}{expected}'


def _is_branch(part: int | str) -> bool:
    """Return whether Pydantic names one of several types here, and no key of the file."""
    return isinstance(part, str) and bool(re.search(r"[\[\]']|^(int|str|constrained)", part))
