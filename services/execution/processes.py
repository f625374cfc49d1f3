"""Identification and fusion in processes of their own, so that the caller can listen meanwhile.

Every process is warm (its kernels are loaded before its first crossing) and works on one crossing
at a time. If it dies, for lack of memory or in a library, its crossing is tried once more in a new
process and then rejected as `failed`: no crossing can end the caller, nor another crossing. A hung
process (`hang_watchdog`), at its work or during its start, is killed, so it dies as well.

Fusions come before identifications: the state of a bridge is due when its result is published, and
takes a second. Of one bridge only the newest set waits, and while one is being fused the next waits
for it. So states keep their order, and a bridge with many results occupies one slot at most. A
fusion whose process dies twice gives no state.

Background tasks run in the same processes while no crossing waits for one, so a crossing waits for
one of them at most. The processes are spawned: the threads of numba and OpenBLAS would not survive
a fork. Signals are handled by the process that started them; they end with it, however it ends.
"""

import contextlib
import logging
import math
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from multiprocessing import active_children, get_context
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from schemas.results import BridgeResult, CrossingResult
from services.common.child_process import group_signals_blocked, ignore_group_signals
from services.common.errors import FailureError
from services.execution.dispatch import FusionResult, RunningCrossing, TaskResult, failed_result
from services.execution.hang_watchdog import HangWatchdog, TaskLimits
from services.execution.inline import InlineExecutor, Report
from services.execution.warm_up import warm_up
from services.identification.bridge_state import FusionSettings, RecentCrossings, state_of
from services.identification.identify import Identify, identify
from services.identification.outputs import FusionTask, IdentificationTask

_log = logging.getLogger(__name__)
_SPAWN = get_context("spawn")
_STARTING = threading.Lock()
"""Lock of process starts: a new process is recognised as the one that was absent before."""
_TRIES = 2
"""Attempts per task: another program may exhaust the memory once; twice is no accident."""
_WAITING_PER_PROCESS = 2
"""Queued crossings per process: they are finished after a signal, within a minute."""
_USUAL = TaskLimits()
_CHECK_EVERY_S = 0.5
"""Interval in s at which a process is checked for a hang."""
_LONGEST_END_S = 5.0
"""Longest wait in s for the end of a process, which a running kernel may delay."""


class BackgroundTask(NamedTuple):
    """A task for times when no crossing waits; picklable: a module's function, applied."""

    name: str
    run: Callable[[], object]


class BackgroundResult(NamedTuple):
    """A background task with its outcome; None if it raised or its process died twice."""

    task: BackgroundTask
    outcome: object | None


StateOf = Callable[[RecentCrossings, str, FusionSettings], BridgeResult | None]
"""Type of `bridge_state.state_of`."""
_Task = IdentificationTask | FusionTask | BackgroundTask
_BridgeName = tuple[str, str]
"""Realm and bridge."""


class _ProcessSetup(NamedTuple):
    """The functions of a process, and its preparation."""

    identify: Identify
    state_of: StateOf
    prepare: Callable[[], None]


class _Job(NamedTuple):
    task: _Task
    tries: int = 0

    @property
    def name(self) -> str:
        match self.task:
            case IdentificationTask():
                return self.task.crossing_id
            case FusionTask():
                return f"the state of {self.task.bridge}"
            case BackgroundTask():
                return self.task.name


class ProcessExecutor:
    """The executor in `number` processes; it may call `report` from another thread.

    Each process takes its share of the settings' `threads`, at least one. Draws are not kept. A
    process that exceeds the `limits` for a task is killed. To be closed, or used as a context
    manager: running tasks are then given up.
    """

    def __init__(
        self,
        number: int,
        *,
        report: Report = lambda crossing_id, stage, fraction: None,
        identify: Identify = identify,
        state_of: StateOf = state_of,
        prepare: Callable[[], None] = warm_up,
        limits: TaskLimits = _USUAL,
    ) -> None:
        # Read when a process loads numpy: its threads would compete with those of its neighbours.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        self._report = report
        begin = _ProcessSetup(identify, state_of, prepare)
        self._slots = [_Slot(report, begin, limits) for _ in range(number)]
        self._waiting: deque[_Job] = deque()
        self._finished: list[TaskResult] = []
        self._to_fuse: dict[_BridgeName, _Job] = {}
        """The newest fusion of each bridge, in the order of submission."""
        self._fused: list[FusionResult] = []
        self._background: deque[_Job] = deque()
        self._background_results: list[BackgroundResult] = []

    def wait_until_warm(self) -> None:
        """Wait until all processes are ready. Raise FailureError if one dies or hangs."""
        try:
            for slot in self._slots:
                while not wait([slot.is_warm], _CHECK_EVERY_S).done:
                    slot.end_if_hung()
                slot.is_warm.result()
        except BrokenExecutor as error:
            raise FailureError(
                "a process for identifications died while it was started, see the log"
            ) from error

    @property
    def is_busy(self) -> bool:
        """Whether a result or a state is still to be collected."""
        waiting = self._waiting or self._to_fuse
        return bool(waiting or self._finished or self._fused or self._in_use)

    @property
    def is_full(self) -> bool:
        """Whether enough crossings wait for a process."""
        return len(self._waiting) >= _WAITING_PER_PROCESS * len(self._slots)

    @property
    def has_room(self) -> bool:
        """Whether one more crossing would not make it full."""
        return len(self._waiting) + 1 < _WAITING_PER_PROCESS * len(self._slots)

    @property
    def is_idle(self) -> bool:
        """Whether a crossing submitted now starts at once, or after a background task."""
        return not self._waiting and len(self._in_use) < len(self._slots)

    @property
    def waiting(self) -> int:
        """Number of crossings that wait for a process."""
        return len(self._waiting)

    @property
    def running(self) -> list[RunningCrossing]:
        """Running crossings in the order of their start."""
        now_s = time.monotonic()
        found = [
            RunningCrossing(slot.job.name, now_s - slot.began_s)
            for slot in self._slots
            if slot.job and isinstance(slot.job.task, IdentificationTask)
        ]
        return sorted(found, key=lambda one: -one.seconds)

    def submit(self, task: IdentificationTask) -> None:
        """Pass a crossing to a process, as soon as one is free."""
        self._waiting.append(_Job(task))
        self._fill()
        if self._waiting:
            self._report(task.crossing_id, "waiting for a process", 0.0)

    def collect(self, timeout_s: float = 0.0) -> list[TaskResult]:
        """Return the crossings identified since the last call; see `CrossingExecutor`."""
        self._fill()
        running = [slot.future for slot in self._slots if slot.future is not None]
        if running and timeout_s > 0.0:  # called after every message: must cost nothing
            wait(running, timeout_s, FIRST_COMPLETED)
        for slot in self._slots:
            if slot.future is not None and slot.future.done():
                self._collect_result(slot, slot.future)
            elif slot.job is not None:
                slot.end_if_hung()
        finished, self._finished = self._finished, []
        if not finished:  # otherwise the states that the results lead to come first
            self._fill()
        return finished

    def submit_fusion(self, fuse: FusionTask) -> None:
        """Pass a fusion to the next free process; see `CrossingExecutor`."""
        self._to_fuse[_bridge_of(fuse)] = _Job(fuse)
        self._fill()

    def collect_fusions(self) -> list[FusionResult]:
        """Return the states computed since the last call; see `CrossingExecutor`."""
        self._fill()
        fused, self._fused = self._fused, []
        return fused

    def submit_background(self, task: BackgroundTask) -> None:
        """Compute a task in a process that no crossing waits for."""
        self._background.append(_Job(task))
        self._fill()

    @property
    def wants_background(self) -> bool:
        """Whether a process may be free for one more background task."""
        begun = sum(1 for p in self._slots if p.job and isinstance(p.job.task, BackgroundTask))
        return len(self._background) + begun < len(self._slots)

    def collect_background(self) -> list[BackgroundResult]:
        """Return the background tasks finished since the last call; `collect` drives them."""
        self._fill()
        collect_background, self._background_results = self._background_results, []
        return collect_background

    def cancel_background(self) -> None:
        """Remove the background tasks that still wait."""
        self._background.clear()

    def close(self) -> None:
        """End the processes, whatever they compute."""
        for slot in self._slots:
            slot.close()

    def __enter__(self) -> "ProcessExecutor":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _in_use(self) -> list["_Slot"]:
        """Slots that work on something other than a background task."""
        return [p for p in self._slots if p.job and not isinstance(p.job.task, BackgroundTask)]

    def _fill(self) -> None:
        for slot in self._slots:
            job = self._next() if slot.job is None else None
            if job is not None:
                slot.begin(job, len(self._slots))

    def _next(self) -> _Job | None:
        running = {
            _bridge_of(slot.job.task)
            for slot in self._slots
            if slot.job and isinstance(slot.job.task, FusionTask)
        }
        for name in self._to_fuse:
            if name not in running:
                return self._to_fuse.pop(name)
        first = self._waiting or self._background
        return first.popleft() if first else None

    def _collect_result(self, slot: "_Slot", future: Future[Any]) -> None:
        job = slot.job
        assert job is not None  # noqa: S101 - it has a future
        slot.job = slot.future = None
        try:
            self._is_over(job.task, future.result())
        except BrokenExecutor:
            slot.renew()
            if job.tries + 1 < _TRIES:
                _log.warning("the process that worked on %s died; retrying once", job.name)
                self._put_back(_Job(job.task, job.tries + 1))
            else:
                _log.error("the process that worked on %s died again; giving up", job.name)
                self._is_over(job.task, None)
        except Exception:  # whatever it is, another process would fail alike
            _log.exception("%s failed", job.name)
            self._is_over(job.task, None)

    def _put_back(self, job: _Job) -> None:
        """Put a job first in its queue; a fusion only if no newer one has been submitted."""
        match job.task:
            case IdentificationTask():
                self._waiting.appendleft(job)
            case FusionTask():
                self._to_fuse = {_bridge_of(job.task): job} | self._to_fuse
            case BackgroundTask():
                self._background.appendleft(job)

    def _is_over(self, task: _Task, outcome: Any) -> None:
        """Store the outcome of a task; None if it failed."""
        match task:
            case IdentificationTask():
                result = failed_result(task) if outcome is None else outcome
                self._finished.append(TaskResult(task, result))
            case FusionTask():
                self._fused.append(FusionResult(task, outcome))
            case BackgroundTask():
                self._background_results.append(BackgroundResult(task, outcome))


def _bridge_of(fuse: FusionTask) -> _BridgeName:
    return fuse.realm, fuse.bridge


class _Slot:
    """A slot for one process after the other, and for its task."""

    def __init__(self, report: Report, begin: _ProcessSetup, limits: TaskLimits) -> None:
        self._report = report
        self._begin = begin
        self._limits = limits
        self._watchdog: HangWatchdog | None = None
        self.began_s = 0.0
        """Time at which the job was passed to the process."""
        self.job: _Job | None = None
        self.future: Future[Any] | None = None
        self._open()

    def begin(self, job: _Job, slots: int) -> None:
        """Start a job; a crossing gets the share of its threads that one of `slots` slots has."""
        self.job = job
        self._watchdog = None
        self._next_check_s = 0.0
        self.began_s = time.monotonic()
        task = job.task
        try:
            if isinstance(task, BackgroundTask):
                self.future = self._executor.submit(task.run)
            elif isinstance(task, FusionTask):
                threads = max(1, task.fusing.threads // slots)
                made_of = (task.counted, task.bridge, task.fusing._replace(threads=threads))
                self.future = self._executor.submit(self._begin.state_of, *made_of)
            else:
                threads = max(1, task.settings.threads // slots)
                settings = task.settings.model_copy(update={"threads": threads})
                self.future = self._executor.submit(_identified, task._replace(settings=settings))
        except BrokenExecutor as error:  # it died while idle
            self.future = Future()
            self.future.set_exception(error)

    def end_if_hung(self) -> None:
        """Kill the process if it exceeds the limits for its job or its start.

        Its job then counts as one whose process died.
        """
        now_s = time.monotonic()
        if now_s < self._next_check_s:
            return
        self._next_check_s = now_s + _CHECK_EVERY_S
        starts = self.job is None or not self.is_warm.done()
        if self._watchdog is None or starts != self._watchdog.starts:
            self._watchdog = HangWatchdog(self._pid, self._limits, now_s, starts=starts)
        why = self._watchdog.why_hung(now_s)
        if why:
            self._next_check_s = math.inf
            what = "is being started" if starts else f"works on {self.job and self.job.name}"
            _log.warning("the process that %s %s; ending it", what, why)
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGKILL)

    def renew(self) -> None:
        """Start a new process in place of a dead one."""
        self.close()
        self._open()

    def close(self) -> None:
        """End the process: it exits when the other end of its lifeline is closed."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        self._lifeline.close()
        self._send.close()
        # A thread that is still publishing when the interpreter ends would abort the process.
        self._reader.join(_LONGEST_END_S)
        if self._reader.is_alive():  # it is frozen, and the caller would wait for its end
            self._process.kill()
            self._reader.join(_LONGEST_END_S)

    def _open(self) -> None:
        receive, self._send = _SPAWN.Pipe(duplex=False)
        its_end, self._lifeline = _SPAWN.Pipe(duplex=False)
        given = (its_end, self._send, self._begin)
        with _STARTING, group_signals_blocked():
            self._executor = ProcessPoolExecutor(1, _SPAWN, _prepare, given)
            others = set(active_children())
            self.is_warm = self._executor.submit(os.getpid)  # which starts the process
            (self._process,) = set(active_children()) - others
        assert self._process.pid is not None  # noqa: S101 - it was started
        self._pid = self._process.pid
        self._watchdog, self._next_check_s = None, 0.0
        its_end.close()
        self._reader = threading.Thread(
            target=self._read, args=(receive,), name="progress", daemon=True
        )
        self._reader.start()

    def _read(self, receive: "Connection") -> None:
        """Forward the progress of identifications, until the process and this slot have ended."""
        with receive:
            while True:
                try:
                    progress = receive.recv()
                except (EOFError, OSError):
                    return
                try:
                    self._report(*progress)
                except Exception as error:  # progress may be lost, the result is not
                    _log.debug("cannot report progress: %s", error)


# In the process itself


_HERE: list[InlineExecutor] = []
"""The process's own executor, once it is prepared."""


def _prepare(lifeline: Connection, send: Connection, begin: _ProcessSetup) -> None:
    ignore_group_signals()
    threading.Thread(target=_end_with, args=(lifeline,), name="lifeline", daemon=True).start()
    _HERE.append(
        InlineExecutor(report=lambda *progress: send.send(progress), identify=begin.identify)
    )
    begin.prepare()


def _end_with(lifeline: Connection) -> None:
    """Exit at once when the other end is closed, or its owner is dead."""
    try:
        lifeline.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)


def _identified(task: IdentificationTask) -> CrossingResult:
    (here,) = _HERE
    here.submit(task)
    (finished,) = here.collect()
    return finished.result
