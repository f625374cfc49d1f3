"""`[vehicle]` of a site file: a truck of two axles, with its accelerometers where it names them."""

from typing import Annotated, Any, Final

from pydantic import BeforeValidator, Field, model_validator

from schemas.signals import CHANNELS
from schemas.site_axles import in_pairs
from schemas.site_errors import at
from schemas.site_numbers import (
    UNSPRUNG_MASS_SPREAD,
    Identifier,
    NotNegativePair,
    Number,
    PositivePair,
    Spread,
    Table,
    Track,
)
from schemas.site_physics import check_vehicle
from schemas.site_sensors import MOST_SENSORS, PlacedSensor, check_sensors

_TYRE_DAMPING_NS_PER_M: Final = 1000.0


def _two(value: object) -> object:
    """Spell one value for both axles out as a pair."""
    return [value] * 2 if isinstance(value, int | float) and not isinstance(value, bool) else value


class Spreadable(Table):
    """A table whose values may have spreads."""

    id: Identifier

    def spread(self, key: str) -> float:
        """Return the relative standard deviation of the prior of `key`."""
        value: float = getattr(self, f"{key}_spread")
        return value

    def nominal(self, key: str) -> tuple[float, ...]:
        """Return what is known of a quantity before, one value or several."""
        value: float | tuple[float, ...] = getattr(self, key)
        return value if isinstance(value, tuple) else (value,)

    def scale_at_zero(self, key: str) -> float:
        """Return the scale of the half-normal prior of a quantity that is nominally zero."""
        value: float = getattr(self, f"{key}_scale_at_zero")
        return value


class Vehicle(Spreadable):
    """A truck with two axles. Nominal values are those of a data sheet."""

    total_mass_kg: Annotated[Number, Field(gt=0, le=1e6)]
    wheelbase_m: Annotated[Number, Field(gt=0, le=30)]
    front_axle_to_cg_m: Annotated[Number, Field(gt=0, le=30)]
    suspension_damping_ns_per_m: NotNegativePair
    suspension_stiffness_n_per_m: PositivePair
    unsprung_mass_kg: PositivePair
    tyre_stiffness_n_per_m: PositivePair
    gps_antenna_to_front_axle_m: Annotated[Number, Field(ge=-50, le=50)]
    """How far the antenna is behind the front axle, positive to the rear."""
    cg_height_m: Annotated[Number, Field(gt=0, le=5)] | None = None
    pitch_inertia_ratio: Annotated[Number, Field(gt=0, le=10)] = 1.0
    """κ: the pitch inertia is κ·m_s·d_1·d_2."""
    tyre_damping_ns_per_m: NotNegativePair = (0.0, 0.0)
    """Zero: not known (see `scale_at_zero`)."""
    tyre_width_m: PositivePair | None = None
    """Widths of the tread; with the next four, by how much the road differs from axle to axle."""
    tyre_contact_length_m: PositivePair | None = None
    twin_tyre_distance_m: NotNegativePair | None = None
    """Between the middles of twin tyres; 0 for single ones."""
    track_m: Annotated[tuple[Track, Track] | None, BeforeValidator(_two)] = None
    """Between the middles of the wheels of both sides, of each axle."""
    rear_axle_offset_m: Annotated[Number, Field(ge=-1, le=1)] | None = None
    """How far the rear axle runs to the left of the front axle."""
    sensors: Annotated[tuple[PlacedSensor, ...], Field(max_length=MOST_SENSORS)] = ()
    """Accelerometers by name and place; none: four by the names of `CHANNELS`, in the middle."""

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
        """Scale of the half-normal prior of the damping of a tyre of which nothing is known."""
        return _TYRE_DAMPING_NS_PER_M

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the accelerometers."""
        return tuple(one.channel for one in self.sensors) or CHANNELS

    def shortest(self) -> dict[str, Any]:
        """Return all values in the shortest spelling, as they go into files and hashes.

        So a truck without sensors of its own is to older programs what it was.
        """
        values = self.model_dump()
        if not self.sensors:
            del values["sensors"]
        if self.track_m is not None and self.track_m[0] == self.track_m[1]:
            values["track_m"] = self.track_m[0]
        return values

    @property
    def sprung_mass_kg(self) -> float:
        """Mass of the body: what is not axles and wheels."""
        return self.total_mass_kg - sum(self.unsprung_mass_kg)

    @property
    def cg_to_rear_axle_m(self) -> float:
        """Distance d_2 of the body's centre of gravity from the rear axle."""
        return self.wheelbase_m - self.front_axle_to_cg_m

    @model_validator(mode="before")
    @classmethod
    def _axles_in_pairs(cls, table: Any) -> Any:
        return in_pairs(table)

    @model_validator(mode="after")
    def _fits_together(self) -> "Vehicle":
        if self.front_axle_to_cg_m >= self.wheelbase_m:
            raise at(
                "front_axle_to_cg_m",
                f"is {self.front_axle_to_cg_m}, it must be a length less than wheelbase_m, "
                f"{self.wheelbase_m} m",
            )
        if self.sprung_mass_kg <= 0:
            raise at(
                "unsprung_mass_kg",
                f"adds up to {sum(self.unsprung_mass_kg)}, it must be a mass less than "
                f"total_mass_kg, {self.total_mass_kg} kg",
            )
        if self.sensors:
            check_sensors(self.sensors, self.wheelbase_m)
        check_vehicle(self)
        return self
