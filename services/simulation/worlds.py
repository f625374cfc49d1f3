"""Crossings with more physics than a method's model has, drawn from ranges that are no priors.

Truck, rigidities, sensors, receiver and conditions are those of `drawn.draw_truth`. The bearings
of its bridge are made free and rigid and its tyres undamped; then one effect is added, or all. The
same seed gives the same truck and drive under every effect, but of "spans", whose bridge differs.

What is drawn, uniformly unless said:

- sprung: each end turns against a spring of 0.1 to 3 EI/span;
- sinking: each end stands on 1e9 to 2e10 N/m (log-uniform);
- swing: a lorry of 10 to 40 t left 0.05 to 2 s before, at 10 to 25 m/s, either way;
- tyres: damping of 300 to 2000 N s/m each;
- friction: 2 to 10 % of the load of the springs within 1 to 4 mm, every other time growing in
  proportion to the load; body sensors of 2.5 to 25 µg/√Hz (log-uniform);
- bilinear: dampers 5 to 30 % stronger in rebound and weaker in compression;
- air: springs of air with an exponent of 1.2 to 1.4;
- spans: two to five of 12 to 25 m, with eight elements for two, else three for each on average;
- surface: the road is a random surface under single tyres in front and twin tyres behind, unless
  the site says which (`wheel_paths`); the rear axle runs 0 to 10 mm beside the front, the truck
  0.12 m from the line (standard deviation);
- everything: all of these but the surface, each end sprung and the bridge continuous every other
  time.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.physics.bridge import Beam
from pre_core.physics.vehicle import HalfCar
from schemas.site import Bridge, Site
from services.common.geodesy import bridge_frame, to_lat_lon
from services.simulation.drawn import Truth, draw_truth
from services.simulation.drive import Beyond, Left, with_beyond
from services.simulation.wheel_paths import OnSurface, wheel_paths_of

Floats = NDArray[np.float64]

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
WANDER_M = 0.12

EVERYTHING = "everything"
SURFACE = "surface"
"""Not a part of everything, whose answers on such a road would say little of the rest."""
AMONG_ALL = ("free", "sprung", "sinking", "swing", "tyres", "friction", "bilinear", "air", "spans")
ALONE = (*AMONG_ALL, SURFACE)
EFFECTS = (*ALONE, EVERYTHING)


class World(NamedTuple):
    """The truth of a crossing with an effect, and the site that its owner would declare."""

    truth: Truth
    site: Site
    """Nominal values; noise apart. Of continuous bridges, with the supports."""
    beyond: Beyond


def draw_world(site: Site, effect: str, seed: int) -> World:
    """Draw a crossing of one of EFFECTS; ValueError for any other."""
    if effect not in EFFECTS:
        raise ValueError(f"{effect} is none of {', '.join(EFFECTS)}")
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x3D0B]))
    # Everything is drawn every time, so that an effect is the same alone and among all.
    every_other = rng.uniform(size=4) < 0.5
    springs = rng.uniform(*SPRUNG_EI_PER_SPAN, 2)
    softest, hardest = BEARINGS_N_PER_M
    bearings = softest * (hardest / softest) ** rng.uniform(size=2)
    way = 1.0 if rng.uniform() < 0.5 else -1.0
    left = Left(
        float(rng.uniform(*LORRY_KG) * STANDARD_GRAVITY_M_PER_S2),
        float(way * rng.uniform(*LORRY_M_PER_S)),
        float(rng.uniform(*LEFT_S)),
    )
    tyres = rng.uniform(*TYRE_DAMPING_NS_PER_M, 2)
    share, length = float(rng.uniform(*FRICTION_SHARE)), float(rng.uniform(*FRICTION_LENGTH_M))
    quiet, loud = BODY_NOISE_UG
    body_noise = float(quiet * (loud / quiet) ** rng.uniform())
    bilinear, air = float(rng.uniform(*BILINEAR)), float(rng.uniform(*AIR_EXPONENT))
    spans = rng.uniform(*SPAN_M, int(rng.integers(SPANS[0], SPANS[1] + 1)))
    rear_offset = float(rng.uniform(*REAR_OFFSET_M))

    alone = effect != EVERYTHING

    def has(name: str) -> bool:
        return effect == name or (not alone and name in AMONG_ALL)

    if effect == "spans" or (not alone and every_other[0]):
        site = site.model_copy(update={"bridges": (continuous(site.bridges[0], spans),)})
    drawn = draw_truth(site, seed)
    scale = site.bridges[0].support_rotational_stiffness_nm_per_rad_scale_at_zero
    sprung = [has("sprung") and (alone or bool(other)) for other in every_other[1:3]]
    beyond = Beyond(
        _pair(springs * scale * sprung),
        _pair(1.0 / bearings if has("sinking") else np.zeros(2)),
        left if has("swing") else None,
        share if has("friction") else 0.0,
        1.0 if has("friction") and every_other[3] else 0.0,
        bilinear if has("bilinear") else 0.0,
        air if has("air") else 0.0,
    )
    car, beam = _plain(drawn.car, drawn.beam)
    if has("tyres"):
        car = car._replace(tyre_damping_ns_per_m=_pair(tyres))
    car, beam = with_beyond(car._replace(friction_length_m=length), beam, beyond)
    conditions = drawn.conditions
    if has("friction"):
        conditions = conditions._replace(body_noise_ug_per_rthz=body_noise)
    paths = None
    if has(SURFACE):
        vehicle = site.vehicles[0]
        unknown = vehicle.rear_axle_offset_m is None
        paths = wheel_paths_of(vehicle, OnSurface(None, rear_offset if unknown else None, WANDER_M))
    truth = drawn._replace(car=car, beam=beam, conditions=conditions, left=beyond.left, paths=paths)
    return World(truth, site, beyond)


def _plain(car: HalfCar, beam: Beam) -> tuple[HalfCar, Beam]:
    """Without what a prior may have drawn of the effects."""
    return car._replace(tyre_damping_ns_per_m=(0.0, 0.0)), beam._replace(
        support_rotational_stiffness_nm_per_rad=(0.0, 0.0), support_compliance_m_per_n=(0.0, 0.0)
    )


def _pair(values: Floats) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def continuous(bridge: Bridge, spans_m: Floats) -> Bridge:
    """The bridge over these spans, from the same start in the same direction."""
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
