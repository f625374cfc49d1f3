"""Gaps of a drive in words: where and how long, and whether the truck was on a bridge."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from schemas.site import Bridge, Site, Vehicle
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, to_chainage
from services.common.language import utc_second
from services.common.naming import count_of
from services.drives.runs import Run, grid_index
from services.finding.stays import CORRIDOR_M

_MAX_NAMED: Final = 3
"""Maximum number of gaps of a run that are named: those on bridges first, then the longest."""
_LONGEST_FIX_S: Final = 1.5
"""Longest time between two fixes that is no outage (docs/verdicts.md)."""


class _Gap(NamedTuple):
    """A time without rows in a file: last time before it and first one after it, in s."""

    what: str
    begin_s: float
    end_s: float
    where: str | None
    """Bridge and chainages where it lies; None away from all bridges."""

    @property
    def length_s(self) -> float:
        return self.end_s - self.begin_s


def gap_notes(run: Run, site: Site, vehicle: Vehicle) -> Iterator[str]:
    """Yield a line for each gap in the samples of a run, and for each outage of its fixes."""
    found = [
        _Gap(what, begin_s, end_s, _bridge_of(run, site, vehicle, (begin_s, end_s)))
        for what, begin_s, end_s in (*_without_samples(run), *_without_fixes(run))
    ]
    found.sort(key=lambda one: (one.where is None, -one.length_s))
    for one in found[:_MAX_NAMED]:
        where = "on no bridge of the site file"
        if one.where is not None:
            where = f"{one.where}, so its crossing will not be good"
        since_s = one.begin_s - float(run.accel_time_s[0])
        yield (
            f"{one.what} for {one.length_s:.2f} s, from {since_s:.2f} s after its first sample "
            f"({utc_second(one.begin_s)} UTC): {where}"
        )
    others = found[_MAX_NAMED:]
    if others:
        total_s = sum(one.length_s for one in others)
        yield f"{count_of(len(others), 'more gap')}, {total_s:.2f} s in all"


def _without_samples(run: Run) -> Iterator[tuple[str, float, float]]:
    time_s = run.accel_time_s
    for k in np.flatnonzero(np.diff(grid_index(time_s)) > 1):
        yield "no samples", float(time_s[k]), float(time_s[k + 1])


def _without_fixes(run: Run) -> Iterator[tuple[str, float, float]]:
    time_s = run.gnss.time_s
    steps_s = np.diff(time_s)
    usual_s = float(np.median(steps_s)) if steps_s.size else 0.0
    for k in np.flatnonzero(steps_s > max(_LONGEST_FIX_S, 1.5 * usual_s)):
        yield "no fix", float(time_s[k]), float(time_s[k + 1])


def _bridge_of(run: Run, site: Site, vehicle: Vehicle, gap_s: tuple[float, float]) -> str | None:
    """Return the bridge that the truck was on in a gap, and the chainages of its front axle."""
    for bridge in site.bridges:
        front_m = _front_axle_m(run, bridge, vehicle, gap_s)
        if front_m is None:
            continue
        (begin, end), forward = front_m, np.sign(front_m[1] - front_m[0]) or 1.0
        axles_m = [*front_m, *(front_m - forward * vehicle.length_m)]
        if min(axles_m) < bridge.span_m and max(axles_m) > 0.0:
            return f"on {bridge.id}, front axle from {begin:.1f} to {end:.1f} m"
    return None


def _front_axle_m(
    run: Run, bridge: Bridge, vehicle: Vehicle, gap_s: tuple[float, float]
) -> Floats | None:
    """Return the chainages (2,) of the front axle at the ends of a gap; None next to the bridge."""
    gnss = run.gnss
    chainage_m, lateral_m = to_chainage(bridge_frame(bridge), gnss.latitude_deg, gnss.longitude_deg)
    at_m, aside_m = (np.interp(gap_s, gnss.time_s, values) for values in (chainage_m, lateral_m))
    if np.abs(aside_m).min() > CORRIDOR_M:
        return None
    return np.asarray(at_m + np.sign(at_m[1] - at_m[0]) * vehicle.gps_antenna_to_front_axle_m)
