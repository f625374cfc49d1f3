"""Which trucks were near a bridge, and when: two at once are more than any model here knows.

Every truck of a realm counts, also one that the site file does not know. Trucks share no clock but
the wall's, so times here are ns since 1970 UTC.
"""

from collections import OrderedDict
from typing import Final

import numpy as np

from schemas.signals import GnssFix
from schemas.site import Bridge, Vehicle
from services.common.geodesy import BridgeFrame, to_chainage
from services.identification.stays import CORRIDOR_M, Floats, Stay, find_stays

_REACH_M: Final = 200.0
"""Fixes further away than this from a bridge are not kept: a fast truck has two on its way in."""
_METRES_PER_DEGREE: Final = 111_000.0
"""About so many of latitude anywhere: for a first look, which a reach twice too long makes safe."""
_STRANGER_WHEELBASE_M: Final = 4.0
"""What the wheelbase of a truck is taken to be that the site file does not know."""
_LONGEST_OUTAGE_S: Final = 30.0
"""Fixes further apart are two visits: the truck may have gone round in between."""
_MOST_TRUCKS: Final = 1000
"""Trucks remembered, one at two bridges being two: who was silent for longest makes room."""
_MOST_FIXES: Final = 2000
"""Fixes kept of a truck at a bridge, 200 s at 10 Hz. Who stands there longer is forgotten as it
was, not as it is."""

_Near = OrderedDict[int, tuple[float, float, float]]
"""By wall time of a fix: chainage and lateral offset of the antenna in m, speed in m/s."""


class Traffic:
    """The positions of all trucks of all realms near the bridges of a site."""

    def __init__(
        self,
        frames: list[tuple[Bridge, BridgeFrame]],
        vehicles: dict[str, Vehicle],
        margin_m: float,
    ) -> None:
        self._frames = frames
        self._vehicles = vehicles
        self._margin_m = margin_m
        bridges = [bridge for bridge, _ in frames]
        self._latitude_deg = np.array([b.start_latitude_deg for b in bridges])
        self._longitude_deg = np.array([b.start_longitude_deg for b in bridges])
        reach_m = np.array([b.span_m for b in bridges]) + 2.0 * _REACH_M
        self._reach_deg = reach_m / _METRES_PER_DEGREE
        self._near: OrderedDict[tuple[str, str, str], _Near] = OrderedDict()
        """By realm, bridge and vehicle; who was heard last stands last."""

    def note(self, realm: str, vehicle: str, fix: GnssFix, *, for_ever: bool = False) -> None:
        """Keep a fix if it is near a bridge; `for_ever`: whatever else comes."""
        for index in self._bridges_near(fix):
            bridge, frame = self._frames[index]
            chainage, lateral = to_chainage(frame, fix.latitude_deg, fix.longitude_deg)
            far_m = max(-chainage, chainage - bridge.span_m, abs(lateral) - CORRIDOR_M)
            if far_m > _REACH_M:
                continue
            place = (realm, bridge.id, vehicle)
            near = self._near.setdefault(place, OrderedDict())
            self._near.move_to_end(place)
            near[fix.wall_time_ns] = (float(chainage), float(lateral), fix.speed_m_per_s)
            if not for_ever:
                while len(near) > _MOST_FIXES:
                    near.popitem(last=False)
                while len(self._near) > _MOST_TRUCKS:
                    self._near.popitem(last=False)

    def others(
        self, realm: str, bridge: Bridge, vehicle: str, entry_ns: int, exit_ns: int
    ) -> list[str]:
        """The other trucks that were on the bridge between two wall times, as far as is known."""
        return [
            other
            for (in_realm, at, other), near in self._near.items()
            if (in_realm, at) == (realm, bridge.id)
            and other != vehicle
            and self._was_there(bridge, other, near, entry_ns, exit_ns)
        ]

    def _bridges_near(self, fix: GnssFix) -> list[int]:
        north = np.abs(self._latitude_deg - fix.latitude_deg)
        turn = np.abs(self._longitude_deg - fix.longitude_deg)
        east = np.minimum(turn, 360.0 - turn) * np.cos(np.radians(self._latitude_deg))
        close: list[int] = np.flatnonzero(np.maximum(north, east) < self._reach_deg).tolist()
        return close

    def _was_there(
        self, bridge: Bridge, other: str, near: _Near, entry_ns: int, exit_ns: int
    ) -> bool:
        times_ns = sorted(near)
        time_s = np.array([(t - entry_ns) * 1e-9 for t in times_ns])
        length_s = (exit_ns - entry_ns) * 1e-9
        columns = np.vstack([time_s, np.array([near[t] for t in times_ns]).T])
        # Who was away in between may have gone round: that is no way over the bridge.
        away = np.flatnonzero(np.diff(time_s) > _LONGEST_OUTAGE_S) + 1
        return any(
            stay.entry_s < length_s and stay.exit_s > 0.0
            for visit in np.split(columns, away, axis=1)
            for stay in self._stays(bridge, other, visit)
        )

    def _stays(self, bridge: Bridge, vehicle: str, visit: Floats) -> list[Stay]:
        """Stays in one visit (4, n): time, chainage and lateral offset of the antenna, speed."""
        known = self._vehicles.get(vehicle)
        return find_stays(
            *np.ascontiguousarray(visit),
            span_m=bridge.span_m,
            wheelbase_m=_STRANGER_WHEELBASE_M if known is None else known.wheelbase_m,
            antenna_to_front_axle_m=0.0 if known is None else known.gps_antenna_to_front_axle_m,
            margin_m=self._margin_m,
        )
