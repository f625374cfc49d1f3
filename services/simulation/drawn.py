"""Crossings whose truth is drawn from the priors of a site, identified and compared with it.

If a method's intervals are true, then over many such crossings their coverage is nominal
(simulation-based calibration). So every parameter of the method is drawn from its prior: truck and
tyres, rigidity of every element, mass per length, damping, rotational restraint and bearing
compliance (both may be absent), wheelbase, gains and delays of the channels, the receiver's errors,
and also the total mass and the common sensor gain, which no residual shows. Nothing is truncated.
The bridge is at rest before the crossing. The rest varies as drives vary: road, speed, direction,
rates, noise density.

The truth is computed by the simulation of `services.simulation.drive` (ten finite elements in each
element, 40 modes, steps of at most 0.1 ms), measured, put into messages and fed to the worker's
finder: the identification gets what it would get from a recording.
"""

import time
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from pre_core import parameters
from pre_core.physics.bridge import Beam
from pre_core.physics.road import Profile
from pre_core.physics.sensors import Accelerometer
from pre_core.physics.simulate import Motion
from pre_core.physics.vehicle import HalfCar
from schemas.reasons import Reason
from schemas.results import CrossingResult
from schemas.settings import IdentificationSettings
from schemas.site import Bridge, Site, Vehicle
from services.common.arrays import Floats
from services.drives.runs import Run, run_to_messages
from services.finding.crossing_data import CrossingData
from services.finding.finder import crossings_in
from services.identification.identify import Identify, identify
from services.identification.methods import window_of
from services.identification.pre_method import absence
from services.simulation.drive import (
    LONGEST_STEP_S,
    SETTLE_S,
    TRUCK_KEYS,
    DepartedVehicle,
    DrivenRoad,
    beam_of,
    declared_site,
    half_car,
    measured_run,
    with_two_axles,
)
from services.simulation.positions import Instruments, TimedMotion, receiver_of
from services.simulation.wheel_paths import WheelPaths

REALM = "sim-calibration"
_BEFORE_S, _AFTER_S = 4.0, 3.5
"""Duration of a recording before the entry, and after the exit."""

_ROADS = ("A", "B")
_SPEED_M_PER_S = (5.0, 25.0)
_NOISE_UG = (25.0, 100.0)
_RATES_HZ = (1000.0, 500.0, 200.0, 2000.0)
_RATE_SHARES = (0.6, 0.15, 0.15, 0.1)
_FIX_RATES_HZ = (10.0, 1.0)
_FIX_RATE_SHARES = (0.7, 0.3)
_BIAS_M_PER_S2 = 0.03
"""Standard deviation of a channel's offset, 3 mg: a MEMS sensor after a change of temperature."""
_CHANGING_SHARE = 0.4
"""Share of crossings that accelerate and brake by up to 1 m/s²; the others are driven steadily, and
so are all where the height of the centre of gravity is unknown."""
_STEADY_M_PER_S2, _CHANGING_M_PER_S2 = (0.0, 0.1), (0.1, 1.0)
_PERIOD_S = (6.0, 16.0)
_LARGEST_CHANGE = 0.3
"""Largest relative change of speed in either direction."""


_DRAWN_FIRST: Final = (
    "unsprung_mass_kg",
    "total_mass_kg",
    "front_axle_to_cg_m",
    "wheelbase_m",
    "suspension_damping_ns_per_m",
    "suspension_stiffness_n_per_m",
    "tyre_stiffness_n_per_m",
    "pitch_inertia_ratio",
    "cg_height_m",
)
"""Quantities of a truck in the order of their draws, on which the truth of a seed depends."""
_DRAWN_LAST: Final = tuple(key for key in TRUCK_KEYS if key not in _DRAWN_FIRST)
"""Those that may be zero, and any later row of the parameter table."""


class DriveConditions(NamedTuple):
    """Driving and measuring conditions, which an owner knows or does not need."""

    road_class: str
    road_seed: int
    speed_m_per_s: float
    """Speed at the entry; it changes as a sine of `change_m_per_s` and `period_s` from `phase` on.
    """
    change_m_per_s: float
    period_s: float
    phase: float
    forward: bool
    rate_hz: float
    fix_rate_hz: float
    noise_ug_per_rthz: float
    body_noise_ug_per_rthz: float | None = None
    """Noise of the two body sensors, if they are of another kind than those of the axles."""

    @property
    def densities_ug_per_rthz(self) -> tuple[float, float, float, float]:
        """Noise of the four channels."""
        axles, body = self.noise_ug_per_rthz, self.body_noise_ug_per_rthz
        body = axles if body is None else body
        return body, body, axles, axles


class ChannelErrors(NamedTuple):
    """Errors of the four channels, (4,) each; `common` is that of all gains."""

    common_gain: float
    gain: Floats
    delay_s: Floats
    bias_m_per_s2: Floats


class CrossingTruth(NamedTuple):
    """The truth of one crossing."""

    car: HalfCar
    beam: Beam
    channels: ChannelErrors
    latency_s: float
    conditions: DriveConditions
    departed: DepartedVehicle | None = None
    """Vehicle on the bridge before."""
    paths: WheelPaths | None = None
    """Wheel paths on a 2-D road surface; None: both axles follow one profile."""


class SimulatedCrossing(NamedTuple):
    """One recorded crossing with its truth."""

    truth: CrossingTruth
    run: Run
    site: Site
    """Declared site: nominal values and noise density."""
    motion: Motion
    start_s: float
    """Time of the first position of `motion` on the clock of `run`."""
    step_s: float
    road: Profile
    """Profile under the tyres; on a surface, the front tyres."""
    largest_deflection_m: float


class IdentifiedCrossing(NamedTuple):
    """The result of a crossing, and its data."""

    result: CrossingResult
    data: CrossingData
    settings: IdentificationSettings
    draws: dict[str, Floats] | None = None
    """Posterior draws (n,) by the names of docs/contract.md; None where a method has none."""


def draw_truth(site: Site, seed: int, mass_score: float | None = None) -> CrossingTruth:
    """Draw everything that the site's priors and the conditions above leave open.

    `mass_score`, where given, is the standard score of the total mass, which is then not drawn.
    """
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x7247]))
    vehicle, bridge = site.vehicles[0], site.bridges[0]

    def log_normal(nominal: float, spread: float) -> float:
        return float(nominal * np.exp(spread * rng.standard_normal()))

    def of_truck(key: str) -> Any:
        drawn = tuple(log_normal(value, vehicle.spread(key)) for value in vehicle.nominal(key))
        return drawn if len(drawn) > 1 else drawn[0]

    known = [key for key in _DRAWN_FIRST if getattr(vehicle, key) is not None]
    values = {key: of_truck(key) for key in known}
    if mass_score is not None:
        spread = vehicle.spread("total_mass_kg")
        values["total_mass_kg"] = vehicle.total_mass_kg * float(np.exp(spread * mass_score))
    ei_spread = bridge.spread("flexural_rigidity_nm2")
    ratios = np.exp(ei_spread * rng.standard_normal(bridge.elements))
    beam = beam_of(bridge, ratios)
    key = "mass_per_length_kg_per_m"
    mass_per_length = log_normal(bridge.mass_per_length_kg_per_m, bridge.spread(key))
    springs = np.abs(rng.standard_normal(2))
    beam = beam._replace(
        mass_per_length_kg_per_m=np.full(bridge.elements, mass_per_length),
        rayleigh_alpha_per_s=log_normal(
            bridge.rayleigh_alpha_per_s, bridge.spread("rayleigh_alpha_per_s")
        ),
        rayleigh_beta_s=log_normal(bridge.rayleigh_beta_s, bridge.spread("rayleigh_beta_s")),
    )
    channels = ChannelErrors(
        float(site.sensor.common_gain_spread * rng.standard_normal()),
        site.sensor.gain_spread * rng.standard_normal(4),
        site.sensor.delay_spread_s * rng.standard_normal(4),
        _BIAS_M_PER_S2 * rng.standard_normal(4),
    )
    receiver = site.receiver
    latency = receiver.latency_s + receiver.latency_spread_s * float(rng.standard_normal())
    conditions = _draw_conditions(vehicle, rng)
    compliances = np.abs(rng.standard_normal(2))
    sizes = {key: np.abs(rng.standard_normal(len(vehicle.nominal(key)))) for key in _DRAWN_LAST}
    beam = _with_supports(beam, bridge, springs, compliances, rng)
    for key, at_zero in sizes.items():
        scale = vehicle.scale_at_zero(key)
        drawn = tuple(
            log_normal(value, vehicle.spread(key)) if value else float(scale * size)
            for value, size in zip(vehicle.nominal(key), at_zero, strict=True)
        )
        values[key] = drawn if len(drawn) > 1 else drawn[0]
    mass_kg, wheelbase_m = values.pop("total_mass_kg"), values.pop("wheelbase_m")
    car = half_car(values, mass_kg, wheelbase_m, values.pop("cg_height_m", None))
    return CrossingTruth(car, beam, channels, latency, conditions)


def _with_supports(
    beam: Beam, bridge: Bridge, springs: Floats, compliances: Floats, rng: np.random.Generator
) -> Beam:
    """Return a beam with restraints and compliances of both ends, each of which may be absent."""

    def at_end(place: int, size: float) -> float:
        row = parameters.SCALARS[place]
        is_absent = rng.uniform() < absence(bridge, row)
        return 0.0 if is_absent else float(size * bridge.scale_at_zero(row.key))

    return beam._replace(
        support_rotational_stiffness_nm_per_rad=(
            at_end(parameters.K_ROT, springs[0]),
            at_end(parameters.K_ROT + 1, springs[1]),
        ),
        support_compliance_m_per_n=(
            at_end(parameters.F, compliances[0]),
            at_end(parameters.F + 1, compliances[1]),
        ),
    )


def _draw_conditions(vehicle: Vehicle, rng: np.random.Generator) -> DriveConditions:
    speed = rng.uniform(*_SPEED_M_PER_S)
    changing = vehicle.cg_height_m is not None and rng.uniform() < _CHANGING_SHARE
    acceleration = rng.uniform(*(_CHANGING_M_PER_S2 if changing else _STEADY_M_PER_S2))
    period = rng.uniform(*_PERIOD_S)
    return DriveConditions(
        road_class=str(rng.choice(_ROADS)),
        road_seed=int(rng.integers(1 << 31)),
        speed_m_per_s=float(speed),
        change_m_per_s=float(min(acceleration * period / (2.0 * np.pi), _LARGEST_CHANGE * speed)),
        period_s=float(period),
        phase=float(rng.uniform(0.0, 2.0 * np.pi)),
        forward=bool(rng.uniform() < 0.5),
        rate_hz=float(rng.choice(_RATES_HZ, p=_RATE_SHARES)),
        fix_rate_hz=float(rng.choice(_FIX_RATES_HZ, p=_FIX_RATE_SHARES)),
        noise_ug_per_rthz=float(np.exp(rng.uniform(*np.log(_NOISE_UG)))),
    )


def drive(
    site: Site,
    truth: CrossingTruth,
    seed: int,
    *,
    noise_ug_per_rthz: tuple[float, float, float, float] | None = None,
) -> SimulatedCrossing:
    """Simulate and measure one crossing; `seed` is that of noise and receiver.

    The noise is that of the conditions, unless that of each channel is given.
    """
    bridge, how = site.bridges[0], truth.conditions
    every = max(1, int(np.ceil(1.0 / (how.rate_hz * LONGEST_STEP_S))))
    step_s = 1.0 / (how.rate_hz * every)
    settling = round(SETTLE_S * how.rate_hz) * every
    densities = noise_ug_per_rthz or how.densities_ug_per_rthz
    motion = motion_of(truth, bridge, step_s, every)
    run, roads, happened = measured_run(
        bridge,
        truth.car,
        truth.beam,
        TimedMotion(motion, step_s, settling),
        DrivenRoad(how.road_class, how.road_seed, truth.paths),
        instruments_of(site, truth, densities, seed),
        truth.departed,
    )
    return SimulatedCrossing(
        truth,
        run,
        declared_site(site, densities, how.rate_hz),
        motion,
        float(run.accel_time_s[0]) - settling * step_s,
        step_s,
        roads.front,
        float(-happened.wheel_deflection_m.min()),
    )


def instruments_of(
    site: Site, truth: CrossingTruth, densities: Sequence[float], seed: int
) -> Instruments:
    """Return the accelerometers of the four channels and the receiver, with their errors."""
    errors, vehicle = truth.channels, with_two_axles(site.vehicles[0])
    sensors = [
        Accelerometer(
            truth.conditions.rate_hz,
            noise_density_ug_per_rthz=densities[c],
            bias_m_per_s2=float(errors.bias_m_per_s2[c]),
            gain_error=float((1.0 + errors.common_gain) * (1.0 + errors.gain[c]) - 1.0),
            delay_s=float(errors.delay_s[c]),
        )
        for c in range(4)
    ]
    receiver = receiver_of(site, perfect=False)._replace(
        rate_hz=truth.conditions.fix_rate_hz, latency_s=truth.latency_s
    )
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x6E]))
    return Instruments(sensors, receiver, rng, vehicle.gps_antenna_to_front_axle_m)


def motion_of(truth: CrossingTruth, bridge: Bridge, step_s: float, every: int) -> Motion:
    """Return the motion from `SETTLE_S` + `_BEFORE_S` before entry to `_AFTER_S` after exit."""
    how, car = truth.conditions, truth.car
    omega = 2.0 * np.pi / how.period_s
    # At the entry, t = 0, the speed is that of the conditions.
    level = how.speed_m_per_s - how.change_m_per_s * np.sin(how.phase)
    slowest = level - how.change_m_per_s
    longest = (bridge.span_m + car.wheelbase_m) / slowest
    before = SETTLE_S + _BEFORE_S
    # Whole sampling intervals, so that the recording begins with a sample.
    first = -round(before / (step_s * every)) * every
    time_s = step_s * np.arange(first, round((longest + _AFTER_S) / step_s) + 1)
    phase = omega * time_s + how.phase
    swing = how.change_m_per_s / omega
    travel = level * time_s - swing * (np.cos(phase) - np.cos(how.phase))
    speed = level + how.change_m_per_s * np.sin(phase)
    acceleration = how.change_m_per_s * omega * np.cos(phase)
    left = int(np.searchsorted(travel, bridge.span_m + car.wheelbase_m))
    stop = min(left + round(_AFTER_S / (step_s * every)) * every, time_s.size)
    sign = 1.0 if how.forward else -1.0
    position = travel if how.forward else bridge.span_m - travel
    return Motion(position[:stop], sign * speed[:stop], acceleration[:stop])


def identify_simulated(
    runs: list[Run],
    site: Site,
    settings: IdentificationSettings,
    identify: Identify = identify,
) -> list[IdentifiedCrossing]:
    """Identify all crossings of the site's first truck, as from a recording.

    A bridge drawn from the prior may have implausible elements, which do not count against the
    crossing.
    """
    draws: dict[str, dict[str, Floats]] = {}
    messages = run_to_messages(runs, site, REALM, site.vehicles[0].id)
    pairs = ((message.key, message.payload) for message in messages)
    found = []
    for data in crossings_in(pairs, site, window_of(settings.method)):
        result = identify(data, settings, stopwatch=time.perf_counter, keep=draws.__setitem__)
        kept = _flat(draws.get(data.crossing_id))
        found.append(IdentifiedCrossing(of_any_bridge(result), data, settings, kept))
    return found


def of_any_bridge(result: CrossingResult) -> CrossingResult:
    """Return the result without the reason that its bridge is implausible."""
    kept = [k for k, code in enumerate(result.reasons) if code != Reason.IMPLAUSIBLE_BRIDGE]
    if len(kept) == len(result.reasons):
        return result
    return result.model_copy(
        update={
            "verdict": result.verdict if kept else "good",
            "reasons": tuple(result.reasons[k] for k in kept),
            "reason_texts": tuple(result.reason_texts[k] for k in kept),
        }
    )


def _flat(draws: dict[str, Floats] | None) -> dict[str, Floats] | None:
    return None if draws is None else {name: values.ravel() for name, values in draws.items()}
