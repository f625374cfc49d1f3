"""Identification on the workers of a Dask cluster, in batches, without losing a crossing.

A batch is a Dask task: the packed crossings, the program that they are meant for, and a key that is
the hash of both. The scheduler holds as many batches as its workers need (a window); the others
stay with the process that reads recordings. A submitted batch is kept here until its results are
received. If the scheduler dies or freezes, this process waits for a new one and submits the
unfinished batches again. The scheduler replaces a dead worker, until several have died with a batch
or next to it, which cannot be distinguished: such a batch is suspect. It is submitted once more
when nothing else runs, then crossing by crossing, and a crossing that ends workers on its own is
rejected as `failed`.
"""

import logging
import time
from collections import deque
from collections.abc import Sequence
from math import ceil
from typing import Any, Final, NamedTuple

from schemas.results import CrossingResult
from services.common.errors import FailureError
from services.common.extras import check_installed
from services.execution.cluster_worker import BatchFailure, BatchRefusal, packed, unpacked
from services.execution.dispatch import FusionResult, RunningCrossing, TaskResult, failed_result
from services.execution.inline import InlineExecutor
from services.execution.program import program
from services.execution.scheduler import (
    Credentials,
    Scheduler,
    SchedulerUnavailableError,
    check_address,
    connect,
)
from services.execution.task_hash import combined_hash, task_hash
from services.identification.outputs import FusionTask, IdentificationTask

_log = logging.getLogger(__name__)
BATCH: Final = 50
"""Crossings in a batch: a minute of work, where the scheduler takes milliseconds per task."""
PATIENCE_S: Final = 300.0
"""Time in s that a scheduler, or its workers, may be unavailable."""
_FIRST_S: Final = 20.0
"""The same at the beginning, when the address may be wrong."""
_ASK_EVERY_S: Final = 5.0
_RETRY_S: Final = 1.0
_POLL_S: Final = 0.05
_GIVEN: Final = ("finished", "error")
_KNOWN: Final = ("pending", "lost", *_GIVEN)
"""States in which a scheduler knows a batch.

`lost` is a result that went with its worker before it was requested; the scheduler computes it
again. Any other state belongs to a scheduler that is lost.
"""


class _Batch(NamedTuple):
    content: str
    tasks: tuple[IdentificationTask, ...]
    tries: int = 0
    is_suspect: bool = False
    """Whether workers died while they had it, or another batch."""


class _SubmittedBatch(NamedTuple):
    batch: _Batch
    future: Any


class DaskExecutor:
    """The executor on a cluster; to be closed, or used as a context manager.

    It keeps no draws and reports no progress within a batch. States of bridges are computed inline.
    Raise InputError for an invalid or refused address and without Dask, FailureError without a
    scheduler or a worker for `patience_s`, and for workers of another version.
    """

    def __init__(
        self,
        address: str,
        *,
        credentials: Credentials | None = None,
        batch: int = BATCH,
        patience_s: float = PATIENCE_S,
    ) -> None:
        check_address(address, credentials)
        check_installed("a cluster", "distributed", extra="cluster")
        self._address = address
        self._credentials = credentials
        self._batch = batch
        self._patience_s = patience_s
        self._program = program()
        self._pending: deque[IdentificationTask] = deque()
        self._to_send: deque[_Batch] = deque()
        """Batches to be submitted again, or crossing by crossing."""
        self._suspects: deque[_Batch] = deque()
        """Batches to be submitted alone."""
        self._submitted: dict[str, _SubmittedBatch] = {}
        self._finished: list[TaskResult] = []
        self._inline = InlineExecutor()
        self._workers = 1
        """Number of batches that the workers run at once."""
        self._connect(min(_FIRST_S, patience_s))

    @property
    def is_busy(self) -> bool:
        """Whether a result or a state is still to be collected."""
        waiting = self._pending or self._to_send or self._suspects or self._submitted
        return bool(waiting or self._finished or self._inline.is_busy)

    @property
    def is_full(self) -> bool:
        """Whether no batch may be submitted, and one more waits."""
        return not self._may_send and len(self._pending) >= self._batch

    @property
    def has_room(self) -> bool:
        """Whether one more crossing would not make it full."""
        return self._may_send or len(self._pending) + 1 < self._batch

    @property
    def is_idle(self) -> bool:
        """Whether a worker is free for a batch."""
        return len(self._submitted) < self._workers

    @property
    def waiting(self) -> int:
        """Number of crossings not yet submitted to the scheduler."""
        again = (*self._to_send, *self._suspects)
        return len(self._pending) + sum(len(batch.tasks) for batch in again)

    @property
    def running(self) -> list[RunningCrossing]:
        """Always an empty list: only the workers know."""
        return []

    def submit(self, task: IdentificationTask) -> None:
        """Queue a crossing; it is submitted to the scheduler together with others."""
        self._pending.append(task)
        self._send()

    def collect(self, timeout_s: float = 0.0) -> list[TaskResult]:
        """Return the crossings identified since the last call; see `CrossingExecutor`.

        A caller that waits in spite of room has no more crossings: incomplete batches are sent.
        FailureError: the scheduler or all workers were unavailable for too long.
        """
        if timeout_s > 0.0 and not self.is_full:
            self._send(is_all=True)
        _wait_for_any([sent.future for sent in self._submitted.values()], timeout_s)
        self._collect_all()
        self._check_scheduler()
        self._send()
        finished, self._finished = self._finished, []
        return finished

    def submit_fusion(self, fuse: FusionTask) -> None:
        """Fuse the crossings inline. Raise what `state_of` raises."""
        self._inline.submit_fusion(fuse)

    def collect_fusions(self) -> list[FusionResult]:
        """Return the states computed since the last call."""
        return self._inline.collect_fusions()

    def close(self) -> None:
        """Leave the cluster; its unfinished work for this process is given up."""
        self._scheduler.close()

    def __enter__(self) -> "DaskExecutor":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _window(self) -> int:
        """Number of batches at the scheduler: a running and a waiting one per worker."""
        return 2 * self._workers

    @property
    def _may_send(self) -> bool:
        """Whether there is room, and no suspect batch has to run alone."""
        suspect = self._suspects or any(one.batch.is_suspect for one in self._submitted.values())
        return not suspect and len(self._submitted) < self._window

    def _connect(self, longest_s: float) -> None:
        self._scheduler = _scheduler_with_workers(
            self._address, self._credentials, self._program, longest_s, self._patience_s
        )
        self._asked_s = self._with_workers_s = time.monotonic()
        self._workers = self._scheduler.threads or 1

    def _send(self, *, is_all: bool = False) -> None:
        """Submit batches while there is room; `is_all` includes incomplete ones."""
        if self._suspects and not self._submitted:
            self._submit(self._suspects.popleft())
        size = self._batch
        if is_all:  # the last ones are shared among all workers
            size = min(size, max(1, ceil(len(self._pending) / self._workers)))
        while self._may_send:
            if self._to_send:
                self._submit(self._to_send.popleft())
            elif len(self._pending) >= size or (is_all and self._pending):
                tasks = [self._pending.popleft() for _ in range(min(size, len(self._pending)))]
                self._submit(self._batch_of(tasks))
            else:
                return

    def _batch_of(self, tasks: Sequence[IdentificationTask]) -> _Batch:
        content = combined_hash(task_hash(task, self._program) for task in tasks)
        return _Batch(content, tuple(tasks))

    def _submit(self, batch: _Batch) -> None:
        key = f"crossings-{batch.content}-{batch.tries}"
        tasks = packed(map(_with_one_thread, batch.tasks))
        self._submitted[batch.content] = _SubmittedBatch(
            batch, self._scheduler.submit(key, tasks, self._program)
        )

    def _collect_all(self) -> None:
        """Collect the results of finished tasks, up to one that does not arrive.

        That is with a frozen process, which takes long to detect: it is requested again last.
        """
        for content, sent in list(self._submitted.items()):
            if sent.future.status in _GIVEN and not self._collect_result(sent):
                self._submitted[content] = self._submitted.pop(content)
                return

    def _collect_result(self, sent: _SubmittedBatch) -> bool:
        """Store the result of a task, or submit it again; return False if it does not arrive."""
        from distributed import KilledWorker

        is_error: bool = sent.future.status == "error"
        try:
            answer = self._scheduler.answer(sent.future)
        except KilledWorker:
            self._forget(sent)
            self._killed(sent.batch)
            return True
        except Exception as error:
            if is_error:
                self._forget(sent)
                self._failed(sent.batch, f"{type(error).__name__}: {error}")
            return is_error
        self._forget(sent)
        if isinstance(answer, BatchRefusal):
            _log.warning("worker %s: %s; retiring it", answer.worker, answer.why)
            self._scheduler.retire_worker(answer.worker)
            self._to_send.append(sent.batch._replace(tries=sent.batch.tries + 1))
        elif isinstance(answer, BatchFailure):
            self._failed(sent.batch, f"worker {answer.worker}: {answer.why}")
        else:
            results: tuple[CrossingResult, ...] = unpacked(answer)
            self._finished += map(TaskResult, sent.batch.tasks, results)
        return True

    def _killed(self, batch: _Batch) -> None:
        if batch.is_suspect:
            self._failed(batch, "the workers that tried have died")
            return
        _log.warning(
            "workers died with a batch of %d crossings; retrying it alone",
            len(batch.tasks),
        )
        self._suspects.append(batch._replace(tries=batch.tries + 1, is_suspect=True))

    def _failed(self, batch: _Batch, why: str) -> None:
        """Split a failed batch; reject a single crossing."""
        tasks, line = batch.tasks, " ".join(why.split())[:200]
        if len(tasks) > 1:
            _log.warning("a batch of %d crossings: %s; retrying each alone", len(tasks), line)
            singles = [self._batch_of([task]) for task in tasks]
            if batch.is_suspect:
                self._suspects += (one._replace(is_suspect=True) for one in singles)
            else:
                self._to_send += singles
            return
        _log.error("identification of %s failed: %s", tasks[0].crossing_id, line)
        self._finished.append(TaskResult(tasks[0], failed_result(tasks[0])))

    def _forget(self, sent: _SubmittedBatch) -> None:
        del self._submitted[sent.batch.content]
        sent.future.release()

    def _check_scheduler(self) -> None:
        """Wait for a new scheduler if it is lost; count its workers."""
        is_lost = any(sent.future.status not in _KNOWN for sent in self._submitted.values())
        now_s = time.monotonic()
        if not is_lost and now_s < self._asked_s + _ASK_EVERY_S:
            return
        self._asked_s = now_s
        threads = None if is_lost else self._scheduler.threads
        if threads is None:
            self._resubmit_all()
        elif threads:
            self._workers, self._with_workers_s = threads, now_s
        elif self._submitted and now_s > self._with_workers_s + self._patience_s:
            raise FailureError(
                f"{self._address}: has had no worker for {self._patience_s:.0f} s; start some, and "
                "run the same command again"
            )

    def _resubmit_all(self) -> None:
        """Wait for a scheduler, and submit the unfinished batches of its predecessor again."""
        _log.warning(
            "scheduler %s lost; waiting up to %.0f s for a new one",
            *(self._address, self._patience_s),
        )
        self.close()
        self._connect(self._patience_s)
        lost = [sent.batch for sent in self._submitted.values()]
        self._submitted.clear()
        for batch in lost:
            (self._suspects if batch.is_suspect else self._to_send).append(batch)
        number = f"{len(lost)} batch{'es' if len(lost) != 1 else ''}"
        _log.warning("scheduler %s is back: submitted %s again", self._address, number)


def _with_one_thread(task: IdentificationTask) -> IdentificationTask:
    return task._replace(settings=task.settings.model_copy(update={"threads": 1}))


def _scheduler_with_workers(
    address: str,
    credentials: Credentials | None,
    program: dict[str, str],
    longest_s: float,
    patience_s: float,
) -> Scheduler:
    """Wait for a scheduler with workers of this program, also if it is lost meanwhile."""
    deadline = time.monotonic() + patience_s
    is_logged = False
    while True:
        scheduler = connect(address, credentials, longest_s)
        try:
            scheduler.wait_for_workers(patience_s)
            scheduler.check_workers(program)
            return scheduler
        except SchedulerUnavailableError as error:
            scheduler.close()
            longest_s = deadline - time.monotonic()
            if longest_s <= 0.0:
                raise
            if not is_logged:
                is_logged = True
                _log.warning("%s; retrying for %.0f s", error, longest_s)
            time.sleep(_RETRY_S)
        except BaseException:
            scheduler.close()
            raise


def _wait_for_any(futures: Sequence[Any], timeout_s: float) -> None:
    """Wait until one of some tasks is no longer pending."""
    deadline = time.monotonic() + timeout_s
    while futures and time.monotonic() < deadline:
        if any(future.status != "pending" for future in futures):
            return
        time.sleep(_POLL_S)
