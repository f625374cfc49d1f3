"""The clock of a live view: that of the samples, continued between messages."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from schemas.proto import driveby_pb2 as pb

_SOON_NS: Final = 120_000_000_000
"""Delay in ns after the exit beyond which a result is dated at the exit."""
_TICKS_S: Final = 20.0
"""Time in s for which the view's clock continues after the last message.

A state that has just started is visible by it. Then the clock stops, and the window of
accelerations still holds the last ones.
"""


class SampleClock:
    """Time of the newest sample, and the present by it."""

    def __init__(
        self, clock: Callable[[], float], wall_clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._clock = clock
        self._wall_clock_ns = wall_clock_ns
        self.latest_ns = 0
        """Time of the newest sample; 0: there is none."""
        self._latest_s = self._received_s = clock()

    @property
    def is_running(self) -> bool:
        """Whether there are samples, and messages were received a moment ago."""
        return bool(self.latest_ns) and self._clock() - self._received_s < _TICKS_S

    def receive(self) -> None:
        """Note the reception of a message."""
        self._received_s = self._clock()

    def note(self, time_ns: int) -> None:
        """Note the time of a sample."""
        if time_ns > self.latest_ns:
            self.latest_ns, self._latest_s = time_ns, self._clock()

    def now_ns(self) -> int:
        """Return the present time on the clock of the samples."""
        return self.latest_ns + round(1e9 * (self._clock() - self._latest_s))

    def moment_ns(self, exit_ns: int, *, is_driving: bool) -> int:
        """Return the time of a result, whose truck may be driving now."""
        now_ns = self.now_ns() if is_driving else 0
        return now_ns if exit_ns < now_ns < exit_ns + _SOON_NS else exit_ns

    def present_ns(self, *, is_driving: bool) -> int:
        """Return the present, for a truck that may send samples, which a replay dates back."""
        return self.now_ns() if is_driving else self._wall_clock_ns()

    def moment_of_state_ns(self, crossing: pb.Crossing, *, is_driving: bool) -> int:
        """Return the time from which on a crossing has its state."""
        if crossing.state == pb.DETECTED:
            return crossing.entry_time_ns
        if crossing.state == pb.COMPLETE:
            return crossing.time_ns
        return self.moment_ns(crossing.exit_time_ns, is_driving=is_driving)
