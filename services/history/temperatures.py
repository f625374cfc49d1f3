"""Temperatures of crossings, from a CSV file of a weather station or a sensor on the bridge."""

import csv
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable
from math import inf, isfinite
from pathlib import Path
from typing import Final

from schemas.results import CrossingResult
from services.common.errors import InputError
from services.common.files import read_text

_FARTHEST_S: Final = 3 * 3600.0
"""Longest time in s between a temperature and a crossing that it describes."""
_MILLISECONDS_S: Final = 1e11
"""Distance in s, some 3,000 years, beyond which times are taken to be in milliseconds."""
_LOWEST, _HIGHEST = -60.0, 80.0


def temperatures_of(path: Path, crossings: Iterable[CrossingResult]) -> dict[str, float]:
    """Return °C by crossing id, interpolated between the rows around it, where both are near.

    The columns are `time_s` (Unix time), `temperature_deg_c`, and `bridge` where rows belong to one
    bridge only. Raise InputError with the number of an invalid line.
    """
    rows = _rows(path)
    found = {}
    for crossing in crossings:
        series = rows.get(crossing.bridge) or rows.get("") or []
        value = _at(series, 0.5 * (crossing.entry_time + crossing.exit_time))
        if value is not None:
            found[crossing.crossing_id] = value
    return found


def nearest_row_s(path: Path, crossings: Iterable[CrossingResult]) -> float:
    """Return the shortest time in s between a crossing and a row that applies to its bridge.

    It is infinite where no row applies.
    """
    rows = _rows(path)
    return min(
        (
            abs(time_s - 0.5 * (crossing.entry_time + crossing.exit_time))
            for crossing in crossings
            for time_s, _ in rows.get(crossing.bridge) or rows.get("") or []
        ),
        default=inf,
    )


def no_match(path: Path, nearest_s: float) -> str:
    """Return why no temperature matched, from the time to the nearest row that applies."""
    if nearest_s == inf:
        return f"no row of {path} applies to these bridges"
    away = (
        f"{nearest_s / 3600:.1f} hours"
        if nearest_s < 2 * 86400
        else f"{nearest_s / 86400:.0f} days"
    )
    units = "; the rows seem to be in milliseconds" if nearest_s > _MILLISECONDS_S else ""
    return f"the nearest row of {path} is {away} away (time_s is Unix time in s){units}"


def _rows(path: Path) -> dict[str, list[tuple[float, float]]]:
    lines = csv.DictReader(read_text(path).splitlines())
    names = lines.fieldnames or ()
    for wanted in ("time_s", "temperature_deg_c"):
        if wanted not in names:
            raise InputError(f"{path}: has no column {wanted}, but {', '.join(names)[:80]}")
    found: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    for number, row in enumerate(lines, start=2):
        try:
            time_s, value = float(row["time_s"]), float(row["temperature_deg_c"])
        except (TypeError, ValueError):
            raise InputError(
                f"{path}: line {number}: time_s and temperature_deg_c must be numbers"
            ) from None
        if not (isfinite(time_s) and _LOWEST <= value <= _HIGHEST):
            raise InputError(
                f"{path}: line {number}: {value:g} is not a temperature of a bridge in °C "
                f"({_LOWEST:g} to {_HIGHEST:g})"
            )
        found[row.get("bridge") or ""].append((time_s, value))
    return {bridge: sorted(series) for bridge, series in found.items()}


def _at(series: list[tuple[float, float]], time_s: float) -> float | None:
    n = bisect_left(series, (time_s, 0.0))
    near = [one for one in series[max(n - 1, 0) : n + 1] if abs(one[0] - time_s) <= _FARTHEST_S]
    if not near:
        return None
    if len(near) == 1:
        return near[0][1]
    (a, low), (b, high) = near
    return low + (high - low) * (time_s - a) / (b - a) if b > a else low
