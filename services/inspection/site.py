"""Checks of a site file alone, for a survey with its truck and sensors."""

from collections.abc import Iterator
from typing import Final

from schemas.site import Bridge, Site, Vehicle
from schemas.site_implied import ImpliedQuantity
from schemas.site_usual import implied_by
from schemas.site_vehicle import axle_loads_kg
from services.finding.placed import densities_ug_per_rthz, rates_hz, sensors_in_words
from services.identification.checks import ALIKE_LOADS
from services.identification.identify import SLOWEST_M_PER_S
from services.inspection.finding import CheckFinding, CheckStatus, check_finding

SLOWEST_RATE_HZ: Final = 100.0
"""Lowest rate in Hz: the residuals need 25 Hz, and slower sensors were never tried."""
_LARGEST_MASS_SPREAD: Final = 0.03
"""Largest relative spread: a weighbridge has 1 %, an estimated load 10 %."""
_AXLE_LOADS_KG: Final = (500.0, 20_000.0)
"""Plausible loads of an axle in kg: less is no truck, more is not permitted on a road."""
_WHEELBASE_M: Final = (1.5, 12.0)


def findings_of_site(site: Site, vehicle: Vehicle) -> Iterator[CheckFinding]:
    """Yield findings on loads, masses, tyres, sampling, and the bridges' coordinates."""
    yield from findings_of_truck(vehicle)
    yield from sensors_of(site, vehicle)
    yield sampling(tuple(rates_hz(site.sensor, vehicle).values()))
    yield noise_declared(site, vehicle)
    for bridge in site.bridges:
        yield from findings_of_bridge(bridge)
    yield from findings_of_implied(site, vehicle)


def findings_of_implied(site: Site, vehicle: Vehicle) -> Iterator[CheckFinding]:
    """Yield frequencies, damping and deflections; open where unusual, wrong where far from that."""
    yield from map(finding_of_implied, implied_by(site, vehicle))


def finding_of_implied(one: ImpliedQuantity) -> CheckFinding:
    """Return the finding on one quantity: open where it is unusual, wrong where far from that."""
    state = (
        CheckStatus.WRONG if one.is_far else CheckStatus.OPEN if one.is_unusual else CheckStatus.OK
    )
    return CheckFinding(one.name, state, one.text, one.advice if one.is_unusual else "")


def findings_of_truck(vehicle: Vehicle) -> Iterator[CheckFinding]:
    """Yield findings on one truck of the site file."""
    front, rear = axle_loads_kg(vehicle)
    name = vehicle.id
    share = abs(front - rear) / (front + rear)
    yield check_finding(
        "axle_loads",
        f"{name}: axles carry {front / 1e3:.2f} and {rear / 1e3:.2f} t "
        f"and differ by {100.0 * share:.0f} % of the total",
        f"load one axle more than the other: below {100.0 * ALIKE_LOADS:.0f} % both axles deflect "
        "the bridge nearly alike, which hides the deflection behind the profile",
        is_wrong=share < ALIKE_LOADS,
    )
    low, high = _AXLE_LOADS_KG
    is_mass_odd = not low <= min(front, rear) <= max(front, rear) <= high
    yield check_finding(
        "total_mass",
        f"{name}: total mass {vehicle.total_mass_kg / 1e3:.2f} t, known to "
        f"{100.0 * vehicle.spread('total_mass_kg'):.1f} %",
        f"total_mass_kg or front_axle_to_cg_m cannot be right: an axle carries {low / 1e3:g} to "
        f"{high / 1e3:g} t"
        if is_mass_odd
        else "weigh the truck: every EI is proportional to its mass, and no residual shows an "
        "error of it",
        is_wrong=is_mass_odd or vehicle.spread("total_mass_kg") > _LARGEST_MASS_SPREAD,
    )
    shortest, longest = _WHEELBASE_M
    yield check_finding(
        "wheelbase_declared",
        f"{name}: wheelbase {vehicle.wheelbase_m:g} m",
        f"measure it: trucks have a wheelbase of {shortest:g} to {longest:g} m",
        is_wrong=not shortest <= vehicle.wheelbase_m <= longest,
    )
    is_known = vehicle.twin_tyre_distance_m is not None
    yield CheckFinding(
        "tyres",
        CheckStatus.OK if is_known else CheckStatus.OPEN,
        f"{name}: {tyres_in_words(vehicle)}",
        ""
        if is_known
        else "declare twin_tyre_distance_m (0 for single tyres) and tyre_width_m, which determine "
        "how well a single element can be resolved",
    )

    is_measured = vehicle.cg_height_m is not None
    yield CheckFinding(
        "cg_height",
        CheckStatus.OK if is_measured else CheckStatus.OPEN,
        f"{name}: height of the centre of gravity "
        + (f"{vehicle.cg_height_m:g} m above the road" if is_measured else "unknown"),
        "" if is_measured else "give cg_height_m, or do not brake or accelerate on the bridge",
    )


def tyres_in_words(vehicle: Vehicle) -> str:
    """Return the tyres of the site file in words, with the assumed ones."""
    distance = vehicle.twin_tyre_distance_m
    if distance is None:
        return "tyres are not declared, so twin rear tyres are assumed"
    kinds = ["twin" if apart > 0.0 else "single" for apart in distance]
    return f"{kinds[0]} front tyres, {kinds[1]} rear tyres"


def sampling(rates_hz: tuple[float, ...]) -> CheckFinding:
    """Check whether the sensors are fast enough."""
    slowest = min(rates_hz)
    return check_finding(
        "sampling_rate",
        f"lowest sampling rate {slowest:g} Hz",
        f"sample at {SLOWEST_RATE_HZ:g} Hz or more, better at 500 Hz",
        is_wrong=slowest < SLOWEST_RATE_HZ,
    )


def sensors_of(site: Site, vehicle: Vehicle) -> Iterator[CheckFinding]:
    """Yield the sensors of a truck that names its own, with their positions."""
    for line in sensors_in_words(site.sensor, vehicle):
        yield CheckFinding("sensor", CheckStatus.OK, line)


def noise_declared(site: Site, vehicle: Vehicle) -> CheckFinding:
    """Check whether a noise is declared at all."""
    declared = densities_ug_per_rthz(site.sensor, vehicle)
    densities = declared.values()
    silent = [name for name, density in declared.items() if density == 0.0]
    return check_finding(
        "noise_declared",
        f"declared noise {', '.join(f'{density:g}' for density in densities)} µg/√Hz"
        + (f", none for {', '.join(silent)}" if silent else ""),
        "declare noise_density_ug_per_rthz from the data sheet: residuals are compared with it",
        is_wrong=bool(silent),
    )


def findings_of_bridge(bridge: Bridge) -> Iterator[CheckFinding]:
    """Yield findings on one bridge of the site file."""
    yield _ends(bridge)
    yield from _lane(bridge)
    speed = bridge.survey_speed_m_per_s
    if speed is not None:
        yield check_finding(
            "survey_speed",
            f"{bridge.id}: to be crossed at {speed:g} m/s",
            f"drive at 5 m/s or more: below {SLOWEST_M_PER_S:g} m/s a crossing is rejected",
            is_wrong=speed < SLOWEST_M_PER_S,
        )


def _ends(bridge: Bridge) -> CheckFinding:
    """Check whether the distance of the ends' coordinates is the span."""
    apart, span = bridge.ends_distance_m, bridge.span_m
    return check_finding(
        "bearings_distance",
        f"{bridge.id}: ends are {apart:.2f} m apart by their coordinates, span_m is {span:g}",
        "take the coordinates at the bearings, and measure the span with a tape",
        is_wrong=abs(apart - span) > max(1.0, 0.02 * span),
    )


def _lane(bridge: Bridge) -> Iterator[CheckFinding]:
    """Yield the lane and the torsion of the deck, a line each, where the site file has them."""
    if bridge.lane_offset_m is not None:
        side = "left" if bridge.lane_offset_m >= 0.0 else "right"
        effect = "so the deck twists" if bridge.is_lane_off_axis else "which may be zero"
        yield CheckFinding(
            "lane",
            CheckStatus.OK,
            f"{bridge.id}: lane {abs(bridge.lane_offset_m):g} ± {bridge.lane_offset_m_spread:g} m "
            f"{side} of the axis, {effect}",
        )
    declared = [
        f"{what} {value:g}{unit}"
        for what, value, unit in (
            ("frequency ratio", bridge.torsional_frequency_ratio, ""),
            ("radius of gyration", bridge.deck_gyration_m, " m"),
        )
        if value is not None
    ]
    if declared:
        yield CheckFinding(
            "torsion", CheckStatus.OK, f"{bridge.id}: torsion with {', '.join(declared)}"
        )
