"""Steps and drift between the clocks of trucks and logger. No clock of its own.

A truck's messages carry its wall time and its monotonic device time. Their difference is constant
except for drift, so a jump in it is a step of the truck's wall clock. The logger's own wall clock
is compared with its monotonic clock in the same way. The offset of the two wall clocks shows in
arrival time minus wall time. Delays only add to it, so the smallest value of each minute is the
offset plus the shortest delay (an upper bound of the truck's lag). Its slope over the minutes, as
the median over all pairs (Theil-Sen), is the drift.
"""

from collections import deque
from dataclasses import dataclass, field
from itertools import combinations
from statistics import median
from typing import NamedTuple

from services.common.naming import offset_in_words

STEP_NS = 500_000_000
"""Smallest step; a smaller jump counts as drift, because steered clocks slew by less."""
_SURELY_BEHIND_NS = 86_400_000_000_000
"""Offset that no delay explains, so that the first message shows it."""
_MINUTE_NS = 60_000_000_000
_MINUTES = 60
"""Number of minutes in the slope."""
_PAIRS_FROM = 3
"""Fewest minutes; a slope over fewer reflects their delays."""
_OFFSET_MINUTES = 5
"""Number of minutes in the median offset: recent, and robust against a bad one."""
_REPORT_EVERY_S = 600.0
"""Shortest interval of events on a drift."""
_CHANGE_S = 0.05
"""Smallest change of an offset that is reported again."""


class ClockDrift(NamedTuple):
    """Offset and drift of a truck's wall clock against the logger's."""

    offset_s: float
    """Lag of the truck behind the logger, plus the shortest delay; negative: it is ahead."""
    drift_ppm: float | None
    """Rate by which the truck's clock is slow; None within the first three minutes."""

    def __str__(self) -> str:
        """Return how far the truck's clock is behind or ahead."""
        direction = "ahead of" if self.offset_s < 0.0 else "behind"
        return f"{offset_in_words(abs(self.offset_s), 3)} {direction} the logger's"


def clock_step_ns(before_ns: int | None, offset_ns: int) -> int:
    """Return the jump of wall minus monotonic time; 0 if it is not a step."""
    if before_ns is None:
        return 0
    step_ns = offset_ns - before_ns
    return step_ns if abs(step_ns) >= STEP_NS else 0


@dataclass
class TruckClock:
    """The clock of one truck in one boot."""

    boot_id: int
    step_reference_ns: int | None = None
    """Wall minus device time of the message with the highest sequence so far."""
    _minutes: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=_MINUTES))
    _smallest: tuple[int, int] | None = None
    _began_ns: int | None = None
    _drift: ClockDrift | None = None
    """Fit over complete minutes, computed once a minute and requested every second."""
    _reported: tuple[float, float] | None = None
    _is_stepped: bool = False

    def wall_against_device(self, wall_ns: int, device_ns: int) -> int:
        """Note a message's two times, in order of sequence; return the step in ns or 0."""
        offset_ns = wall_ns - device_ns
        step_ns = clock_step_ns(self.step_reference_ns, offset_ns)
        self.step_reference_ns = offset_ns
        if step_ns:
            self.forget()  # the envelope before the step does not apply after it
        return step_ns

    def arrived(self, wall_ns: int, arrival_ns: int) -> None:
        """Note the wall time of a live message, and the logger's wall time at its arrival.

        Exclude messages that were fetched again, which are late by nature.
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
        """Return offset and drift over the last hour; None in the first minute.

        A clock that is ahead, or a day behind, is known at once: no delay explains either.
        After a step, which has an event of its own, the result is None for a minute.
        """
        if self._drift is not None or self._is_stepped or self._smallest is None:
            return self._drift
        delay_ns = self._smallest[1]
        is_certain = delay_ns <= -STEP_NS or delay_ns >= _SURELY_BEHIND_NS
        return ClockDrift(delay_ns * 1e-9, None) if is_certain else None

    def due(self, now_s: float) -> ClockDrift | None:
        """Return the drift if it should be recorded: first, and when it has moved by 50 ms.

        `now_s` is a monotonic clock: at most once in ten minutes.
        """
        drift = self.drift()
        if drift is None:
            return None
        if self._reported is not None:
            reported_s, reported_offset_s = self._reported
            moved_s = abs(drift.offset_s - reported_offset_s)
            if now_s - reported_s < _REPORT_EVERY_S or moved_s < _CHANGE_S:
                return None
        self._reported = (now_s, drift.offset_s)
        return drift

    def _fitted(self) -> ClockDrift:
        slopes = [
            (b[1] - a[1]) / (b[0] - a[0]) for a, b in combinations(self._minutes, 2) if b[0] > a[0]
        ]
        ppm = median(slopes) * 1e6 if len(self._minutes) >= _PAIRS_FROM and slopes else None
        # Over several minutes: one with late messages only would look like a slow clock.
        recent = list(self._minutes)[-_OFFSET_MINUTES:]
        offset_ns = round(median(delay_ns for _, delay_ns in recent))
        return ClockDrift(offset_ns * 1e-9, ppm)

    def forget(self) -> None:
        """Restart the envelope after a step of either clock."""
        self._is_stepped = True
        self._minutes.clear()
        self._drift = None
        self._smallest = None
        self._began_ns = None
