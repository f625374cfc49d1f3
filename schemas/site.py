"""The site file: trucks and bridges, with the prior knowledge of them.

Field names are the keys of the TOML file (docs/contract.md). Pairs are [front, rear]. A `…_spread`
is a relative standard deviation of a log-normal prior, unless its name carries a unit.
"""

import math
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Annotated, ClassVar, Final, Literal

from pydantic import (
    BeforeValidator,
    Field,
    Strict,
    StrictBool,
    StringConstraints,
    model_validator,
)

from schemas.site_damping import Damping, with_coefficients
from schemas.site_errors import error_at
from schemas.site_import import Import
from schemas.site_lane import Lane
from schemas.site_numbers import Density, NotNegative, Number, Positive, Rate, Spread, Table
from schemas.site_physics import check_bridge, check_receiver, check_sensor
from schemas.site_ros2 import Ros2, check_ros2
from schemas.site_vehicle import Vehicle as Vehicle
from schemas.site_vehicle import WithSpreads
from schemas.wgs84 import ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS_M

MAX_ELEMENTS: Final = 30
MAX_TABLES: Final = 20_000
"""Largest number of vehicles or bridges in a site file."""
MAX_SPAN_DISAGREEMENT: Final = 0.2
"""Largest relative difference between `span_m` and the distance of the ends. More is a typing
error; less is accepted because ends from a hand-held receiver are metres off."""

_SMALLEST_SLIP: Final = 1e-3
"""Tolerance of the sum of rounded element lengths, relative to the span."""

_BEARING_COMPLIANCE_M_PER_N: Final = 1e-9

Latitude = Annotated[Number, Field(ge=-89, le=89)]
Altitude = Annotated[Number, Field(ge=-500, le=9000)]
Longitude = Annotated[Number, Field(ge=-180, le=180)]
Text = Annotated[str, StringConstraints(min_length=1, max_length=1000)]
Sign = Annotated[Literal[1, -1], BeforeValidator(lambda v: int(v) if v in (1.0, -1.0) else v)]


def _per_channel(value: object) -> object:
    """Expand one value for all channels to four."""
    return [value] * 4 if isinstance(value, int | float) and not isinstance(value, bool) else value


Bearing = Literal["unknown", "free", "sprung"]


def _per_end(value: object) -> object:
    """Expand one value for both ends to a pair."""
    return [value] * 2 if value in ("unknown", "free", "sprung") else value


Rates = Annotated[tuple[Rate, Rate, Rate, Rate], BeforeValidator(_per_channel)]
Densities = Annotated[tuple[Density, Density, Density, Density], BeforeValidator(_per_channel)]


class Bridge(Lane, Damping, WithSpreads):
    """A bridge of one or more spans. Its ends are at the bearings; elements count from its start.

    Over interior supports the beam is continuous: no deflection, free rotation.

    `flexural_rigidity_nm2` is the nominal (undamaged) value of every element.
    `flexural_rigidity_per_element_nm2` replaces it where elements differ. If both are given, the
    values by element are the nominal ones and the single value is not used.
    """

    later_keys: ClassVar[tuple[str, ...]] = (*Lane.model_fields, *Damping.model_fields)

    _damping = model_validator(mode="before")(with_coefficients)

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
    """Scale of the half-normal prior of the vertical compliance of the end bearings."""
    interior_supports_m: tuple[Positive, ...] = ()
    """Chainages of the supports between the ends, ascending."""
    bearings: Annotated[tuple[Bearing, Bearing], BeforeValidator(_per_end)] = (
        "unknown",
        "unknown",
    )
    """Rotational restraint at start and end: none, a spring, or unknown (estimated)."""
    start_altitude_m: Altitude | None = None
    end_altitude_m: Altitude | None = None
    owner_id: Text | None = None
    """The owner's name of the bridge."""
    road_class: Literal["A", "B", "C", "D", "E"] | None = None
    """Road class of ISO 8608."""
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
        """Nominal EI of each element."""
        if self.flexural_rigidity_per_element_nm2 is not None:
            return self.flexural_rigidity_per_element_nm2
        assert self.flexural_rigidity_nm2 is not None  # noqa: S101 - the validator saw to it
        return (self.flexural_rigidity_nm2,) * self.elements

    def nominal(self, key: str) -> tuple[float, ...]:
        """Return the nominal values of a quantity: 0 for compliance and restraint of bearings."""
        if key == "flexural_rigidity_nm2":
            return self.nominal_flexural_rigidity_nm2
        if key in ("support_rotational_stiffness_nm_per_rad", "support_compliance_m_per_n"):
            return (0.0, 0.0)
        return super().nominal(key)

    def uniform(self) -> tuple[float, float, float]:
        """Return the longest span in m, mean nominal EI in N·m² and mass per length in kg/m."""
        mean = sum(self.nominal_flexural_rigidity_nm2) / self.elements
        return max(self.lengths_of_spans_m), mean, self.mass_per_length_kg_per_m

    @property
    def lengths_m(self) -> tuple[float, ...]:
        """Length of each element; an element ends at every support."""
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
        """Number of elements before each interior support."""
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
            raise error_at(
                "flexural_rigidity_nm2",
                "is missing, give the sound bridge's flexural rigidity in N·m² "
                "(or flexural_rigidity_per_element_nm2)",
            )
        for key, values in (
            ("flexural_rigidity_per_element_nm2", per_element),
            ("element_lengths_m", self.element_lengths_m),
        ):
            if values is not None and len(values) != self.elements:
                raise error_at(
                    key,
                    f"has {len(values)} values, it must have one for each of the "
                    f"{self.elements} elements",
                )
        if self.element_lengths_m is not None:
            total = math.fsum(self.element_lengths_m)
            if not math.isclose(total, self.span_m, rel_tol=_SMALLEST_SLIP):
                raise error_at(
                    "element_lengths_m",
                    f"adds up to {total:g} m, it must add up to span_m, {self.span_m:g} m",
                )
            for support, node in zip(
                self.interior_supports_m, self.interior_support_nodes, strict=True
            ):
                end = math.fsum(self.element_lengths_m[:node])
                if abs(end - support) > _SMALLEST_SLIP * self.span_m:
                    raise error_at(
                        "element_lengths_m",
                        f"has no element that ends at {support:g} m, one must end at every "
                        f"interior support; the nearest ends at {end:g} m",
                    )
        distance = self.ends_distance_m
        if distance < 0.01:
            raise error_at(
                "end_latitude_deg",
                "and end_longitude_deg are the start's, the two ends must be different places",
            )
        if abs(self.span_m / distance - 1) > MAX_SPAN_DISAGREEMENT:
            raise error_at(
                "span_m",
                f"is {self.span_m:g} but the ends are {distance:.1f} m apart, "
                "the span and the coordinates of the bearings must agree"
                f"{self._ends_meant()}",
            )
        check_bridge(self)
        return self

    def _ends_meant(self) -> str:
        """Return a hint what the coordinates of the ends may be; empty where it is not known."""
        ends = (
            (self.start_latitude_deg, self.start_longitude_deg),
            (self.end_latitude_deg, self.end_longitude_deg),
        )
        for hint, (start, end) in {
            "latitude and longitude swapped": tuple((b, a) for a, b in ends),
            "in radians": tuple((math.degrees(a), math.degrees(b)) for a, b in ends),
            "the sign of one longitude": (ends[0], (ends[1][0], -ends[1][1])),
        }.items():
            if abs(start[0]) > 89.0 or abs(end[0]) > 89.0:
                continue
            if abs(self.span_m / _distance_m(*start, *end) - 1) <= MAX_SPAN_DISAGREEMENT:
                return f"; {hint}?"
        return ""

    def _supports_fit(self) -> None:
        """Raise if interior supports do not ascend between the ends or a span has no element."""
        supports = (0.0, *self.interior_supports_m, self.span_m)
        for number, (before, after) in enumerate(pairwise(supports)):
            if after <= before and number < len(self.interior_supports_m):
                raise error_at(
                    f"interior_supports_m.{number}",
                    f"is {after:g}, it must be a chainage beyond {before:g} m: supports between "
                    "the ends are given from the start on",
                )
            if after <= before:
                raise error_at(
                    f"interior_supports_m.{number - 1}",
                    f"is {before:g}, it must be a chainage between 0 and span_m, {self.span_m:g} m",
                )
        if self.elements < len(self.lengths_of_spans_m):
            raise error_at(
                "elements",
                f"is {self.elements}, it must be at least {len(self.lengths_of_spans_m)}, "
                "one for each span",
            )


def _shared(count: int, lengths: Sequence[float]) -> list[int]:
    """Distribute elements over spans by length: largest remainder first, at least one each."""
    total = math.fsum(lengths)
    wanted = [count * length / total for length in lengths]
    shares = [max(1, math.floor(quota)) for quota in wanted]
    while sum(shares) < count:
        shares[max(range(len(shares)), key=lambda k: wanted[k] - shares[k])] += 1
    while sum(shares) > count:  # every short span has got an element
        longer = [k for k, share in enumerate(shares) if share > 1]
        shares[min(longer, key=lambda k: wanted[k] - shares[k])] -= 1
    return shares


class Sensor(Table):
    """The accelerometers, in the order sprung front, sprung rear, unsprung front, unsprung rear.

    Densities, and rates where given, of a truck's own `sensors` replace these.
    """

    rate_hz: Rates
    noise_density_ug_per_rthz: Densities = (0.0, 0.0, 0.0, 0.0)
    """One-sided density; 0 for a simulation without noise. Optional only if all trucks have
    `sensors`."""
    gravity_included: StrictBool = False
    up: tuple[Sign, Sign, Sign, Sign] = (1, 1, 1, 1)
    gain_spread: Spread = 0.01
    """Standard deviation between channels."""
    delay_spread_s: Annotated[Number, Field(ge=0, le=1)] = 0.0005
    common_gain_spread: Spread = 0.01

    _is_possible = model_validator(mode="after")(check_sensor)


class Receiver(Table):
    """The GNSS receiver."""

    position_spread_m: NotNegative = 1.5
    """Standard deviation of the slow error, which is constant during a crossing."""
    position_noise_m: NotNegative = 0.4
    speed_noise_m_per_s: NotNegative = 0.07
    latency_s: Annotated[Number, Field(ge=-10, le=10)] = 0.0
    latency_spread_s: Annotated[Number, Field(ge=0, le=10)] = 0.1

    _is_possible = model_validator(mode="after")(check_receiver)


class Site(Table):
    """The content of a site file."""

    vehicles: Annotated[tuple[Vehicle, ...], Field(alias="vehicle", min_length=1)]
    bridges: Annotated[tuple[Bridge, ...], Field(alias="bridge", min_length=1)]
    sensor: Sensor
    receiver: Receiver = Receiver()
    ros2: tuple[Ros2, ...] = ()
    """Sources of the messages of trucks with ROS 2, independent of their measurements."""
    imports: Annotated[Import | None, Field(alias="import")] = None
    """The realm of imported drives."""

    def vehicle(self, identifier: str) -> Vehicle:
        """Return the vehicle of that id; raise KeyError if the site has none."""
        return {v.id: v for v in self.vehicles}[identifier]

    def bridge(self, identifier: str) -> Bridge:
        """Return the bridge of that id; raise KeyError if the site has none."""
        return {b.id: b for b in self.bridges}[identifier]

    @model_validator(mode="after")
    def _identifiers_are_unique(self) -> "Site":
        lists: dict[str, tuple[WithSpreads, ...]] = {
            "vehicle": self.vehicles,
            "bridge": self.bridges,
        }
        for name, tables in lists.items():
            seen: set[str] = set()
            for index, table in enumerate(tables):
                if table.id in seen:
                    raise error_at(
                        f"{name}.{index}.id", f'is "{table.id}" again, ids must be unique'
                    )
                seen.add(table.id)
        check_ros2(self.ros2, {vehicle.id: vehicle.channels for vehicle in self.vehicles})
        return self

    @model_validator(mode="after")
    def _sensors_are_described(self) -> "Site":
        """Raise if [sensor] and the sensors of a vehicle leave a value undefined."""
        sensor = self.sensor
        by_place = [vehicle for vehicle in self.vehicles if vehicle.sensors]
        if len(by_place) < len(self.vehicles):
            if "noise_density_ug_per_rthz" not in sensor.model_fields_set:
                raise error_at(
                    "sensor.noise_density_ug_per_rthz",
                    "is missing, it must be a noise density in µg/√Hz",
                )
        elif sensor.up != (1, 1, 1, 1):
            raise error_at(
                "sensor.up", "is of the four channels, the vehicle's sensors must point up"
            )
        for number, vehicle in enumerate(self.vehicles):
            for place, one in enumerate(vehicle.sensors):
                if one.rate_hz is None and len(set(sensor.rate_hz)) > 1:
                    raise error_at(
                        f"vehicle.{number}.sensors.{place}.rate_hz",
                        "is missing, it must be a rate in Hz: sensor.rate_hz has several",
                    )
        return self


def _distance_m(
    latitude_1: float, longitude_1: float, latitude_2: float, longitude_2: float
) -> float:
    """Return the distance on the WGS 84 ellipsoid of places less than a few km apart."""
    a, e2 = SEMI_MAJOR_AXIS_M, ECCENTRICITY_SQUARED
    middle = math.radians((latitude_1 + latitude_2) / 2)
    w = 1 - e2 * math.sin(middle) ** 2
    north = math.radians(latitude_2 - latitude_1) * a * (1 - e2) / w**1.5
    east = math.remainder(longitude_2 - longitude_1, 360)
    return math.hypot(north, math.radians(east) * a * math.cos(middle) / math.sqrt(w))
