"""Detection of crossings with their data in messages, before any method is involved.

A `Finder` searches the positions for stays of trucks on bridges, waits for the samples of each stay
and yields it once at its beginning and once when it is complete. It opens nothing and reads no
clock, so that the same messages give the same crossings, live or from a recording.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from schemas.signals import TRUCK_DECODERS, AccelBatch, GnssFix, VehicleInfo, decode_gnss
from schemas.site import Bridge, Site, Vehicle
from schemas.topics import Key
from services.common.naming import name_of_crossing
from services.finding.crossing_data import (
    LONGEST_MARGIN_S,
    Complete,
    CrossingData,
    Detection,
    Window,
    WindowOf,
)
from services.finding.scene import Scene
from services.finding.stays import LONGEST_STAY_S, Passage, Stay
from services.finding.truck import FORGET_EVERY_S, TruckBoot

Found = Detection | Complete


class Name(NamedTuple):
    """Known name of a stay that a finder detects for the first time."""

    crossing_id: str
    is_decided: bool
    """Whether the finder can ignore it."""


Recognise = Callable[[Detection], Name | None]
"""Type of a function that returns the name of a stay known from elsewhere, or None."""
_Wait = Callable[[TruckBoot, Window, Stay, float], bool]
"""Type of a function that returns whether a finished crossing waits for more data.

Its last argument is the present time of the truck in s.
"""


class Finder:
    """Detector of crossings in messages of trucks of all realms.

    Everything that follows from a message comes from the iterator that `feed` returns, as it
    happens, and must be consumed before the next call.

    Parameters
    ----------
    site
        Trucks and bridges.
    window
        Function that returns the stretch of a drive of a crossing.
    recognise
        Function called once for every new stay.
    """

    def __init__(
        self, site: Site, window: WindowOf, recognise: Recognise = lambda detection: None
    ) -> None:
        self.scene = Scene(site)
        self._window = window
        self._recognise = recognise
        self._trucks: dict[tuple[str, str, int], TruckBoot] = {}
        self._newest_boot: dict[tuple[str, str], int] = {}
        self._expected: tuple[bytes, GnssFix] | None = None
        """The last position noted: it is usually fed next, and decoded once."""
        self._recorded: dict[str, int] = {}
        """Wall time in ns up to which a logger has the messages, by truck."""
        self.unknown_vehicles: set[str] = set()
        """Trucks that the site file lacks; none of their crossings can be identified."""

    def retarget(self, site: Site) -> None:
        """Continue with another site file; decided crossings stay decided."""
        before = self.scene.bridges
        self.scene.retarget(site)
        for name, truck in list(self._trucks.items()):
            if name[1] in self.scene.vehicles:
                truck.retarget(self.scene.vehicles[name[1]], before, self.scene.bridges)
            else:
                del self._trucks[name]
        self.unknown_vehicles.clear()

    def leave_to_recordings(self, until_ns: Mapping[str, int]) -> None:
        """Exclude crossings of recorded trucks whose data begin or end too early, or lack a part.

        `until_ns` is the wall time, by truck, up to which a logger has recorded it: in ns since
        1970 UTC. Such a crossing is complete in the recording.
        """
        self._recorded = dict(until_ns)

    def expect(self, key: Key, payload: bytes, *, for_ever: bool = False) -> None:
        """Record a truck's position at its arrival, when another may be on the bridge.

        It is called once for every message, of any stream, before the message is fed, which may be
        after another truck's; `for_ever` for a recording, in which nothing is too old. `feed`
        records no position: an expired one would return as the newest. Malformed messages are left
        to `feed`.
        """
        if key.owner == "vehicle" and key.stream == "gnss":
            with contextlib.suppress(ValueError):
                fix = decode_gnss(payload)
                self._expected = payload, fix
                self.scene.traffic.note(key.realm, key.identifier, fix, for_ever=for_ever)

    def feed(self, key: Key, payload: bytes) -> Iterator[Found]:
        """Accept one message of a vehicle that `expect` has received; ignore other streams.

        Raise ValueError, at once, for a malformed message.
        """
        if key.owner != "vehicle" or key.stream not in TRUCK_DECODERS:
            return iter(())
        vehicle = self.scene.vehicles.get(key.identifier)
        if vehicle is None:
            self.unknown_vehicles.add(key.identifier)
            return iter(())
        if self._expected is not None and self._expected[0] is payload:
            return self._ingest(key, vehicle, self._expected[1])
        return self._ingest(key, vehicle, TRUCK_DECODERS[key.stream](payload))

    def _ingest(
        self, key: Key, vehicle: Vehicle, message: AccelBatch | GnssFix | VehicleInfo
    ) -> Iterator[Found]:
        truck_name = (key.realm, key.identifier)
        if message.boot_id < self._newest_boot.get(truck_name, 0):
            return  # its crossings are decided
        name = (*truck_name, message.boot_id)
        truck = self._trucks.get(name)
        if truck is None:
            truck = self._trucks[name] = TruckBoot(key.realm, vehicle)
        truck.is_gone = False
        if isinstance(message, VehicleInfo):
            truck.ingest_info(message.site_toml)
        elif isinstance(message, AccelBatch):
            truck.boot.add_accel(message)
            truck.forget(message.device_time_ns * 1e-9, _wall_offset_s(message))
        else:
            # A truck that has restarted sends nothing more of its earlier boots.
            for older in [
                n for n in self._trucks if n[:2] == truck_name and n[2] < message.boot_id
            ]:
                yield from self._finish(self._trucks.pop(older))
            self._newest_boot[truck_name] = message.boot_id
            if truck.boot.add_fix(message):
                truck.add_late_fix(self.scene.bridges, message)
            yield from self._process_fixes(truck)

    def finish(self) -> Iterator[Found]:
        """Decide all crossings with the present data: no more messages will arrive."""
        for truck in list(self._trucks.values()):
            yield from self._finish(truck)

    def gone(self, realm: str, vehicle: str, *, for_good: bool = False) -> Iterator[Found]:
        """Decide the finished crossings of a truck that has become silent.

        The truck may only have lost its connection, and send the missing data later. A crossing in
        progress therefore waits, as does one with missing data until the truck has left
        `for_good`; data after its last message are not needed.
        """
        for truck in self._boots_of(realm, vehicle):
            truck.is_gone = for_good
            if truck.boot.lacks_fixes() and not for_good:
                continue
            yield from self._process_fixes(truck, all_there_is=True)
            if np.isfinite(truck.latest_s):
                wait: _Wait = (lambda *_: False) if for_good else TruckBoot.has_hole
                yield from self._search_stays(truck, list(truck.near), truck.latest_s, wait)

    def settle(self, realm: str, vehicle: str, crossing_id: str) -> None:
        """Ignore a detected crossing from now on: it was decided from a recording."""
        for truck in self._boots_of(realm, vehicle):
            if crossing_id in truck.detected.values():
                truck.done.add(crossing_id)

    def has_undecided(self, realm: str, vehicle: str) -> bool:
        """Return whether a truck has, or may have, a crossing that is not decided."""
        return any(
            truck.boot.lacks_fixes() or truck.busy_at() for truck in self._boots_of(realm, vehicle)
        )

    def is_tracking(
        self, realm: str, vehicle: str, boot_id: int, bridge: str, entry_s: float
    ) -> bool:
        """Return whether a stay with entry at `entry_s` on its truck's clock is detected here.

        It is if the messages around it came from the truck itself, and the truck has not left for
        good: then it has been decided, or will be.
        """
        truck = self._trucks.get((realm, vehicle, boot_id))
        if (
            truck is None
            or truck.is_gone
            or entry_s < max(truck.forgotten_s + FORGET_EVERY_S, truck.began_s)
        ):
            return False
        if bridge not in self.scene.bridges.number:
            return True  # it belongs to another site file
        if truck.has_left(bridge, entry_s):
            return False
        before = LONGEST_MARGIN_S if vehicle in self._recorded else 0.0
        return not truck.boot.is_cut_off_at(entry_s - before)

    def _boots_of(self, realm: str, vehicle: str) -> list[TruckBoot]:
        return [t for name, t in self._trucks.items() if name[:2] == (realm, vehicle)]

    def _process_fixes(self, truck: TruckBoot, *, all_there_is: bool = False) -> Iterator[Found]:
        """Search once at every fix, so that results do not depend on how messages were grouped."""
        for fix in truck.boot.release_fixes(all_there_is=all_there_is):
            truck.latest_s = max(truck.latest_s, fix.device_time_ns * 1e-9)
            near = truck.add_fix(self.scene.bridges, fix)
            if truck.late:
                near = sorted({*near, *truck.due_late_bridges()})
            yield from self._search_stays(truck, near, truck.latest_s, here=fix)
            truck.forget(truck.latest_s, _wall_offset_s(fix))

    def _finish(self, truck: TruckBoot) -> Iterator[Found]:
        yield from self._process_fixes(truck, all_there_is=True)
        yield from self._search_stays(truck, list(truck.near), np.inf)

    def _search_stays(
        self,
        truck: TruckBoot,
        bridges: list[int],
        now_s: float,
        wait: _Wait = TruckBoot.may_still_come,
        here: GnssFix | None = None,
    ) -> Iterator[Found]:
        """Search for crossings in the known fixes; `here` is the new one.

        A finished crossing waits while `wait` returns true.
        """
        for number in sorted(bridges):
            bridge = self.scene.bridges.bridge(number)
            for stay in truck.stays(self.scene.bridges, number, here):
                # Which of several adjacent bridges it is on is known when it has left them.
                is_plain = stay.is_over or not self.scene.bridges.adjacent_bridges(number)
                if is_plain or now_s - stay.entry_s >= LONGEST_STAY_S:
                    yield from self._advance(truck, bridge, stay, now_s, wait)

    def _advance(
        self, truck: TruckBoot, bridge: Bridge, stay: Stay, now_s: float, wait: _Wait
    ) -> Iterator[Found]:
        begins = stay.passage is Passage.BEGINS_ON_BRIDGE
        if begins and stay.entry_s < truck.forgotten_s + FORGET_EVERY_S:
            return  # earlier data have been forgotten; this was decided before that
        window = self._window(stay, bridge, truck.vehicle)
        if truck.boot.is_cut_off_at(window.begin_s) and self._is_recorded(truck, stay):
            return
        crossing_id = truck.id_of(bridge.id, stay)
        is_new = crossing_id is None
        if crossing_id is None:
            crossing_id = self._named(truck, bridge, stay)
        if crossing_id in truck.done:
            return
        if is_new:
            yield _detection(truck, bridge, stay, crossing_id)
        found = stay  # the reported end does not change when it lasts too long
        if np.isfinite(now_s):
            if not stay.is_over and now_s - stay.entry_s < LONGEST_STAY_S:
                return
            if not stay.is_over:
                stay = stay._replace(passage=Passage.TURNED_BACK)
            elif wait(truck, window, stay, now_s):
                return
        # The connection broke between positions and accelerations, or damaged a message.
        has_hole = stay.is_over and truck.has_hole(window, stay, now_s)
        if has_hole and self._is_recorded(truck, stay):
            truck.left.add(crossing_id)
            return
        truck.decide(bridge.id, stay, crossing_id)
        detection = _detection(truck, bridge, found, crossing_id)
        yield Complete(detection, self.scene.data(truck, detection, stay, window))

    def _is_recorded(self, truck: TruckBoot, stay: Stay) -> bool:
        """Return whether a logger was recording when a stay ended."""
        until_ns = self._recorded.get(truck.vehicle.id)
        return until_ns is not None and truck.boot.wall_time_ns(stay.exit_s) <= until_ns

    def _named(self, truck: TruckBoot, bridge: Bridge, stay: Stay) -> str:
        """Return the name of a stay that this finder detects for the first time."""
        wall_ns = truck.boot.wall_time_ns(stay.entry_s)
        own = name_of_crossing(truck.vehicle.id, bridge.id, wall_ns / 1e9)
        known = self._recognise(_detection(truck, bridge, stay, own))
        name = known or Name(own, is_decided=False)
        truck.detected[bridge.id, stay.entry_s] = name.crossing_id
        if name.is_decided:
            truck.done.add(name.crossing_id)
        return name.crossing_id


def crossings_in(
    messages: Iterable[tuple[Key, bytes]], site: Site, window: WindowOf
) -> Iterator[CrossingData]:
    """Yield the data of all crossings in messages in order of measurement.

    Raise ValueError for a malformed message.
    """
    finder = Finder(site, window)
    for key, payload in messages:
        finder.expect(key, payload)
        yield from _complete(finder.feed(key, payload))
    yield from _complete(finder.finish())


def _complete(found: Iterable[Found]) -> Iterator[CrossingData]:
    return (one.data for one in found if isinstance(one, Complete))


def _detection(truck: TruckBoot, bridge: Bridge, stay: Stay, crossing_id: str) -> Detection:
    return Detection(
        *(crossing_id, truck.realm, truck.vehicle.id, bridge.id, stay),
        truck.boot.wall_time_ns(stay.entry_s),
        truck.boot.wall_time_ns(stay.exit_s),
    )


def _wall_offset_s(message: AccelBatch | GnssFix) -> float:
    """Return the wall clock minus the device clock of a message, s."""
    return (message.wall_time_ns - message.device_time_ns) * 1e-9
