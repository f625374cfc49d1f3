"""Forecasts of `driveby survey` for simulated surveys, to compare with their results."""

from collections.abc import Sequence

import numpy as np

from schemas.site import Site
from services.planning.alternatives import Plan, as_planned, with_tyres
from services.planning.crossings import PlannedRoad
from services.planning.survey import forecasts
from services.simulation.survey_kinds import KINDS, SurveyKind
from studies.validation.surveys import (
    SPEED_M_PER_S,
    Forecast,
    FusedSurvey,
    sites_of,
)


def forecasts_of(site: Site, found: Sequence[FusedSurvey]) -> dict[str, Forecast]:
    """Return a forecast for each kind of survey, by its plan and the EI of its surveys.

    All else of truck and bridge is nominal, as in `driveby survey`; declared are the tyres, the
    rear axle's lateral offset, and whether both axles follow one profile.
    """
    out = {}
    for name in dict.fromkeys(one.kind for one in found):
        kind = KINDS[name]
        plan = _plan(site, kind)
        nominal = np.array(plan.site.bridges[0].nominal_flexural_rigidity_nm2)
        ratios = [one.truth / nominal for one in found if one.kind == name]
        road = PlannedRoad("A", kind.wander_m, is_surface=kind.tyres is not None or kind.has_tandem)
        spreads = forecasts(road, plan, kind.crossings, ratios)
        out[name] = Forecast(
            float(np.median(np.concatenate([one.elements for one in spreads]))),
            float(np.median([one.level for one in spreads])),
        )
    return out


def _plan(site: Site, kind: SurveyKind) -> Plan:
    """Return a plan in which all trucks take turns in one lane; half the other way in another."""
    there = tuple(
        crossing
        for of_truck in sites_of(site, kind)
        for crossing in as_planned(_with_wheels(of_truck, kind), SPEED_M_PER_S).tracks[0]
    )
    back = tuple(crossing._replace(forward=False) for crossing in there)
    return Plan("as driven", (there, back) if kind.both_ways else (there,))


def _with_wheels(site: Site, kind: SurveyKind) -> Site:
    if site.vehicles[0].tandem is not None:
        return _with_offset(site, kind.offset_m)
    if kind.tyres is None:
        return site
    known = with_tyres(site, kind.tyres)
    aside = known.vehicles[0].model_copy(update={"rear_axle_offset_m": kind.offset_m})
    return known.model_copy(update={"vehicles": (aside,)})


def _with_offset(site: Site, offset_m: float) -> Site:
    """Return a site whose truck's last axle runs `offset_m` to the left of the others."""
    vehicle = site.vehicles[0]
    last = vehicle.axles[-1].model_copy(update={"lateral_offset_m": offset_m})
    aside = vehicle.model_copy(update={"axles": (*vehicle.axles[:-1], last)})
    return site.model_copy(update={"vehicles": (aside,)})
