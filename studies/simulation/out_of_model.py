"""Crossings with out-of-model effects, drawn from ranges that are not priors.

Truck, rigidities, sensors, receiver and conditions are those of `drawn.draw_truth`. The bearings of
its bridge are made free and rigid and its tyres undamped; then one effect is added, or all. The
same seed gives the same truck and drive under every effect except "spans", whose bridge differs.

The ranges, uniform unless stated:

- sprung: each end has a rotational restraint of 0.1 to 3 EI/span;
- sinking: each end is on a bearing of 1e9 to 2e10 N/m (log-uniform);
- swing: a lorry of 10 to 40 t left 0.05 to 2 s before, at 10 to 25 m/s, either way;
- tyres: damping of 300 to 2000 N s/m each;
- friction: 2 to 10 % of the suspension's load within 1 to 4 mm, every other time proportional to
  the load; body sensors of 2.5 to 25 µg/√Hz (log-uniform);
- bilinear: dampers 5 to 30 % stronger in rebound and weaker in compression;
- air: air springs with an exponent of 1.2 to 1.4;
- spans: two to five of 12 to 25 m, with eight elements for two, else three for each on average;
- surface: the road is a 2-D surface under single tyres in front and twin tyres behind, unless
  the site defines them (`wheel_paths`); the rear axle is 0 to 10 mm off the front one, the truck
  0.12 m from the line (standard deviation);
- torsion: a lane 0.5 to 2 m off the axis, either side, of a deck whose first torsional frequency is
  1.3 to 3 times the first of bending and whose radius of gyration is 1.8 to 3 m, under single tyres
  on such a surface;
- left-and-right: a truck that rolls, its load up to 6 cm off the centre line, on the same tyres and
  surface, with sensors left and right on both axles and in pairs on the body, whose gains differ,
  averaged to the four channels;
- pavement: such a surface whose deck is 0.4 to 4 times as rough as the road (log-uniform), with
  dips or steps of up to 15 mm at its ends, and a lateral correlation length of 1 to 5 times that of
  an isotropic surface (log-uniform);
- everything: all of these but the last four, each end sprung and the bridge continuous every other
  time.
"""

from typing import NamedTuple

import numpy as np

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.physics.bridge import Beam, natural_frequencies_hz
from pre_core.physics.vehicle import HalfCar
from schemas.site import Bridge, Site
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, to_lat_lon
from services.simulation.drawn import CrossingTruth, SimulatedCrossing, draw_truth, drive
from services.simulation.drive import DepartedVehicle, OutOfModelEffects, with_effects
from services.simulation.effects import (
    AMONG_ALL,
    EFFECTS,
    EVERYTHING,
    LEFT_AND_RIGHT,
    PAVEMENT,
    SURFACE,
    TORSION,
)
from services.simulation.pavement import PLAIN, Pavement
from services.simulation.two_sided_deck import Torsion
from services.simulation.wheel_paths import WANDER_M, SurfaceOptions, WheelPaths, wheel_paths_of
from services.simulation.wide_crossings import WideSensor
from studies.simulation.drive_wide import Width, drive_wide

SPRUNG_EI_PER_SPAN = (0.1, 3.0)
BEARINGS_N_PER_M = (1e9, 2e10)
LORRY_KG = (10e3, 40e3)
LORRY_M_PER_S = (10.0, 25.0)
LEFT_S = (0.05, 2.0)
TYRE_DAMPING_NS_PER_M = (300.0, 2000.0)
FRICTION_SHARE = (0.02, 0.10)
FRICTION_LENGTH_M = (0.001, 0.004)
BODY_NOISE_UG = (2.5, 25.0)
BILINEAR = (0.05, 0.30)
AIR_EXPONENT = (1.2, 1.4)
SPANS = (2, 5)
SPAN_M = (12.0, 25.0)
REAR_OFFSET_M = (0.0, 0.01)
LANE_OFFSET_M = (0.5, 2.0)
TORSIONAL_RATIO = (1.3, 3.0)
GYRATION_M = (1.8, 3.0)
LOAD_LEFT_M = (-0.06, 0.06)
DECK_ROUGHNESS = (0.4, 4.0)
LARGEST_JOINT_M = (0.0, 0.015)
ANISOTROPY = (1.0, 5.0)
AXLE_SENSORS_M, BODY_SENSORS_M = 0.9, 0.4
"""Distance of sensors left and right from the centre line, on axles and body."""


class OutOfModelTruth(NamedTuple):
    """The truth of a crossing with an effect, and the site that its owner would declare."""

    truth: CrossingTruth
    site: Site
    """Nominal values except noise; for continuous bridges, with the supports."""
    effects: OutOfModelEffects
    width: Width | None
    """Properties of truck and bridge beyond the plane; None: none."""


class _LateralDraws(NamedTuple):
    """Values of the effects that give truck or bridge a width."""

    lane_offset_m: float
    torsional_ratio: float
    """First torsional natural frequency over the first one of bending."""
    gyration_m: float
    load_left_m: float
    errors_of_pairs: Floats  # (3, 8): standard normals of `_pairs`


def draw_out_of_model(site: Site, effect: str, seed: int) -> OutOfModelTruth:
    """Draw a crossing of one of EFFECTS; raise ValueError for any other."""
    if effect not in EFFECTS:
        raise ValueError(f"{effect} is none of {', '.join(EFFECTS)}")
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x3D0B]))
    # Everything is drawn every time, so that an effect is the same alone and combined.
    every_other = rng.uniform(size=4) < 0.5
    springs = rng.uniform(*SPRUNG_EI_PER_SPAN, 2)
    softest, hardest = BEARINGS_N_PER_M
    bearings = softest * (hardest / softest) ** rng.uniform(size=2)
    departed = _draw_departed(rng)
    tyres = rng.uniform(*TYRE_DAMPING_NS_PER_M, 2)
    share, length = float(rng.uniform(*FRICTION_SHARE)), float(rng.uniform(*FRICTION_LENGTH_M))
    body_noise = _draw_log_uniform(rng, *BODY_NOISE_UG)
    bilinear, air = float(rng.uniform(*BILINEAR)), float(rng.uniform(*AIR_EXPONENT))
    spans = rng.uniform(*SPAN_M, int(rng.integers(SPANS[0], SPANS[1] + 1)))
    rear_offset = float(rng.uniform(*REAR_OFFSET_M))
    lateral = _draw_lateral(rng)
    pavement = _draw_pavement(rng)

    alone = effect != EVERYTHING

    def has(name: str) -> bool:
        return effect == name or (not alone and name in AMONG_ALL)

    if effect == "spans" or (not alone and every_other[0]):
        site = site.model_copy(update={"bridges": (continuous(site.bridges[0], spans),)})
    if effect in (TORSION, LEFT_AND_RIGHT):
        site = with_single_tyres(site)
    drawn = draw_truth(site, seed)
    sprung = [has("sprung") and (alone or bool(other)) for other in every_other[1:3]]
    springs *= site.bridges[0].support_rotational_stiffness_nm_per_rad_scale_at_zero
    effects = OutOfModelEffects(
        _pair(springs * sprung),
        _pair(1.0 / bearings if has("sinking") else np.zeros(2)),
        departed if has("swing") else None,
        share if has("friction") else 0.0,
        1.0 if has("friction") and every_other[3] else 0.0,
        bilinear if has("bilinear") else 0.0,
        air if has("air") else 0.0,
    )
    car, beam = _plain(drawn.car, drawn.beam)
    if has("tyres"):
        car = car._replace(tyre_damping_ns_per_m=_pair(tyres))
    car, beam = with_effects(car._replace(friction_length_m=length), beam, effects)
    conditions = drawn.conditions
    if has("friction"):
        conditions = conditions._replace(body_noise_ug_per_rthz=body_noise)
    paths = None
    if has(SURFACE) or has(PAVEMENT):
        paths = _paths(site, rear_offset, pavement if has(PAVEMENT) else PLAIN)
    width = None
    if has(TORSION):
        width = _twisting(_paths(site, rear_offset, PLAIN), lateral, site, beam)
    if has(LEFT_AND_RIGHT):
        width = _leaning(_paths(site, rear_offset, PLAIN), lateral, site, drawn, car)
    truth = drawn._replace(
        car=car, beam=beam, conditions=conditions, departed=effects.departed, paths=paths
    )
    return OutOfModelTruth(truth, site, effects, width)


def drive_out_of_model(case: OutOfModelTruth, seed: int) -> SimulatedCrossing:
    """Simulate and measure one crossing; `seed` is that of noise and receiver."""
    if case.width is None:
        return drive(case.site, case.truth, seed)
    return drive_wide(case.site, case.truth, case.width, seed)


def _draw_departed(rng: np.random.Generator) -> DepartedVehicle:
    way = 1.0 if rng.uniform() < 0.5 else -1.0
    return DepartedVehicle(
        float(rng.uniform(*LORRY_KG) * STANDARD_GRAVITY_M_PER_S2),
        float(way * rng.uniform(*LORRY_M_PER_S)),
        float(rng.uniform(*LEFT_S)),
    )


def _draw_lateral(rng: np.random.Generator) -> _LateralDraws:
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    return _LateralDraws(
        side * float(rng.uniform(*LANE_OFFSET_M)),
        float(rng.uniform(*TORSIONAL_RATIO)),
        float(rng.uniform(*GYRATION_M)),
        float(rng.uniform(*LOAD_LEFT_M)),
        rng.standard_normal((3, 8)),
    )


def _twisting(paths: WheelPaths, lateral: _LateralDraws, site: Site, beam: Beam) -> Width:
    """Return the width of a crossing off the axis of a deck that twists."""
    frequency_hz = lateral.torsional_ratio * _undamaged_frequency_hz(site, beam)
    torsion = Torsion(frequency_hz, lateral.gyration_m)
    return Width(paths, lane_offset_m=lateral.lane_offset_m, torsion=torsion)


def _leaning(
    paths: WheelPaths, lateral: _LateralDraws, site: Site, drawn: CrossingTruth, car: HalfCar
) -> Width:
    """Return the width of a truck whose load is off its centre line, with sensors on both sides."""
    sensors = _pairs(site, drawn, car, lateral.errors_of_pairs)
    return Width(paths, load_left_m=lateral.load_left_m, sensors=sensors)


def _undamaged_frequency_hz(site: Site, beam: Beam) -> float:
    """Return the first natural frequency of a beam with the nominal EI."""
    nominal = np.mean(site.bridges[0].nominal_flexural_rigidity_nm2)
    undamaged = beam._replace(
        flexural_rigidity_nm2=np.full_like(beam.flexural_rigidity_nm2, nominal)
    )
    return float(natural_frequencies_hz(undamaged, 1)[0])


def _draw_pavement(rng: np.random.Generator) -> Pavement:
    roughness = _draw_log_uniform(rng, *DECK_ROUGHNESS)
    largest_joint_m = float(rng.uniform(*LARGEST_JOINT_M))
    return Pavement(roughness, largest_joint_m, _draw_log_uniform(rng, *ANISOTROPY))


def _draw_log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.uniform())


def _paths(site: Site, rear_offset_m: float, pavement: Pavement) -> WheelPaths:
    """Return the wheel paths of the site's truck, with this rear offset if it declares none."""
    vehicle = site.vehicles[0]
    unknown = vehicle.rear_axle_offset_m is None
    options = SurfaceOptions(None, rear_offset_m if unknown else None, WANDER_M, pavement)
    return wheel_paths_of(vehicle, options)


def with_single_tyres(site: Site) -> Site:
    """Return the site whose truck has single tyres, unless it defines them."""
    vehicle = site.vehicles[0]
    if vehicle.twin_tyre_distance_m is not None:
        return site
    single = vehicle.model_copy(update={"twin_tyre_distance_m": (0.0, 0.0)})
    return site.model_copy(update={"vehicles": (single, *site.vehicles[1:])})


def _pairs(
    site: Site, drawn: CrossingTruth, car: HalfCar, errors: Floats
) -> tuple[WideSensor, ...]:
    """Return sensors left and right, with own gains and biases: (3, 8) standard normals.

    One data logger samples both of a pair at the same time: they have the same delay. Different
    delays, like different gains, would leak an axle's roll into their mean.
    """
    sensor = site.sensor
    bias = float(np.sqrt(np.mean(drawn.channels.bias_m_per_s2**2)))
    places = [
        ("body", position, 0, side * BODY_SENSORS_M)
        for position in (0.0, car.wheelbase_m)
        for side in (1.0, -1.0)
    ] + [("axle", 0.0, axle, side * AXLE_SENSORS_M) for axle in (1, 2) for side in (1.0, -1.0)]
    return tuple(
        WideSensor(
            f"{on}_{k}",
            on,
            position,
            axle,
            lateral,
            gain_error=float(
                (1.0 + drawn.channels.common_gain) * (1.0 + sensor.gain_spread * errors[0, k]) - 1.0
            ),
            delay_s=float(sensor.delay_spread_s * errors[1, k - k % 2]),
            bias_m_per_s2=float(bias * errors[2, k]),
        )
        for k, (on, position, axle, lateral) in enumerate(places)
    )


def _plain(car: HalfCar, beam: Beam) -> tuple[HalfCar, Beam]:
    """Return truck and beam without effects that a prior may have drawn."""
    return car._replace(tyre_damping_ns_per_m=(0.0, 0.0)), beam._replace(
        support_rotational_stiffness_nm_per_rad=(0.0, 0.0), support_compliance_m_per_n=(0.0, 0.0)
    )


def _pair(values: Floats) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def continuous(bridge: Bridge, spans_m: Floats) -> Bridge:
    """Return the bridge over these spans, from the same start in the same direction."""
    lengths = np.round(spans_m, 2)
    total = float(lengths.sum().round(2))
    latitude, longitude = to_lat_lon(bridge_frame(bridge), np.array([total]), np.zeros(1))
    changed = {
        "span_m": total,
        "interior_supports_m": tuple(np.cumsum(lengths)[:-1].round(2).tolist()),
        "elements": (4 if lengths.size == 2 else 3) * lengths.size,
        "element_lengths_m": None,
        "flexural_rigidity_nm2": float(np.mean(bridge.nominal_flexural_rigidity_nm2)),
        "flexural_rigidity_per_element_nm2": None,
        "end_latitude_deg": float(latitude[0]),
        "end_longitude_deg": float(longitude[0]),
    }
    return Bridge.model_validate(bridge.model_dump() | changed)
