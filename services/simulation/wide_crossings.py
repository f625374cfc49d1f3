"""Crossings of three-dimensional trucks and bridges (`two_sided`), and their sensors.

A case is one truck, bridge, road, set of sensors and the site file of its owner, with any number of
runs. `two_sided` simulates it. Accelerometers have gain, delay, bias and white noise; a receiver
has a slow error, which is constant during a run, and white ones.

    found = identify_simulated([drive_case(case, 0).run], site_of(case), IdentificationSettings())
"""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from pre_core.constants import MICRO_G_M_PER_S2
from schemas.site import Site
from schemas.site_file import parse_site, toml_of
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, to_lat_lon
from services.drives.runs import GnssTrack, Run
from services.simulation.two_sided import (
    LONGEST_STEP_S,
    WideRoad,
    WideTruck,
    axle_row,
    body_row,
    cross,
    even_motion,
    tyres_of,
)
from services.simulation.two_sided_deck import Deck
from services.simulation.two_sided_march import WideResponse
from services.simulation.two_sided_surface import Strip, Waves, draw_waves, heights_m

START_TIME_S: Final = 1_796_300_000.0
BETWEEN_RUNS_S: Final = 600.0
_RUN_UP_S, _SETTLE_S = 5.0, 2.0
_BEFORE_M, _BEHIND_M = 30.0, 25.0
"""Road between the beginning of a recording and the first axle's entry, and after the last exit."""
_ROAD_SPACING_M = 0.02
_FIX_RATE_HZ = 10.0
_ALTITUDE_M, _ALTITUDE_NOISE_M = 20.0, 0.2


class WideSensor(NamedTuple):
    """An accelerometer on a body, or on an axle."""

    channel: str
    on: str
    """Place: "body" or "axle"."""
    position_m: float = 0.0
    """Distance behind the first axle, for sensors on a body."""
    axle: int = 0
    """Number from 1, for sensors on axles."""
    lateral_m: float = 0.0
    """Distance to the left of the centre line."""
    body: int = 0
    noise_ug_per_rthz: float = 25.0
    gain_error: float = 0.0
    delay_s: float = 0.0
    """Delay: a sample stamped t shows the motion at t - delay."""
    bias_m_per_s2: float = 0.0


class SatelliteErrors(NamedTuple):
    """Standard deviations of a receiver's errors."""

    slow_m: float = 1.5
    noise_m: float = 0.4
    speed_m_per_s: float = 0.07


USUAL_RECEIVER: Final = SatelliteErrors()


class WideRun(NamedTuple):
    """Driving conditions of one run."""

    speed_m_per_s: float
    """Mean speed; it changes as a sine of `change_m_per_s` and `period_s`."""
    forward: bool = True
    lateral_m: float = 0.0
    """Distance of the truck to the left of its lane's middle, seen from start to end."""
    change_m_per_s: float = 0.0
    period_s: float = 10.0


class WideCase(NamedTuple):
    """One truck on one bridge, and the owner's declaration."""

    name: str
    seed: int
    """Seed of noise and receiver."""
    truck: WideTruck
    deck: Deck
    undamaged_nm2: float
    lane_offset_m: float
    road_class: str
    road_seed: int
    is_one_road: bool
    """Whether all tyres follow the profile of one line."""
    sensors: tuple[WideSensor, ...]
    runs: tuple[WideRun, ...]
    declared: Mapping[str, Mapping[str, Any]]
    """Tables and keys of the site file."""
    rate_hz: float = 500.0
    receiver: SatelliteErrors = USUAL_RECEIVER
    antenna_to_front_axle_m: float = 0.0
    """Distance of the receiver's antenna behind the first axle."""
    latency_s: float = 0.0
    """Latency of the receiver's time stamps."""
    least_before_m: float = 0.0
    """Least recorded road of the last axle before the bridge."""


class WideDrivenRun(NamedTuple):
    """One recorded run with its truth."""

    run: Run
    response: WideResponse
    road: WideRoad
    entry_s: float
    """Entry of the first axle on the clock of the recording."""
    exit_s: float
    """Exit of the last axle."""


def drive_case(case: WideCase, number: int) -> WideDrivenRun:
    """Simulate and measure one of the case's runs."""
    how = case.runs[number]
    truck, span = case.truck, case.deck.span_m
    length = max(axle.position_m for axle in truck.axles)
    before_m = max(_BEFORE_M, case.least_before_m + length if case.least_before_m else 0.0)
    step_s = 1.0 / (case.rate_hz * np.ceil(1.0 / (case.rate_hz * LONGEST_STEP_S)))
    slowest = how.speed_m_per_s - abs(how.change_m_per_s)
    reach = (how.speed_m_per_s + abs(how.change_m_per_s)) * _RUN_UP_S + before_m
    duration = _RUN_UP_S + (before_m + span + length + _BEHIND_M) / slowest
    motion = even_motion(
        -reach if how.forward else span + reach,
        how.speed_m_per_s,
        duration,
        step_s,
        forward=how.forward,
        change_m_per_s=how.change_m_per_s,
        period_s=how.period_s,
    )
    sign = 1.0 if how.forward else -1.0
    lane = case.lane_offset_m + how.lateral_m
    low, high = motion.position_m.min(), motion.position_m.max()
    road = road_under(
        truck,
        draw_waves(case.road_class, case.road_seed),
        float(low - length - 1.0),
        float(high + length + 1.0),
        lane_offset_m=lane,
        forward=how.forward,
        is_one_road=case.is_one_road,
    )
    response = cross(truck, case.deck, road, motion, lane_offset_m=lane, settle_s=_SETTLE_S)
    rng = np.random.default_rng(np.random.SeedSequence([case.seed, 0x51DE, number]))
    travel = sign * (response.position_m - (0.0 if how.forward else span))
    begin = float(np.interp(-before_m, travel, response.time_s))
    end = float(np.interp(span + length + _BEHIND_M, travel, response.time_s))
    time_s = begin + np.arange(int((end - begin) * case.rate_hz)) / case.rate_hz
    start_s = START_TIME_S + number * BETWEEN_RUNS_S
    channels = {
        sensor.channel: _measured(truck, response, sensor, time_s, case.rate_hz, rng)
        for sensor in case.sensors
    }
    run = Run(
        f"{case.name} {number}",
        start_s + time_s - begin,
        case.rate_hz,
        channels,
        _fixes(case, response, lane, time_s, start_s - begin, rng),
    )
    crossed = [float(np.interp(x, travel, response.time_s)) for x in (0.0, span + length)]
    return WideDrivenRun(run, response, road, *(start_s + at - begin for at in crossed))


def road_under(
    truck: WideTruck,
    waves: Waves,
    start_m: float,
    stop_m: float,
    *,
    lane_offset_m: float = 0.0,
    forward: bool = True,
    is_one_road: bool = False,
) -> WideRoad:
    """Return the profile under each tyre of a truck on an eccentric lane.

    With one road every tyre follows the same line, averaged over the first axle's contact length.
    """
    count = round((stop_m - start_m) / _ROAD_SPACING_M) + 1
    sign = 1.0 if forward else -1.0
    strips = []
    tyres = tyres_of(truck)
    for i, lateral in zip(tyres.axle, tyres.lateral_m, strict=True):
        axle = truck.axles[i]
        place = lane_offset_m + sign * float(lateral)
        strips.append(Strip(place, axle.tyre_width_m, axle.contact_length_m))
    if is_one_road:
        strips = [Strip(0.0, 0.0, truck.axles[0].contact_length_m)] * len(strips)
    heights = {
        s: heights_m(waves, s, start_m, _ROAD_SPACING_M, count) for s in dict.fromkeys(strips)
    }
    return WideRoad(start_m, _ROAD_SPACING_M, np.stack([heights[strip] for strip in strips]))


def sensor_row(truck: WideTruck, sensor: WideSensor) -> Floats:
    """Return the row from the truck's accelerations to the reading of a perfect sensor."""
    if sensor.on == "body":
        return body_row(truck, sensor.position_m, sensor.lateral_m, sensor.body)
    return axle_row(truck, sensor.axle - 1, sensor.lateral_m)


def _measured(
    truck: WideTruck,
    response: WideResponse,
    sensor: WideSensor,
    time_s: Floats,
    rate_hz: float,
    rng: np.random.Generator,
) -> Floats:
    from scipy.interpolate import CubicSpline  # slow to import, of deviating crossings alone

    true = response.acceleration @ sensor_row(truck, sensor)
    read = CubicSpline(response.time_s, true)(time_s - sensor.delay_s)
    noise = sensor.noise_ug_per_rthz * MICRO_G_M_PER_S2 * np.sqrt(rate_hz / 2.0)
    return np.asarray(
        (1.0 + sensor.gain_error) * read
        + sensor.bias_m_per_s2
        + noise * rng.standard_normal(time_s.size)
    )


def _fixes(
    case: WideCase,
    response: WideResponse,
    lane_m: float,
    time_s: Floats,
    clock_s: float,
    rng: np.random.Generator,
) -> GnssTrack:
    at = np.arange(time_s[0], time_s[-1], 1.0 / _FIX_RATE_HZ)
    errors = case.receiver
    slow = errors.slow_m * rng.standard_normal(2)
    white = errors.noise_m * rng.standard_normal((2, at.size))
    sign = 1.0 if response.position_m[-1] > response.position_m[0] else -1.0
    antenna = response.position_m - sign * case.antenna_to_front_axle_m
    along = np.interp(at, response.time_s, antenna) + slow[0] + white[0]
    beside = lane_m + slow[1] + white[1]
    speed = np.abs(
        np.interp(at, response.time_s, np.gradient(response.position_m, response.time_s))
    )
    latitude, longitude = to_lat_lon(bridge_frame(site_of(case).bridges[0]), along, beside)
    return GnssTrack(
        clock_s + at + case.latency_s,
        latitude,
        longitude,
        _ALTITUDE_M + _ALTITUDE_NOISE_M * rng.standard_normal(at.size),
        speed + errors.speed_m_per_s * rng.standard_normal(at.size),
        None,
    )


def site_text(case: WideCase) -> str:
    """Return the owner's site file."""
    return "# All SI.\n" + toml_of(
        {table: dict(case.declared[table]) for table in ("vehicle", "bridge", "sensor")}
    )


def site_of(case: WideCase) -> Site:
    """Return the owner's site file as the program reads it."""
    return parse_site(site_text(case), f"{case.name}.toml")
