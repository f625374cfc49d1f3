"""A survey's expectation: what so many crossings will tell, and what would help most."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.survey import detection
from pre_core.survey.plan import Known, Spreads, Track, spreads, together
from schemas.site import Bridge, Site
from services.common.errors import FailureError
from services.planning.alternatives import Plan, alternatives, as_planned
from services.planning.crossings import Crossing, Road, Simulated, scale_error

Floats = NDArray[np.float64]

_JOINED_M: Final = 1e-6
MOST_CROSSINGS: Final = 300
"""Nobody drives more often."""
_COUNTS: Final = (1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120, 200, 300)
"""Numbers of crossings that the figure shows."""
_SPEEDS: Final = 4


class Asked(NamedTuple):
    """What the engineer wants to know."""

    loss: float
    crossings: int
    speed_m_per_s: float
    """About which the survey drives."""
    speeds_m_per_s: tuple[float, float]
    """That are possible."""


class Expected(NamedTuple):
    """What a plan's crossings tell; arrays (e,) by element from the bridge's start."""

    crossings: int
    std: Floats
    """Of ln EI, with what is common to all."""
    level_std: float
    seen: Floats
    """Probability that the loss is seen against the nominal value."""
    seen_among_others: Floats
    """The same against the mean of the other elements."""
    smallest_loss: Floats
    """That is seen with probability `detection.SURE` against the nominal value."""


class Outlook(NamedTuple):
    """A plan, with what it tells."""

    plan: Plan
    once: Expected
    expected: Expected
    middle: int
    """The element at the middle of the longest span; of two, the one that is told less."""
    needed_middle: int | None
    """Crossings by which the loss is seen there for sure; None: more than MOST_CROSSINGS."""
    needed_ends: int | None
    """The same at both ends."""


class AtSpeed(NamedTuple):
    """The plan at another speed."""

    speed_m_per_s: float
    std_middle: float
    level_std: float
    seen_middle: float
    smallest_middle: float


class Survey(NamedTuple):
    """All that is found."""

    asked: Asked
    road: Road
    planned: Outlook
    others: tuple[Outlook, ...]
    speeds: tuple[AtSpeed, ...]
    rougher: Outlook | None
    """The plan on a road one class worse."""
    growth: tuple[Expected, ...]
    """The plan with more and more crossings."""
    compared_m: float
    """Of road beside the bridge, at the planned speed."""


def survey(
    site: Site,
    road: Road,
    asked: Asked,
    progress: Callable[[int, int], None] = lambda done, jobs: None,
) -> Survey:
    """Plan a survey of the site's first bridge with its first truck."""
    simulated = Simulated(road)
    plans = list(alternatives(site, asked.speed_m_per_s))
    speeds = _speeds(asked)
    jobs = 2 + len(plans) + len(speeds)
    planned = _outlook(simulated, as_planned(site, asked.speed_m_per_s), asked)
    progress(1, jobs)
    others = []
    for plan in plans:
        others.append(_outlook(simulated, plan, asked))
        progress(1 + len(others), jobs)
    at_speeds = []
    for number, speed in enumerate(speeds, start=1):
        # A speed that is only looked at beside the plan may be one that tells nothing.
        with suppress(FailureError):
            at_speeds.append(_at_speed(simulated, site, speed, asked))
        progress(1 + len(others) + number, jobs)
    growth = _growth(simulated, planned.plan, asked)
    crossing = planned.plan.tracks[0][0]
    found = Survey(
        asked,
        road,
        planned,
        tuple(others),
        tuple(at_speeds),
        _on_rougher_road(planned.plan, road, asked),
        growth,
        simulated.compared_m(crossing),
    )
    progress(jobs, jobs)
    return found


def forecasts(road: Road, plan: Plan, crossings: int, ratios: Iterable[Floats]) -> list[Spreads]:
    """What a plan's crossings tell of bridges whose EI (e,) is so many times the nominal one."""
    simulated = Simulated(road)
    tracks = [simulated.track(some) for some in plan.tracks]
    precision = _precision(simulated, plan, tracks, crossings)
    known = simulated.known(plan.tracks[0][0])
    found = []
    for ratio in ratios:
        truth = np.zeros(precision.shape[0])
        truth[truth.size - ratio.size :] = 1.0 / ratio
        found.append(_spreads(known, precision, plan.site, truth))
    return found


def _speeds(asked: Asked) -> list[float]:
    """Speeds to compare, from the slowest to the fastest; none where there is no choice."""
    low, high = asked.speeds_m_per_s
    return np.geomspace(low, high, _SPEEDS).round(1).tolist() if high > low else []


def _on_rougher_road(plan: Plan, road: Road, asked: Asked) -> Outlook | None:
    if road.road_class == "E":
        return None
    rougher = road._replace(road_class=chr(ord(road.road_class) + 1))
    return _outlook(Simulated(rougher), plan, asked)


def _outlook(simulated: Simulated, plan: Plan, asked: Asked) -> Outlook:
    tracks = [simulated.track(crossings) for crossings in plan.tracks]
    middles = middle_elements(plan.site.bridges[0])
    last = plan.site.bridges[0].elements - 1

    def errors_of(crossings: int) -> detection.Errors:
        return _errors(simulated, plan, tracks, crossings)

    expected = _expected(simulated, plan, tracks, asked.crossings, asked.loss)
    return Outlook(
        plan,
        _expected(simulated, plan, tracks, 1, asked.loss),
        expected,
        _told_less(plan.site.bridges[0], expected),
        _needed(errors_of, asked.loss, middles),
        _needed(errors_of, asked.loss, (0, last)),
    )


def _told_less(bridge: Bridge, expected: Expected) -> int:
    """Which element at the middle is told less."""
    return max(middle_elements(bridge), key=lambda element: expected.smallest_loss[element])


def _precision(simulated: Simulated, plan: Plan, tracks: list[Track], crossings: float) -> Floats:
    known = simulated.known(plan.tracks[0][0])
    return together(tracks, crossings, known.log_odds.size)


def _errors(
    simulated: Simulated, plan: Plan, tracks: list[Track], crossings: int
) -> detection.Errors:
    precision = _precision(simulated, plan, tracks, crossings)
    return detection.errors(simulated.known(plan.tracks[0][0]), precision, scale_error(plan.site))


def _expected(
    simulated: Simulated, plan: Plan, tracks: list[Track], crossings: int, loss: float
) -> Expected:
    precision = _precision(simulated, plan, tracks, crossings)
    known, scale = simulated.known(plan.tracks[0][0]), scale_error(plan.site)
    wide = _spreads(known, precision, plan.site)
    errors = detection.errors(known, precision, scale)
    return Expected(
        crossings,
        wide.elements,
        wide.level,
        detection.probability(loss, errors.of_nominal),
        detection.probability(loss, errors.of_others),
        detection.smallest_loss(errors.of_nominal),
    )


def _spreads(known: Known, precision: Floats, site: Site, truth: Floats | None = None) -> Spreads:
    """Of ln EI, with what is common to all."""
    wide = spreads(known, precision, np.array(site.bridges[0].lengths_m), truth)
    scale = scale_error(site)
    return Spreads(np.hypot(wide.elements, scale), float(np.hypot(wide.level, scale)))


def _growth(simulated: Simulated, plan: Plan, asked: Asked) -> tuple[Expected, ...]:
    tracks = [simulated.track(crossings) for crossings in plan.tracks]
    counts = sorted({*_COUNTS, asked.crossings})
    return tuple(_expected(simulated, plan, tracks, count, asked.loss) for count in counts)


def _at_speed(simulated: Simulated, site: Site, speed: float, asked: Asked) -> AtSpeed:
    plan = Plan(f"at {speed:g} m/s", ((Crossing(site, speed),),))
    tracks = [simulated.track(crossings) for crossings in plan.tracks]
    expected = _expected(simulated, plan, tracks, asked.crossings, asked.loss)
    middle = _told_less(site.bridges[0], expected)
    return AtSpeed(
        speed,
        float(expected.std[middle]),
        expected.level_std,
        float(expected.seen[middle]),
        float(expected.smallest_loss[middle]),
    )


def _needed(
    errors_of: Callable[[int], detection.Errors], loss: float, elements: tuple[int, ...]
) -> int | None:
    """The fewest crossings by which the loss is seen for sure in these elements."""

    def is_seen(crossings: int) -> bool:
        seen = detection.probability(loss, errors_of(crossings).of_nominal)
        return bool(seen[list(elements)].min() >= detection.SURE)

    if not is_seen(MOST_CROSSINGS):
        return None
    too_few, enough = 0, MOST_CROSSINGS
    while enough - too_few > 1:
        tried = (too_few + enough) // 2 if enough < 64 else round(np.sqrt(max(1, too_few) * enough))
        tried = min(max(tried, too_few + 1), enough - 1)
        too_few, enough = (too_few, tried) if is_seen(tried) else (tried, enough)
    return enough


def middle_elements(bridge: Bridge) -> tuple[int, ...]:
    """Which elements, from 0, lie at the middle of the longest span: two where they meet there."""
    spans = bridge.lengths_of_spans_m
    longest = spans.index(max(spans))
    at = sum(spans[:longest]) + 0.5 * spans[longest]
    ends = np.cumsum(bridge.lengths_m)
    first = min(int(np.searchsorted(ends, at - _JOINED_M)), bridge.elements - 1)
    meets_next = bool(abs(ends[first] - at) <= _JOINED_M) and first + 1 < bridge.elements
    return (first, first + 1) if meets_next else (first,)
