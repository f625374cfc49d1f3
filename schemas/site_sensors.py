"""`[[vehicle.sensors]]` of a site file: accelerometers by name and place.

The fit needs four readings on the truck's centre line: of the body above both axles, and of both
axles. A part that rolls (body or axle) gives its centre reading through a sensor on the centre line
or through sensors on both sides. Sensors on one side cannot separate it from roll: such a file is
refused.
"""

from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, Strict

from schemas.site_errors import error_at
from schemas.site_numbers import Density, Identifier, Number, Rate, Table

MAX_SENSORS: Final = 32
IN_THE_MIDDLE_M: Final = 0.05
"""Largest lateral distance at which a sensor counts as on the centre line: places are not known
better."""
_LARGEST_LEVER: Final = 3.0
"""Largest sum of the absolute weights of a centre reading; more amplifies gain errors too far.
Sensors above both axles have 1, three corners of a frame 2."""
_TIME: Final = "time_s"
"""Column of times in CSV files, which no channel can have."""
_BEFORE_M, _BEHIND_M = 5.0, 10.0
"""Largest distances of a sensor on the body before the first and behind the last axle."""
_ASIDE_M: Final = 2.0
"""Largest lateral distance, half of a truck twice as wide as roads permit; for a wider track, half
of that."""
ADVICE: Final = "put a second sensor on the other side, or this one in the middle"


class PlacedSensor(Table):
    """One accelerometer."""

    channel: Identifier
    """Name in CSV headers, batches and recordings."""
    on: Literal["body", "axle"]
    axle: Annotated[int, Strict(), Field(ge=1, le=20)] | None = None
    """Number of its axle, from 1."""
    position_m: Annotated[Number, Field(ge=-30, le=60)] | None = None
    """Distance behind the first axle, for a sensor on the body."""
    lateral_m: Annotated[Number, Field(ge=-3, le=3)] = 0.0
    """Distance to the left of the truck's centre line."""
    noise_density_ug_per_rthz: Density
    """One-sided density; 0 for a simulation without noise."""
    rate_hz: Rate | None = None
    """Sampling rate; None: that of [sensor]."""


def check_places(
    sensors: tuple[PlacedSensor, ...], length_m: float, track_m: tuple[float, ...]
) -> None:
    """Raise if a sensor is not on a truck of this distance between first and last axle."""
    aside = max((_ASIDE_M, *(0.5 * one for one in track_m)))
    for number, sensor in enumerate(sensors):
        where = f"sensors.{number}"
        if sensor.channel == _TIME:
            raise error_at(
                f"{where}.channel", f'is "{_TIME}", it must be another name: that is the time'
            )
        place = sensor.position_m
        if place is not None and not -_BEFORE_M <= place <= length_m + _BEHIND_M:
            raise error_at(
                f"{where}.position_m",
                f"is {place:g}, it must be a length from {-_BEFORE_M:g} to "
                f"{length_m + _BEHIND_M:g} m: the last axle is {length_m:g} m behind the first",
            )
        if abs(sensor.lateral_m) > aside:
            raise error_at(
                f"{where}.lateral_m",
                f"is {sensor.lateral_m:g}, it must be a length from {-aside:g} to {aside:g} m: "
                "no truck is wider",
            )


def check_sensors(
    sensors: tuple[PlacedSensor, ...],
    forces_m: tuple[float, float],
    compared: int = 1,
    axles: int = 2,
) -> None:
    """Raise if the sensors do not give the four centre readings.

    `forces_m` are the distance of the front spring force behind the first axle, and that of the
    rear one behind it. The axle readings are those of axle `compared` and the next one, of `axles`;
    a sensor on another axle is allowed and not used.
    """
    names: set[str] = set()
    for number, sensor in enumerate(sensors):
        where = f"sensors.{number}"
        if sensor.channel in names:
            raise error_at(
                f"{where}.channel", f'is "{sensor.channel}" again, a channel is one sensor'
            )
        names.add(sensor.channel)
        if sensor.on == "axle" and (sensor.axle is None or sensor.axle > axles):
            value = "missing" if sensor.axle is None else str(sensor.axle)
            numbers = "1 or 2" if axles == 2 else f"1 to {axles}"
            raise error_at(
                f"{where}.axle", f"is {value}, it must be the number of an axle, {numbers}"
            )
        if sensor.on == "axle" and sensor.position_m is not None:
            raise error_at(
                f"{where}.position_m", "is of a sensor on an axle, remove it: axle places it"
            )
        if sensor.on == "body" and sensor.position_m is None:
            raise error_at(
                f"{where}.position_m",
                "is missing, it must be a length in m: how far behind the first axle the sensor is",
            )
        if sensor.on == "body" and sensor.axle is not None:
            raise error_at(
                f"{where}.axle", "is of a sensor on the body, remove it: position_m places it"
            )
    for axle in (compared, compared + 1):
        _check_axle(sensors, axle)
    _check_body(sensors, *forces_m)


def _check_axle(sensors: tuple[PlacedSensor, ...], axle: int) -> None:
    own = [(k, one) for k, one in enumerate(sensors) if one.axle == axle]
    if not own:
        raise error_at("sensors", f"has none on axle {axle}, one in the middle or two are expected")
    _check_sides(own, f"axle {axle}")


def _check_body(sensors: tuple[PlacedSensor, ...], front_m: float, wheelbase_m: float) -> None:
    own = [(k, one) for k, one in enumerate(sensors) if one.on == "body"]
    if not own:
        raise error_at("sensors", "has none on the body, one near each axle is expected")
    _check_sides(own, "the body")
    places = (np.array([one.position_m for _, one in own]) - front_m) / wheelbase_m
    lateral = np.array([one.lateral_m for _, one in own])
    for end, at_end in (("front", 0.0), ("rear", 1.0)):
        if _lever(places, np.zeros_like(lateral), at_end) > _LARGEST_LEVER:
            raise error_at(
                "sensors",
                f"of the body do not show its motion above the {end} axle, sensors near both axles "
                "are expected",
            )
        if _lever(places, lateral, at_end) > _LARGEST_LEVER:
            near = [one for one in own if (one[1].position_m or 0.0) - front_m < 0.5 * wheelbase_m]
            if end == "rear":
                near = [one for one in own if one not in near]
            _check_sides(near or own, f"the body near the {end} axle")
            raise error_at(
                "sensors",
                f"of the body do not show its roll well enough for the {end} axle, sensors on both "
                "sides are expected",
            )


def _check_sides(own: list[tuple[int, PlacedSensor]], part: str) -> None:
    """Raise if all sensors of a part are on one side."""
    lateral = [one.lateral_m for _, one in own]
    number, first = own[0]
    for side, is_there in (
        ("left", min(lateral) > IN_THE_MIDDLE_M),
        ("right", max(lateral) < -IN_THE_MIDDLE_M),
    ):
        if is_there:
            raise error_at(
                f"sensors.{number}",
                f'("{first.channel}") shows {part} on the {side} only, which hides its roll '
                f"(roll_not_seen): {ADVICE}",
            )


def _lever(places: np.ndarray, lateral: np.ndarray, at_end: float) -> float:
    """Return the least sum of absolute weights giving the centre reading at a place; inf if none.

    `places` (m,) from 0 at the front to 1 at the rear axle, `lateral` (m,) in m.
    """
    columns = [np.ones_like(places), places]
    if np.abs(lateral).max() > IN_THE_MIDDLE_M:
        columns.append(lateral)
    wanted = np.array([1.0, at_end, 0.0])[: len(columns)]
    geometry = np.stack(columns)
    weights = np.linalg.pinv(geometry, rcond=1e-6) @ wanted
    fits = np.abs(geometry @ weights - wanted).max() < 1e-6
    return float(np.abs(weights).sum()) if fits else np.inf
