"""The forecast of a survey in words: its resolution, the most useful change, its limits."""

from collections.abc import Iterator
from math import inf
from typing import Final, NamedTuple

from pre_core.constants import DETECTION_PROBABILITY
from services.common.naming import count_of
from services.common.truck_choice import truck_to_try
from services.identification.checks import SHORTEST_APPROACH_M
from services.identification.identify import SLOWEST_M_PER_S
from services.inspection.finding import CheckStatus
from services.inspection.site import (
    findings_of_bridge,
    findings_of_truck,
    noise_declared,
    sampling,
)
from services.planning.alternatives import EQUAL_TYRES, TANDEM
from services.planning.crossings import axles_of, has_declared_offset
from services.planning.survey import MAX_CROSSINGS, PlanForecast, SurveyForecast

_WORTH_NAMING: Final = 0.75
"""Share of the plan's crossings or smallest loss below which an alternative is worth a sentence."""
_POSSIBLE: Final = 100
"""Crossings beyond which a survey is no advice, unless more are planned."""
_SMALLER_LOSS: Final = 0.95
"""The same share of the smallest loss where no number of crossings detects the loss in question."""


class _Change(NamedTuple):
    """A change of the plan that helps."""

    text: str
    gain: str
    cost: int
    """Rank of its cost; 0: none."""
    rank: tuple[float, float, float]
    """Rank of its effect; less is better."""


def advice(found: SurveyForecast) -> str:
    """Return a sentence on the plan, and one on the most useful change."""
    return f"{_of_the_plan(found)} {_of_the_others(found)}"


def tyres_of(outlook: PlanForecast) -> str:
    """Return the tyres of a plan in words."""
    vehicle = outlook.plan.site.vehicles[0]
    front, rear = axles_of(vehicle)
    if vehicle.tandem is not None:
        return f"{'twin' if rear.twin_distance_m > 0.0 else 'single'} tyres on its tandem"
    if rear.twin_distance_m > 0.0:
        return "twin rear tyres"
    is_equal = rear._replace(offset_m=front.offset_m) == front
    return "equal single tyres" if is_equal else "single tyres"


def mismatch_in_words(found: SurveyForecast) -> str:
    """Return the causes of profile mismatch in words, and whether they were given."""
    vehicle = found.planned.plan.site.vehicles[0]
    front, rear = axles_of(vehicle)
    offset_mm = 1e3 * abs(rear.offset_m - front.offset_m)
    if vehicle.tandem is not None:
        given = "" if has_declared_offset(vehicle) else " (assumed, lateral_offset_m)"
        first = vehicle.tandem.number
        which = f"offset of axle {first + 1} from {first}"
    else:
        given = "" if has_declared_offset(vehicle) else " (assumed, rear_axle_offset_m)"
        which = "rear axle offset"
    return f"{which} {offset_mm:g} mm{given}, lateral wander {found.road.wander_m:g} m"


def percent(share: float) -> str:
    """Return a share in whole per cent."""
    return f"{100.0 * float(share):.0f} %"


def _of_the_plan(found: SurveyForecast) -> str:
    planned, question = found.planned, found.question
    how = f"at {question.speed_m_per_s:g} m/s with {tyres_of(planned)}"
    wanted = percent(DETECTION_PROBABILITY)
    what = f"a {percent(question.loss)} loss at midspan with {wanted} probability"
    if planned.needed_middle is None:
        smallest = planned.expected.smallest_loss[planned.middle]
        return (
            f"Even {MAX_CROSSINGS} crossings {how} do not detect {what}; {question.crossings} "
            f"detect a loss of {percent(smallest)} or more, and give the overall stiffness to "
            f"± {percent(planned.expected.level_std)}."
        )
    count = count_of(planned.needed_middle, "crossing")
    verb = "detects" if planned.needed_middle == 1 else "detect"
    return f"{count} {how} {verb} {what}; {_ends(planned)}. {_clear(planned)}"


def _ends(outlook: PlanForecast) -> str:
    if outlook.needed_ends is None:
        return f"the ends would take more than {MAX_CROSSINGS}"
    if outlook.needed_ends == outlook.needed_middle:
        return "the ends need no more"
    return f"the ends need {outlook.needed_ends}"


def _clear(planned: PlanForecast) -> str:
    """Return a sentence on the loss that a report, which compares elements, calls clear."""
    if planned.clear_middle is not None:
        return f"A report calls it clear after {count_of(planned.clear_middle, 'crossing')}."
    smallest = percent(planned.expected.smallest_clear_loss[planned.middle])
    return (
        f"A report does not call it clear even after {MAX_CROSSINGS}; after "
        f"{planned.expected.crossings} it calls a loss of {smallest} clear."
    )


def _of_the_others(found: SurveyForecast) -> str:
    planned = found.planned
    # A loss in one of fewer, longer elements is more damage: it answers another question. The
    # forecast of a tandem is more accurate than its crossings are (studies/tandems.md).
    elements = planned.plan.site.bridges[0].elements
    has_tandem = planned.plan.site.vehicles[0].tandem is not None
    same = [
        one
        for one in found.others
        if one.plan.site.bridges[0].elements == elements
        and (has_tandem or one.plan.site.vehicles[0].tandem is None)
    ]
    better = [
        _Change(_change(one), _gain(one, found), one.plan.cost, _rank(one))
        for one in same
        if _helps(one, planned)
    ]
    better = sorted([*better, *_other_speeds(found)], key=lambda one: (one.cost, one.rank))
    is_tandem_advised = _is_tandem_advised(found)
    if not better:
        other = "No other change of truck, load, direction or sensors helps much."
        return (
            f"What helps is {TANDEM}, but less than its optimistic row states."
            if is_tandem_advised
            else other
        )
    first, *rest = better
    is_best = all(first.rank <= one.rank for one in rest)
    how = "at no cost" if first.cost == 0 else "most" if is_best else "at the least cost"
    sentence = f"What helps {how}: {first.text}; then {first.gain}."
    more = [one for one in rest if one.rank < first.rank]
    for second in (more or rest)[:1]:
        how = "What helps more" if more else "Next best"
        sentence += f" {how}: {second.text} (then {second.gain})."
    if is_tandem_advised:
        sentence += f" {TANDEM.capitalize()} helps, too, but less than its optimistic row states."
    return sentence


def _other_speeds(found: SurveyForecast) -> Iterator[_Change]:
    """Yield the speed that detects the smallest loss, if it helps.

    These forecasts are of one speed, so they are compared with that of the planned speed.
    """
    if not found.speeds:
        return
    planned, (middle, ends) = found.planned, _needed(found.planned)
    limit = float(planned.expected.smallest_loss[planned.middle])
    wanted = found.question.speed_m_per_s
    usual = min(found.speeds, key=lambda one: abs(one.speed_m_per_s - wanted))
    best = min(found.speeds, key=lambda one: one.smallest_middle)
    share = _WORTH_NAMING if middle < inf else _SMALLER_LOSS
    if best.smallest_middle < share * min(limit, usual.smallest_middle):
        detecting = _detecting(found.question.crossings)
        gain = f"{detecting} a loss of {percent(best.smallest_middle)}"
        rank = middle, ends, best.smallest_middle
        yield _Change(f"driving at {best.speed_m_per_s:g} m/s", gain, 0, rank)


def _is_tandem_advised(found: SurveyForecast) -> bool:
    """Return whether reports would advise a truck with a tandem, and its row is better."""
    site = found.planned.plan.site
    rows = [one for one in found.others if one.plan.name == TANDEM]
    is_better = any(_helps(row, found.planned) for row in rows)
    return is_better and truck_to_try(site.vehicles[0], site.bridges[0]) == "tandem"


def _gain(one: PlanForecast, found: SurveyForecast) -> str:
    """Return what an alternative achieves, by the column of the table in which it is better."""
    needed, planned = _needed(one), _needed(found.planned)
    if one.needed_middle is None or needed[0] == inf or needed == planned:
        smallest = percent(one.expected.smallest_loss[one.middle])
        return f"{_detecting(found.question.crossings)} a loss of {smallest}"
    if needed[0] == planned[0]:
        return _ends(one)
    return f"{_detecting(one.needed_middle)} it, and {_ends(one)}"


def _detecting(crossings: int) -> str:
    return f"{count_of(crossings, 'crossing')} {'detects' if crossings == 1 else 'detect'}"


def _change(one: PlanForecast) -> str:
    if one.plan.name == EQUAL_TYRES:
        return f"{EQUAL_TYRES}, on equal tracks to a centimetre"
    return one.plan.label


def _helps(one: PlanForecast, planned: PlanForecast) -> bool:
    """Return whether an alternative needs clearly fewer crossings, or no more and detects more."""
    (middle, ends), (planned_middle, planned_ends) = _needed(one), _needed(planned)
    if middle < _WORTH_NAMING * planned_middle:
        return True
    if middle > planned_middle:
        return False
    if ends < _WORTH_NAMING * planned_ends:
        return True
    share = _WORTH_NAMING if planned_middle < inf else _SMALLER_LOSS
    limit = share * planned.expected.smallest_loss[planned.middle]
    return ends <= planned_ends and bool(one.expected.smallest_loss[one.middle] < limit)


def _rank(one: PlanForecast) -> tuple[float, float, float]:
    """Return the columns of the table that rank it: `needed`, `ends` and `smallest`."""
    return (*_needed(one), float(one.expected.smallest_loss[one.middle]))


def _needed(one: PlanForecast) -> tuple[float, float]:
    """Return the crossings needed at midspan and at both ends; infinite beyond what is possible.

    The ends count only where midspan is detected.
    """
    most = max(_POSSIBLE, one.expected.crossings)
    middle, ends = (
        inf if count is None or count > most else count
        for count in (one.needed_middle, one.needed_ends)
    )
    return middle, ends if middle < inf else inf


def warnings(found: SurveyForecast) -> Iterator[str]:
    """Yield reasons why this truck and these sensors are blind, or the forecast doubtful."""
    site = found.planned.plan.site
    vehicle = site.vehicles[0]
    of_site = [
        *findings_of_truck(vehicle),
        sampling(site.sensor.rate_hz),
        noise_declared(site, vehicle),
    ]
    # The bridge's speed is judged below, together with that of the command line.
    of_bridge = (f for f in findings_of_bridge(site.bridges[0]) if f.name != "survey_speed")
    for finding in (*of_site, *of_bridge):
        if finding.state is not CheckStatus.OK:
            yield f"{finding.text}; {finding.advice}"
    slowest = min(found.question.speed_m_per_s, found.question.speeds_m_per_s[0])
    if slowest < SLOWEST_M_PER_S:
        yield (
            f"speeds begin at {slowest:g} m/s; below {SLOWEST_M_PER_S:g} m/s a crossing is "
            "rejected, so drive at 5 m/s or more"
        )
    if found.compared_m < SHORTEST_APPROACH_M:
        yield (
            f"at {found.question.speed_m_per_s:g} m/s only {found.compared_m:.0f} m of road before "
            f"and after the bridge are compared, but {SHORTEST_APPROACH_M:g} m are needed; drive "
            "faster"
        )
