"""What a crossing's result keeps for fusion: its likelihood about what crossings have in common.

-|R x - z|²/2 is the logarithm of the likelihood up to a constant, of x: the bridge's unknowns, the
truck's, and coefficients in mm of the long waves of the mismatch of its axles' roads. No prior of
these is in it, nor the truck's total mass, to which all rigidities are proportional.
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

    @model_validator(mode="after")
    def _has_its_size(self) -> "FusionLikelihood":
        m = len(self.target)
        if len(self.root) != m * (m + 1) // 2:
            raise ValueError(f"root must have {m * (m + 1) // 2} numbers, as target has {m}")
        told = len(self.bridge) + len(self.truck)
        if m < told or (m > told) != (self.first_knot_m is not None):
            raise ValueError("target must have a place for each coordinate and knot")
        return self
