"""Possible crossings of a survey, simulated once each, with their information on a bridge.

Truck and bridge are nominal. Both axles follow one profile, and the model's mismatch is the one
that a surface of this class would cause: so the residuals are at the truth, independently of the
simulated surface.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import parameters
from pre_core.crossing import posterior
from pre_core.crossing.mismatch import Mismatch, expected_levels, mismatch_spectra
from pre_core.crossing.off_bridge import compared_length_m
from pre_core.crossing.preparation import build_problem
from pre_core.physics.surface import Footprint
from pre_core.survey.plan import (
    BridgePrior,
    PlannedPathGroup,
    PosteriorAtTruth,
    bridge_prior,
    planned_path_group,
)
from schemas.settings import IdentificationSettings
from schemas.site import Site, Vehicle
from services.common.errors import FailureError, InputError
from services.drives.runs import Run
from services.identification.footprints import footprints_of
from services.simulation.data_alone import crossing_data_only, inputs_of_seen
from services.simulation.drive import DrivenRoad, simulate_drive
from services.simulation.drive_tandem import TandemDrive, tandem_case
from services.simulation.wheel_paths import REAR_OFFSET_M
from services.simulation.wide_crossings import drive_case

_SETTINGS = IdentificationSettings(method="pre", threads=1)
_ROAD_SEED = 1
_MEDIAN_OF_HALF_NORMAL = 0.6745
_NEARBY = (1.0, 1.02, 0.97)
"""Factors of the speed to use where rounding leaves the residuals without noise.

This occurs with single and twin tyres, quiet sensors of 200 Hz and 11.5 m/s.
"""


class PlannedCrossing(NamedTuple):
    """A planned crossing of the site's first bridge by its first truck."""

    site: Site
    speed_m_per_s: float
    forward: bool = True


class PlannedRoad(NamedTuple):
    """The road of a planned crossing."""

    road_class: str
    """Road class of ISO 8608."""
    wander_m: float
    """Standard deviation of the truck's lateral position between runs, m."""
    is_surface: bool = True
    """Whether the road is also rough across; otherwise both axles follow one profile."""


class CrossingSimulator:
    """Simulator of crossings at the truth; each is simulated at its first request."""

    def __init__(self, road: PlannedRoad) -> None:
        self.road = road
        self._known: list[tuple[PlannedCrossing, PosteriorAtTruth]] = []

    def truth(self, crossing: PlannedCrossing) -> PosteriorAtTruth:
        """Return the posterior of a crossing of the nominal truck and bridge, at the truth."""
        for known, truth in self._known:
            if known == crossing:
                return truth
        truth = _truth(crossing, self.road)
        self._known.append((crossing, truth))
        return truth

    def track(self, crossings: tuple[PlannedCrossing, ...]) -> PlannedPathGroup:
        """Return the information of equally many of some crossings in one wheel-path group."""
        for factor in _NEARBY:
            near = [c._replace(speed_m_per_s=factor * c.speed_m_per_s) for c in crossings]
            truths = [self.truth(crossing) for crossing in near]
            whole = mismatch_of(crossings[0].site.vehicles[0], self.road, truths[0].problem)
            try:
                return planned_path_group(truths, whole, self.road.wander_m)
            except ValueError:
                continue
        raise FailureError(
            f"at {crossings[0].speed_m_per_s:g} m/s the noise of the residuals cannot be computed, "
            "drive faster or try another --noise"
        )

    def known(self, crossing: PlannedCrossing) -> BridgePrior:
        """Return the information of the site file on the bridge."""
        return bridge_prior(self.truth(crossing).problem)

    def compared_m(self, crossing: PlannedCrossing) -> float:
        """Return the length of road next to the bridge that is compared at this speed, m."""
        return compared_length_m(*self.truth(crossing))


def axles_of(vehicle: Vehicle) -> tuple[Footprint, Footprint]:
    """Return the footprints of the axles, as far as declared; axles are set to millimetres."""
    front, rear = footprints_of(vehicle)
    if not has_declared_offset(vehicle):
        rear = rear._replace(offset_m=REAR_OFFSET_M)
    return front, rear


def has_declared_offset(vehicle: Vehicle) -> bool:
    """Return whether the site file has the lateral offset between the compared axles."""
    if vehicle.tandem is None:
        return vehicle.rear_axle_offset_m is not None
    return any(axle.lateral_offset_m is not None for axle in vehicle.tandem.axles)


def mismatch_of(
    vehicle: Vehicle, road: PlannedRoad, problem: posterior.PosteriorProblem
) -> Mismatch:
    """Return the profile mismatch of this road under these axles."""
    front, rear = axles_of(vehicle)
    shapes = mismatch_spectra(front, rear._replace(offset_m=0.0))
    level = expected_levels(front, rear, road.road_class) * (1.0 if road.is_surface else 0.0)
    return Mismatch(shapes, level, problem.mismatch.speed_m_per_s)


def scale_error(site: Site) -> float:
    """Return the relative standard deviation common to all EI: total mass, and all gains."""
    mass = site.vehicles[0].spread("total_mass_kg")
    return float(np.hypot(mass, site.sensor.common_gain_spread))


def _truth(crossing: PlannedCrossing, road: PlannedRoad) -> PosteriorAtTruth:
    site, speed = crossing.site, crossing.speed_m_per_s
    found = crossing_data_only([_run(crossing, road)], site, _SETTINGS)
    if len(found) != 1:
        raise InputError(
            f"{site.bridges[0].id}: with the accuracy that [receiver] declares, a crossing at "
            f"{speed:g} m/s cannot be detected from positions; correct its values"
        )
    problem, y = build_problem(inputs_of_seen(found[0]))
    y[_undamped_tyres(problem, site)] = _MEDIAN_OF_HALF_NORMAL
    # The common part of all sensors' gains is constant between runs: `scale_error` has it.
    apart = problem.priors._replace(common_gain_spread=0.0)
    return PosteriorAtTruth(problem._replace(priors=apart), y)


def _run(crossing: PlannedCrossing, road: PlannedRoad) -> Run:
    """Simulate the crossing without noise, all axles on one profile."""
    site, speed = crossing.site, crossing.speed_m_per_s
    undamaged = np.ones(site.bridges[0].elements)
    if site.vehicles[0].tandem is not None:
        of_road = (road.road_class, _ROAD_SEED)
        how = TandemDrive(of_road, speed_m_per_s=speed, forward=crossing.forward)
        return drive_case(tandem_case(_with_damped_tyres(site), undamaged, how), 0).run
    return simulate_drive(
        site,
        undamaged,
        DrivenRoad(road.road_class, _ROAD_SEED),
        speed_m_per_s=(speed, speed),
        forward=crossing.forward,
    ).run


def _undamped_tyres(problem: posterior.PosteriorProblem, site: Site) -> NDArray[np.int64]:
    """Return the indices in y of the tyre damping that `_with_damped_tyres` changes."""
    if site.vehicles[0].tandem is None:
        return np.zeros(0, dtype=np.int64)
    kept = np.flatnonzero(problem.priors.estimated)
    of_tyres = np.isin(kept, (parameters.C_U1, parameters.C_U1 + 1))
    return np.flatnonzero(of_tyres & problem.priors.half_normal[kept])


def _with_damped_tyres(site: Site) -> Site:
    """Return the site with the median of the prior where damping of a tandem's tyres is zero.

    Two axles that share their load bounce in opposite directions without moving their springs.
    Only the tyres damp that: without damping it shakes the bridge, whose response passes for
    information.
    """
    vehicle = site.vehicles[0]
    damping = _MEDIAN_OF_HALF_NORMAL * vehicle.scale_at_zero("tyre_damping_ns_per_m")
    ahead = vehicle.axles[:-2]
    damped = [
        axle.model_copy(update={"tyre_damping_ns_per_m": axle.tyre_damping_ns_per_m or damping})
        for axle in vehicle.axles[len(ahead) :]
    ]
    changed = vehicle.model_copy(update={"axles": (*ahead, *damped)})
    return site.model_copy(update={"vehicles": (changed,)})
