"""Where the wheels of a simulated truck run on a road that is a surface, and what they feel there.

Both axles feel one groove unless somebody asks for more. On a surface single tyres in front and
twin tyres behind average over different strips, the rear axle runs some millimetres beside the
front one, and the truck takes another place in its lane from run to run.
"""

from typing import Final, NamedTuple

import numpy as np

from pre_core.physics.road import Profile
from pre_core.physics.simulate import Motion
from pre_core.physics.surface import COMMON_LORRY, Footprint, felt_by, random_surface
from schemas.site import Bridge, Vehicle
from services.common.errors import InputError
from services.identification.footprints import footprints_of

REAR_OFFSET_M: Final = 0.005
"""Axles are set to millimetres."""
REACH_M: Final = 150.0
"""A surface is drawn so far beyond both ends of the bridge, or twice as far, …: runs that stay
within the same reach, fast or slow, either way, drive over the same road."""
_SINGLE, _TWIN = COMMON_LORRY
_BEHIND: Final = {"single": _SINGLE, "twin": _TWIN}


class OnSurface(NamedTuple):
    """What the site file may not tell of a truck that drives on a surface."""

    tyres: str | None = None
    """Behind: "single" or "twin" (the default)."""
    rear_offset_m: float | None = None
    wander_m: float = 0.0


USUAL: Final = OnSurface()


class WheelPaths(NamedTuple):
    """Where the axles run."""

    front: Footprint
    rear: Footprint
    wander_m: float = 0.0
    """Standard deviation of the truck's place across the lane, from run to run."""


class AxleRoads(NamedTuple):
    """The road as the tyres of either axle feel it."""

    front: Profile
    rear: Profile


def wheel_paths_of(vehicle: Vehicle, asked: OnSurface = USUAL) -> WheelPaths:
    """What the site file says of the truck's tyres; else what is asked for; else common ones.

    InputError if the site file tells already what is asked for.
    """
    distance, offset_m = vehicle.twin_tyre_distance_m, vehicle.rear_axle_offset_m
    for option, wanted, name, told in (
        ("--tyres", asked.tyres, "twin_tyre_distance_m", distance),
        ("--rear-offset", asked.rear_offset_m, "rear_axle_offset_m", offset_m),
    ):
        if wanted is not None and told is not None:
            raise InputError(f"{option}: the site file tells it, {vehicle.id} has {name}")
    behind = asked.tyres or "twin"
    if distance is not None:
        behind = "twin" if distance[1] > 0.0 else "single"
    if offset_m is None:
        offset_m = REAR_OFFSET_M if asked.rear_offset_m is None else asked.rear_offset_m
    front, rear = footprints_of(vehicle, (_SINGLE, _BEHIND[behind]))
    return WheelPaths(front, rear._replace(offset_m=offset_m), asked.wander_m)


def roads_of_surface(
    bridge: Bridge,
    motion: Motion,
    beyond_m: float,
    spacing_m: float,
    road: tuple[str, int],
    paths: WheelPaths,
    rng: np.random.Generator,
) -> AxleRoads:
    """What both axles feel of the surface of a class and a seed; the truck's place is drawn.

    `beyond_m` is how far the road must reach past the front axle.
    """
    low, high = motion.position_m.min() - beyond_m, motion.position_m.max() + beyond_m
    before = REACH_M * max(1.0, np.ceil(-low / REACH_M))
    after = REACH_M * max(1.0, np.ceil((high - bridge.span_m) / REACH_M))
    surface = random_surface(-before, np.ceil(bridge.span_m) + after, spacing_m, *road)
    beside = paths.wander_m * float(rng.standard_normal())
    # The left of a truck that comes back is the right of the line.
    sign = 1.0 if motion.speed_m_per_s[0] >= 0.0 else -1.0
    return AxleRoads(
        *(
            felt_by(surface, axle._replace(offset_m=sign * axle.offset_m), beside)
            for axle in (paths.front, paths.rear)
        )
    )
