"""Drawn crossings of trucks with a tandem behind front axles, equalised or on its own springs.

The owner knows the axles' places and the total mass, weighs each axle, and has all other values
within SITE_ERROR, as in `wide_cases`.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from services.simulation.two_sided import WideAxle, WideBogie, WideTruck, static_axle_loads_n
from services.simulation.wheel_paths import WANDER_M
from services.simulation.wide_crossings import WideCase, WideRun, WideSensor
from studies.simulation.wide_cases import (
    SINGLE,
    TWIN,
    declared_bridge,
    disturbed,
    draw_beam,
    rigid_body,
    with_errors,
)

TOTAL_MASS_KG: Final = (17e3, 26e3)
AHEAD_M: Final = (3.6, 5.0)
GAP_M: Final = (1.2, 1.45)
SPAN_M: Final = (22.0, 38.0)
SPEED_M_PER_S: Final = (8.5, 13.0)
SHARE: Final = (0.47, 0.53)
FRICTION_SHARE: Final = (0.02, 0.1)
OFFSET_M: Final = 0.005
"""Lateral offset of the tandem's second axle from the first."""
STEERED_APART_M: Final = (1.8, 2.1)
"""Distance of two steered axles."""
_LONGER_M: Final = 0.7
"""Distance by which a truck with two steered axles is longer."""
_LOAD_ERROR: Final = 0.01


class TandemOptions(NamedTuple):
    """Choices for a drawn tandem; None: drawn."""

    equalised: bool = True
    friction_share: float | None = None
    """Dry friction of the springs over their static load."""
    offset_m: float = OFFSET_M
    outer_share: float = 0.5
    """Share of the outer twin tyre in a side's load."""
    tyres: str = "twin"
    runs: int = 1
    noise_ug: float = 25.0
    road_class: str = "A"
    total_mass_kg: tuple[float, float] = TOTAL_MASS_KG
    """Range of the truck's mass."""
    span_m: tuple[float, float] = SPAN_M
    is_declared: bool = True
    """Whether the site file states how the axles share their load; otherwise it is `equalised`."""
    has_two_steered: bool = False
    """Whether there are two steered axles, with as much more mass; they have their own springs."""


USUAL: Final = TandemOptions()


def draw_tandem(seed: int, options: TandemOptions = USUAL) -> WideCase:
    """Draw a truck with a tandem, declared as such, on a bridge with one weak element or none."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x7A2D]))
    u = rng.uniform
    truck = tandem_truck_of(rng, options)
    if options.has_two_steered:
        apart = np.random.default_rng(np.random.SeedSequence([seed, 0x7A31]))
        truck = with_second_steered_axle(truck, apart)
    plain, ratios = draw_beam(rng, options.span_m, fewest_below_m=26.0, weak_share=0.7)
    rigidity = plain.flexural_rigidity_nm2[0]
    deck = plain._replace(flexural_rigidity_nm2=tuple((rigidity * ratios).tolist()))
    runs = tuple(
        WideRun(
            float(u(*SPEED_M_PER_S)),
            bool(u() < 0.5) if options.runs == 1 else True,
            WANDER_M * float(rng.standard_normal()),
            float(u(0.05, 0.4)),
            float(u(8.0, 16.0)),
        )
        for _ in range(options.runs)
    )
    sensors = with_errors(tandem_sensors(truck, options.noise_ug), rng)
    return WideCase(
        f"tandem-{seed}",
        seed,
        truck,
        deck,
        rigidity,
        0.0,
        options.road_class,
        int(rng.integers(1 << 31)),
        False,
        sensors,
        runs,
        {
            "vehicle": declared_tandem(
                truck, sensors, rng, equalised=options.equalised or not options.is_declared
            ),
            "bridge": declared_bridge(deck, rigidity, rng),
            "sensor": {"rate_hz": 500.0},
        },
    )


def tandem_truck_of(rng: np.random.Generator, options: TandemOptions) -> WideTruck:
    """Draw a loaded lorry of three axles whose springs and tyres fit its load."""
    u = rng.uniform
    total = float(u(*options.total_mass_kg))
    ahead, gap, share = float(u(*AHEAD_M)), float(u(*GAP_M)), float(u(*SHARE))
    vary = np.exp(0.1 * rng.standard_normal(10))
    own = np.array([650.0, 1050.0, 1050.0]) * vary[:3]
    body_kg = total - float(own.sum())
    force_m = ahead + (1.0 - share) * gap
    front_share = float(u(0.26, 0.36))
    carried = body_kg * np.array(
        [front_share, (1.0 - front_share) * share, (1.0 - front_share) * (1.0 - share)]
    )
    stiffness = carried * np.array([56.0, 105.0, 105.0]) * vary[3:6]
    damping = 0.3 * np.sqrt(stiffness * carried) * vary[6]
    tyre = np.array([2.0e6, 3.7e6, 3.7e6]) * np.sqrt(total / 24.8e3) * vary[7:10]
    rubs = options.friction_share
    rubs = float(u(*FRICTION_SHARE)) if rubs is None else rubs
    behind: dict[str, Any] = dict(TWIN if options.tyres == "twin" else SINGLE)
    cg = (1.0 - front_share) * force_m
    axles = []
    for i, (place, kind, offset, roll) in enumerate(
        (
            (0.0, dict(SINGLE) | {"track_m": 2.05, "spring_track_m": 0.84}, 0.0, 1.0e5),
            (ahead, behind, OFFSET_M, 1.2e5),
            (ahead + gap, behind, OFFSET_M + options.offset_m, 1.2e5),
        )
    ):
        axles.append(
            WideAxle(
                place,
                float(own[i]),
                float(stiffness[i]),
                float(damping[i]),
                float(tyre[i]),
                tyre_damping_ns_per_m=0.0 if i == 0 else float(u(0.0, 1000.0)),
                anti_roll_nm_per_rad=roll,
                offset_m=offset,
                outer_share=0.5 if i == 0 else options.outer_share,
                friction_n=rubs * float(carried[i]) * STANDARD_GRAVITY_M_PER_S2,
                **kind,
            )
        )
    body = rigid_body(body_kg, cg, cg * (force_m - cg) * float(u(0.85, 1.15)))
    bogies = (WideBogie((1, 2), (share, 1.0 - share)),) if options.equalised else ()
    return WideTruck((body,), tuple(axles), bogies)


def with_second_steered_axle(truck: WideTruck, rng: np.random.Generator) -> WideTruck:
    """Return a truck with an equalised tandem, longer and heavier by a second steered axle."""
    u, g = rng.uniform, STANDARD_GRAVITY_M_PER_S2
    first, *tandem = truck.axles
    carried = static_axle_loads_n(truck) - g * np.array([axle.mass_kg for axle in truck.axles])
    vary = np.exp(0.1 * rng.standard_normal(4))
    second = first._replace(
        position_m=float(u(*STEERED_APART_M)),
        mass_kg=first.mass_kg * float(vary[0]),
        suspension_stiffness_n_per_m=first.suspension_stiffness_n_per_m * float(vary[1]),
        suspension_damping_ns_per_m=first.suspension_damping_ns_per_m * float(vary[2]),
        tyre_stiffness_n_per_m=first.tyre_stiffness_n_per_m * float(vary[3]),
    )
    behind = [axle._replace(position_m=axle.position_m + _LONGER_M) for axle in tandem]
    loads = [carried[0], carried[0] * float(u(0.95, 1.05)), *carried[1:]]
    axles = tuple(
        axle._replace(preload_n=float(load))
        for axle, load in zip((first, second, *behind), loads, strict=True)
    )
    body_kg = sum(loads) / g
    places = [axle.position_m for axle in axles]
    cg = float(np.dot(places, loads) / sum(loads))
    front_m = places[1] * loads[1] / (loads[0] + loads[1])
    force_m = float(np.dot(places[2:], loads[2:]) / sum(loads[2:]))
    pitch = (cg - front_m) * (force_m - cg) * float(u(0.85, 1.15))
    bogie = truck.bogies[0]._replace(axles=(2, 3))
    return WideTruck((rigid_body(float(body_kg), cg, pitch),), axles, (bogie,))


def tandem_sensors(truck: WideTruck, noise_ug: float) -> tuple[WideSensor, ...]:
    """Return two sensors on the body, above front axles and tandem, and two on the tandem's axles.

    The front one is in the middle of the front axles.
    """
    *ahead, first, second = (axle.position_m for axle in truck.axles)
    front, middle = sum(ahead) / len(ahead), 0.5 * (first + second)
    number = len(truck.axles) - 1
    return (
        WideSensor("sprung_front", "body", round(front, 3), noise_ug_per_rthz=noise_ug),
        WideSensor("sprung_rear", "body", round(middle, 3), noise_ug_per_rthz=noise_ug),
        *(
            WideSensor(f"unsprung_{axle}", "axle", axle=axle, noise_ug_per_rthz=noise_ug)
            for axle in (number, number + 1)
        ),
    )


def declared_tandem(
    truck: WideTruck,
    sensors: tuple[WideSensor, ...],
    rng: np.random.Generator,
    *,
    equalised: bool = True,
) -> dict[str, Any]:
    """Return the vehicle's table, with a bogie of the last two axles, as its owner writes it."""
    weighed = static_axle_loads_n(truck) / STANDARD_GRAVITY_M_PER_S2
    axles = [
        {
            "position_m": axle.position_m,
            "tyres": "twin" if axle.twin_distance_m > 0.0 else "single",
            "tyre_width_m": axle.tyre_width_m,
            "twin_tyre_distance_m": axle.twin_distance_m,
            "track_m": axle.track_m,
            "load_kg": round(float(load * (1.0 + _LOAD_ERROR * rng.standard_normal())), 1),
            "unsprung_mass_kg": disturbed(axle.mass_kg, rng),
            "suspension_stiffness_n_per_m": disturbed(axle.suspension_stiffness_n_per_m, rng),
            "suspension_damping_ns_per_m": disturbed(axle.suspension_damping_ns_per_m, rng),
            "tyre_stiffness_n_per_m": disturbed(axle.tyre_stiffness_n_per_m, rng),
        }
        for axle, load in zip(truck.axles, weighed, strict=True)
    ]
    placed = [
        {
            "channel": sensor.channel,
            "on": sensor.on,
            **({"axle": sensor.axle} if sensor.on == "axle" else {"position_m": sensor.position_m}),
            "lateral_m": sensor.lateral_m,
            "noise_density_ug_per_rthz": sensor.noise_ug_per_rthz,
        }
        for sensor in sensors
    ]
    return {
        "id": "tandem-truck",
        "gps_antenna_to_front_axle_m": 0.0,
        "cg_height_m": 1.3,
        "total_mass_kg": round(truck.total_mass_kg, 1),
        "axles": axles,
        "bogies": [{"axles": [len(axles) - 1, len(axles)], "equalised": equalised}],
        "sensors": placed,
    }
