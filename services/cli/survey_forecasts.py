"""What `driveby survey` says of surveys before they are driven, beside what they achieve."""

from collections.abc import Sequence

import numpy as np

from schemas.site import Site
from services.planning.alternatives import Plan, as_planned, with_tyres
from services.planning.crossings import Road
from services.planning.survey import forecasts
from services.validation.surveys import (
    KINDS,
    SPEED_M_PER_S,
    Forecast,
    Fused,
    Kind,
    sites_of,
)


def forecasts_of(site: Site, found: Sequence[Fused]) -> dict[str, Forecast]:
    """For each kind of survey, by its plan and by the EI of the surveys that were driven.

    All else of truck and bridge is nominal, as `driveby survey` has it; it is told of the tyres
    and of how far the rear axle runs aside, and that both axles feel one groove where they do.
    """
    out = {}
    for name in dict.fromkeys(one.kind for one in found):
        kind = KINDS[name]
        plan = _plan(site, kind)
        nominal = np.array(plan.site.bridges[0].nominal_flexural_rigidity_nm2)
        ratios = [one.truth / nominal for one in found if one.kind == name]
        road = Road("A", kind.wander_m, is_surface=kind.tyres is not None)
        told = forecasts(road, plan, kind.crossings, ratios)
        out[name] = Forecast(
            float(np.median(np.concatenate([one.elements for one in told]))),
            float(np.median([one.level for one in told])),
        )
    return out


def _plan(site: Site, kind: Kind) -> Plan:
    """All trucks take turns in one lane; half of their runs the other way in another."""
    there = tuple(
        crossing
        for of_truck in sites_of(site, kind)
        for crossing in as_planned(_with_wheels(of_truck, kind), SPEED_M_PER_S).tracks[0]
    )
    back = tuple(crossing._replace(forward=False) for crossing in there)
    return Plan("as driven", (there, back) if kind.both_ways else (there,))


def _with_wheels(site: Site, kind: Kind) -> Site:
    if kind.tyres is None:
        return site
    known = with_tyres(site, kind.tyres)
    aside = known.vehicles[0].model_copy(update={"rear_axle_offset_m": kind.offset_m})
    return known.model_copy(update={"vehicles": (aside,)})
