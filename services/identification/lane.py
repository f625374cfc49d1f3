"""Lateral distance of a run from the bridge's axis, for the parameter of torsion."""

import numpy as np

from schemas.site import Bridge
from services.common.geodesy import bridge_frame, to_chainage
from services.finding.crossing_data import CrossingData

_SURE_OF_LANE_M = 0.3
"""Slow error in m above which a receiver determines the lane less precisely than the site."""
_LARGEST_LATERAL_Z = 3.0
"""Standard deviations beyond which receiver and site file refer to different axes."""


def lane_factor(data: CrossingData) -> float:
    """Return the squared ratio of this run's distance from the axis to that of torsion's prior.

    Where the site file declares the lane's offset from the axis, a receiver with an error of
    decimetres that agrees shows the run's own distance; otherwise the ratio is 1. Without a
    declaration the distance from the line between the ends is no evidence: often that line was
    measured along the lane.
    """
    bridge, spread_m = data.bridge, data.receiver.position_spread_m
    if not bridge.is_lane_off_axis or bridge.lane_offset_m is None or spread_m > _SURE_OF_LANE_M:
        return 1.0
    fixes, stay = data.fixes, data.stay
    on_bridge = (fixes.time_s >= stay.entry_s) & (fixes.time_s <= stay.exit_s)
    if not on_bridge.any():
        return 1.0
    _, lateral_m = to_chainage(
        bridge_frame(bridge), fixes.latitude_deg[on_bridge], fixes.longitude_deg[on_bridge]
    )
    measured_m = abs(float(np.median(lateral_m)))
    if not agrees_with_lane(bridge, measured_m, spread_m):
        return 1.0
    return float((measured_m / bridge.reference_lane_offset_m) ** 2)


def agrees_with_lane(bridge: Bridge, lateral_m: float, spread_m: float) -> bool:
    """Return whether a measured distance from the axis agrees with the declared lane, if any.

    Its side does not matter: torsion is symmetric, and the opposite lane is on the other side.
    `spread_m` is the receiver's slow error.
    """
    if bridge.lane_offset_m is None:
        return True
    aside_m = abs(abs(lateral_m) - abs(bridge.lane_offset_m))
    return bool(aside_m <= _LARGEST_LATERAL_Z * np.hypot(bridge.lane_offset_m_spread, spread_m))
