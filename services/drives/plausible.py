"""Cross-checks of a CSV drive: units and columns that the numbers themselves contradict."""

from typing import Final

import numpy as np

from schemas.site import Site
from services.common.errors import InputError
from services.common.geodesy import bridge_frame, on_plane_m, to_chainage
from services.drives.runs import Run

_DRIVING_M: Final = 20.0
"""Distance by positions below which the speed column is not judged: fixes scatter by metres."""
_SPEED_UNITS: Final = {"km/h": 3.6, "knots": 1.943844, "mph": 2.236936}
_UNIT_TOLERANCE: Final = 0.04
_FAR_M: Final = 100_000.0


def check_plausible(run: Run, site: Site) -> None:
    """Raise InputError if speed, coordinates or accelerations are in another unit or order."""
    _check_exchanged(run, site)
    _check_speed(run)
    means = [abs(float(values.mean())) for values in run.channels.values()]
    if len(means) > 1 and all(abs(mean - 1.0) < 0.03 for mean in means):
        raise InputError(
            f"{run.source}: the mean of every channel is near 1, which is gravity in g: "
            "multiply by 9.80665, and set gravity_included in [sensor]"
        )


def _check_exchanged(run: Run, site: Site) -> None:
    latitude, longitude = run.gnss.latitude_deg, run.gnss.longitude_deg
    frames = [bridge_frame(bridge) for bridge in site.bridges[:100]]
    near = min(float(np.hypot(*to_chainage(f, latitude, longitude)).min()) for f in frames)
    if near < _FAR_M or np.abs(longitude).max() > 90:
        return
    swapped = min(float(np.hypot(*to_chainage(f, longitude, latitude)).min()) for f in frames)
    if swapped < _FAR_M:
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
