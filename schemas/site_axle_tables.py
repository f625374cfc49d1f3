"""The tables `[[vehicle.axles]]` and `[[vehicle.bogies]]` of a site file."""

from typing import Annotated, Final, Literal, NamedTuple

from pydantic import Field, Strict, StrictBool

from schemas.site_numbers import NotNegative, Number, Positive, Spread, Table, Track

MAX_AXLES: Final = 20
_LOAD_SPREAD: Final = 0.02
MECHANICAL: Final = (
    "unsprung_mass_kg",
    "suspension_stiffness_n_per_m",
    "suspension_damping_ns_per_m",
    "tyre_stiffness_n_per_m",
    "tyre_damping_ns_per_m",
)
"""Keys of an axle that add up over axles, and that [vehicle] has as pairs."""


class Tyres(NamedTuple):
    """Default dimensions of the tyres of an axle, in m."""

    width_m: float
    twin_distance_m: float
    contact_length_m: float


TYRES: Final = {
    "single": Tyres(0.25, 0.0, 0.2),
    "twin": Tyres(0.22, 0.33, 0.2),
    "wide": Tyres(0.4, 0.0, 0.2),
}


class Axle(Table):
    """An axle; values of springs, dampers and tyres are of both wheels together."""

    position_m: Annotated[Number, Field(ge=0, le=60)]
    """Distance behind the first axle."""
    tyres: Literal["single", "twin", "wide"] | None = None
    """Kind of tyres, which sets the defaults of the next three."""
    tyre_width_m: Positive | None = None
    twin_tyre_distance_m: NotNegative | None = None
    tyre_contact_length_m: Positive | None = None
    track_m: Track | None = None
    load_kg: Annotated[Number, Field(gt=0, le=1e6)] | None = None
    """Static load by a weighbridge."""
    load_kg_spread: Spread = _LOAD_SPREAD
    lateral_offset_m: Annotated[Number, Field(ge=-1, le=1)] | None = None
    """Distance to the left of the truck's centre line."""
    unsprung_mass_kg: Positive
    suspension_stiffness_n_per_m: Positive
    suspension_damping_ns_per_m: NotNegative
    tyre_stiffness_n_per_m: Positive
    tyre_damping_ns_per_m: NotNegative = 0.0


class Bogie(Table):
    """A group of axles that share their load, by their numbers from 1."""

    axles: Annotated[
        tuple[Annotated[int, Strict(), Field(ge=1, le=MAX_AXLES)], ...],
        Field(min_length=2, max_length=MAX_AXLES),
    ]
    equalised: StrictBool = False
    """Whether the axles share one spring force by `shares`."""
    shares: Annotated[tuple[Positive, ...], Field(max_length=MAX_AXLES)] | None = None
    """Shares of the force, one for each axle; equal where absent."""
    share_spread: Spread = 0.05


class Axles(Table):
    """The axles of a truck from front to rear, and its bogies."""

    axles: Annotated[tuple[Axle, ...], Field(min_length=2, max_length=MAX_AXLES)]
    bogies: Annotated[tuple[Bogie, ...], Field(max_length=MAX_AXLES)] = ()
