"""What a worker of a cluster runs: batches of crossings, in a process of its own.

The worker itself only listens. What computes is `Processes`, one for each of its threads: so a
crossing that ends its process, or hangs, costs itself and not the batch, let alone the worker. A
batch comes as bytes, and with the program that it is meant for: only the same one unpacks it.
"""

import multiprocessing
import pickle
import threading
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import zstandard

from schemas.results import Crossing
from services.execution.processes import Processes
from services.execution.program import another_program, processor, program
from services.identification.outputs import Work

_WAIT_S = 0.1
_LEVEL = 1
"""Accelerations hardly get smaller: what costs time brings nothing."""


class About(NamedTuple):
    """What a worker says of itself."""

    program: dict[str, str]
    processor: str
    cannot: str
    """Why it can identify nothing; empty if it can."""


class Refused(NamedTuple):
    """A worker has not run a batch: it is not of the program that the batch is meant for."""

    worker: str
    why: str


class Broken(NamedTuple):
    """A batch has failed as a whole. Told, not raised: not every exception comes through."""

    worker: str
    why: str


def about() -> About:
    """What runs here. To be called on a worker."""
    daemon = multiprocessing.current_process().daemon
    cannot = (
        "is a daemon of its nanny and can start no process: start it with --no-nanny, or with "
        "DASK_DISTRIBUTED__WORKER__DAEMON=False"
    )
    return About(program(), processor(), cannot if daemon else "")


def identify_batch(batch: bytes, meant_for: dict[str, str]) -> bytes | Refused | Broken:
    """Identify packed works; packed results in their order. To be called on a worker."""
    from distributed import get_worker

    here = about()
    worker = str(get_worker().address)
    why = another_program(here.program, meant_for) or here.cannot
    if why:
        return Refused(worker, why)
    try:
        return packed(_results(unpacked(batch)))
    except Exception as error:  # whatever it is: who waits must hear of it
        return Broken(worker, f"{type(error).__name__}: {error}")


def packed(content: Iterable[Any]) -> bytes:
    """Values as bytes that `unpacked` takes, in a process of the same program."""
    return zstandard.compress(pickle.dumps(tuple(content), protocol=5), level=_LEVEL)


def unpacked(content: bytes) -> tuple[Any, ...]:
    """The values of `packed`. It runs what the bytes say: for those of one's own cluster only."""
    values: tuple[Any, ...] = pickle.loads(zstandard.decompress(content))  # noqa: S301 - see above
    return values


class _Pools(threading.local):
    """The process of each thread of the worker, once it has had a batch."""

    pool: Processes | None = None


_POOLS = _Pools()


def _results(works: Sequence[Work]) -> list[Crossing]:
    """The results of works, in their order."""
    results: dict[int, Crossing] = {}
    left = list(works)
    pool = _POOLS.pool = _POOLS.pool or new_pool()
    try:
        pool.wait_until_warm()
        while left or pool.is_busy:
            while left and not pool.is_full:
                pool.start(left.pop(0))
            for work, result in pool.finished(_WAIT_S):
                results[work.number] = result
    except BaseException:
        # What it still works on is nobody's: the next batch gets another one.
        _POOLS.pool = None
        pool.close()
        raise
    return [results[work.number] for work in works]


def new_pool() -> Processes:
    """Where a thread of the worker has its crossings identified."""
    return Processes(1)
