"""Which process is taken to be hung: by what it has taken, as far as anybody looked."""

import os
import time

import pytest

from services.execution import hang_watchdog
from services.execution.hang_watchdog import HangWatchdog, TaskLimits, processor_time_s

LIMITS = TaskLimits(processor_s=10.0, idle_s=5.0)


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[float | None]:
    """What the process has taken so far; the last item is what is read."""
    values: list[float | None] = [100.0]
    monkeypatch.setattr(hang_watchdog, "processor_time_s", lambda pid: values[-1])
    return values


def test_processor_time_counts_and_no_clock(taken: list[float | None]) -> None:
    """A hundredth of a processor for an hour is no hang."""
    one = HangWatchdog(1, LIMITS, 0.0)
    for second in range(1, 900):
        taken.append(100.0 + 0.01 * second)
        assert one.why_hung(float(second)) == ""
    taken.append(110.5)
    assert one.why_hung(900.0) == "has taken more than 10 s of processor time"


def test_idle_process_counts_as_hung_after_its_limit(taken: list[float | None]) -> None:
    one = HangWatchdog(1, LIMITS, 0.0)
    output = [one.why_hung(0.5 * n) for n in range(1, 12)]
    assert output == [""] * 10 + ["has done nothing for 5 s"]
    taken.append(100.01)
    assert one.why_hung(6.0) == ""


def test_a_time_in_which_nobody_looked_hardly_counts(taken: list[float | None]) -> None:
    """The machine slept for an hour, or who looks was stopped."""
    one = HangWatchdog(1, LIMITS, 0.0)
    assert one.why_hung(3600.0) == ""
    assert [one.why_hung(3600.0 + n) != "" for n in range(1, 6)] == [False] * 4 + [True]


def test_process_without_a_counter_never_counts_as_hung(taken: list[float | None]) -> None:
    one = HangWatchdog(1, LIMITS, 0.0)
    taken.append(None)
    assert all(one.why_hung(float(n)) == "" for n in range(100))


def test_the_processor_time_is_that_of_the_system() -> None:
    before = processor_time_s(os.getpid())
    began = time.process_time()
    while time.process_time() < began + 0.2:
        pass
    after = processor_time_s(os.getpid())
    assert before is not None
    assert after is not None
    assert after - before >= 0.15
    assert processor_time_s(2**22 + 1) is None
