"""Three-dimensional cases: decks that twist, and trucks with more axles than declared.

The owner knows total mass and axle distances; all other values of the site file are those of the
undamaged bridge and of the truck within SITE_ERROR.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from schemas.wgs84 import ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS_M
from services.simulation.two_sided import (
    Body,
    Kingpin,
    WideAxle,
    WideBogie,
    WideTruck,
    static_axle_loads_n,
)
from services.simulation.two_sided_deck import Deck, Torsion, bending_frequencies_hz
from services.simulation.wheel_paths import WANDER_M
from services.simulation.wide_crossings import (
    USUAL_RECEIVER,
    SatelliteErrors,
    WideCase,
    WideRun,
    WideSensor,
)

SITE_ERROR: Final = 0.15
"""Largest relative error of declared values."""
_LATITUDE_DEG, _LONGITUDE_DEG = 36.4, 140.3

GAIN_SPREAD: Final = 0.01
DELAY_SPREAD_S: Final = 0.0005
BIAS_M_PER_S2: Final = 0.02
NOISE_UG: Final = (10.0, 25.0, 50.0)
TOTAL_MASS_KG: Final = (12e3, 19e3)
WHEELBASE_M: Final = (4.5, 6.0)
FRONT_SHARE: Final = (0.34, 0.45)
"""Share of the body's mass on the front axle."""
SPAN_M: Final = (18.0, 40.0)
SPEED_M_PER_S: Final = (8.0, 15.0)
LANE_OFFSET_M: Final = (0.0, 2.0)
TORSIONAL_RATIO: Final = (1.3, 3.0)
GYRATION_M: Final = (1.8, 3.0)
WEAK: Final = (0.4, 0.75)
"""EI of the weak element over that of the others, where there is one."""
REAR_OFFSET_M: Final = 0.005
SINGLE: Final[Mapping[str, Any]] = {"track_m": 1.9, "tyre_width_m": 0.25}
TWIN: Final[Mapping[str, Any]] = {"track_m": 1.83, "tyre_width_m": 0.22, "twin_distance_m": 0.33}
LANE_ERROR_M: Final = 0.3
"""Standard deviation of a declared lane offset."""


def draw_wide(
    seed: int,
    *,
    tyres: str | None = None,
    declared: bool | None = None,
    runs: int = 1,
    receiver: SatelliteErrors = USUAL_RECEIVER,
) -> WideCase:
    """Draw a two-axle truck on an eccentric lane of a deck that twists.

    `tyres` is "single" (equal tracks, rear axle offset by 5 mm) or "twin" (behind); `declared` is
    whether the site file has lane offset, torsional ratio and gyration. Both are drawn unless
    given.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x31DE]))
    u = rng.uniform
    drawn_tyres = "single" if u() < 0.5 else "twin"
    drawn_declared = bool(u() < 0.5)
    tyres = drawn_tyres if tyres is None else tyres
    declared = drawn_declared if declared is None else declared
    truck = two_axle_truck(
        float(u(*TOTAL_MASS_KG)), float(u(*WHEELBASE_M)), float(u(*FRONT_SHARE)), tyres, rng
    )
    plain, ratios = draw_beam(rng, SPAN_M, fewest_below_m=24.0, weak_share=0.5)
    rigidity = plain.flexural_rigidity_nm2[0]
    f_1 = float(bending_frequencies_hz(plain, 1)[0])
    ratio, gyration = float(u(*TORSIONAL_RATIO)), float(u(*GYRATION_M))
    side = 1.0 if u() < 0.5 else -1.0
    lane = side * float(u(*LANE_OFFSET_M))
    deck = plain._replace(
        flexural_rigidity_nm2=tuple((rigidity * ratios).tolist()),
        torsion=Torsion(ratio * f_1, gyration),
    )
    width = {
        "lane_offset_m": round(lane + LANE_ERROR_M * float(rng.standard_normal()), 2),
        "torsional_frequency_ratio": disturbed(ratio, rng),
        "deck_gyration_m": disturbed(gyration, rng),
    }
    noise = float(rng.choice(NOISE_UG))
    return WideCase(
        f"wide-{seed}",
        seed,
        truck,
        deck,
        rigidity,
        lane,
        str(rng.choice(["A", "B"])),
        int(rng.integers(1 << 31)),
        False,
        with_errors(middle_sensors(truck.axles[1].position_m, noise), rng),
        tuple(_draw_run(rng) for _ in range(runs)),
        {
            "vehicle": declared_vehicle(truck, truck.total_mass_kg, rng),
            "bridge": declared_bridge(deck, rigidity, rng) | (width if declared else {}),
            "sensor": {"rate_hz": 500.0, "noise_density_ug_per_rthz": noise},
        },
        receiver=receiver,
    )


def draw_beam(
    rng: np.random.Generator,
    span_m: tuple[float, float],
    *,
    fewest_below_m: float,
    weak_share: float,
) -> tuple[Deck, NDArray[np.float64]]:
    """Draw an undamaged deck that does not twist, and the ratios (n,) of the damaged EI to it.

    Spans below `fewest_below_m` have five elements, others seven; with probability `weak_share` one
    element is weak.
    """
    u = rng.uniform
    span = round(float(u(*span_m)), 1)
    elements = 5 if span < fewest_below_m else 7
    mass = 4400.0 * float(np.sqrt(span / 30.0) * u(0.8, 1.25))
    rigidity = mass * (2.0 * float(u(90.0, 115.0)) * span / np.pi) ** 2
    ratios = np.ones(elements)
    is_weak, element, weak = u() < weak_share, int(rng.integers(elements)), u(*WEAK)
    if is_weak:
        ratios[element] = weak
    alpha, beta = (
        0.7 * np.exp(0.2 * rng.standard_normal()),
        0.005 * np.exp(0.2 * rng.standard_normal()),
    )
    deck = Deck(span, (float(rigidity),) * elements, mass, float(alpha), float(beta))
    return deck, ratios


def _draw_run(rng: np.random.Generator) -> WideRun:
    u = rng.uniform
    return WideRun(
        float(u(*SPEED_M_PER_S)),
        bool(u() < 0.5),
        WANDER_M * float(rng.standard_normal()),
        float(u(0.1, 0.6)) if u() < 0.3 else 0.02,
        float(u(8.0, 16.0)),
    )


def two_axle_truck(
    total_kg: float, wheelbase_m: float, front_share: float, tyres: str, rng: np.random.Generator
) -> WideTruck:
    """Return a lorry whose springs and tyres fit its load, varied by some 15 %."""
    vary = np.exp(0.12 * rng.standard_normal(9))
    front_kg, rear_kg = 650.0 * vary[0], 1100.0 * vary[1]
    body_kg = total_kg - front_kg - rear_kg
    carried = body_kg * np.array([front_share, 1.0 - front_share])
    stiffness = carried * np.array([56.0, 100.0]) * vary[2:4]
    damping = 0.3 * np.sqrt(stiffness * carried) * vary[4:6]
    tyre = np.array([1.9e6, 3.8e6]) * np.sqrt(total_kg / 16.3e3) * vary[6:8]
    cg = (1.0 - front_share) * wheelbase_m
    behind = SINGLE if tyres == "single" else TWIN
    axles = (
        WideAxle(
            0.0,
            float(front_kg),
            float(stiffness[0]),
            float(damping[0]),
            float(tyre[0]),
            spring_track_m=0.84,
            **SINGLE,
        ),
        WideAxle(
            wheelbase_m,
            float(rear_kg),
            float(stiffness[1]),
            float(damping[1]),
            float(tyre[1]),
            anti_roll_nm_per_rad=1.5e5,
            offset_m=REAR_OFFSET_M,
            **behind,
        ),
    )
    return WideTruck((rigid_body(float(body_kg), cg, cg * (wheelbase_m - cg) * vary[8]),), axles)


def rigid_body(mass_kg: float, cg_position_m: float, gyration_squared_m2: float) -> Body:
    """Return a body with this squared pitch gyration and a roll gyration of 0.85 m."""
    pitch, roll = mass_kg * float(gyration_squared_m2), mass_kg * 0.85**2
    return Body(mass_kg, cg_position_m, pitch, roll)


def middle_sensors(
    wheelbase_m: float, noise_ug: float, rear_axle: int = 2
) -> tuple[WideSensor, ...]:
    """Return the four sensors of a two-axle truck on its centre line."""
    return (
        WideSensor("sprung_front", "body", 0.0, noise_ug_per_rthz=noise_ug),
        WideSensor("sprung_rear", "body", wheelbase_m, noise_ug_per_rthz=noise_ug),
        WideSensor("unsprung_front", "axle", axle=1, noise_ug_per_rthz=noise_ug),
        WideSensor("unsprung_rear", "axle", axle=rear_axle, noise_ug_per_rthz=noise_ug),
    )


def with_errors(sensors: Sequence[WideSensor], rng: np.random.Generator) -> tuple[WideSensor, ...]:
    """Return the sensors with gains, delays and biases drawn from the declared spreads."""
    return tuple(
        sensor._replace(
            gain_error=GAIN_SPREAD * float(rng.standard_normal()),
            delay_s=DELAY_SPREAD_S * float(rng.standard_normal()),
            bias_m_per_s2=BIAS_M_PER_S2 * float(rng.standard_normal()),
        )
        for sensor in sensors
    )


def declared_vehicle(
    truck: WideTruck,
    total_mass_kg: float,
    rng: np.random.Generator,
    rear: Sequence[int] = (1,),
) -> dict[str, Any]:
    """Return the table of a truck with two axles; those of `rear` (indices) count as one."""
    front, behind = truck.axles[0], [truck.axles[i] for i in rear]
    wheelbase = float(np.mean([axle.position_m for axle in behind]))
    body = truck.bodies[0]

    def pair(key: str) -> list[float]:
        return [
            disturbed(float(getattr(front, key)), rng),
            disturbed(float(sum(getattr(axle, key) for axle in behind)), rng),
        ]

    tracks = [front.track_m, behind[0].track_m]
    return {
        "id": "wide-truck",
        "gps_antenna_to_front_axle_m": 0.0,
        "cg_height_m": 1.3,
        "total_mass_kg": round(total_mass_kg, 1),
        "wheelbase_m": round(wheelbase, 4),
        "front_axle_to_cg_m": min(disturbed(body.cg_position_m, rng), 0.9 * wheelbase),
        "suspension_damping_ns_per_m": pair("suspension_damping_ns_per_m"),
        "suspension_stiffness_n_per_m": pair("suspension_stiffness_n_per_m"),
        "unsprung_mass_kg": pair("mass_kg"),
        "tyre_stiffness_n_per_m": pair("tyre_stiffness_n_per_m"),
        "tyre_width_m": [front.tyre_width_m, behind[0].tyre_width_m],
        "twin_tyre_distance_m": [front.twin_distance_m, behind[0].twin_distance_m],
        "track_m": tracks[0] if tracks[0] == tracks[1] else tracks,
    }


def declared_bridge(deck: Deck, undamaged_nm2: float, rng: np.random.Generator) -> dict[str, Any]:
    """Return the table of a bridge without its torsional properties."""
    azimuth = float(rng.uniform(0.0, 2.0 * np.pi))
    latitude = np.radians(_LATITUDE_DEG)
    root = 1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    meridian = SEMI_MAJOR_AXIS_M * (1.0 - ECCENTRICITY_SQUARED) / root**1.5
    parallel = SEMI_MAJOR_AXIS_M / np.sqrt(root) * np.cos(latitude)
    north = np.degrees(deck.span_m * np.cos(azimuth) / meridian)
    east = np.degrees(deck.span_m * np.sin(azimuth) / parallel)
    return {
        "id": "wide-bridge",
        "span_m": deck.span_m,
        "start_latitude_deg": _LATITUDE_DEG,
        "start_longitude_deg": _LONGITUDE_DEG,
        "end_latitude_deg": round(float(_LATITUDE_DEG + north), 8),
        "end_longitude_deg": round(float(_LONGITUDE_DEG + east), 8),
        "elements": len(deck.flexural_rigidity_nm2),
        "flexural_rigidity_nm2": disturbed(undamaged_nm2, rng),
        "mass_per_length_kg_per_m": disturbed(deck.mass_per_length_kg_per_m, rng),
        "rayleigh_alpha_per_s": disturbed(deck.rayleigh_alpha_per_s, rng),
        "rayleigh_beta_s": disturbed(deck.rayleigh_beta_s, rng),
    }


def disturbed(value: float, rng: np.random.Generator) -> float:
    """Return a value as its owner has it: five digits, within SITE_ERROR."""
    return float(f"{value * (1.0 + rng.uniform(-SITE_ERROR, SITE_ERROR)):.5g}")


TYRE_KINDS: Final = ("twin", "single", "same")
"""Twin tyres on all axles except the first, single ones on equal tracks, or one profile for all."""


def more_axles(number: int) -> WideCase:
    """Return one of 16 crossings of a semitrailer or tandem that is declared as two axles.

    Even numbers are tractors with a semitrailer, declared with the tractor's mass or all of it; odd
    ones trucks with a tandem, equalised or not, whose third or second axle has the sensor. Speeds
    are from 8 to 14 m/s. Raise ValueError for other numbers.
    """
    if not 0 <= number < 16:
        raise ValueError(f"{number} is no case, it must be from 0 to 15")
    rng = np.random.default_rng(np.random.SeedSequence([number, 0x3A71]))
    kind = TYRE_KINDS[(number // 2) % len(TYRE_KINDS)]
    rear = TWIN if kind == "twin" else SINGLE
    is_first = number % 4 < 2
    if number % 2 == 0:
        truck = semitrailer(rear)
        mass = float(static_axle_loads_n(truck)[:2].sum() / STANDARD_GRAVITY_M_PER_S2)
        mass = mass if is_first else truck.total_mass_kg
        vehicle = declared_vehicle(truck, mass, rng)
        sensors = middle_sensors(truck.axles[1].position_m, 25.0)
    else:
        truck = tandem_truck(rear, equalised=number % 8 < 4)
        vehicle = declared_vehicle(truck, truck.total_mass_kg, rng, rear=(1, 2))
        sensors = middle_sensors(vehicle["wheelbase_m"], 25.0, rear_axle=2 if is_first else 3)
    rigidity = 1.56e10
    ratios = np.ones(7)
    ratios[number % 7] = 0.6
    deck = Deck(30.0, tuple((rigidity * ratios).tolist()), 4400.0, 0.7, 0.005)
    return WideCase(
        f"more-axles-{number}",
        number,
        truck,
        deck,
        rigidity,
        0.0,
        "A",
        int(rng.integers(1 << 31)),
        kind == "same",
        with_errors(sensors, rng),
        (WideRun(8.0 + 6.0 * number / 15.0, lateral_m=WANDER_M * float(rng.standard_normal())),),
        {
            "vehicle": vehicle,
            "bridge": declared_bridge(deck, rigidity, rng),
            "sensor": {"rate_hz": 500.0, "noise_density_ug_per_rthz": 25.0},
        },
    )


def semitrailer(rear: Mapping[str, Any]) -> WideTruck:
    """Return a tractor of two axles and a loaded trailer on three that share their load."""
    axles = [WideAxle(0.0, 700.0, 3.4e5, 2.4e4, 2.0e6, spring_track_m=0.84, **SINGLE)]
    axles.append(WideAxle(3.7, 1150.0, 7e5, 4e4, 3.8e6, offset_m=REAR_OFFSET_M, **rear))
    for k, offset in enumerate((0.008, 0.004, 0.0)):
        axles.append(
            WideAxle(
                9.2 + 1.31 * k,
                850.0,
                6e5,
                2.5e4,
                2.4e6,
                tyre_damping_ns_per_m=500.0,
                offset_m=offset,
                body=1,
                **SINGLE,
            )
        )
    return WideTruck(
        (rigid_body(6200.0, 1.25, 3.0), rigid_body(28500.0, 7.6, 12.0)),
        tuple(axles),
        (WideBogie((2, 3, 4), (1.0 / 3.0,) * 3),),
        Kingpin(3.1),
    )


def tandem_truck(
    rear: Mapping[str, Any], *, equalised: bool = True, outer_share: float = 0.5
) -> WideTruck:
    """Return a truck of 24.8 t on a front axle and a tandem."""
    axles = [WideAxle(0.0, 700.0, 3.4e5, 2.4e4, 2.0e6, spring_track_m=0.84, **SINGLE)]
    for position, offset in ((4.6, REAR_OFFSET_M), (5.95, 2.0 * REAR_OFFSET_M)):
        axles.append(
            WideAxle(
                position,
                1050.0,
                8.5e5,
                3e4,
                3.7e6,
                tyre_damping_ns_per_m=500.0,
                anti_roll_nm_per_rad=1.2e5,
                offset_m=offset,
                outer_share=outer_share,
                **rear,
            )
        )
    bogies = (WideBogie((1, 2), (0.5, 0.5)),) if equalised else ()
    return WideTruck((rigid_body(22000.0, 3.55, 6.74),), tuple(axles), bogies)
