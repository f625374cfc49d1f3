"""Finding the passages of a truck over a bridge in its positions.

Driving along the bridge's line, a truck is before the bridge, on it (with at least one axle) or
behind it. A crossing is a passage from one side to the other; one that ends on the side where it
began, or that the positions only begin or end in, is a crossing that cannot be identified.
"""

from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CORRIDOR_M = 30.0
"""How far a fix may lie beside the bridge's line: a carriageway's width and a poor receiver."""
MERGE_S = 5.0
"""Two entries less than this apart are one crossing (docs/contract.md)."""


class Passage(Enum):
    """How a stay on the bridge went."""

    THROUGH = "through"
    TURNED_BACK = "turned back"
    BEGINS_ON_BRIDGE = "begins on the bridge"
    ENDS_ON_BRIDGE = "ends on the bridge"


class Stay(NamedTuple):
    """One stay on the bridge; times of the fixes around it and an estimate of entry and exit."""

    passage: Passage
    direction: int  # 1: start to end, -1: end to start
    entry_s: float
    exit_s: float


def find_stays(
    time_s: Floats,
    antenna_m: Floats,
    lateral_m: Floats,
    *,
    span_m: float,
    wheelbase_m: float,
    antenna_to_front_axle_m: float,
) -> list[Stay]:
    """All stays on the bridge, in order of time; the last may still be going on (ENDS_ON_BRIDGE).

    Arrays are (m,): chainage and lateral offset of the antenna. Entry and exit are interpolated
    between fixes, good enough to find the samples; the trajectory says them better.
    """
    if time_s.size < 2:
        return []
    forward = _directions(antenna_m)
    front = antenna_m + forward * antenna_to_front_axle_m
    rear = front - forward * wheelbase_m
    low, high = np.minimum(front, rear), np.maximum(front, rear)
    side = np.where(high < 0.0, -1, np.where(low > span_m, 1, 0))
    stays: list[Stay] = []
    n = 0
    while n < time_s.size:
        if side[n] == 0:
            stop = n
            while stop < time_s.size and side[stop] == 0:
                stop += 1
            stays += _stay(time_s, front, rear, lateral_m, side, n, stop, span_m)
            n = stop
        elif n > 0 and side[n - 1] * side[n] == -1:
            # Jumped over the bridge between two fixes: the receiver was out.
            stays += _stay(time_s, front, rear, lateral_m, side, n, n, span_m)
            n += 1
        else:
            n += 1
    return _merged(stays)


def _directions(antenna_m: Floats) -> Floats:
    """Sense of travel at each fix: of the movement over the last metres, not of the noise."""
    sense = np.ones(antenna_m.size)
    anchor = antenna_m[0]
    current = 0.0
    for n in range(antenna_m.size):
        moved = antenna_m[n] - anchor
        if abs(moved) > 2.0:
            current = float(np.sign(moved))
            anchor = antenna_m[n]
        sense[n] = current
    known = np.flatnonzero(sense)
    if known.size == 0:
        return np.ones(antenna_m.size)
    sense[: known[0]] = sense[known[0]]
    return sense


def _stay(
    time_s: Floats,
    front: Floats,
    rear: Floats,
    lateral_m: Floats,
    side: NDArray[np.int64],
    start: int,
    stop: int,
    span_m: float,
) -> list[Stay]:
    """The stay over the fixes start … stop - 1 (none where the receiver jumped), if it is near."""
    before, after = start - 1, stop
    first, last = max(before, 0), min(after, time_s.size - 1)
    lateral = np.abs(lateral_m[first : last + 1] if start < stop else lateral_m[[first, last]])
    inside = lateral_m[start:stop] if start < stop else 0.5 * lateral_m[[first, last]].sum()
    if np.min(lateral) > CORRIDOR_M or np.median(np.abs(inside)) > CORRIDOR_M:
        return []
    if before < 0:
        direction = 1 if front[last] >= front[first] else -1
        passage = Passage.BEGINS_ON_BRIDGE
    else:
        direction = int(-side[before])
        if after >= time_s.size:
            passage = Passage.ENDS_ON_BRIDGE
        elif side[after] == -side[before]:
            passage = Passage.THROUGH
        else:
            passage = Passage.TURNED_BACK
    near, far = (0.0, span_m) if direction > 0 else (span_m, 0.0)
    entry = float(time_s[first])
    leave = float(time_s[last])
    if before >= 0 and start < time_s.size:
        entry = _passing(time_s, front, before, start if start < stop else after, near)
    if after < time_s.size and passage is Passage.THROUGH:
        leave = _passing(
            time_s, rear, max(before, stop - 1) if start < stop else before, after, far
        )
    return [Stay(passage, direction, entry, leave)]


def _passing(time_s: Floats, position: Floats, n: int, m: int, where: float) -> float:
    """Time at which the position passes `where` between two fixes, by linear interpolation."""
    moved = position[m] - position[n]
    share = (where - position[n]) / moved if moved != 0.0 else 0.5
    return float(time_s[n] + np.clip(share, 0.0, 1.0) * (time_s[m] - time_s[n]))


def _merged(stays: list[Stay]) -> list[Stay]:
    """Stays whose entries are less than 5 s apart are one: a truck that halts at an end."""
    merged: list[Stay] = []
    for stay in stays:
        if merged and stay.entry_s - merged[-1].entry_s < MERGE_S:
            earlier = merged[-1]
            through = [s for s in (earlier, stay) if s.passage is Passage.THROUGH]
            merged[-1] = through[0] if through else earlier._replace(exit_s=stay.exit_s)
        else:
            merged.append(stay)
    return merged
