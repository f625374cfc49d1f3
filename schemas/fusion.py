"""What a crossing's result keeps for fusion: its likelihood about what crossings have in common.

-|R x - z|²/2 is the logarithm of the likelihood up to a constant, of x: the bridge's unknowns, the
truck's, and coefficients in mm of the long waves of the mismatch of its axles' roads; where there
are `bends`, then the crossing's place in m from where it was found, and the bends. No prior of the
first three is in it, nor the truck's total mass, to which all rigidities are proportional.
"""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

Finite = Annotated[float, Field(allow_inf_nan=False)]
_MOST_COORDINATES = 400


class _Fields(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Coordinate(_Fields):
    """An unknown: x = ln(value/location)/scale or value/scale; of EI, location/EI."""

    name: str
    location: Finite
    scale: Annotated[Finite, Field(gt=0)]
    is_log: bool
    absence: Annotated[Finite, Field(ge=0, le=1)] = 0.0
    """Probability before any crossing that it is exactly zero."""


class Axle(_Fields):
    """Where an axle stands on the road, in m."""

    width_m: Finite
    twin_distance_m: Finite
    length_m: Finite
    track_m: Finite
    offset_m: Finite


class Stretch(_Fields):
    """Values along the road, from `begin_m` on."""

    begin_m: Finite
    step_m: Annotated[Finite, Field(gt=0)]
    values: tuple[Finite, ...]


class Bends(_Fields):
    """What is of second order: sums of products of what bridge and place move from `about`."""

    about: tuple[Finite, ...]
    """x of the bridge's unknowns at the crossing's own optimum."""
    size: tuple[Annotated[Finite, Field(gt=0)], ...]
    """Units of the moves: of the bridge's unknowns, and in m of the place."""
    shapes: tuple[Finite, ...]
    """Of one bend after the other the factors of all products of two moves, i <= j row by row."""


class FusionLikelihood(_Fields):
    """See the module's text."""

    bridge: tuple[Coordinate, ...]
    """Elements last."""
    truck: tuple[Coordinate, ...]
    root: tuple[Finite, ...]
    """R, upper triangular, row by row."""
    target: Annotated[tuple[Finite, ...], Field(max_length=_MOST_COORDINATES)]
    """z."""
    element_lengths_m: tuple[Finite, ...]
    mass_spread: Annotated[Finite, Field(ge=0)]
    """Relative, of the truck's total mass."""
    footprints: tuple[Axle, Axle]
    first_knot_m: Finite | None = None
    """Chainage; None where both axles feel one road."""
    knot_spacing_m: Annotated[Finite, Field(gt=0)]
    level_m3: tuple[Finite, ...]
    """Of the mismatch, as the crossing told it."""
    off_bridge_m: tuple[Stretch, ...] = ()
    """The mismatch before and behind the bridge."""
    bends: Bends | None = None

    @model_validator(mode="after")
    def _has_its_size(self) -> "FusionLikelihood":
        m = len(self.target)
        if len(self.root) != m * (m + 1) // 2:
            raise ValueError(f"root must have {m * (m + 1) // 2} numbers, as target has {m}")
        told = len(self.bridge) + len(self.truck) + self._of_bends()
        if m < told or (m > told) != (self.first_knot_m is not None):
            raise ValueError("target must have a place for each coordinate, knot and bend")
        return self

    def _of_bends(self) -> int:
        """How many places bends take, with the crossing's place."""
        if self.bends is None:
            return 0
        moves = len(self.bends.size)
        if len(self.bends.about) != len(self.bridge) or moves != len(self.bridge) + 1:
            raise ValueError("bends must be of the bridge's coordinates and the place")
        count, left = divmod(len(self.bends.shapes), moves * (moves + 1) // 2)
        if left:
            raise ValueError("shapes must have a factor for each product of two moves")
        return 1 + count
