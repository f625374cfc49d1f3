"""Sensors with a position (`[[vehicle.sensors]]`): four middle readings, and consistency.

A truck without such sensors has the four of `CHANNELS` in the middle; their properties are those of
the site file, and their signals are the readings, bit for bit.
"""

from collections.abc import Collection, Mapping
from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.crossing.middle import (
    BODY,
    Reduction,
    SensorPlaces,
    centre_readings,
    centre_reduction,
)
from pre_core.diagnostics.redundancy import RedundancyResidual, motion_ratio, redundancy_residual
from schemas.reasons import Reason
from schemas.signals import CHANNELS
from schemas.site import Sensor, Site, Vehicle
from schemas.site_sensors import IN_THE_MIDDLE_M, PlacedSensor
from services.common.arrays import Floats

_SLACK = 2.5
"""Standard deviations of gains and delays by which redundant sensors may differ.

Chance exceeds it in 5e-5 of the crossings with four corners.
"""
_LARGEST_APART = 3.0
"""Largest ratio between the motions of two sides of a part; fault-free at most 1.3 (d10)."""
_EXPLAINED = 0.5
_AS_WELL = 2.0
_BARELY = 0.05
"""Share by which another sensor's error may explain less and is still named."""
_SWAPPED = 0.1
"""Largest share of the residual that a swap may leave."""
_LOOSE = 0.1
"""Share of motion unexplained by gain and delay that no twisting frame causes."""
_TURNED = 1.5
"""Error of a gain that is a wrong sign: an inverted sensor has 2."""


class Spreads(NamedTuple):
    """Standard deviations of relative gains and of delays between channels."""

    gain: float
    delay_s: float


USUAL_SPREADS = Spreads(0.01, 0.0005)


def middle_sensor(sensor: Sensor, vehicle: Vehicle) -> Sensor:
    """Return [sensor] for the middle readings of a vehicle.

    Sensors with a position all point up: the signs in [sensor] are those of the four channels.
    """
    if not vehicle.sensors:
        return sensor
    reduced = reduction_of(vehicle)
    rates = list(rates_hz(sensor, vehicle).values())
    slowest = [
        min((rate for rate, weight in zip(rates, row, strict=True) if weight), default=min(rates))
        for row in reduced.weights
    ]
    density = tuple(np.nan_to_num(reduced.density).tolist())
    return sensor.model_copy(
        update={
            "rate_hz": tuple(slowest),
            "noise_density_ug_per_rthz": density,
            "up": (1, 1, 1, 1),
        }
    )


def rates_hz(sensor: Sensor, vehicle: Vehicle) -> dict[str, float]:
    """Return the declared rate of each channel."""
    if not vehicle.sensors:
        return dict(zip(CHANNELS, sensor.rate_hz, strict=True))
    return {one.channel: one.rate_hz or sensor.rate_hz[0] for one in vehicle.sensors}


def densities_ug_per_rthz(sensor: Sensor, vehicle: Vehicle) -> dict[str, float]:
    """Return the declared noise density of each channel."""
    if not vehicle.sensors:
        return dict(zip(CHANNELS, sensor.noise_density_ug_per_rthz, strict=True))
    return {one.channel: one.noise_density_ug_per_rthz for one in vehicle.sensors}


def middle_names(vehicle: Vehicle) -> tuple[str, ...]:
    """Return the names of the four middle readings, from the channels they are computed of."""
    if not vehicle.sensors:
        return CHANNELS
    names = vehicle.channels
    return tuple(
        " and ".join(names[k] for k in np.flatnonzero(row)) or "none"
        for row in np.nan_to_num(reduction_of(vehicle).weights)
    )


def middle_of(vehicle: Vehicle, acceleration: Floats) -> Floats:
    """Return the middle readings (4, n) of all channels (m, n) of a vehicle, in its order."""
    return centre_readings(reduction_of(vehicle), acceleration) if vehicle.sensors else acceleration


def middle_site(site: Site) -> Site:
    """Return the site as if its first truck, alone, had its four readings from four sensors.

    Simulations measure in the middle, on a body above the two compared axles.
    """
    vehicle = site.vehicles[0]
    if not vehicle.sensors:
        return site
    sensor = middle_sensor(site.sensor, vehicle)
    of_tandem = () if vehicle.tandem is None else _middle_sensors(sensor, vehicle)
    return site.model_copy(
        update={
            "vehicles": (vehicle.model_copy(update={"sensors": of_tandem}),),
            "sensor": sensor,
            "ros2": (),
        }
    )


def _middle_sensors(sensor: Sensor, vehicle: Vehicle) -> tuple[PlacedSensor, ...]:
    """Return the four readings of a truck with a tandem as sensors in the middle."""
    front_m, first = vehicle.front_force_m, first_axle(vehicle)
    places: tuple[dict[str, Any], ...] = (
        {"channel": "sprung_front", "on": "body", "position_m": front_m},
        {"channel": "sprung_rear", "on": "body", "position_m": front_m + vehicle.wheelbase_m},
        *(
            {"channel": f"unsprung_{axle}", "on": "axle", "axle": axle}
            for axle in (first, first + 1)
        ),
    )
    return tuple(
        PlacedSensor(**place, noise_density_ug_per_rthz=density, rate_hz=rate)
        for place, density, rate in zip(
            places, sensor.noise_density_ug_per_rthz, sensor.rate_hz, strict=True
        )
    )


class SensorRow(NamedTuple):
    """One sensor of a truck for a table: channel, position, declared noise and rate."""

    channel: str
    place: str
    noise: str
    rate: str


def sensor_rows(sensor: Sensor, vehicle: Vehicle) -> list[SensorRow]:
    """Return the sensors of a vehicle that names its own; none for the usual four."""
    rates = rates_hz(sensor, vehicle)
    return [
        SensorRow(
            one.channel,
            f"{_where(one)}, {_side(one.lateral_m)}",
            f"{one.noise_density_ug_per_rthz:g} µg/√Hz",
            f"{rates[one.channel]:g} Hz",
        )
        for one in vehicle.sensors
    ]


def sensors_in_words(sensor: Sensor, vehicle: Vehicle) -> list[str]:
    """Return a line for each sensor of a vehicle that names its own."""
    rows = sensor_rows(sensor, vehicle)
    return [f"{row.channel}: {row.place}, {row.noise}, {row.rate}" for row in rows]


def _where(sensor: PlacedSensor) -> str:
    if sensor.axle is not None:
        return f"axle {sensor.axle}"
    return f"body, {sensor.position_m or 0.0:g} m behind the first axle"


def _side(lateral_m: float) -> str:
    if abs(lateral_m) <= IN_THE_MIDDLE_M:
        return "in the middle"
    return f"{abs(lateral_m):g} m to the {'left' if lateral_m > 0.0 else 'right'}"


def one_sided_channels(vehicle: Vehicle, there: Collection[str]) -> str:
    """Return the names of those channels in `there` whose part has sensors on one side only.

    The result is empty for a truck with sensors in the middle, and for a part without sensors.
    """
    left = tuple(one for one in vehicle.sensors if one.channel in there)
    if not left:
        return ""
    weights = _reduction_of(vehicle, left).weights
    parts = {
        part
        for part, row in zip((BODY, BODY, 1, 2), weights, strict=True)
        if bool(np.isnan(row).all())
    }
    first = first_axle(vehicle)
    return ", ".join(one.channel for one in left if _part(one, first) in parts)


def first_axle(vehicle: Vehicle) -> int:
    """Return the number of the first of the two axles whose profiles are compared."""
    return 1 if vehicle.tandem is None else vehicle.tandem.number


def reduction_of(vehicle: Vehicle) -> Reduction:
    """Return the reduction of a vehicle's sensors to middle readings; densities in µg/√Hz."""
    return _reduction_of(vehicle, vehicle.sensors)


def _reduction_of(vehicle: Vehicle, sensors: tuple[PlacedSensor, ...]) -> Reduction:
    forces_m = (vehicle.front_force_m, vehicle.wheelbase_m)
    return _reduction(sensors, forces_m, first_axle(vehicle))


@lru_cache(maxsize=64)
def _reduction(
    sensors: tuple[PlacedSensor, ...], forces_m: tuple[float, float], first: int
) -> Reduction:
    """Return the reduction to the body's motion above both spring forces, and to two axles."""
    front_m, wheelbase_m = forces_m
    places = SensorPlaces(
        np.array([_part(one, first) for one in sensors]),
        np.array([(one.position_m or 0.0) - front_m for one in sensors]),
        np.array([one.lateral_m for one in sensors]),
    )
    density = np.array([one.noise_density_ug_per_rthz for one in sensors])
    return centre_reduction(places, density, wheelbase_m, IN_THE_MIDDLE_M)


def _part(sensor: PlacedSensor, first: int) -> int:
    """Return the part of a sensor: `BODY`, 1 or 2 for the compared axles, -1 for another axle."""
    if sensor.axle is None:
        return BODY
    return sensor.axle - first + 1 if sensor.axle in (first, first + 1) else -1


def disagreement(
    vehicle: Vehicle, acceleration: Floats, step_s: float, spreads: Spreads
) -> Mapping[Reason, str]:
    """Return contradictions between the sensors (m, n) of one part, with their channels."""
    if not vehicle.sensors:
        return {}
    names = vehicle.channels
    for i, k in combinations(range(len(names)), 2):
        are_mirrored = _are_mirrored(vehicle.sensors[i], vehicle.sensors[k])
        if are_mirrored and motion_ratio(acceleration[i], acceleration[k], step_s) > _LARGEST_APART:
            return {Reason.SENSORS_DISAGREE: f"{names[i]} or {names[k]}"}

    def judged(parity: Floats, signals: Floats) -> RedundancyResidual:
        return redundancy_residual(parity, signals, step_s, *spreads, _SLACK)

    # The parities are for accelerations in units of the noise, 1 µg/√Hz for sensors without any.
    for parity in (one / MICRO_G_M_PER_S2 for one in reduction_of(vehicle).parities):
        found = judged(parity, acceleration)
        if found.power <= found.expected:
            continue
        own = np.flatnonzero(np.abs(parity).sum(axis=0))
        swapped = []
        for i, k in combinations(own.tolist(), 2):
            other = acceleration.copy()
            other[[i, k]] = acceleration[[k, i]]
            again = judged(parity, other)
            if again.power <= min(again.expected, _SWAPPED * found.power):
                swapped.append(f"{names[i]} and {names[k]}")
        if swapped:
            return {Reason.CHANNEL_SWAPPED: ", or ".join(swapped)}
        best = np.nanmin(found.unexplained)
        if best < _EXPLAINED:
            guilty = [k for k in own if found.unexplained[k] <= _AS_WELL * best + _BARELY]
            if found.gain[int(np.nanargmin(found.unexplained))] > _TURNED:
                return {Reason.CHANNEL_INVERTED: " or ".join(names[k] for k in guilty)}
            return {
                Reason.SENSORS_DISAGREE: " or ".join(
                    f"{names[k]} (gain {_signed(100.0 * found.gain[k])} %, "
                    f"{_signed(1e3 * found.delay_s[k])} ms late)"
                    for k in guilty
                )
            }
        if found.power > _LOOSE * found.motion:
            return {Reason.SENSORS_DISAGREE: f"one of {', '.join(names[k] for k in own)}"}
    return {}


def _signed(value: float) -> str:
    """Return a number with its sign and one decimal; 0.0 without a sign."""
    text = f"{value:+.1f}"
    return "0.0" if float(text) == 0.0 else text


def _are_mirrored(one: PlacedSensor, other: PlacedSensor) -> bool:
    """Return whether two sensors are left and right of one another."""
    far = max(abs(one.lateral_m), abs(other.lateral_m))
    return (
        one.axle == other.axle
        and one.lateral_m * other.lateral_m < 0.0
        and abs(one.lateral_m + other.lateral_m) <= 0.2 * far
        and abs((one.position_m or 0.0) - (other.position_m or 0.0)) <= 0.5
    )
