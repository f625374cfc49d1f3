"""What the receiver of a simulated truck reports of its drive."""

import numpy as np
from numpy.typing import NDArray

from pre_core.physics.sensors import Receiver, measure_position
from schemas.site import Bridge, Site
from services.common.geodesy import bridge_frame, heading_deg, to_lat_lon
from services.drives.runs import GnssTrack

Floats = NDArray[np.float64]

START_TIME_S = 1_767_225_600.0
"""2026-01-01 00:00 UTC: simulated drives begin then, so that the same call gives the same file."""
_FIX_RATE_HZ = 10.0
SLOW_ERROR_S = 300.0
"""A receiver's slow error is forgotten within minutes: a crossing sees it as almost constant."""
_ALTITUDE_M = 25.0
"""Of a bridge whose altitude the site file does not tell."""


def receiver_of(site: Site, *, perfect: bool) -> Receiver:
    """Return the receiver of the site file, or one without error."""
    if perfect:
        return Receiver(_FIX_RATE_HZ)
    declared_errors = site.receiver
    return Receiver(
        _FIX_RATE_HZ,
        position_noise_m=declared_errors.position_noise_m,
        position_spread_m=declared_errors.position_spread_m,
        correlation_s=SLOW_ERROR_S,
        speed_noise_m_per_s=declared_errors.speed_noise_m_per_s,
        latency_s=declared_errors.latency_s,
    )


def _altitude_m(bridge: Bridge, chainage_m: Floats) -> Floats:
    """Of the road: level but for the bridge, if the altitudes of its ends are known."""
    ends = [a for a in (bridge.start_altitude_m, bridge.end_altitude_m) if a is not None]
    low, high = (ends[0], ends[-1]) if ends else (_ALTITUDE_M, _ALTITUDE_M)
    return np.interp(chainage_m, [0.0, bridge.span_m], [low, high])


def gnss_track(
    bridge: Bridge,
    step_s: float,
    antenna: Floats,
    lateral: Floats,
    speed: Floats,
    receiver: Receiver,
    rng: np.random.Generator,
    *,
    forward: bool,
) -> GnssTrack:
    """Return what the receiver reports of the drive of its antenna, (n,) positions by step."""
    time_s = step_s * np.arange(antenna.size, dtype=np.float64)
    fixes = measure_position(time_s, antenna, lateral, speed, receiver, rng)
    frame = bridge_frame(bridge)
    latitude, longitude = to_lat_lon(frame, fixes.chainage_m, fixes.lateral_m)
    return GnssTrack(
        START_TIME_S + fixes.time_s,
        latitude,
        longitude,
        _altitude_m(bridge, fixes.chainage_m),
        fixes.speed_m_per_s,
        np.full(latitude.size, heading_deg(frame, start_to_end=forward)),
    )
