"""A survey's expectation in words: what it will show, what helps most, what makes it blind."""

from collections.abc import Iterator
from typing import Final

from pre_core.survey.detection import SURE
from services.identification.checks import SHORTEST_APPROACH_M
from services.identification.identify import SLOWEST_M_PER_S
from services.inspection.finding import State
from services.inspection.site import (
    findings_of_bridge,
    findings_of_truck,
    noise_declared,
    sampling,
)
from services.planning.crossings import axles_of
from services.planning.survey import MOST_CROSSINGS, Outlook, Survey

_WORTH_SAYING: Final = 0.95
"""An alternative helps whose smallest loss is less than this part of the plan's."""


def advice(found: Survey) -> str:
    """One sentence on the plan, and one on what would help most."""
    return f"{_of_the_plan(found)} {_of_the_others(found)}"


def tyres_of(outlook: Outlook) -> str:
    """The tyres of a plan."""
    front, rear = axles_of(outlook.plan.site.vehicles[0])
    if rear.twin_distance_m > 0.0:
        return "twin tyres behind"
    is_equal = rear._replace(offset_m=front.offset_m) == front
    return "equal single tyres" if is_equal else "single tyres"


def tracks_of(found: Survey) -> str:
    """What decides how much the axles' roads differ, and whether it was given."""
    vehicle = found.planned.plan.site.vehicles[0]
    front, rear = axles_of(vehicle)
    given = "" if vehicle.rear_axle_offset_m is not None else " (no rear_axle_offset_m)"
    aside = 1e3 * abs(rear.offset_m - front.offset_m)
    return f"rear axle {aside:g} mm aside{given}, tracks ± {found.road.wander_m:g} m"


def _of_the_plan(found: Survey) -> str:
    planned, asked = found.planned, found.asked
    how = f"at {asked.speed_m_per_s:g} m/s with {tyres_of(planned)}"
    what = f"a {asked.loss:.0%} loss at midspan with {SURE:.0%} probability"
    if planned.needed_middle is None:
        smallest = planned.expected.smallest_loss[planned.middle]
        return (
            f"Not even {MOST_CROSSINGS} crossings {how} show {what}: {asked.crossings} show one "
            f"of {smallest:.0%} or more, and tell the mean rigidity to "
            f"± {planned.expected.level_std:.0%}."
        )
    count = _crossings(planned.needed_middle)
    verb = "shows" if planned.needed_middle == 1 else "show"
    return f"{count} {how} {verb} {what}; {_ends(planned)}."


def _ends(outlook: Outlook) -> str:
    if outlook.needed_ends is None:
        return f"the ends would take more than {MOST_CROSSINGS}"
    if outlook.needed_ends == outlook.needed_middle:
        return "the ends need no more"
    return f"the ends need {outlook.needed_ends}"


def _of_the_others(found: Survey) -> str:
    planned = found.planned
    # A loss in one of fewer, longer elements is more damage: no help, but another question.
    elements = planned.plan.site.bridges[0].elements
    same = [one for one in found.others if one.plan.site.bridges[0].elements == elements]
    better = sorted((one for one in same if _helps(one, planned)), key=_rank)
    if not better:
        return "Nothing else that was tried here helps by much."
    best = better[0]
    if best.needed_middle is None:
        gain = f"then {found.asked.crossings} show {best.expected.smallest_loss[best.middle]:.0%}"
    else:
        verb = "does" if best.needed_middle == 1 else "do"
        gain = f"then {_crossings(best.needed_middle)} {verb}, and {_ends(best)}"
    sentence = f"What helps most: {best.plan.name}; {gain}."
    if len(better) > 1:
        next_best = better[1]
        smallest = next_best.expected.smallest_loss[next_best.middle]
        sentence += f" Next: {next_best.plan.name} ({found.asked.crossings} show {smallest:.0%})."
    return sentence


def _helps(one: Outlook, planned: Outlook) -> bool:
    limit = _WORTH_SAYING * planned.expected.smallest_loss[planned.middle]
    return bool(one.expected.smallest_loss[one.middle] < limit)


def _rank(one: Outlook) -> float:
    return float(one.expected.smallest_loss[one.middle])


def _crossings(count: int) -> str:
    return "1 crossing" if count == 1 else f"{count} crossings"


def warnings(found: Survey) -> Iterator[str]:
    """What makes a survey with this truck and these sensors blind, or its forecast doubtful."""
    site = found.planned.plan.site
    vehicle = site.vehicles[0]
    of_site = [
        *findings_of_truck(vehicle),
        sampling(site.sensor.rate_hz),
        noise_declared(site, vehicle),
    ]
    # The bridge's speed is judged below, with that of the command line.
    of_bridge = (f for f in findings_of_bridge(site.bridges[0]) if f.name != "survey_speed")
    for finding in (*of_site, *of_bridge):
        if finding.state is not State.OK:
            yield f"{finding.text}: {finding.advice}"
    slowest = min(found.asked.speed_m_per_s, found.asked.speeds_m_per_s[0])
    if slowest < SLOWEST_M_PER_S:
        yield (
            f"speeds from {slowest:g} m/s: below {SLOWEST_M_PER_S:g} m/s a crossing is rejected, "
            "drive at 5 m/s or more"
        )
    if found.compared_m < SHORTEST_APPROACH_M:
        yield (
            f"at {found.asked.speed_m_per_s:g} m/s {found.compared_m:.0f} m of road beside the "
            f"bridge are compared, {SHORTEST_APPROACH_M:g} m are needed: drive faster"
        )
