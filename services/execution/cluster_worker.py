"""Functions that a worker of a cluster runs: batches of crossings, in a process of its own.

The worker itself only listens. The crossings are computed by `ProcessExecutor`, one for each of its
threads, so a crossing that ends its process, or hangs, affects neither the batch nor the worker. A
batch is bytes with a description of its program; only the same program unpacks it.
"""

import multiprocessing
import pickle
import threading
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import zstandard

from schemas.results import CrossingResult
from services.execution.processes import ProcessExecutor
from services.execution.program import processor, program, version_difference
from services.identification.outputs import IdentificationTask

_WAIT_S = 0.1
_LEVEL = 1
"""Compression level: accelerations hardly shrink, so a higher one only takes time."""


class WorkerInfo(NamedTuple):
    """A worker's description of itself."""

    program: dict[str, str]
    processor: str
    cannot: str
    """Reason why it can identify nothing; empty if it can."""


class BatchRefusal(NamedTuple):
    """A worker's refusal to run a batch, which is meant for another program."""

    worker: str
    why: str


class BatchFailure(NamedTuple):
    """Failure of a batch as a whole; returned, because not every exception can be transmitted."""

    worker: str
    why: str


def worker_info() -> WorkerInfo:
    """Return the description of this process. To be called on a worker."""
    daemon = multiprocessing.current_process().daemon
    cannot = (
        "is a daemon of its nanny and can start no process: start it with --no-nanny, or with "
        "DASK_DISTRIBUTED__WORKER__DAEMON=False"
    )
    return WorkerInfo(program(), processor(), cannot if daemon else "")


def identify_batch(batch: bytes, meant_for: dict[str, str]) -> bytes | BatchRefusal | BatchFailure:
    """Identify packed crossings; return their packed results in order. To be called on a worker."""
    from distributed import get_worker

    here = worker_info()
    worker = str(get_worker().address)
    why = version_difference(here.program, meant_for) or here.cannot
    if why:
        return BatchRefusal(worker, why)
    try:
        return packed(_results(unpacked(batch)))
    except Exception as error:  # whatever it is, the client must receive it
        return BatchFailure(worker, f"{type(error).__name__}: {error}")


def packed(content: Iterable[Any]) -> bytes:
    """Return values as bytes, to be unpacked by a process of the same program."""
    return zstandard.compress(pickle.dumps(tuple(content), protocol=5), level=_LEVEL)


def unpacked(content: bytes) -> tuple[Any, ...]:
    """Return the values of `packed`. It executes pickles: only for bytes of one's own cluster."""
    values: tuple[Any, ...] = pickle.loads(zstandard.decompress(content))  # noqa: S301 - see above
    return values


class _Pools(threading.local):
    """The process of each thread of the worker, once it has received a batch."""

    pool: ProcessExecutor | None = None


_POOLS = _Pools()


def _results(tasks: Sequence[IdentificationTask]) -> list[CrossingResult]:
    """Return the results of crossings, in their order."""
    results: dict[int, CrossingResult] = {}
    left = list(tasks)
    pool = _POOLS.pool = _POOLS.pool or new_pool()
    try:
        pool.wait_until_warm()
        while left or pool.is_busy:
            while left and not pool.is_full:
                pool.submit(left.pop(0))
            for task, result in pool.collect(_WAIT_S):
                results[task.number] = result
    except BaseException:
        # Its running crossing is abandoned: the next batch gets another process.
        _POOLS.pool = None
        pool.close()
        raise
    return [results[task.number] for task in tasks]


def new_pool() -> ProcessExecutor:
    """Return a process in which a thread of the worker has its crossings identified."""
    return ProcessExecutor(1)
