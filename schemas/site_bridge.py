"""`[bridge]` of a site file: a bridge of one or more spans with prior knowledge about it."""

import math
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Annotated, ClassVar, Final, Literal

from pydantic import BeforeValidator, Field, Strict, StringConstraints, model_validator

from schemas.site_damping import Damping, with_coefficients
from schemas.site_errors import error_at
from schemas.site_lane import Lane
from schemas.site_numbers import NotNegative, Number, Positive, Spread
from schemas.site_physics import G_M_PER_S2, check
from schemas.site_vehicle import WithSpreads
from schemas.wgs84 import ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS_M

MAX_ELEMENTS: Final = 30
MAX_SPAN_DISAGREEMENT: Final = 0.2
"""Largest relative difference between `span_m` and the distance of the ends. More is a typing
error; less is accepted because ends from a hand-held receiver are metres off."""

_SMALLEST_SLIP: Final = 1e-3
"""Tolerance of the sum of rounded element lengths, relative to the span."""

_BEARING_COMPLIANCE_M_PER_N: Final = 1e-9
_MASS_PER_LENGTH_KG_PER_M: Final = (0.01, 1e6)
_WAVE_SPEED_M_PER_S: Final = 6000.0
"""Largest wave speed of bridge materials: 5100 in steel, 4000 in concrete."""
_GYRATION: Final = 0.25
"""Largest radius of gyration relative to the span: a truss half as deep as it is long."""
_SAG: Final = 0.1
"""Largest deflection under self-weight relative to the span; 1/100 and less in real bridges."""
_SHORTEST_PART: Final = 1e-3
"""Smallest length of an element or a span relative to the whole bridge."""
_SUPPORT_SPRING: Final = (1e-6, 1e6)
"""Bounds of a rotational restraint relative to EI / span."""
_SMALLEST_COMPLIANCE_M_PER_N: Final = 1e-15
_LIGHTEST_DECK_KG_PER_M, _SHORTEST_BRIDGE_M = 100.0, 5.0
"""Mass per length below which a deck is a laboratory model, and the largest length of such a
model."""
_USUAL_DAMPING: Final = (0.002, 0.15)

Latitude = Annotated[Number, Field(ge=-89, le=89)]
Altitude = Annotated[Number, Field(ge=-500, le=9000)]
Longitude = Annotated[Number, Field(ge=-180, le=180)]
Text = Annotated[str, StringConstraints(min_length=1, max_length=1000)]
Bearing = Literal["unknown", "free", "sprung"]


def _per_end(value: object) -> object:
    """Expand one value for both ends to a pair."""
    return [value] * 2 if value in ("unknown", "free", "sprung") else value


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
    bearings: Annotated[
        tuple[Bearing, Bearing],
        BeforeValidator(_per_end, json_schema_input_type=tuple[Bearing, Bearing] | Bearing),
    ] = ("unknown", "unknown")
    """Rotational restraint at start and end: none, a spring, or unknown (estimated)."""
    start_altitude_m: Altitude | None = None
    end_altitude_m: Altitude | None = None
    owner_id: Text | None = None
    """Name of the bridge in its owner's records."""
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
        assert self.flexural_rigidity_nm2 is not None  # noqa: S101 - the validator requires one
        return (self.flexural_rigidity_nm2,) * self.elements

    def nominal(self, key: str) -> tuple[float, ...]:
        """Return the nominal values of a quantity; compliance and restraint of bearings are 0."""
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
        """Distance between the ends by their coordinates, to 0.1 %."""
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
                "is missing, give the undamaged bridge's flexural rigidity in N·m² "
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
        _check_physics(self)
        return self

    def _ends_meant(self) -> str:
        """Return a hint at the probable slip in the ends' coordinates; empty if none is likely."""
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


def _check_physics(bridge: Bridge) -> None:
    """Raise an error for the first key whose value no bridge can have."""
    check("span_m", bridge.span_m, (0.1, 1000.0), "a length", "m")
    mass = bridge.mass_per_length_kg_per_m
    key = "mass_per_length_kg_per_m"
    check(key, mass, _MASS_PER_LENGTH_KG_PER_M, "a mass per length", "kg/m")
    shortest = _SHORTEST_PART * bridge.span_m
    for k, length in enumerate(bridge.element_lengths_m or ()):
        check(f"element_lengths_m.{k}", length, (shortest, bridge.span_m), "a length", "m")
    for k, support in enumerate(bridge.interior_supports_m):
        before = (0.0, *bridge.interior_supports_m)[k]
        limits = (before + shortest, bridge.span_m - shortest)
        check(f"interior_supports_m.{k}", support, limits, "a chainage", "m")
    span = max(bridge.lengths_of_spans_m)
    limits = _rigidities(span, mass)
    low_hz, high_hz = (_first_hz(span, mass, rigidity) for rigidity in limits)
    because = f"{span:g} m of {mass:g} kg/m vibrate at {low_hz:.2g} to {high_hz:.3g} Hz"
    if mass < _LIGHTEST_DECK_KG_PER_M and span > _SHORTEST_BRIDGE_M:
        because += f"; or is mass_per_length_kg_per_m in t/m? then it is {1e3 * mass:g}"
    single = "flexural_rigidity_nm2"
    if bridge.flexural_rigidity_nm2 is not None:
        value = bridge.flexural_rigidity_nm2
        check(single, value, limits, "a flexural rigidity", "N·m²", because)
    for k, value in enumerate(bridge.flexural_rigidity_per_element_nm2 or ()):
        key = f"flexural_rigidity_per_element_nm2.{k}"
        check(key, value, limits, "a flexural rigidity", "N·m²", because)
    nominal = bridge.nominal_flexural_rigidity_nm2
    mean = math.exp(math.fsum(map(math.log, nominal)) / len(nominal))
    first_hz = _first_hz(span, mass, mean)
    omega = 2.0 * math.pi * first_hz
    because = f"beyond it the first mode, {first_hz:.2g} Hz, does not vibrate"
    because += _damping_meant(bridge.rayleigh_alpha_per_s, bridge.rayleigh_beta_s, omega)
    for key, value, most, noun, unit in (
        ("rayleigh_alpha_per_s", bridge.rayleigh_alpha_per_s, 2.0 * omega, "a coefficient", "1/s"),
        ("rayleigh_beta_s", bridge.rayleigh_beta_s, 2.0 / omega, "a time", "s"),
    ):
        check(key, value, (0.0, most), noun, unit, because)
    if bridge.support_rotational_stiffness_spread_nm_per_rad is not None:
        key = "support_rotational_stiffness_spread_nm_per_rad"
        low, high = (share * mean / span for share in _SUPPORT_SPRING)
        check(key, getattr(bridge, key), (low, high), "a rotational stiffness", "N·m/rad")
    key = "support_compliance_spread_m_per_n"
    check(key, getattr(bridge, key), (_SMALLEST_COMPLIANCE_M_PER_N, 1e-6), "a compliance", "m/N")


def _damping_meant(alpha: float, beta: float, omega: float) -> str:
    """Return a hint at the probable slip in a damping coefficient; empty if none is likely."""
    swapped = 0.5 * (beta / omega + alpha * omega)
    if alpha and _USUAL_DAMPING[0] <= swapped <= _USUAL_DAMPING[1]:
        return "; swapped with the other coefficient?"
    if beta < 0.2:
        return f"; a damping ratio? then it is {2.0 * beta / omega:.3g} s"
    if beta <= 20.0:
        return f"; a damping ratio in %? then it is {0.02 * beta / omega:.3g} s"
    return ""


def _first_hz(span_m: float, mass_kg_per_m: float, rigidity_nm2: float) -> float:
    """Return the first natural frequency of a simply supported beam."""
    return math.pi / (2.0 * span_m**2) * math.sqrt(rigidity_nm2 / mass_kg_per_m)


def _rigidities(span_m: float, mass_kg_per_m: float) -> tuple[float, float]:
    """Return the EI at which a beam sags by a tenth of its span, and EI of the stiffest section."""
    least = 5.0 * mass_kg_per_m * G_M_PER_S2 * span_m**3 / (384.0 * _SAG)
    return least, mass_kg_per_m * (_WAVE_SPEED_M_PER_S * _GYRATION * span_m) ** 2
