"""The bridges of a site: those near a position, and the one that a truck is on.

Every fix of every truck is tested for bridges, so the cost must not grow with their number: they
are stored in cells of latitude and longitude. Where several bridges are next to or above each
other, the distances from their lines and decks determine which one a truck is on.
"""

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from math import cos, floor, hypot, radians
from typing import Final, NamedTuple

import numpy as np

from schemas.site import Bridge, Receiver, Vehicle
from services.common.geodesy import BridgeFrame, bridge_frame, chainage_of, to_chainage
from services.finding.stays import (
    CORRIDOR_M,
    STANDING_M_PER_S,
    AxleGeometry,
    Passage,
    Stay,
    least_depth_m,
    stays_on,
)
from services.finding.streams import Boot, Fixes

_log = logging.getLogger(__name__)
REACH_M: Final = 50.0
"""Distance in m from the ends of a bridge beyond which no fix affects its stays."""
AROUND_M: Final = 200.0
"""Radius in m within which even a fast truck has two fixes on its way to a bridge."""
_CELL_DEG: Final = 0.01
"""Size of a cell, about a kilometre: a bridge is in a few cells, a cell has few bridges."""
_CELLS_AROUND: Final = round(360.0 / _CELL_DEG)
_METRES_PER_DEGREE: Final = 110_500.0
"""Length of a degree of latitude, at least, in m."""
_LONGEST_JUMP_CELLS: Final = 30
"""Longest interpolated jump: after a longer outage the truck's path is unknown."""
AWAY_S: Final = 60.0
"""Time in s after which a truck that comes back near a bridge starts a new search."""
_HEIGHT_LIMIT_M: Final = 9.0
"""Limit of the height in m, three times a receiver's usual error."""


class Box(NamedTuple):
    """A rectangle on the map, from south-west to north-east."""

    south_deg: float
    west_deg: float
    north_deg: float
    east_deg: float
    """Eastern limit, up to 540: a box may cross the meridian of 180 degrees."""


class StaySearch(NamedTuple):
    """Result of a search for a truck's stays on a bridge."""

    stays: list[Stay]
    side: int
    """Side of the truck: -1 well before the bridge's start, 1 well behind its end, otherwise 0."""
    first_m: float
    """Chainage of the first fix on this side."""
    is_settled: bool
    """Whether further fixes on this side change nothing."""


class DetectedCrossing(NamedTuple):
    """A stay of a truck on a bridge of the site file; times in ns since 1970 UTC."""

    realm: str
    vehicle: str
    bridge: str
    forward: bool
    """Whether it goes from the bridge's start to its end."""
    entry_ns: int
    exit_ns: int
    passage: Passage
    recordings: tuple[str, ...] = ()
    """Recordings that cover its time, where several were searched."""


class Bridges:
    """All bridges of a site, by their number in it."""

    def __init__(self, bridges: Sequence[Bridge], receiver: Receiver) -> None:
        self._bridges = tuple(bridges)
        self._receiver = receiver
        self.number = {bridge.id: n for n, bridge in enumerate(self._bridges)}
        """Number of each bridge, by id."""
        self._frames: dict[int, BridgeFrame] = {}
        reach_m = REACH_M + 2.0 * least_depth_m(receiver)
        self._near = _Cells([_box_of(bridge, reach_m) for bridge in self._bridges])
        self._around = _Cells([_box_of(bridge, AROUND_M) for bridge in self._bridges])
        self._warned: set[int] = set()
        self._adjacent: dict[int, tuple[int, ...]] = {}

    def __len__(self) -> int:
        return len(self._bridges)

    def bridge(self, number: int) -> Bridge:
        """Return the bridge of a number."""
        return self._bridges[number]

    def frame(self, number: int) -> BridgeFrame:
        """Return the coordinates of a bridge, computed at the first request."""
        if number not in self._frames:
            self._frames[number] = bridge_frame(self._bridges[number])
        return self._frames[number]

    def between(
        self, latitude_deg: float, longitude_deg: float, to_latitude: float, to_longitude: float
    ) -> list[int]:
        """Return the bridges that a truck may have reached between two fixes, or is near at both.

        Their surroundings intersect the rectangle around both fixes, or contain either fix where
        these are too far apart for interpolation.
        """
        box = _box_round(latitude_deg, longitude_deg, to_latitude, to_longitude)
        if max(box.north_deg - box.south_deg, box.east_deg - box.west_deg) > (
            _LONGEST_JUMP_CELLS * _CELL_DEG
        ):
            here = _box_round(to_latitude, to_longitude, to_latitude, to_longitude)
            before = _box_round(latitude_deg, longitude_deg, latitude_deg, longitude_deg)
            return sorted({*self._near.meeting(here), *self._near.meeting(before)})
        return self._near.meeting(box)

    def meeting(self, box: Box, among: Iterable[int] | None = None) -> list[int]:
        """Return the bridges, or those of `among`, whose surroundings intersect a box."""
        numbers = range(len(self._near.boxes)) if among is None else among
        return [n for n in numbers if _meet(self._near.boxes[n], box)]

    def around(self, latitude_deg: float, longitude_deg: float) -> list[int]:
        """Return the bridges less than `AROUND_M` away, and some that are a little further."""
        return self._around.meeting(Box(latitude_deg, longitude_deg, latitude_deg, longitude_deg))

    def stays(self, number: int, car: AxleGeometry, fixes: Fixes) -> list[Stay]:
        """Return all stays of a truck on one bridge, without those on another one next to it."""
        stays = self._alone(number, car, fixes)
        if not stays or not (adjacent_bridges := self.adjacent_bridges(number)):
            return stays
        others = {n: self._alone(n, car, fixes) for n in adjacent_bridges}
        return [
            stay
            for stay in stays
            if all(
                self._distance_m(number, adjacent, stay, fixes)
                <= self._distance_m(adjacent, number, stay, fixes)
                for adjacent, theirs in others.items()
                if any(_overlap(stay, other) for other in theirs)
            )
        ]

    def search_stays(
        self, number: int, car: AxleGeometry, fixes: Fixes, before: StaySearch | None
    ) -> StaySearch:
        """Return all stays of a truck on one bridge, with the state for the next search.

        `before` is the latest search while the truck is near the bridge; None for the first one.
        """
        stays = self.stays(number, car, fixes)
        if not fixes.time_s.size:
            return StaySearch(stays, 0, 0.0, is_settled=False)
        along_m = self._along_m(
            number, float(fixes.latitude_deg[-1]), float(fixes.longitude_deg[-1])
        )
        side = self._side(number, car, along_m)
        stayed = before is not None and before.side == side
        first_m = before.first_m if before is not None and stayed else along_m
        # It has moved there further than noise does: by then its direction is known, and which way
        # it came.
        has_moved = abs(along_m - first_m) > least_depth_m(self._receiver)
        drives = bool(abs(fixes.speed_m_per_s[-1]) >= STANDING_M_PER_S)
        is_settled = side != 0 and has_moved and drives and not self.adjacent_bridges(number)
        return StaySearch(stays, side, first_m, is_settled)

    def is_as_it_was(
        self,
        search: StaySearch,
        number: int,
        car: AxleGeometry,
        latitude_deg: float,
        longitude_deg: float,
    ) -> bool:
        """Return whether a search would find the same stays after a new fix."""
        if not search.is_settled:
            return False
        return (
            self._side(number, car, self._along_m(number, latitude_deg, longitude_deg))
            == search.side
        )

    def _along_m(self, number: int, latitude_deg: float, longitude_deg: float) -> float:
        return chainage_of(self.frame(number), latitude_deg, longitude_deg)

    def _side(self, number: int, car: AxleGeometry, along_m: float) -> int:
        """Return the side of a bridge on which a truck is, -1 or 1; 0 if it is on or near it.

        Near means that it may have turned on the bridge without visible evidence yet.
        """
        reach_m = abs(car.gps_antenna_to_front_axle_m) + car.length_m
        reach_m += 2.0 * least_depth_m(self._receiver)
        return (along_m > self._bridges[number].span_m + reach_m) - (along_m < -reach_m)

    def all_stays(self, car: AxleGeometry, fixes: Fixes) -> list[tuple[int, Stay]]:
        """Return all stays in a drive in order of entry, with the numbers of the bridges."""
        found = [
            (number, stay)
            for number, visits in self._visits(fixes).items()
            for visit in visits
            for stay in self.stays(number, car, visit)
        ]
        return sorted(found, key=lambda one: (one[1].entry_s, one[0]))

    def adjacent_bridges(self, number: int) -> tuple[int, ...]:
        """Return the bridges so near another one that a truck may seem to be on both."""
        if number not in self._adjacent:
            near = set(self._near.meeting(self._near.boxes[number])) - {number}
            self._adjacent[number] = tuple(sorted(near))
        return self._adjacent[number]

    def _alone(self, number: int, car: AxleGeometry, fixes: Fixes) -> list[Stay]:
        bridge = self._bridges[number]
        stays = stays_on(bridge, self.frame(number), car, self._receiver, fixes)
        return [stay for stay in stays if not self._is_other_level(number, stay, fixes)]

    def _is_other_level(self, number: int, stay: Stay, fixes: Fixes) -> bool:
        height_m = self.height_above_deck_m(number, stay, fixes)
        if height_m is None or abs(height_m) <= _HEIGHT_LIMIT_M:
            return False
        if stay.passage is Passage.THROUGH and number not in self._warned:
            self._warned.add(number)  # sea level and the ellipsoid are tens of metres apart
            _log.warning(
                "%s: a truck drove along it, but %.0f m %s its start_altitude_m and "
                "end_altitude_m: the truck is taken to be on another road",
                *(self._bridges[number].id, abs(height_m), "above" if height_m > 0 else "below"),
            )
        return True

    def height_above_deck_m(self, number: int, stay: Stay, fixes: Fixes) -> float | None:
        """Return the truck's height above a bridge's deck in m; None without altitudes.

        It is the median of all fixes on the bridge, as a receiver's height may jump.
        """
        bridge = self._bridges[number]
        ends = [a for a in (bridge.start_altitude_m, bridge.end_altitude_m) if a is not None]
        on = _during(stay, fixes) & np.isfinite(fixes.altitude_m)
        if not ends or not on.any():
            return None
        chainage, _ = to_chainage(
            self.frame(number), fixes.latitude_deg[on], fixes.longitude_deg[on]
        )
        share = np.clip(chainage / bridge.span_m, 0.0, 1.0)
        deck_m = ends[0] + share * (ends[-1] - ends[0])
        return float(np.median(fixes.altitude_m[on] - deck_m))

    def _distance_m(self, number: int, adjacent: int, stay: Stay, fixes: Fixes) -> float:
        """Return a truck's distance from a bridge's line, and deck if both altitudes are known."""
        on = _during(stay, fixes)
        if not on.any():  # the receiver was out: only the fixes on either side remain
            on = (fixes.time_s >= stay.entry_s - AWAY_S) & (fixes.time_s <= stay.exit_s + AWAY_S)
        _, lateral = to_chainage(
            self.frame(number), fixes.latitude_deg[on], fixes.longitude_deg[on]
        )
        aside_m = float(np.median(np.abs(lateral))) if lateral.size else np.inf
        heights = [self.height_above_deck_m(n, stay, fixes) for n in (number, adjacent)]
        if heights[0] is None or heights[1] is None:
            return aside_m
        return hypot(aside_m, heights[0])

    def _visits(self, fixes: Fixes) -> dict[int, list[Fixes]]:
        """Return by bridge the parts of a drive near it, with a margin before and after."""
        near: dict[int, list[int]] = {}
        place = np.column_stack([fixes.latitude_deg, fixes.longitude_deg]).tolist()
        for n, here in enumerate(place):
            for number in self.between(*place[max(n - 1, 0)], *here):
                near.setdefault(number, []).append(n)
        visits: dict[int, list[Fixes]] = {}
        for number, at in near.items():
            times = fixes.time_s[at]
            edges = np.flatnonzero(np.diff(times) > 2.0 * AWAY_S) + 1
            for part in np.split(times, edges):
                begin, stop = np.searchsorted(
                    fixes.time_s, [part[0] - AWAY_S, part[-1] + AWAY_S], side="right"
                ).tolist()
                # A jump starts at the previous fix.
                cut = slice(max(begin - 1, 0), stop)
                visits.setdefault(number, []).append(Fixes(*(column[cut] for column in fixes)))
        return visits


class _Cells:
    """Boxes by the cells that they overlap."""

    def __init__(self, boxes: list[Box]) -> None:
        self.boxes = boxes
        self._cells: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
        for n, box in enumerate(boxes):
            for cell in _cells_of(box):
                self._cells[cell].append(n)

    def meeting(self, box: Box) -> list[int]:
        """Return the numbers of the boxes that meet another one."""
        south, west = floor(box.south_deg / _CELL_DEG), floor(box.west_deg / _CELL_DEG)
        if box.north_deg < (south + 1) * _CELL_DEG and box.east_deg < (west + 1) * _CELL_DEG:
            here = self._cells.get(
                (south, west % _CELLS_AROUND), ()
            )  # two fixes often share a cell
            return [n for n in here if _meet(self.boxes[n], box)]
        found = {n for cell in _cells_of(box) for n in self._cells.get(cell, ())}
        return sorted(n for n in found if _meet(self.boxes[n], box))


def _box_of(bridge: Bridge, reach_m: float) -> Box:
    """Return the box of a bridge and its surroundings."""
    box = _box_round(
        bridge.start_latitude_deg,
        bridge.start_longitude_deg,
        bridge.end_latitude_deg,
        bridge.end_longitude_deg,
    )
    reach_m = max(reach_m, CORRIDOR_M)
    north = reach_m / _METRES_PER_DEGREE
    farthest = max(abs(box.south_deg), abs(box.north_deg)) + north
    east = north / max(cos(radians(farthest)), 1e-3)
    return Box(
        box.south_deg - north, box.west_deg - east, box.north_deg + north, box.east_deg + east
    )


def _box_round(latitude: float, longitude: float, to_latitude: float, to_longitude: float) -> Box:
    """Return the smaller of the two rectangles between two positions."""
    low, high = min(longitude, to_longitude), max(longitude, to_longitude)
    if high - low > 180.0:
        low, high = high, low + 360.0
    return Box(min(latitude, to_latitude), low, max(latitude, to_latitude), high)


def _cells_of(box: Box) -> Iterator[tuple[int, int]]:
    for row in range(floor(box.south_deg / _CELL_DEG), floor(box.north_deg / _CELL_DEG) + 1):
        for column in range(floor(box.west_deg / _CELL_DEG), floor(box.east_deg / _CELL_DEG) + 1):
            yield row, column % _CELLS_AROUND


def _meet(one: Box, other: Box) -> bool:
    if one.south_deg > other.north_deg or other.south_deg > one.north_deg:
        return False
    if one.west_deg <= other.east_deg and other.west_deg <= one.east_deg:
        return True
    return any(
        one.west_deg <= other.east_deg + turn and other.west_deg + turn <= one.east_deg
        for turn in (-360.0, 360.0)
    )


def _during(stay: Stay, fixes: Fixes) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return np.asarray((fixes.time_s >= stay.entry_s) & (fixes.time_s <= stay.exit_s))


def _overlap(one: Stay, other: Stay) -> bool:
    return one.entry_s <= other.exit_s and other.entry_s <= one.exit_s


def detect_crossings(
    bridges: Bridges, realm: str, truck: Vehicle, boot: Boot
) -> list[DetectedCrossing]:
    """Return all stays of a truck on bridges in one boot."""
    return [
        DetectedCrossing(
            realm,
            truck.id,
            bridges.bridge(number).id,
            stay.direction > 0,
            boot.wall_time_ns(stay.entry_s),
            boot.wall_time_ns(stay.exit_s),
            stay.passage,
        )
        for number, stay in bridges.all_stays(truck, boot.fixes())
    ]
