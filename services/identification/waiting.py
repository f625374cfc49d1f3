"""Complete crossings that wait for a site validation or a free process."""

import logging
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator
from types import MappingProxyType
from typing import NamedTuple

from schemas.proto import driveby_pb2 as pb
from schemas.validation_records import ValidationHashes, VehicleBridgePair
from services.finding.crossing_data import Complete, CrossingData
from services.identification.outputs import (
    IdentificationTask,
    Output,
    ValidationRequest,
    crossing_output,
)

_log = logging.getLogger(__name__)
MAX_WAITING_CROSSINGS = 100
"""Maximum number of waiting crossings: half a megabyte each, or more."""


class Validations(NamedTuple):
    """The site validations known at the start."""

    hashes: ValidationHashes = MappingProxyType({})
    """Hashes of the known validation records; results name them."""
    are_required: bool = False
    """Whether a crossing of a pair without a validation record waits for one."""


NO_VALIDATIONS = Validations()


class PendingCrossing(NamedTuple):
    """A complete crossing, with the messages about its identification."""

    task: IdentificationTask
    identifying: Output | None
    """Message at the start of its identification; None if an earlier run has published it."""
    done: Output
    """Message with its result: the truck's clock may have been forgotten by then."""

    @property
    def pair(self) -> VehicleBridgePair:
        """Truck and bridge."""
        return VehicleBridgePair(self.task.data.vehicle.id, self.task.data.bridge.id)


def pending_of(
    one: Complete, task: IdentificationTask, reported: Collection[pb.CrossingState]
) -> PendingCrossing:
    """Return a crossing with its messages, less those that have been `reported`."""
    found = one.detection

    def output(state: pb.CrossingState) -> Output:
        return crossing_output(found, state, found.exit_ns)

    identifying = None if pb.IDENTIFYING in reported else output(pb.IDENTIFYING)
    return PendingCrossing(task, identifying, output(pb.DONE))


class CrossingFromRecording(NamedTuple):
    """A complete crossing from a recording."""

    messages: tuple[Output, ...]
    """Messages of its detection and completion that earlier runs have not published."""
    pending: PendingCrossing
    entry_ns: int
    """Entry in ns since 1970 UTC."""
    exit_ns: int


class WaitingCrossings:
    """Crossings that wait, in the order of detection; at most `MAX_WAITING_CROSSINGS`.

    Parameters
    ----------
    validations
        Known validation records, and whether they are required.
    has_room
        Whether a crossing would be started soon. Otherwise those of recorded trucks wait too, so
        that the caller is not delayed.
    """

    def __init__(self, validations: Validations, *, has_room: Callable[[], bool]) -> None:
        self._certificates = dict(validations.hashes)
        self._are_required = validations.are_required
        self._has_room = has_room
        self._recorded: frozenset[str] = frozenset()
        self._wanted: set[VehicleBridgePair] = set()
        self._pending: deque[PendingCrossing] = deque()

    def retarget(
        self,
        certificates: ValidationHashes,
        retargeted: Callable[[CrossingData], CrossingData | None],
    ) -> Iterator[ValidationRequest]:
        """Continue with the data and records of another site file; yield validation requests."""
        self._certificates = dict(certificates)
        self._wanted.clear()
        self._pending = deque(
            one._replace(task=one.task._replace(data=data))
            for one in self._pending
            if (data := retargeted(one.task.data)) is not None
        )
        for pair in self.by_pair():
            if not self.is_certified(pair):
                self._wanted.add(pair)
                yield ValidationRequest(pair)

    def note_recorded(self, vehicles: Collection[str]) -> None:
        """Record which trucks a logger records: nothing is lost where their crossings wait."""
        self._recorded = frozenset(vehicles)

    def is_certified(self, pair: VehicleBridgePair) -> bool:
        """Return whether the crossings of a pair may be identified."""
        return not self._are_required or pair in self._certificates

    def certify(self, pair: VehicleBridgePair, certificate: str) -> None:
        """Accept the hash of a pair's passed validation record."""
        self._certificates[pair] = certificate

    def certified(self, task: IdentificationTask) -> IdentificationTask:
        """Return a task with the validation record of its pair, where there is one."""
        pair = VehicleBridgePair(task.data.vehicle.id, task.data.bridge.id)
        return task._replace(certificate=self._certificates.get(pair))

    def must_wait(self, pair: VehicleBridgePair) -> bool:
        """Return whether a crossing that is complete now has to wait."""
        for_room = pair.vehicle in self._recorded and not self._has_room()
        return not self.is_certified(pair) or for_room or pair in self.by_pair()

    def keep(self, pending: PendingCrossing) -> Iterator[ValidationRequest]:
        """Add a crossing; yield the validation request for its pair, once for a pair."""
        self._pending.append(pending)
        if len(self._pending) > MAX_WAITING_CROSSINGS:
            _log.warning(
                "too many crossings wait; dropping %s: it is identified later from the logger's "
                "recording, or by `driveby identify`",
                self._pending.popleft().task.crossing_id,
            )
        if not self.is_certified(pending.pair) and pending.pair not in self._wanted:
            self._wanted.add(pending.pair)
            yield ValidationRequest(pending.pair)

    def by_pair(self) -> dict[VehicleBridgePair, list[str]]:
        """Return the ids of the crossings by pair, in the order of detection."""
        found: dict[VehicleBridgePair, list[str]] = {}
        for one in self._pending:
            found.setdefault(one.pair, []).append(one.task.crossing_id)
        return found

    def pairs(self) -> list[VehicleBridgePair]:
        """Return the pairs by number of waiting crossings, descending; then the latest first."""
        count: Counter[VehicleBridgePair] = Counter()
        latest: dict[VehicleBridgePair, int] = {}
        for number, one in enumerate(self._pending):
            count[one.pair] += 1
            latest[one.pair] = number
        return sorted(count, key=lambda pair: (-count[pair], -latest[pair]))

    @property
    def has_released(self) -> bool:
        """Whether a crossing may continue."""
        return any(self.is_certified(one.pair) for one in self._pending)

    def release(self) -> PendingCrossing | None:
        """Return and remove the first crossing that may continue, if there is one."""
        for place, one in enumerate(self._pending):
            if self.is_certified(one.pair):
                del self._pending[place]
                return one
        return None
