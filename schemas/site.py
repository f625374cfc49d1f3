"""The site file: trucks and bridges, with prior knowledge about them.

Field names are the keys of the TOML file (docs/contract.md). Pairs are [front, rear]. A `…_spread`
is a relative standard deviation of a log-normal prior, unless its name carries a unit.
"""

from typing import Annotated, Final, Literal

from pydantic import BeforeValidator, Field, StrictBool, model_validator

from schemas.site_bridge import Bridge as Bridge
from schemas.site_errors import error_at
from schemas.site_import import Import
from schemas.site_numbers import Density, NotNegative, Number, Rate, Spread, Table
from schemas.site_physics import check
from schemas.site_ros2 import Ros2, check_ros2
from schemas.site_vehicle import Vehicle as Vehicle
from schemas.site_vehicle import WithSpreads

MAX_TABLES: Final = 20_000
"""Largest number of vehicles or bridges in a site file."""
_SLOWEST_RATE_HZ: Final = 10.0
_LARGEST_POSITION_M: Final = 100.0
_LARGEST_SPEED_M_PER_S: Final = 10.0

Sign = Annotated[Literal[1, -1], BeforeValidator(lambda v: int(v) if v in (1.0, -1.0) else v)]


def _per_channel(value: object) -> object:
    """Expand one value for all channels to four."""
    return [value] * 4 if isinstance(value, int | float) and not isinstance(value, bool) else value


_FourRates = tuple[Rate, Rate, Rate, Rate]
_FourDensities = tuple[Density, Density, Density, Density]
Rates = Annotated[
    _FourRates, BeforeValidator(_per_channel, json_schema_input_type=_FourRates | Rate)
]
Densities = Annotated[
    _FourDensities, BeforeValidator(_per_channel, json_schema_input_type=_FourDensities | Density)
]


class Sensor(Table):
    """The accelerometers, in the order sprung front, sprung rear, unsprung front, unsprung rear.

    Densities, and rates where given, of a truck's own `sensors` replace these.
    """

    rate_hz: Rates
    noise_density_ug_per_rthz: Densities = (0.0, 0.0, 0.0, 0.0)
    """One-sided density; 0 for a simulation without noise. Optional only if all trucks have
    `sensors`."""
    gravity_included: StrictBool = False
    up: tuple[Sign, Sign, Sign, Sign] = (1, 1, 1, 1)
    """Sign of each channel: 1 if it reads upward accelerations as positive, else -1."""
    gain_spread: Spread = 0.01
    """Standard deviation of each channel's gain, independent of the others."""
    delay_spread_s: Annotated[Number, Field(ge=0, le=1)] = 0.0005
    common_gain_spread: Spread = 0.01
    """Standard deviation of the gain that all channels share."""

    @model_validator(mode="after")
    def _is_possible(self) -> "Sensor":
        for rate in self.rate_hz:
            if rate < _SLOWEST_RATE_HZ:
                raise error_at(
                    "rate_hz",
                    f"is {rate:g}, it must be a rate of at least {_SLOWEST_RATE_HZ:g} Hz "
                    "(Hz, not kHz)",
                )
        return self


class Receiver(Table):
    """The GNSS receiver."""

    position_spread_m: NotNegative = 1.5
    """Standard deviation of the slow error, which is constant during a crossing."""
    position_noise_m: NotNegative = 0.4
    speed_noise_m_per_s: NotNegative = 0.07
    latency_s: Annotated[Number, Field(ge=-10, le=10)] = 0.0
    latency_spread_s: Annotated[Number, Field(ge=0, le=10)] = 0.1

    @model_validator(mode="after")
    def _is_possible(self) -> "Receiver":
        for key in ("position_spread_m", "position_noise_m"):
            check(key, getattr(self, key), (0.0, _LARGEST_POSITION_M), "a length", "m")
        key = "speed_noise_m_per_s"
        check(key, self.speed_noise_m_per_s, (0.0, _LARGEST_SPEED_M_PER_S), "a speed", "m/s")
        return self


class Site(Table):
    """The content of a site file."""

    vehicles: Annotated[tuple[Vehicle, ...], Field(alias="vehicle", min_length=1)]
    bridges: Annotated[tuple[Bridge, ...], Field(alias="bridge", min_length=1)]
    sensor: Sensor
    receiver: Receiver = Receiver()
    ros2: tuple[Ros2, ...] = ()
    """Sources of the messages of trucks with ROS 2, independent of their measurements."""
    imports: Annotated[Import | None, Field(alias="import")] = None
    """The realm of imported drives."""

    def vehicle(self, identifier: str) -> Vehicle:
        """Return the vehicle of that id; raise KeyError if the site has none."""
        return {v.id: v for v in self.vehicles}[identifier]

    def bridge(self, identifier: str) -> Bridge:
        """Return the bridge of that id; raise KeyError if the site has none."""
        return {b.id: b for b in self.bridges}[identifier]

    @model_validator(mode="after")
    def _identifiers_are_unique(self) -> "Site":
        lists: dict[str, tuple[WithSpreads, ...]] = {
            "vehicle": self.vehicles,
            "bridge": self.bridges,
        }
        for name, tables in lists.items():
            seen: set[str] = set()
            for index, table in enumerate(tables):
                if table.id in seen:
                    raise error_at(
                        f"{name}.{index}.id", f'is "{table.id}" again, ids must be unique'
                    )
                seen.add(table.id)
        check_ros2(self.ros2, {vehicle.id: vehicle.channels for vehicle in self.vehicles})
        return self

    @model_validator(mode="after")
    def _sensors_are_described(self) -> "Site":
        """Raise if [sensor] and the sensors of a vehicle leave a value undefined."""
        sensor = self.sensor
        by_place = [vehicle for vehicle in self.vehicles if vehicle.sensors]
        if len(by_place) < len(self.vehicles):
            if "noise_density_ug_per_rthz" not in sensor.model_fields_set:
                raise error_at(
                    "sensor.noise_density_ug_per_rthz",
                    "is missing, it must be a noise density in µg/√Hz",
                )
        elif sensor.up != (1, 1, 1, 1):
            raise error_at(
                "sensor.up",
                "applies to the four usual channels only, [[vehicle.sensors]] must point up",
            )
        for number, vehicle in enumerate(self.vehicles):
            for place, one in enumerate(vehicle.sensors):
                if one.rate_hz is None and len(set(sensor.rate_hz)) > 1:
                    raise error_at(
                        f"vehicle.{number}.sensors.{place}.rate_hz",
                        "is missing, it must be a rate in Hz: sensor.rate_hz has several",
                    )
        return self
