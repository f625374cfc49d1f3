"""How far a run was from the bridge's axis, against what the unknown of torsion is defined for."""

import numpy as np

from services.common.geodesy import bridge_frame, to_chainage
from services.identification.crossing_data import CrossingData

_SURE_OF_LANE_M = 0.3
"""A receiver whose slow error is larger says less of the lane than the site file."""
_FARTHEST_ASIDE = 3.0
"""Standard deviations beyond which receiver and site file speak of different axes."""


def lane_factor(data: CrossingData) -> float:
    """Return the square of this run's distance from the axis over that of the torsion's prior.

    Where the site file says how far the lane is off the axis, a receiver that is right to
    decimetres and agrees with that shows the run's own distance; otherwise 1. Without such a
    statement its distance from the line between the ends is no evidence: often that line was
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
    aside_m = measured_m - abs(bridge.lane_offset_m)
    if abs(aside_m) > _FARTHEST_ASIDE * np.hypot(bridge.lane_offset_m_spread, spread_m):
        return 1.0
    return float((measured_m / bridge.reference_lane_offset_m) ** 2)
