"""Identifies crossings in processes of their own, so that who finds them can go on listening.

Every process is warm (its kernels are loaded before its first crossing) and works on one crossing
at a time. If it dies, for want of memory or in a library, its crossing is tried once more in a new
one and then rejected as `failed`: no crossing can end who asked for it, nor another crossing.

They are spawned: numba's and OpenBLAS's threads would not survive a fork. Signals are for the
process that started them, and they end with it, however it ends.
"""

import logging
import os
import signal
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import NamedTuple

from schemas.results import Crossing
from services.common.errors import FailureError
from services.execution.dispatch import Finished, failed
from services.execution.here import Here, Report
from services.execution.warm_up import warm_up
from services.identification.identify import Identify, identify
from services.identification.outputs import Work

_log = logging.getLogger(__name__)
_SPAWN = get_context("spawn")
_TRIES = 2
"""A process may be ended for what others do to the machine's memory; twice is no accident."""
_WAITING_PER_PROCESS = 2
"""What waits here is finished even after a signal, and a service has a minute to end."""

_LONGEST_END_S = 5.0
"""A process ends as soon as its interpreter has a turn, which a kernel may hold up for a while."""


class _Job(NamedTuple):
    work: Work
    tries: int = 0


class Processes:
    """The `Execution` in `number` processes; `report` may be told from another thread.

    Each takes its share of the settings' `threads`, at least one. It keeps no draws. To be closed,
    or used as a context manager: what is under way then is given up.
    """

    def __init__(
        self,
        number: int,
        *,
        report: Report = lambda crossing_id, stage, fraction: None,
        identify: Identify = identify,
        prepare: Callable[[], None] = warm_up,
    ) -> None:
        # Read when a process loads numpy: its threads would fight with those of its neighbours.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        self._places = [_Place(report, identify, prepare) for _ in range(number)]
        self._waiting: deque[_Job] = deque()
        self._finished: list[Finished] = []

    def wait_until_warm(self) -> None:
        """Wait until all processes can begin. FailureError if one of them cannot."""
        try:
            for place in self._places:
                place.is_warm.result()
        except BrokenExecutor as error:
            raise FailureError(
                "a process for identifications died while it was started, see the log"
            ) from error

    @property
    def is_busy(self) -> bool:
        """Whether there are works that `finished` has not given back yet."""
        return bool(self._waiting or self._finished or any(p.job for p in self._places))

    @property
    def is_full(self) -> bool:
        """Whether enough works wait for a process."""
        return len(self._waiting) >= _WAITING_PER_PROCESS * len(self._places)

    def start(self, work: Work) -> None:
        """Give a work to a process, as soon as one is free."""
        self._waiting.append(_Job(work))
        self._fill()

    def finished(self, timeout_s: float = 0.0) -> list[Finished]:
        """What has been done since the last call; see `Execution`."""
        under_way = [place.future for place in self._places if place.future is not None]
        if under_way:
            wait(under_way, timeout_s, FIRST_COMPLETED)
        for place in self._places:
            if place.future is not None and place.future.done():
                self._take(place, place.future)
        self._fill()
        finished, self._finished = self._finished, []
        return finished

    def close(self) -> None:
        """End the processes, in the middle of whatever they do."""
        for place in self._places:
            place.close()

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _fill(self) -> None:
        for place in self._places:
            if self._waiting and place.job is None:
                job = self._waiting.popleft()
                place.begin(job, max(1, job.work.settings.threads // len(self._places)))

    def _take(self, place: "_Place", future: Future[Crossing]) -> None:
        job = place.job
        assert job is not None  # noqa: S101 - it has a future
        place.job = place.future = None
        name = job.work.crossing_id
        try:
            self._finished.append(Finished(job.work, future.result()))
        except BrokenExecutor:
            place.renew()
            if job.tries + 1 < _TRIES:
                _log.warning("the process that identified %s died; tried once more", name)
                self._waiting.appendleft(_Job(job.work, job.tries + 1))
            else:
                _log.error("the process that identified %s died again; it is rejected", name)
                self._finished.append(Finished(job.work, failed(job.work)))
        except Exception:  # whatever it is, another process would meet it, too
            _log.exception("identification of %s failed", name)
            self._finished.append(Finished(job.work, failed(job.work)))


class _Place:
    """One process after the other, and what it works on."""

    def __init__(self, report: Report, identify: Identify, prepare: Callable[[], None]) -> None:
        self._report = report
        self._begin = identify, prepare
        self.job: _Job | None = None
        self.future: Future[Crossing] | None = None
        self._open()

    def begin(self, job: _Job, threads: int) -> None:
        """Work on a crossing."""
        settings = job.work.settings.model_copy(update={"threads": threads})
        self.job = job
        try:
            self.future = self._executor.submit(_identified, job.work._replace(settings=settings))
        except BrokenExecutor as error:  # it died while it had nothing to do
            self.future = Future()
            self.future.set_exception(error)

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

    def _open(self) -> None:
        receive, self._send = _SPAWN.Pipe(duplex=False)
        its_end, self._lifeline = _SPAWN.Pipe(duplex=False)
        self._executor = ProcessPoolExecutor(
            1, mp_context=_SPAWN, initializer=_prepare, initargs=(its_end, self._send, *self._begin)
        )
        self.is_warm = self._executor.submit(_nothing)
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


def _prepare(
    lifeline: Connection, send: Connection, identify: Identify, prepare: Callable[[], None]
) -> None:
    # A signal to the whole group is for who started this; it says what is to be done.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), name="lifeline", daemon=True).start()
    _HERE.append(Here(report=lambda *progress: send.send(progress), identify=identify))
    prepare()


def _end_with(lifeline: Connection) -> None:
    """End at once when the other end has been closed, or who held it is dead."""
    try:
        lifeline.recv_bytes()
    except (EOFError, OSError):
        os._exit(1)


def _nothing() -> None:
    """Be done as soon as the process is prepared."""


def _identified(work: Work) -> Crossing:
    (here,) = _HERE
    here.start(work)
    (finished,) = here.finished()
    return finished.result
