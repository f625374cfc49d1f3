"""Detection of a truck's stays on a bridge in its positions.

Driving along the bridge's line, a truck is before the bridge, on it (with at least one axle) or
behind it. A crossing is a stay from one side to the other; one that ends on the side where it
began, or with positions that only begin or end in it, cannot be identified.

Where the receiver was out during a crossing, the fixes on both sides are sufficient, unless the
truck's path between them is unknown: they are more than `LONGEST_UNSEEN_S` apart, or the truck
drove away from the bridge before and towards it afterwards, because it returned unobserved, or was
switched off and started another run. A stay with fixes on the bridge lasts at most
`LONGEST_BRIDGED_S` beyond them.

A receiver's noise moves a truck at an end of the bridge on and off it: only a passage, or a move
further onto the bridge than noise reaches, is a stay.
"""

from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np

from schemas.signals import NS_PER_S
from schemas.site import Bridge, Receiver
from services.common.arrays import Floats, Ints
from services.common.geodesy import BridgeFrame, to_chainage
from services.finding.streams import Fixes

CORRIDOR_M = 30.0
"""Largest lateral distance of a fix in m: a carriageway's width and a poor receiver."""
MERGE_S = 5.0
"""Two entries less than this apart in s are one crossing (docs/contract.md)."""
LONGEST_STAY_S = 270.0
"""Longest stay in s on a short bridge that counts as a crossing."""
LONGEST_BRIDGED_S = 8.0
"""Longest time in s over which positions are interpolated between fixes (docs/verdicts.md)."""
LONGEST_UNSEEN_S = 30.0
"""Longest time in s between two fixes beyond a bridge's ends that make a crossing without others.

After a longer silence the truck may have detoured.
"""
MARGIN_M = 3.0
"""Distance in m above a usable receiver's noise between two fixes."""
_LARGEST_SLOPE = 0.2
"""Largest lateral move relative to the distance along a bridge (11 degrees).

A truck that exceeds it, and a lane's width, is on a road across the bridge, above or below.
"""
_LANE_M = 3.5
STANDING_M_PER_S = 0.5
"""Speed below which positions move by their noise, not by driving."""


class Passage(Enum):
    """Kind of a stay on the bridge."""

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
    is_over: bool = True
    """Whether it is finished; otherwise the truck is on the bridge in the last fix."""


class AxleGeometry(Protocol):
    """Geometry of a truck's axles; `schemas.site.Vehicle` fits."""

    @property
    def length_m(self) -> float: ...  # noqa: D102
    @property
    def gps_antenna_to_front_axle_m(self) -> float: ...  # noqa: D102


class AntennaFixes(NamedTuple):
    """Fixes of a truck next to a bridge: arrays (m,), in order of time."""

    time_s: Floats
    chainage_m: Floats
    lateral_m: Floats
    speed_m_per_s: Floats
    """Speed according to the receiver."""


class _Places(NamedTuple):
    """Positions of the truck at each fix (m,)."""

    front: Floats
    rear: Floats
    depth: Floats  # how far the truck must drive to leave the bridge; negative: how far away it is
    side: Ints  # -1 before the start, 1 behind the end, 0 on the bridge
    sense: Floats  # 1: towards the end, -1: towards the start


def least_depth_m(receiver: Receiver) -> float:
    """Return the depth in m that a truck must reach for a stay, with this receiver."""
    return max(MARGIN_M, 5.0 * receiver.position_noise_m)


def stays_on(
    bridge: Bridge, frame: BridgeFrame, vehicle: AxleGeometry, receiver: Receiver, fixes: Fixes
) -> list[Stay]:
    """Return all stays of a truck on one bridge: the only conversion of fixes to stays.

    `bridges` determines whether it was on an adjacent one.
    """
    chainage_m, lateral_m = to_chainage(frame, fixes.latitude_deg, fixes.longitude_deg)
    return find_stays(
        AntennaFixes(fixes.time_s, chainage_m, lateral_m, fixes.speed_m_per_s),
        span_m=bridge.span_m,
        wheelbase_m=vehicle.length_m,
        antenna_to_front_axle_m=vehicle.gps_antenna_to_front_axle_m,
        margin_m=least_depth_m(receiver),
    )


def find_stays(
    fixes: AntennaFixes,
    *,
    span_m: float,
    wheelbase_m: float,
    antenna_to_front_axle_m: float,
    margin_m: float = MARGIN_M,
) -> list[Stay]:
    """Return all stays on the bridge, in order of time; the last may still be running.

    Entry and exit are interpolated between fixes, precisely enough to select the samples; the
    trajectory gives them more precisely. A truck that reaches less than `margin_m` and returns was
    not on it.
    """
    time_s, antenna_m, lateral_m, speed_m_per_s = fixes
    if time_s.size < 2:
        return []
    sense = _senses(antenna_m, speed_m_per_s, margin_m)
    front = antenna_m + sense * antenna_to_front_axle_m
    rear = front - sense * wheelbase_m
    low, high = np.minimum(front, rear), np.maximum(front, rear)
    depth = np.minimum(high, span_m - low)
    side = np.where(depth > 0.0, 0, np.where(low > 0.5 * span_m, 1, -1))
    places = _Places(front, rear, depth, side, sense)
    stays: list[Stay] = []
    # Fixes at which the truck enters the bridge, or jumps over it because the receiver was out.
    has_jumped = np.diff(side, prepend=side[0]) * side == 2
    has_jumped &= np.diff(time_s, prepend=time_s[0]) <= LONGEST_UNSEEN_S
    begins = np.flatnonzero((depth > 0.0) | has_jumped)
    gone = np.append(np.flatnonzero(depth <= 0.0), time_s.size)
    stop = 0
    for n in begins.tolist():
        if n >= stop and not (
            depth[n] <= 0.0 and _entered_unobserved(antenna_m, speed_m_per_s, n, margin_m)
        ):
            stop = int(gone[np.searchsorted(gone, n)]) if depth[n] > 0.0 else n
            stay = _stay(time_s, places, n, stop, span_m, margin_m)
            deep_m = np.inf
            silence_s = np.diff(time_s[max(n - 1, 0) : stop + 1]).max()
            if stay.passage is not Passage.THROUGH or silence_s > LONGEST_UNSEEN_S:
                # A truck that backs away has not turned, whatever its positions: one sense for all.
                axle = antenna_m[n:stop] + stay.direction * antenna_to_front_axle_m
                other = axle - stay.direction * wheelbase_m
                deep = np.minimum(np.maximum(axle, other), span_m - np.minimum(axle, other))
                deep_m = float(deep.max())
            was_on_it = deep_m >= min(margin_m, 0.25 * (span_m + wheelbase_m))
            is_near = _is_near(lateral_m, places, n, stop, stay)
            if was_on_it and is_near and _is_along(lateral_m, front, n, stop, span_m):
                stays.append(stay)
    return _merged(stays)


def _entered_unobserved(antenna_m: Floats, speed_m_per_s: Floats, n: int, margin_m: float) -> bool:
    """Return whether a truck on the other side at fix n may not have crossed the bridge.

    That is so if it drove the other way before, and continues that way; while it has not moved
    further than noise does, it counts as continuing.
    """
    direction = np.sign(antenna_m[n] - antenna_m[n - 1])
    before, after = antenna_m[:n], direction * (antenna_m[n:] - antenna_m[n])
    # By the earlier fixes alone: seen from later ones, a truck that stood has turned there.
    if np.ptp(before) <= margin_m or _senses(before, speed_m_per_s[:n], margin_m)[-1] == direction:
        return False
    far = np.flatnonzero(np.abs(after) > margin_m)
    return far.size == 0 or bool(after[far[0]] < 0.0)


def _senses(antenna_m: Floats, speed_m_per_s: Floats, margin_m: float) -> Floats:
    """Return the sense of travel at each fix (m,), 1 or -1: it follows the truck, not the noise."""
    moving = np.flatnonzero(np.abs(speed_m_per_s) >= STANDING_M_PER_S)
    place = antenna_m[moving]
    lowest = np.minimum(np.minimum.accumulate(place), antenna_m[0])
    highest = np.maximum(np.maximum.accumulate(place), antenna_m[0])
    moved = np.flatnonzero(np.maximum(place - lowest, highest - place) > margin_m)
    if not moved.size:
        return np.ones(antenna_m.size)
    begin = int(moved[0])
    current = 1.0 if place[begin] - lowest[begin] > margin_m else -1.0
    # Only the turns are stored: first the sense, then its changes.
    sense = np.zeros(antenna_m.size)
    sense[0] = current
    while True:
        ahead = current * place[begin:]
        back = np.flatnonzero(np.maximum.accumulate(ahead) - ahead > margin_m)
        if not back.size:
            return np.cumsum(sense)
        # It has turned behind the farthest fix.
        farthest = begin + int(np.argmax(ahead[: back[0]]))
        sense[moving[farthest] + 1] = -2.0 * current
        current = -current
        begin += int(back[0])


def _stay(
    time_s: Floats, places: _Places, start: int, stop: int, span_m: float, margin_m: float
) -> Stay:
    """Return the stay over the fixes start … stop - 1 (none where the receiver jumped)."""
    last = min(stop, time_s.size - 1)
    side_before = int(places.side[start - 1]) if start > 0 else 0
    side_after = int(places.side[last])
    is_over = side_after != 0
    if start == 0:
        passage = Passage.BEGINS_ON_BRIDGE
        direction = int(places.sense[last])
    else:
        direction = -side_before
        if not is_over:
            passage = Passage.ENDS_ON_BRIDGE
        elif side_after == -side_before:
            passage = Passage.THROUGH
        else:
            passage = Passage.TURNED_BACK
    near, far = (0.0, span_m) if direction > 0 else (span_m, 0.0)
    around = slice(max(start - 1, 0), last + 1)
    times = time_s[around]
    entry_s, exit_s = float(times[0]), float(times[-1])
    deep = min(margin_m, 0.5 * span_m)
    if start > 0:
        entry_s = _last_passing(times, direction * (places.front[around] - near), deep)
    if passage is Passage.THROUGH:
        # Backwards in time the truck enters the bridge over its far end.
        left = direction * (far - places.rear[around])
        exit_s = -_last_passing(-times[::-1], left[::-1], deep)
    if start < stop:
        entry_s = max(entry_s, float(time_s[start]) - LONGEST_BRIDGED_S)
        exit_s = min(exit_s, float(time_s[stop - 1]) + LONGEST_BRIDGED_S)
    return Stay(passage, direction, entry_s, exit_s, is_over)


def _last_passing(time_s: Floats, beyond_m: Floats, deep_m: float) -> float:
    """Return when `beyond` (m,) last passes zero upwards before it reaches `deep`, linearly.

    The first value is negative. Noise makes a truck that waits at the end of the bridge pass it
    often: it enters when it drives on.
    """
    reached = np.flatnonzero(beyond_m >= deep_m)
    stop = int(reached[0]) if reached.size else beyond_m.size - 1
    outside = np.flatnonzero(beyond_m[: stop + 1] < 0.0)
    n = int(outside[-1]) if outside.size else 0
    if n + 1 >= beyond_m.size:
        return float(time_s[n])
    share = beyond_m[n] / (beyond_m[n] - beyond_m[n + 1]) if beyond_m[n] < 0.0 else 0.0
    return float(time_s[n] + np.clip(share, 0.0, 1.0) * (time_s[n + 1] - time_s[n]))


def _is_near(lateral_m: Floats, places: _Places, start: int, stop: int, stay: Stay) -> bool:
    """Return whether the truck was on this bridge's road, not next to, below or across it."""
    before = max(start - 1, 0)
    if start == stop:
        moved = places.front[start] - places.front[before]
        share = np.clip((0.0 - places.front[before]) / moved, 0.0, 1.0) if moved != 0.0 else 0.5
        between = lateral_m[before] + share * (lateral_m[start] - lateral_m[before])
        nearest = np.abs(lateral_m[[before, start]]).min()
        return bool(max(abs(between), nearest) <= CORRIDOR_M)
    beside = np.abs(lateral_m[start:stop])
    if stay.passage is Passage.BEGINS_ON_BRIDGE:
        return bool(beside.max() <= CORRIDOR_M)
    came_in = np.abs(lateral_m[[before, start]]).min()
    return bool(max(came_in, np.median(beside)) <= CORRIDOR_M)


def _is_along(lateral_m: Floats, front_m: Floats, start: int, stop: int, span_m: float) -> bool:
    """Return whether the truck drove along the bridge's line, not across it, up to now."""
    along, aside = front_m[start:stop], lateral_m[start:stop]
    if along.size < 2 or np.ptp(along) < 0.3 * span_m:
        return True
    beyond = along > 0.5 * (along.min() + along.max())  # by chainage: a truck may stand for long
    if min(beyond.sum(), (~beyond).sum()) < 3:
        return True
    # Medians: a single outlier is no path across.
    came_m = float(np.median(along[beyond]) - np.median(along[~beyond]))
    moved_m = abs(float(np.median(aside[beyond]) - np.median(aside[~beyond])))
    return moved_m * span_m <= came_m * (_LARGEST_SLOPE * span_m + _LANE_M)


def _merged(stays: list[Stay]) -> list[Stay]:
    """Merge stays whose entries are less than 5 s apart: a truck that halts at an end."""
    merged: list[Stay] = []
    for stay in stays:
        if merged and stay.entry_s - merged[-1].entry_s < MERGE_S:
            earlier = merged[-1]
            through = [s for s in (earlier, stay) if s.passage is Passage.THROUGH]
            merged[-1] = (
                through[0]
                if through
                else earlier._replace(exit_s=stay.exit_s, is_over=stay.is_over)
            )
        else:
            merged.append(stay)
    return merged


def are_one(entry_ns: float, exit_ns: float, other_entry_ns: float, other_exit_ns: float) -> bool:
    """Return whether two stays of one truck on one bridge begin together or overlap."""
    if abs(entry_ns - other_entry_ns) < MERGE_S * NS_PER_S:
        return True
    return overlap(entry_ns, exit_ns, other_entry_ns, other_exit_ns)


def overlap(begin: float, end: float, other_begin: float, other_end: float) -> bool:
    """Return whether two stretches of time have more than a moment in common."""
    return begin < other_end and other_begin < end
