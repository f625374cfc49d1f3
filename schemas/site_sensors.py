"""`[[vehicle.sensors]]` of a site file: accelerometers by name and place.

The fit needs four readings in the middle of the truck: of the body above both axles, and of both
axles. A part that rolls (the body, an axle) shows its middle through a sensor in the middle, or
through sensors on both sides. Sensors of one side show middle and roll as one: such a file is
refused.
"""

from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, Strict

from schemas.site_errors import at
from schemas.site_numbers import Density, Identifier, Number, Rate, Table

MOST_SENSORS: Final = 32
IN_THE_MIDDLE_M: Final = 0.05
"""A sensor that is less far to the side is in the middle: a truck's axis is not known better."""
_LARGEST_LEVER: Final = 3.0
"""Sum of the sizes of the weights of a middle reading; more amplifies gain errors too far. Sensors
above both axles have 1, three corners of a frame 2."""
ADVICE: Final = "put a second sensor on the other side, or this one in the middle"


class PlacedSensor(Table):
    """One accelerometer."""

    channel: Identifier
    """Its name in CSV headers, batches and recordings."""
    on: Literal["body", "axle"]
    axle: Annotated[int, Strict(), Field(ge=1, le=20)] | None = None
    """Number of the axle it is on, from 1."""
    position_m: Annotated[Number, Field(ge=-30, le=60)] | None = None
    """Distance behind the first axle, of a sensor on the body."""
    lateral_m: Annotated[Number, Field(ge=-3, le=3)] = 0.0
    """Distance to the left of the truck's middle."""
    noise_density_ug_per_rthz: Density
    """One-sided; 0 for a simulation without noise."""
    rate_hz: Rate | None = None
    """None: that of [sensor]."""


def check_sensors(sensors: tuple[PlacedSensor, ...], wheelbase_m: float) -> None:
    """Raise if the sensors of a two-axle truck do not show the four middle readings."""
    names: set[str] = set()
    for number, sensor in enumerate(sensors):
        where = f"sensors.{number}"
        if sensor.channel in names:
            raise at(f"{where}.channel", f'is "{sensor.channel}" again, a channel is one sensor')
        names.add(sensor.channel)
        if sensor.on == "axle" and (sensor.axle is None or sensor.axle > 2):
            value = "missing" if sensor.axle is None else str(sensor.axle)
            raise at(f"{where}.axle", f"is {value}, it must be the number of an axle, 1 or 2")
        if sensor.on == "axle" and sensor.position_m is not None:
            raise at(f"{where}.position_m", "is of a sensor on an axle, remove it: axle places it")
        if sensor.on == "body" and sensor.position_m is None:
            raise at(
                f"{where}.position_m",
                "is missing, it must be a length in m: how far behind the first axle the sensor is",
            )
        if sensor.on == "body" and sensor.axle is not None:
            raise at(f"{where}.axle", "is of a sensor on the body, remove it: position_m places it")
    for axle in (1, 2):
        _check_axle(sensors, axle)
    _check_body(sensors, wheelbase_m)


def _check_axle(sensors: tuple[PlacedSensor, ...], axle: int) -> None:
    own = [(k, one) for k, one in enumerate(sensors) if one.axle == axle]
    if not own:
        raise at("sensors", f"has none on axle {axle}, one in the middle or two are expected")
    _check_sides(own, f"axle {axle}")


def _check_body(sensors: tuple[PlacedSensor, ...], wheelbase_m: float) -> None:
    own = [(k, one) for k, one in enumerate(sensors) if one.on == "body"]
    if not own:
        raise at("sensors", "has none on the body, one near each axle is expected")
    _check_sides(own, "the body")
    places = np.array([one.position_m for _, one in own]) / wheelbase_m
    lateral = np.array([one.lateral_m for _, one in own])
    for end, at_end in (("front", 0.0), ("rear", 1.0)):
        if _lever(places, np.zeros_like(lateral), at_end) > _LARGEST_LEVER:
            raise at(
                "sensors",
                f"of the body do not show its motion above the {end} axle, sensors near both axles "
                "are expected",
            )
        if _lever(places, lateral, at_end) > _LARGEST_LEVER:
            near = [one for one in own if (one[1].position_m or 0.0) < 0.5 * wheelbase_m]
            if end == "rear":
                near = [one for one in own if one not in near]
            _check_sides(near or own, f"the body near the {end} axle")
            raise at(
                "sensors",
                f"of the body do not show its roll well enough for the {end} axle, sensors on both "
                "sides are expected",
            )


def _check_sides(own: list[tuple[int, PlacedSensor]], part: str) -> None:
    """Raise if sensors of a part are all on one side."""
    lateral = [one.lateral_m for _, one in own]
    number, first = own[0]
    for side, is_there in (
        ("left", min(lateral) > IN_THE_MIDDLE_M),
        ("right", max(lateral) < -IN_THE_MIDDLE_M),
    ):
        if is_there:
            raise at(
                f"sensors.{number}",
                f'("{first.channel}") shows {part} on the {side} only, which hides its roll '
                f"(roll_not_seen): {ADVICE}",
            )


def _lever(places: np.ndarray, lateral: np.ndarray, at_end: float) -> float:
    """Return the least sum of sizes of weights that give the middle at a place; inf if none do.

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
