"""Identification within this process, each crossing as soon as it is detected."""

import time
from collections.abc import Callable
from functools import partial

from schemas.results import CrossingResult
from services.execution.dispatch import FusionResult, RunningCrossing, TaskResult
from services.identification.bridge_state import state_of
from services.identification.identify import Identify, Keep, identify
from services.identification.outputs import FusionTask, IdentificationTask

Report = Callable[[str, str, float], None]
"""Callback for progress: a crossing's id, the stage of its identification, the fraction done."""


class InlineExecutor:
    """The executor within the calling process, which waits for each result.

    `report` is called with the progress of an identification, `keep` with its draws. `stopwatch`
    measures its seconds, the only value that may differ between two runs. A caller that needs more
    than a crossing's result wraps `identify`.
    """

    def __init__(
        self,
        *,
        report: Report = lambda crossing_id, stage, fraction: None,
        keep: Keep = lambda crossing_id, draws: None,
        stopwatch: Callable[[], float] = time.perf_counter,
        identify: Identify = identify,
    ) -> None:
        self._report = report
        self._keep = keep
        self._stopwatch = stopwatch
        self._identify = identify
        self._finished: list[TaskResult] = []
        self._fused: list[FusionResult] = []

    @property
    def is_busy(self) -> bool:
        """Whether a result or a state is still to be collected."""
        return bool(self._finished or self._fused)

    @property
    def is_full(self) -> bool:
        """Always false: a submitted crossing is identified at once."""
        return False

    @property
    def has_room(self) -> bool:
        """Always true."""
        return True

    @property
    def is_idle(self) -> bool:
        """Always true."""
        return True

    @property
    def waiting(self) -> int:
        """Always 0."""
        return 0

    @property
    def running(self) -> list[RunningCrossing]:
        """Always an empty list: no crossing runs between two calls."""
        return []

    def submit(self, task: IdentificationTask) -> None:
        """Identify the crossing. Raise what `identify` raises."""
        self._finished.append(TaskResult(task, self._result(task)))

    def collect(self, timeout_s: float = 0.0) -> list[TaskResult]:
        """Return the results since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def submit_fusion(self, fuse: FusionTask) -> None:
        """Fuse the crossings. Raise what `state_of` raises."""
        self._fused.append(FusionResult(fuse, state_of(fuse.counted, fuse.bridge, fuse.fusing)))

    def collect_fusions(self) -> list[FusionResult]:
        """Return the states computed since the last call."""
        fused, self._fused = self._fused, []
        return fused

    def _result(self, task: IdentificationTask) -> CrossingResult:
        return self._identify(
            task.data,
            task.settings,
            stopwatch=self._stopwatch,
            report=partial(self._report, task.crossing_id),
            keep=self._keep,
        )
