"""The road that a simulated recording has before and after the bridge."""

from math import sqrt
from typing import Final

from services.finding.crossing_data import AFTER_M, APPROACH_M

SURVEY_ROAD_M: Final = (APPROACH_M, AFTER_M)
"""Road before and after the bridge that an identification uses, which a survey has to record."""
_BEFORE_S, _AFTER_S = 3.0, 2.5


def times_s(
    speed_m_per_s: tuple[float, float],
    on_bridge_m: float,
    wheelbase_m: float,
    least_road_m: tuple[float, float],
) -> tuple[float, float]:
    """Return the recorded time before the front axle's entry, and the whole recorded time.

    They are at least 3 s before the entry and 2.5 s after the exit, longer where the rear axle
    would have less than `least_road_m` before and after the bridge. The speed changes evenly.
    """
    begin, end = speed_m_per_s
    mean = 0.5 * (begin + end)
    before_s, driven_s = _BEFORE_S, _BEFORE_S + on_bridge_m / mean + _AFTER_S
    if not any(least_road_m):
        return before_s, driven_s
    before_m = begin * before_s + 0.5 * (end - begin) / driven_s * before_s**2
    after_m = mean * driven_s - before_m - on_bridge_m
    before_m = max(before_m, least_road_m[0] + wheelbase_m)
    driven_s = (before_m + on_bridge_m + max(after_m, least_road_m[1])) / mean
    root = sqrt(begin**2 + 2.0 * (end - begin) / driven_s * before_m)
    return 2.0 * before_m / (begin + root), driven_s
