"""Identifies and fuses crossings in processes of their own, so that who finds them can listen.

Every process is warm (its kernels are loaded before its first crossing) and works on one crossing
at a time. If it dies, for want of memory or in a library, its crossing is tried once more in a new
one and then rejected as `failed`: no crossing can end who asked for it, nor another crossing. One
that is hung (`watch`), at its work or while it is started, is killed, so it dies as well.

Crossings that are to be fused come before those that are to be identified: the state of a bridge
is due when its result is told, and takes a second. Of one bridge only the newest set waits, and
while one is being fused the next waits for it: so states come in their order, and however many
results a bridge has, it takes no more than its place. Who dies twice over it has no state.

What else is to be computed (`Aside`) is computed in the same processes, when no crossing waits for
one: so a crossing waits for one aside at most.

They are spawned: numba's and OpenBLAS's threads would not survive a fork. Signals are for the
process that started them, and they end with it, however it ends.
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

from schemas.results import BridgeResult, Crossing
from services.common.errors import FailureError
from services.execution.dispatch import Begun, Finished, Fused, failed
from services.execution.here import Here, Report
from services.execution.warm_up import warm_up
from services.execution.watch import Limits, Watch
from services.identification.bridge_state import Counted, Fusing, state_of
from services.identification.identify import Identify, identify
from services.identification.outputs import Fuse, Work

_log = logging.getLogger(__name__)
_SPAWN = get_context("spawn")
_STARTING = threading.Lock()
"""Which process is new is told by which was not there before: one is started at a time."""
_TRIES = 2
"""A process may be ended for what others do to the machine's memory; twice is no accident."""
_WAITING_PER_PROCESS = 2
"""What waits here is finished even after a signal, and a service has a minute to end."""
_USUAL = Limits()
_WATCH_EVERY_S = 0.5
"""So often it is looked whether a process is hung."""
_LONGEST_END_S = 5.0
"""A process ends as soon as its interpreter has a turn, which a kernel may hold up for a while."""


class Aside(NamedTuple):
    """What is computed when no crossing waits. To be pickled: a function of a module, applied."""

    name: str
    run: Callable[[], object]


class Aftermath(NamedTuple):
    """An aside that is over, and what it gave; None if it raised or its process died twice."""

    aside: Aside
    outcome: object | None


StateOf = Callable[[Counted, str, Fusing], BridgeResult | None]
"""Makes the state of a bridge; as `state_of`."""
_Task = Work | Fuse | Aside
_BridgeName = tuple[str, str]
"""Realm and bridge."""


class _Begin(NamedTuple):
    """What a process does, and what it does before."""

    identify: Identify
    state_of: StateOf
    prepare: Callable[[], None]


class _Job(NamedTuple):
    task: _Task
    tries: int = 0

    @property
    def name(self) -> str:
        match self.task:
            case Work():
                return self.task.crossing_id
            case Fuse():
                return f"the state of {self.task.bridge}"
            case Aside():
                return self.task.name


class Processes:
    """The `Execution` in `number` processes; `report` may be told from another thread.

    Each takes its share of the settings' `threads`, at least one. It keeps no draws. One that takes
    more than the `limits` for a piece of work is killed. To be closed, or used as a context
    manager: what is under way then is given up.
    """

    def __init__(
        self,
        number: int,
        *,
        report: Report = lambda crossing_id, stage, fraction: None,
        identify: Identify = identify,
        state_of: StateOf = state_of,
        prepare: Callable[[], None] = warm_up,
        limits: Limits = _USUAL,
    ) -> None:
        # Read when a process loads numpy: its threads would fight with those of its neighbours.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        self._report = report
        begin = _Begin(identify, state_of, prepare)
        self._places = [_Place(report, begin, limits) for _ in range(number)]
        self._waiting: deque[_Job] = deque()
        self._finished: list[Finished] = []
        self._to_fuse: dict[_BridgeName, _Job] = {}
        """The newest of each bridge, in the order in which the bridges came."""
        self._fused: list[Fused] = []
        self._asides: deque[_Job] = deque()
        self._aftermaths: list[Aftermath] = []

    def wait_until_warm(self) -> None:
        """Wait until all processes can begin. FailureError if one of them cannot, or is hung."""
        try:
            for place in self._places:
                while not wait([place.is_warm], _WATCH_EVERY_S).done:
                    place.end_if_hung()
                place.is_warm.result()
        except BrokenExecutor as error:
            raise FailureError(
                "a process for identifications died while it was started, see the log"
            ) from error

    @property
    def is_busy(self) -> bool:
        """Whether there is something that `finished` or `fused` has not given back yet."""
        waiting = self._waiting or self._to_fuse
        return bool(waiting or self._finished or self._fused or self._wanted_at)

    @property
    def is_full(self) -> bool:
        """Whether enough works wait for a process."""
        return len(self._waiting) >= _WAITING_PER_PROCESS * len(self._places)

    @property
    def has_room(self) -> bool:
        """Whether one more may wait for a process, and then it is not full."""
        return len(self._waiting) + 1 < _WAITING_PER_PROCESS * len(self._places)

    @property
    def is_idle(self) -> bool:
        """Whether a work that is started now is begun at once, or as soon as an aside is over."""
        return not self._waiting and len(self._wanted_at) < len(self._places)

    @property
    def waiting(self) -> int:
        """How many works wait for a process."""
        return len(self._waiting)

    @property
    def under_way(self) -> list[Begun]:
        """The crossings that are being identified, the one that was begun first first."""
        now_s = time.monotonic()
        found = [
            Begun(place.job.name, now_s - place.began_s)
            for place in self._places
            if place.job and isinstance(place.job.task, Work)
        ]
        return sorted(found, key=lambda one: -one.seconds)

    def start(self, work: Work) -> None:
        """Give a work to a process, as soon as one is free."""
        self._waiting.append(_Job(work))
        self._fill()
        if self._waiting:
            self._report(work.crossing_id, "waiting for a process", 0.0)

    def finished(self, timeout_s: float = 0.0) -> list[Finished]:
        """What has been done since the last call; see `Execution`."""
        self._fill()
        under_way = [place.future for place in self._places if place.future is not None]
        if under_way and timeout_s > 0.0:  # asked after every message: no time for nothing
            wait(under_way, timeout_s, FIRST_COMPLETED)
        for place in self._places:
            if place.future is not None and place.future.done():
                self._take(place, place.future)
            elif place.job is not None:
                place.end_if_hung()
        finished, self._finished = self._finished, []
        if not finished:  # else the states that the results lead to come first
            self._fill()
        return finished

    def fuse(self, fuse: Fuse) -> None:
        """Give crossings to the next process that is free; see `Execution`."""
        self._to_fuse[_bridge_of(fuse)] = _Job(fuse)
        self._fill()

    def fused(self) -> list[Fused]:
        """The states that have been made since the last call; see `Execution`."""
        self._fill()
        fused, self._fused = self._fused, []
        return fused

    def start_aside(self, aside: Aside) -> None:
        """Compute something in a process that no crossing waits for."""
        self._asides.append(_Job(aside))
        self._fill()

    @property
    def wants_aside(self) -> bool:
        """Whether a process may be free for an aside that is not waiting yet."""
        begun = sum(1 for p in self._places if p.job and isinstance(p.job.task, Aside))
        return len(self._asides) + begun < len(self._places)

    def aftermaths(self) -> list[Aftermath]:
        """The asides that have been over since the last call; `finished` looks after them."""
        self._fill()
        aftermaths, self._aftermaths = self._aftermaths, []
        return aftermaths

    def forget_asides(self) -> None:
        """Begin no more of those that wait."""
        self._asides.clear()

    def close(self) -> None:
        """End the processes, in the middle of whatever they do."""
        for place in self._places:
            place.close()

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _wanted_at(self) -> list["_Place"]:
        """Where something is done that somebody waits for."""
        return [p for p in self._places if p.job and not isinstance(p.job.task, Aside)]

    def _fill(self) -> None:
        for place in self._places:
            job = self._next() if place.job is None else None
            if job is not None:
                place.begin(job, len(self._places))

    def _next(self) -> _Job | None:
        under_way = {
            _bridge_of(place.job.task)
            for place in self._places
            if place.job and isinstance(place.job.task, Fuse)
        }
        for name in self._to_fuse:
            if name not in under_way:
                return self._to_fuse.pop(name)
        first = self._waiting or self._asides
        return first.popleft() if first else None

    def _take(self, place: "_Place", future: Future[Any]) -> None:
        job = place.job
        assert job is not None  # noqa: S101 - it has a future
        place.job = place.future = None
        try:
            self._is_over(job.task, future.result())
        except BrokenExecutor:
            place.renew()
            if job.tries + 1 < _TRIES:
                _log.warning("the process that worked on %s died; tried once more", job.name)
                self._put_back(_Job(job.task, job.tries + 1))
            else:
                _log.error("the process that worked on %s died again; it has failed", job.name)
                self._is_over(job.task, None)
        except Exception:  # whatever it is, another process would meet it, too
            _log.exception("work on %s failed", job.name)
            self._is_over(job.task, None)

    def _put_back(self, job: _Job) -> None:
        """Let it be the next of its kind; crossings to fuse only if no newer ones have come."""
        match job.task:
            case Work():
                self._waiting.appendleft(job)
            case Fuse():
                self._to_fuse = {_bridge_of(job.task): job} | self._to_fuse
            case Aside():
                self._asides.appendleft(job)

    def _is_over(self, task: _Task, outcome: Any) -> None:
        """Keep what a task gave; None: nothing."""
        match task:
            case Work():
                result = failed(task) if outcome is None else outcome
                self._finished.append(Finished(task, result))
            case Fuse():
                self._fused.append(Fused(task, outcome))
            case Aside():
                self._aftermaths.append(Aftermath(task, outcome))


def _bridge_of(fuse: Fuse) -> _BridgeName:
    return fuse.realm, fuse.bridge


class _Place:
    """One process after the other, and what it works on."""

    def __init__(self, report: Report, begin: _Begin, limits: Limits) -> None:
        self._report = report
        self._begin = begin
        self._limits = limits
        self._watch: Watch | None = None
        self.began_s = 0.0
        """When the job was given to the process."""
        self.job: _Job | None = None
        self.future: Future[Any] | None = None
        self._open()

    def begin(self, job: _Job, places: int) -> None:
        """Work on a crossing, with the share of its threads that one of `places` has; or aside."""
        self.job = job
        self._watch = None
        self._next_look_s = 0.0
        self.began_s = time.monotonic()
        task = job.task
        try:
            if isinstance(task, Aside):
                self.future = self._executor.submit(task.run)
            elif isinstance(task, Fuse):
                threads = max(1, task.fusing.threads // places)
                made_of = (task.counted, task.bridge, task.fusing._replace(threads=threads))
                self.future = self._executor.submit(self._begin.state_of, *made_of)
            else:
                threads = max(1, task.settings.threads // places)
                settings = task.settings.model_copy(update={"threads": threads})
                self.future = self._executor.submit(_identified, task._replace(settings=settings))
        except BrokenExecutor as error:  # it died while it had nothing to do
            self.future = Future()
            self.future.set_exception(error)

    def end_if_hung(self) -> None:
        """Kill the process if it takes too much for its job, or to be started.

        Its job then is as if it had died.
        """
        now_s = time.monotonic()
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + _WATCH_EVERY_S
        if self._watch is None:
            self._watch = Watch(self._pid, self._limits, now_s)
        why = self._watch.why_hung(now_s)
        if why:
            self._next_look_s = math.inf
            starts = self.job is None or not self.is_warm.done()
            what = "is being started" if starts else f"works on {self.job and self.job.name}"
            _log.warning("the process that %s %s and is ended", what, why)
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGKILL)

    def renew(self) -> None:
        """Put a new process in the place of one that has died."""
        self.close()
        self._open()

    def close(self) -> None:
        """End the process: it ends itself when it sees that nobody holds its lifeline."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        self._lifeline.close()
        self._send.close()
        # A thread that is still publishing when the interpreter ends would abort the process.
        self._reader.join(_LONGEST_END_S)
        if self._reader.is_alive():  # it is frozen, and who started it would wait for its end
            self._process.kill()
            self._reader.join(_LONGEST_END_S)

    def _open(self) -> None:
        receive, self._send = _SPAWN.Pipe(duplex=False)
        its_end, self._lifeline = _SPAWN.Pipe(duplex=False)
        self._executor = ProcessPoolExecutor(
            1, mp_context=_SPAWN, initializer=_prepare, initargs=(its_end, self._send, self._begin)
        )
        with _STARTING:
            others = set(active_children())
            self.is_warm = self._executor.submit(os.getpid)  # which starts the process
            (self._process,) = set(active_children()) - others
        assert self._process.pid is not None  # noqa: S101 - it has been started
        self._pid = self._process.pid
        self._watch, self._next_look_s = None, 0.0
        its_end.close()
        self._reader = threading.Thread(
            target=self._read, args=(receive,), name="progress", daemon=True
        )
        self._reader.start()

    def _read(self, receive: "Connection") -> None:
        """Pass on how far an identification is, until the process and this place have ended."""
        with receive:
            while True:
                try:
                    progress = receive.recv()
                except (EOFError, OSError):
                    return
                try:
                    self._report(*progress)
                except Exception as error:  # who cannot be told of it still gets the result
                    _log.debug("progress was not told: %s", error)


# In the process itself


_HERE: list[Here] = []
"""The process's own execution, once it is prepared."""


def _prepare(lifeline: Connection, send: Connection, begin: _Begin) -> None:
    # A signal to the whole group is for who started this; it says what is to be done.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), name="lifeline", daemon=True).start()
    _HERE.append(Here(report=lambda *progress: send.send(progress), identify=begin.identify))
    begin.prepare()


def _end_with(lifeline: Connection) -> None:
    """End at once when the other end has been closed, or who held it is dead."""
    try:
        lifeline.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)


def _identified(work: Work) -> Crossing:
    (here,) = _HERE
    here.start(work)
    (finished,) = here.finished()
    return finished.result
