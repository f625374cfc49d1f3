"""Memory of a finder about one boot of a truck."""

import logging
from typing import NamedTuple

import numpy as np

from schemas.signals import MAX_BATCH_S, GnssFix
from schemas.site import Vehicle
from schemas.vehicle_info import InfoDifference, differences
from services.finding.bridges import AWAY_S, Bridges, StaySearch
from services.finding.crossing_data import Window
from services.finding.stays import MERGE_S, Stay, overlap
from services.finding.streams import PATIENCE_S, Boot

_log = logging.getLogger(__name__)
_KEEP_S = 300.0
"""Age in s from which samples are dropped."""
_PAUSE_S = 60.0
"""Change of the wall clock's offset up to which a jump of the device clock is a pause of both."""
_SILENCE_S = 120.0
"""Time in s for which positions may lack accelerations, as when both are fetched later."""
FORGET_EVERY_S = 10.0
"""Interval in s of dropping old data, which takes time."""
_ROUNDING_S = 1e-6
"""Time in s above the rounding of a conversion from nanoseconds."""


class Visit(NamedTuple):
    """A period in which a truck is near a bridge, on its own clock."""

    since_s: float
    last_s: float


class TruckBoot:
    """Messages of one boot of one truck, and its decided crossings."""

    def __init__(self, realm: str, vehicle: Vehicle) -> None:
        self.realm = realm
        self.vehicle = vehicle
        self.boot = Boot()
        self.latest_s = -np.inf
        self.began_s = np.inf
        self.forgotten_s = -np.inf
        self.clock_s = -np.inf
        """Latest time that more than one message has confirmed."""
        self.wall_offset_s = 0.0
        """Wall clock minus device clock at that time, s."""
        self.doubtful_s = -np.inf
        """Time far ahead of it, which only one message has stated yet."""
        self.detected: dict[tuple[str, float], str] = {}
        """Crossing ids by bridge and approximate time of entry."""
        self.done: set[str] = set()
        self.decided: list[tuple[str, float, float, str]] = []
        """Bridge, times of the fixes around it, and id of each decided crossing."""
        self.left: set[str] = set()
        """Detected crossings that are left to the recordings."""
        self.place: tuple[float, float, float] | None = None
        """Time, latitude and longitude of the latest fix."""
        self.near: dict[int, Visit] = {}
        """Visits by number of the bridge, as far as they are remembered."""
        self.searches: dict[int, StaySearch] = {}
        """Latest search of the present visit, by number of the bridge."""
        self.late: dict[int, float] = {}
        """Arrival of the last late fix near a bridge, by its number."""
        self.is_gone = False
        """Whether it has left for good, as far as known."""
        self._declared_toml: str | None = None
        self.differences: list[InfoDifference] = []
        """Differences between its own description and the site file."""

    def ingest_info(self, site_toml: str) -> None:
        """Accept the truck's description of itself; its first difference counts."""
        if not self.differences:
            self._declared_toml = site_toml
            self.differences = differences(site_toml, self.vehicle)

    def retarget(self, vehicle: Vehicle, before: Bridges, bridges: Bridges) -> None:
        """Continue with truck and bridges of another site file."""
        self.vehicle = vehicle
        ids = {before.bridge(number).id: visit for number, visit in self.near.items()}
        self.near = {bridges.number[i]: v for i, v in ids.items() if i in bridges.number}
        self.late.clear()
        self.searches.clear()
        dropped = {
            name: one for name, one in self.detected.items() if name[0] not in bridges.number
        }
        self.detected = {name: one for name, one in self.detected.items() if name not in dropped}
        self.differences = []
        if self._declared_toml is not None:
            self.ingest_info(self._declared_toml)

    def busy_at(self) -> set[str]:
        """Return the bridges with a crossing that has started and is to be decided here."""
        over = self.done | self.left
        return {bridge for (bridge, _), name in self.detected.items() if name not in over}

    def add_fix(self, bridges: Bridges, fix: GnssFix) -> list[int]:
        """Add a fix; return the numbers of the bridges whose stays it may change."""
        now_s = fix.device_time_ns * 1e-9
        here = (now_s, fix.latitude_deg, fix.longitude_deg)
        before, self.place = self.place or here, here
        busy = {bridges.number[bridge] for bridge in self.busy_at()}
        found = bridges.between(*before[1:], *here[1:])
        for number in found:
            visit = self.near.get(number)
            if visit is None or (now_s - visit.last_s > AWAY_S and number not in busy):
                visit = Visit(before[0], now_s)  # it may have jumped over it since then
                self.searches.pop(number, None)
            self.near[number] = Visit(min(visit.since_s, now_s), max(visit.last_s, now_s))
        return sorted(busy.union(found)) if busy else found

    def add_late_fix(self, bridges: Bridges, fix: GnssFix) -> None:
        """Add a fix that had been given up as lost; its effect is evaluated later."""
        time_s = fix.device_time_ns * 1e-9
        here = (fix.latitude_deg, fix.longitude_deg)
        for number in bridges.between(*here, *here):
            visit = self.near.get(number, Visit(time_s, time_s))
            self.near[number] = Visit(min(visit.since_s, time_s), max(visit.last_s, time_s))
            self.late[number] = self.latest_s
        self.searches.clear()

    def due_late_bridges(self) -> list[int]:
        """Remove and return the bridges whose late fixes are complete by now."""
        found = [n for n, came_s in self.late.items() if self.latest_s > came_s + PATIENCE_S]
        for number in found:
            del self.late[number]
        return found

    def stays(self, bridges: Bridges, number: int, here: GnssFix | None) -> list[Stay]:
        """Return all stays on a bridge in the known fixes; `here` is the new one.

        A search takes time: it is skipped for a truck that stays on the side without effect.
        """
        search = self.searches.get(number)
        is_newest = here is not None and here.device_time_ns * 1e-9 >= self.latest_s
        if here is not None and is_newest and search is not None:
            place = here.latitude_deg, here.longitude_deg
            if bridges.is_as_it_was(search, number, self.vehicle, *place):
                return search.stays
        fixes, visit = self.boot.fixes(), self.near.get(number)
        # A truck may have stood somewhere for minutes: fixes before its arrival are not needed.
        lately = fixes if visit is None else fixes.since(visit.since_s - AWAY_S)
        search = self.searches[number] = bridges.search_stays(number, self.vehicle, lately, search)
        return search.stays

    def id_of(self, bridge: str, stay: Stay) -> str | None:
        """Return the id of a stay, although its entry moves a little with every new fix."""
        for (known_bridge, entry_s), crossing_id in self.detected.items():
            if known_bridge == bridge and abs(entry_s - stay.entry_s) < MERGE_S:
                return crossing_id
        for known_bridge, begin_s, end_s, crossing_id in self.decided:
            # Late fixes may move an entry far, but not to before the known fixes, and a truck is
            # not on a bridge twice at once.
            if known_bridge == bridge and overlap(begin_s, end_s, stay.entry_s, stay.exit_s):
                return crossing_id
        return None

    def decide(self, bridge: str, stay: Stay, crossing_id: str) -> None:
        """Record that a crossing is decided, with the fixes around it."""
        time_s = self.boot.fixes().time_s
        first = int(np.searchsorted(time_s, stay.entry_s, "right")) - 1
        last = int(np.searchsorted(time_s, stay.exit_s, "left"))
        around = float(time_s[max(first, 0)]), float(time_s[min(last, time_s.size - 1)])
        self.done.add(crossing_id)
        self.decided.append((bridge, *around, crossing_id))

    def has_left(self, bridge: str, entry_s: float) -> bool:
        """Return whether a crossing with entry at about `entry_s` is left to the recordings."""
        return any(
            known == bridge and abs(at_s - entry_s) < MERGE_S and crossing_id in self.left
            for (known, at_s), crossing_id in self.detected.items()
        )

    def may_still_come(self, window: Window, stay: Stay, now_s: float) -> bool:
        """Return whether a crossing lacks data that may still arrive soon."""
        begin_s, end_s = window
        if now_s < end_s:
            return True
        if not self.boot.lacks_accel(begin_s - MAX_BATCH_S, end_s):
            return False
        if self.boot.latest_accel_s() >= end_s + PATIENCE_S:
            return False  # newer ones arrived long ago: it is lost
        return now_s < end_s + _SILENCE_S

    def has_hole(self, window: Window, stay: Stay, now_s: float) -> bool:
        """Return whether a crossing lacks data older than some that were received."""
        latest_s = self.boot.latest_accel_s()
        if latest_s < stay.exit_s:
            return True  # positions from after the bridge were received
        end_s = min(window.end_s, latest_s - _ROUNDING_S)
        return self.boot.lacks_accel(window.begin_s - MAX_BATCH_S, end_s)

    def forget(self, now_s: float, wall_offset_s: float) -> None:
        """Drop data that are too old by the truck's own clock, at intervals.

        `wall_offset_s` is the wall clock minus the device clock of the message.
        """
        self.began_s = min(self.began_s, now_s)
        if now_s > self.clock_s + _KEEP_S and abs(now_s - self.doubtful_s) > _KEEP_S:
            # A single wrong time must not make the truck drop, and never accept again, everything
            # older.
            if np.isfinite(self.clock_s):
                self._log_jump(now_s - self.clock_s, wall_offset_s - self.wall_offset_s)
            self.doubtful_s = now_s
            return
        self.clock_s = max(self.clock_s, now_s)
        self.wall_offset_s = wall_offset_s
        if now_s - _KEEP_S > max(self.began_s, self.forgotten_s) + FORGET_EVERY_S:
            self.forget_before(now_s - _KEEP_S)

    def _log_jump(self, ahead_s: float, change_s: float) -> None:
        """Log a jump of the device clock, by which the wall clock's offset from it changed."""
        name = self.vehicle.id
        if abs(change_s) < _PAUSE_S:
            _log.info("%s: measured nothing for %.0f s (a pause, or --skip-gaps)", name, ahead_s)
        else:
            _log.warning("%s: device time jumped ahead by %.0f s", name, ahead_s)

    def forget_before(self, time_s: float) -> None:
        """Drop samples, fixes and decided crossings: no stay is detected there again."""
        self.forgotten_s = time_s
        self.boot.forget_before(time_s)
        self.searches.clear()
        busy = self.busy_at()
        self.near = {n: v for n, v in self.near.items() if v.last_s >= time_s or busy}
        self.decided = [one for one in self.decided if one[2] >= time_s]
        kept = {crossing_id for *_, crossing_id in self.decided}
        self.detected = {
            (bridge, entry_s): crossing_id
            for (bridge, entry_s), crossing_id in self.detected.items()
            if entry_s >= time_s - MERGE_S
            or crossing_id in kept
            or crossing_id not in self.done | self.left
        }
        self.left &= set(self.detected.values())
        kept.update(self.detected.values())
        self.done &= kept
