"""`[[vehicle.axles]]` and `[[vehicle.bogies]]` of a site file, converted to pairs for two axles.

The tables describe any number of axles. Identification compares two: their values become the pairs
[front, rear] of `[vehicle]`. A truck with a tandem (`site_tandem`) keeps its tables; its pairs are
those of all axles ahead of the tandem together, and of both its axles.
"""

import math
from typing import Any, Final

from schemas.site_axle_tables import MECHANICAL, TYRES, Axle, Axles
from schemas.site_errors import error_at
from schemas.site_numbers import UNSPRUNG_MASS_SPREAD
from schemas.site_tandem import tandem_of

_TOTAL_MASS_SPREAD: Final = 0.01
_LARGEST_LOAD_ERROR: Final = 0.1
"""Largest difference of the sum of axle loads from the total mass, relative to it."""

# Key of [vehicle] in the short form, and the key of an axle that replaces it.
REPLACED: Final = {
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


def in_pairs(table: Any) -> Any:
    """Return a [vehicle] table with its axles as pairs; one without axles is returned unchanged.

    A truck with a tandem keeps `axles` and `bogies` next to the pairs. Raise a `FieldError` or a
    ValidationError where the axles are wrong, where both spellings are given, and where
    identification does not model the axles.
    """
    if not isinstance(table, dict) or not {"axles", "bogies"} & table.keys():
        return table
    known = Axles.model_validate({k: table[k] for k in ("axles", "bogies") if k in table})
    for old, new in REPLACED.items():
        if old in table:
            raise error_at(
                old,
                f"and axles.{new} are both there, keep one: the values of [[vehicle.axles]] take "
                f"the place of {old}",
            )
    _check_places(known)
    kept: dict[str, Any] = {}
    if len(known.axles) > 2 or known.bogies:
        if len(known.axles) == 2:
            raise error_at(
                "bogies", "joins axles of a two-axle truck, it must join axles of three or more"
            )
        axles = _with_tracks(known.axles, table.get("track_m"))
        tandem = tandem_of(axles, known.bogies)
        kept = {"axles": axles, "bogies": known.bogies}
        front, rear = tandem.front, tandem.rear
    else:
        front, rear = known.axles
    rest = {key: value for key, value in table.items() if key not in ("axles", "bogies")}
    pairs: dict[str, Any] = {key: (getattr(front, key), getattr(rear, key)) for key in MECHANICAL}
    pairs["wheelbase_m"] = rear.position_m - front.position_m
    pairs |= _tyres(front, rear)
    if front.track_m is not None or rear.track_m is not None:
        pairs["track_m"] = _tracks(front, rear, table.get("track_m"))
    if front.lateral_offset_m is not None or rear.lateral_offset_m is not None:
        pairs["rear_axle_offset_m"] = (rear.lateral_offset_m or 0.0) - (
            front.lateral_offset_m or 0.0
        )
    return _centre_of_gravity(front, rear, table) | rest | pairs | kept


def _with_tracks(axles: tuple[Axle, ...], default: Any) -> tuple[Axle, ...]:
    """Return the axles; those without a track get the vehicle's, if that is one number."""
    if isinstance(default, bool) or not isinstance(default, int | float):
        return axles
    return tuple(
        axle if axle.track_m is not None else axle.model_copy(update={"track_m": float(default)})
        for axle in axles
    )


def _check_places(known: Axles) -> None:
    """Raise if axle positions do not ascend or a bogie names a missing axle."""
    places = [axle.position_m for axle in known.axles]
    if places[0] != 0.0:
        raise error_at(
            "axles.0.position_m", f"is {places[0]:g}, it must be 0, the position of the first axle"
        )
    for number in range(1, len(places)):
        if places[number] <= places[number - 1]:
            raise error_at(
                f"axles.{number}.position_m",
                f"is {places[number]:g}, it must be a length greater than {places[number - 1]:g} m:"
                " axles are listed from front to rear",
            )
    for number, bogie in enumerate(known.bogies):
        if max(bogie.axles) > len(places):
            raise error_at(
                f"bogies.{number}.axles",
                f"names axle {max(bogie.axles)}, it must be numbers from 1 to {len(places)}",
            )
        if bogie.shares is not None and len(bogie.shares) != len(bogie.axles):
            raise error_at(
                f"bogies.{number}.shares",
                f"has {len(bogie.shares)} values, it must have one for each of its "
                f"{len(bogie.axles)} axles",
            )


def _tyres(front: Axle, rear: Axle) -> dict[str, tuple[float, float]]:
    """Return the dimensions of the tyres; empty where neither axle states any.

    An axle without dimensions has those of most lorries: single tyres in front, twin tyres behind.
    """
    keys = ("tyre_width_m", "twin_tyre_distance_m", "tyre_contact_length_m")
    stated = [key for axle in (front, rear) for key in ("tyres", *keys) if getattr(axle, key)]
    if not stated and front.twin_tyre_distance_m is None and rear.twin_tyre_distance_m is None:
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
    """Return the track of each axle; an axle without one has the vehicle's."""
    defaults = default if isinstance(default, list | tuple) else [default, default]
    found = []
    for number, axle in enumerate((front, rear)):
        usual = defaults[number] if len(defaults) == 2 else None
        if axle.track_m is None and usual is None:
            raise error_at(
                f"axles.{number}.track_m", "is missing, give the track of both axles or of none"
            )
        found.append(usual if axle.track_m is None else axle.track_m)
    return tuple(found)


def _centre_of_gravity(front: Axle, rear: Axle, table: dict[str, Any]) -> dict[str, float]:
    """Return `front_axle_to_cg_m` and its spread, from the loads less the unsprung masses.

    If both loads are known, they are scaled to the total mass, which is known better.
    """
    if front.load_kg is None and rear.load_kg is None:
        raise error_at(
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
            raise error_at(
                "axles",
                f"carry {whole:g} kg by their load_kg, but total_mass_kg is {total:g}; both must "
                "be those of the truck as driven",
            )
        behind = total * rear.load_kg / whole
        spread_kg = (
            behind * front.load_kg / whole * math.hypot(front.load_kg_spread, rear.load_kg_spread)
        )
    elif rear.load_kg is not None:
        behind, spread_kg = rear.load_kg, rear.load_kg * rear.load_kg_spread
    else:
        assert front.load_kg is not None  # noqa: S101 - one of the two is given
        behind = total - front.load_kg
        spread_kg = math.hypot(front.load_kg * front.load_kg_spread, total * total_spread)
    sprung = total - front.unsprung_mass_kg - rear.unsprung_mass_kg
    carried = behind - rear.unsprung_mass_kg
    if not 0.0 < carried < sprung:
        number, axle = (1, rear) if carried <= 0.0 else (0, front)
        raise error_at(
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
        "front_axle_to_cg_m": (rear.position_m - front.position_m) * carried / sprung,
        "front_axle_to_cg_m_spread": math.hypot(*parts),
    }


def _number(value: Any, otherwise: float = 0.0) -> float:
    """Return a number of at least zero, or `otherwise`; the model reports other values."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and 0.0 <= value < math.inf else otherwise
