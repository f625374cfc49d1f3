"""What the engine remembers of a truck since it started, and of a bridge."""

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from schemas.proto import driveby_pb2 as pb
from schemas.results import BridgeResult, Crossing
from schemas.signals import GnssFix
from schemas.site import Vehicle
from schemas.vehicle_info import Difference, differences
from services.identification.bridge_state import Counted
from services.identification.bridges import AWAY_S, Bridges, Look
from services.identification.outputs import Output, Work
from services.identification.stays import MERGE_S
from services.identification.streams import PATIENCE_S, Boot


class Visit(NamedTuple):
    """A while in which a truck is near a bridge, on its own clock."""

    since_s: float
    last_s: float


class TruckBoot:
    """One boot of one truck: its messages, and what has been said of its crossings."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.boot = Boot()
        self.latest_s = -np.inf
        self.began_s = np.inf
        self.forgotten_s = -np.inf
        self.clock_s = -np.inf
        """The latest time that more than one message has told."""
        self.doubtful_s = -np.inf
        """One far ahead of it, which only one message has told yet."""
        self.detected: dict[tuple[str, float], str] = {}
        """Crossing ids by bridge and about the time of entry."""
        self.done: set[str] = set()
        self.decided: list[tuple[str, float, float, str]] = []
        """Bridge, times of the fixes around it, and id of each crossing that is decided."""
        self.said: dict[str, set[pb.CrossingState]] = {}
        """By crossing id: states that an earlier run of the worker has told."""
        self.place: tuple[float, float, float] | None = None
        """Time, latitude and longitude of the latest fix."""
        self.near: dict[int, Visit] = {}
        """By number of the bridge: those that it came to within what is remembered."""
        self.looks: dict[int, Look] = {}
        """By number of the bridge, in the visit that it is near it in: the latest look."""
        self.late: dict[int, float] = {}
        """By number of the bridge: when the last of the fixes near it came that came late."""
        self.is_gone = False
        """It has left for good, as far as is known."""
        self._said_toml: str | None = None
        self.differences: list[Difference] = []
        """Where it says of itself what the site file does not say of it."""

    def says(self, site_toml: str) -> None:
        """Take in what the truck says of itself; the first time that it differs counts."""
        if not self.differences:
            self._said_toml = site_toml
            self.differences = differences(site_toml, self.vehicle)

    def retarget(self, vehicle: Vehicle, before: Bridges, bridges: Bridges) -> None:
        """The truck and the bridges are those of another site file now."""
        self.vehicle = vehicle
        ids = {before.bridge(number).id: visit for number, visit in self.near.items()}
        self.near = {bridges.number[i]: v for i, v in ids.items() if i in bridges.number}
        self.late.clear()
        self.looks.clear()
        gone = {name: one for name, one in self.detected.items() if name[0] not in bridges.number}
        self.detected = {name: one for name, one in self.detected.items() if name not in gone}
        self.differences = []
        if self._said_toml is not None:
            self.says(self._said_toml)

    def busy_at(self) -> set[str]:
        """The bridges of which a crossing has begun and is not decided yet."""
        return {bridge for (bridge, _), name in self.detected.items() if name not in self.done}

    def came_to(self, bridges: Bridges, fix: GnssFix) -> list[int]:
        """Note a fix; return the numbers of the bridges at which it may change something."""
        now_s = fix.device_time_ns * 1e-9
        here = (now_s, fix.latitude_deg, fix.longitude_deg)
        before, self.place = self.place or here, here
        busy = {bridges.number[bridge] for bridge in self.busy_at()}
        found = bridges.between(*before[1:], *here[1:])
        for number in found:
            visit = self.near.get(number)
            if visit is None or (now_s - visit.last_s > AWAY_S and number not in busy):
                visit = Visit(before[0], now_s)  # it may have jumped over it since then
                self.looks.pop(number, None)
            self.near[number] = Visit(min(visit.since_s, now_s), max(visit.last_s, now_s))
        return sorted(busy.union(found)) if busy else found

    def came_late(self, bridges: Bridges, fix: GnssFix) -> None:
        """Note a fix that had been taken to be lost: what it changes is looked at later."""
        time_s = fix.device_time_ns * 1e-9
        here = (fix.latitude_deg, fix.longitude_deg)
        for number in bridges.between(*here, *here):
            visit = self.near.get(number, Visit(time_s, time_s))
            self.near[number] = Visit(min(visit.since_s, time_s), max(visit.last_s, time_s))
            self.late[number] = self.latest_s
        self.looks.clear()

    def late_enough(self) -> list[int]:
        """The bridges of which late fixes have come, if by now none of them is missing still."""
        found = [n for n, came_s in self.late.items() if self.latest_s > came_s + PATIENCE_S]
        for number in found:
            del self.late[number]
        return found

    def forget_before(self, time_s: float) -> None:
        """Forget samples, fixes and crossings that are decided: no stay is found there again."""
        self.forgotten_s = time_s
        self.boot.forget_before(time_s)
        self.looks.clear()
        busy = self.busy_at()
        self.near = {n: v for n, v in self.near.items() if v.last_s >= time_s or busy}
        self.decided = [one for one in self.decided if one[2] >= time_s]
        kept = {crossing_id for *_, crossing_id in self.decided}
        self.detected = {
            (bridge, entry_s): crossing_id
            for (bridge, entry_s), crossing_id in self.detected.items()
            if entry_s >= time_s - MERGE_S or crossing_id in kept or crossing_id not in self.done
        }
        kept.update(self.detected.values())
        self.done &= kept
        self.said = {name: states for name, states in self.said.items() if name in kept}


class UnderWay(NamedTuple):
    """A crossing that is being identified."""

    work: Work
    done: Output
    """What is told when it is: the truck's clock may have been forgotten by then."""


class Waiting(NamedTuple):
    """A crossing that is complete and waits for a certificate, or behind one that did."""

    work: Work
    identifying: Output | None
    """What is told when it goes on; None if an earlier run has told it."""
    done: Output


class Found(NamedTuple):
    """A crossing whose data are all there, found in a recording by an engine of its own."""

    told: tuple[Output, ...]
    """That it was detected and is complete, as far as earlier runs have not told it."""
    waiting: Waiting
    entry_ns: int
    """Since 1970 UTC."""
    exit_ns: int


@dataclass
class BridgeCrossings:
    """What has been found on one bridge, in one realm."""

    counted: Counted = field(default_factory=Counted)
    under_way: deque[UnderWay] = field(default_factory=deque)
    """In the order in which they were found: so their results are told."""
    state: BridgeResult | None = None
    """The latest that was made of those that are counted."""
    results: dict[int, Crossing] = field(default_factory=dict)
    """Those that have come before one that was found earlier, by number of the work."""
