"""Detection of hung processes: by their processor time, not by a clock alone.

On a loaded machine a healthy process may take a hundred times as long by the clock, and an hour
more if the machine slept. So the measure is the processor time used, and, because a process that
waits for ever uses none, the time without any use. Linux provides both; elsewhere no process counts
as hung.
"""

import os
from pathlib import Path
from typing import Final, NamedTuple

LIMIT_S: Final = 900.0
"""Limit of processor time for one crossing in s, all threads together.

A usual crossing takes 10 s (docs/worker.md); one that takes ninety times as long does not end.
"""
IDLE_S: Final = 300.0
"""Longest time in s without any use of the processor, such as reading from a slow disk."""
_LONGEST_STEP_S: Final = 1.0
"""Longest time in s that counts between two checks.

The checking process may have been stopped, and the checked one with it.
"""
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")


class TaskLimits(NamedTuple):
    """Limits of a process for one task."""

    processor_s: float = LIMIT_S
    idle_s: float = IDLE_S
    start_processor_s: float = LIMIT_S
    """Limit of processor time of the start, before the task."""


class HangWatchdog:
    """Watchdog of a process during its start or one task."""

    def __init__(self, pid: int, limits: TaskLimits, now_s: float, *, starts: bool = False) -> None:
        """Begin to watch a start or a task; `now_s` is the time by any steady clock."""
        self.starts = starts
        self._pid = pid
        self._processor_s = limits.start_processor_s if starts else limits.processor_s
        self._most_idle_s = limits.idle_s
        self._checked_s = now_s
        self._began = self._used_s = processor_time_s(pid)
        self._idle_s = 0.0

    def why_hung(self, now_s: float) -> str:
        """Return the reason why the process counts as hung; empty if it does not."""
        used_s = processor_time_s(self._pid)
        step_s = min(now_s - self._checked_s, _LONGEST_STEP_S)
        self._checked_s = now_s
        if used_s is None or self._began is None:
            return ""
        self._idle_s = 0.0 if used_s != self._used_s else self._idle_s + step_s
        self._used_s = used_s
        if used_s - self._began > self._processor_s:
            return f"has taken more than {self._processor_s:g} s of processor time"
        if self._idle_s > self._most_idle_s:
            return f"has done nothing for {self._most_idle_s:g} s"
        return ""


def processor_time_s(pid: int) -> float | None:
    """Return the processor time of a process, all threads together, in s; None if unknown."""
    try:
        # The name, in parentheses, may contain anything.
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
    except (OSError, ValueError, IndexError):
        return None
