"""Truck and sensors of a measurement, as the site file declares them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from schemas.results import CrossingResult
from schemas.site import Site, Vehicle
from schemas.site_sensors import IN_THE_MIDDLE_M, PlacedSensor
from schemas.site_vehicle import axle_loads_kg
from services.common.language import Language
from services.finding.placed import densities_ug_per_rthz, rates_hz


def vehicles_of(site: Site, crossings: Iterable[CrossingResult]) -> list[Vehicle]:
    """Return the trucks of a site file that crossed."""
    drove = {crossing.vehicle for crossing in crossings}
    return [vehicle for vehicle in site.vehicles if vehicle.id in drove]


def truck_line(vehicle: Vehicle, language: Language) -> str:
    """Return mass, wheelbase and static axle loads; of a tandem the load of both axles."""
    line = language.text(
        "truck.weighs",
        name=vehicle.id,
        mass_t=vehicle.total_mass_kg / 1e3,
        wheelbase_m=vehicle.wheelbase_m,
    )
    listed = language.listed(
        [language.number(load / 1e3, ".1f") for load in axle_loads_kg(vehicle)]
    )
    return f"{line}, {language.text('truck.loads', loads=listed)}"


def sensor_lines(site: Site, vehicle: Vehicle, language: Language) -> Iterator[str]:
    """Yield the place, noise and rate of the sensors of a truck."""
    rates = rates_hz(site.sensor, vehicle)
    densities = densities_ug_per_rthz(site.sensor, vehicle)
    if not vehicle.sensors:
        yield language.text(
            "sensors.middle",
            name=vehicle.id,
            rate=_several(rates.values(), language),
            density=_several(densities.values(), language),
        )
    for sensor in vehicle.sensors:
        rate = language.number(rates[sensor.channel], "g")
        density = language.number(densities[sensor.channel], "g")
        place = _place_of(sensor, language)
        yield f"{vehicle.id} {sensor.channel}: {place}, {density} µg/√Hz, {rate} Hz"


def _several(values: Iterable[float], language: Language) -> str:
    """Return different values in their order."""
    return ", ".join(language.number(value, "g") for value in dict.fromkeys(values))


def _place_of(sensor: PlacedSensor, language: Language) -> str:
    side = language.text("sensor.middle")
    if abs(sensor.lateral_m) > IN_THE_MIDDLE_M:
        which = "left" if sensor.lateral_m > 0.0 else "right"
        side = language.text(f"sensor.{which}", lateral_m=abs(sensor.lateral_m))
    if sensor.axle is not None:
        return language.text("sensor.axle", axle=sensor.axle, side=side)
    return language.text("sensor.body", position_m=sensor.position_m or 0.0, side=side)
