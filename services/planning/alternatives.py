"""Alternatives at a site: other tyres, loads, lanes, speeds, sensors, elements.

Each alternative is the plan with one change, so that its gain can be compared with the plan.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

from schemas.site import Bridge, Site, Vehicle
from schemas.site_axle_tables import TYRES
from schemas.site_vehicle import axle_loads_kg
from services.common.truck_choice import allows_tandem
from services.identification.checks import loads_are_alike
from services.planning.crossings import PlannedCrossing, axles_of
from services.simulation.usual_trucks import usual_lorry, usual_tandem

SPREAD: Final = 0.15
"""Relative deviation of a survey's speeds from the planned one, to either side."""
_LIGHTER, _HEAVIER = 0.4, 1.5
"""Loads of an emptied and of a loaded truck, relative to the planned load on its springs."""
_LEAST_HEAVIER = 1.1
"""Least relative load of a loaded truck that is worth a row."""
_LEGAL_TOTAL_KG: Final = {2: 18_000.0, 3: 26_000.0, 4: 32_000.0}
"""Largest total mass in international traffic by number of axles (Directive 96/53/EC, Annex I)."""
_LEGAL_AXLE_KG: Final = 11_500.0
"""Largest load of a driving axle there."""
_QUIETER: Final = 0.25
_ELEMENTS: Final = (5, 3)
_MOVED: Final = 0.12
"""Shift of the load to the heavier axle, relative to the wheelbase, where both are alike."""

_UNEQUAL: Final = ("tyre_contact_length_m", "track_m")
"""Pairs of a site file that equal single tyres have in common, besides the width."""
EQUAL_TYRES: Final = "equal single tyres on both axles"
TANDEM: Final = "a truck with an equalised tandem"
_OTHER_WAY = "half of the runs the other way"
_MOVED_LOAD = "load moved to the heavier axle"
_QUIET_SENSORS = "sensors of a quarter of the noise"
_TWO_AXLES = "a lorry of two axles"
_LABELS: Final = {
    _OTHER_WAY: "half in the other direction",
    _QUIET_SENSORS: "sensors with 1/4 of the noise",
    f"{_TWO_AXLES}, twin tyres behind": "a two-axle truck, twin rear tyres",
    f"{_TWO_AXLES}, equal single tyres": "a two-axle truck, equal single tyres",
}
"""Names as printed; JSON keeps those of the first version."""


class Plan(NamedTuple):
    """Crossings in equal numbers; those of one tuple are one wheel-path group."""

    name: str
    tracks: tuple[tuple[PlannedCrossing, ...], ...]

    @property
    def label(self) -> str:
        """Name as printed: JSON keeps that of the first version."""
        return _LABELS.get(self.name, self.name)

    @property
    def cost(self) -> int:
        """Rank of its cost: 0 for the same truck driven otherwise, 1 for another, 2 for sensors.

        Other tyres count as another truck, which can be hired. Sensors are bought and mounted.
        """
        if self.name == _MOVED_LOAD or self.fewest_crossings > 1:
            return 0
        return 2 if self.name == _QUIET_SENSORS else 1

    @property
    def fewest_crossings(self) -> int:
        """Fewest crossings that the plan can have: half of one crossing is none."""
        return 2 if self.name.startswith("half of the runs") else 1

    @property
    def site(self) -> Site:
        """Site with the elements and tyres of the plan."""
        return self.tracks[0][0].site


def as_planned(site: Site, speed_m_per_s: float) -> Plan:
    """Return a plan of one truck in one lane and direction, at speeds about the planned one."""
    return Plan("as planned", (_spread(site, speed_m_per_s),))


def alternatives(site: Site, speed_m_per_s: float) -> Iterator[Plan]:
    """Yield plans with one change each, as far as this site permits."""
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    planned = _spread(site, speed_m_per_s)
    for name, other_truck in _other_trucks(site):
        yield Plan(name, (_spread(other_truck, speed_m_per_s),))
    for factor in (_LIGHTER, *_heavier(vehicle)):
        loaded = _with_vehicle(site, _carrying(vehicle, factor))
        other = loaded.vehicles[0].total_mass_kg / 1e3
        yield Plan(
            f"half of the runs at {other:.1f} t", ((*planned, *_spread(loaded, speed_m_per_s)),)
        )
    if vehicle.tandem is None and loads_are_alike(vehicle):
        yield Plan(
            _MOVED_LOAD,
            (_spread(_with_vehicle(site, _moved(vehicle)), speed_m_per_s),),
        )
    yield Plan(
        _OTHER_WAY,
        (planned, tuple(crossing._replace(forward=False) for crossing in planned)),
    )
    quiet = tuple(_QUIETER * density for density in site.sensor.noise_density_ug_per_rthz)
    yield Plan(_QUIET_SENSORS, (_spread(with_noise(site, quiet), speed_m_per_s),))
    for elements in _ELEMENTS:
        if len(bridge.lengths_of_spans_m) <= elements < bridge.elements:
            coarser = site.model_copy(update={"bridges": (_coarser(bridge, elements),)})
            yield Plan(f"{elements} elements", (_spread(coarser, speed_m_per_s),))


def _other_trucks(site: Site) -> Iterator[tuple[str, Site]]:
    """Yield the same survey with other tyres, and with usual trucks of another kind.

    Trucks with a tandem are simulated on one span of equal elements only.
    """
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    noise = max(site.sensor.noise_density_ug_per_rthz)
    front, rear = axles_of(vehicle)
    is_equal = rear._replace(offset_m=front.offset_m) == front
    if vehicle.tandem is not None:
        if front.twin_distance_m > 0.0:
            yield "single tyres on the tandem", with_tyres(site, "single")
        for name, tyres in (("twin tyres behind", "twin"), ("equal single tyres", "single")):
            yield f"{_TWO_AXLES}, {name}", _with_vehicle(site, usual_lorry(tyres))
        return
    if not is_equal or front.twin_distance_m > 0.0:
        yield EQUAL_TYRES, with_tyres(site, "single")
    if allows_tandem(bridge):
        yield TANDEM, _with_vehicle(site, usual_tandem(noise))


def with_tyres(site: Site, behind: str) -> Site:
    """Return a site with single tyres in front, and equal single ones or twins `behind`.

    Single tyres behind have the front axle's width, contact length and track. Both axles of a
    tandem get the same tyres.
    """
    vehicle = site.vehicles[0]
    if vehicle.tandem is not None:
        of = TYRES[behind]
        changed_axles = tuple(
            axle.model_copy(
                update={
                    "tyres": behind,
                    "tyre_width_m": of.width_m,
                    "twin_tyre_distance_m": of.twin_distance_m,
                }
            )
            for axle in vehicle.tandem.axles
        )
        axles = (*vehicle.axles[:-2], *changed_axles)
        return _with_vehicle(site, vehicle.model_copy(update={"axles": axles}))
    width = (vehicle.tyre_width_m or (0.25, 0.25))[0]
    twin = behind == "twin"
    changed = {
        "twin_tyre_distance_m": (0.0, 0.33 if twin else 0.0),
        "tyre_width_m": (width, 0.22 if twin else width),
    }
    for key in () if twin else _UNEQUAL:
        declared = getattr(vehicle, key)
        if declared is not None:
            changed[key] = (declared[0], declared[0])
    return _with_vehicle(site, vehicle.model_copy(update=changed))


def with_noise(site: Site, densities_ug_per_rthz: tuple[float, ...]) -> Site:
    """Return a site with other sensors, of which a truck with a tandem names its own."""
    changed = {"noise_density_ug_per_rthz": densities_ug_per_rthz}
    vehicle = site.vehicles[0]
    if vehicle.sensors:
        sensors = tuple(
            one.model_copy(update={"noise_density_ug_per_rthz": density})
            for one, density in zip(vehicle.sensors, densities_ug_per_rthz, strict=True)
        )
        site = _with_vehicle(site, vehicle.model_copy(update={"sensors": sensors}))
    return site.model_copy(update={"sensor": site.sensor.model_copy(update=changed)})


def _spread(site: Site, speed_m_per_s: float) -> tuple[PlannedCrossing, ...]:
    return tuple(
        PlannedCrossing(site, round(factor * speed_m_per_s, 2))
        for factor in (1.0 - SPREAD, 1.0 + SPREAD)
    )


def _with_vehicle(site: Site, vehicle: Vehicle) -> Site:
    return site.model_copy(update={"vehicles": (vehicle, *site.vehicles[1:])})


def _carrying(vehicle: Vehicle, factor: float) -> Vehicle:
    """Return the truck with a multiple of the load on its springs, at the same position."""
    total = sum(vehicle.unsprung_mass_kg) + factor * vehicle.sprung_mass_kg
    axles = tuple(
        axle
        if axle.load_kg is None
        else axle.model_copy(
            update={
                "load_kg": axle.unsprung_mass_kg
                + factor * max(axle.load_kg - axle.unsprung_mass_kg, 0.0)
            }
        )
        for axle in vehicle.axles
    )
    return vehicle.model_copy(update={"total_mass_kg": round(total, 1), "axles": axles})


def _heavier(vehicle: Vehicle) -> Iterator[float]:
    """Yield the relative load of a loaded truck within legal limits, unless it is hardly more."""
    legal = _LEGAL_TOTAL_KG[min(max(len(vehicle.axles), 2), max(_LEGAL_TOTAL_KG))]
    factors = [_HEAVIER, (legal - sum(vehicle.unsprung_mass_kg)) / vehicle.sprung_mass_kg]
    if vehicle.tandem is None:
        factors += [
            (_LEGAL_AXLE_KG - unsprung) / (load - unsprung)
            for load, unsprung in zip(axle_loads_kg(vehicle), vehicle.unsprung_mass_kg, strict=True)
        ]
    if min(factors) >= _LEAST_HEAVIER:
        yield min(factors)


def _moved(vehicle: Vehicle) -> Vehicle:
    front, rear = axle_loads_kg(vehicle)
    sign = 1.0 if rear >= front else -1.0
    place = vehicle.front_axle_to_cg_m + sign * _MOVED * vehicle.wheelbase_m
    place = min(max(place, 0.05 * vehicle.wheelbase_m), 0.95 * vehicle.wheelbase_m)
    return vehicle.model_copy(update={"front_axle_to_cg_m": round(place, 3)})


def _coarser(bridge: Bridge, elements: int) -> Bridge:
    """Return the same bridge with fewer elements, alike within each span."""
    rigidity = sum(bridge.nominal_flexural_rigidity_nm2) / bridge.elements
    return bridge.model_copy(
        update={
            "elements": elements,
            "element_lengths_m": None,
            "flexural_rigidity_nm2": rigidity,
            "flexural_rigidity_per_element_nm2": None,
        }
    )
