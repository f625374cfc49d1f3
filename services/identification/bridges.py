"""The bridges of a site: which are near a place, and which of them a truck is on.

Where a bridge is, is asked of every fix of every truck, so the answer does not grow with the number
of bridges: they lie in cells of latitude and longitude. Which of them a truck is on, where several
lie beside or above each other, is told by its distance from their lines and decks.
"""

import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from math import cos, floor, hypot, radians
from typing import Final, NamedTuple

import numpy as np

from schemas.site import Bridge, Receiver, Vehicle
from services.common.geodesy import BridgeFrame, bridge_frame, chainage_of, to_chainage
from services.identification.stays import (
    CORRIDOR_M,
    STANDING_M_PER_S,
    Car,
    Passage,
    Stay,
    least_depth_m,
    stays_on,
)
from services.identification.streams import Boot, Fixes

_log = logging.getLogger(__name__)
REACH_M: Final = 50.0
"""Further away than this from the ends of a bridge no fix changes what happened on it."""
AROUND_M: Final = 200.0
"""A fast truck has two fixes in it on its way to a bridge."""
_CELL_DEG: Final = 0.01
"""About a kilometre: a bridge lies in a few cells, and few bridges in a cell."""
_CELLS_AROUND: Final = round(360.0 / _CELL_DEG)
_METRES_PER_DEGREE: Final = 110_500.0
"""Of latitude, nowhere less."""
_LONGEST_JUMP_CELLS: Final = 30
"""Of a receiver that was out for longer nobody knows which way its truck has gone."""
AWAY_S: Final = 60.0
"""Who was away from a bridge for so long and is near it again has come anew."""
_HEIGHT_LIMIT_M: Final = 9.0
"""Three times a receiver's error of height, where it does not tell its own."""


class Box(NamedTuple):
    """A place on the map, from south-west to north-east."""

    south_deg: float
    west_deg: float
    north_deg: float
    east_deg: float
    """Up to 540: a box may lie across the meridian of 180 degrees."""


class Look(NamedTuple):
    """What was found when it was looked where a truck was on a bridge."""

    stays: list[Stay]
    side: int
    """-1: the truck is well before the bridge's start, 1: well behind its end; 0 else."""
    first_m: float
    """Chainage of the first fix on this side."""
    is_settled: bool
    """Fixes of a truck that stays on this side change nothing."""


class Passing(NamedTuple):
    """A stay of a truck on a bridge of the site file; times in ns since 1970 UTC."""

    realm: str
    vehicle: str
    bridge: str
    forward: bool
    """From the bridge's start to its end."""
    entry_ns: int
    exit_ns: int
    passage: Passage
    recordings: tuple[str, ...] = ()
    """That hold its time, where several were looked through."""


class Bridges:
    """All bridges of a site, by their number in it."""

    def __init__(self, bridges: Sequence[Bridge], receiver: Receiver) -> None:
        self._bridges = tuple(bridges)
        self._receiver = receiver
        self.number = {bridge.id: n for n, bridge in enumerate(self._bridges)}
        """By id."""
        self._frames: dict[int, BridgeFrame] = {}
        reach_m = REACH_M + 2.0 * least_depth_m(receiver)
        self._near = _Cells([_box_of(bridge, reach_m) for bridge in self._bridges])
        self._around = _Cells([_box_of(bridge, AROUND_M) for bridge in self._bridges])
        self._told: set[int] = set()
        self._rivals: dict[int, tuple[int, ...]] = {}

    def __len__(self) -> int:
        return len(self._bridges)

    def bridge(self, number: int) -> Bridge:
        """The bridge of a number."""
        return self._bridges[number]

    def frame(self, number: int) -> BridgeFrame:
        """Its coordinates; made when they are asked for first."""
        if number not in self._frames:
            self._frames[number] = bridge_frame(self._bridges[number])
        return self._frames[number]

    def between(
        self, latitude_deg: float, longitude_deg: float, to_latitude: float, to_longitude: float
    ) -> list[int]:
        """The bridges that a truck may have come to between two fixes, or is near at both.

        That is those whose surroundings meet the rectangle round both; where the fixes lie further
        apart than anybody can guess across, those at either end.
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
        """The bridges, or `among` some, whose surroundings meet a place, however large that is."""
        numbers = range(len(self._near.boxes)) if among is None else among
        return [n for n in numbers if _meet(self._near.boxes[n], box)]

    def around(self, latitude_deg: float, longitude_deg: float) -> list[int]:
        """The bridges that are less than `AROUND_M` away, and some that are a little further."""
        return self._around.meeting(Box(latitude_deg, longitude_deg, latitude_deg, longitude_deg))

    def stays(self, number: int, car: Car, fixes: Fixes) -> list[Stay]:
        """All stays of a truck on one bridge, but for those that are on another one beside it."""
        stays = self._alone(number, car, fixes)
        if not stays or not (rivals := self.rivals(number)):
            return stays
        others = {n: self._alone(n, car, fixes) for n in rivals}
        return [
            stay
            for stay in stays
            if all(
                self._distance_m(number, rival, stay, fixes)
                <= self._distance_m(rival, number, stay, fixes)
                for rival, theirs in others.items()
                if any(_overlap(stay, other) for other in theirs)
            )
        ]

    def look(self, number: int, car: Car, fixes: Fixes, before: Look | None) -> Look:
        """All stays of a truck on one bridge, with what the next look may go on from.

        `before` is the latest look, while it is near the bridge; None if this is the first one.
        """
        stays = self.stays(number, car, fixes)
        if not fixes.time_s.size:
            return Look(stays, 0, 0.0, is_settled=False)
        along_m = self._along_m(
            number, float(fixes.latitude_deg[-1]), float(fixes.longitude_deg[-1])
        )
        side = self._side(number, car, along_m)
        stayed = before is not None and before.side == side
        first_m = before.first_m if before is not None and stayed else along_m
        # It has moved there further than noise does: by then it is known which way it drives, and
        # which way it came.
        has_moved = abs(along_m - first_m) > least_depth_m(self._receiver)
        drives = bool(abs(fixes.speed_m_per_s[-1]) >= STANDING_M_PER_S)
        is_settled = side != 0 and has_moved and drives and not self.rivals(number)
        return Look(stays, side, first_m, is_settled)

    def is_as_it_was(
        self, look: Look, number: int, car: Car, latitude_deg: float, longitude_deg: float
    ) -> bool:
        """Whether a look would find the same stays after a new fix."""
        if not look.is_settled:
            return False
        return (
            self._side(number, car, self._along_m(number, latitude_deg, longitude_deg)) == look.side
        )

    def _along_m(self, number: int, latitude_deg: float, longitude_deg: float) -> float:
        return chainage_of(self.frame(number), latitude_deg, longitude_deg)

    def _side(self, number: int, car: Car, along_m: float) -> int:
        """On which side of a bridge a truck is, -1 or 1; 0 if it is on it or near it.

        So near that it may have turned on it and not be known to have turned yet.
        """
        reach_m = abs(car.gps_antenna_to_front_axle_m) + car.wheelbase_m
        reach_m += 2.0 * least_depth_m(self._receiver)
        return (along_m > self._bridges[number].span_m + reach_m) - (along_m < -reach_m)

    def all_stays(self, car: Car, fixes: Fixes) -> list[tuple[int, Stay]]:
        """All stays in a whole drive in order of their entries, with the numbers of the bridges."""
        found = [
            (number, stay)
            for number, visits in self._visits(fixes).items()
            for visit in visits
            for stay in self.stays(number, car, visit)
        ]
        return sorted(found, key=lambda one: (one[1].entry_s, one[0]))

    def rivals(self, number: int) -> tuple[int, ...]:
        """The bridges so near another one that a truck may be taken to be on both."""
        if number not in self._rivals:
            near = set(self._near.meeting(self._near.boxes[number])) - {number}
            self._rivals[number] = tuple(sorted(near))
        return self._rivals[number]

    def _alone(self, number: int, car: Car, fixes: Fixes) -> list[Stay]:
        bridge = self._bridges[number]
        stays = stays_on(bridge, self.frame(number), car, self._receiver, fixes)
        return [stay for stay in stays if not self._is_other_level(number, stay, fixes)]

    def _is_other_level(self, number: int, stay: Stay, fixes: Fixes) -> bool:
        height_m = self.height_above_deck_m(number, stay, fixes)
        if height_m is None or abs(height_m) <= _HEIGHT_LIMIT_M:
            return False
        if stay.passage is Passage.THROUGH and number not in self._told:
            self._told.add(number)  # sea level and the ellipsoid are tens of metres apart
            _log.warning(
                "%s: a truck drove along it, but %.0f m %s its start_altitude_m and "
                "end_altitude_m: taken for another road",
                *(self._bridges[number].id, abs(height_m), "above" if height_m > 0 else "below"),
            )
        return True

    def height_above_deck_m(self, number: int, stay: Stay, fixes: Fixes) -> float | None:
        """How far the truck was above a bridge's deck; None where the site gives no altitude.

        The middle one of all fixes on the bridge: a receiver's height may jump.
        """
        bridge = self._bridges[number]
        ends = [a for a in (bridge.start_altitude_m, bridge.end_altitude_m) if a is not None]
        on = _during(stay, fixes)
        if not ends or not on.any():
            return None
        chainage, _ = to_chainage(
            self.frame(number), fixes.latitude_deg[on], fixes.longitude_deg[on]
        )
        share = np.clip(chainage / bridge.span_m, 0.0, 1.0)
        deck_m = ends[0] + share * (ends[-1] - ends[0])
        return float(np.median(fixes.altitude_m[on] - deck_m))

    def _distance_m(self, number: int, rival: int, stay: Stay, fixes: Fixes) -> float:
        """How far a truck is from a bridge's line; and from its deck, if the rival's is known."""
        on = _during(stay, fixes)
        if not on.any():  # the receiver was out: all there is are the fixes on either side
            on = (fixes.time_s >= stay.entry_s - AWAY_S) & (fixes.time_s <= stay.exit_s + AWAY_S)
        _, lateral = to_chainage(
            self.frame(number), fixes.latitude_deg[on], fixes.longitude_deg[on]
        )
        aside_m = float(np.median(np.abs(lateral))) if lateral.size else np.inf
        heights = [self.height_above_deck_m(n, stay, fixes) for n in (number, rival)]
        if heights[0] is None or heights[1] is None:
            return aside_m
        return hypot(aside_m, heights[0])

    def _visits(self, fixes: Fixes) -> dict[int, list[Fixes]]:
        """By bridge: the parts of a drive in which it is near, with a while before and behind."""
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
                # A jump begins at the fix before.
                cut = slice(max(begin - 1, 0), stop)
                visits.setdefault(number, []).append(Fixes(*(column[cut] for column in fixes)))
        return visits


class _Cells:
    """Boxes by the cells that they lie in."""

    def __init__(self, boxes: list[Box]) -> None:
        self.boxes = boxes
        self._cells: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
        for n, box in enumerate(boxes):
            for cell in _cells_of(box):
                self._cells[cell].append(n)

    def meeting(self, box: Box) -> list[int]:
        """The numbers of the boxes that have a place in common with another one."""
        south, west = floor(box.south_deg / _CELL_DEG), floor(box.west_deg / _CELL_DEG)
        if box.north_deg < (south + 1) * _CELL_DEG and box.east_deg < (west + 1) * _CELL_DEG:
            here = self._cells.get((south, west % _CELLS_AROUND), ())  # two fixes lie in one, often
            return [n for n in here if _meet(self.boxes[n], box)]
        found = {n for cell in _cells_of(box) for n in self._cells.get(cell, ())}
        return sorted(n for n in found if _meet(self.boxes[n], box))


def _box_of(bridge: Bridge, reach_m: float) -> Box:
    """A bridge and what is around it."""
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
    """The smaller of the two rectangles between two places."""
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


def passings_of(bridges: Bridges, realm: str, truck: Vehicle, boot: Boot) -> list[Passing]:
    """All stays of a truck on bridges in one boot."""
    return [
        Passing(
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
