"""The lane of simulated drives, and the torsion of the deck under it."""

from typing import NamedTuple

from schemas.site import Bridge
from schemas.site_lane import flexibility_per_n, wave_speed_m_per_s
from services.common.errors import InputError


class Twist(NamedTuple):
    """A deck that twists under a truck on an eccentric lane."""

    flexibility_per_n: float
    wave_speed_m_per_s: float
    lane_offset_m: float
    """Distance to the left of the axis, seen from start to end."""


def driven_lane(
    bridge: Bridge, lane_offset_m: float | None, torsion: tuple[float, float] | None
) -> tuple[float, tuple[float, float] | None]:
    """Return the lane's offset in m, and the deck's frequency ratio and gyration in m.

    Values that are not given are those of the site file, without which the lane is on the axis and
    the deck does not twist. Raise InputError for one of both without the other.
    """
    ratio, gyration_m = bridge.torsional_frequency_ratio, bridge.deck_gyration_m
    declared = None if ratio is None or gyration_m is None else (ratio, gyration_m)
    offset_m = bridge.lane_offset_m if lane_offset_m is None else lane_offset_m
    twisting = declared if torsion is None else torsion
    if torsion is not None and offset_m is None:
        raise InputError("--torsion: is of use with --lane-offset only, which is missing")
    if lane_offset_m is not None and twisting is None:
        raise InputError("--lane-offset: is of use with --torsion only, which is missing")
    return offset_m or 0.0, twisting if offset_m else None


def twist_of(
    bridge: Bridge,
    lane_offset_m: float | None = None,
    torsion: tuple[float, float] | None = None,
) -> Twist | None:
    """Return the twist of the site's bridge, uniform and undamaged; None on the axis.

    Arguments as in `driven_lane`; on a deck that does not twist the flexibility is zero.
    """
    offset_m, twisting = driven_lane(bridge, lane_offset_m, torsion)
    if not offset_m:
        return None
    if twisting is None:
        return Twist(0.0, 0.0, offset_m)
    frequency_ratio, gyration_m = twisting
    span_m, rigidity_nm2, mass_kg_per_m = bridge.uniform()
    return Twist(
        flexibility_per_n(offset_m, gyration_m, frequency_ratio, span_m, rigidity_nm2),
        wave_speed_m_per_s(frequency_ratio, span_m, rigidity_nm2, mass_kg_per_m),
        offset_m,
    )
