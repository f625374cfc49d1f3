"""The part of a crossing's result that fusion needs: its likelihood of the shared parameters.

Up to a constant the log-likelihood of x is -|R x - z|²/2. The vector x has the parameters of the
bridge and of the truck, and coefficients in mm of the long waves of the profile mismatch. With
`bends`, x continues with the longitudinal offset from the estimate in m and the curvature terms.
The likelihood contains no prior of bridge, truck and mismatch, nor the truck's total mass, to which
all rigidities are proportional.
"""

from typing import Annotated

from pydantic import Field, model_validator

from schemas.strict_model import Finite, StrictModel

_MAX_COORDINATES = 400


class Coordinate(StrictModel):
    """A parameter: x = ln(value/location)/scale or value/scale; for EI, location/EI."""

    name: str
    location: Finite
    scale: Annotated[Finite, Field(gt=0)]
    is_log: bool
    absence: Annotated[Finite, Field(ge=0, le=1)] = 0.0
    """Prior probability that the parameter is exactly zero."""


class AxleFootprint(StrictModel):
    """Footprint of an axle on the road, in m."""

    width_m: Finite
    twin_distance_m: Finite
    length_m: Finite
    track_m: Finite
    offset_m: Finite


class Stretch(StrictModel):
    """Values at even steps along the road, from `begin_m`."""

    begin_m: Finite
    step_m: Annotated[Finite, Field(gt=0)]
    values: tuple[Finite, ...]


class Bends(StrictModel):
    """Curvature terms: sums of products of two moves, of bridge parameters or offset."""

    about: tuple[Finite, ...]
    """Values of the bridge's x at the optimum of this crossing, from which the moves count; shape
    (b,)."""
    size: tuple[Annotated[Finite, Field(gt=0)], ...] = ()
    """Units of moves of single coordinates: of the b bridge parameters, and in m of the offset.
    Empty except in results of versions without `directions`."""
    shapes: tuple[Finite, ...]
    """Factors of all products of two moves, i <= j row by row, one curvature term after the other.
    """
    directions: tuple[Finite, ...] = ()
    """Matrix (b + 1, b + 1), row by row, whose columns are the moves of unit size; empty if `size`
    gives moves of single coordinates."""
    logarithms: Annotated[int, Field(ge=0)] = 0
    """Number of the last parameters of the bridge, all elements, whose x enters as ln x, in moves
    and in R; zero in results of earlier versions."""


class ShortWaves(StrictModel):
    """Response of a crossing's estimate to waves of the mismatch, at 1, 2, … steps in cycles/m."""

    step_cycles_per_m: Annotated[Finite, Field(gt=0)]
    cosine: tuple[Finite, ...]
    """Change of the bridge's parameters in x by a mismatch of cos(2 pi n s) m at the chainage s:
    wave by wave for the first parameter, then for the next."""
    sine: tuple[Finite, ...]


class FusionLikelihood(StrictModel):
    """The likelihood of a crossing, as the module describes it."""

    bridge: tuple[Coordinate, ...]
    """Bridge parameters; elements last."""
    truck: tuple[Coordinate, ...]
    root: tuple[Finite, ...]
    """R, upper triangular, row by row."""
    target: Annotated[tuple[Finite, ...], Field(max_length=_MAX_COORDINATES)]
    """The vector z."""
    element_lengths_m: tuple[Finite, ...]
    mass_spread: Annotated[Finite, Field(ge=0)]
    """Relative standard deviation of the truck's total mass."""
    footprints: tuple[AxleFootprint, AxleFootprint]
    first_knot_m: Finite | None = None
    """Chainage of the first mismatch coefficient; None where both axles follow one profile."""
    knot_spacing_m: Annotated[Finite, Field(gt=0)]
    level_m3: tuple[Finite, ...]
    """Levels of the mismatch spectrum, one for each shape, as this crossing estimates them."""
    off_bridge_m: tuple[Stretch, ...] = ()
    """Mismatch before and after the bridge."""
    bends: Bends | None = None
    short_waves: ShortWaves | None = None

    @model_validator(mode="after")
    def _has_its_size(self) -> "FusionLikelihood":
        m = len(self.target)
        if len(self.root) != m * (m + 1) // 2:
            raise ValueError(f"root must have {m * (m + 1) // 2} numbers, as target has {m}")
        expected = len(self.bridge) + len(self.truck) + self._of_bends()
        if m < expected or (m > expected) != (self.first_knot_m is not None):
            raise ValueError("target must have a place for each coordinate, knot and bend")
        short = self.short_waves
        if short is not None and (
            len(short.cosine) != len(short.sine) or len(short.sine) % len(self.bridge)
        ):
            raise ValueError(
                "short_waves must have as many values for each parameter of the bridge"
            )
        return self

    def _of_bends(self) -> int:
        """Return the number of coordinates of the curvature terms, with the offset."""
        if self.bends is None:
            return 0
        moves = len(self.bridge) + 1
        if len(self.bends.about) != moves - 1:
            raise ValueError("bends must be of the bridge's coordinates and the place")
        if self.bends.logarithms > moves - 1 or any(
            x <= 0.0 for x in self.bends.about[moves - 1 - self.bends.logarithms :]
        ):
            raise ValueError("logarithms must be of parameters of the bridge with a positive x")
        given = (len(self.bends.size), len(self.bends.directions))
        if given not in ((moves, 0), (0, moves**2)):
            raise ValueError(f"bends must have {moves} sizes or {moves**2} numbers of directions")
        count, left = divmod(len(self.bends.shapes), moves * (moves + 1) // 2)
        if left:
            raise ValueError("shapes must have a factor for each product of two moves")
        return 1 + count
