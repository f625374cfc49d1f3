"""Drives of a half-car and a beam extended to three dimensions: the truth of `two_sided` for a run.

`Width` holds the properties beyond a plane truck and bridge (roll, tracks, torsion, the lane).
Sensors on the centre line, or left and right, become the four channels of every method.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pre_core.physics.bridge import Beam
from pre_core.physics.road import Profile
from pre_core.physics.sensors import Accelerometer, measure_acceleration
from pre_core.physics.simulate import Motion
from pre_core.physics.surface import Footprint
from pre_core.physics.vehicle import HalfCar
from schemas.signals import CHANNELS
from schemas.site import Bridge, Site
from services.common.arrays import Floats
from services.drives.runs import Run
from services.simulation.drawn import (
    CrossingTruth,
    SimulatedCrossing,
    instruments_of,
    motion_of,
)
from services.simulation.drive import SETTLE_S, declared_site
from services.simulation.positions import (
    START_TIME_S,
    AntennaTrack,
    Instruments,
    TimedMotion,
    gnss_track,
)
from services.simulation.two_sided import Body, WideAxle, WideMotion, WideRoad, WideTruck, cross
from services.simulation.two_sided_deck import Deck, Torsion
from services.simulation.two_sided_surface import draw_waves
from services.simulation.wheel_paths import WheelPaths
from services.simulation.wide_crossings import WideSensor, road_under, sensor_row

LONGEST_STEP_S = 2e-4
"""Longest sampling interval of the accelerometers' filters."""
_ROLL_GYRATION_M = 0.85
_SETTLE_S = 1.5
"""Duration at the beginning of the run-up in which the road rises to its heights."""


class Width(NamedTuple):
    """Properties of truck and bridge beyond the plane through the truck's centre line."""

    paths: WheelPaths
    lane_offset_m: float = 0.0
    """Distance of the lane's middle to the left of the bridge's axis, seen from start to end."""
    torsion: Torsion | None = None
    load_left_m: float = 0.0
    """Distance of the body's centre of gravity to the left of the centre line."""
    sensors: tuple[WideSensor, ...] = ()
    """Sensors with gains, delays and biases; empty: the four on the centre line."""


class _WideDrive(NamedTuple):
    """The recording of a truck, and the truth."""

    run: Run
    road: Profile
    """Mean profile under the front tyres."""
    largest_deflection_m: float
    """Largest deflection of the bridge's axis under an axle."""


def drive_wide(site: Site, truth: CrossingTruth, width: Width, seed: int) -> SimulatedCrossing:
    """Simulate and measure one crossing of a truck and a bridge with width, as `drawn.drive`."""
    bridge, how = site.bridges[0], truth.conditions
    every = max(1, int(np.ceil(1.0 / (how.rate_hz * LONGEST_STEP_S))))
    step_s = 1.0 / (how.rate_hz * every)
    settling = round(SETTLE_S * how.rate_hz) * every
    densities = how.densities_ug_per_rthz
    halves = motion_of(truth, bridge, 0.5 * step_s, 2 * every)
    wide = _measured_wide_run(
        bridge,
        truth.car,
        truth.beam,
        width,
        TimedMotion(halves, step_s, settling),
        (how.road_class, how.road_seed),
        instruments_of(site, truth, densities, seed),
    )
    of_channels = np.array(densities) / (np.sqrt(2.0) if width.sensors else 1.0)
    return SimulatedCrossing(
        truth,
        wide.run,
        declared_site(site, tuple(of_channels.tolist()), how.rate_hz),
        Motion(*(values[::2] for values in halves)),
        float(wide.run.accel_time_s[0]) - settling * step_s,
        step_s,
        wide.road,
        wide.largest_deflection_m,
    )


def _measured_wide_run(
    bridge: Bridge,
    car: HalfCar,
    beam: Beam,
    width: Width,
    driven: TimedMotion,
    road: tuple[str, int],
    instruments: Instruments,
) -> _WideDrive:
    """Drive a truck with width along a motion, given every half step, and measure it.

    The sensors are those of the four channels; further sensors of the truck have the rate of the
    first one, the density of their channel's kind, and errors of their own.
    """
    motion, step_s, settling_steps = driven
    accel_rng, gnss_rng, place_rng = instruments.rng.spawn(3)
    truck, deck = truck_with_width(car, width), deck_with_width(beam, width)
    forward = bool(motion.speed_m_per_s[0] >= 0.0)
    lane = width.lane_offset_m + width.paths.wander_m * float(place_rng.standard_normal())
    reach = car.wheelbase_m + 1.0
    surface = road_under(
        truck,
        draw_waves(*road),
        float(motion.position_m.min() - reach),
        float(motion.position_m.max() + reach),
        lane_offset_m=lane,
        forward=forward,
    )
    count = motion.position_m.size - (motion.position_m.size + 1) % 2
    response = cross(
        truck,
        deck,
        surface,
        WideMotion(step_s, *(values[:count] for values in motion)),
        lane_offset_m=lane,
        settle_s=_SETTLE_S,
    )
    recorded = response.acceleration[settling_steps:]
    read = {
        place.channel: measure_acceleration(
            recorded @ sensor_row(truck, place), 1.0 / step_s, sensor, accel_rng
        )
        for place, sensor in _places(car, width, instruments.sensors)
    }
    channels = middle_channels(read, width.sensors) if width.sensors else read
    position = motion.position_m[:count:2][settling_steps:]
    speed = np.abs(motion.speed_m_per_s[:count:2][settling_steps:])
    to_front_axle_m = (1 if forward else -1) * instruments.antenna_to_front_axle_m
    gnss = gnss_track(
        bridge,
        step_s,
        AntennaTrack(position - to_front_axle_m, np.full_like(position, lane), speed),
        instruments.receiver,
        gnss_rng,
        forward=forward,
    )
    rate = instruments.sensors[0].rate_hz
    time_s = START_TIME_S + np.arange(channels[CHANNELS[0]].size, dtype=np.float64) / rate
    run = Run("simulation", time_s, rate, channels, gnss)
    return _WideDrive(run, _felt_in_front(surface, truck), -float(response.deflection_m.min()))


def _places(
    car: HalfCar, width: Width, sensors: Sequence[Accelerometer]
) -> list[tuple[WideSensor, Accelerometer]]:
    """Return all sensors of the truck with their accelerometer models."""
    front, rear = sensors[:2], sensors[2:]
    if not width.sensors:
        middle = (
            WideSensor(CHANNELS[0], "body", 0.0),
            WideSensor(CHANNELS[1], "body", car.wheelbase_m),
            WideSensor(CHANNELS[2], "axle", axle=1),
            WideSensor(CHANNELS[3], "axle", axle=2),
        )
        return list(zip(middle, sensors, strict=True))
    return [
        (
            place,
            (front if place.on == "body" else rear)[0]._replace(
                gain_error=place.gain_error,
                delay_s=place.delay_s,
                bias_m_per_s2=place.bias_m_per_s2,
            ),
        )
        for place in width.sensors
    ]


def middle_channels(
    channels: Mapping[str, Floats], sensors: Sequence[WideSensor]
) -> dict[str, Floats]:
    """Average sensors left and right of the same place into the four centre channels.

    Body places and axles are front and rear in their order. Raise ValueError where sensors of one
    place have no mean on the centre line.
    """
    found: dict[str, Floats] = {}
    for on, names in (("body", CHANNELS[:2]), ("axle", CHANNELS[2:])):
        of = [sensor for sensor in sensors if sensor.on == on]
        places = sorted({(sensor.axle, sensor.position_m) for sensor in of})
        for name, place in zip(names, places, strict=True):
            there = [sensor for sensor in of if (sensor.axle, sensor.position_m) == place]
            if abs(sum(sensor.lateral_m for sensor in there)) > 1e-9:
                raise ValueError(f"{there[0].channel} and what is with it are not symmetric")
            found[name] = np.mean([channels[sensor.channel] for sensor in there], axis=0)
    return found


def _felt_in_front(road: WideRoad, truck: WideTruck) -> Profile:
    front = 4 if truck.axles[0].twin_distance_m > 0.0 else 2
    x = road.start_m + road.spacing_m * np.arange(road.height_m.shape[1], dtype=np.float64)
    return Profile(x, road.height_m[:front].mean(axis=0))


def truck_with_width(car: HalfCar, width: Width) -> WideTruck:
    """Return the truck with two sides that moves as `car` does in its centre plane."""
    body_kg, d_1 = car.body_mass_kg, car.front_axle_to_cg_m
    pitch = car.pitch_inertia_ratio * body_kg * d_1 * (car.wheelbase_m - d_1)
    body = Body(
        body_kg,
        d_1,
        pitch,
        body_kg * _ROLL_GYRATION_M**2,
        cg_left_m=width.load_left_m,
        cg_height_m=car.cg_height_m,
    )
    return WideTruck(
        (body,),
        tuple(
            _axle(car, i, footprint)
            for i, footprint in enumerate((width.paths.front, width.paths.rear))
        ),
    )


def _axle(car: HalfCar, i: int, footprint: Footprint) -> WideAxle:
    return WideAxle(
        i * car.wheelbase_m,
        car.unsprung_mass_kg[i],
        car.suspension_stiffness_n_per_m[i],
        car.suspension_damping_ns_per_m[i],
        car.tyre_stiffness_n_per_m[i],
        car.tyre_damping_ns_per_m[i],
        footprint.track_m,
        footprint.width_m,
        footprint.twin_distance_m,
        contact_length_m=footprint.length_m,
        offset_m=footprint.offset_m,
        friction_n=car.dry_friction_n[i],
        friction_length_m=car.friction_length_m,
    )


def deck_with_width(beam: Beam, width: Width) -> Deck:
    """Return the deck of a single span of equal elements; raise ValueError for any other beam."""
    lengths = beam.element_lengths_m
    if beam.interior_supports or np.ptp(lengths) > 1e-9 * lengths[0]:
        raise ValueError("a deck with width has one span of equal elements")
    return Deck(
        float(lengths.sum()),
        tuple(beam.flexural_rigidity_nm2.tolist()),
        float(beam.mass_per_length_kg_per_m[0]),
        beam.rayleigh_alpha_per_s,
        beam.rayleigh_beta_s,
        width.torsion,
        beam.support_rotational_stiffness_nm_per_rad,
    )
