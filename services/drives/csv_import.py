"""CSV files of a drive: pairs `accel_NN.csv` and `gps_NN.csv` (docs/contract.md).

Every error names the file, the line and the field. The whole file is parsed at once; only if that
fails, or the numbers are not acceptable, is it read line by line to locate the error.
"""

import re
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from schemas.signals import (
    CHANNELS,
    EARLIEST_WALL_TIME_NS,
    LATEST_WALL_TIME_NS,
    MAX_ACCELERATION_M_PER_S2,
    MAX_CHANNELS,
    MAX_RATE_HZ,
)
from schemas.topics import IDENTIFIER
from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.files import read_text
from services.common.progress import Steps, no_step_progress
from services.drives.runs import GnssTrack, Run, sampling_rate_hz

_CHANNEL: Final = re.compile(IDENTIFIER)
GPS_COLUMNS: Final = ("time_s", "latitude_deg", "longitude_deg", "altitude_m", "speed_mps")


class _Limits(NamedTuple):
    low: float
    high: float
    what: str


_TIME = _Limits(EARLIEST_WALL_TIME_NS / 1e9, LATEST_WALL_TIME_NS / 1e9, "seconds since 1970 UTC")
_ACCELERATION = _Limits(
    -MAX_ACCELERATION_M_PER_S2, MAX_ACCELERATION_M_PER_S2, "an acceleration in m/s²"
)
_LIMITS: Final[dict[str, _Limits]] = {
    "time_s": _TIME,
    "latitude_deg": _Limits(-90, 90, "a latitude in degrees"),
    "longitude_deg": _Limits(-180, 180, "a longitude in degrees"),
    "altitude_m": _Limits(-1000, 20_000, "an altitude in m"),
    "speed_mps": _Limits(-200, 200, "a speed in m/s"),
}
"""Limits of the columns other than accelerations."""


def read_folder(
    folder: Path,
    progress: Steps = no_step_progress,
    channels: tuple[str, ...] | None = CHANNELS,
) -> list[Run]:
    """Read every pair of files in a folder, in order of time; InputError if there is none.

    `channels` are the permitted columns, None for any names of channels. `progress` is called for
    each pair.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, one with accel_NN.csv and gps_NN.csv expected")
    accel = {path.name.removeprefix("accel_"): path for path in folder.glob("accel_*.csv")}
    gps = {path.name.removeprefix("gps_"): path for path in folder.glob("gps_*.csv")}
    if not accel:
        inside = sorted(path.name for path in folder.iterdir() if path.is_dir())
        hint = f"; give each of its folders alone, such as {folder / inside[0]}" if inside else ""
        raise InputError(
            f"{folder}: holds no accel_NN.csv, pairs accel_NN.csv and gps_NN.csv expected{hint}"
        )
    for number in sorted(gps.keys() - accel.keys()):
        missing = folder / f"accel_{number}"
        raise InputError(f"{missing}: no such file, accelerations for {gps[number].name} expected")
    runs: list[Run] = []
    for number in sorted(accel):
        progress(len(runs), len(accel))
        runs.append(read_pair(accel[number], folder / f"gps_{number}", channels))
    runs.sort(key=lambda run: float(run.accel_time_s[0]))
    for before, after in pairwise(runs):
        if after.accel_time_s[0] <= before.accel_time_s[-1]:
            raise InputError(
                f"{after.source}: begins at {after.accel_time_s[0]:.3f} s, before "
                f"{before.source} ends; runs of one truck must follow one another"
            )
    return runs


def read_pair(accel: Path, gps: Path, channels: tuple[str, ...] | None = CHANNELS) -> Run:
    """Read one run; times in s since 1970 UTC, accelerations in m/s² as in the file."""
    columns = _read_accel(accel, channels)
    track = _read_gps(gps, accel)
    time_s = columns.pop("time_s")
    if track.time_s[-1] < time_s[0] or time_s[-1] < track.time_s[0]:
        raise InputError(
            f"{gps}: time_s goes from {track.time_s[0]:.3f} to {track.time_s[-1]:.3f} s, it must "
            f"overlap {accel.name}, which goes from {time_s[0]:.3f} to {time_s[-1]:.3f} s"
        )
    rate_hz = sampling_rate_hz(time_s)
    if not 1 <= rate_hz <= MAX_RATE_HZ:
        raise InputError(
            f"{accel}: time_s gives a rate of {rate_hz:g} Hz, it must be 1 to {MAX_RATE_HZ:g} Hz"
        )
    return Run(str(accel), time_s, rate_hz, columns, track)


def _read_accel(path: Path, channels: tuple[str, ...] | None) -> dict[str, Floats]:
    header, lines = _lines(path)
    if channels is None:
        wanted = f"the columns time_s and at most {MAX_CHANNELS} channels"
        named = [name for name in header if _CHANNEL.fullmatch(name) and name not in GPS_COLUMNS]
        channels = tuple(named[:MAX_CHANNELS])
    else:
        wanted = f"the columns time_s and {', '.join(channels)}"
    _check_header(path, header, ("time_s",), channels, wanted)
    if len(header) < 2:
        raise InputError(f"{path}: line 1: no accelerations, {wanted} expected")
    return _columns(path, header, lines)


def _read_gps(path: Path, accel: Path) -> GnssTrack:
    if not path.exists():
        raise InputError(f"{path}: no such file, positions for {accel.name} expected")
    header, lines = _lines(path)
    _check_header(path, header, GPS_COLUMNS, (), f"the columns {', '.join(GPS_COLUMNS)}")
    columns = _columns(path, header, lines)
    time_s, latitude, longitude, altitude, speed = (columns[name] for name in GPS_COLUMNS)
    return GnssTrack(time_s, latitude, longitude, altitude, speed, heading_deg=None)


def _lines(path: Path) -> tuple[list[str], list[str]]:
    """Return the column names and the lines after them."""
    lines = read_text(path).splitlines()
    if not lines or not lines[0].strip():
        raise InputError(f"{path}: line 1: is empty, a line with the column names expected")
    return [name.strip() for name in lines[0].split(",")], lines[1:]


def _check_header(
    path: Path, header: list[str], needed: tuple[str, ...], optional: tuple[str, ...], wanted: str
) -> None:
    for name in header:
        if name not in needed + optional:
            raise InputError(f'{path}: line 1: unknown column "{name[:40]}", {wanted} expected')
        if header.count(name) > 1:
            raise InputError(f'{path}: line 1: column "{name}" is there twice, {wanted} expected')
    for name in needed:
        if name not in header:
            raise InputError(f'{path}: line 1: no column "{name}", {wanted} expected')


def _columns(path: Path, header: list[str], lines: list[str]) -> dict[str, Floats]:
    try:
        table = (
            np.loadtxt(lines, delimiter=",", comments=None, ndmin=2) if lines else np.empty((0, 0))
        )
    except ValueError as error:
        raise _first_error(path, header, lines) from error
    limits = [_LIMITS.get(name, _ACCELERATION) for name in header]
    low, high = (np.array([one[side] for one in limits]) for side in (0, 1))
    if (
        table.shape[0] < 2
        or table.shape[1] != len(header)
        or not np.all((table >= low) & (table <= high))  # false for NaN too
        or not np.all(np.diff(table[:, header.index("time_s")]) > 0)
    ):
        raise _first_error(path, header, lines)
    return {name: np.ascontiguousarray(table[:, i]) for i, name in enumerate(header)}


def _first_error(path: Path, header: list[str], lines: list[str]) -> InputError:
    """Return the error of the first bad line."""
    before = -np.inf
    rows = 0
    for number, line in enumerate(lines, start=2):
        if not line.strip():
            continue
        rows += 1
        where = f"{path}: line {number}"
        fields = line.split(",")
        if len(fields) != len(header):
            return InputError(f"{where}: has {len(fields)} fields, {len(header)} expected")
        for name, field in zip(header, fields, strict=True):
            value = _number(field)
            low, high, what = _LIMITS.get(name, _ACCELERATION)
            if value is None or not low <= value <= high:
                shown = field.strip()[:40] or "empty"
                return InputError(
                    f"{where}: {name} is {shown}, it must be {what} from {low:g} to {high:g}"
                )
            if name == "time_s":
                if value <= before:
                    return InputError(
                        f"{where}: time_s is {field.strip()}, it must be later than the line before"
                    )
                before = value
    if rows < 2:
        return InputError(f"{path}: has {rows} lines of data, at least 2 expected")
    return InputError(f"{path}: is not a table of numbers separated by commas")


def _number(field: str) -> float | None:
    try:
        return None if "_" in field else float(field)
    except ValueError:
        return None
