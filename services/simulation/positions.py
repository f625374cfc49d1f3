"""Fixes of a simulated truck's receiver."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pre_core.physics.sensors import Accelerometer, ReceiverModel, measure_position
from pre_core.physics.simulate import Motion
from schemas.site import Bridge, Site
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, heading_deg, to_lat_lon
from services.drives.runs import GnssTrack

START_TIME_S = 1_767_225_600.0
"""Start of simulated drives, 2026-01-01 00:00 UTC, so that the same call gives the same file."""
_FIX_RATE_HZ = 10.0
SLOW_ERROR_S = 300.0
"""Correlation time of the slow error, some minutes: it is almost constant in a crossing."""
_ALTITUDE_M = 25.0
"""Altitude of a bridge without one in the site file."""


class TimedMotion(NamedTuple):
    """The motion of a simulated truck."""

    motion: Motion
    step_s: float
    """Length of a simulated step, a whole fraction of the sensors' sampling interval."""
    settling_steps: int
    """Number of steps before the recording."""


class Instruments(NamedTuple):
    """Sensors of a simulated truck."""

    sensors: Sequence[Accelerometer]
    """One for each channel, all of one rate."""
    receiver: ReceiverModel
    rng: np.random.Generator
    """Source of their noise, and of the truck's lateral position."""
    antenna_to_front_axle_m: float = 0.0


class AntennaTrack(NamedTuple):
    """Motion of the receiver's antenna, (n,) by step."""

    chainage_m: Floats
    lateral_m: Floats
    speed_m_per_s: Floats


def receiver_of(site: Site, *, perfect: bool) -> ReceiverModel:
    """Return the receiver of the site file, or one without error."""
    if perfect:
        return ReceiverModel(_FIX_RATE_HZ)
    declared_errors = site.receiver
    return ReceiverModel(
        _FIX_RATE_HZ,
        position_noise_m=declared_errors.position_noise_m,
        position_spread_m=declared_errors.position_spread_m,
        correlation_s=SLOW_ERROR_S,
        speed_noise_m_per_s=declared_errors.speed_noise_m_per_s,
        latency_s=declared_errors.latency_s,
    )


def _altitude_m(bridge: Bridge, chainage_m: Floats) -> Floats:
    """Return the altitude of the road: level except on a bridge with known end altitudes."""
    ends = [a for a in (bridge.start_altitude_m, bridge.end_altitude_m) if a is not None]
    low, high = (ends[0], ends[-1]) if ends else (_ALTITUDE_M, _ALTITUDE_M)
    return np.interp(chainage_m, [0.0, bridge.span_m], [low, high])


def gnss_track(
    bridge: Bridge,
    step_s: float,
    antenna: AntennaTrack,
    receiver: ReceiverModel,
    rng: np.random.Generator,
    *,
    forward: bool,
) -> GnssTrack:
    """Return the fixes on a drive of the receiver's antenna."""
    time_s = step_s * np.arange(antenna.chainage_m.size, dtype=np.float64)
    fixes = measure_position(time_s, *antenna, receiver, rng)
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
