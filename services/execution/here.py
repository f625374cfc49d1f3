"""Identifies crossings in this process, each as soon as it is found; who calls waits for it."""

import time
from collections.abc import Callable
from functools import partial

from schemas.results import Crossing
from services.execution.dispatch import Begun, Finished, Fused
from services.identification.bridge_state import state_of
from services.identification.identify import Identify, Keep, identify
from services.identification.outputs import Fuse, Work

Report = Callable[[str, str, float], None]
"""Takes a crossing's id, the stage of its identification and the fraction that is done."""


class Here:
    """The `Execution` that has no other place.

    `report` is told how far an identification is, `keep` is given its draws. `stopwatch` measures
    its seconds, the only thing that may differ between two runs. Who wants more of a crossing than
    its result wraps `identify`.
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
        self._finished: list[Finished] = []
        self._fused: list[Fused] = []

    @property
    def is_busy(self) -> bool:
        """Whether something was done that has not been given back."""
        return bool(self._finished or self._fused)

    @property
    def is_full(self) -> bool:
        """Never: what is started is done."""
        return False

    @property
    def has_room(self) -> bool:
        """Always."""
        return True

    @property
    def is_idle(self) -> bool:
        """Always."""
        return True

    @property
    def waiting(self) -> int:
        """None ever does."""
        return 0

    @property
    def under_way(self) -> list[Begun]:
        """None, when somebody can ask."""
        return []

    def start(self, work: Work) -> None:
        """Identify the crossing. Raises what `identify` does."""
        self._finished.append(Finished(work, self._result(work)))

    def finished(self, timeout_s: float = 0.0) -> list[Finished]:
        """What was started since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def fuse(self, fuse: Fuse) -> None:
        """Fuse the crossings. Raises what `state_of` does."""
        self._fused.append(Fused(fuse, state_of(fuse.counted, fuse.bridge, fuse.fusing)))

    def fused(self) -> list[Fused]:
        """What was fused since the last call."""
        fused, self._fused = self._fused, []
        return fused

    def _result(self, work: Work) -> Crossing:
        return self._identify(
            work.data,
            work.settings,
            stopwatch=self._stopwatch,
            report=partial(self._report, work.crossing_id),
            keep=self._keep,
        )
