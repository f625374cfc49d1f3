"""Whether a process that works on something is hung: by what it has taken, not by a clock alone.

On a loaded machine a sound process may take a hundred times as long by the clock, and one whose
machine slept an hour more. So what counts is the processor time that it has taken; and, because who
waits for ever takes none, how long it has taken nothing. Linux tells both; elsewhere nothing is
hung.
"""

import os
from pathlib import Path
from typing import Final, NamedTuple

LIMIT_S: Final = 900.0
"""Processor time of one crossing, all threads together. A usual one takes 10 s (docs/worker.md):
what takes ninety times as long comes to no end."""
IDLE_S: Final = 300.0
"""So long may it take no processor time at all, as for what it has to read from a slow disk."""
_LONGEST_STEP_S: Final = 1.0
"""Of the time between two looks no more counts: who looks may have been stopped, and the process
with it."""
_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")


class Limits(NamedTuple):
    """What a process may take for one piece of work."""

    processor_s: float = LIMIT_S
    idle_s: float = IDLE_S


class Watch:
    """Looks now and then at a process while it works on one thing."""

    def __init__(self, pid: int, limits: Limits, now_s: float) -> None:
        """`now_s` is the time by any steady clock."""
        self._pid = pid
        self._limits = limits
        self._looked_s = now_s
        self._began = self._taken = processor_time_s(pid)
        self._idle_s = 0.0

    def why_hung(self, now_s: float) -> str:
        """Why the process is taken to be hung, in a few words; empty if it is not."""
        taken = processor_time_s(self._pid)
        step_s = min(now_s - self._looked_s, _LONGEST_STEP_S)
        self._looked_s = now_s
        if taken is None or self._began is None:
            return ""
        self._idle_s = 0.0 if taken != self._taken else self._idle_s + step_s
        self._taken = taken
        if taken - self._began > self._limits.processor_s:
            return f"has taken more than {self._limits.processor_s:g} s of processor time"
        if self._idle_s > self._limits.idle_s:
            return f"has done nothing for {self._limits.idle_s:g} s"
        return ""


def processor_time_s(pid: int) -> float | None:
    """Processor time that a process has taken, all its threads together; None if nobody tells."""
    try:
        # The name, in parentheses, may hold anything.
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
    except (OSError, ValueError, IndexError):
        return None
