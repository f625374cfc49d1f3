"""The site file: which trucks drive over which bridges, and what is known of them before.

Field names are the keys of the TOML file (docs/contract.md). Pairs are [front, rear]. A `…_spread`
is a relative standard deviation of a log-normal prior, unless its name carries a unit.
"""

import math
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Annotated, Final, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    StrictBool,
    StringConstraints,
    model_validator,
)

from schemas.signals import MAX_RATE_HZ
from schemas.site_errors import at
from schemas.site_physics import check_bridge, check_receiver, check_sensor, check_vehicle
from schemas.site_ros2 import Ros2, check_ros2
from schemas.topics import IDENTIFIER
from schemas.wgs84 import ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS_M

MAX_ELEMENTS: Final = 30
MAX_TABLES: Final = 20_000
"""Vehicles or bridges of a site file."""
MAX_SPAN_DISAGREEMENT: Final = 0.2
"""Beyond this relative difference between `span_m` and the distance of the ends one of them is a
slip of the pen. Ends read off a hand-held receiver are metres off, so less is not refused."""

_SMALLEST_SLIP: Final = 1e-3
"""Lengths of elements are rounded: they may miss the span by this share of it."""

_TYRE_DAMPING_NS_PER_M: Final = 1000.0
_BEARING_COMPLIANCE_M_PER_N: Final = 1e-9

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0, le=1e15)]
NotNegative = Annotated[Number, Field(ge=0, le=1e15)]
PositivePair = tuple[Positive, Positive]
NotNegativePair = tuple[NotNegative, NotNegative]
Spread = Annotated[Number, Field(ge=0, le=3)]
Latitude = Annotated[Number, Field(ge=-89, le=89)]
Altitude = Annotated[Number, Field(ge=-500, le=9000)]
Longitude = Annotated[Number, Field(ge=-180, le=180)]
Identifier = Annotated[str, StringConstraints(pattern=f"^{IDENTIFIER}$")]
Text = Annotated[str, StringConstraints(min_length=1, max_length=1000)]
Sign = Annotated[Literal[1, -1], BeforeValidator(lambda v: int(v) if v in (1.0, -1.0) else v)]


def _four(value: object) -> object:
    """Spell one value for all channels out as four."""
    return [value] * 4 if isinstance(value, int | float) and not isinstance(value, bool) else value


Bearing = Literal["unknown", "free", "sprung"]


def _both_ends(value: object) -> object:
    """Spell what is true of both ends out as a pair."""
    return [value] * 2 if value in ("unknown", "free", "sprung") else value


Rate = Annotated[Number, Field(ge=1, le=MAX_RATE_HZ)]
Density = Annotated[Number, Field(ge=0, le=1e6)]
Rates = Annotated[tuple[Rate, Rate, Rate, Rate], BeforeValidator(_four)]
Densities = Annotated[tuple[Density, Density, Density, Density], BeforeValidator(_four)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Spreadable(_Table):
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


class Vehicle(_Spreadable):
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
    track_m: Annotated[Number, Field(gt=0, le=5)] | None = None
    """Between the middles of the wheels of both sides."""
    rear_axle_offset_m: Annotated[Number, Field(ge=-1, le=1)] | None = None
    """How far the rear axle runs to the left of the front axle."""

    total_mass_kg_spread: Spread = 0.01
    wheelbase_m_spread: Spread = 0.002
    front_axle_to_cg_m_spread: Spread = 0.15
    suspension_damping_ns_per_m_spread: Spread = 0.15
    suspension_stiffness_n_per_m_spread: Spread = 0.15
    unsprung_mass_kg_spread: Spread = 0.15
    tyre_stiffness_n_per_m_spread: Spread = 0.15
    cg_height_m_spread: Spread = 0.15
    pitch_inertia_ratio_spread: Spread = 0.15
    tyre_damping_ns_per_m_spread: Spread = 0.15

    @property
    def tyre_damping_ns_per_m_scale_at_zero(self) -> float:
        """Scale of the half-normal prior of the damping of a tyre of which nothing is known."""
        return _TYRE_DAMPING_NS_PER_M

    @property
    def sprung_mass_kg(self) -> float:
        """Mass of the body: what is not axles and wheels."""
        return self.total_mass_kg - sum(self.unsprung_mass_kg)

    @property
    def cg_to_rear_axle_m(self) -> float:
        """Distance d_2 of the body's centre of gravity from the rear axle."""
        return self.wheelbase_m - self.front_axle_to_cg_m

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
        check_vehicle(self)
        return self


class Bridge(_Spreadable):
    """One or more spans. Its ends are where the bearings are; elements are numbered from its start.

    Over interior supports the bridge is continuous: their deflection is held and they turn freely.

    `flexural_rigidity_nm2` is the nominal (sound) value of every element;
    `flexural_rigidity_per_element_nm2` takes its place where elements are not alike. If both are
    given the values by element are the nominal ones and the single value is not used.
    """

    span_m: Annotated[Number, Field(gt=0, le=1000)]
    start_latitude_deg: Latitude
    start_longitude_deg: Longitude
    end_latitude_deg: Latitude
    end_longitude_deg: Longitude
    elements: Annotated[int, Strict(), Field(ge=1, le=MAX_ELEMENTS)]
    flexural_rigidity_nm2: Positive | None = None
    mass_per_length_kg_per_m: Positive
    rayleigh_alpha_per_s: NotNegative
    rayleigh_beta_s: NotNegative
    flexural_rigidity_per_element_nm2: tuple[Positive, ...] | None = None
    element_lengths_m: tuple[Positive, ...] | None = None
    support_rotational_stiffness_spread_nm_per_rad: Positive | None = None
    support_compliance_spread_m_per_n: Annotated[Number, Field(gt=0, le=1e-6)] = (
        _BEARING_COMPLIANCE_M_PER_N
    )
    """Scale of the half-normal prior of the vertical compliance of the bearings at the ends."""
    interior_supports_m: tuple[Positive, ...] = ()
    """Chainages of the supports between the ends, ascending."""
    bearings: Annotated[tuple[Bearing, Bearing], BeforeValidator(_both_ends)] = (
        "unknown",
        "unknown",
    )
    """Whether start and end turn freely or against a spring; unknown: the data decide."""
    start_altitude_m: Altitude | None = None
    end_altitude_m: Altitude | None = None
    owner_id: Text | None = None
    """The owner's name of the bridge."""
    road_class: Literal["A", "B", "C", "D", "E"] | None = None
    """ISO 8608."""
    survey_speed_m_per_s: Annotated[Number, Field(gt=0, le=100)] | None = None
    baseline: Text | None = None
    """Path of a results file, relative to the site file."""

    flexural_rigidity_nm2_spread: Spread = 0.55
    """Standard deviation of ln EI: 95 % within a factor of 3."""
    mass_per_length_kg_per_m_spread: Spread = 0.1
    rayleigh_alpha_per_s_spread: Spread = 0.5
    rayleigh_beta_s_spread: Spread = 0.5

    @property
    def nominal_flexural_rigidity_nm2(self) -> tuple[float, ...]:
        """EI of each element before the crossing."""
        if self.flexural_rigidity_per_element_nm2 is not None:
            return self.flexural_rigidity_per_element_nm2
        assert self.flexural_rigidity_nm2 is not None  # noqa: S101 - the validator saw to it
        return (self.flexural_rigidity_nm2,) * self.elements

    def nominal(self, key: str) -> tuple[float, ...]:
        """Return what is known of a quantity before: of bearings, that nothing need be there."""
        if key == "flexural_rigidity_nm2":
            return self.nominal_flexural_rigidity_nm2
        if key in ("support_rotational_stiffness_nm_per_rad", "support_compliance_m_per_n"):
            return (0.0, 0.0)
        return super().nominal(key)

    @property
    def lengths_m(self) -> tuple[float, ...]:
        """Length of each element; they add up to the span. One ends at every support."""
        if self.element_lengths_m is not None:
            return self.element_lengths_m
        shares = _shared(self.elements, self.lengths_of_spans_m)
        return tuple(
            length / share
            for length, share in zip(self.lengths_of_spans_m, shares, strict=True)
            for _ in range(share)
        )

    @property
    def lengths_of_spans_m(self) -> tuple[float, ...]:
        """Distances between neighbouring supports, from the start."""
        supports = (0.0, *self.interior_supports_m, self.span_m)
        return tuple(after - before for before, after in pairwise(supports))

    @property
    def interior_support_nodes(self) -> tuple[int, ...]:
        """After how many elements each interior support stands."""
        ends = tuple(accumulate(self.lengths_m))
        return tuple(
            1 + min(range(len(ends)), key=lambda e: abs(ends[e] - support))
            for support in self.interior_supports_m
        )

    @property
    def support_rotational_stiffness_nm_per_rad_scale_at_zero(self) -> float:
        """Scale of the half-normal prior of the supports' rotational stiffness."""
        if self.support_rotational_stiffness_spread_nm_per_rad is not None:
            return self.support_rotational_stiffness_spread_nm_per_rad
        mean_span_m = self.span_m / len(self.lengths_of_spans_m)
        return sum(self.nominal_flexural_rigidity_nm2) / self.elements / mean_span_m

    @property
    def support_compliance_m_per_n_scale_at_zero(self) -> float:
        """Scale of the half-normal prior of the bearings' vertical compliance."""
        return self.support_compliance_spread_m_per_n

    @property
    def ends_distance_m(self) -> float:
        """Distance of the ends by their coordinates, to 0.1 %."""
        return _distance_m(
            self.start_latitude_deg,
            self.start_longitude_deg,
            self.end_latitude_deg,
            self.end_longitude_deg,
        )

    @model_validator(mode="after")
    def _fits_together(self) -> "Bridge":
        self._supports_fit()
        per_element = self.flexural_rigidity_per_element_nm2
        if per_element is None and self.flexural_rigidity_nm2 is None:
            raise at(
                "flexural_rigidity_nm2",
                "is missing, give the sound bridge's flexural rigidity in N·m² "
                "(or flexural_rigidity_per_element_nm2)",
            )
        for key, values in (
            ("flexural_rigidity_per_element_nm2", per_element),
            ("element_lengths_m", self.element_lengths_m),
        ):
            if values is not None and len(values) != self.elements:
                raise at(
                    key,
                    f"has {len(values)} values, it must have one for each of the "
                    f"{self.elements} elements",
                )
        if self.element_lengths_m is not None:
            total = math.fsum(self.element_lengths_m)
            if not math.isclose(total, self.span_m, rel_tol=_SMALLEST_SLIP):
                raise at(
                    "element_lengths_m",
                    f"adds up to {total:g} m, it must add up to span_m, {self.span_m:g} m",
                )
            for support, node in zip(
                self.interior_supports_m, self.interior_support_nodes, strict=True
            ):
                end = math.fsum(self.element_lengths_m[:node])
                if abs(end - support) > _SMALLEST_SLIP * self.span_m:
                    raise at(
                        "element_lengths_m",
                        f"has no element that ends at {support:g} m, one must end at every "
                        f"interior support; the nearest ends at {end:g} m",
                    )
        distance = self.ends_distance_m
        if distance < 0.01:
            raise at(
                "end_latitude_deg",
                "and end_longitude_deg are the start's, the two ends must be different places",
            )
        if abs(self.span_m / distance - 1) > MAX_SPAN_DISAGREEMENT:
            raise at(
                "span_m",
                f"is {self.span_m:g} but the ends are {distance:.1f} m apart, "
                "the span and the coordinates of the bearings must agree",
            )
        check_bridge(self)
        return self

    def _supports_fit(self) -> None:
        """Raise if interior supports are not between the ends, ascending, an element apart."""
        supports = (0.0, *self.interior_supports_m, self.span_m)
        for number, (before, after) in enumerate(pairwise(supports)):
            if after <= before and number < len(self.interior_supports_m):
                raise at(
                    f"interior_supports_m.{number}",
                    f"is {after:g}, it must be a chainage beyond {before:g} m: supports between "
                    "the ends are given from the start on",
                )
            if after <= before:
                raise at(
                    f"interior_supports_m.{number - 1}",
                    f"is {before:g}, it must be a chainage between 0 and span_m, {self.span_m:g} m",
                )
        if self.elements < len(self.lengths_of_spans_m):
            raise at(
                "elements",
                f"is {self.elements}, it must be at least {len(self.lengths_of_spans_m)}, "
                "one for each span",
            )


def _shared(count: int, lengths: Sequence[float]) -> list[int]:
    """Share so many elements among spans by length: largest remainder first, at least one each."""
    total = math.fsum(lengths)
    wanted = [count * length / total for length in lengths]
    shares = [max(1, math.floor(quota)) for quota in wanted]
    while sum(shares) < count:
        shares[max(range(len(shares)), key=lambda k: wanted[k] - shares[k])] += 1
    while sum(shares) > count:  # short spans were given an element each
        longer = [k for k, share in enumerate(shares) if share > 1]
        shares[min(longer, key=lambda k: wanted[k] - shares[k])] -= 1
    return shares


class Sensor(_Table):
    """The accelerometers, in the order sprung front, sprung rear, unsprung front, unsprung rear."""

    rate_hz: Rates
    noise_density_ug_per_rthz: Densities
    """One-sided; 0 for a simulation without noise."""
    gravity_included: StrictBool = False
    up: tuple[Sign, Sign, Sign, Sign] = (1, 1, 1, 1)
    gain_spread: Spread = 0.01
    """Between channels."""
    delay_spread_s: Annotated[Number, Field(ge=0, le=1)] = 0.0005
    common_gain_spread: Spread = 0.01

    _is_possible = model_validator(mode="after")(check_sensor)


class Receiver(_Table):
    """The satellite receiver."""

    position_spread_m: NotNegative = 1.5
    """The spread of the slow error, which is the same during a crossing."""
    position_noise_m: NotNegative = 0.4
    speed_noise_m_per_s: NotNegative = 0.07
    latency_s: Annotated[Number, Field(ge=-10, le=10)] = 0.0
    latency_spread_s: Annotated[Number, Field(ge=0, le=10)] = 0.1

    _is_possible = model_validator(mode="after")(check_receiver)


class Site(_Table):
    """Everything in a site file."""

    vehicles: Annotated[tuple[Vehicle, ...], Field(alias="vehicle", min_length=1)]
    bridges: Annotated[tuple[Bridge, ...], Field(alias="bridge", min_length=1)]
    sensor: Sensor
    receiver: Receiver = Receiver()
    ros2: tuple[Ros2, ...] = ()
    """Where messages of trucks with ROS 2 come from; says nothing of what they measure."""

    def vehicle(self, identifier: str) -> Vehicle:
        """Return the vehicle of that id; KeyError if the site has none."""
        return {v.id: v for v in self.vehicles}[identifier]

    def bridge(self, identifier: str) -> Bridge:
        """Return the bridge of that id; KeyError if the site has none."""
        return {b.id: b for b in self.bridges}[identifier]

    @model_validator(mode="after")
    def _identifiers_are_unique(self) -> "Site":
        lists: dict[str, tuple[_Spreadable, ...]] = {
            "vehicle": self.vehicles,
            "bridge": self.bridges,
        }
        for name, tables in lists.items():
            seen: set[str] = set()
            for index, table in enumerate(tables):
                if table.id in seen:
                    raise at(f"{name}.{index}.id", f'is "{table.id}" again, ids must be unique')
                seen.add(table.id)
        check_ros2(self.ros2, {vehicle.id for vehicle in self.vehicles})
        return self


def _distance_m(
    latitude_1: float, longitude_1: float, latitude_2: float, longitude_2: float
) -> float:
    """Distance on the WGS 84 ellipsoid of places less than a few km apart."""
    a, e2 = SEMI_MAJOR_AXIS_M, ECCENTRICITY_SQUARED
    middle = math.radians((latitude_1 + latitude_2) / 2)
    w = 1 - e2 * math.sin(middle) ** 2
    north = math.radians(latitude_2 - latitude_1) * a * (1 - e2) / w**1.5
    east = math.remainder(longitude_2 - longitude_1, 360)
    return math.hypot(north, math.radians(east) * a * math.cos(middle) / math.sqrt(w))
