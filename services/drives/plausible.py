"""Cross-checks of a CSV drive: units and columns that contradict the numbers."""

from typing import Final

import numpy as np

from schemas.signals import CHANNELS
from schemas.site import Site, Vehicle
from services.common.errors import InputError
from services.common.geodesy import on_plane_m
from services.drives.runs import Run
from services.drives.tables import judged
from services.finding.placed import middle_sensor

_DRIVING_M: Final = 20.0
"""Distance in m below which the speed column is not judged: fixes scatter by metres."""
_SPEED_UNITS: Final = {"km/h": 3.6, "knots": 1.943844, "mph": 2.236936}
_UNIT_TOLERANCE: Final = 0.04


def check_plausible(run: Run, site: Site, vehicle: Vehicle | None = None) -> None:
    """Raise InputError if speed, coordinates or accelerations are in another unit or order.

    Gravity, and noise against its declared density, are compared where `vehicle` is given.
    """
    _check_exchanged(run, site)
    _check_speed(run)
    means = [abs(float(values.mean())) for values in run.channels.values()]
    if len(means) > 1 and all(abs(mean - 1.0) < 0.03 for mean in means):
        raise InputError(
            f"{run.source}: the mean of every channel is near 1, which is gravity in g: "
            "multiply by 9.80665, and set gravity_included in [sensor]"
        )
    if vehicle is not None:
        _check_gravity(run, site, vehicle)
        ratio = judged.noise_ratio(run.channels, run.rate_hz, site, vehicle)
        found = judged.unit_by_numbers(run.channels, ratio)
        if found is not None and found.unit != "m/s2":
            raise InputError(f"{run.source}: accelerations are in {found.unit}: {found.why}")


def _check_gravity(run: Run, site: Site, vehicle: Vehicle) -> None:
    """Raise InputError where the mean of a channel contradicts [sensor] on gravity and axes."""
    sensor = middle_sensor(site.sensor, vehicle)
    signs = dict(zip(CHANNELS, sensor.up, strict=True))
    declared = {
        name: judged.Gravity(sensor.gravity_included, signs.get(name, 1)) for name in run.channels
    }
    found = judged.gravity_of(run.channels, declared, run.source)
    for name in run.channels:
        if found[name] != declared[name]:
            mean = float(run.channels[name].mean())
            raise InputError(
                f"{run.source}: the mean of {name} is {mean:.2f} m/s², which contradicts [sensor]: "
                "gravity_included and up must be as the sensors are"
            )


def _check_exchanged(run: Run, site: Site) -> None:
    latitude, longitude = run.gnss.latitude_deg, run.gnss.longitude_deg
    near = judged.nearest_m(latitude, longitude, site.bridges)
    if near < judged.NEAR_M:
        return
    swapped = judged.nearest_m(longitude, latitude, site.bridges)
    if swapped < judged.NEAR_M:
        raise InputError(
            f"{run.source}: latitude_deg and longitude_deg of its positions are exchanged: "
            f"{near / 1000:.0f} km from the site's bridges, {swapped / 1000:.1f} km the other way"
        )


def _check_speed(run: Run) -> None:
    gnss = run.gnss
    north, west = on_plane_m(gnss.latitude_deg, gnss.longitude_deg)
    straight = float(np.hypot(north[-1], west[-1]))
    steps = 0.5 * (gnss.speed_m_per_s[1:] + gnss.speed_m_per_s[:-1]) * np.diff(gnss.time_s)
    path = float(np.hypot(np.diff(north), np.diff(west)).sum())
    if straight < max(_DRIVING_M, 0.9 * path):
        return
    ratio = float(np.abs(steps).sum()) / straight
    for unit, factor in _SPEED_UNITS.items():
        if abs(ratio / factor - 1.0) < _UNIT_TOLERANCE:
            raise InputError(
                f"{run.source}: speed_mps is {ratio:.2f} times the speed of the positions, which "
                f"is {unit}: divide it by {factor:g}"
            )
