"""Crossings in processes of their own: the same results, whatever becomes of a process."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from schemas.results import BridgeResult, CrossingResult
from services.common.errors import FailureError
from services.execution.dispatch import TaskResult
from services.execution.hang_watchdog import TaskLimits
from services.execution.processes import BackgroundResult, BackgroundTask, ProcessExecutor
from services.identification.bridge_state import (
    NOTHING_STORED,
    RecentCrossings,
    add_crossings,
    state_of,
    usable,
)
from services.identification.engine import Engine
from services.identification.outputs import FusionTask, IdentificationTask
from tests import prepared
from tests.identifications import Identifications
from tests.unit.execution.in_processes import (
    after_a_signal,
    bad,
    broken,
    busy,
    deadly,
    deadly_once,
    die,
    dies,
    dies_once,
    for_ever,
    hung_once,
    named_by_number,
    no_answer,
    nothing,
    quick,
    sleep_at_the_second_start,
    sleep_for_ever,
    slow,
    two_of,
    wait_for,
)
from tests.unit.identification.test_engine_resume import (
    HEADER,
    SETTINGS,
    SITE,
    THERE_AND_BACK,
    TWO,
    WHOLE,
    messages_of,
)
from tests.unit.identification.test_fusing import crossing
from tests.waiting import LONGEST_S, until
from tests.working_engine import feed_all


def works() -> list[IdentificationTask]:
    engine = Engine(SITE, SETTINGS, HEADER)
    printed = [one for m in TWO for one in engine.feed(m.key, m.payload)]
    return [one for one in printed if isinstance(one, IdentificationTask)]


def all_of(processes: ProcessExecutor) -> list[TaskResult]:
    found: list[TaskResult] = []
    deadline = time.monotonic() + LONGEST_S
    while processes.is_busy and time.monotonic() < deadline:
        found += processes.collect(0.1)
    assert not processes.is_busy
    return found


def test_signals_to_the_group_are_left_to_the_parent_while_a_process_starts() -> None:
    before = set(multiprocessing.active_children())
    with ProcessExecutor(1, prepare=nothing) as processes:
        (child,) = set(multiprocessing.active_children()) - before
        assert child.pid is not None
        for number in (signal.SIGINT, signal.SIGTERM):
            os.kill(child.pid, number)
        processes.wait_until_warm()
    assert not {signal.SIGINT, signal.SIGTERM} & signal.pthread_sigmask(signal.SIG_BLOCK, ())


# That test is of the start of a process that multiprocessing spawns; the others are of what becomes
# of it, and a fork has no imports.
forked = pytest.mark.usefixtures("forked_spawns")


def pairs() -> Iterator[Any]:
    return ((m.key, m.payload) for m in TWO)


@forked
@pytest.mark.parametrize("number", [1, 2])
def test_the_bytes_are_those_of_one_process(number: int) -> None:
    reported: list[tuple[str, str, float]] = []
    with ProcessExecutor(
        number, identify=quick, prepare=nothing, report=lambda *how: reported.append(how)
    ) as processes:
        processes.wait_until_warm()
        outputs = list(feed_all(Engine(SITE, SETTINGS, HEADER), processes, pairs()))
    assert [(o.key, o.payload) for o in by_stream(outputs)] == [
        (o.key, o.payload) for o in by_stream(WHOLE)
    ]
    streams = [o.key.stream for o in outputs if o.key.stream != "crossing"]
    # Two processes may have found the second one before the first is fused.
    found_first = ["estimate", "estimate", "state", "state"]
    assert streams == ["estimate", "state"] * 2 or (number == 2 and streams == found_first)
    names = {o.result.crossing_id for o in WHOLE if o.result}
    until(lambda: {(name, "half", 0.5) for name in names} <= set(reported), "progress of both")
    # The second waits for the only process, where there is one.
    assert {stage for _, stage, _ in reported} <= {"half", "waiting for a process"}


def by_stream(outputs: list[Any]) -> list[Any]:
    """States of crossings may be published while another crossing is identified."""
    return sorted(outputs, key=lambda o: (o.key.stream, o.payload * (o.key.stream == "crossing")))


@forked
def test_a_process_that_dies_twice_costs_its_own_crossing_only(
    caplog: pytest.LogCaptureFixture,
) -> None:
    first, second = works()
    with ProcessExecutor(1, identify=deadly, prepare=nothing) as processes:
        for work in (second, first):
            processes.submit(work)
        results = {work.number: result for work, result in all_of(processes)}
    assert results[first.number].verdict == "good"
    assert results[second.number].reasons == ("failed",)
    assert results[second.number].speed_m_per_s == pytest.approx(10.0, rel=0.01)
    printed = [record.getMessage() for record in caplog.records]
    assert sum("retrying once" in text for text in printed) == 1


@forked
def test_a_process_that_dies_once_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEADLY_ONCE", str(tmp_path))
    with ProcessExecutor(2, identify=deadly_once, prepare=nothing) as processes:
        for work in works():
            processes.submit(work)
        results = [result for _, result in all_of(processes)]
    assert [result.verdict for result in results] == ["good", "good"]
    assert len(list(tmp_path.iterdir())) == 2


@forked
@pytest.mark.parametrize(
    ("search", "limits", "why"),
    [
        (slow, TaskLimits(idle_s=1.0), "has done nothing for 1 s"),
        # Less than the start of the process takes, which does not count.
        (busy, TaskLimits(processor_s=0.5), "has taken more than 0.5 s of processor time"),
    ],
)
def test_a_hung_process_is_ended_and_its_crossing_fails_at_the_second_time(
    search: Callable[..., CrossingResult],
    limits: TaskLimits,
    why: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    reported: list[tuple[str, str, float]] = []
    (first, second) = works()
    with ProcessExecutor(
        1, identify=search, prepare=nothing, limits=limits, report=lambda *how: reported.append(how)
    ) as processes:
        processes.submit(first)
        processes.submit(second)
        assert (second.crossing_id, "waiting for a process", 0.0) in reported
        assert [one.crossing_id for one in processes.running] == [first.crossing_id]
        assert processes.waiting == 1
        results = {work.number: result for work, result in all_of(processes)}
        assert (processes.running, processes.waiting) == ([], 0)
    assert results[first.number].reasons == ("failed",)
    printed = [record.getMessage() for record in caplog.records]
    hung = f"the process that works on {first.crossing_id} {why}; ending it"
    assert printed.count(hung) == 2
    assert sum(f"{first.crossing_id} died; retrying once" in text for text in printed) == 1
    assert (results[second.number].verdict == "good") == (search is busy)


@forked
def test_a_process_that_is_hung_once_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEADLY_ONCE", str(tmp_path))
    limits = TaskLimits(idle_s=1.0)
    with ProcessExecutor(1, identify=hung_once, prepare=nothing, limits=limits) as processes:
        processes.submit(works()[0])
        (finished,) = all_of(processes)
    assert finished.result.verdict == "good"


@forked
def test_an_aside_that_is_hung_makes_room(caplog: pytest.LogCaptureFixture) -> None:
    (work, _) = works()
    with ProcessExecutor(
        1, identify=quick, prepare=nothing, limits=TaskLimits(idle_s=1.0)
    ) as processes:
        processes.submit_background(BackgroundTask("for ever", partial(time.sleep, 1e6)))
        processes.submit(work)
        (finished,) = all_of(processes)
    assert finished.result.verdict == "good"


@forked
def test_an_error_in_a_process_is_a_verdict(caplog: pytest.LogCaptureFixture) -> None:
    (work, _) = works()
    with ProcessExecutor(1, identify=broken, prepare=nothing) as processes:
        processes.submit(work)
        (finished,) = all_of(processes)
    assert finished.task.number == work.number
    assert finished.result.reasons == ("failed",)
    assert "singular" in caplog.text


@forked
def test_a_process_that_cannot_begin_is_a_failure() -> None:
    with (
        ProcessExecutor(1, identify=quick, prepare=die) as processes,
        pytest.raises(FailureError, match="died while it was started"),
    ):
        processes.wait_until_warm()


@forked
def test_a_process_that_hangs_while_it_is_started_is_ended(
    caplog: pytest.LogCaptureFixture,
) -> None:
    limits = TaskLimits(idle_s=1.0)
    with (
        ProcessExecutor(1, identify=quick, prepare=sleep_for_ever, limits=limits) as processes,
        pytest.raises(FailureError, match="died while it was started"),
    ):
        processes.wait_until_warm()
    assert "the process that is being started has done nothing for 1 s; ending it" in caplog.text


@forked
def test_one_that_hangs_at_a_later_start_costs_one_crossing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The first dies at its work, the second never begins."""
    monkeypatch.setenv("DEADLY_ONCE", str(tmp_path))
    first, second = works()
    with ProcessExecutor(
        1, identify=deadly_once, prepare=sleep_at_the_second_start, limits=TaskLimits(idle_s=4.0)
    ) as processes:
        processes.wait_until_warm()
        processes.submit(first)
        (one,) = all_of(processes)
        (tmp_path / second.crossing_id).touch()  # it kills nobody
        processes.submit(second)
        (other,) = all_of(processes)
    assert one.result.reasons == ("failed",)
    assert other.result.verdict == "good"
    assert caplog.text.count("the process that is being started has done nothing") == 1


@forked
def test_more_than_a_few_wait_elsewhere() -> None:
    (work, _) = works()
    with ProcessExecutor(1, identify=slow, prepare=nothing) as processes:
        full, room = [], []
        for _ in range(3):
            room.append(processes.has_room)
            processes.submit(work)
            full.append(processes.is_full)
        assert full == [False, False, True]
        assert room == [True, True, False]
        assert processes.is_busy
        assert processes.collect() == []


STARTER = """
import os, signal, sys, time
from services.execution.processes import ProcessExecutor
from tests.unit.execution.in_processes import nothing, slow
from tests.unit.execution.test_processes import works
processes = ProcessExecutor(1, identify=slow, prepare=nothing)
processes.wait_until_warm()
processes.submit(works()[0])
import multiprocessing
pid = multiprocessing.active_children()[0].pid
print(pid, flush=True)
if sys.argv[1] == "kill":
    time.sleep(1000.0)
if sys.argv[1] == "close one that is frozen":
    os.kill(pid, signal.SIGSTOP)
processes.close()
"""


@pytest.mark.process
@pytest.mark.parametrize("end", ["close", "close one that is frozen", "kill"])
def test_no_process_outlives_its_parent(end: str) -> None:
    """Neither one that is closed in the middle of an identification, nor one that is killed.

    One that is frozen sees nothing of that, and its starter would wait for it when it ends.
    """
    command = [sys.executable, "-c", STARTER, end]
    with prepared.Popen(command, has_server=True, stdout=subprocess.PIPE) as starter:
        assert starter.stdout is not None
        pid = int(starter.stdout.readline())
        if end == "kill":
            starter.kill()
        starter.wait(LONGEST_S)
    deadline = time.monotonic() + LONGEST_S
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{pid}").exists()


def test_results_may_come_back_in_any_order() -> None:
    """The published state of a bridge is the same; the second waits for the first."""
    more = messages_of(*THERE_AND_BACK, (60.0, -60.0), (80.0, 140.0))
    orders = {}
    for order in ((0, 1, 2), (2, 1, 0), (1, 0, 2)):
        engine = Engine(SITE, SETTINGS, HEADER)
        printed = [one for m in more for one in engine.feed(m.key, m.payload)]
        printed += list(engine.finish())
        found = [one for one in printed if isinstance(one, IdentificationTask)]
        assert len(found) == 3
        reported = []
        for n in order:
            result = Identifications()(found[n].data, SETTINGS, stopwatch=lambda: 0.0)
            reported.append([*engine.done(found[n], result)])
        orders[order] = [output for outputs in reported for output in outputs]
        if order == (2, 1, 0):
            assert [len(outputs) for outputs in reported] == [0, 0, 9]
        with pytest.raises(KeyError):
            list(engine.done(found[0], result))
    first, *others = orders.values()
    assert all(other == first for other in others)


# Crossings that are fused


def fuse_of(number: int, bridge: str = "bridge-1") -> FusionTask:
    return FusionTask("live", bridge, RecentCrossings((), number), NOTHING_STORED, 1.0 * number)


@pytest.fixture
def marks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DEADLY_ONCE", str(tmp_path))
    return tmp_path


def begun(marks: Path) -> list[str]:
    """What was begun to be fused, in order of time."""
    names = sorted(path.name for path in marks.iterdir() if path.name[0].isdigit())
    return [name.partition(" ")[2] for name in names]


def all_fused(processes: ProcessExecutor) -> list[tuple[str, int | None]]:
    found = []
    deadline = time.monotonic() + LONGEST_S
    while processes.is_busy and time.monotonic() < deadline:
        assert processes.collect(0.1) == []
        for fuse, state in processes.collect_fusions():
            found.append((fuse.bridge, state and state.crossings_left_out_count))
    assert not processes.is_busy
    return found


@forked
def test_of_one_bridge_only_the_newest_waits_while_one_is_fused(marks: Path) -> None:
    """The first is under way; of the three behind it only the last is fused."""
    with ProcessExecutor(2, identify=quick, state_of=after_a_signal, prepare=nothing) as processes:
        processes.submit_fusion(fuse_of(1))
        until(lambda: begun(marks) == ["bridge-1 1"], "the first")
        for number in (2, 3, 4):
            processes.submit_fusion(fuse_of(number))
        processes.submit_fusion(fuse_of(5, "other"))
        until(lambda: len(begun(marks)) == 2, "the other bridge's, in the other process")
        assert begun(marks) == ["bridge-1 1", "other 5"]
        assert not processes.is_idle
        assert not processes.is_full
        (marks / "go on").touch()
        found = all_fused(processes)
    assert sorted(found) == [("bridge-1", 1), ("bridge-1", 4), ("other", 5)]
    assert found.index(("bridge-1", 1)) < found.index(("bridge-1", 4))


@forked
def test_a_state_comes_before_the_crossings_that_wait(marks: Path) -> None:
    first, second = works()
    with ProcessExecutor(1, identify=quick, state_of=named_by_number, prepare=nothing) as processes:
        processes.submit(first)
        processes.submit(second)
        finished: list[TaskResult] = []
        deadline = time.monotonic() + LONGEST_S
        while not finished and time.monotonic() < deadline:
            finished = processes.collect(0.1)
        processes.submit_fusion(fuse_of(1))
        assert (processes.waiting, processes.running) == (1, [])
        rest: list[TaskResult] = []
        while processes.is_busy and time.monotonic() < deadline:
            if now := processes.collect_fusions():
                assert (len(now), rest) == (1, [])
            rest += processes.collect(0.1)
    assert [work.number for work, _ in finished + rest] == [first.number, second.number]
    assert begun(marks) == ["bridge-1 1"]


@forked
@pytest.mark.parametrize(
    ("make", "limits"),
    [(dies, TaskLimits()), (for_ever, TaskLimits(idle_s=1.0)), (bad, TaskLimits())],
)
def test_what_cannot_be_fused_costs_its_own_state_only(
    make: Callable[..., BridgeResult],
    limits: TaskLimits,
    marks: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with ProcessExecutor(
        1, identify=quick, state_of=make, prepare=nothing, limits=limits
    ) as processes:
        processes.submit_fusion(fuse_of(1))
        assert all_fused(processes) == [("bridge-1", None)]
        processes.submit(works()[0])
        (finished,) = all_of(processes)
    assert finished.result.verdict == "good"
    printed = [record.getMessage() for record in caplog.records]
    again = "the process that worked on the state of bridge-1 died; retrying once"
    assert printed.count(again) == (make is not bad)
    assert any("the state of bridge-1 died again" in text for text in printed) == (make is not bad)


@forked
def test_a_process_that_dies_once_while_it_fuses_costs_nothing(marks: Path) -> None:
    """Meanwhile a newer set has come: that is the one that is tried."""
    with ProcessExecutor(1, identify=quick, state_of=dies_once, prepare=nothing) as processes:
        processes.submit_fusion(fuse_of(1))
        processes.submit_fusion(fuse_of(2))
        assert all_fused(processes) == [("bridge-1", 2)]


@forked
def test_numbers_of_a_state_are_those_of_this_process() -> None:
    """To the last bit, of a fusion that has something to fuse."""
    three = [usable(crossing(number)) for number in range(3)]
    counted = add_crossings(RecentCrossings(), [one for one in three if one is not None])
    fuse = FusionTask("live", "bridge-1", counted, NOTHING_STORED, 1.0)
    with ProcessExecutor(1, identify=quick, prepare=nothing) as processes:
        processes.submit_fusion(fuse)
        deadline = time.monotonic() + LONGEST_S
        while not (found := processes.collect_fusions()) and time.monotonic() < deadline:
            processes.collect(0.1)
    assert found == [(fuse, state_of(counted, "bridge-1", NOTHING_STORED))]
    assert found[0].state is not None
    assert found[0].state.between_crossing_std


# What is computed aside


def until_over(processes: ProcessExecutor, number: int) -> list[BackgroundResult]:
    found: list[BackgroundResult] = []
    deadline = time.monotonic() + LONGEST_S
    while len(found) < number and time.monotonic() < deadline:
        assert processes.collect(0.1) == []
        found += processes.collect_background()
    assert len(found) == number
    return found


@forked
def test_what_is_computed_aside_comes_back_and_keeps_nobody_waiting() -> None:
    with ProcessExecutor(2, identify=quick, prepare=nothing) as processes:
        assert processes.wants_background
        processes.submit_background(BackgroundTask("one", partial(two_of, 1)))
        processes.submit_background(BackgroundTask("other", partial(two_of, 2)))
        assert not processes.wants_background
        assert not processes.is_busy  # nobody waits for it at the end
        assert not processes.is_full
        found = until_over(processes, 2)
        assert processes.wants_background
    assert {(task.name, outcome) for task, outcome in found} == {("one", 2), ("other", 4)}


@forked
@pytest.mark.parametrize("run", [die, no_answer])
def test_what_cannot_be_computed_aside_costs_nothing_else(run: Callable[[], None]) -> None:
    (work, _) = works()
    with ProcessExecutor(1, identify=quick, prepare=nothing) as processes:
        processes.submit_background(BackgroundTask("bad", run))
        ((task, outcome),) = until_over(processes, 1)
        assert (task.name, outcome) == ("bad", None)
        processes.submit(work)
        (finished,) = all_of(processes)
    assert finished.result.verdict == "good"


@forked
def test_a_crossing_comes_before_whatever_waits_aside(tmp_path: Path) -> None:
    """Three wait; the crossing that comes then waits for the first only."""
    (work, _) = works()
    marks = [str(tmp_path / name) for name in "abc"]
    with ProcessExecutor(1, identify=quick, prepare=nothing) as processes:
        for mark in marks:
            processes.submit_background(BackgroundTask(mark, partial(wait_for, mark)))
        processes.submit(work)
        Path(marks[0]).touch()
        (finished,) = all_of(processes)
        assert finished.result.verdict == "good"
        assert [task.name for task, _ in processes.collect_background()] == marks[:1]
        processes.cancel_background()
        Path(marks[1]).touch()
        assert [task.name for task, _ in until_over(processes, 1)] == marks[1:2]
        assert processes.collect(0.1) == []
        assert processes.wants_background


def test_end_at_a_second_signal_prints_nothing_of_leaked_semaphores() -> None:
    """A worker leaves at once; the tracker of resources cleans up, which needs no warning."""
    code = (
        "import os, time\n"
        "from services.execution.processes import ProcessExecutor\n"
        "if __name__ == '__main__':\n"
        "    ProcessExecutor(1, prepare=time.time)\n"
        "    os._exit(130)\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert (ended.returncode, ended.stderr) == (130, "")
