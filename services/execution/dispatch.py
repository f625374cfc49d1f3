"""Connection of the engine, which requests identifications and fusions, with an executor.

The engine's messages keep their order. A crossing is submitted to a `CrossingExecutor`, and the
engine's messages about its result follow when it is received, as they do for fusions.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, Protocol

from schemas.reasons import Reason
from schemas.results import BridgeResult, CrossingResult
from schemas.validation_records import VehicleBridgePair
from services.identification.engine import Engine
from services.identification.outputs import (
    EngineOutput,
    FusionTask,
    IdentificationTask,
    Output,
    ValidationRequest,
)
from services.identification.result_parts import CrossingTimes, rejected

_POLL_S = 0.1
"""Longest uninterrupted wait in s: Python handles signals between two waits."""


class TaskResult(NamedTuple):
    """A crossing with its result."""

    task: IdentificationTask
    result: CrossingResult


class FusionResult(NamedTuple):
    """A fusion with the bridge's state; None if it failed."""

    fuse: FusionTask
    state: BridgeResult | None


class RunningCrossing(NamedTuple):
    """A crossing whose identification runs."""

    crossing_id: str
    seconds: float
    """Time in s since this attempt started."""


class CrossingExecutor(Protocol):
    """Interface of executors, which identify and fuse crossings. To be used from one thread."""

    @property
    def is_busy(self) -> bool:
        """Whether a result or a state is still to be collected."""

    @property
    def is_full(self) -> bool:
        """Whether results should be collected before more crossings are submitted."""

    @property
    def has_room(self) -> bool:
        """Whether one more crossing would not make it full."""

    @property
    def is_idle(self) -> bool:
        """Whether a crossing submitted now starts at once, or after a background task."""

    @property
    def waiting(self) -> int:
        """Number of crossings submitted and not started."""

    @property
    def running(self) -> list[RunningCrossing]:
        """Running crossings in the order of their start."""

    def submit(self, task: IdentificationTask) -> None:
        """Submit a crossing; it is identified now, later or elsewhere."""

    def collect(self, timeout_s: float = 0.0) -> list[TaskResult]:
        """Return the crossings identified since the last call, each once, in any order.

        Without one it waits until there is one, or for `timeout_s`.
        """

    def submit_fusion(self, fuse: FusionTask) -> None:
        """Submit a fusion, in place of an older one of the same bridge that still waits."""

    def collect_fusions(self) -> list[FusionResult]:
        """Return the states computed since the last call, those of a bridge in their order.

        `collect` drives fusions too, and also returns as soon as there is a state.
        """


def dispatch(
    engine: Engine,
    execution: CrossingExecutor,
    reported: Iterable[EngineOutput],
    want: Callable[[VehicleBridgePair], None] = lambda pair: None,
) -> Iterator[Output]:
    """Yield the engine's messages, its tasks executed, and those that results lead to meanwhile.

    `want` is called with the pairs whose site validation is requested.
    """
    for one in reported:
        if isinstance(one, Output):
            yield one
            continue
        if isinstance(one, ValidationRequest):
            want(one.pair)
            continue
        if isinstance(one, FusionTask):
            execution.submit_fusion(one)
            yield from collect(engine, execution)
            continue
        execution.submit(one)
        yield from collect(engine, execution)
        while execution.is_full:
            yield from collect(engine, execution, _POLL_S)


def collect(
    engine: Engine, execution: CrossingExecutor, timeout_s: float = 0.0
) -> Iterator[Output]:
    """Yield the engine's messages about the results and states that are available."""
    for task, result in execution.collect(timeout_s):
        yield from dispatch(engine, execution, engine.done(task, result))
    for fuse, state in execution.collect_fusions():
        yield from engine.fused(fuse, state)


def drain(engine: Engine, execution: CrossingExecutor) -> Iterator[Output]:
    """Yield the engine's messages about everything that is still identified or fused."""
    while execution.is_busy:
        yield from collect(engine, execution, _POLL_S)


def failed_result(task: IdentificationTask) -> CrossingResult:
    """Return the result of a crossing whose identification failed unexpectedly."""
    data = task.data
    stay, way_m = data.stay, data.bridge.span_m + data.vehicle.length_m
    speed_m_per_s = way_m / (stay.exit_s - stay.entry_s) if stay.exit_s > stay.entry_s else 0.0
    passing = CrossingTimes(stay.entry_s, stay.exit_s, speed_m_per_s)
    return rejected(data, task.settings, passing, [Reason.FAILED])
