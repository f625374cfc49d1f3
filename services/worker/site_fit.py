"""Whether the trucks come near the bridges of the site file: another site's file fits none."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from schemas.signals import decode_gnss
from schemas.site import Bridge
from schemas.topics import Key
from services.common.arrays import Floats

_NEAR_M: Final = 1000.0
"""Distance at which a bridge is one that the trucks use."""
_EVERY_S: Final = 5.0
"""Interval of checks of a truck's position, because a site may have many bridges."""
_MAX_TRUCKS: Final = 1000
_EARTH_RADIUS_M: Final = 6_371_000.0


class _Nearest(NamedTuple):
    distance_m: float
    vehicle: str
    bridge: str


class SiteFit:
    """The smallest distance of a truck to a bridge since the site file applies."""

    def __init__(self, bridges: Sequence[Bridge] = ()) -> None:
        self.retarget(bridges)

    def retarget(self, bridges: Sequence[Bridge]) -> None:
        """Start again with the bridges of another site file."""
        self._names = [bridge.id for bridge in bridges]
        self._places = np.radians(
            [(bridge.start_latitude_deg, bridge.start_longitude_deg) for bridge in bridges]
        ).reshape(-1, 2)
        self._nearest: _Nearest | None = None
        self._next_s: dict[tuple[str, str], float] = {}

    def note(self, key: Key, payload: bytes, now_s: float) -> None:
        """Note a position of a truck; `now_s` is a monotonic clock. Ignore other messages."""
        truck = (key.realm, key.identifier)
        if key.stream != "gnss" or not self._names or now_s < self._next_s.get(truck, -math.inf):
            return
        if self._nearest is not None and self._nearest.distance_m < _NEAR_M:
            return
        if truck not in self._next_s and len(self._next_s) >= _MAX_TRUCKS:
            return
        self._next_s[truck] = now_s + _EVERY_S
        fix = decode_gnss(payload)
        distances_m = _distances_m(self._places, fix.latitude_deg, fix.longitude_deg)
        nearest = int(np.argmin(distances_m))
        found = _Nearest(float(distances_m[nearest]), key.identifier, self._names[nearest])
        self._nearest = found if self._nearest is None else min(self._nearest, found)

    def complaint(self) -> str:
        """Return that no truck has come near a bridge, if that is so; empty before any position."""
        if self._nearest is None or self._nearest.distance_m < _NEAR_M:
            return ""
        distance_m, vehicle, bridge = self._nearest
        return (
            "no truck has come near a bridge of the site file: the smallest distance is "
            f"{distance_m / 1e3:.1f} km, of {vehicle} to {bridge}"
        )


def _distances_m(places: Floats, latitude_deg: float, longitude_deg: float) -> Floats:
    """Return the distances (n,) in m on a sphere from places (n, 2), latitude and longitude."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    half = np.sin((places - (latitude, longitude)) / 2) ** 2
    chord = half[:, 0] + np.cos(places[:, 0]) * math.cos(latitude) * half[:, 1]
    return np.asarray(2 * _EARTH_RADIUS_M * np.arcsin(np.sqrt(np.minimum(chord, 1.0))))
