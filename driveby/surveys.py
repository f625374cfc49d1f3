"""Forecasts of surveys in a notebook, as by `driveby survey`."""

from typing import Any, NamedTuple

from schemas.site import Site
from services.common.errors import InputError
from services.execution.blas import one_blas_thread
from services.notebook.read import Name, given_site
from services.planning.forecast_text import as_json, lines_of
from services.planning.plan_survey import SurveyWishes, plan_survey
from services.planning.survey import SurveyForecast


class SurveyPlan(NamedTuple):
    """Plan of a survey, with its expected accuracy and detection."""

    survey: SurveyForecast

    def __repr__(self) -> str:
        """Return the lines that `driveby survey` prints."""
        return "\n".join(lines_of(self.survey))

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers, as `driveby survey --json` writes them."""
        return as_json(self.survey)


def survey(
    site: Name | Site,
    *,
    loss: float = 0.2,
    crossings: int = 12,
    speed: float | tuple[float, float] | None = None,
    road: str | None = None,
    tyres: str | None = None,
    noise: float | None = None,
) -> SurveyPlan:
    """Forecast a survey of the site's first bridge by its first truck.

    The options are those of `driveby survey` but for `--wander`; `speed` is in m/s, or a pair
    (slowest, fastest). BLAS is limited to one thread meanwhile. Raise InputError, in one line, for
    an impossible value.
    """
    slowest, fastest = speed if isinstance(speed, tuple) else (speed, speed)
    for what, value, low, high in (
        ("loss", loss, 0.01, 0.95),
        ("crossings", crossings, 1, 300),
        ("speed", slowest, 1, 50),
        ("speed", fastest, slowest or 1, 50),
        ("noise", noise, 0.1, 1e6),
    ):
        if value is not None and not low <= value <= high:
            raise InputError(f"{what} is {value:g}, it must be from {low:g} to {high:g}")
    for what, choice, known in (("road", road, "ABCDE"), ("tyres", tyres, ("single", "twin"))):
        if choice is not None and choice not in tuple(known):
            raise InputError(f'{what} is "{choice}", it must be one of {", ".join(known)}')
    speeds = None if slowest is None or fastest is None else (slowest, fastest)
    wishes = SurveyWishes(loss, crossings, speeds, road, tyres, noise)
    with one_blas_thread():
        return SurveyPlan(plan_survey(given_site(site), wishes, lambda done, jobs: None))
