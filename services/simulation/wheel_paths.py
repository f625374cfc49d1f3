"""Wheel paths of a simulated truck on a 2-D road surface, and the profiles along them.

By default both axles follow one profile. On a surface single tyres in front and twin tyres behind
average over different strips, the rear axle runs some millimetres off the front one, and the
truck's lateral position differs from run to run.
"""

from typing import Final, NamedTuple

import numpy as np

from pre_core.physics.road import Profile
from pre_core.physics.simulate import Motion
from pre_core.physics.surface import (
    TYPICAL_FOOTPRINTS,
    Footprint,
    Surface,
    axle_profile,
    random_surface,
)
from schemas.site import Bridge, Vehicle
from services.common.errors import InputError
from services.identification.footprints import footprints_of
from services.simulation.pavement import (
    PLAIN,
    Pavement,
    joint_heights,
    on_stretched_surface,
    with_deck,
)

REAR_OFFSET_M: Final = 0.005
"""Lateral offset of the rear axle; axles are aligned to millimetres."""
WANDER_M: Final = 0.12
"""Usual lateral wander of a truck."""
REACH_M: Final = 150.0
"""Extent of a surface beyond both ends of the bridge, or a multiple: runs within the same extent,
fast or slow, either way, drive over the same road."""
_SINGLE, _TWIN = TYPICAL_FOOTPRINTS
_BEHIND: Final = {"single": _SINGLE, "twin": _TWIN}


class SurfaceOptions(NamedTuple):
    """Options for a truck on a surface that the site file may not have."""

    tyres: str | None = None
    """Rear tyres: "single" or "twin" (the default)."""
    rear_offset_m: float | None = None
    wander_m: float = 0.0
    pavement: Pavement = PLAIN


USUAL: Final = SurfaceOptions()


class WheelPaths(NamedTuple):
    """The paths of the axles."""

    front: Footprint
    rear: Footprint
    wander_m: float = 0.0
    """Lateral wander: standard deviation of the truck's position from run to run."""
    pavement: Pavement = PLAIN


class AxleRoads(NamedTuple):
    """The profile under the tyres of each axle."""

    front: Profile
    rear: Profile


def wheel_paths_of(vehicle: Vehicle, asked: SurfaceOptions = USUAL) -> WheelPaths:
    """Return the tyres of the site file, of the options, or common ones.

    Raise InputError if the site file already defines an option.
    """
    distance, offset_m = vehicle.twin_tyre_distance_m, vehicle.rear_axle_offset_m
    for option, wanted, name, known in (
        ("--tyres", asked.tyres, "twin_tyre_distance_m", distance),
        ("--rear-offset", asked.rear_offset_m, "rear_axle_offset_m", offset_m),
    ):
        if wanted is not None and known is not None:
            raise InputError(
                f"{option}: {vehicle.id} declares {name} in the site file, leave the option out"
            )
    behind = asked.tyres or "twin"
    if distance is not None:
        behind = "twin" if distance[1] > 0.0 else "single"
    if offset_m is None:
        offset_m = REAR_OFFSET_M if asked.rear_offset_m is None else asked.rear_offset_m
    front, rear = footprints_of(vehicle, (_SINGLE, _BEHIND[behind]))
    return WheelPaths(front, rear._replace(offset_m=offset_m), asked.wander_m, asked.pavement)


def roads_of_surface(
    bridge: Bridge,
    motion: Motion,
    beyond_m: float,
    spacing_m: float,
    road: tuple[str, int],
    paths: WheelPaths,
    rng: np.random.Generator,
) -> AxleRoads:
    """Return the profiles of both axles on the surface of a class and a seed; draw the wander.

    `beyond_m` is the extent of the road beyond the front axle.
    """
    low, high = motion.position_m.min() - beyond_m, motion.position_m.max() + beyond_m
    before = REACH_M * max(1.0, np.ceil(-low / REACH_M))
    after = REACH_M * max(1.0, np.ceil((high - bridge.span_m) / REACH_M))
    surface = random_surface(-before, np.ceil(bridge.span_m) + after, spacing_m, *road)
    beside = paths.wander_m * float(rng.standard_normal())
    # The left of a returning truck is the right of the line.
    sign = 1.0 if motion.speed_m_per_s[0] >= 0.0 else -1.0
    front, rear = (
        _profile_under(
            surface, axle._replace(offset_m=sign * axle.offset_m), beside, paths.pavement
        )
        for axle in (paths.front, paths.rear)
    )
    if paths.pavement.deck_roughness != 1.0:
        factor = paths.pavement.deck_roughness
        front, rear = (with_deck(one, bridge.span_m, factor) for one in (front, rear))
    if paths.pavement.largest_joint_m > 0.0:
        front, rear = (
            one._replace(
                height_m=one.height_m
                + joint_heights(
                    one.x_m,
                    bridge.span_m,
                    paths.pavement.largest_joint_m,
                    axle._replace(offset_m=sign * axle.offset_m + beside),
                    road[1],
                )
            )
            for one, axle in ((front, paths.front), (rear, paths.rear))
        )
    return AxleRoads(front, rear)


def _profile_under(
    surface: Surface, axle: Footprint, lateral_m: float, pavement: Pavement
) -> Profile:
    """Return the profile of an axle on the surface, stretched laterally."""
    if pavement.anisotropy == 1.0:
        return axle_profile(surface, axle, lateral_m)
    stretched = on_stretched_surface(axle, pavement.anisotropy)
    return axle_profile(surface, stretched, lateral_m / pavement.anisotropy)
