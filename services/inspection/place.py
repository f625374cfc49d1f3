"""Whether the bridges of the site file lie on the road that was driven."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.site import Bridge, Receiver, Vehicle
from services.common.geodesy import bridge_frame, to_chainage
from services.identification.crossing_data import APPROACH_M, BEHIND_M, LONGEST_MARGIN_S
from services.identification.identify import SLOWEST_M_PER_S
from services.identification.stays import CORRIDOR_M, Passage, Stay, stays_on
from services.inspection.finding import Finding, State, judged
from services.inspection.recorded import Recorded

Floats = NDArray[np.float64]

_SHORT: Final = 0.4
_NEAR_M: Final = 300.0
_LANE_M: Final = 6.0
"""A lane beside the line of the bearings is no mistake; more with a poor receiver."""
_LARGEST_ANGLE_DEG: Final = 4.0


class Passing(NamedTuple):
    """A passage over a bridge, as its fixes show it."""

    stay: Stay
    speed_m_per_s: float
    lateral_m: float
    """Median over the bridge."""
    angle_deg: float
    """Between what was driven and the bridge's line."""
    before_m: float
    """Of road before the entry on which all was recorded."""
    behind_m: float


def place_of(
    run: Recorded, bridge: Bridge, vehicle: Vehicle, receiver: Receiver
) -> Iterator[Finding]:
    """What this run says of one bridge's coordinates, and of the road beside it."""
    frame = bridge_frame(bridge)
    chainage, lateral = to_chainage(frame, run.fixes.latitude_deg, run.fixes.longitude_deg)
    stays = stays_on(bridge, frame, vehicle, receiver, run.fixes)
    through = [stay for stay in stays if stay.passage is Passage.THROUGH]
    if not through:
        yield _not_crossed(bridge, chainage, lateral, stays)
        return
    for stay in through:
        passing = _passing(run, bridge, vehicle, stay, chainage, lateral)
        yield from _of_passing(bridge, receiver, passing)


def _not_crossed(bridge: Bridge, chainage: Floats, lateral: Floats, stays: list[Stay]) -> Finding:
    if stays:
        return Finding(
            "bridge_crossed",
            State.WRONG,
            f"{bridge.id}: the recording {stays[0].passage.value}",
            "record from before the bridge to behind it, without stopping",
        )
    beside = np.flatnonzero((chainage > 0.0) & (chainage < bridge.span_m))
    outside = np.maximum(np.maximum(-chainage, chainage - bridge.span_m), 0.0)
    away = np.hypot(outside, lateral)
    nearest = float(away.min()) if away.size else np.inf
    if beside.size and abs(lateral[beside]).min() < _NEAR_M:
        return Finding(
            "bridge_place",
            State.WRONG,
            f"{bridge.id}: the track passes {abs(lateral[beside]).min():.0f} m beside its line, "
            f"{CORRIDOR_M:g} m are taken for a passage",
            "correct the coordinates of the bearings, latitude and longitude of both ends",
        )
    if nearest < _NEAR_M:
        side = "start" if chainage[int(np.argmin(away))] < 0.5 * bridge.span_m else "end"
        return Finding(
            "bridge_place",
            State.WRONG,
            f"{bridge.id}: the track ends {nearest:.0f} m from its {side} and does not reach over "
            "it",
            "record the whole passage, or correct the coordinates of the bearings",
        )
    return Finding(
        "bridge_crossed",
        State.OPEN,
        f"{bridge.id}: not driven over here"
        + (f", nearest fix {nearest / 1e3:.1f} km away" if np.isfinite(nearest) else ""),
        "check again with a drive over it",
    )


def _passing(
    run: Recorded,
    bridge: Bridge,
    vehicle: Vehicle,
    stay: Stay,
    chainage: Floats,
    lateral: Floats,
) -> Passing:
    time_s = run.fixes.time_s
    seconds = stay.exit_s - stay.entry_s
    speed = (bridge.span_m + vehicle.wheelbase_m) / seconds
    # As far again to both sides: a line through fixes on a short bridge alone is their noise.
    near = (time_s > stay.entry_s - seconds) & (time_s < stay.exit_s + seconds)
    near &= np.abs(chainage - 0.5 * bridge.span_m) < 1.5 * bridge.span_m
    slope = np.polyfit(chainage[near], lateral[near], 1)[0] if near.sum() > 2 else 0.0
    on = near & (chainage > 0.0) & (chainage < bridge.span_m)
    first_s, last_s = _recorded_between(run)
    return Passing(
        stay,
        speed,
        float(np.median(lateral[on if on.any() else near])),
        float(np.degrees(np.arctan(slope))),
        max(0.0, stay.entry_s - first_s) * speed,
        max(0.0, last_s - stay.exit_s) * speed,
    )


def _recorded_between(run: Recorded) -> tuple[float, float]:
    """From when to when there are both accelerations and fixes."""
    time_s = run.fixes.time_s
    if run.samples is None:
        return float(time_s[0]), float(time_s[-1])
    count = max(values.size for values in run.samples.channels.values())
    start_s = run.samples.start_s
    stop_s = start_s + (count - 1) / run.samples.rate_hz
    return max(float(time_s[0]), start_s), min(float(time_s[-1]), stop_s)


def _of_passing(bridge: Bridge, receiver: Receiver, passing: Passing) -> Iterator[Finding]:
    way = "start to end" if passing.stay.direction > 0 else "end to start"
    where = f"{bridge.id}, {way}"
    limit = max(_LANE_M, 3.0 * receiver.position_spread_m)
    yield judged(
        "bridge_lateral",
        f"{where}: track {abs(passing.lateral_m):.1f} m beside the line of its bearings",
        "correct the coordinates of the bearings, or declare the receiver's position_spread_m",
        is_wrong=abs(passing.lateral_m) > limit,
    )
    yield judged(
        "bridge_angle",
        f"{where}: track at {abs(passing.angle_deg):.1f}° to its line",
        "correct the coordinates of the bearings: the line must be the one that is driven",
        is_wrong=abs(passing.angle_deg) > _LARGEST_ANGLE_DEG,
    )
    yield judged(
        "crossing_speed",
        f"{where}: {passing.speed_m_per_s:.1f} m/s",
        "drive at 5 m/s or more",
        is_wrong=passing.speed_m_per_s < SLOWEST_M_PER_S,
    )
    # More road than this is not used (`crossing_data.window`).
    reach_m = LONGEST_MARGIN_S * passing.speed_m_per_s
    for side, have_m, want_m in (
        ("before", passing.before_m, min(APPROACH_M, reach_m)),
        ("behind", passing.behind_m, min(BEHIND_M, reach_m)),
    ):
        yield judged(
            f"approach_{side}",
            f"{where}: {have_m:.0f} m recorded {side} it, {want_m:.0f} m are used",
            f"record more road {side} the bridge: the roads' mismatch is measured there",
            is_wrong=have_m < _SHORT * want_m,
        )
