"""`[vehicle]` of a site file: a truck with its axles, and its accelerometers if it names them."""

import math
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import BeforeValidator, Field, model_validator

from schemas.signals import CHANNELS
from schemas.site_axle_tables import MAX_AXLES, Axle, Bogie
from schemas.site_axles import REPLACED, in_pairs
from schemas.site_errors import error_at
from schemas.site_numbers import (
    UNSPRUNG_MASS_SPREAD,
    Identifier,
    NotNegativePair,
    Number,
    Positive,
    PositivePair,
    Spread,
    Table,
    Track,
)
from schemas.site_physics import check
from schemas.site_sensors import MAX_SENSORS, PlacedSensor, check_places, check_sensors
from schemas.site_tandem import Tandem, tandem_of

_TYRE_DAMPING_NS_PER_M: Final = 1000.0
TOTAL_T: Final = (1.0, 100.0)
"""Usual total mass of a truck in t."""
_SMALLEST_MASS_KG: Final = 0.1
_SMALLEST_AXLE: Final = 1e-3
"""Smallest share of the truck's mass in one axle, and in the body."""
_SMALLEST_LOAD: Final = 0.01
"""Smallest share of the weight on one axle."""
_SPRING_HZ: Final = (0.1, 300.0)
"""Natural frequency of the body on an axle's springs; at 0.1 Hz it sags by 25 m under its weight.
"""
_TYRE_HZ: Final = (0.1, 1000.0)
"""Natural frequency: lower bound for the body on the tyres, upper bound for the axle on them."""
_MAX_DAMPING: Final = 20.0
"""Largest damping ratio of a suspension and of a tyre."""
_TYRE_M: Final = (1e-3, 2.0)


def _two(value: object) -> object:
    """Expand one value for both axles to a pair."""
    return [value] * 2 if isinstance(value, int | float) and not isinstance(value, bool) else value


def _none_twin(value: object) -> object:
    """Expand a zero, single tyres on both axles, to a pair; front tyres are never twin."""
    return _two(value) if isinstance(value, int | float) and value == 0 else value


class WithSpreads(Table):
    """A table whose values may have spreads."""

    id: Identifier

    def spread(self, key: str) -> float:
        """Return the relative standard deviation of the prior of `key`."""
        value: float = getattr(self, f"{key}_spread")
        return value

    def nominal(self, key: str) -> tuple[float, ...]:
        """Return the nominal values of a quantity, one or several."""
        value: float | tuple[float, ...] = getattr(self, key)
        return value if isinstance(value, tuple) else (value,)

    def scale_at_zero(self, key: str) -> float:
        """Return the scale of the half-normal prior of a quantity whose nominal value is zero."""
        value: float = getattr(self, f"{key}_scale_at_zero")
        return value


class Vehicle(WithSpreads):
    """A truck with two axles, or with more and a tandem; nominal values are from a data sheet.

    With a tandem, pairs are those of all axles ahead of it together, and of both its axles; the
    wheelbase is the distance between the spring forces of these groups.
    """

    later_keys: ClassVar[tuple[str, ...]] = ("axles", "bogies")

    total_mass_kg: Annotated[Number, Field(gt=0, le=1e6)]
    wheelbase_m: Annotated[Number, Field(gt=0, le=30)]
    front_axle_to_cg_m: Annotated[Number, Field(gt=0, le=30)]
    suspension_damping_ns_per_m: NotNegativePair
    suspension_stiffness_n_per_m: PositivePair
    unsprung_mass_kg: PositivePair
    tyre_stiffness_n_per_m: PositivePair
    gps_antenna_to_front_axle_m: Annotated[Number, Field(ge=-50, le=50)]
    """Distance of the antenna behind the front axle."""
    cg_height_m: Annotated[Number, Field(gt=0, le=5)] | None = None
    pitch_inertia_ratio: Annotated[Number, Field(gt=0, le=10)] = 1.0
    """Ratio κ: the pitch inertia is κ·m_s·d_1·d_2."""
    tyre_damping_ns_per_m: NotNegativePair = (0.0, 0.0)
    """Tyre damping; zero: unknown (see `scale_at_zero`)."""
    tyre_width_m: Annotated[
        PositivePair | None,
        BeforeValidator(_two, json_schema_input_type=PositivePair | Positive | None),
    ] = None
    """Tread widths; with the next four they determine the profile mismatch of the axles."""
    tyre_contact_length_m: PositivePair | None = None
    twin_tyre_distance_m: Annotated[
        NotNegativePair | None,
        BeforeValidator(_none_twin, json_schema_input_type=NotNegativePair | Literal[0] | None),
    ] = None
    """Distance between the centres of twin tyres; 0 for single tyres."""
    track_m: Annotated[
        tuple[Track, Track] | None,
        BeforeValidator(_two, json_schema_input_type=tuple[Track, Track] | Track | None),
    ] = None
    """Distance between the centres of the left and right wheels of each axle."""
    rear_axle_offset_m: Annotated[Number, Field(ge=-1, le=1)] | None = None
    """Distance of the rear axle's path to the left of the front axle's."""
    sensors: Annotated[tuple[PlacedSensor, ...], Field(max_length=MAX_SENSORS)] = ()
    """Accelerometers by name and place; empty: four with the names of `CHANNELS`, on the centre
    line."""
    axles: Annotated[tuple[Axle, ...], Field(max_length=MAX_AXLES)] = ()
    """Axles of a truck with a tandem; empty: two, in the pairs."""
    bogies: Annotated[tuple[Bogie, ...], Field(max_length=MAX_AXLES)] = ()

    total_mass_kg_spread: Spread = 0.01
    wheelbase_m_spread: Spread = 0.002
    front_axle_to_cg_m_spread: Spread = 0.15
    suspension_damping_ns_per_m_spread: Spread = 0.15
    suspension_stiffness_n_per_m_spread: Spread = 0.15
    unsprung_mass_kg_spread: Spread = UNSPRUNG_MASS_SPREAD
    tyre_stiffness_n_per_m_spread: Spread = 0.15
    cg_height_m_spread: Spread = 0.15
    pitch_inertia_ratio_spread: Spread = 0.15
    tyre_damping_ns_per_m_spread: Spread = 0.15

    @property
    def tyre_damping_ns_per_m_scale_at_zero(self) -> float:
        """Scale of the half-normal prior of the damping of a tyre without a nominal value."""
        return _TYRE_DAMPING_NS_PER_M

    @property
    def tandem(self) -> Tandem | None:
        """The tandem whose axles are compared; None for a truck of two axles."""
        return tandem_of(self.axles, self.bogies) if self.axles else None

    @property
    def front_force_m(self) -> float:
        """Distance of the front spring force behind the first axle; 0 for one front axle."""
        tandem = self.tandem
        return 0.0 if tandem is None else tandem.front.position_m

    @property
    def length_m(self) -> float:
        """Distance between the first and the last axle."""
        return self.axles[-1].position_m if self.axles else self.wheelbase_m

    @property
    def tandem_share(self) -> float:
        """Share of the tandem's spring force on its first axle; 0 without a tandem."""
        tandem = self.tandem
        return 0.0 if tandem is None else tandem.share

    @property
    def tandem_share_spread(self) -> float:
        """Relative standard deviation of `tandem_share`."""
        tandem = self.tandem
        return 0.0 if tandem is None else tandem.share_spread

    @property
    def has_equal_single_tyres(self) -> bool:
        """Whether both axles have the same single tyres, as far as their sizes are declared."""
        pairs = (self.tyre_width_m, self.tyre_contact_length_m, self.track_m)
        return self.twin_tyre_distance_m == (0.0, 0.0) and all(
            pair is None or pair[0] == pair[1] for pair in pairs
        )

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the accelerometers."""
        return tuple(one.channel for one in self.sensors) or CHANNELS

    def shortest(self) -> dict[str, Any]:
        """Return all values in the shortest spelling, as they go into files and hashes.

        A truck without sensors of its own thus keeps the form and hash of older programs.
        """
        values = self.model_dump()
        if not self.sensors:
            del values["sensors"]
        if self.axles:
            return {
                key: value for key, value in values.items() if key not in (*REPLACED, "track_m")
            }
        if self.track_m is not None and self.track_m[0] == self.track_m[1]:
            values["track_m"] = self.track_m[0]
        return values

    @property
    def sprung_mass_kg(self) -> float:
        """Mass of the body, without axles and wheels."""
        return self.total_mass_kg - sum(self.unsprung_mass_kg)

    @property
    def cg_to_rear_axle_m(self) -> float:
        """Distance d_2 of the body's centre of gravity from the rear axle."""
        return self.wheelbase_m - self.front_axle_to_cg_m

    @model_validator(mode="before")
    @classmethod
    def _axles_in_pairs(cls, table: Any) -> Any:
        if isinstance(table, dict) and table.get("sensors") == []:
            raise error_at(
                "sensors",
                "is [], it must be [[vehicle.sensors]] with all accelerometers, or be left out for "
                "the four usual ones",
            )
        return in_pairs(table)

    @model_validator(mode="after")
    def _fits_together(self) -> "Vehicle":
        if self.front_axle_to_cg_m >= self.wheelbase_m:
            raise error_at(
                "front_axle_to_cg_m",
                f"is {self.front_axle_to_cg_m}, it must be a length less than wheelbase_m, "
                f"{self.wheelbase_m} m",
            )
        if self.sprung_mass_kg <= 0:
            raise error_at(
                "unsprung_mass_kg",
                f"adds up to {sum(self.unsprung_mass_kg)}, it must be a mass less than "
                f"total_mass_kg, {self.total_mass_kg} kg{_in_tonnes(self.total_mass_kg)}",
            )
        if self.tandem is not None and not self.sensors:
            raise error_at(
                "sensors",
                "is missing, it must place two accelerometers on the body and one on each axle of "
                "the tandem",
            )
        if self.sensors:
            check_places(self.sensors, self.length_m, self.track_m or ())
            tandem = self.tandem
            check_sensors(
                self.sensors,
                (self.front_force_m, self.wheelbase_m),
                1 if tandem is None else tandem.number,
                max(2, len(self.axles)),
            )
        _check_physics(self)
        return self


def axle_loads_kg(vehicle: Vehicle) -> tuple[float, float]:
    """Return the nominal static loads of the front and the rear axle in kg."""
    share = vehicle.front_axle_to_cg_m / vehicle.wheelbase_m
    return (
        vehicle.sprung_mass_kg * (1.0 - share) + vehicle.unsprung_mass_kg[0],
        vehicle.sprung_mass_kg * share + vehicle.unsprung_mass_kg[1],
    )


def _check_physics(vehicle: Vehicle) -> None:
    """Raise an error for the first key whose value no truck can have."""
    total = vehicle.total_mass_kg
    check("total_mass_kg", total, (_SMALLEST_MASS_KG, 1e6), "a mass", "kg")
    wheelbase = vehicle.wheelbase_m
    check("wheelbase_m", wheelbase, (0.05, 30.0), "a length", "m")
    check(
        "front_axle_to_cg_m",
        vehicle.front_axle_to_cg_m,
        (_SMALLEST_LOAD * wheelbase, (1.0 - _SMALLEST_LOAD) * wheelbase),
        "a length",
        "m",
        "each axle carries a part of the truck",
    )
    check("pitch_inertia_ratio", vehicle.pitch_inertia_ratio, (0.01, 10.0), "a number")
    for k, mass in enumerate(vehicle.unsprung_mass_kg):
        limits = (_SMALLEST_AXLE * total, (1.0 - _SMALLEST_AXLE) * total)
        check(f"unsprung_mass_kg.{k}", mass, limits, "a mass", "kg", f"the truck has {total:g} kg")
    if vehicle.sprung_mass_kg < _SMALLEST_AXLE * total:
        raise error_at(
            "unsprung_mass_kg",
            f"adds up to {sum(vehicle.unsprung_mass_kg):g}, it must be a mass of at most "
            f"{(1.0 - _SMALLEST_AXLE) * total:g} kg: a part of the truck is on springs",
        )
    loads = (vehicle.cg_to_rear_axle_m / wheelbase, vehicle.front_axle_to_cg_m / wheelbase)
    for k in range(2):
        _check_axle(vehicle, k, vehicle.sprung_mass_kg * loads[k])
    for key in ("tyre_width_m", "tyre_contact_length_m"):
        for k, value in enumerate(getattr(vehicle, key) or ()):
            check(f"{key}.{k}", value, _TYRE_M, "a length", "m")
    for k, value in enumerate(vehicle.twin_tyre_distance_m or ()):
        check(f"twin_tyre_distance_m.{k}", value, (0.0, _TYRE_M[1]), "a length", "m")
    for k, value in enumerate(vehicle.track_m or ()):
        check(f"track_m.{k}", value, (0.02, 5.0), "a length", "m")


def _check_axle(vehicle: Vehicle, k: int, body_kg: float) -> None:
    """Raise if springs, tyres or dampers of an axle that carries `body_kg` are impossible."""
    axle_kg = vehicle.unsprung_mass_kg[k]
    spring, tyre = vehicle.suspension_stiffness_n_per_m[k], vehicle.tyre_stiffness_n_per_m[k]
    low, high = (_stiffness(body_kg, hz) for hz in _SPRING_HZ)
    because = f"{body_kg:.3g} kg swing on it at {_SPRING_HZ[0]:g} to {_SPRING_HZ[1]:g} Hz"
    key = f"suspension_stiffness_n_per_m.{k}"
    check(key, spring, (low, high), "a stiffness", "N/m", because)
    low, high = _stiffness(body_kg, _TYRE_HZ[0]), _stiffness(axle_kg, _TYRE_HZ[1])
    because = f"an axle of {axle_kg:.3g} kg swings on it at {_TYRE_HZ[1]:g} Hz at most"
    check(f"tyre_stiffness_n_per_m.{k}", tyre, (low, high), "a stiffness", "N/m", because)
    because = f"the damping ratio is {_MAX_DAMPING:g} then"
    for key, damping, stiffness, mass in (
        ("suspension_damping_ns_per_m", vehicle.suspension_damping_ns_per_m[k], spring, body_kg),
        ("tyre_damping_ns_per_m", vehicle.tyre_damping_ns_per_m[k], tyre, axle_kg),
    ):
        most = 2.0 * _MAX_DAMPING * math.sqrt(stiffness * mass)
        check(f"{key}.{k}", damping, (0.0, most), "a damping", "N·s/m", because)


def _in_tonnes(mass_kg: float) -> str:
    """Return a hint that the total mass of a truck may be in t; empty where it may not."""
    if not TOTAL_T[0] <= mass_kg <= TOTAL_T[1]:
        return ""
    return f"; total_mass_kg is {mass_kg:g}: in t? then it is {1e3 * mass_kg:g}"


def _stiffness(mass_kg: float, frequency_hz: float) -> float:
    return mass_kg * (2.0 * math.pi * frequency_hz) ** 2
