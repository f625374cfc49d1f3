"""A cluster whose scheduler and workers go at the worst moment; Dask is played by a few lines."""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any, Literal

import pytest

from services.common.errors import FailureError
from services.execution import cluster
from services.execution.cluster import DaskExecutor
from services.execution.cluster_worker import BatchRefusal, packed, unpacked
from services.execution.dispatch import TaskResult, failed_result
from services.execution.scheduler import Scheduler, connect, threads_of
from services.identification.outputs import IdentificationTask
from tests.unit.execution.test_processes import works
from tests.waiting import until

ADDRESS = "tcp://127.0.0.1:8786"


class Future:
    """A batch that is with the scheduler; its crossings are all `failed`."""

    def __init__(self, batch: bytes) -> None:
        self.status: Literal["pending", "finished", "lost", "cancelled"] = "finished"
        self.given: bytes | BatchRefusal | None = packed(
            failed_result(work) for work in unpacked(batch)
        )
        """None: it does not come."""
        self.asked = 0

    def result(self, timeout: float) -> bytes | BatchRefusal:
        self.asked += 1
        if self.given is None:
            raise TimeoutError
        return self.given

    def release(self) -> None:
        """Nothing is kept."""


class Client:
    """What of Dask's client is used. Each method may be replaced by one that raises."""

    status = "running"

    def __init__(self) -> None:
        self.scheduler = self
        self.sent: list[Future] = []

    def sync(self, ask: Callable[[], Any], callback_timeout: float) -> Any:
        return asyncio.run(ask())

    async def identity(self) -> dict[str, Any]:
        return {"workers": {"tcp://127.0.0.1:1": {"nthreads": 1}}}

    async def get_versions(self, packages: list[str]) -> dict[str, Any]:
        return {"workers": {}}

    async def run(self, *_: Any, **__: Any) -> dict[str, Any]:
        return {}

    async def retire_workers(self, *_: Any, **__: Any) -> None:
        """It goes."""

    def submit(self, function: Any, batch: bytes, *_: Any, **__: Any) -> Any:
        self.sent.append(Future(batch))
        return self.sent[-1]

    def close(self, timeout: float) -> None:
        self.status = "closed"


@pytest.fixture
def clients(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Client]]:
    """Those that will connect, the next one first; each that does is put off the list."""
    waiting = [Client(), Client()]
    monkeypatch.setattr(cluster, "_RETRY_S", 0.0)
    monkeypatch.setattr(cluster, "connect", lambda *_: Scheduler(ADDRESS, waiting.pop(0)))
    return waiting


def gone(*_: Any, **__: Any) -> Any:
    raise OSError("the connection is closed")


def all_of(on: DaskExecutor) -> list[TaskResult]:
    found: list[TaskResult] = []
    until(lambda: found.extend(on.collect(0.01)) or not on.is_busy)
    return found


def is_each_once(found: list[TaskResult], given: list[IdentificationTask]) -> bool:
    return sorted(one.task.number for one in found) == sorted(work.number for work in given)


def test_a_result_that_goes_with_its_worker_is_waited_for(
    clients: list[Client], caplog: pytest.LogCaptureFixture
) -> None:
    """The scheduler has it made again, and is not gone."""
    first = clients[0]
    given = works()
    with DaskExecutor(ADDRESS, batch=len(given)) as on:
        for work in given:
            on.submit(work)
        (future,) = first.sent
        future.status = "lost"
        assert on.collect(0.01) == []
        future.status = "finished"
        assert is_each_once(all_of(on), given)
    assert len(clients) == 1
    assert caplog.messages == []


def test_a_batch_that_cannot_be_sent_goes_to_the_next_scheduler(clients: list[Client]) -> None:
    first, second = clients
    given = works()
    with DaskExecutor(ADDRESS, batch=len(given)) as on:
        first.submit = gone  # type: ignore[method-assign]
        for work in given:
            on.submit(work)
        assert is_each_once(all_of(on), given)
    assert (len(first.sent), len(second.sent)) == (0, 1)


def test_an_answer_that_does_not_come_keeps_no_other_one_up(clients: list[Client]) -> None:
    (first, *_), given = clients, works()
    with DaskExecutor(ADDRESS, batch=1) as on:
        for work in given:
            on.submit(work)
        late, other = first.sent
        there, late.given = late.given, None
        assert on.collect() == []
        assert (late.asked, other.asked) == (1, 0)  # and the scheduler is looked after
        (one,) = on.collect()
        assert one.task.number == given[1].number
        late.given = there
        assert is_each_once([one, *all_of(on)], given)


def test_a_worker_that_is_refused_may_have_gone_by_itself(clients: list[Client]) -> None:
    (first, *_), given = clients, works()
    first.retire_workers = gone  # type: ignore[method-assign]
    with DaskExecutor(ADDRESS, batch=len(given)) as on:
        for work in given:
            on.submit(work)
        first.sent[0].given = BatchRefusal("tcp://127.0.0.1:1", "has driveby 0.0.9")
        assert is_each_once(all_of(on), given)
    assert len(first.sent) == 2


@pytest.mark.parametrize("what", ["identity", "get_versions", "run"])
def test_a_scheduler_that_goes_while_it_is_asked_is_waited_for(
    clients: list[Client], what: str, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = clients
    setattr(first, what, gone)
    given = works()
    with DaskExecutor(ADDRESS, batch=len(given)) as on:
        for work in given:
            on.submit(work)
        assert is_each_once(all_of(on), given)
    assert (first.status, len(second.sent)) == ("closed", 1)
    (line,) = caplog.messages
    assert line.startswith(ADDRESS)


def test_waiting_for_a_scheduler_leaves_no_thread() -> None:
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        assert threads_of(address, None) == 0
        before = threading.active_count()
        for _ in range(2):
            with pytest.raises(FailureError, match="no scheduler answers"):
                connect(address, None, 0.1)
        assert threading.active_count() == before
