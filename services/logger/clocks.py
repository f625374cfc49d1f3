"""What the clocks of trucks and logger say of each other: steps and drift. No clock of its own.

A truck's messages carry its wall time and its monotonic device time; their difference is constant
but for drift, so a jump in it is a step of the truck's wall clock. The logger's own wall clock is
compared with its monotonic clock in the same way. How far the two wall clocks are apart is seen in
arrival time minus wall time: delays on the way only add to it, so the smallest value of each minute
is the offset plus the shortest way (an upper bound of how far the truck is behind), and its slope
over the minutes, as the median over all pairs (Theil-Sen), the drift.
"""

from collections import deque
from dataclasses import dataclass, field
from itertools import combinations
from statistics import median
from typing import NamedTuple

STEP_NS = 500_000_000
"""A smaller jump is left to the drift: clocks that are steered slew by less."""
_MINUTE_NS = 60_000_000_000
_MINUTES = 60
"""Drift is the slope over the last hour."""
_PAIRS_FROM = 3
"""The slope of fewer minutes is that of their delays."""
_OFFSET_MINUTES = 5
"""The offset is the median over so many minutes: recent, and not that of one bad one."""
_TOLD_EVERY_S = 600.0
"""How often at most an event tells of a drift."""
_CHANGE_S = 0.05
"""An offset that has moved by less is not told again."""


class ClockDrift(NamedTuple):
    """A truck's wall clock against the logger's."""

    offset_s: float
    """How far the truck is behind the logger, plus the shortest delay on the way."""
    drift_ppm: float | None
    """How much slower the truck's clock runs; None: less than three minutes are known."""


def clock_step_ns(before_ns: int | None, offset_ns: int) -> int:
    """Return by how much (wall minus monotonic) has jumped; 0 if that is no step."""
    if before_ns is None:
        return 0
    step_ns = offset_ns - before_ns
    return step_ns if abs(step_ns) >= STEP_NS else 0


@dataclass
class TruckClock:
    """One truck in one boot."""

    boot_id: int
    step_reference_ns: int | None = None
    """Wall minus device time of the message with the highest sequence so far."""
    _minutes: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_MINUTES))
    _smallest: tuple[int, int] | None = None
    _began_ns: int | None = None
    _drift: ClockDrift | None = None
    """What the minutes that are over give: it changes once a minute and is asked for every
    second."""
    _told: tuple[float, float] | None = None

    def wall_against_device(self, wall_ns: int, device_ns: int) -> int:
        """Note a message's two times, in order of sequence; return the step in ns or 0."""
        offset_ns = wall_ns - device_ns
        step_ns = clock_step_ns(self.step_reference_ns, offset_ns)
        self.step_reference_ns = offset_ns
        if step_ns:
            self.forget()  # the envelope before the step says nothing of the clock after it
        return step_ns

    def arrived(self, wall_ns: int, arrival_ns: int) -> None:
        """Note a live message: its wall time, and the logger's wall time when it came.

        Messages that were fetched again must not be given: they come late by nature.
        """
        delay_ns = arrival_ns - wall_ns
        if self._began_ns is None or not 0 <= arrival_ns - self._began_ns < _MINUTE_NS:
            if self._smallest is not None:
                self._minutes.append(self._smallest)
                self._drift = self._fitted()
            self._began_ns, self._smallest = arrival_ns, (arrival_ns, delay_ns)
        elif self._smallest is None or delay_ns < self._smallest[1]:
            self._smallest = (arrival_ns, delay_ns)

    def drift(self) -> ClockDrift | None:
        """Return offset and drift over the last hour; None in the first minute."""
        return self._drift

    def due(self, now_s: float) -> ClockDrift | None:
        """Return the drift if it should be written down: first, and when it has moved by 50 ms.

        `now_s` is a monotonic clock: at most one in ten minutes.
        """
        drift = self.drift()
        if drift is None:
            return None
        if self._told is not None:
            told_s, told_offset_s = self._told
            moved_s = abs(drift.offset_s - told_offset_s)
            if now_s - told_s < _TOLD_EVERY_S or moved_s < _CHANGE_S:
                return None
        self._told = (now_s, drift.offset_s)
        return drift

    def _fitted(self) -> ClockDrift:
        slopes = [
            (b[1] - a[1]) / (b[0] - a[0]) for a, b in combinations(self._minutes, 2) if b[0] > a[0]
        ]
        ppm = median(slopes) * 1e6 if len(self._minutes) >= _PAIRS_FROM and slopes else None
        # Over several minutes: one in which all came late would look like a clock that is behind.
        recent = list(self._minutes)[-_OFFSET_MINUTES:]
        offset_ns = round(median(delay_ns for _, delay_ns in recent))
        return ClockDrift(offset_ns * 1e-9, ppm)

    def forget(self) -> None:
        """Begin the envelope anew, after a step of either clock."""
        self._minutes.clear()
        self._drift = None
        self._smallest = None
        self._began_ns = None
