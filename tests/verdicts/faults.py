"""Crossings with something wrong: in the truck, on the bridge, in the sensors or in the site file.

The truth is what `simulation.drive` drives (a mesh ten times finer than the elements, 40 modes,
steps of 0.1 ms) and a little more: dampers that are not linear, wheels on different roads, a second
vehicle. Then the sensors, what breaks in them, and the site file that the owner believes in.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.physics import simulate as forward
from pre_core.physics.bridge import refine
from pre_core.physics.road import WheelRoad, contact_patch_average, iso_8608_profile, under_wheels
from pre_core.physics.sensors import (
    Accelerometer,
    ReceiverModel,
    measure_acceleration,
    measure_position,
)
from pre_core.physics.simulate import Discretisation
from pre_core.physics.vehicle import HalfCar
from schemas.results import BridgeResult, CrossingResult, ResultHeader
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS, AccelChannel, decode_accel, encode_accel
from schemas.site import Bridge, Site, Vehicle
from schemas.site_file import site_hash
from schemas.topics import Message
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, heading_deg, to_lat_lon
from services.drives.runs import GnssTrack, Run, run_to_messages
from services.identification.engine import Engine
from services.simulation.drive import START_TIME_S, beam_of, declared_site, paper_site, truck_of
from tests.working_engine import feed_all, unhurried

Channels = dict[str, Floats]

_PARTS, _MODES = 10, 40
_SETTLE_S, _AFTER_S = 3.0, 2.5
_FIX_RATE_HZ = 10.0
S1, S2, U1, U2 = CHANNELS


class Truth(NamedTuple):
    """What is driven; the defaults are the paper's truck and scenario 6 with good MEMS sensors."""

    site: Site = paper_site()
    """The true truck and the true sound bridge."""
    ratios: tuple[float, ...] = (1.0, 1.0, 1.0, 0.4, 1.0, 1.0, 1.0)
    road_class: str = "A"
    seed: int = 1
    speed_m_per_s: tuple[float, float] = (10.0, 10.0)
    forward: bool = True
    rate_hz: float = 1000.0
    noise_ug_per_rthz: float = 25.0
    before_s: float = 3.0
    """From the beginning of the recording to the entry."""


class Fault(NamedTuple):
    """What is wrong; the default is nothing."""

    car: Callable[[HalfCar], HalfCar] = lambda car: car
    rear_road: float = 1.0
    """The rear wheels' road over the front wheels'."""
    second_vehicle_kg: float = 0.0
    noise: float = 1.0
    """True over declared."""
    sensor: dict[str, Any] = {}  # noqa: RUF012 - of pre_core.physics.sensors.Accelerometer, never changed
    channels: Callable[[Channels, Floats], Channels] = lambda channels, time_s: channels
    """What becomes of the samples; times are seconds since the front axle's entry."""
    kept: Callable[[Floats], NDArray[np.bool_]] = lambda time_s: np.ones(time_s.shape, dtype=bool)
    """Which samples are not lost."""
    jitter_s: float = 0.0
    slow: str | None = None
    """A channel that is sampled at 100 Hz."""
    speeds: float = 1.0
    """The receiver's speeds over the true ones."""
    outage_s: tuple[float, float] | None = None
    """No fixes between these times since the entry."""
    site: Callable[[Site], Site] = lambda site: site
    """What the owner believes."""


class Case(NamedTuple):
    """A crossing as it is recorded, and what was true."""

    run: Run
    messages: list[Message]
    site: Site
    """What the owner believes."""
    rigidity_nm2: Floats
    entry_s: float
    exit_s: float
    """Front axle on and rear axle off, since 1970."""


def identified(case: Case, settings: IdentificationSettings | None = None) -> CrossingResult:
    """The one result of a case."""
    chosen = settings or IdentificationSettings(method="pre", seed=0)
    header = ResultHeader(
        "0", 0.0, site_hash(case.site), chosen.model_dump(mode="json"), chosen.seed
    )
    pairs = ((m.key, m.payload) for m in case.messages)
    outputs = list(feed_all(Engine(case.site, chosen, header), unhurried(), pairs))
    (result,) = [output.result for output in outputs if output.result is not None]
    return result


def z_scores(case: Case, result: CrossingResult) -> Floats:
    """Error of every EI in its standard deviations."""
    return errors_of(result, case.rigidity_nm2)


def errors_of(result: CrossingResult | BridgeResult, truth_nm2: Floats) -> Floats:
    """Error of every EI (n,) in its standard deviations."""
    found = result.elements if isinstance(result, BridgeResult) else result.parameters
    assert found, result.reasons
    elements = [found[f"EI_{e + 1}"] for e in range(truth_nm2.size)]
    return np.array([(p.mean - t) / p.std for p, t in zip(elements, truth_nm2, strict=True)])


NOTHING = Fault()


def crossing(truth: Truth, fault: Fault = NOTHING) -> Case:
    """Drive the truth with the fault and record it."""
    site = truth.site
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    car, beam = (
        fault.car(truck_of(vehicle)),
        refine(beam_of(bridge, np.array(truth.ratios)), _PARTS),
    )
    every = max(1, round(1.0 / (truth.rate_hz * 1e-4)))
    fine_hz = truth.rate_hz * every
    motion = _motion(truth, vehicle, bridge, fine_hz)
    settle = round(_SETTLE_S * truth.rate_hz) * every
    sign = 1 if truth.forward else -1
    road = _road(truth, fault, motion, car, sign)
    if fault.second_vehicle_kg > 0.0:
        road = _with_second_vehicle(truth, fault, motion, road, beam, fine_hz, settle)
    modes = min(_MODES, 2 * bridge.elements * _PARTS)
    done = forward.simulate(car, beam, motion, road, Discretisation(1.0 / fine_hz, modes))
    assert done.converged
    acceleration = done.acceleration_m_per_s2[settle:]
    accel_rng, gnss_rng, fault_rng = np.random.default_rng(truth.seed + 7919).spawn(3)
    accelerometer = Accelerometer(
        truth.rate_hz, noise_density_ug_per_rthz=truth.noise_ug_per_rthz * fault.noise
    )._replace(**fault.sensor)
    channels = {
        name: measure_acceleration(acceleration[:, i], fine_hz, accelerometer, accel_rng)
        for i, name in enumerate(CHANNELS)
    }
    time_s = np.arange(channels[S1].size) / truth.rate_hz
    position, speed = motion.position_m[settle:], np.abs(motion.speed_m_per_s[settle:])
    clock = np.arange(position.size) / fine_hz
    near, far = (0.0, bridge.span_m) if truth.forward else (bridge.span_m, 0.0)
    entry = float(np.interp(0.0, sign * (position - near), clock))
    exit_ = float(np.interp(0.0, sign * (position - far) - car.wheelbase_m, clock))
    channels = fault.channels(channels, time_s - entry)
    kept = fault.kept(time_s - entry)
    stamps = START_TIME_S + time_s + fault.jitter_s * fault_rng.standard_normal(time_s.size)
    outages = (
        () if fault.outage_s is None else ((entry + fault.outage_s[0], entry + fault.outage_s[1]),)
    )
    gnss = _fixes(truth, clock, position, speed, outages, gnss_rng)
    gnss = gnss._replace(speed_m_per_s=fault.speeds * gnss.speed_m_per_s)
    run = Run(
        "simulation",
        stamps[kept],
        truth.rate_hz,
        {name: values[kept] for name, values in channels.items()},
        gnss,
    )
    believed = fault.site(declared_site(site, truth.noise_ug_per_rthz, truth.rate_hz))
    messages = list(run_to_messages([run], believed, "sim-fault", believed.vehicles[0].id))
    if fault.slow is not None:
        slow = accelerometer._replace(rate_hz=100.0)
        column = acceleration[:, CHANNELS.index(fault.slow)]
        samples = measure_acceleration(column, fine_hz, slow, fault_rng)
        messages = _with_slow_channel(messages, fault.slow, samples, truth.rate_hz)
    rigidity = np.array(bridge.nominal_flexural_rigidity_nm2) * np.array(truth.ratios)
    return Case(run, messages, believed, rigidity, START_TIME_S + entry, START_TIME_S + exit_)


def _motion(truth: Truth, vehicle: Vehicle, bridge: Bridge, fine_hz: float) -> forward.Motion:
    begin, end = truth.speed_m_per_s
    driven_s = truth.before_s + _AFTER_S
    driven_s += (bridge.span_m + vehicle.wheelbase_m) / (0.5 * (begin + end))
    acceleration = (end - begin) / driven_s
    first = begin - acceleration * _SETTLE_S
    approach = (truth.before_s + _SETTLE_S) * first
    approach += 0.5 * acceleration * (truth.before_s + _SETTLE_S) ** 2
    steps = int(np.ceil((_SETTLE_S + driven_s) * fine_hz)) + 1
    sign = 1 if truth.forward else -1
    start = -approach if truth.forward else bridge.span_m + approach
    return forward.constant_acceleration(start, sign * first, acceleration, steps, 1.0 / fine_hz)


def _road(truth: Truth, fault: Fault, motion: forward.Motion, car: HalfCar, sign: int) -> WheelRoad:
    reach = car.wheelbase_m + 1.0
    low = np.floor(motion.position_m.min() - reach)
    high = np.ceil(motion.position_m.max() + reach)
    raw = iso_8608_profile(low, high, 0.01, truth.road_class, truth.seed)
    felt = under_wheels(contact_patch_average(raw, 0.2), motion, car.wheelbase_m, sign)
    scale = np.array([1.0, fault.rear_road])
    return WheelRoad(felt.height_m * scale, felt.rate_m_per_s * scale)


def _with_second_vehicle(
    truth: Truth,
    fault: Fault,
    motion: forward.Motion,
    road: WheelRoad,
    beam: Any,
    fine_hz: float,
    settle: int,
) -> WheelRoad:
    """The bridge sinks under another vehicle too, which comes the other way and meets the truck.

    The bridge is linear: what the other vehicle adds to its deflection is added to the road that
    the truck's wheels feel. What the truck does to the other vehicle is left out.
    """
    scale = fault.second_vehicle_kg / 9530.0
    nominal = truck_of(truth.site.vehicles[0])
    other = nominal._replace(
        body_mass_kg=fault.second_vehicle_kg - scale * sum(nominal.unsprung_mass_kg),
        unsprung_mass_kg=tuple(scale * m for m in nominal.unsprung_mass_kg),
        suspension_stiffness_n_per_m=tuple(scale * k for k in nominal.suspension_stiffness_n_per_m),
        suspension_damping_ns_per_m=tuple(scale * c for c in nominal.suspension_damping_ns_per_m),
        tyre_stiffness_n_per_m=tuple(scale * k for k in nominal.tyre_stiffness_n_per_m),
        wheelbase_m=3.0,
        front_axle_to_cg_m=1.4,
    )
    span = float(beam.element_lengths_m.sum())
    sign = 1.0 if truth.forward else -1.0
    # It meets the truck a little past the middle.
    meet = int(np.argmin(np.abs(motion.position_m - span * (0.5 + 0.1 * sign))))
    steps = motion.position_m.size
    speed = -sign * 12.0
    start = motion.position_m[meet] - speed * meet / fine_hz
    own = forward.constant_speed(start, speed, steps, 1.0 / fine_hz)
    low, high = np.floor(own.position_m.min() - 5.0), np.ceil(own.position_m.max() + 5.0)
    raw = iso_8608_profile(low, high, 0.01, truth.road_class, truth.seed + 1)
    felt = under_wheels(contact_patch_average(raw, 0.2), own, other.wheelbase_m, int(-sign))
    run = forward.simulate(other, beam, own, felt, Discretisation(1.0 / fine_hz, _MODES))
    x = np.linspace(0.0, span, 61)
    deflection = forward.deflection_m(beam, run, x)
    front = motion.position_m
    rear = front - sign * truth.site.vehicles[0].wheelbase_m
    added = np.stack([_at(deflection, x, front), _at(deflection, x, rear)], axis=1)
    return WheelRoad(
        road.height_m + added, road.rate_m_per_s + np.gradient(added, 1.0 / fine_hz, axis=0)
    )


def _at(deflection_m: Floats, x_m: Floats, place_m: Floats) -> Floats:
    """Deflections (n, m) at chainages (m,), cubically at one place a row (n,); zero beside them."""
    from scipy.interpolate import CubicSpline

    out = np.zeros(place_m.size)
    on = np.flatnonzero((place_m > x_m[0]) & (place_m < x_m[-1]))
    for block in np.array_split(on, max(1, on.size // 5000)):
        spline = CubicSpline(x_m, deflection_m[block], axis=1)
        cell = np.clip(np.searchsorted(x_m, place_m[block]) - 1, 0, x_m.size - 2)
        s = place_m[block] - x_m[cell]
        c = spline.c[:, cell, np.arange(block.size)]
        out[block] = ((c[0] * s + c[1]) * s + c[2]) * s + c[3]
    return out


def _fixes(
    truth: Truth,
    time_s: Floats,
    position: Floats,
    speed: Floats,
    outages: tuple[tuple[float, float], ...],
    rng: np.random.Generator,
) -> GnssTrack:
    errors = truth.site.receiver
    receiver = ReceiverModel(
        _FIX_RATE_HZ,
        position_noise_m=errors.position_noise_m,
        position_spread_m=errors.position_spread_m,
        correlation_s=300.0,
        speed_noise_m_per_s=errors.speed_noise_m_per_s,
        outages_s=outages,
    )
    sign = 1 if truth.forward else -1
    antenna = position - sign * truth.site.vehicles[0].gps_antenna_to_front_axle_m
    fixes = measure_position(time_s, antenna, np.zeros_like(antenna), speed, receiver, rng)
    frame = bridge_frame(truth.site.bridges[0])
    latitude, longitude = to_lat_lon(frame, fixes.chainage_m, fixes.lateral_m)
    heading = heading_deg(frame, start_to_end=truth.forward)
    return GnssTrack(
        START_TIME_S + fixes.time_s,
        latitude,
        longitude,
        np.full(latitude.size, 25.0),
        fixes.speed_m_per_s,
        np.full(latitude.size, heading),
    )


def _with_slow_channel(
    messages: list[Message], name: str, samples: Floats, rate_hz: float
) -> list[Message]:
    out, taken = [], 0
    for message in messages:
        if message.key.stream == "accel":
            batch = decode_accel(message.payload)
            stop = round((taken + batch.channels[name].samples.size) * 100.0 / rate_hz)
            begin = round(taken * 100.0 / rate_hz)
            taken += batch.channels[name].samples.size
            if stop <= begin:
                continue
            slow = AccelChannel(100.0, samples[begin:stop])
            message = message._replace(
                payload=encode_accel(batch._replace(channels=batch.channels | {name: slow}))
            )
        out.append(message)
    return out


# What breaks in the sensors.


def swapped(a: str, b: str) -> Fault:
    """Two plugs are swapped."""
    return Fault(channels=lambda channels, _: channels | {a: channels[b], b: channels[a]})


def inverted(name: str) -> Fault:
    """A sensor is mounted upside down."""
    return Fault(channels=lambda channels, _: channels | {name: -channels[name]})


def saturated(name: str, share: float = 0.5) -> Fault:
    """A range of half of what the truck does."""

    def clip(channels: Channels, _: Floats) -> Channels:
        end = share * np.abs(channels[name]).max()
        return channels | {name: np.clip(channels[name], -end, end)}

    return Fault(channels=clip)


def stuck(name: str, from_s: float = -np.inf) -> Fault:
    """A sensor repeats one value from some time on."""

    def hold(channels: Channels, time_s: Floats) -> Channels:
        values = channels[name].copy()
        values[time_s >= from_s] = values[np.argmax(time_s >= from_s)]
        return channels | {name: values}

    return Fault(channels=hold)


def frozen(name: str, from_s: float, seconds: float, *, bridged: bool = False) -> Fault:
    """A sensor holds its value for a while; or a line bridges what it did not measure."""

    def hold(channels: Channels, time_s: Floats) -> Channels:
        values = channels[name].copy()
        there = np.flatnonzero((time_s >= from_s) & (time_s < from_s + seconds))
        first, last = values[there[[0, -1]]]
        values[there] = np.linspace(first, last if bridged else first, there.size)
        return channels | {name: values}

    return Fault(channels=hold)


def quantised(channels: Channels, step_m_per_s2: float) -> Channels:
    """A converter with this step, in all channels."""
    return {name: step_m_per_s2 * np.round(v / step_m_per_s2) for name, v in channels.items()}


def slipped(name: str, samples: int, at_s: float) -> Fault:
    """A sensor loses samples at a time since the entry; the later ones move up."""

    def lose(channels: Channels, time_s: Floats) -> Channels:
        values, first = channels[name], int(np.argmax(time_s >= at_s))
        kept = np.delete(values, slice(first, first + samples))
        return channels | {name: np.concatenate([kept, np.repeat(kept[-1:], samples)])}

    return Fault(channels=lose)


def louder(name: str, factor: float, at_s: float) -> Fault:
    """A sensor's gain changes by a factor at a time since the entry."""

    def change(channels: Channels, time_s: Floats) -> Channels:
        return channels | {name: channels[name] * np.where(time_s >= at_s, factor, 1.0)}

    return Fault(channels=change)


def tilted(
    degrees: float, shaking_m_per_s2: float, band_hz: tuple[float, float], seed: int = 0
) -> Fault:
    """All sensors lean, and the truck shakes along or across the road within a band."""

    def lean(channels: Channels, time_s: Floats) -> Channels:
        frequency = np.fft.rfftfreq(time_s.size, time_s[1] - time_s[0])
        spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(time_s.size))
        spectrum[(frequency < band_hz[0]) | (frequency > band_hz[1])] = 0.0
        shaking = np.fft.irfft(spectrum, time_s.size)
        shaking *= shaking_m_per_s2 / shaking.std()
        angle = np.radians(degrees)
        return {k: np.cos(angle) * v + np.sin(angle) * shaking for k, v in channels.items()}

    return Fault(channels=lean)


def alike(channels: Channels, _: Floats) -> Channels:
    """Four channels of one sensor."""
    return dict.fromkeys(channels, channels[U1])


def spiked(name: str, height_m_per_s2: float = 20.0, every_s: float = 0.7) -> Fault:
    """Single samples are disturbed by the ignition, a radio, a loose plug."""

    def disturb(channels: Channels, time_s: Floats) -> Channels:
        values = channels[name].copy()
        step = max(1, round(every_s / (time_s[1] - time_s[0])))
        signs = np.where(np.arange(values[::step].size) % 2, 1.0, -1.0)
        values[::step] += height_m_per_s2 * signs
        return channels | {name: values}

    return Fault(channels=disturb)


def biased(name: str, bias_m_per_s2: float) -> Fault:
    """A sensor with an offset."""
    return Fault(channels=lambda channels, _: channels | {name: channels[name] + bias_m_per_s2})


# What the owner believes.


def vehicle_believed(**changes: Any) -> Callable[[Site], Site]:
    """A site file whose truck has other values."""
    return lambda site: site.model_copy(
        update={"vehicles": (site.vehicles[0].model_copy(update=changes),)}
    )


def span_believed(factor: float) -> Callable[[Site], Site]:
    """A site file whose bridge is longer or shorter by a factor, about its start."""

    def change(site: Site) -> Site:
        bridge = site.bridges[0]
        latitude, longitude = to_lat_lon(bridge_frame(bridge), factor * bridge.span_m, 0.0)
        other = bridge.model_copy(
            update={
                "span_m": factor * bridge.span_m,
                "end_latitude_deg": float(latitude),
                "end_longitude_deg": float(longitude),
            }
        )
        return site.model_copy(update={"bridges": (other,)})

    return change


# Trucks and bridges of other kinds.


def drawn(seed: int) -> Truth:
    """A healthy crossing: another truck, bridge, road, speed, rate, noise for every seed."""
    rng = np.random.default_rng(seed + 12345)

    def around(value: float, spread: float = 0.12) -> float:
        return float(value * np.exp(spread * rng.standard_normal()))

    mass = rng.uniform(6000.0, 26000.0)
    wheelbase = rng.uniform(3.2, 6.5)
    share = rng.uniform(0.25, 0.4) if rng.random() < 0.7 else rng.uniform(0.55, 0.65)  # d_1/D
    size = mass / 9530.0
    body = 0.87 * mass
    front, rear = body * (1.0 - share), body * share
    frequency = rng.uniform(1.1, 2.2, 2)
    damping = rng.uniform(0.12, 0.4, 2)
    stiffness = [m * (2.0 * np.pi * f) ** 2 for m, f in zip((front, rear), frequency, strict=True)]
    viscous = [
        2.0 * z * np.sqrt(k * m) for z, k, m in zip(damping, stiffness, (front, rear), strict=True)
    ]
    paper = paper_site()
    vehicle = paper.vehicles[0].model_copy(
        update={
            "total_mass_kg": mass,
            "wheelbase_m": wheelbase,
            "front_axle_to_cg_m": share * wheelbase,
            "suspension_stiffness_n_per_m": tuple(float(k) for k in stiffness),
            "suspension_damping_ns_per_m": tuple(float(c) for c in viscous),
            "unsprung_mass_kg": (0.05 * mass, 0.08 * mass),
            "tyre_stiffness_n_per_m": (around(4.5e6 * size), around(4.3e6 * size)),
            "pitch_inertia_ratio": around(1.0, 0.1),
            "cg_height_m": float(rng.uniform(0.9, 1.5)),
            "gps_antenna_to_front_axle_m": float(rng.uniform(-1.0, 2.0)),
        }
    )
    span = float(rng.uniform(12.0, 40.0))
    elements = int(rng.integers(3, 12))
    bridge = span_believed(span / 30.0)(paper).bridges[0]
    bridge = bridge.model_copy(
        update={
            "elements": elements,
            "flexural_rigidity_nm2": around(1.56e10 * (span / 30.0) ** 2.5, 0.2),
            "mass_per_length_kg_per_m": around(4400.0, 0.2),
        }
    )
    speed = float(rng.uniform(5.0, 25.0))
    change = float(rng.uniform(-0.25, 0.25)) * min(speed, 8.0) if rng.random() < 0.5 else 0.0
    return Truth(
        paper.model_copy(update={"vehicles": (vehicle,), "bridges": (bridge,)}),
        tuple(float(r) for r in np.exp(0.3 * rng.standard_normal(elements))),
        str(rng.choice(["A", "B", "C"])),
        seed,
        (speed - 0.5 * change, speed + 0.5 * change),
        bool(rng.random() < 0.5),
        float(rng.choice([100.0, 200.0, 500.0, 1000.0, 2000.0])),
        float(rng.choice([5.0, 25.0, 50.0, 100.0])),
    )


def believed_nearly(seed: int) -> Callable[[Site], Site]:
    """A site file whose nominal values are off as data sheets are: by 12 % or so."""
    rng = np.random.default_rng(seed + 54321)

    def nearly(values: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(float(v * np.exp(0.12 * rng.standard_normal())) for v in values)

    def change(site: Site) -> Site:
        truck, bridge = site.vehicles[0], site.bridges[0]
        truck = truck.model_copy(
            update={
                key: nearly(getattr(truck, key))
                for key in (
                    "suspension_damping_ns_per_m",
                    "suspension_stiffness_n_per_m",
                    "unsprung_mass_kg",
                    "tyre_stiffness_n_per_m",
                )
            }
        )
        d_1 = min(nearly((truck.front_axle_to_cg_m,))[0], 0.9 * truck.wheelbase_m)
        truck = truck.model_copy(update={"front_axle_to_cg_m": d_1, "pitch_inertia_ratio": 1.0})
        return site.model_copy(update={"vehicles": (truck,), "bridges": (bridge,)})

    return change
