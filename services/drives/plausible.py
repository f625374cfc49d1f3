"""Cross-checks of a CSV drive: units and columns that contradict the numbers."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from schemas.signals import CHANNELS
from schemas.site import Site, Vehicle
from services.common.errors import InputError
from services.drives.gaps import gap_notes
from services.drives.runs import Run
from services.drives.tables import evidence
from services.drives.tables.clocks import clock_note
from services.drives.tables.guesses import Guess
from services.drives.tables.stamps import LATEST_UNIX_S
from services.drives.tables.units import SPEED
from services.finding.placed import middle_sensor

_SPEED_TOLERANCE: Final = 0.25
_HIGHEST_M: Final = 9000.0
"""Highest altitude of a road in m."""


def check_plausible(run: Run, site: Site, vehicle: Vehicle | None = None) -> None:
    """Raise InputError if speed, coordinates or accelerations are in another unit or order.

    Gravity, and noise against its declared density, are compared where `vehicle` is given.
    """
    _check_coordinates(run, site)
    _check_speed(run)
    means = [abs(float(values.mean())) for values in run.channels.values()]
    if len(means) > 1 and all(abs(mean - 1.0) < 0.03 for mean in means):
        raise InputError(
            f"{run.source}: the mean of every channel is near 1, which is gravity in g: "
            "multiply by 9.80665, and set gravity_included in [sensor]"
        )
    if vehicle is not None:
        _check_gravity(run, site, vehicle)
        ratio = evidence.noise_ratio(run.channels, run.rate_hz, site, vehicle)
        found = evidence.unit_by_numbers(run.channels, ratio)
        if found is None and evidence.is_counted(run.channels):
            raise evidence.refuse_counts(run.source)
        if found is None and evidence.is_beyond(run.channels, ratio):
            raise evidence.refuse_unit(run.source, ratio)
        if run.accel_time_s[0] > LATEST_UNIX_S:
            raise InputError(f"{run.source}: time_s is after 2066; is it in seconds since 1904?")
        if any(evidence.sentinels(values).any() for values in run.channels.values()):
            raise InputError(
                f"{run.source}: 9999 or the like stands for missing values; leave such rows out"
            )
        if found is not None and found.unit != "m/s2":
            raise InputError(f"{run.source}: accelerations are in {found.unit}; {found.why}")


def _check_gravity(run: Run, site: Site, vehicle: Vehicle) -> None:
    """Raise InputError where the mean of a channel contradicts [sensor] on gravity and axes."""
    sensor = middle_sensor(site.sensor, vehicle)
    signs = dict(zip(CHANNELS, sensor.up, strict=True))
    declared = {
        name: evidence.Gravity(sensor.gravity_included, signs.get(name, 1)) for name in run.channels
    }
    found = evidence.gravity_of(run.channels, declared, run.source)
    for name in run.channels:
        if found[name] != declared[name]:
            mean = float(run.channels[name].mean())
            raise InputError(
                f"{run.source}: the mean of {name} is {mean:.2f} m/s², which contradicts [sensor]; "
                "gravity_included and up must describe the sensors"
            )


def _check_coordinates(run: Run, site: Site) -> None:
    """Raise InputError where positions are near a bridge in another order, unit or sign only."""
    latitude, longitude = run.gnss.latitude_deg, run.gnss.longitude_deg
    near = evidence.nearest_m(latitude, longitude, site.bridges)
    if near < evidence.NEAR_M:
        return
    read = evidence.coordinates(latitude, longitude, site, None)
    if read.distance_m >= evidence.NEAR_M:
        return
    if read.is_swapped:
        problem = "latitude_deg and longitude_deg of its positions are swapped"
    elif read.unit != "deg":
        problem = f"its positions are in {read.unit}, not in degrees"
    else:
        name = "longitude_deg" if read.signs[1] < 0.0 else "latitude_deg"
        problem = f"{name} of its positions has the wrong sign"
    raise InputError(
        f"{run.source}: {problem}; they are {near / 1000:.0f} km from the site's bridges as read, "
        f"{read.distance_m / 1000:.1f} km if corrected"
    )


def _check_speed(run: Run) -> None:
    gnss = run.gnss
    ratio = evidence.speed_ratio(
        gnss.latitude_deg, gnss.longitude_deg, gnss.time_s, gnss.speed_m_per_s
    )
    if ratio is None:
        return
    unit = evidence.speed_unit(ratio)
    if unit not in (None, "m/s"):
        raise InputError(
            f"{run.source}: speed_mps is {ratio:.2f} times the speed of the positions, which "
            f"is {unit}: divide it by {1.0 / SPEED[str(unit)]:g}"
        )
    if abs(ratio - 1.0) > _SPEED_TOLERANCE:
        raise InputError(f"{run.source}: speed_mps is {ratio:.2f} times the speed of the positions")


def notes_of(runs: Sequence[Run], site: Site, vehicle: Vehicle) -> list[Guess]:
    """Return notes on what is strange in a drive and may be right, and on its gaps."""
    return [
        Guess(Path(run.source).name, words, "lost")
        for run in runs
        for words in (*_strange(run, site), *gap_notes(run, site, vehicle))
    ]


def _strange(run: Run, site: Site) -> Iterator[str]:
    near_m = evidence.nearest_m(run.gnss.latitude_deg, run.gnss.longitude_deg, site.bridges)
    if near_m > evidence.NEAR_M:
        yield f"no bridge of the site file is near: the nearest fix is {near_m / 1000:.0f} km away"
    for name, values in run.channels.items():
        if values.size > 1 and float(np.ptp(values)) == 0.0:
            yield f"{name} never changes"
    for end in ("front", "rear"):
        body, axle = run.channels.get(f"sprung_{end}"), run.channels.get(f"unsprung_{end}")
        if body is not None and axle is not None and np.std(body) > 2.0 * np.std(axle) > 0.0:
            yield f"the {end} body shakes more than its axle: are the two columns swapped?"
    if np.nanmax(np.abs(run.gnss.altitude_m), initial=0.0) > _HIGHEST_M:
        yield f"altitudes reach {np.nanmax(run.gnss.altitude_m):g} m; are they in another unit?"
    note = clock_note(run.accel_time_s, run.gnss.time_s)
    if note is not None:
        yield note
