"""Results in the order of their crossings' detection, and pending states of bridges."""

import logging
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from schemas.results import BridgeResult, CrossingResult, ResultHeader
from schemas.results_on_the_wire import crossing_to_protobuf
from schemas.topics import Key
from services.identification.bridge_state import (
    LISTED_AT_MOST,
    FusionSettings,
    RecentCrossings,
    add_crossings,
    usable,
    with_loss_probability,
)
from services.identification.known import CrossingRecord
from services.identification.outputs import FusionTask, IdentificationTask, Output, state_output
from services.identification.usable import latest_realms
from services.identification.waiting import PendingCrossing

_log = logging.getLogger(__name__)
Name = tuple[str, str]
"""Realm and bridge."""


@dataclass
class _OfBridge:
    """Crossings and state of one bridge in one realm."""

    counted: RecentCrossings = field(default_factory=RecentCrossings)
    running: deque[PendingCrossing] = field(default_factory=deque)
    """Running crossings in the order of detection, in which their results are published."""
    state: BridgeResult | None = None
    """Latest state of the counted crossings."""
    results: dict[int, CrossingResult] = field(default_factory=dict)
    """Results that precede one of an earlier detected crossing, by number of the task."""


class BridgeStates:
    """Crossings under identification by bridge, and the fusion of their results.

    Parameters
    ----------
    header
        Head of every estimate.
    fusing
        Settings of the fusion.
    are_published
        Whether a state is computed after each result; otherwise at the end (`fuse_all`).
    """

    def __init__(
        self, header: ResultHeader, fusing: FusionSettings, *, are_published: bool = True
    ) -> None:
        self._header = header
        self._fusing = fusing
        self._are_published = are_published
        self._of_bridge: dict[Name, _OfBridge] = {}

    def retarget(self, header: ResultHeader, fusing: FusionSettings) -> None:
        """Continue with another site file: the states of bridges start again."""
        self._header, self._fusing = header, fusing
        self._of_bridge.clear()

    def resume(
        self, crossings: Sequence[CrossingRecord], states: Mapping[Name, BridgeResult]
    ) -> Iterator[FusionTask]:
        """Count crossings of earlier runs with their latest `states`; yield pending fusions.

        A fusion is pending for a bridge whose latest state lacks one of the crossings.
        """
        for known in crossings:
            if known.usable is not None:
                bridge = self._at(known.realm, known.bridge)
                bridge.counted = add_crossings(bridge.counted, [known.usable])
        for name, bridge in self._of_bridge.items():
            bridge.state = states.get(name)
        owed: dict[Name, float] = {}
        for known in crossings:
            if known.usable is not None and not known.is_in_state:
                name = (known.realm, known.bridge)
                # A state lists no older crossings.
                listed = self._at(*name).counted.newest[-LISTED_AT_MOST:]
                if any(one.crossing_id == known.crossing_id for one in listed):
                    owed[name] = known.usable.exit_time
        for name, exit_time in owed.items():
            yield self._fuse(name, exit_time)

    def begin(self, pending: PendingCrossing) -> None:
        """Record that a crossing is being identified."""
        data = pending.task.data
        self._at(data.realm, data.bridge.id).running.append(pending)

    def running_ids(self) -> set[str]:
        """Return the running crossings."""
        return {one.task.crossing_id for b in self._of_bridge.values() for one in b.running}

    def done(
        self, task: IdentificationTask, result: CrossingResult
    ) -> Iterator[Output | FusionTask]:
        """Accept the result of a crossing, and yield the messages and fusions that follow.

        Results of one bridge are published in the order of their crossings' detection, whichever
        arrives first: so nothing depends on the duration of an identification. Raise KeyError for a
        task that is not running.
        """
        bridge = self._of_bridge[task.data.realm, task.data.bridge.id]
        if all(one.task.number != task.number for one in bridge.running):
            raise KeyError(f"{task.crossing_id} is not running")
        bridge.results[task.number] = result
        while bridge.running and bridge.running[0].task.number in bridge.results:
            first = bridge.running.popleft()
            yield from self._published(bridge, first, bridge.results.pop(first.task.number))

    def _published(
        self, bridge: _OfBridge, found: PendingCrossing, result: CrossingResult
    ) -> Iterator[Output | FusionTask]:
        realm, name = found.task.data.realm, found.task.data.bridge.id
        result = with_loss_probability(result, self._fusing.baselines.get(name))
        if found.task.certificate is not None:
            result = result.model_copy(update={"certificate": found.task.certificate})
        counts = usable(result)
        if counts is not None:
            bridge.counted = add_crossings(bridge.counted, [counts])
        # A result is dated by its data: there is no clock here.
        header = self._header._replace(created=result.exit_time)
        estimate = crossing_to_protobuf(result, header)
        payload = estimate.SerializeToString(deterministic=True)
        yield Output(Key(realm, "bridge", name, "estimate"), payload, result)
        yield found.done
        if counts is not None and self._are_published:
            yield self._fuse((realm, name), result.exit_time)

    def fused(self, fuse: FusionTask, state: BridgeResult | None) -> Iterator[Output]:
        """Accept the state of a bridge, None if the fusion failed; yield its message.

        None is a warning, and the state stays pending: the next one of the bridge includes the same
        crossings, and so does the first one of the next run.
        """
        if state is None:
            _log.warning(
                "%s: fusing its crossings failed; its state follows after the next crossing or "
                "in the next run",
                fuse.bridge,
            )
            return
        self._at(fuse.realm, fuse.bridge).state = state
        yield state_output(fuse.realm, fuse.bridge, fuse.exit_time, state)

    def fuse_all(self) -> Iterator[FusionTask]:
        """Yield the fusions of all bridges, where states are computed at the end only."""
        for name, bridge in self._of_bridge.items():
            if bridge.counted.newest:
                yield self._fuse(name, bridge.counted.newest[-1].exit_time)

    def bridges(self) -> dict[str, BridgeResult]:
        """Return the latest state of every bridge that has one, for the results file.

        Of a bridge in several realms it is that of the last crossing's realm, with a warning.
        """
        counted = {name: bridge.counted for name, bridge in self._of_bridge.items()}
        latest = latest_realms(counted)
        states = {name: self._at(realm, name).state for name, realm in latest.items()}
        return {name: state for name, state in states.items() if state is not None}

    def _fuse(self, name: Name, exit_time: float) -> FusionTask:
        realm, bridge = name
        baseline = self._fusing.baselines.get(bridge)
        fusing = self._fusing._replace(baselines={} if baseline is None else {bridge: baseline})
        return FusionTask(realm, bridge, self._at(realm, bridge).counted, fusing, exit_time)

    def _at(self, realm: str, bridge: str) -> _OfBridge:
        return self._of_bridge.setdefault((realm, bridge), _OfBridge())
