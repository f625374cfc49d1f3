"""Decisions of the worker: messages in, messages out.

Crossings in the messages are detected, named, queued, identified and fused, and the messages to
publish are yielded. The engine opens nothing, reads no clock and makes no request, so that
replaying a recording through it gives the same bytes every time.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping

from schemas.proto import driveby_pb2 as pb
from schemas.reasons import Reason
from schemas.results import BridgeResult, CrossingResult, ResultHeader
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.topics import Key
from schemas.validation_records import ValidationHashes, VehicleBridgePair
from services.finding.crossing_data import Complete
from services.finding.finder import Finder, Found
from services.identification.bridge_state import NOTHING_STORED, FusionSettings
from services.identification.bridge_states import BridgeStates
from services.identification.known import CrossingRecord
from services.identification.methods import window_of
from services.identification.names import ReportedCrossings
from services.identification.outputs import (
    EngineOutput,
    FusionTask,
    IdentificationTask,
    Output,
    ValidationRequest,
    crossing_output,
)
from services.identification.waiting import (
    NO_VALIDATIONS,
    CrossingFromRecording,
    PendingCrossing,
    Validations,
    WaitingCrossings,
    pending_of,
)

_log = logging.getLogger(__name__)


class Engine:
    """Identification of the crossings of a realm's trucks, as messages to publish.

    The engine identifies nothing itself: it yields a task for each crossing, whose result is passed
    to `done`, at any later time and in any order. It does not fuse either: after a result it yields
    a fusion, whose state is passed to `fused`: states of a bridge in their order, and one may be
    skipped for a later one. `services.execution` executes both.

    `header` is the head of every estimate, `fusing` the settings of fusions. Without
    `publishes_states` states are computed at the end only (`fuse_all`).

    `validations` are the known validation records; results name them. If they are required a
    crossing of a pair without one waits: a request is yielded, once for a pair, the record is
    passed to `certify`, and `release` then yields the crossings that waited. While an executor has
    no room, crossings of recorded trucks wait as well (`note_recorded`).
    """

    def __init__(
        self,
        site: Site,
        settings: IdentificationSettings,
        header: ResultHeader,
        fusing: FusionSettings = NOTHING_STORED,
        *,
        validations: Validations = NO_VALIDATIONS,
        publishes_states: bool = True,
        has_room: Callable[[], bool] = lambda: True,
    ) -> None:
        self._settings = settings
        self._names = ReportedCrossings()
        self._finder = Finder(site, window_of(settings.method), self._names.recognise)
        self._waiting = WaitingCrossings(validations, has_room=has_room)
        self._states = BridgeStates(header, fusing, are_published=publishes_states)
        self._last_number = 0
        """Number of tasks up to now."""

    def resume(
        self,
        crossings: Iterable[CrossingRecord],
        states: Mapping[tuple[str, str], BridgeResult] | None = None,
    ) -> Iterator[Output | FusionTask]:
        """Continue from known crossings; yield what earlier runs did not publish.

        To be called before the first message. A crossing with a result by these settings and this
        site file gets no other one, and counts in the states of its bridge; of one without, only
        unpublished states are published. `states` are the latest published ones, by realm and
        bridge.
        """
        crossings = sorted(crossings, key=lambda known: known.entry_ns)
        for known in crossings:
            self._names.add(known)
            if known.has_result and known.last is not None and pb.DONE not in known.states:
                known.last.state = pb.DONE  # everything else is as for its identification
                yield Output(
                    Key(known.realm, "bridge", known.bridge, "crossing"),
                    known.last.SerializeToString(deterministic=True),
                )
        yield from self._states.resume(crossings, states or {})
        for known in crossings:
            known.last = known.usable = None  # they are not needed again, and they are large

    def retarget(
        self,
        site: Site,
        header: ResultHeader,
        fusing: FusionSettings,
        certificates: ValidationHashes,
    ) -> Iterator[ValidationRequest]:
        """Continue with another site file, when no task is running; yield validation requests.

        Decided crossings stay decided. Waiting crossings are identified with truck and bridge of
        the new file; as after a restart the states of bridges start again.
        """
        self._finder.retarget(site)
        self._states.retarget(header, fusing)
        yield from self._waiting.retarget(certificates, self._finder.scene.retargeted)

    def note_recorded(self, until_ns: Mapping[str, int]) -> None:
        """Set the trucks that a logger records, and up to which wall time it did, in ns.

        A crossing whose data begin or end too early here is in a recording, and is left to `take`
        (`Finder.leave_to_recordings`).
        """
        self._finder.leave_to_recordings(until_ns)
        self._waiting.note_recorded(until_ns)

    def expect(self, key: Key, payload: bytes, *, for_ever: bool = False) -> None:
        """Record a truck's position before its message is fed (`Finder.expect`)."""
        self._finder.expect(key, payload, for_ever=for_ever)

    def feed(self, key: Key, payload: bytes) -> Iterator[EngineOutput]:
        """Accept one message of a vehicle that `expect` has received; ignore other streams.

        Raise ValueError, at once, for a malformed message. The consequences come from the iterator,
        as they happen, so that a state can be published before the long task starts.
        """
        return self._publish(self._finder.feed(key, payload))

    def finish(self) -> Iterator[EngineOutput]:
        """Decide all crossings with the present data: no more messages will arrive."""
        return self._publish(self._finder.finish())

    def gone(self, realm: str, vehicle: str, *, for_good: bool = False) -> Iterator[EngineOutput]:
        """Decide the crossings that a silent truck has finished (`Finder.gone`)."""
        return self._publish(self._finder.gone(realm, vehicle, for_good=for_good))

    def has_undecided(self, realm: str, vehicle: str) -> bool:
        """Return whether a truck may have a crossing that is not decided."""
        return self._finder.has_undecided(realm, vehicle)

    def is_tracking(
        self, realm: str, vehicle: str, boot_id: int, bridge: str, entry_s: float
    ) -> bool:
        """Return whether a stay is detected here, from the truck itself (`Finder.is_tracking`)."""
        return self._finder.is_tracking(realm, vehicle, boot_id, bridge, entry_s)

    @property
    def unknown_vehicles(self) -> set[str]:
        """Trucks that the site file lacks; none of their crossings can be identified."""
        return self._finder.unknown_vehicles

    def _publish(self, found: Iterable[Found]) -> Iterator[EngineOutput]:
        for one in found:
            if isinstance(one, Complete):
                yield from self._complete(one)
            elif pb.DETECTED not in self._names.reported(one):
                yield crossing_output(one, pb.DETECTED, one.entry_ns)

    def _complete(self, one: Complete) -> Iterator[EngineOutput]:
        detection, reported = one.detection, self._names.reported(one.detection)
        if pb.COMPLETE not in reported:
            yield crossing_output(detection, pb.COMPLETE, detection.exit_ns)
        pending = pending_of(one, self._work(one), reported)
        if not self._waiting.must_wait(pending.pair):
            yield from self._begun(pending)
            return
        is_certified = self._waiting.is_certified(pending.pair)
        if not is_certified and pb.WAITING_NOT_VALIDATED not in reported:
            yield crossing_output(detection, pb.WAITING_NOT_VALIDATED, detection.exit_ns)
        yield from self._waiting.keep(pending)

    def _work(self, one: Complete) -> IdentificationTask:
        self._last_number += 1
        return IdentificationTask(self._last_number, one.data, self._settings)

    def _begun(self, pending: PendingCrossing) -> Iterator[EngineOutput]:
        if pending.identifying is not None:
            yield pending.identifying
        pending = pending._replace(task=self._waiting.certified(pending.task))
        self._states.begin(pending)
        yield pending.task

    def take(
        self, found: CrossingFromRecording, others: Iterable[str] = ()
    ) -> Iterator[EngineOutput]:
        """Accept a crossing from a recording; `others` were on the bridge, too.

        Messages of the trucks themselves give no second crossing from now on.
        """
        task = found.pending.task
        data, span_ns = task.data, (found.entry_ns, found.exit_ns)
        self._names.take(data, *span_ns)
        self._finder.settle(data.realm, data.vehicle.id, data.crossing_id)
        seen = self._finder.scene.traffic.others(
            data.realm, data.bridge.id, data.vehicle.id, *span_ns
        )
        against = data.against
        if names := sorted({*seen, *others}):
            _log.warning(
                "%s: %s was on the bridge at the same time", task.crossing_id, ", ".join(names)
            )
            against = tuple(dict.fromkeys((*against, Reason.OTHER_TRUCK_ON_BRIDGE)))
        self._last_number += 1
        task = task._replace(number=self._last_number, data=data._replace(against=against))
        yield from found.messages
        yield from self._begun(found.pending._replace(task=task))

    def pending_ids(self) -> set[str]:
        """Return the crossings that are running or wait."""
        waiting = (name for names in self.waiting().values() for name in names)
        return self._states.running_ids().union(waiting)

    def is_certified(self, pair: VehicleBridgePair) -> bool:
        """Return whether the crossings of a pair may be identified."""
        return self._waiting.is_certified(pair)

    def waiting(self) -> dict[VehicleBridgePair, list[str]]:
        """Return the ids of the waiting crossings, by pair, in the order of detection."""
        return self._waiting.by_pair()

    def waiting_pairs(self) -> list[VehicleBridgePair]:
        """Return the pairs with waiting crossings: with most first (`WaitingCrossings.pairs`)."""
        return self._waiting.pairs()

    def certify(self, pair: VehicleBridgePair, certificate: str) -> None:
        """Accept the hash of a pair's passed validation record: `release` its crossings."""
        self._waiting.certify(pair, certificate)

    @property
    def has_released(self) -> bool:
        """Whether a crossing that waited may continue."""
        return self._waiting.has_released

    def release(self) -> Iterator[EngineOutput]:
        """Continue the first waiting crossing that need not wait any longer, if there is one.

        One at a time: the caller receives messages in between.
        """
        released = self._waiting.release()
        if released is not None:
            yield from self._begun(released)

    def done(
        self, task: IdentificationTask, result: CrossingResult
    ) -> Iterator[Output | FusionTask]:
        """Accept the result of a crossing; KeyError if it is not running (`BridgeStates.done`)."""
        return self._states.done(task, result)

    def fused(self, fuse: FusionTask, state: BridgeResult | None) -> Iterator[Output]:
        """Accept the state of a bridge, None if the fusion failed (`BridgeStates.fused`)."""
        return self._states.fused(fuse, state)

    def fuse_all(self) -> Iterator[FusionTask]:
        """Yield the fusions of all bridges, for `publishes_states` False."""
        return self._states.fuse_all()

    def bridges(self) -> dict[str, BridgeResult]:
        """Return the latest state of every bridge that has one, for the results file."""
        return self._states.bridges()
