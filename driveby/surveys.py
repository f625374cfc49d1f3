"""Forecasts of surveys in a notebook, as by `driveby survey`."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from numpy.typing import NDArray

from schemas.site import Site
from services.common.errors import InputError
from services.common.field_docs import with_field_docs
from services.execution.blas import one_blas_thread
from services.notebook.arguments import known_arguments, number, one_or_two, whole
from services.notebook.read import Name, given_site
from services.planning.forecast_text import as_json, lines_of
from services.planning.plan_survey import SurveyWishes, plan_survey
from services.planning.survey import SurveyForecast


@with_field_docs
class SurveyPlan(NamedTuple):
    """Plan of a survey, with its expected accuracy and detection."""

    survey: SurveyForecast
    """Expected accuracy and detection; `as_dict` returns its numbers."""

    def __repr__(self) -> str:
        """Return the lines that `driveby survey` prints."""
        return "\n".join(lines_of(self.survey))

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers, as `driveby survey --json` writes them."""
        return as_json(self.survey)


@known_arguments()
def survey(
    site: Name | Site,
    *,
    loss: float = 0.2,
    crossings: int = 12,
    speed: float | Sequence[float] | NDArray[Any] | None = None,
    road: str | None = None,
    tyres: str | None = None,
    noise: float | None = None,
) -> SurveyPlan:
    """Forecast a survey of the site's first bridge by its first truck.

    The options are those of `driveby survey` but for `--wander`; `speed` is in m/s, or a pair (2,):
    slowest and fastest. BLAS is limited to one thread meanwhile. Raise InputError, in one line, for
    an impossible value.
    """
    speeds = None if speed is None else one_or_two("speed", speed, 1, 50, "(slowest, fastest)")
    if speeds is not None:
        number("speed", speeds[1], speeds[0], 50)
    for what, choice, known in (("road", road, "ABCDE"), ("tyres", tyres, ("single", "twin"))):
        if choice is not None and choice not in tuple(known):
            raise InputError(f'{what} is "{choice}", it must be one of {", ".join(known)}')
    wishes = SurveyWishes(
        number("loss", loss, 0.01, 0.95),
        whole("crossings", crossings, 1, 300),
        speeds,
        road,
        tyres,
        None if noise is None else number("noise", noise, 0.1, 1e6),
    )
    with one_blas_thread():
        return SurveyPlan(plan_survey(given_site(site), wishes, lambda done, jobs: None))
