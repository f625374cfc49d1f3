"""Identifies crossings on the workers of a Dask cluster, in batches, and loses none of them.

A batch is a task: the packed works, the program that they are meant for, and a key that is the hash
of both. So many batches are given to the scheduler as its workers need (a window), the others wait
with who finds crossings. What is given away is kept here until its results have come: a scheduler
that dies, or is frozen, is waited for, and gets anew what it has not brought. A worker that dies is
the scheduler's affair, until several have died of a batch, or beside it: that cannot be told apart.
So such a batch is suspect: it is sent once more when nothing else is under way, then crossing by
crossing, and one that ends workers all by itself is rejected as `failed`.
"""

import logging
import time
from collections import deque
from collections.abc import Sequence
from math import ceil
from typing import Any, Final, NamedTuple

from schemas.results import Crossing
from services.common.errors import FailureError
from services.common.extras import check_installed
from services.execution.cluster_worker import Broken, Refused, packed, unpacked
from services.execution.content import content_of, content_of_all
from services.execution.dispatch import Begun, Finished, Fused, failed
from services.execution.here import Here
from services.execution.program import program
from services.execution.scheduler import AwayError, Credentials, check_address, connected
from services.identification.outputs import Fuse, Work

_log = logging.getLogger(__name__)
BATCH: Final = 50
"""Crossings: a minute of work, against the milliseconds that a scheduler takes for a task."""
PATIENCE_S: Final = 300.0
"""So long a scheduler, or its workers, may be away."""
_FIRST_S: Final = 20.0
"""So long at the beginning: an address may be wrong."""
_ASK_EVERY_S: Final = 5.0
_RETRY_S: Final = 1.0
_LOOK_S: Final = 0.05
_GIVEN: Final = ("finished", "error")
_KNOWN: Final = ("pending", "lost", *_GIVEN)
"""What a scheduler says of a batch. `lost` is a result that has gone with its worker before it was
asked for: the scheduler has it made again. Any other status is of a scheduler that is gone."""


class _Batch(NamedTuple):
    content: str
    works: tuple[Work, ...]
    tries: int = 0
    is_suspect: bool = False
    """Workers have died of it, or of another one."""


class _Sent(NamedTuple):
    batch: _Batch
    future: Any


class Cluster:
    """The `Execution` on a cluster; to be closed, or used as a context manager.

    It keeps no draws and tells no progress within a batch. States of bridges are made here.
    InputError: an address that is none or must not be used, Dask is not installed. FailureError: no
    scheduler or no worker for `patience_s`, or workers that are refused.
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
        self._pending: deque[Work] = deque()
        self._to_send: deque[_Batch] = deque()
        """Batches that are to be sent once more, or crossing by crossing."""
        self._suspects: deque[_Batch] = deque()
        """Those that are to be sent alone."""
        self._sent: dict[str, _Sent] = {}
        self._finished: list[Finished] = []
        self._here = Here()
        self._workers = 1
        """How many batches they take at once."""
        self._connect(min(_FIRST_S, patience_s))

    @property
    def is_busy(self) -> bool:
        """Whether there is something that `finished` or `fused` has not given back yet."""
        waiting = self._pending or self._to_send or self._suspects or self._sent
        return bool(waiting or self._finished or self._here.is_busy)

    @property
    def is_full(self) -> bool:
        """Whether no batch may be sent, and one more waits."""
        return not self._may_send and len(self._pending) >= self._batch

    @property
    def has_room(self) -> bool:
        """Whether it would not be full after one more work."""
        return self._may_send or len(self._pending) + 1 < self._batch

    @property
    def is_idle(self) -> bool:
        """Whether a worker waits for a batch."""
        return len(self._sent) < self._workers

    @property
    def waiting(self) -> int:
        """How many works have not been given to the scheduler."""
        again = (*self._to_send, *self._suspects)
        return len(self._pending) + sum(len(batch.works) for batch in again)

    @property
    def under_way(self) -> list[Begun]:
        """None: only the workers know."""
        return []

    def start(self, work: Work) -> None:
        """Take a work; it is given to the scheduler with others."""
        self._pending.append(work)
        self._send()

    def finished(self, timeout_s: float = 0.0) -> list[Finished]:
        """What has been done since the last call; see `Execution`.

        Who waits although there is room has no more to give: what is left is sent. FailureError:
        the scheduler or all workers were away for too long.
        """
        if timeout_s > 0.0 and not self.is_full:
            self._send(is_all=True)
        self._wait(timeout_s)
        self._take_all()
        self._look_after_scheduler()
        self._send()
        finished, self._finished = self._finished, []
        return finished

    def fuse(self, fuse: Fuse) -> None:
        """Fuse the crossings, here. Raises what `state_of` does."""
        self._here.fuse(fuse)

    def fused(self) -> list[Fused]:
        """What was fused since the last call."""
        return self._here.fused()

    def close(self) -> None:
        """Leave the cluster; what it works on for this one is given up."""
        self._scheduler.close()

    def __enter__(self) -> "Cluster":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _window(self) -> int:
        """So many batches are with the scheduler: what is worked on, and one each that waits."""
        return 2 * self._workers

    @property
    def _may_send(self) -> bool:
        """Whether there is room, and no suspect to be left alone."""
        suspect = self._suspects or any(one.batch.is_suspect for one in self._sent.values())
        return not suspect and len(self._sent) < self._window

    def _connect(self, longest_s: float) -> None:
        """Wait for a scheduler with workers of this program, also if one of them goes meanwhile."""
        deadline = time.monotonic() + self._patience_s
        is_told = False
        while True:
            self._scheduler = connected(self._address, self._credentials, longest_s)
            try:
                self._scheduler.wait_for_workers(self._patience_s)
                self._scheduler.check_workers(self._program)
                break
            except AwayError as error:
                self.close()
                longest_s = deadline - time.monotonic()
                if longest_s <= 0.0:
                    raise
                if not is_told:
                    is_told = True
                    _log.warning("%s; asked again for %.0f s", error, longest_s)
                time.sleep(_RETRY_S)
            except BaseException:
                self.close()
                raise
        self._asked_s = self._with_workers_s = time.monotonic()
        self._workers = self._scheduler.threads or 1

    def _send(self, *, is_all: bool = False) -> None:
        """Give batches to the scheduler while there is room; `is_all`: those that are not full."""
        if self._suspects and not self._sent:
            self._submit(self._suspects.popleft())
        size = self._batch
        if is_all:  # the last ones are shared among all workers
            size = min(size, max(1, ceil(len(self._pending) / self._workers)))
        while self._may_send:
            if self._to_send:
                self._submit(self._to_send.popleft())
            elif len(self._pending) >= size or (is_all and self._pending):
                works = [self._pending.popleft() for _ in range(min(size, len(self._pending)))]
                self._submit(self._batch_of(works))
            else:
                return

    def _batch_of(self, works: Sequence[Work]) -> _Batch:
        content = content_of_all(content_of(work, self._program) for work in works)
        return _Batch(content, tuple(works))

    def _submit(self, batch: _Batch) -> None:
        key = f"crossings-{batch.content}-{batch.tries}"
        works = packed(map(_with_one_thread, batch.works))
        self._sent[batch.content] = _Sent(batch, self._scheduler.submit(key, works, self._program))

    def _wait(self, timeout_s: float) -> None:
        deadline = time.monotonic() + timeout_s
        while self._sent and time.monotonic() < deadline:
            if any(sent.future.status != "pending" for sent in self._sent.values()):
                return
            time.sleep(_LOOK_S)

    def _take_all(self) -> None:
        """Take what tasks have given.

        An answer that does not come is with a worker, or a scheduler, that is frozen. It takes long
        to find out, so then the scheduler is looked after first; and the answer is asked for again
        after all others.
        """
        for content, sent in list(self._sent.items()):
            if sent.future.status in _GIVEN and not self._take(sent):
                self._sent[content] = self._sent.pop(content)
                return

    def _take(self, sent: _Sent) -> bool:
        """Keep what a task has given, or send it anew; False if it does not come."""
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
        if isinstance(answer, Refused):
            _log.warning("worker %s: %s; it is sent away", answer.worker, answer.why)
            self._scheduler.send_away(answer.worker)
            self._to_send.append(sent.batch._replace(tries=sent.batch.tries + 1))
        elif isinstance(answer, Broken):
            self._failed(sent.batch, f"worker {answer.worker}: {answer.why}")
        else:
            results: tuple[Crossing, ...] = unpacked(answer)
            self._finished += map(Finished, sent.batch.works, results)
        return True

    def _killed(self, batch: _Batch) -> None:
        if batch.is_suspect:
            self._failed(batch, "the workers that tried have died")
            return
        _log.warning(
            "workers have died while they had a batch of %d crossings; it is tried alone",
            len(batch.works),
        )
        self._suspects.append(batch._replace(tries=batch.tries + 1, is_suspect=True))

    def _failed(self, batch: _Batch, why: str) -> None:
        """Take a batch apart that has failed; a single crossing is rejected."""
        works, line = batch.works, " ".join(why.split())[:200]
        if len(works) > 1:
            _log.warning("a batch of %d crossings: %s; each is tried alone", len(works), line)
            singles = [self._batch_of([work]) for work in works]
            if batch.is_suspect:
                self._suspects += (one._replace(is_suspect=True) for one in singles)
            else:
                self._to_send += singles
            return
        _log.error("work on %s failed: %s", works[0].crossing_id, line)
        self._finished.append(Finished(works[0], failed(works[0])))

    def _forget(self, sent: _Sent) -> None:
        del self._sent[sent.batch.content]
        sent.future.release()

    def _look_after_scheduler(self) -> None:
        """Wait for a scheduler that is gone; count its workers."""
        is_lost = any(sent.future.status not in _KNOWN for sent in self._sent.values())
        now_s = time.monotonic()
        if not is_lost and now_s < self._asked_s + _ASK_EVERY_S:
            return
        self._asked_s = now_s
        threads = None if is_lost else self._scheduler.threads
        if threads is None:
            self._begin_anew()
        elif threads:
            self._workers, self._with_workers_s = threads, now_s
        elif self._sent and now_s > self._with_workers_s + self._patience_s:
            raise FailureError(
                f"{self._address}: has had no worker for {self._patience_s:.0f} s; start some, and "
                "the same command again"
            )

    def _begin_anew(self) -> None:
        """Wait for a scheduler, and give it what the one before has not brought."""
        _log.warning(
            "the scheduler at %s is gone; waiting %.0f s for another one",
            *(self._address, self._patience_s),
        )
        self.close()
        self._connect(self._patience_s)
        lost = [sent.batch for sent in self._sent.values()]
        self._sent.clear()
        for batch in lost:
            (self._suspects if batch.is_suspect else self._to_send).append(batch)
        number = f"{len(lost)} batch{'es' if len(lost) != 1 else ''}"
        _log.warning("there is a scheduler at %s again: %s sent anew", self._address, number)


def _with_one_thread(work: Work) -> Work:
    return work._replace(settings=work.settings.model_copy(update={"threads": 1}))
