"""Measurements of trucks as tables, one of accelerations and one of fixes.

As CSV they are pairs of files for each run in the form that `driveby import` reads, as Parquet one
file of each kind for all runs.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.signals import CHANNELS, in_order
from schemas.site import Site
from schemas.site_file import site_toml
from services.drives.signals import ChannelSeries, FixSeries, Signals
from services.export.tables import NamedTable

_FIXES = ("latitude_deg", "longitude_deg", "altitude_m", "speed_m_per_s", "heading_deg")


def tables_of_run(run: Signals, number: int) -> list[NamedTable]:
    """Return accelerations and fixes of one run, as `accel_NN` and `gps_NN`."""
    fixes = _by_time(run.fixes)
    return [
        NamedTable(f"accel_{number:02d}", _accelerations(run.channels)),
        NamedTable(
            f"gps_{number:02d}",
            {
                "time_ns": fixes.time_ns,
                "latitude_deg": fixes.latitude_deg,
                "longitude_deg": fixes.longitude_deg,
                "altitude_m": fixes.altitude_m,
                "speed_mps": fixes.speed_m_per_s,
            },
        ),
    ]


def tables_of_runs(runs: Sequence[Signals]) -> list[NamedTable]:
    """Return accelerations and fixes of all runs, with the truck and the number of the run."""
    accel = [_accelerations(run.channels) for run in runs]
    empty = np.empty(0)
    accelerations: dict[str, NDArray[np.generic]] = {
        "time_ns": np.concatenate([one["time_ns"] for one in accel] or [np.empty(0, np.int64)])
    }
    for name in in_order({*CHANNELS, *(name for run in runs for name in run.channels)}):
        parts = [one.get(name, np.full(one["time_ns"].size, np.nan)) for one in accel]
        accelerations[name] = np.concatenate(parts or [empty])
    tracks = [_by_time(run.fixes) for run in runs]
    fixes = {"time_ns": np.concatenate([track.time_ns for track in tracks])}
    for name in _FIXES:
        fixes[name] = np.concatenate([getattr(track, name) for track in tracks])
    return [
        NamedTable(
            "accelerations",
            _identity_columns(runs, [one["time_ns"].size for one in accel]) | accelerations,
        ),
        NamedTable(
            "fixes", _identity_columns(runs, [run.fixes.time_ns.size for run in runs]) | fixes
        ),
    ]


def as_measured(site: Site) -> str:
    """Return the site file for exported CSV files, which are upward and without gravity."""
    sensor = site.sensor.model_copy(update={"gravity_included": False, "up": (1, 1, 1, 1)})
    return site_toml(site.model_copy(update={"sensor": sensor}))


def _by_time(track: FixSeries) -> FixSeries:
    """Return fixes in order of time; a clock that was set back may have changed it."""
    order = np.argsort(track.time_ns, kind="stable")
    return FixSeries(track.time_ns[order], *(values[order] for values in track[1:]))


def _identity_columns(
    runs: Sequence[Signals], sizes: Sequence[int]
) -> dict[str, NDArray[np.generic]]:
    vehicles = np.array([run.vehicle for run in runs], dtype=object)
    return {
        "vehicle": np.repeat(vehicles, sizes),
        "run": np.repeat(np.arange(len(runs), dtype=np.int64), sizes),
    }


def _accelerations(channels: dict[str, ChannelSeries]) -> dict[str, NDArray[np.generic]]:
    """Return a row for each time at which any channel has a sample; NaN where another has none."""
    if not channels:
        return {"time_ns": np.empty(0, np.int64)}
    times = [series.time_ns for series in channels.values()]
    every = times[0]
    # A truck's clock may be set back within a boot: its batches are then not in order of time.
    is_rising = bool(np.all(np.diff(every) > 0))
    if not is_rising or any(not np.array_equal(every, other) for other in times[1:]):
        every = np.unique(np.concatenate(times))
    columns: dict[str, NDArray[np.generic]] = {"time_ns": every}
    for name, (time_ns, values) in channels.items():
        column = np.full(every.size, np.nan)
        column[np.searchsorted(every, time_ns)] = values
        columns[name] = column
    return columns
