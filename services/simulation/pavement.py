"""Pavements: a deck that is rougher or smoother than the road, joints at its ends, anisotropy.

Only simulations have these; the method knows none of their ranges or shapes.

- On the bridge the slopes of the surface are multiplied by a factor, so that its heights continue
  the road's without a jump.
- A joint is a dip or a step at an end of the deck. Its size varies laterally by a tenth (standard
  deviation), so that axles with different tyres meet nearly the same joint.
- An anisotropic surface is an isotropic one stretched laterally: left and right resemble each other
  more, and a profile along any line keeps its spectrum.
"""

from typing import Final, NamedTuple

import numpy as np

from pre_core.physics.road import Profile
from pre_core.physics.surface import Footprint, response
from services.common.arrays import Floats

JOINT_WIDTH_M: Final = (0.05, 0.30)
JOINT_SHARE: Final = (0.3, 1.0)
"""Size of a joint over the largest one."""
_LATERAL_CHANGE: Final = 0.1
_LATERAL_CYCLES_PER_M: Final = (0.2, 2.0)
_LATERAL_WAVES: Final = 20


class Pavement(NamedTuple):
    """Properties of a surface and its deck beyond an isotropic road."""

    deck_roughness: float = 1.0
    """Slopes on the bridge over those of the same surface off it."""
    largest_joint_m: float = 0.0
    """Largest height of a dip or step at either end of the deck; 0 without joints."""
    anisotropy: float = 1.0
    """Lateral correlation length over that of an isotropic surface."""


PLAIN: Final = Pavement()


def on_stretched_surface(axle: Footprint, anisotropy: float) -> Footprint:
    """Return the axle that has on an isotropic surface the profile of `axle` on a stretched one."""
    return axle._replace(
        width_m=axle.width_m / anisotropy,
        twin_distance_m=axle.twin_distance_m / anisotropy,
        track_m=axle.track_m / anisotropy,
        offset_m=axle.offset_m / anisotropy,
    )


def with_deck(profile: Profile, span_m: float, roughness: float) -> Profile:
    """Return the profile with its slopes between 0 and `span_m` multiplied by `roughness`."""
    middle = 0.5 * (profile.x_m[1:] + profile.x_m[:-1])
    factor = np.where((middle > 0.0) & (middle < span_m), roughness, 1.0)
    rise = np.cumsum(factor * np.diff(profile.height_m))
    return profile._replace(height_m=profile.height_m[0] + np.concatenate([[0.0], rise]))


def joint_heights(
    x_m: Floats, span_m: float, largest_m: float, axle: Footprint, seed: int
) -> Floats:
    """Return heights (n,) in m of the joints at 0 and `span_m` under an axle; `seed` draws them."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x10117]))
    heights = np.zeros_like(x_m)
    for end in (0.0, span_m):
        size = largest_m * rng.uniform(*JOINT_SHARE) * rng.choice((-1.0, 1.0))
        width = rng.uniform(*JOINT_WIDTH_M)
        is_step = rng.uniform() < 0.5
        waves = rng.uniform(*_LATERAL_CYCLES_PER_M, _LATERAL_WAVES)
        amplitude = rng.standard_normal((2, _LATERAL_WAVES))
        lateral = response(axle, np.zeros(1), waves)
        change = float(((amplitude[0] + 1j * amplitude[1]) * lateral).real.sum())
        size *= 1.0 + _LATERAL_CHANGE * change / np.sqrt(_LATERAL_WAVES)
        along = np.clip((x_m - end) / width + 0.5, 0.0, 1.0)
        turn = np.pi * along if is_step else 2.0 * np.pi * along
        heights += 0.5 * size * (1.0 - np.cos(turn))
    spacing = float(x_m[1] - x_m[0])
    points = max(1, round(axle.length_m / spacing))
    padded = np.pad(heights, points, mode="edge")
    return np.convolve(padded, np.full(points, 1.0 / points), mode="same")[points:-points]
