"""Crossings that a survey might consist of: simulated once each, with what they tell of a bridge.

Truck and bridge are nominal. Both axles feel one groove, and the noise that the model has for roads
that differ is what a surface of this class would give: so the rows are at the truth, whatever the
surface happened to be.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing import posterior
from pre_core.crossing.mismatch import Mismatch, levels_on, shapes_of
from pre_core.crossing.preparation import off_bridge_m, prepare
from pre_core.physics.surface import Footprint
from pre_core.survey.plan import Known, Track, Truth, known_before, track_of
from schemas.settings import IdentificationSettings
from schemas.site import Site, Vehicle
from services.common.errors import FailureError, InputError
from services.identification.footprints import footprints_of
from services.simulation.data_alone import data_alone, inputs_of_seen
from services.simulation.drive import simulate_drive
from services.simulation.wheel_paths import REAR_OFFSET_M

Floats = NDArray[np.float64]

_SETTINGS = IdentificationSettings(method="pre", threads=1)
_ROAD_SEED = 1
_NEARBY = (1.0, 1.02, 0.97)
"""Speeds to take instead where rounding leaves the rows no noise: unlike tyres, quiet sensors of
200 Hz and 11.5 m/s."""


class Crossing(NamedTuple):
    """One way to cross: the site's first truck over its first bridge."""

    site: Site
    speed_m_per_s: float
    forward: bool = True


class Road(NamedTuple):
    """What the wheels run on."""

    road_class: str
    """ISO 8608."""
    wander_m: float
    """Standard deviation of the truck's place across the lane, from run to run."""
    is_surface: bool = True
    """Rough across as well; else both axles feel one groove, as simulations may have it."""


class Simulated:
    """Crossings at their truth; each is simulated when it is first asked for."""

    def __init__(self, road: Road) -> None:
        self.road = road
        self._known: list[tuple[Crossing, Truth]] = []

    def truth(self, crossing: Crossing) -> Truth:
        """The posterior of a crossing of the nominal truck and bridge, at the truth."""
        for known, truth in self._known:
            if known == crossing:
                return truth
        truth = _truth(crossing, self.road)
        self._known.append((crossing, truth))
        return truth

    def track(self, crossings: tuple[Crossing, ...]) -> Track:
        """What equally many of some crossings tell that run in one track with tyres alike."""
        for factor in _NEARBY:
            near = [c._replace(speed_m_per_s=factor * c.speed_m_per_s) for c in crossings]
            truths = [self.truth(crossing) for crossing in near]
            whole = mismatch_of(crossings[0].site.vehicles[0], self.road, truths[0].problem)
            try:
                return track_of(truths, whole, self.road.wander_m)
            except ValueError:
                continue
        raise FailureError(
            f"at {crossings[0].speed_m_per_s:g} m/s the noise of the rows cannot be computed, "
            "drive faster or try another --noise"
        )

    def known(self, crossing: Crossing) -> Known:
        """What the site file knows of the bridge."""
        return known_before(self.truth(crossing).problem)

    def compared_m(self, crossing: Crossing) -> float:
        """How many metres of road beside the bridge can be compared at this speed."""
        return off_bridge_m(*self.truth(crossing))


def axles_of(vehicle: Vehicle) -> tuple[Footprint, Footprint]:
    """Where the axles run, as far as the site file tells; axles are set to millimetres."""
    front, rear = footprints_of(vehicle)
    if vehicle.rear_axle_offset_m is None:
        rear = rear._replace(offset_m=REAR_OFFSET_M)
    return front, rear


def mismatch_of(vehicle: Vehicle, road: Road, problem: posterior.Problem) -> Mismatch:
    """By how much this road differs under these axles."""
    front, rear = axles_of(vehicle)
    shapes = shapes_of(front, rear._replace(offset_m=0.0))
    level = levels_on(front, rear, road.road_class) * (1.0 if road.is_surface else 0.0)
    return Mismatch(shapes, level, problem.mismatch.speed_m_per_s)


def scale_error(site: Site) -> float:
    """Relative standard deviation common to all EI: of the total mass, and of all gains."""
    mass = site.vehicles[0].spread("total_mass_kg")
    return float(np.hypot(mass, site.sensor.common_gain_spread))


def _truth(crossing: Crossing, road: Road) -> Truth:
    site, speed = crossing.site, crossing.speed_m_per_s
    drive = simulate_drive(
        site,
        np.ones(site.bridges[0].elements),
        road_class=road.road_class,
        seed=_ROAD_SEED,
        speed_m_per_s=(speed, speed),
        forward=crossing.forward,
    )
    found = data_alone([drive.run], site, _SETTINGS)
    if len(found) != 1:
        raise InputError(
            f"{site.bridges[0].id}: a crossing at {speed:g} m/s is not found in the positions of "
            "[receiver], its values must be those of a receiver that sees the bridge"
        )
    problem, y = prepare(inputs_of_seen(found[0]))
    # What all sensors' gains share stays the same from run to run: it is part of `scale_error`.
    apart = problem.priors._replace(common_gain_spread=0.0)
    return Truth(problem._replace(priors=apart), y)
