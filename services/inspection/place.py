"""Check of the bridges' coordinates against the driven path."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from schemas.site import Bridge, Receiver, Vehicle
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, to_chainage
from services.finding.crossing_data import AFTER_M, APPROACH_M, LONGEST_MARGIN_S
from services.finding.stays import CORRIDOR_M, Passage, Stay, stays_on
from services.identification.identify import SLOWEST_M_PER_S
from services.identification.lane import agrees_with_lane
from services.inspection.finding import CheckFinding, CheckStatus, check_finding
from services.inspection.recorded import InspectedRun

_SHORT: Final = 0.4
_NEAR_M: Final = 300.0
_LANE_M: Final = 6.0
"""Lateral distance in m that is plausible: a lane next to the line of the bearings.

It is larger for a poor receiver.
"""
_LARGEST_ANGLE_DEG: Final = 4.0
_INCOMPLETE: Final = {
    Passage.TURNED_BACK: "the truck turned back on the bridge",
    Passage.BEGINS_ON_BRIDGE: "the recording begins on the bridge",
    Passage.ENDS_ON_BRIDGE: "the recording ends on the bridge",
}
"""Clause on a stay that is no whole crossing."""


class CrossingTrack(NamedTuple):
    """A crossing of a bridge, as its fixes show it."""

    stay: Stay
    speed_m_per_s: float
    lateral_m: float
    """Median lateral position on the bridge, m."""
    angle_deg: float
    """Angle between the path and the bridge's line."""
    before_m: float
    """Length of recorded road before the entry, m."""
    after_m: float


def bridge_findings(
    run: InspectedRun, bridge: Bridge, vehicle: Vehicle, receiver: Receiver
) -> Iterator[CheckFinding]:
    """Yield findings on one bridge's coordinates, and on the road next to it."""
    frame = bridge_frame(bridge)
    chainage, lateral = to_chainage(frame, run.fixes.latitude_deg, run.fixes.longitude_deg)
    stays = stays_on(bridge, frame, vehicle, receiver, run.fixes)
    through = [stay for stay in stays if stay.passage is Passage.THROUGH]
    if not through:
        yield _not_crossed(bridge, chainage, lateral, stays)
        return
    for stay in through:
        track = _crossing_track(run, bridge, vehicle, stay, chainage, lateral)
        yield from _findings_of_track(bridge, receiver, track)


def _not_crossed(
    bridge: Bridge, chainage: Floats, lateral: Floats, stays: list[Stay]
) -> CheckFinding:
    if stays:
        return CheckFinding(
            "bridge_crossed",
            CheckStatus.WRONG,
            f"{bridge.id}: {_INCOMPLETE[stays[0].passage]}",
            "record from before the bridge until after it, without stopping",
        )
    beside = np.flatnonzero((chainage > 0.0) & (chainage < bridge.span_m))
    outside = np.maximum(np.maximum(-chainage, chainage - bridge.span_m), 0.0)
    away = np.hypot(outside, lateral)
    nearest = float(away.min()) if away.size else np.inf
    if beside.size and abs(lateral[beside]).min() < _NEAR_M:
        return CheckFinding(
            "bridge_place",
            CheckStatus.WRONG,
            f"{bridge.id}: the path passes {abs(lateral[beside]).min():.0f} m from the line "
            f"between the bearings; up to {CORRIDOR_M:g} m counts as on the bridge",
            "correct the coordinates of the bearings, latitude and longitude of both ends",
        )
    if nearest < _NEAR_M:
        side = "start" if chainage[int(np.argmin(away))] < 0.5 * bridge.span_m else "end"
        return CheckFinding(
            "bridge_place",
            CheckStatus.WRONG,
            f"{bridge.id}: the path ends {nearest:.0f} m from its {side} and does not cross it",
            "record the whole crossing, or correct the coordinates of the bearings",
        )
    return CheckFinding(
        "bridge_crossed",
        CheckStatus.OPEN,
        f"{bridge.id}: not crossed in this recording"
        + (f", nearest fix {nearest / 1e3:.1f} km away" if np.isfinite(nearest) else ""),
        "check again with a recording of a crossing",
    )


def _crossing_track(
    run: InspectedRun,
    bridge: Bridge,
    vehicle: Vehicle,
    stay: Stay,
    chainage: Floats,
    lateral: Floats,
) -> CrossingTrack:
    time_s = run.fixes.time_s
    seconds = stay.exit_s - stay.entry_s
    speed = (bridge.span_m + vehicle.length_m) / seconds
    # Extended by its length to both sides: a line through fixes on a short bridge alone is their
    # noise.
    near = (time_s > stay.entry_s - seconds) & (time_s < stay.exit_s + seconds)
    near &= np.abs(chainage - 0.5 * bridge.span_m) < 1.5 * bridge.span_m
    slope = np.polyfit(chainage[near], lateral[near], 1)[0] if near.sum() > 2 else 0.0
    on = near & (chainage > 0.0) & (chainage < bridge.span_m)
    first_s, last_s = _recorded_between(run)
    return CrossingTrack(
        stay,
        speed,
        float(np.median(lateral[on if on.any() else near])),
        float(np.degrees(np.arctan(slope))),
        max(0.0, stay.entry_s - first_s) * speed,
        max(0.0, last_s - stay.exit_s) * speed,
    )


def _recorded_between(run: InspectedRun) -> tuple[float, float]:
    """Return the times between which there are both accelerations and fixes."""
    time_s = run.fixes.time_s
    if run.samples is None:
        return float(time_s[0]), float(time_s[-1])
    count = max(values.size for values in run.samples.channels.values())
    start_s = run.samples.start_s
    stop_s = start_s + (count - 1) / run.samples.rate_hz
    return max(float(time_s[0]), start_s), min(float(time_s[-1]), stop_s)


def _findings_of_track(
    bridge: Bridge, receiver: Receiver, track: CrossingTrack
) -> Iterator[CheckFinding]:
    way = "start to end" if track.stay.direction > 0 else "end to start"
    where = f"{bridge.id}, {way}"
    limit = max(_LANE_M, 3.0 * receiver.position_spread_m)
    yield check_finding(
        "bridge_lateral",
        f"{where}: wheel path {abs(track.lateral_m):.1f} m from the line between the bearings",
        "correct the coordinates of the bearings, or declare the receiver's position_spread_m",
        is_wrong=abs(track.lateral_m) > limit,
    )
    if not agrees_with_lane(bridge, track.lateral_m, receiver.position_spread_m):
        yield CheckFinding(
            "lane_driven",
            CheckStatus.OPEN,
            f"{where}: wheel path {abs(track.lateral_m):.1f} m from the line between the bearings, "
            f"lane_offset_m is {bridge.lane_offset_m:g}",
            "correct lane_offset_m, or take the bearings' coordinates on the deck's axis",
        )
    yield check_finding(
        "bridge_angle",
        f"{where}: wheel path at {abs(track.angle_deg):.1f}° to the line between the bearings",
        "correct the coordinates of the bearings: the truck drives along that line",
        is_wrong=abs(track.angle_deg) > _LARGEST_ANGLE_DEG,
    )
    yield check_finding(
        "crossing_speed",
        f"{where}: speed {track.speed_m_per_s:.1f} m/s",
        "drive at 5 m/s or more",
        is_wrong=track.speed_m_per_s < SLOWEST_M_PER_S,
    )
    # The identification uses no more road than this (`crossing_data.window`).
    reach_m = LONGEST_MARGIN_S * track.speed_m_per_s
    for name, side, have_m, want_m in (
        ("approach_before", "before", track.before_m, min(APPROACH_M, reach_m)),
        ("approach_behind", "after", track.after_m, min(AFTER_M, reach_m)),
    ):
        yield check_finding(
            name,
            f"{where}: {have_m:.0f} m of road recorded {side} the bridge, up to "
            f"{want_m:.0f} m can be used",
            f"record more road {side} the bridge: the profile mismatch is measured there",
            is_wrong=have_m < _SHORT * want_m,
        )
