"""The bridges, trucks and traffic of a site, and the data of stays that follow from them."""

import logging

from schemas.reasons import Reason
from schemas.site import Site
from services.common.geodesy import to_chainage
from services.finding.bridges import Bridges
from services.finding.crossing_data import CrossingData, Detection, Window
from services.finding.placed import middle_sensor
from services.finding.stays import Stay
from services.finding.traffic import Traffic
from services.finding.truck import TruckBoot

_log = logging.getLogger(__name__)


class Scene:
    """A site with the positions of all trucks near its bridges."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self.bridges = Bridges(site.bridges, site.receiver)
        self.vehicles = {vehicle.id: vehicle for vehicle in site.vehicles}
        self.traffic = Traffic(self.bridges, self.vehicles)

    def retarget(self, site: Site) -> None:
        """Continue with another site file; positions of trucks stay."""
        self._site = site
        self.bridges = Bridges(site.bridges, site.receiver)
        self.vehicles = {vehicle.id: vehicle for vehicle in site.vehicles}
        self.traffic.retarget(self.bridges, self.vehicles)

    def data(
        self, truck: TruckBoot, detection: Detection, stay: Stay, window: Window
    ) -> CrossingData:
        """Return the data of a crossing, with the samples in its window."""
        number = self.bridges.number[detection.bridge]
        fixes = truck.boot.fixes()
        chainage, _ = to_chainage(
            self.bridges.frame(number), fixes.latitude_deg, fixes.longitude_deg
        )
        return CrossingData(
            detection.crossing_id,
            truck.realm,
            truck.vehicle,
            self.bridges.bridge(number),
            middle_sensor(self._site.sensor, truck.vehicle),
            self._site.receiver,
            stay,
            fixes,
            chainage,
            truck.boot.samples(*window, truck.vehicle.channels),
            (detection.entry_ns - round(stay.entry_s * 1e9)) / 1e9,
            self._against(truck, detection),
        )

    def _against(self, truck: TruckBoot, detection: Detection) -> tuple[Reason, ...]:
        """Return known faults of a crossing that its own signals do not show."""
        reasons = []
        for name, declared, known in truck.differences[:1]:
            _log.warning(
                "%s: the truck declares %s as %g, the site file %g",
                *(detection.crossing_id, name, declared, known),
            )
            reasons.append(Reason.VEHICLE_DIFFERS_FROM_SITE)
        others = self.traffic.others(
            *(detection.realm, detection.bridge, detection.vehicle),
            *(detection.entry_ns, detection.exit_ns),
        )
        if others:
            names = ", ".join(others)
            _log.warning("%s: %s was on the bridge at the same time", detection.crossing_id, names)
            reasons.append(Reason.OTHER_TRUCK_ON_BRIDGE)
        return tuple(reasons)

    def retargeted(self, data: CrossingData) -> CrossingData | None:
        """Return a crossing's data by the present site file; None if that lacks truck or bridge."""
        vehicle = self.vehicles.get(data.vehicle.id)
        number = self.bridges.number.get(data.bridge.id)
        if vehicle is None or number is None:
            return None
        chainage, _ = to_chainage(
            self.bridges.frame(number), data.fixes.latitude_deg, data.fixes.longitude_deg
        )
        return data._replace(
            vehicle=vehicle,
            bridge=self.bridges.bridge(number),
            sensor=middle_sensor(self._site.sensor, vehicle),
            receiver=self._site.receiver,
            chainage_m=chainage,
        )
