"""What a site file alone says for and against a survey with this truck and these sensors."""

from collections.abc import Iterator
from typing import Final

from schemas.site import Bridge, Site, Vehicle
from services.identification.checks import ALIKE_LOADS, axle_loads_kg
from services.identification.identify import SLOWEST_M_PER_S
from services.identification.placed import densities_ug_per_rthz, rates_hz, sensors_in_words
from services.inspection.finding import Finding, State, judged

SLOWEST_RATE_HZ: Final = 100.0
"""The method's rows need 25 Hz: sensors of fewer samples a second were never tried."""
_LARGEST_MASS_SPREAD: Final = 0.03
"""A weighbridge is right to 1 %; a guess of the load is worth 10 %."""
_AXLE_LOADS_KG: Final = (500.0, 20_000.0)
"""Of an axle: less is no truck, more no road allows."""
_WHEELBASE_M: Final = (1.5, 12.0)


def findings_of_site(site: Site, vehicle: Vehicle) -> Iterator[Finding]:
    """Loads, masses, tyres, sampling, and the bridges' places."""
    yield from findings_of_truck(vehicle)
    yield from sensors_of(site, vehicle)
    yield sampling(tuple(rates_hz(site.sensor, vehicle).values()))
    yield noise_declared(site, vehicle)
    for bridge in site.bridges:
        yield from findings_of_bridge(bridge)


def findings_of_truck(vehicle: Vehicle) -> Iterator[Finding]:
    """What the site file says of one truck."""
    front, rear = axle_loads_kg(vehicle)
    name = vehicle.id
    share = abs(front - rear) / (front + rear)
    yield judged(
        "axle_loads",
        f"{name}: axles carry {front / 1e3:.2f} and {rear / 1e3:.2f} t, "
        f"they differ by {share:.0%} of the total",
        f"load one axle more: with less than {ALIKE_LOADS:.0%} both press the bridge nearly alike, "
        "and what the road does can hardly be told from what the bridge does",
        is_wrong=share < ALIKE_LOADS,
    )
    low, high = _AXLE_LOADS_KG
    is_mass_odd = not low <= min(front, rear) <= max(front, rear) <= high
    yield judged(
        "total_mass",
        f"{name}: total mass {vehicle.total_mass_kg / 1e3:.2f} t, known to "
        f"{vehicle.spread('total_mass_kg'):.1%}",
        f"total_mass_kg or front_axle_to_cg_m cannot be right, an axle carries {low / 1e3:g} to "
        f"{high / 1e3:g} t"
        if is_mass_odd
        else "weigh it: every EI is proportional to it, and no residual shows its error",
        is_wrong=is_mass_odd or vehicle.spread("total_mass_kg") > _LARGEST_MASS_SPREAD,
    )
    shortest, longest = _WHEELBASE_M
    yield judged(
        "wheelbase_declared",
        f"{name}: wheelbase {vehicle.wheelbase_m:g} m",
        f"measure it: trucks have {shortest:g} to {longest:g} m",
        is_wrong=not shortest <= vehicle.wheelbase_m <= longest,
    )
    is_known = vehicle.twin_tyre_distance_m is not None
    yield Finding(
        "tyres",
        State.OK if is_known else State.OPEN,
        f"{name}: {tyres_in_words(vehicle)}",
        ""
        if is_known
        else "give twin_tyre_distance_m (0 for single tyres) and tyre_width_m: they decide how "
        "much of a single element can be told",
    )

    is_measured = vehicle.cg_height_m is not None
    yield Finding(
        "cg_height",
        State.OK if is_measured else State.OPEN,
        f"{name}: centre of gravity "
        + (f"{vehicle.cg_height_m:g} m above the road" if is_measured else "of unknown height"),
        "" if is_measured else "give cg_height_m, or do not brake or accelerate on the bridge",
    )


def tyres_in_words(vehicle: Vehicle) -> str:
    """What the site file says of the tyres, and what is taken for granted."""
    distance = vehicle.twin_tyre_distance_m
    if distance is None:
        return "nothing is known of the tyres, twin ones are assumed behind"
    kinds = ["twin" if apart > 0.0 else "single" for apart in distance]
    return f"{kinds[0]} tyres in front, {kinds[1]} behind"


def sampling(rates_hz: tuple[float, ...]) -> Finding:
    """Whether the sensors are quick enough."""
    slowest = min(rates_hz)
    return judged(
        "sampling_rate",
        f"slowest sensor {slowest:g} Hz",
        f"sample at {SLOWEST_RATE_HZ:g} Hz or more, better 500",
        is_wrong=slowest < SLOWEST_RATE_HZ,
    )


def sensors_of(site: Site, vehicle: Vehicle) -> Iterator[Finding]:
    """The sensors of a truck that names its own, with their places."""
    for line in sensors_in_words(site.sensor, vehicle):
        yield Finding("sensor", State.OK, line)


def noise_declared(site: Site, vehicle: Vehicle) -> Finding:
    """Whether a noise is declared at all."""
    declared = densities_ug_per_rthz(site.sensor, vehicle)
    densities = declared.values()
    silent = [name for name, density in declared.items() if density == 0.0]
    return judged(
        "noise_declared",
        f"noise declared {' '.join(f'{density:g}' for density in densities)} µg/√Hz"
        + (f", none for {', '.join(silent)}" if silent else ""),
        "declare noise_density_ug_per_rthz of the data sheet: the fit is judged by it",
        is_wrong=bool(silent),
    )


def findings_of_bridge(bridge: Bridge) -> Iterator[Finding]:
    """What the site file says of one bridge."""
    yield _ends(bridge)
    speed = bridge.survey_speed_m_per_s
    if speed is not None:
        yield judged(
            "survey_speed",
            f"{bridge.id}: to be crossed at {speed:g} m/s",
            f"below {SLOWEST_M_PER_S:g} m/s a crossing is rejected, drive at 5 m/s or more",
            is_wrong=speed < SLOWEST_M_PER_S,
        )


def _ends(bridge: Bridge) -> Finding:
    """Whether the coordinates of the ends are as far apart as the bridge is long."""
    apart, span = bridge.ends_distance_m, bridge.span_m
    return judged(
        "bearings_distance",
        f"{bridge.id}: ends {apart:.2f} m apart by their coordinates, span_m {span:g}",
        "take the coordinates where the bearings are, and measure the span with a tape",
        is_wrong=abs(apart - span) > max(1.0, 0.02 * span),
    )
