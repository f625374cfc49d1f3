"""The part of the worker that decides: messages in, messages out.

It finds crossings in the positions, waits for the samples that belong to them, has them identified
and says so. It opens nothing, reads no clock and asks nobody, so that a recording that is replayed
through it gives the same bytes every time.
"""

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from typing import Any, NamedTuple, TypeVar

import numpy as np

from schemas.proto import driveby_pb2 as pb
from schemas.reasons import Reason
from schemas.results import (
    BridgeResult,
    Crossing,
    Direction,
    ElementState,
    Header,
    LeftOut,
    bridge_to_protobuf,
    crossing_to_protobuf,
    direction_to_protobuf,
)
from schemas.settings import IdentificationSettings
from schemas.signals import (
    MAX_BATCH_S,
    AccelBatch,
    GnssFix,
    VehicleInfo,
    decode_accel,
    decode_gnss,
    decode_info,
)
from schemas.site import Bridge, Site, Vehicle
from schemas.topics import Key
from schemas.vehicle_info import Difference, differences
from services.common.geodesy import BridgeFrame, bridge_frame, to_chainage
from services.identification.crossing_data import CrossingData
from services.identification.identify import MARGIN_S, Identify, Report, Stopwatch, identify
from services.identification.stays import MARGIN_M, MERGE_S, Passage, Stay, find_stays
from services.identification.streams import PATIENCE_S, Boot
from services.identification.told import Told, told_of
from services.identification.traffic import Traffic

_log = logging.getLogger(__name__)
_KEEP_S = 300.0
"""Samples older than this are forgotten."""
_LONGEST_STAY_S = 270.0
"""Who is on a short bridge for so long does not cross it."""
_SILENCE_S = 120.0
"""So long may positions come without accelerations, as when both are fetched after an outage."""
_FORGET_EVERY_S = 10.0
_ROUNDING_S = 1e-6
"""More than is lost when a time in nanoseconds becomes one in seconds."""
_REACH_M = 50.0
"""Further away than this from the ends of a bridge no fix changes what happened on it."""


class Output(NamedTuple):
    """A message to publish, and the result itself where it is one."""

    key: Key
    payload: bytes
    result: Crossing | None = None


class _Truck:
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
        """Of what has been identified: bridge, times of the fixes around it, and crossing id."""
        self.said: dict[str, set[pb.CrossingState]] = {}
        """By crossing id: states that an earlier run of the worker has told."""
        self.side: dict[str, int] = {}
        """By bridge: far before its start (-1), far behind its end (1), or near (0)."""
        self.differences: list[Difference] = []
        """Where it says of itself what the site file does not say of it."""

    def is_busy_at(self, bridge: Bridge) -> bool:
        """Whether a crossing of this bridge has begun and is not decided yet."""
        return any(
            known_bridge == bridge.id and crossing_id not in self.done
            for (known_bridge, _), crossing_id in self.detected.items()
        )


_DECODERS: dict[str, Callable[[bytes], AccelBatch | GnssFix | VehicleInfo]] = {
    "accel": decode_accel,
    "gnss": decode_gnss,
    "info": decode_info,
}
Name = TypeVar("Name")
_Wait = Callable[[_Truck, Stay, float], bool]
"""Whether a crossing that is over, at the truck's time of now (s), waits for more of its data."""


class Engine:
    """Takes the messages of a realm's trucks and returns what is to be published.

    `header` says what goes into every estimate; `stopwatch` measures the seconds of an
    identification and is the only thing that may differ between two runs; `report` is told how far
    an identification is. Who wants more of a crossing than its result wraps `identify`.
    """

    def __init__(
        self,
        site: Site,
        settings: IdentificationSettings,
        header: Header,
        *,
        stopwatch: Stopwatch = lambda: 0.0,
        report: Callable[[str, str, float], None] = lambda crossing, stage, fraction: None,
        identify: Identify = identify,
    ) -> None:
        self._site = site
        self._identify = identify
        self._settings = settings
        self._header = header
        self._stopwatch = stopwatch
        self._report = report
        self._frames: list[tuple[Bridge, BridgeFrame]] = [
            (bridge, bridge_frame(bridge)) for bridge in site.bridges
        ]
        self._margin_m = max(MARGIN_M, 5.0 * site.receiver.position_noise_m)
        self._vehicles = {vehicle.id: vehicle for vehicle in site.vehicles}
        self._traffic = Traffic(self._frames, self._vehicles, self._margin_m)
        self._trucks: dict[tuple[str, str, int], _Truck] = {}
        self._newest_boot: dict[tuple[str, str], int] = {}
        self._usable: dict[tuple[str, str], list[Crossing]] = {}
        self._told: dict[tuple[str, str, str], list[Told]] = {}
        """By realm, vehicle and bridge: what earlier runs told."""
        self.unknown_vehicles: set[str] = set()
        """Trucks that the site file does not know; nothing of theirs can be identified."""

    def resume(self, said: Iterable[tuple[Key, bytes]]) -> Iterator[Output]:
        """Go on from what earlier runs said, in its order; yield what they did not come to say.

        To be called before the first message. A crossing that has a result by these settings and
        this site file gets no other one, and counts in the states of its bridge; of one that has
        none only those states are told that have not been told.
        """
        crossings = told_of(said, self._header)
        for told in crossings:
            self._told.setdefault((told.realm, told.vehicle, told.bridge), []).append(told)
        self._usable = usable_of(
            ((told.realm, told.bridge), told.result) for told in crossings if told.result
        )
        for told in crossings:
            if told.result is None:
                continue
            if told.last is not None and pb.DONE not in told.states:
                told.last.state = pb.DONE  # all else is as when it was told to be identified
                yield Output(
                    Key(told.realm, "bridge", told.bridge, "crossing"),
                    told.last.SerializeToString(deterministic=True),
                )
            if told.result.parameters is not None and not told.is_in_state:
                usable = self._usable[told.realm, told.bridge]
                yield _state_message(told.realm, told.bridge, told.result, latest_state(usable))

    def expect(self, key: Key, payload: bytes) -> None:
        """Take a position into account before its turn: that another truck was there then.

        For recordings, which are fed truck by truck. What is malformed is left to `feed`.
        """
        if key.owner == "vehicle" and key.stream == "gnss":
            with contextlib.suppress(ValueError):
                self._traffic.note(key.realm, key.identifier, decode_gnss(payload), for_ever=True)

    def feed(self, key: Key, payload: bytes) -> Iterator[Output]:
        """Take one message of a vehicle; other streams are ignored.

        ValueError, at once: malformed. What follows from the message comes from the iterator, as
        things happen, so that a state can be published before the long work begins.
        """
        if key.owner != "vehicle" or key.stream not in _DECODERS:
            return iter(())
        vehicle = self._vehicles.get(key.identifier)
        if vehicle is None:
            self.unknown_vehicles.add(key.identifier)
            if key.stream == "gnss":  # it may cross a bridge together with one that is known
                with contextlib.suppress(ValueError):
                    self._traffic.note(key.realm, key.identifier, decode_gnss(payload))
            return iter(())
        decoded = _DECODERS[key.stream](payload)
        if isinstance(decoded, GnssFix):
            self._traffic.note(key.realm, key.identifier, decoded)
        return self._take(key, vehicle, decoded)

    def _take(
        self, key: Key, vehicle: Vehicle, message: AccelBatch | GnssFix | VehicleInfo
    ) -> Iterator[Output]:
        if message.boot_id < self._newest_boot.get((key.realm, key.identifier), 0):
            return  # its crossings have been decided
        truck = self._truck(key, message.boot_id, vehicle)
        if isinstance(message, VehicleInfo):
            truck.differences = truck.differences or differences(message.site_toml, vehicle)
        elif isinstance(message, AccelBatch):
            truck.boot.add_accel(message)
            self._forget(truck, message.device_time_ns * 1e-9)
        else:
            yield from self._finish_older_boots(key, message.boot_id)
            truck.boot.add_fix(message)
            yield from self._settle(key.realm, truck)

    def finish(self) -> Iterator[Output]:
        """No more messages will come: decide all crossings with what there is."""
        for (realm, _, _), truck in list(self._trucks.items()):
            yield from self._finish(realm, truck)

    def gone(self, realm: str, vehicle: str, *, for_good: bool = False) -> Iterator[Output]:
        """A truck has gone silent: decide the crossings that it has finished.

        It may only have lost its connection, and bring what is missing when it has it again. So
        one that it is still in waits, and until it is gone `for_good` one in which something is
        missing; of what was to follow on the last that came nothing is needed.
        """
        for truck in self._boots_of(realm, vehicle):
            if truck.boot.lacks_fixes() and not for_good:
                continue
            yield from self._settle(realm, truck, all_there_is=True)
            if np.isfinite(truck.latest_s):
                now_s = truck.latest_s
                wait = (lambda *_: False) if for_good else self._has_hole
                yield from self._look(realm, truck, self._frames, now_s, wait)

    def has_undecided(self, realm: str, vehicle: str) -> bool:
        """Whether a truck is known to have a crossing that is not decided, or may have one."""
        return any(
            truck.boot.lacks_fixes() or any(truck.is_busy_at(bridge) for bridge, _ in self._frames)
            for truck in self._boots_of(realm, vehicle)
        )

    def _boots_of(self, realm: str, vehicle: str) -> list[_Truck]:
        return [t for name, t in self._trucks.items() if name[:2] == (realm, vehicle)]

    def _settle(self, realm: str, truck: _Truck, *, all_there_is: bool = False) -> Iterator[Output]:
        """Look once at every fix: what is found does not depend on which came together."""
        for fix in truck.boot.settle(all_there_is=all_there_is):
            truck.latest_s = max(truck.latest_s, fix.device_time_ns * 1e-9)
            bridges = [b for b in self._frames if self._may_change(truck, *b, fix)]
            yield from self._look(realm, truck, bridges, truck.latest_s)
            self._forget(truck, truck.latest_s)

    def _finish(self, realm: str, truck: _Truck) -> Iterator[Output]:
        yield from self._settle(realm, truck, all_there_is=True)
        yield from self._look(realm, truck, self._frames, np.inf)

    def _forget(self, truck: _Truck, now_s: float) -> None:
        truck.began_s = min(truck.began_s, now_s)
        if now_s > truck.clock_s + _KEEP_S and abs(now_s - truck.doubtful_s) > _KEEP_S:
            # A single wrong time must not make the truck forget, and never take in again, all that
            # is older than it.
            if np.isfinite(truck.clock_s):
                name = truck.vehicle.id
                _log.warning("%s: a device time %.0f s ahead", name, now_s - truck.clock_s)
            truck.doubtful_s = now_s
            return
        truck.clock_s = max(truck.clock_s, now_s)
        if now_s - _KEEP_S > max(truck.began_s, truck.forgotten_s) + _FORGET_EVERY_S:
            truck.forgotten_s = now_s - _KEEP_S
            truck.boot.forget_before(truck.forgotten_s)

    def _truck(self, key: Key, boot_id: int, vehicle: Vehicle) -> _Truck:
        name = (key.realm, key.identifier, boot_id)
        truck = self._trucks.get(name)
        if truck is None:
            truck = self._trucks[name] = _Truck(vehicle)
        return truck

    def _finish_older_boots(self, key: Key, boot_id: int) -> Iterator[Output]:
        """A truck that has started anew says nothing more of its boots before."""
        for name in [n for n in self._trucks if n[:2] == (key.realm, key.identifier)]:
            if name[2] < boot_id:
                yield from self._finish(key.realm, self._trucks.pop(name))
        self._newest_boot[key.realm, key.identifier] = boot_id

    def _may_change(self, truck: _Truck, bridge: Bridge, frame: BridgeFrame, fix: GnssFix) -> bool:
        """Whether a fix can begin, change or end a stay on a bridge: most are far from it."""
        here_m, _ = to_chainage(frame, fix.latitude_deg, fix.longitude_deg)
        reach_m = _REACH_M + 2.0 * self._margin_m
        side = -1 if here_m < -reach_m else 1 if here_m > bridge.span_m + reach_m else 0
        before = truck.side.get(bridge.id, side)
        truck.side[bridge.id] = side
        return side == 0 or side != before or truck.is_busy_at(bridge)

    def _look(
        self,
        realm: str,
        truck: _Truck,
        bridges: list[tuple[Bridge, BridgeFrame]],
        now_s: float,
        wait: _Wait | None = None,
    ) -> Iterator[Output]:
        """Find crossings in the fixes that are known, and identify those that are complete.

        A crossing that is over waits while `wait` says so.
        """
        if not bridges:
            return
        wait = wait or self._may_still_come
        fixes = truck.boot.fixes()
        for bridge, frame in bridges:
            chainage, lateral = to_chainage(frame, fixes.latitude_deg, fixes.longitude_deg)
            stays = find_stays(
                fixes.time_s,
                chainage,
                lateral,
                fixes.speed_m_per_s,
                span_m=bridge.span_m,
                wheelbase_m=truck.vehicle.wheelbase_m,
                antenna_to_front_axle_m=truck.vehicle.gps_antenna_to_front_axle_m,
                margin_m=self._margin_m,
            )
            for stay in stays:
                yield from self._advance(realm, truck, bridge, stay, now_s, wait)

    def _advance(
        self,
        realm: str,
        truck: _Truck,
        bridge: Bridge,
        stay: Stay,
        now_s: float,
        wait: _Wait,
    ) -> Iterator[Output]:
        begins = stay.passage is Passage.BEGINS_ON_BRIDGE
        if begins and stay.entry_s < truck.forgotten_s + _FORGET_EVERY_S:
            return  # what was before has been forgotten; this had been decided before that
        crossing_id, is_new = self._identity(realm, truck, bridge, stay)
        if crossing_id in truck.done:
            return
        state = _StateMessages(realm, bridge, truck, stay, crossing_id)
        said = truck.said.get(crossing_id, set())
        if is_new and pb.DETECTED not in said:
            yield state.message(pb.DETECTED, stay.entry_s)
        if np.isfinite(now_s):
            if not stay.is_over and now_s - stay.entry_s < _LONGEST_STAY_S:
                return
            if not stay.is_over:
                stay = stay._replace(passage=Passage.TURNED_BACK)
            elif wait(truck, stay, now_s):
                return
        truck.done.add(crossing_id)
        truck.decided.append((bridge.id, *_fixes_around(truck, stay), crossing_id))
        for begun in (pb.COMPLETE, pb.IDENTIFYING):
            if begun not in said:
                yield state.message(begun, stay.exit_s)
        result = self._identified(realm, truck, bridge, stay, crossing_id)
        latest = self._bridge_state(realm, bridge, result)  # who asks for it with the result has it
        # A result is dated by the data that made it: the engine has no clock.
        header = self._header._replace(created=result.exit_time)
        estimate = crossing_to_protobuf(result, header)
        yield Output(
            Key(realm, "bridge", bridge.id, "estimate"),
            estimate.SerializeToString(deterministic=True),
            result,
        )
        yield state.message(pb.DONE, stay.exit_s)
        if latest is not None:
            yield _state_message(realm, bridge.id, result, latest)

    def _may_still_come(self, truck: _Truck, stay: Stay, now_s: float) -> bool:
        """Whether something of a crossing is missing that a little patience may bring."""
        begin_s, end_s = stay.entry_s - MARGIN_S, stay.exit_s + MARGIN_S
        if now_s < end_s:
            return True
        if not truck.boot.lacks_accel(begin_s - MAX_BATCH_S, end_s):
            return False
        if truck.boot.latest_accel_s() >= end_s + PATIENCE_S:
            return False  # newer ones have come long ago: it is lost
        return now_s < end_s + _SILENCE_S

    def _has_hole(self, truck: _Truck, stay: Stay, now_s: float) -> bool:
        """Whether a crossing lacks what is older than something that has come."""
        latest_s = truck.boot.latest_accel_s()
        if latest_s < stay.exit_s:
            return True  # positions have come from behind the bridge
        end_s = min(stay.exit_s + MARGIN_S, latest_s - _ROUNDING_S)
        return truck.boot.lacks_accel(stay.entry_s - MARGIN_S - MAX_BATCH_S, end_s)

    def _identity(self, realm: str, truck: _Truck, bridge: Bridge, stay: Stay) -> tuple[str, bool]:
        """The id of a stay: the same although its entry moves a little with every new fix."""
        for (known_bridge, entry_s), crossing_id in truck.detected.items():
            if known_bridge == bridge.id and abs(entry_s - stay.entry_s) < MERGE_S:
                return crossing_id, False
        for known_bridge, begin_s, end_s, crossing_id in truck.decided:
            # Fixes that came after all may move an entry far, but not to before the fixes that
            # were known, and nobody is on a bridge twice at once.
            if known_bridge == bridge.id and _overlap(begin_s, end_s, stay.entry_s, stay.exit_s):
                return crossing_id, False
        wall_ns = truck.boot.wall_time_ns(stay.entry_s)
        for told in self._told.get((realm, truck.vehicle.id, bridge.id), ()):
            if _is_told(told, stay, wall_ns):
                truck.detected[bridge.id, stay.entry_s] = told.crossing_id
                truck.said[told.crossing_id] = told.states
                if told.result is not None:
                    truck.done.add(told.crossing_id)
                return told.crossing_id, True
        moment = datetime.fromtimestamp(wall_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3]
        crossing_id = f"{truck.vehicle.id}.{bridge.id}.{moment}Z"
        truck.detected[bridge.id, stay.entry_s] = crossing_id
        return crossing_id, True

    def _identified(
        self, realm: str, truck: _Truck, bridge: Bridge, stay: Stay, crossing_id: str
    ) -> Crossing:
        frame = {b.id: f for b, f in self._frames}[bridge.id]
        fixes = truck.boot.fixes()
        chainage, _ = to_chainage(frame, fixes.latitude_deg, fixes.longitude_deg)
        entry_ns = round(stay.entry_s * 1e9)
        wall_offset_s = (truck.boot.wall_time_ns(stay.entry_s) - entry_ns) / 1e9
        data = CrossingData(
            crossing_id,
            realm,
            truck.vehicle,
            bridge,
            self._site.sensor,
            self._site.receiver,
            stay,
            fixes,
            chainage,
            truck.boot.samples(stay.entry_s - MARGIN_S, stay.exit_s + MARGIN_S),
            wall_offset_s,
            self._against(realm, truck, bridge, stay, crossing_id),
        )
        report: Report = lambda stage, fraction: self._report(crossing_id, stage, fraction)  # noqa: E731
        return self._identify(data, self._settings, stopwatch=self._stopwatch, report=report)

    def _against(
        self, realm: str, truck: _Truck, bridge: Bridge, stay: Stay, crossing_id: str
    ) -> tuple[Reason, ...]:
        """What is known against a crossing that its own signals do not tell."""
        reasons = []
        for field, said, known in truck.differences[:1]:
            _log.warning(
                "%s: the truck says that its %s is %g, the site file %g",
                *(crossing_id, field, said, known),
            )
            reasons.append(Reason.VEHICLE_DIFFERS_FROM_SITE)
        wall_ns = truck.boot.wall_time_ns
        others = self._traffic.others(
            realm, bridge, truck.vehicle.id, wall_ns(stay.entry_s), wall_ns(stay.exit_s)
        )
        if others:
            _log.warning("%s: %s was on the bridge as well", crossing_id, ", ".join(others))
            reasons.append(Reason.OTHER_TRUCK_ON_BRIDGE)
        return tuple(reasons)

    def _bridge_state(self, realm: str, bridge: Bridge, result: Crossing) -> BridgeResult | None:
        """The bridge as the latest usable crossing sees it; crossings are not fused yet."""
        usable = self._usable.setdefault((realm, bridge.id), [])
        if result.parameters is None:
            return None
        usable.append(result)
        usable.sort(key=lambda crossing: crossing.entry_time)
        return latest_state(usable)

    def bridges(self) -> dict[str, BridgeResult]:
        """The latest state of every bridge that has one, for the results file."""
        return {
            bridge: latest_state(crossings)
            for (_, bridge), crossings in self._usable.items()
            if crossings
        }


def _fixes_around(truck: _Truck, stay: Stay) -> tuple[float, float]:
    """The time of the last fix before a stay and of the first one behind it."""
    time_s = truck.boot.fixes().time_s
    first = int(np.searchsorted(time_s, stay.entry_s, "right")) - 1
    last = int(np.searchsorted(time_s, stay.exit_s, "left"))
    return float(time_s[max(first, 0)]), float(time_s[min(last, time_s.size - 1)])


def _overlap(begin: float, end: float, other_begin: float, other_end: float) -> bool:
    return begin < other_end and other_begin < end


def _is_told(told: Told, stay: Stay, entry_ns: int) -> bool:
    """Whether a stay is a crossing that an earlier run has told of."""
    if abs(told.entry_ns - entry_ns) < MERGE_S * 1e9:
        return True
    if not told.exit_ns:
        # Of a history that begins on the bridge the entry is not known, only that it is earlier.
        longest_ns = _LONGEST_STAY_S * 1e9
        begins = stay.passage is Passage.BEGINS_ON_BRIDGE
        return begins and 0 < entry_ns - told.entry_ns < longest_ns
    exit_ns = entry_ns + round((stay.exit_s - stay.entry_s) * 1e9)
    return _overlap(told.entry_ns, told.exit_ns, entry_ns, exit_ns)


def _state_message(realm: str, bridge: str, result: Crossing, latest: BridgeResult) -> Output:
    message = bridge_to_protobuf(bridge, round(result.exit_time * 1e9), latest)
    payload = message.SerializeToString(deterministic=True)
    return Output(Key(realm, "bridge", bridge, "state"), payload)


def usable_of(named: Iterable[tuple[Name, Crossing]]) -> dict[Name, list[Crossing]]:
    """Those of the crossings that gave parameters, by name (of a bridge) in order of entry."""
    usable: dict[Name, list[Crossing]] = {}
    for name, crossing in sorted(named, key=lambda one: one[1].entry_time):
        if crossing.parameters is not None:
            usable.setdefault(name, []).append(crossing)
    return usable


def latest_state(usable: list[Crossing]) -> BridgeResult:
    """The latest of a bridge's usable crossings; the others are named as left out."""
    last = usable[-1]
    parameters = last.parameters or {}
    elements: dict[str, Any] = {
        name: ElementState(mean=p.mean, std=p.std, q025=p.q025, q975=p.q975)
        for name, p in parameters.items()
        if name.startswith("EI_")
    }
    return BridgeResult(
        between_crossing_std=None,
        crossings_used=(last.crossing_id,),
        crossings_left_out=tuple(
            LeftOut(crossing_id=crossing.crossing_id, reason="not_fused")
            for crossing in usable[:-1]
        ),
        **elements,
    )


class _StateMessages(NamedTuple):
    """Makes the messages that tell the states of one crossing."""

    realm: str
    bridge: Bridge
    truck: _Truck
    stay: Stay
    crossing_id: str

    def message(self, state: pb.CrossingState, time_s: float) -> Output:
        direction: Direction = "start_to_end" if self.stay.direction > 0 else "end_to_start"
        wall_time_ns = self.truck.boot.wall_time_ns
        left = self.stay.passage is not Passage.ENDS_ON_BRIDGE
        crossing = pb.Crossing(
            schema_version=1,
            crossing_id=self.crossing_id,
            vehicle=self.truck.vehicle.id,
            bridge=self.bridge.id,
            direction=direction_to_protobuf(direction),
            state=state,
            time_ns=wall_time_ns(time_s),
            entry_time_ns=wall_time_ns(self.stay.entry_s),
            exit_time_ns=wall_time_ns(self.stay.exit_s) if left else 0,
        )
        return Output(
            Key(self.realm, "bridge", self.bridge.id, "crossing"),
            crossing.SerializeToString(deterministic=True),
        )


def feed_all(engine: Engine, messages: Iterable[tuple[Key, bytes]]) -> Iterator[Output]:
    """Feed a whole recording and finish."""
    for key, payload in messages:
        yield from engine.feed(key, payload)
    yield from engine.finish()
