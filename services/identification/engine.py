"""The part of the worker that decides: messages in, messages out.

It finds crossings in the positions, waits for the samples that belong to them, has them identified
and fused, and says so. It opens nothing, reads no clock and asks nobody, so that a recording that
is replayed through it gives the same bytes every time.

Longer than other modules, because its class holds the one state that messages, results and
certificates change in turn.
"""

import contextlib
import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime

import numpy as np

from schemas.certificates import Pair
from schemas.proto import driveby_pb2 as pb
from schemas.reasons import Reason
from schemas.results import BridgeResult, Crossing, Header
from schemas.results_on_the_wire import crossing_to_protobuf
from schemas.settings import IdentificationSettings
from schemas.signals import (
    MAX_BATCH_S,
    TRUCK_DECODERS,
    AccelBatch,
    GnssFix,
    VehicleInfo,
    decode_gnss,
)
from schemas.site import Bridge, Site, Vehicle
from schemas.topics import Key
from services.common.geodesy import to_chainage
from services.identification.bridge_state import (
    LISTED_AT_MOST,
    NOTHING_STORED,
    Fusing,
    against,
    count_in,
    usable,
)
from services.identification.bridges import AWAY_S, Bridges
from services.identification.crossing_data import (
    LONGEST_MARGIN_S,
    CrossingData,
    Window,
    window,
)
from services.identification.known import LONGEST_STAY_S, Known, is_stay_of, overlap
from services.identification.outputs import (
    Fuse,
    Output,
    Said,
    Wanted,
    Work,
    crossing_output,
    state_output,
)
from services.identification.placed import middle_sensor
from services.identification.remembered import (
    BridgeCrossings,
    Found,
    TruckBoot,
    UnderWay,
    Waiting,
)
from services.identification.stays import MERGE_S, Passage, Stay
from services.identification.streams import PATIENCE_S
from services.identification.traffic import Traffic

_log = logging.getLogger(__name__)
_KEEP_S = 300.0
"""Samples older than this are forgotten."""
_SILENCE_S = 120.0
"""So long may positions come without accelerations, as when both are fetched after an outage."""
_FORGET_EVERY_S = 10.0
"""To forget takes time, which is spent this often."""
MOST_WAITING = 100
"""Crossings that are kept while they wait for a certificate or for room: half a megabyte each, or
more."""
_ROUNDING_S = 1e-6
"""More than is lost when a time in nanoseconds becomes one in seconds."""
_Name = tuple[str, str]
"""Realm and bridge."""
_Wait = Callable[[TruckBoot, Bridge, Stay, float], bool]
"""Whether a crossing that is over, at the truck's time of now (s), waits for more of its data."""


class Engine:
    """Takes the messages of a realm's trucks and returns what is to be published.

    It identifies nothing itself: what it yields holds a `Work` for each crossing, whose result is
    to be given to `done`, at any later time and in any order. Nor does it fuse: behind a result it
    yields a `Fuse`, whose state is to be given to `fused`; those of a bridge in their order, and
    one may be left out for a later one. `services.execution` does that.
    If it `finds_only`, what it finds is in `found`, and of that nothing is identified.
    `header` says what goes into every estimate, `fusing` how those of a bridge become one. Whoever
    wants states at the end only may do without those on the way (`tells_states`, `fuse_all`).

    `certificates` are the hashes of those that are known; results name them. If they `are_required`
    a crossing of a pair without one waits: a `Wanted` is yielded, once for a pair, the certificate
    is told to `certify`, and `release` then yields the crossings that waited.
    """

    def __init__(
        self,
        site: Site,
        settings: IdentificationSettings,
        header: Header,
        fusing: Fusing | None = None,
        *,
        certificates: Mapping[Pair, str] | None = None,
        are_required: bool = False,
        tells_states: bool = True,
        finds_only: bool = False,
    ) -> None:
        self._fusing = NOTHING_STORED if fusing is None else fusing
        self._tells_states = tells_states
        self._site = site
        self._settings = settings
        self._header = header
        self._bridges = Bridges(site.bridges, site.receiver)
        self._vehicles = {vehicle.id: vehicle for vehicle in site.vehicles}
        self._traffic = Traffic(self._bridges, self._vehicles)
        self._trucks: dict[tuple[str, str, int], TruckBoot] = {}
        self._newest_boot: dict[tuple[str, str], int] = {}
        self._of_bridge: dict[_Name, BridgeCrossings] = {}
        self._expected: tuple[bytes, GnssFix] | None = None
        """The fix that was noted last: as a rule it is fed next, and taken apart once."""
        self._works = 0
        """How many there have been."""
        self._known: dict[tuple[str, str, str], list[Known]] = {}
        """By realm, vehicle and bridge: what earlier runs told."""
        self._certificates = dict(certificates or {})
        self._are_required = are_required
        self._wanted: set[Pair] = set()
        self._waiting: deque[Waiting] = deque()
        """In the order in which they were found."""
        self.found: list[Found] = []
        self._finds_only = finds_only
        self.has_room: Callable[[], bool] = lambda: True
        """Whether a crossing would be begun soon. While there is none, those of trucks that are
        recorded wait as for a certificate, untold: who listens must not be held up."""
        self.recorded: frozenset[str] = frozenset()
        """Trucks that a logger records: a crossing that began before the first message of theirs
        that has come here is in a recording, and is left to who reads that (`take`)."""
        self.unknown_vehicles: set[str] = set()
        """Trucks that the site file does not know; nothing of theirs can be identified."""

    def resume(
        self, crossings: Iterable[Known], states: Mapping[_Name, BridgeResult] | None = None
    ) -> Iterator[Output | Fuse]:
        """Go on from what is known of crossings; yield what earlier runs did not come to say.

        To be called before the first message. A crossing that has a result by these settings and
        this site file gets no other one, and counts in the states of its bridge; of one that has
        none only those states are told that have not been told. `states` are those that were told
        last, by realm and bridge.
        """
        crossings = sorted(crossings, key=lambda known: known.entry_ns)
        for known in crossings:
            self._known.setdefault((known.realm, known.vehicle, known.bridge), []).append(known)
            if known.usable is not None:
                bridge = self._bridge(known.realm, known.bridge)
                bridge.counted = count_in(bridge.counted, [known.usable])
        for known in crossings:
            if not known.has_result:
                continue
            if known.last is not None and pb.DONE not in known.states:
                known.last.state = pb.DONE  # all else is as when it was told to be identified
                yield Output(
                    Key(known.realm, "bridge", known.bridge, "crossing"),
                    known.last.SerializeToString(deterministic=True),
                )
        for name, bridge in self._of_bridge.items():
            bridge.state = (states or {}).get(name)
        yield from self._states_owed(crossings)
        for known in crossings:
            known.last = known.usable = None  # nobody asks for them again, and they are large

    def retarget(
        self, site: Site, header: Header, fusing: Fusing, certificates: Mapping[Pair, str]
    ) -> Iterator[Wanted]:
        """Go on with another site file; nothing must be under way. Yield the certificates wanted.

        What was decided stays decided. Crossings that wait are identified with what the new file
        says of their truck and bridge; as after a new start the states of bridges begin anew.
        """
        before, bridges = self._bridges, Bridges(site.bridges, site.receiver)
        vehicles = {vehicle.id: vehicle for vehicle in site.vehicles}
        self._site, self._header, self._bridges, self._vehicles = site, header, bridges, vehicles
        self._fusing = fusing
        self._of_bridge.clear()
        self._traffic.retarget(bridges, vehicles)
        for name, truck in list(self._trucks.items()):
            if name[1] in vehicles:
                truck.retarget(vehicles[name[1]], before, bridges)
            else:
                del self._trucks[name]
        self._certificates = dict(certificates)
        self._wanted.clear()
        self.unknown_vehicles.clear()
        self._waiting = deque(
            one._replace(work=one.work._replace(data=self._retargeted(one.work.data)))
            for one in self._waiting
            if one.work.data.vehicle.id in vehicles and one.work.data.bridge.id in bridges.number
        )
        for pair in self.waiting():
            if not self.is_certified(pair):
                self._wanted.add(pair)
                yield Wanted(pair)

    def _retargeted(self, data: CrossingData) -> CrossingData:
        number = self._bridges.number[data.bridge.id]
        chainage, _ = to_chainage(
            self._bridges.frame(number), data.fixes.latitude_deg, data.fixes.longitude_deg
        )
        return data._replace(
            vehicle=self._vehicles[data.vehicle.id],
            bridge=self._bridges.bridge(number),
            sensor=middle_sensor(self._site.sensor, self._vehicles[data.vehicle.id]),
            receiver=self._site.receiver,
            chainage_m=chainage,
        )

    def expect(self, key: Key, payload: bytes, *, for_ever: bool = False) -> None:
        """Note where a truck is, as soon as that comes: another one may be on the bridge then.

        Once for every message, whatever its stream, before its turn to be fed, which may come after
        another truck's; `for_ever` for a recording, in which nothing is too old. `feed` notes no
        position: one that had been forgotten meanwhile would come back as the newest. What is
        malformed is left to `feed`.
        """
        if key.owner == "vehicle" and key.stream == "gnss":
            with contextlib.suppress(ValueError):
                fix = decode_gnss(payload)
                self._expected = payload, fix
                self._traffic.note(key.realm, key.identifier, fix, for_ever=for_ever)

    def feed(self, key: Key, payload: bytes) -> Iterator[Said]:
        """Take one message of a vehicle that `expect` has had; other streams are ignored.

        ValueError, at once: malformed. What follows from the message comes from the iterator, as
        things happen, so that a state can be published before the long work begins.
        """
        if key.owner != "vehicle" or key.stream not in TRUCK_DECODERS:
            return iter(())
        vehicle = self._vehicles.get(key.identifier)
        if vehicle is None:
            self.unknown_vehicles.add(key.identifier)
            return iter(())
        if self._expected is not None and self._expected[0] is payload:
            return self._take(key, vehicle, self._expected[1])
        return self._take(key, vehicle, TRUCK_DECODERS[key.stream](payload))

    def _take(
        self, key: Key, vehicle: Vehicle, message: AccelBatch | GnssFix | VehicleInfo
    ) -> Iterator[Said]:
        if message.boot_id < self._newest_boot.get((key.realm, key.identifier), 0):
            return  # its crossings have been decided
        truck = self._truck(key, message.boot_id, vehicle)
        truck.is_gone = False
        if isinstance(message, VehicleInfo):
            truck.says(message.site_toml)
        elif isinstance(message, AccelBatch):
            truck.boot.add_accel(message)
            self._forget(truck, message.device_time_ns * 1e-9)
        else:
            yield from self._finish_older_boots(key, message.boot_id)
            if truck.boot.add_fix(message):
                truck.came_late(self._bridges, message)
            yield from self._settle(key.realm, truck)

    def finish(self) -> Iterator[Said]:
        """No more messages will come: decide all crossings with what there is."""
        for (realm, _, _), truck in list(self._trucks.items()):
            yield from self._finish(realm, truck)

    def gone(self, realm: str, vehicle: str, *, for_good: bool = False) -> Iterator[Said]:
        """A truck has gone silent: decide the crossings that it has finished.

        It may only have lost its connection, and bring what is missing when it has it again. So
        one that it is still in waits, and until it is gone `for_good` one in which something is
        missing; of what was to follow on the last that came nothing is needed.
        """
        for truck in self._boots_of(realm, vehicle):
            truck.is_gone = for_good
            if truck.boot.lacks_fixes() and not for_good:
                continue
            yield from self._settle(realm, truck, all_there_is=True)
            if np.isfinite(truck.latest_s):
                now_s = truck.latest_s
                wait = (lambda *_: False) if for_good else self._has_hole
                yield from self._look(realm, truck, list(truck.near), now_s, wait)

    def has_undecided(self, realm: str, vehicle: str) -> bool:
        """Whether a truck is known to have a crossing that is not decided, or may have one."""
        return any(
            truck.boot.lacks_fixes() or truck.busy_at() for truck in self._boots_of(realm, vehicle)
        )

    def _boots_of(self, realm: str, vehicle: str) -> list[TruckBoot]:
        return [t for name, t in self._trucks.items() if name[:2] == (realm, vehicle)]

    def _settle(
        self, realm: str, truck: TruckBoot, *, all_there_is: bool = False
    ) -> Iterator[Said]:
        """Look once at every fix: what is found does not depend on which came together."""
        for fix in truck.boot.settle(all_there_is=all_there_is):
            truck.latest_s = max(truck.latest_s, fix.device_time_ns * 1e-9)
            near = truck.came_to(self._bridges, fix)
            if truck.late:
                near = sorted({*near, *truck.late_enough()})
            yield from self._look(realm, truck, near, truck.latest_s, here=fix)
            self._forget(truck, truck.latest_s)

    def _finish(self, realm: str, truck: TruckBoot) -> Iterator[Said]:
        yield from self._settle(realm, truck, all_there_is=True)
        yield from self._look(realm, truck, list(truck.near), np.inf)

    def _forget(self, truck: TruckBoot, now_s: float) -> None:
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
            truck.forget_before(now_s - _KEEP_S)

    def _truck(self, key: Key, boot_id: int, vehicle: Vehicle) -> TruckBoot:
        name = (key.realm, key.identifier, boot_id)
        truck = self._trucks.get(name)
        if truck is None:
            truck = self._trucks[name] = TruckBoot(vehicle)
        return truck

    def _finish_older_boots(self, key: Key, boot_id: int) -> Iterator[Said]:
        """A truck that has started anew says nothing more of its boots before."""
        for name in [n for n in self._trucks if n[:2] == (key.realm, key.identifier)]:
            if name[2] < boot_id:
                yield from self._finish(key.realm, self._trucks.pop(name))
        self._newest_boot[key.realm, key.identifier] = boot_id

    def _look(
        self,
        realm: str,
        truck: TruckBoot,
        bridges: list[int],
        now_s: float,
        wait: _Wait | None = None,
        here: GnssFix | None = None,
    ) -> Iterator[Said]:
        """Find crossings in the fixes that are known, and identify those that are complete.

        A crossing that is over waits while `wait` says so. `here` is the fix that is new.
        """
        wait = wait or self._may_still_come
        for number in sorted(bridges):
            bridge = self._bridges.bridge(number)
            for stay in self._stays(truck, number, here):
                # Which of several beside each other it is on is told when it has left them.
                is_plain = stay.is_over or not self._bridges.rivals(number)
                if is_plain or now_s - stay.entry_s >= LONGEST_STAY_S:
                    yield from self._advance(realm, truck, bridge, stay, now_s, wait)

    def _stays(self, truck: TruckBoot, number: int, here: GnssFix | None) -> list[Stay]:
        """All stays on a bridge in the fixes that are known; `here` is the one that is new.

        To look takes time: who is still on the side where nothing changes is not looked at again.
        """
        look = truck.looks.get(number)
        is_newest = here is not None and here.device_time_ns * 1e-9 >= truck.latest_s
        if here is not None and is_newest and look is not None:
            place = here.latitude_deg, here.longitude_deg
            if self._bridges.is_as_it_was(look, number, truck.vehicle, *place):
                return look.stays
        fixes, visit = truck.boot.fixes(), truck.near.get(number)
        # A truck may have stood somewhere for minutes: what was before it came is not needed.
        lately = fixes if visit is None else fixes.since(visit.since_s - AWAY_S)
        look = truck.looks[number] = self._bridges.look(number, truck.vehicle, lately, look)
        return look.stays

    def _advance(
        self,
        realm: str,
        truck: TruckBoot,
        bridge: Bridge,
        stay: Stay,
        now_s: float,
        wait: _Wait,
    ) -> Iterator[Said]:
        begins = stay.passage is Passage.BEGINS_ON_BRIDGE
        if begins and stay.entry_s < truck.forgotten_s + _FORGET_EVERY_S:
            return  # what was before has been forgotten; this had been decided before that
        if self._is_recorded(truck, bridge, stay):
            return
        crossing_id, is_new = self._identity(realm, truck, bridge, stay)
        if crossing_id in truck.done:
            return
        found = stay  # what is told of its end does not change when it lasts too long

        def told(state: pb.CrossingState, time_s: float) -> Output:
            return crossing_output(
                realm, truck.vehicle.id, bridge.id, truck.boot, found, crossing_id, state, time_s
            )

        said = truck.said.get(crossing_id, set())
        if is_new and pb.DETECTED not in said:
            yield told(pb.DETECTED, stay.entry_s)
        if np.isfinite(now_s):
            if not stay.is_over and now_s - stay.entry_s < LONGEST_STAY_S:
                return
            if not stay.is_over:
                stay = stay._replace(passage=Passage.TURNED_BACK)
            elif wait(truck, bridge, stay, now_s):
                return
        truck.done.add(crossing_id)
        truck.decided.append((bridge.id, *_fixes_around(truck, stay), crossing_id))
        if pb.COMPLETE not in said:
            yield told(pb.COMPLETE, stay.exit_s)
        self._works += 1
        data = self._data(realm, truck, bridge, stay, crossing_id)
        waiting = Waiting(
            Work(self._works, data, self._settings),
            told(pb.IDENTIFYING, stay.exit_s) if pb.IDENTIFYING not in said else None,
            told(pb.DONE, stay.exit_s),
        )
        if self._finds_only:
            begun = []
            if pb.DETECTED not in said:  # as it is told while the truck is on the bridge
                found = stay._replace(passage=Passage.ENDS_ON_BRIDGE)
                begun.append(told(pb.DETECTED, stay.entry_s))
                found = stay
            if pb.COMPLETE not in said:
                begun.append(told(pb.COMPLETE, stay.exit_s))
            times = (truck.boot.wall_time_ns(t) for t in (stay.entry_s, stay.exit_s))
            self.found.append(Found(tuple(begun), waiting, *times))
            return
        pair = Pair(truck.vehicle.id, bridge.id)
        may_wait = truck.vehicle.id in self.recorded and not self.has_room()
        if self.is_certified(pair) and not may_wait and pair not in self.waiting():
            yield from self._begun(waiting)
            return
        if not self.is_certified(pair) and pb.WAITING_NOT_VALIDATED not in said:
            yield told(pb.WAITING_NOT_VALIDATED, stay.exit_s)
        self._keep(waiting)
        if not self.is_certified(pair) and pair not in self._wanted:
            self._wanted.add(pair)
            yield Wanted(pair)

    def _is_recorded(self, truck: TruckBoot, bridge: Bridge, stay: Stay) -> bool:
        """Whether the beginning of a crossing has not come here and is in a recording."""
        begin_s, _ = self._window(truck, bridge, stay)
        return truck.vehicle.id in self.recorded and truck.boot.is_cut_off_at(begin_s)

    def has_in_hand(
        self, realm: str, vehicle: str, boot_id: int, bridge: str, entry_s: float
    ) -> bool:
        """Whether a stay whose entry is at `entry_s` on its truck's clock is found here, too.

        It is if the messages around it came from the truck itself, and the truck has not left for
        good: then it has been decided, or will be.
        """
        truck = self._trucks.get((realm, vehicle, boot_id))
        if (
            truck is None
            or truck.is_gone
            or entry_s < max(truck.forgotten_s + _FORGET_EVERY_S, truck.began_s)
        ):
            return False
        number = self._bridges.number.get(bridge)
        if number is None:
            return True  # of another site file
        before = LONGEST_MARGIN_S if vehicle in self.recorded else 0.0
        return not truck.boot.is_cut_off_at(entry_s - before)

    def take(self, found: Found, others: Iterable[str] = ()) -> Iterator[Said]:
        """Take in a crossing that was found in a recording; `others` were on the bridge, too.

        What the trucks themselves send of it from now on is no other crossing.
        """
        work = found.waiting.work
        data = work.data
        crossings = self._known.setdefault((data.realm, data.vehicle.id, data.bridge.id), [])
        for known in crossings:
            if known.crossing_id == work.crossing_id:
                known.is_taken = True
                break
        else:
            crossings.append(
                Known(
                    *(data.realm, data.vehicle.id, data.bridge.id, work.crossing_id),
                    *(found.entry_ns, found.exit_ns),
                    is_taken=True,
                )
            )
        seen = self._traffic.others(
            data.realm, data.bridge.id, data.vehicle.id, found.entry_ns, found.exit_ns
        )
        against = data.against
        if names := sorted({*seen, *others}):
            _log.warning("%s: %s was on the bridge as well", work.crossing_id, ", ".join(names))
            against = tuple(dict.fromkeys((*against, Reason.OTHER_TRUCK_ON_BRIDGE)))
        self._works += 1
        work = work._replace(number=self._works, data=data._replace(against=against))
        yield from found.told
        yield from self._begun(found.waiting._replace(work=work))

    def ids_in_hand(self) -> set[str]:
        """The crossings that are being identified or wait for it."""
        under_way = {u.work.crossing_id for b in self._of_bridge.values() for u in b.under_way}
        return under_way.union(one.work.crossing_id for one in self._waiting)

    def is_certified(self, pair: Pair) -> bool:
        """Whether its crossings may be identified."""
        return not self._are_required or pair in self._certificates

    def _keep(self, waiting: Waiting) -> None:
        self._waiting.append(waiting)
        if len(self._waiting) > MOST_WAITING:
            _log.warning(
                "%s has waited too long and is given up here: it is taken from the logger's "
                "recording later, or `driveby identify` gives its result from there",
                self._waiting.popleft().work.crossing_id,
            )

    def waiting(self) -> dict[Pair, list[str]]:
        """Ids of the crossings that wait, by pair, in the order in which they were found."""
        found: dict[Pair, list[str]] = {}
        for one in self._waiting:
            found.setdefault(_pair(one.work), []).append(one.work.crossing_id)
        return found

    def pairs_that_wait(self) -> list[Pair]:
        """Pairs with crossings that wait: with most first, of as many the one found last first."""
        count: Counter[Pair] = Counter()
        latest: dict[Pair, int] = {}
        for number, one in enumerate(self._waiting):
            pair = _pair(one.work)
            count[pair] += 1
            latest[pair] = number
        return sorted(count, key=lambda pair: (-count[pair], -latest[pair]))

    def certify(self, pair: Pair, certificate: str) -> None:
        """Take the hash of a pair's certificate, which has passed: `release` its crossings."""
        self._certificates[pair] = certificate

    @property
    def has_released(self) -> bool:
        """Whether a crossing that waited may go on."""
        return any(self.is_certified(_pair(one.work)) for one in self._waiting)

    def release(self) -> Iterator[Said]:
        """Let the first crossing go on that has waited and need not any more, if there is one.

        One at a time: who asks goes on listening in between.
        """
        for place, one in enumerate(self._waiting):
            if self.is_certified(_pair(one.work)):
                del self._waiting[place]
                yield from self._begun(one)
                return

    def _begun(self, waiting: Waiting) -> Iterator[Said]:
        if waiting.identifying is not None:
            yield waiting.identifying
        work = waiting.work._replace(certificate=self._certificates.get(_pair(waiting.work)))
        bridge = self._bridge(work.data.realm, work.data.bridge.id)
        bridge.under_way.append(UnderWay(work, waiting.done))
        yield work

    def done(self, work: Work, result: Crossing) -> Iterator[Output | Fuse]:
        """Take the result of a crossing, and yield what there is to say of it.

        Results of one bridge are told in the order in which their crossings were found, whichever
        comes first: so nothing depends on how long an identification took. KeyError if the work is
        none of this engine's, or its result is here already.
        """
        bridge = self._of_bridge[work.data.realm, work.data.bridge.id]
        if all(one.work.number != work.number for one in bridge.under_way):
            raise KeyError(f"{work.crossing_id} is not under way")
        bridge.results[work.number] = result
        while bridge.under_way and bridge.under_way[0].work.number in bridge.results:
            first = bridge.under_way.popleft()
            yield from self._result_told(bridge, first, bridge.results.pop(first.work.number))

    def _result_told(
        self, bridge: BridgeCrossings, found: UnderWay, result: Crossing
    ) -> Iterator[Output | Fuse]:
        realm, name = found.work.data.realm, found.work.data.bridge.id
        result = against(result, self._fusing.baselines.get(name))
        if found.work.certificate is not None:
            result = result.model_copy(update={"certificate": found.work.certificate})
        counts = usable(result)
        if counts is not None:
            bridge.counted = count_in(bridge.counted, [counts])
        # A result is dated by the data that made it: the engine has no clock.
        header = self._header._replace(created=result.exit_time)
        estimate = crossing_to_protobuf(result, header)
        payload = estimate.SerializeToString(deterministic=True)
        yield Output(Key(realm, "bridge", name, "estimate"), payload, result)
        yield found.done
        if counts is not None and self._tells_states:
            yield self._fuse((realm, name), result.exit_time)

    def fused(self, fuse: Fuse, state: BridgeResult | None) -> Iterator[Output]:
        """Take the state of a bridge, None if its crossings could not be fused; yield its message.

        None is a warning, and the state is owed: the next one of the bridge holds the same
        crossings, and so does the first one of the next run.
        """
        if state is None:
            _log.warning(
                "%s: its crossings could not be fused; its state is told after the next one, or by "
                "the next run",
                fuse.bridge,
            )
            return
        self._bridge(fuse.realm, fuse.bridge).state = state
        yield state_output(fuse.realm, fuse.bridge, fuse.exit_time, state)

    def fuse_all(self) -> Iterator[Fuse]:
        """What is to be fused of all bridges, for who has had no states on the way."""
        for name, bridge in self._of_bridge.items():
            if bridge.counted.newest:
                yield self._fuse(name, bridge.counted.newest[-1].exit_time)

    def _states_owed(self, crossings: Iterable[Known]) -> Iterator[Fuse]:
        """What is to be fused of bridges whose latest state does not count one of the crossings."""
        owed: dict[_Name, float] = {}
        for known in crossings:
            if known.usable is not None and not known.is_in_state:
                name = (known.realm, known.bridge)
                # No state names those that are older.
                listed = self._bridge(*name).counted.newest[-LISTED_AT_MOST:]
                if any(one.crossing_id == known.crossing_id for one in listed):
                    owed[name] = known.usable.exit_time
        for name, exit_time in owed.items():
            yield self._fuse(name, exit_time)

    def _fuse(self, name: _Name, exit_time: float) -> Fuse:
        realm, bridge = name
        baseline = self._fusing.baselines.get(bridge)
        fusing = self._fusing._replace(baselines={} if baseline is None else {bridge: baseline})
        return Fuse(realm, bridge, self._bridge(realm, bridge).counted, fusing, exit_time)

    def _window(self, truck: TruckBoot, bridge: Bridge, stay: Stay) -> Window:
        return window(stay, bridge, truck.vehicle, self._settings.method)

    def _may_still_come(self, truck: TruckBoot, bridge: Bridge, stay: Stay, now_s: float) -> bool:
        """Whether something of a crossing is missing that a little patience may bring."""
        begin_s, end_s = self._window(truck, bridge, stay)
        if now_s < end_s:
            return True
        if not truck.boot.lacks_accel(begin_s - MAX_BATCH_S, end_s):
            return False
        if truck.boot.latest_accel_s() >= end_s + PATIENCE_S:
            return False  # newer ones have come long ago: it is lost
        return now_s < end_s + _SILENCE_S

    def _has_hole(self, truck: TruckBoot, bridge: Bridge, stay: Stay, now_s: float) -> bool:
        """Whether a crossing lacks what is older than something that has come."""
        latest_s = truck.boot.latest_accel_s()
        if latest_s < stay.exit_s:
            return True  # positions have come from behind the bridge
        begin_s, end_s = self._window(truck, bridge, stay)
        end_s = min(end_s, latest_s - _ROUNDING_S)
        return truck.boot.lacks_accel(begin_s - MAX_BATCH_S, end_s)

    def _identity(
        self, realm: str, truck: TruckBoot, bridge: Bridge, stay: Stay
    ) -> tuple[str, bool]:
        """The id of a stay: the same although its entry moves a little with every new fix."""
        for (known_bridge, entry_s), crossing_id in truck.detected.items():
            if known_bridge == bridge.id and abs(entry_s - stay.entry_s) < MERGE_S:
                return crossing_id, False
        for known_bridge, begin_s, end_s, crossing_id in truck.decided:
            # Fixes that came after all may move an entry far, but not to before the fixes that
            # were known, and nobody is on a bridge twice at once.
            if known_bridge == bridge.id and overlap(begin_s, end_s, stay.entry_s, stay.exit_s):
                return crossing_id, False
        wall_ns = truck.boot.wall_time_ns(stay.entry_s)
        for known in self._known.get((realm, truck.vehicle.id, bridge.id), ()):
            if is_stay_of(known, stay, wall_ns):
                truck.detected[bridge.id, stay.entry_s] = known.crossing_id
                truck.said[known.crossing_id] = known.states
                if known.is_identified or known.is_taken:
                    truck.done.add(known.crossing_id)
                return known.crossing_id, True
        moment = datetime.fromtimestamp(wall_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3]
        crossing_id = f"{truck.vehicle.id}.{bridge.id}.{moment}Z"
        truck.detected[bridge.id, stay.entry_s] = crossing_id
        return crossing_id, True

    def _data(
        self, realm: str, truck: TruckBoot, bridge: Bridge, stay: Stay, crossing_id: str
    ) -> CrossingData:
        frame = self._bridges.frame(self._bridges.number[bridge.id])
        fixes = truck.boot.fixes()
        chainage, _ = to_chainage(frame, fixes.latitude_deg, fixes.longitude_deg)
        entry_ns = round(stay.entry_s * 1e9)
        wall_offset_s = (truck.boot.wall_time_ns(stay.entry_s) - entry_ns) / 1e9
        return CrossingData(
            crossing_id,
            realm,
            truck.vehicle,
            bridge,
            middle_sensor(self._site.sensor, truck.vehicle),
            self._site.receiver,
            stay,
            fixes,
            chainage,
            truck.boot.samples(*self._window(truck, bridge, stay), truck.vehicle.channels),
            wall_offset_s,
            self._against(realm, truck, bridge, stay, crossing_id),
        )

    def _against(
        self, realm: str, truck: TruckBoot, bridge: Bridge, stay: Stay, crossing_id: str
    ) -> tuple[Reason, ...]:
        """What is known against a crossing that its own signals do not tell."""
        reasons = []
        for name, said, known in truck.differences[:1]:
            _log.warning(
                "%s: the truck says that its %s is %g, the site file %g",
                *(crossing_id, name, said, known),
            )
            reasons.append(Reason.VEHICLE_DIFFERS_FROM_SITE)
        wall_ns = truck.boot.wall_time_ns
        others = self._traffic.others(
            realm, bridge.id, truck.vehicle.id, wall_ns(stay.entry_s), wall_ns(stay.exit_s)
        )
        if others:
            _log.warning("%s: %s was on the bridge as well", crossing_id, ", ".join(others))
            reasons.append(Reason.OTHER_TRUCK_ON_BRIDGE)
        return tuple(reasons)

    def _bridge(self, realm: str, bridge: str) -> BridgeCrossings:
        return self._of_bridge.setdefault((realm, bridge), BridgeCrossings())

    def bridges(self) -> dict[str, BridgeResult]:
        """The latest state of every bridge that has one, for the results file."""
        states = {name: bridge.state for (_, name), bridge in self._of_bridge.items()}
        return {name: state for name, state in states.items() if state is not None}


def _pair(work: Work) -> Pair:
    return Pair(work.data.vehicle.id, work.data.bridge.id)


def _fixes_around(truck: TruckBoot, stay: Stay) -> tuple[float, float]:
    """The time of the last fix before a stay and of the first one behind it."""
    time_s = truck.boot.fixes().time_s
    first = int(np.searchsorted(time_s, stay.entry_s, "right")) - 1
    last = int(np.searchsorted(time_s, stay.exit_s, "left"))
    return float(time_s[max(first, 0)]), float(time_s[min(last, time_s.size - 1)])
