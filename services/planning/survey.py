"""Forecast of a survey: the information of its crossings, and the most useful changes."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final, NamedTuple

import numpy as np

from pre_core.constants import DETECTION_PROBABILITY, NORMAL_975
from pre_core.survey import detection
from pre_core.survey.plan import (
    BridgePrior,
    PlannedPathGroup,
    SurveySpreads,
    non_increasing,
    survey_information,
    survey_spreads,
)
from schemas.site import Bridge, Site
from services.common.arrays import Floats
from services.common.errors import FailureError
from services.common.progress import Steps, no_step_progress
from services.identification.comparison import clear_loss_detectable
from services.planning.alternatives import Plan, alternatives, as_planned
from services.planning.crossings import CrossingSimulator, PlannedCrossing, PlannedRoad, scale_error

_JOINED_M: Final = 1e-6
MAX_CROSSINGS: Final = 300
"""Maximum number of crossings of a survey."""
_COUNTS: Final = (1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120, 200, 300)
"""Numbers of crossings in the figure."""
_SPEEDS: Final = 4


class SurveyQuestion(NamedTuple):
    """Question of a forecast."""

    loss: float
    crossings: int
    speed_m_per_s: float
    """Mean speed of the survey."""
    speeds_m_per_s: tuple[float, float]
    """Slowest and fastest possible speed."""


class SurveyExpectation(NamedTuple):
    """Expected information of a plan's crossings; arrays (e,) by element from the start."""

    crossings: int
    std: Floats
    """Standard deviation of ln EI, with the common part."""
    level_std: float
    seen: Floats
    """Probability of detecting the loss against the nominal value."""
    seen_among_others: Floats
    """The same against the mean of the other elements."""
    smallest_loss: Floats
    """Minimum loss against the nominal value that is detected with `DETECTION_PROBABILITY`."""
    smallest_clear_loss: Floats
    """Minimum loss that a report calls clear against the others, with the same probability."""


class PlanForecast(NamedTuple):
    """A plan with its forecast."""

    plan: Plan
    once: SurveyExpectation
    expected: SurveyExpectation
    middle: int
    """Element at the middle of the longest span; of two, the one with less information."""
    needed_middle: int | None
    """Crossings needed to detect the loss there; None beyond MAX_CROSSINGS."""
    needed_ends: int | None
    """The same at both ends."""
    clear_middle: int | None
    """Crossings until a report calls the loss at the middle clear; None beyond MAX_CROSSINGS."""


class SpeedForecast(NamedTuple):
    """The plan at another speed."""

    speed_m_per_s: float
    std_middle: float
    level_std: float
    seen_middle: float
    smallest_middle: float


class SurveyForecast(NamedTuple):
    """Forecast of a survey, with alternatives."""

    question: SurveyQuestion
    road: PlannedRoad
    planned: PlanForecast
    others: tuple[PlanForecast, ...]
    speeds: tuple[SpeedForecast, ...]
    rougher: PlanForecast | None
    """The plan on a road one class worse."""
    growth: tuple[SurveyExpectation, ...]
    """The plan with an increasing number of crossings."""
    compared_m: float
    """Length of road next to the bridge that is compared at the planned speed."""


def forecast_survey(
    site: Site,
    road: PlannedRoad,
    question: SurveyQuestion,
    progress: Steps = no_step_progress,
) -> SurveyForecast:
    """Forecast a survey of the site's first bridge with its first truck."""
    simulated = CrossingSimulator(road)
    plans = list(alternatives(site, question.speed_m_per_s))
    speeds = _speeds(question)
    jobs = 2 + len(plans) + len(speeds)
    progress(0, jobs)
    planned = _forecast_of(simulated, as_planned(site, question.speed_m_per_s), question)
    progress(1, jobs)
    others = []
    for plan in plans:
        others.append(_forecast_of(simulated, plan, question))
        progress(1 + len(others), jobs)
    at_speeds = []
    for number, speed in enumerate(speeds, start=1):
        # A speed that is only compared with the plan may give no information.
        with suppress(FailureError):
            at_speeds.append(_at_speed(simulated, site, speed, question))
        progress(1 + len(others) + number, jobs)
    growth = _growth(simulated, planned, question)
    crossing = planned.plan.tracks[0][0]
    (as_grown,) = (one for one in growth if one.crossings == question.crossings)
    found = SurveyForecast(
        question,
        road,
        planned._replace(expected=as_grown),
        tuple(others),
        tuple(at_speeds),
        _on_rougher_road(planned.plan, road, question),
        growth,
        simulated.compared_m(crossing),
    )
    progress(jobs, jobs)
    return found


def forecasts(
    road: PlannedRoad, plan: Plan, crossings: int, ratios: Iterable[Floats]
) -> list[SurveySpreads]:
    """Return a plan's spreads for bridges whose EI are `ratios` (e,) of the nominal one."""
    simulated = CrossingSimulator(road)
    tracks = [simulated.track(some) for some in plan.tracks]
    precision = _precision(simulated, plan, tracks, crossings)
    known = simulated.known(plan.tracks[0][0])
    found = []
    for ratio in ratios:
        truth = np.zeros(precision.shape[0])
        truth[truth.size - ratio.size :] = 1.0 / ratio
        found.append(_spreads(known, precision, plan.site, truth))
    return found


def _speeds(question: SurveyQuestion) -> list[float]:
    """Return speeds to compare, from the slowest to the fastest; none without a range."""
    low, high = question.speeds_m_per_s
    return np.geomspace(low, high, _SPEEDS).round(1).tolist() if high > low else []


def _on_rougher_road(
    plan: Plan, road: PlannedRoad, question: SurveyQuestion
) -> PlanForecast | None:
    if road.road_class == "E":
        return None
    rougher = road._replace(road_class=chr(ord(road.road_class) + 1))
    return _forecast_of(CrossingSimulator(rougher), plan, question)


def _forecast_of(
    simulated: CrossingSimulator, plan: Plan, question: SurveyQuestion
) -> PlanForecast:
    tracks = [simulated.track(crossings) for crossings in plan.tracks]
    middles = middle_elements(plan.site.bridges[0])
    last = plan.site.bridges[0].elements - 1

    def is_seen(crossings: int, elements: tuple[int, ...]) -> bool:
        errors = _errors(simulated, plan, tracks, crossings)
        seen = detection.detection_probability(question.loss, errors.of_nominal)
        return bool(seen[list(elements)].min() >= DETECTION_PROBABILITY)

    def is_clear(crossings: int) -> bool:
        errors = _errors(simulated, plan, tracks, crossings)
        clear = clear_loss_detectable(NORMAL_975 * errors.of_others)
        return bool(clear[list(middles)].max() <= question.loss)

    expected = _expected(simulated, plan, tracks, question.crossings, question.loss)
    return PlanForecast(
        plan,
        _expected(simulated, plan, tracks, 1, question.loss),
        expected,
        _less_determined(plan.site.bridges[0], expected),
        _needed(lambda crossings: is_seen(crossings, middles), plan.fewest_crossings),
        _needed(lambda crossings: is_seen(crossings, (0, last)), plan.fewest_crossings),
        _needed(is_clear, plan.fewest_crossings),
    )


def _less_determined(bridge: Bridge, expected: SurveyExpectation) -> int:
    """Return the element at the middle with less information."""
    return max(middle_elements(bridge), key=lambda element: expected.smallest_loss[element])


def _precision(
    simulated: CrossingSimulator, plan: Plan, tracks: list[PlannedPathGroup], crossings: float
) -> Floats:
    known = simulated.known(plan.tracks[0][0])
    return survey_information(tracks, crossings, known.log_odds.size)


def _errors(
    simulated: CrossingSimulator, plan: Plan, tracks: list[PlannedPathGroup], crossings: int
) -> detection.DetectionErrors:
    precision = _precision(simulated, plan, tracks, crossings)
    return detection.detection_errors(
        simulated.known(plan.tracks[0][0]), precision, scale_error(plan.site)
    )


def _expected(
    simulated: CrossingSimulator,
    plan: Plan,
    tracks: list[PlannedPathGroup],
    crossings: int,
    loss: float,
) -> SurveyExpectation:
    precision = _precision(simulated, plan, tracks, crossings)
    known, scale = simulated.known(plan.tracks[0][0]), scale_error(plan.site)
    wide = _spreads(known, precision, plan.site)
    errors = detection.detection_errors(known, precision, scale)
    return SurveyExpectation(
        crossings,
        wide.elements,
        wide.level,
        detection.detection_probability(loss, errors.of_nominal),
        detection.detection_probability(loss, errors.of_others),
        detection.minimum_detectable_loss(errors.of_nominal),
        clear_loss_detectable(NORMAL_975 * errors.of_others),
    )


def _spreads(
    known: BridgePrior, precision: Floats, site: Site, truth: Floats | None = None
) -> SurveySpreads:
    """Return standard deviations of ln EI, with the common part."""
    wide = survey_spreads(known, precision, np.array(site.bridges[0].lengths_m), truth)
    scale = scale_error(site)
    return SurveySpreads(np.hypot(wide.elements, scale), float(np.hypot(wide.level, scale)))


def _growth(
    simulated: CrossingSimulator, planned: PlanForecast, question: SurveyQuestion
) -> tuple[SurveyExpectation, ...]:
    plan = planned.plan
    tracks = [simulated.track(crossings) for crossings in plan.tracks]
    known = {one.crossings: one for one in (planned.once, planned.expected)}
    found = [
        known.get(count) or _expected(simulated, plan, tracks, count, question.loss)
        for count in sorted({*_COUNTS, *known})
    ]
    std = non_increasing(np.array([one.std for one in found]))
    level = non_increasing(np.array([[one.level_std] for one in found]))
    return tuple(
        one._replace(std=wide, level_std=float(whole[0]))
        for one, wide, whole in zip(found, std, level, strict=True)
    )


def _at_speed(
    simulated: CrossingSimulator, site: Site, speed: float, question: SurveyQuestion
) -> SpeedForecast:
    plan = Plan(f"at {speed:g} m/s", ((PlannedCrossing(site, speed),),))
    tracks = [simulated.track(crossings) for crossings in plan.tracks]
    expected = _expected(simulated, plan, tracks, question.crossings, question.loss)
    middle = _less_determined(site.bridges[0], expected)
    return SpeedForecast(
        speed,
        float(expected.std[middle]),
        expected.level_std,
        float(expected.seen[middle]),
        float(expected.smallest_loss[middle]),
    )


def _needed(is_enough: Callable[[int], bool], fewest: int = 1) -> int | None:
    """Return the fewest crossings that are enough, at least `fewest`; None beyond MAX_CROSSINGS."""
    if not is_enough(MAX_CROSSINGS):
        return None
    too_few, enough = fewest - 1, MAX_CROSSINGS
    while enough - too_few > 1:
        tried = (too_few + enough) // 2 if enough < 64 else round(np.sqrt(max(1, too_few) * enough))
        tried = min(max(tried, too_few + 1), enough - 1)
        too_few, enough = (too_few, tried) if is_enough(tried) else (tried, enough)
    return enough


def middle_elements(bridge: Bridge) -> tuple[int, ...]:
    """Return the elements, from 0, at the middle of the longest span: two where they meet there."""
    spans = bridge.lengths_of_spans_m
    longest = spans.index(max(spans))
    at = sum(spans[:longest]) + 0.5 * spans[longest]
    ends = np.cumsum(bridge.lengths_m)
    first = min(int(np.searchsorted(ends, at - _JOINED_M)), bridge.elements - 1)
    meets_next = bool(abs(ends[first] - at) <= _JOINED_M) and first + 1 < bridge.elements
    return (first, first + 1) if meets_next else (first,)
