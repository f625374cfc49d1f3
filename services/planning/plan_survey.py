"""Forecast of a survey of a site's first bridge by its first truck, from a few wishes."""

from typing import Final, NamedTuple

from schemas.site import Site
from services.common.errors import InputError
from services.common.progress import Steps
from services.finding.placed import middle_site
from services.planning.alternatives import with_noise, with_tyres
from services.planning.crossings import PlannedRoad
from services.planning.survey import SurveyForecast, SurveyQuestion, forecast_survey
from services.simulation.drive import road_class_of

_SPEEDS: Final = (5.0, 20.0)
_USUAL_M_PER_S: Final = 10.0


class SurveyWishes(NamedTuple):
    """Wishes of a survey; None: as in the site file, or the usual one."""

    loss: float = 0.2
    crossings: int = 12
    speeds_m_per_s: tuple[float, float] | None = None
    """Slowest and fastest possible speed."""
    road_class: str | None = None
    tyres: str | None = None
    noise_ug_per_rthz: float | None = None
    wander_m: float = 0.12


def plan_survey(given: Site, wishes: SurveyWishes, report: Steps) -> SurveyForecast:
    """Return the forecast; `report` receives the finished and all jobs.

    Raise InputError for a tandem without load equalisation.
    """
    site = middle_site(given)
    vehicle = site.vehicles[0]
    if vehicle.tandem is not None and not vehicle.tandem.is_equalised:
        raise InputError(
            f"{vehicle.id}: the axles of its tandem have springs of their own, whose friction is "
            "unknown before a drive; a survey is planned for an equalised tandem or for two axles"
        )
    if wishes.tyres is not None:
        site = with_tyres(site, wishes.tyres)
    if wishes.noise_ug_per_rthz is not None:
        site = with_noise(site, (wishes.noise_ug_per_rthz,) * 4)
    speeds = wishes.speeds_m_per_s or _SPEEDS
    wanted = site.bridges[0].survey_speed_m_per_s or _USUAL_M_PER_S
    question = SurveyQuestion(
        wishes.loss, wishes.crossings, min(max(wanted, speeds[0]), speeds[1]), speeds
    )
    road = PlannedRoad(road_class_of(site, wishes.road_class), wishes.wander_m)
    return forecast_survey(site, road, question, report)
