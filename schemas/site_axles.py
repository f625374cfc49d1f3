"""`[[vehicle.axles]]` and `[[vehicle.bogies]]` of a site file, converted to pairs for two axles.

The tables describe any number of axles. Identification knows two: their values become the pairs
[front, rear] of `[vehicle]`, and a truck of more axles is refused.
"""

import math
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import Field, Strict, StrictBool

from schemas.site_errors import at
from schemas.site_numbers import (
    UNSPRUNG_MASS_SPREAD,
    NotNegative,
    Number,
    Positive,
    Spread,
    Table,
    Track,
)

MOST_AXLES: Final = 20
_LOAD_SPREAD: Final = 0.02
_TOTAL_MASS_SPREAD: Final = 0.01
_LARGEST_LOAD_ERROR: Final = 0.1
"""Beyond this share of the total mass the loads of the axles are another truck's."""


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
    """One axle; both wheels together where a value is of springs, dampers or tyres."""

    position_m: Annotated[Number, Field(ge=0, le=60)]
    """Distance behind the first axle."""
    tyres: Literal["single", "twin", "wide"] | None = None
    """Kind of tyres: the defaults of the next three."""
    tyre_width_m: Positive | None = None
    twin_tyre_distance_m: NotNegative | None = None
    tyre_contact_length_m: Positive | None = None
    track_m: Track | None = None
    load_kg: Annotated[Number, Field(gt=0, le=1e6)] | None = None
    """Static load by a weighbridge."""
    load_kg_spread: Spread = _LOAD_SPREAD
    lateral_offset_m: Annotated[Number, Field(ge=-1, le=1)] | None = None
    """Distance to the left of the truck's middle."""
    unsprung_mass_kg: Positive
    suspension_stiffness_n_per_m: Positive
    suspension_damping_ns_per_m: NotNegative
    tyre_stiffness_n_per_m: Positive
    tyre_damping_ns_per_m: NotNegative = 0.0


class Bogie(Table):
    """Axles that share their load, by their numbers from 1."""

    axles: Annotated[
        tuple[Annotated[int, Strict(), Field(ge=1, le=MOST_AXLES)], ...],
        Field(min_length=2, max_length=MOST_AXLES),
    ]
    equalised: StrictBool = False
    """Whether the axles share one spring force by `shares`."""
    shares: Annotated[tuple[Positive, ...], Field(max_length=MOST_AXLES)] | None = None
    """Shares of the force, one for each axle; equal where absent."""
    share_spread: Spread = 0.05


class Axles(Table):
    """The axles of a truck in the order in which they pass, and its bogies."""

    axles: Annotated[tuple[Axle, ...], Field(min_length=2, max_length=MOST_AXLES)]
    bogies: Annotated[tuple[Bogie, ...], Field(max_length=MOST_AXLES)] = ()


# Key of [vehicle] in the short form, and the key of an axle that takes its place.
_REPLACED: Final = {
    "wheelbase_m": "position_m",
    "front_axle_to_cg_m": "load_kg",
    "unsprung_mass_kg": "unsprung_mass_kg",
    "suspension_stiffness_n_per_m": "suspension_stiffness_n_per_m",
    "suspension_damping_ns_per_m": "suspension_damping_ns_per_m",
    "tyre_stiffness_n_per_m": "tyre_stiffness_n_per_m",
    "tyre_damping_ns_per_m": "tyre_damping_ns_per_m",
    "tyre_width_m": "tyre_width_m",
    "tyre_contact_length_m": "tyre_contact_length_m",
    "twin_tyre_distance_m": "twin_tyre_distance_m",
    "rear_axle_offset_m": "lateral_offset_m",
}
_ALIKE: Final = (
    "unsprung_mass_kg",
    "suspension_stiffness_n_per_m",
    "suspension_damping_ns_per_m",
    "tyre_stiffness_n_per_m",
    "tyre_damping_ns_per_m",
)


def in_pairs(table: Any) -> Any:
    """Return a [vehicle] table with its axles as pairs; one without axles is returned as it is.

    Raises a `FieldError` or a ValidationError where the axles are wrong, where both spellings are
    there, and where there are more axles than identification knows.
    """
    if not isinstance(table, dict) or not {"axles", "bogies"} & table.keys():
        return table
    known = Axles.model_validate({k: table[k] for k in ("axles", "bogies") if k in table})
    for old, new in _REPLACED.items():
        if old in table:
            raise at(
                old,
                f"and axles.{new} are both there, keep one: the values of [[vehicle.axles]] take "
                f"the place of {old}",
            )
    _check_places(known)
    if len(known.axles) > 2 or known.bogies:
        what = f"has {len(known.axles)} axles" if len(known.axles) > 2 else "has a bogie"
        raise at(
            "axles",
            f"{what}: identification with more than two axles is not there yet, it must be a truck "
            "of two axles",
        )
    front, rear = known.axles
    rest = {key: value for key, value in table.items() if key not in ("axles", "bogies")}
    pairs: dict[str, Any] = {key: (getattr(front, key), getattr(rear, key)) for key in _ALIKE}
    pairs["wheelbase_m"] = rear.position_m
    pairs |= _tyres(front, rear)
    if front.track_m is not None or rear.track_m is not None:
        pairs["track_m"] = _tracks(front, rear, table.get("track_m"))
    if front.lateral_offset_m is not None or rear.lateral_offset_m is not None:
        pairs["rear_axle_offset_m"] = (rear.lateral_offset_m or 0.0) - (
            front.lateral_offset_m or 0.0
        )
    return _centre_of_gravity(front, rear, table) | rest | pairs


def _check_places(known: Axles) -> None:
    """Raise if the axles do not follow one another, or a bogie is of axles that there are not."""
    places = [axle.position_m for axle in known.axles]
    if places[0] != 0.0:
        raise at("axles.0.position_m", f"is {places[0]:g}, it must be 0: the first axle's place")
    for number in range(1, len(places)):
        if places[number] <= places[number - 1]:
            raise at(
                f"axles.{number}.position_m",
                f"is {places[number]:g}, it must be a length greater than {places[number - 1]:g} m:"
                " axles are listed in the order in which they pass",
            )
    for number, bogie in enumerate(known.bogies):
        if max(bogie.axles) > len(places):
            raise at(
                f"bogies.{number}.axles",
                f"names axle {max(bogie.axles)}, it must be numbers from 1 to {len(places)}",
            )
        if bogie.shares is not None and len(bogie.shares) != len(bogie.axles):
            raise at(
                f"bogies.{number}.shares",
                f"has {len(bogie.shares)} values, it must have one for each of its "
                f"{len(bogie.axles)} axles",
            )


def _tyres(front: Axle, rear: Axle) -> dict[str, tuple[float, float]]:
    """Dimensions of the tyres; nothing where neither axle's are known.

    An axle that says nothing has what most lorries have: single tyres in front, twin ones behind.
    """
    keys = ("tyre_width_m", "twin_tyre_distance_m", "tyre_contact_length_m")
    told = [key for axle in (front, rear) for key in ("tyres", *keys) if getattr(axle, key)]
    if not told and front.twin_tyre_distance_m is None and rear.twin_tyre_distance_m is None:
        return {}
    by_axle = []
    for axle, usual in ((front, "single"), (rear, "twin")):
        kind = axle.tyres or ("single" if axle.twin_tyre_distance_m == 0.0 else usual)
        given = [getattr(axle, key) for key in keys]
        by_axle.append(
            [
                default if one is None else one
                for one, default in zip(given, TYRES[kind], strict=True)
            ]
        )
    return dict(zip(keys, zip(*by_axle, strict=True), strict=True))


def _tracks(front: Axle, rear: Axle, default: Any) -> Any:
    """Track of each axle; an axle without one has the vehicle's."""
    defaults = default if isinstance(default, list | tuple) else [default, default]
    found = []
    for number, axle in enumerate((front, rear)):
        usual = defaults[number] if len(defaults) == 2 else None
        if axle.track_m is None and usual is None:
            raise at(
                f"axles.{number}.track_m", "is missing, give the track of both axles or of none"
            )
        found.append(usual if axle.track_m is None else axle.track_m)
    return tuple(found)


def _centre_of_gravity(front: Axle, rear: Axle, table: dict[str, Any]) -> dict[str, float]:
    """Return `front_axle_to_cg_m` and its spread, by the loads less the unsprung masses.

    Loads that are both known are scaled to the total mass, which is known better.
    """
    if front.load_kg is None and rear.load_kg is None:
        raise at(
            "axles.0.load_kg",
            "is missing, it must be a mass in kg: the load of one axle at least places the centre "
            "of gravity",
        )
    loads = (front.load_kg, rear.load_kg)
    total = _number(table.get("total_mass_kg")) or sum(load or 0.0 for load in loads)
    total_spread = _number(table.get("total_mass_kg_spread"), _TOTAL_MASS_SPREAD)
    if front.load_kg is not None and rear.load_kg is not None:
        whole = front.load_kg + rear.load_kg
        if abs(whole / total - 1.0) > _LARGEST_LOAD_ERROR:
            raise at(
                "axles",
                f"carry {whole:g} kg by their load_kg but total_mass_kg is {total:g}, both must "
                "be of the truck as it is driven",
            )
        behind = total * rear.load_kg / whole
        spread_kg = (
            behind * front.load_kg / whole * math.hypot(front.load_kg_spread, rear.load_kg_spread)
        )
    elif rear.load_kg is not None:
        behind, spread_kg = rear.load_kg, rear.load_kg * rear.load_kg_spread
    else:
        assert front.load_kg is not None  # noqa: S101 - one of them is
        behind = total - front.load_kg
        spread_kg = math.hypot(front.load_kg * front.load_kg_spread, total * total_spread)
    sprung = total - front.unsprung_mass_kg - rear.unsprung_mass_kg
    carried = behind - rear.unsprung_mass_kg
    if not 0.0 < carried < sprung:
        number, axle = (1, rear) if carried <= 0.0 else (0, front)
        raise at(
            f"axles.{number}.unsprung_mass_kg",
            f"is {axle.unsprung_mass_kg:g}, it must be a mass less than the load of the axle",
        )
    unsprung = _number(table.get("unsprung_mass_kg_spread"), UNSPRUNG_MASS_SPREAD)
    parts = (
        spread_kg / carried,
        unsprung * rear.unsprung_mass_kg * (1.0 / carried - 1.0 / sprung),
        unsprung * front.unsprung_mass_kg / sprung,
    )
    return {
        "front_axle_to_cg_m": rear.position_m * carried / sprung,
        "front_axle_to_cg_m_spread": math.hypot(*parts),
    }


def _number(value: Any, otherwise: float = 0.0) -> float:
    """Return a value that is a positive number; what else it is, the model complains about."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and 0.0 <= value < math.inf else otherwise
