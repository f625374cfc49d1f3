"""Positions of all trucks near bridges: crossings with two trucks at once cannot be identified.

Every truck of a realm counts, also one that the site file lacks. Trucks share only the wall clock,
so times here are ns since 1970 UTC.
"""

from collections import OrderedDict
from typing import Final, NamedTuple

import numpy as np

from schemas.signals import GnssFix
from schemas.site import Vehicle
from services.common.arrays import Floats
from services.finding.bridges import Bridges
from services.finding.stays import LONGEST_UNSEEN_S, AxleGeometry, Stay
from services.finding.streams import Fixes

_MAX_TRUCKS: Final = 1000
"""Maximum number of remembered pairs of truck and bridge; the longest silent one is dropped."""
_MAX_FIXES: Final = 2000
"""Maximum number of fixes of a truck at a bridge, 200 s at 10 Hz; the oldest are dropped."""


class UnlistedVehicle(NamedTuple):
    """Assumed geometry of a truck that the site file lacks."""

    length_m: float = 4.0
    gps_antenna_to_front_axle_m: float = 0.0


_Near = OrderedDict[int, tuple[float, float, float, float]]
"""Latitude and longitude, speed in m/s, altitude in m, by wall time of a fix."""


class Traffic:
    """Positions of all trucks of all realms near the bridges of a site."""

    def __init__(self, bridges: Bridges, vehicles: dict[str, Vehicle]) -> None:
        self._bridges = bridges
        self._vehicles = vehicles
        self._near: OrderedDict[tuple[str, str, str], _Near] = OrderedDict()
        """Positions by realm, bridge and vehicle, the most recently received one last."""

    def retarget(self, bridges: Bridges, vehicles: dict[str, Vehicle]) -> None:
        """Continue with the bridges and trucks of another site file; positions stay."""
        self._bridges, self._vehicles = bridges, vehicles
        for name in [name for name in self._near if name[1] not in bridges.number]:
            del self._near[name]

    def note(self, realm: str, vehicle: str, fix: GnssFix, *, for_ever: bool = False) -> None:
        """Store a fix if it is near a bridge; `for_ever` without expiry."""
        here = fix.latitude_deg, fix.longitude_deg
        for number in self._bridges.around(*here):
            place = (realm, self._bridges.bridge(number).id, vehicle)
            near = self._near.setdefault(place, OrderedDict())
            self._near.move_to_end(place)
            near[fix.wall_time_ns] = (*here, fix.speed_m_per_s, fix.altitude_m)
            if not for_ever:
                while len(near) > _MAX_FIXES:
                    near.popitem(last=False)
                while len(self._near) > _MAX_TRUCKS:
                    self._near.popitem(last=False)

    def others(
        self, realm: str, bridge: str, vehicle: str, entry_ns: int, exit_ns: int
    ) -> list[str]:
        """Return the other trucks known to be on the bridge between two wall times."""
        return [
            other
            for (in_realm, at, other), near in self._near.items()
            if (in_realm, at) == (realm, bridge)
            and other != vehicle
            and self._was_there(bridge, other, near, entry_ns, exit_ns)
        ]

    def _was_there(self, bridge: str, other: str, near: _Near, entry_ns: int, exit_ns: int) -> bool:
        times_ns = sorted(near)
        time_s = np.array([(t - entry_ns) * 1e-9 for t in times_ns])
        length_s = (exit_ns - entry_ns) * 1e-9
        columns = np.vstack([time_s, np.array([near[t] for t in times_ns]).T])
        # A longer silence separates two visits.
        away = np.flatnonzero(np.diff(time_s) > LONGEST_UNSEEN_S) + 1
        return any(
            stay.entry_s < length_s and stay.exit_s > 0.0
            for visit in np.split(columns, away, axis=1)
            for stay in self._stays(bridge, other, visit)
        )

    def _stays(self, bridge: str, vehicle: str, visit: Floats) -> list[Stay]:
        """Return the stays in one visit (5, n): time, latitude and longitude, speed, altitude."""
        car: AxleGeometry = self._vehicles.get(vehicle) or UnlistedVehicle()
        fixes = Fixes(*np.ascontiguousarray(visit))
        return self._bridges.stays(self._bridges.number[bridge], car, fixes)
