"""Speeds of ROS 2 fixes, which have none: from the receiver's velocities, or from the fixes.

The results depend on stamps alone, not on the order of topics, as long as no message is more than
`_PATIENCE_S` late.
"""

from collections import deque
from math import cos, hypot, radians, sin, sqrt
from typing import Final, NamedTuple

from schemas.signals import NS_PER_S
from schemas.wgs84 import ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS_M
from services.drives.ros2_anomalies import AnomalyCounts
from services.drives.ros2_messages import Fix, Velocity

_PATIENCE_S: Final = 30.0
"""Time in s by which newer fixes arrive before a fix stops waiting for a velocity.

In a burst all messages of one topic may arrive before those of the other.
"""
_LARGEST_HOLE_S: Final = 1.1
"""Longest time in s between two velocities for interpolation; receivers send one a second."""
_HALF_WINDOW_S: Final = 1.0
"""Time in s before and after a fix over which its speed is a slope of positions."""
_MAX_WAITING: Final = 1000
_BACK: Final = 20
"""Number of past stamps after which the clock has been set back."""


class FixWithSpeed(NamedTuple):
    """A fix with the truck's speed, m/s."""

    fix: Fix
    speed_m_per_s: float


class SpeedEstimator:
    """Estimator of the speeds of fixes."""

    def __init__(self, topic: str, velocity_topic: str | None, anomalies: AnomalyCounts) -> None:
        self._topic = topic
        self._velocity_topic = velocity_topic
        self._anomalies = anomalies
        self._waiting: deque[Fix] = deque()
        self._past: deque[Fix] = deque()
        """Fixes already returned, as far as slopes need them."""
        self._velocities: deque[Velocity] = deque()
        self._latest_ns = self._latest_velocity_ns = -1
        self._behind = self._velocities_behind = 0

    def add_fix(self, fix: Fix) -> list[FixWithSpeed]:
        """Add a fix; return those whose speed is known now."""
        if fix.stamp_ns <= self._latest_ns:
            self._anomalies.add(self._topic, "stamps repeated or in the past, left out")
            self._behind += 1
            if self._behind <= _BACK:
                return []
            self._anomalies.add(self._topic, "steps back of the clock")
            found = self.finish()
        else:
            found = []
        self._behind = 0
        self._latest_ns = fix.stamp_ns
        self._waiting.append(fix)
        return found + self._ready()

    def add_velocity(self, velocity: Velocity) -> list[FixWithSpeed]:
        """Add a velocity; return those fixes whose speed is known now."""
        if velocity.stamp_ns <= self._latest_velocity_ns:
            if self._velocity_topic is not None:
                self._anomalies.add(
                    self._velocity_topic, "stamps repeated or in the past, left out"
                )
            self._velocities_behind += 1
            if self._velocities_behind <= _BACK:
                return []
            self._velocities.clear()
        self._velocities_behind = 0
        self._latest_velocity_ns = velocity.stamp_ns
        self._velocities.append(velocity)
        if len(self._velocities) > _MAX_WAITING:
            self._velocities.popleft()
        return self._ready()

    def finish(self) -> list[FixWithSpeed]:
        """Return the remaining fixes at the end of the input."""
        found = self._ready(is_end=True)
        self._past.clear()
        return found

    def _ready(self, *, is_end: bool = False) -> list[FixWithSpeed]:
        found = []
        while self._waiting:
            fix = self._waiting[0]
            if not is_end and not self._is_decided(fix):
                break
            speed = self._slope(fix) if self._velocity_topic is None else self._measured(fix)
            if speed is None:
                why = "a velocity" if self._velocity_topic else "another near enough for a speed"
                self._anomalies.add(self._topic, f"fixes without {why}, left out")
            else:
                found.append(FixWithSpeed(fix, speed))
            self._past.append(self._waiting.popleft())
            while self._past[0].stamp_ns < fix.stamp_ns - _HALF_WINDOW_S * NS_PER_S:
                self._past.popleft()
        return found

    def _is_decided(self, fix: Fix) -> bool:
        if self._velocity_topic is None:
            return self._latest_ns >= fix.stamp_ns + _HALF_WINDOW_S * NS_PER_S
        return (
            self._latest_velocity_ns >= fix.stamp_ns
            or self._latest_ns > fix.stamp_ns + _PATIENCE_S * NS_PER_S
            or len(self._waiting) > _MAX_WAITING
        )

    def _measured(self, fix: Fix) -> float | None:
        """Return the speed at a fix's time, linear between the velocities around it."""
        before: Velocity | None = None
        for after in self._velocities:
            if after.stamp_ns == fix.stamp_ns:
                return after.speed_m_per_s
            if after.stamp_ns > fix.stamp_ns:
                break
            before = after
        else:
            return None
        if before is None or after.stamp_ns - before.stamp_ns > _LARGEST_HOLE_S * NS_PER_S:
            return None
        share = (fix.stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        return before.speed_m_per_s + share * (after.speed_m_per_s - before.speed_m_per_s)

    def _slope(self, fix: Fix) -> float | None:
        """Return the slope of the line through the fixes near one; None without others."""
        window_ns = _HALF_WINDOW_S * NS_PER_S
        near = [
            other
            for other in (*self._past, *self._waiting)
            if abs(other.stamp_ns - fix.stamp_ns) <= window_ns
        ]
        if len(near) < 2:
            return None
        times = [(other.stamp_ns - fix.stamp_ns) / NS_PER_S for other in near]
        middle = sum(times) / len(times)
        spread = sum((time - middle) ** 2 for time in times)
        places = [_offset_m(fix, other) for other in near]
        east, north = (
            sum((time - middle) * place[axis] for time, place in zip(times, places, strict=True))
            / spread
            for axis in (0, 1)
        )
        return hypot(east, north)


def _offset_m(origin: Fix, place: Fix) -> tuple[float, float]:
    """Return the offset of one position from another some metres away, to the east and north, m."""
    latitude = radians(origin.latitude_deg)
    w = 1 - ECCENTRICITY_SQUARED * sin(latitude) ** 2
    meridian_m = SEMI_MAJOR_AXIS_M * (1 - ECCENTRICITY_SQUARED) / w**1.5
    parallel_m = SEMI_MAJOR_AXIS_M * cos(latitude) / sqrt(w)
    turn = (place.longitude_deg - origin.longitude_deg + 180) % 360 - 180
    return radians(turn) * parallel_m, radians(
        place.latitude_deg - origin.latitude_deg
    ) * meridian_m
