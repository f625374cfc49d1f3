"""Forecasts of surveys as JSON and as text."""

from collections.abc import Iterator
from itertools import accumulate
from typing import Any

from pre_core.constants import DETECTION_PROBABILITY
from pre_core.survey.detection import FALSE_ALARM
from pre_core.survey.plan import DRAWS
from services.common.naming import count_of
from services.common.road_class import assumed_road
from services.identification.comparison import CLEAR_LOSS
from services.planning.advice import advice, mismatch_in_words, percent, tyres_of, warnings
from services.planning.crossings import scale_error
from services.planning.survey import (
    MAX_CROSSINGS,
    PlanForecast,
    SurveyExpectation,
    SurveyForecast,
)


def as_json(found: SurveyForecast) -> dict[str, Any]:
    """Return the complete forecast, elements from the bridge's start."""
    site = found.planned.plan.site
    return {
        "vehicle": site.vehicles[0].id,
        "bridge": site.bridges[0].id,
        "loss": found.question.loss,
        "false_alarm": FALSE_ALARM,
        "sure": DETECTION_PROBABILITY,
        "draws": DRAWS,
        "crossings": found.question.crossings,
        "speed_m_per_s": found.question.speed_m_per_s,
        "road_class": found.road.road_class,
        "wander_m": found.road.wander_m,
        "scale_error": scale_error(site),
        "planned": _outlook_json(found.planned),
        "alternatives": [_outlook_json(one) for one in found.others],
        "rougher_road": None if found.rougher is None else _outlook_json(found.rougher),
        "speeds": [one._asdict() for one in found.speeds],
        "growth": [_expected_json(one) for one in found.growth],
        "warnings": list(warnings(found)),
        "advice": advice(found),
    }


def _outlook_json(one: PlanForecast) -> dict[str, Any]:
    bridge = one.plan.site.bridges[0]
    return {
        "name": one.plan.name,
        "element_lengths_m": list(bridge.lengths_m),
        "middle_element": one.middle + 1,
        "one_crossing": _expected_json(one.once),
        "all_crossings": _expected_json(one.expected),
        "crossings_needed": {
            "middle": one.needed_middle,
            "ends": one.needed_ends,
            "clear_middle": one.clear_middle,
        },
    }


def _expected_json(one: SurveyExpectation) -> dict[str, Any]:
    return {
        "crossings": one.crossings,
        "std_ln_ei": one.std.tolist(),
        "level_std": one.level_std,
        "probability_seen": one.seen.tolist(),
        "probability_seen_among_others": one.seen_among_others.tolist(),
        "smallest_loss": one.smallest_loss.tolist(),
        "smallest_clear_loss": one.smallest_clear_loss.tolist(),
    }


def lines_of(found: SurveyForecast) -> Iterator[str]:
    """Yield the printed lines, at most 80 characters but for warnings and advice."""
    question, planned = found.question, found.planned
    vehicle, bridge = planned.plan.site.vehicles[0], planned.plan.site.bridges[0]
    speeds = [crossing.speed_m_per_s for crossing in planned.plan.tracks[0]]
    road = found.road.road_class
    road = assumed_road(road, bridge.road_class, "--road") or f"road class {road}"
    tonnes = vehicle.total_mass_kg / 1e3
    yield f"{vehicle.id} ({tonnes:.1f} t, {tyres_of(planned)}) over {bridge.id}"
    yield (
        f"({bridge.span_m:g} m, {bridge.elements} elements), {road}, "
        f"{count_of(question.crossings, 'crossing')}"
    )
    halves = ", ".join(f"half at {speed:.1f} m/s" for speed in speeds)
    yield f"assumed speeds: {halves}"
    if found.road.is_surface:
        yield mismatch_in_words(found)
    false = percent(FALSE_ALARM)
    yield f"loss to detect: {percent(question.loss)}; false alarms: {false} per element"
    yield ""
    yield from _aligned(_elements(found))
    yield (
        f"overall stiffness: ± {_percent(planned.once.level_std)} after 1 crossing, "
        f"± {_percent(planned.expected.level_std)} after {question.crossings}"
    )
    yield from _legend_of_elements(question.crossings)
    yield ""
    yield from _aligned(_comparison(found))
    yield from _legend_of_changes(
        question.crossings, planned.middle + 1, has_speeds=bool(found.speeds)
    )
    yield from _not_advised(found)
    yield ""
    for line in warnings(found):
        yield f"warning: {line}"
    yield advice(found)


def _legend_of_elements(crossings: int) -> Iterator[str]:
    """Yield a line for each column of the first table, and how to read all of them."""
    wanted = percent(DETECTION_PROBABILITY)
    yield "±          standard deviation of EI; near 55 % the measurement adds nothing"
    yield f"           (from {DRAWS:,} draws, with a relative error of 2 %)"
    yield "seen       probability that the loss is detected against the nominal value"
    yield "vs others  probability that the loss is detected against the other elements"
    yield f"smallest   smallest loss that is detected with {wanted} probability"
    yield f"clear      smallest loss that a report calls clear with {wanted} probability:"
    yield f"           the whole 95 % interval is more than {percent(CLEAR_LOSS)} below the others"
    yield f"detected   by a one-sided test with {percent(FALSE_ALARM)} false alarms"
    yield "Next to supports of unknown restraint, seen is lower than the same ± suggests"
    yield "elsewhere."
    yield f"Two compared surveys of {crossings} crossings have √2 times the ± of one, so each needs"
    yield "at least twice the crossings stated here, and more for a clear change."


def _legend_of_changes(crossings: int, middle: int, *, has_speeds: bool) -> Iterator[str]:
    """Yield a line for each column and row of the second table."""
    wanted = percent(DETECTION_PROBABILITY)
    yield f"overall    standard deviation of the overall stiffness after {crossings} crossings"
    yield "mid        standard deviation of EI at midspan"
    yield f"smallest   smallest loss at midspan that is detected with {wanted} probability"
    yield f"needed     crossings that detect the loss at midspan with {wanted} probability"
    yield "ends       crossings that detect it at both ends; other elements lie in between"
    yield "report     crossings after which a report calls the loss at midspan clear"
    yield f"–          more than {MAX_CROSSINGS} crossings"
    yield f"midspan: EI_{middle}, at the middle of the longest span"
    yield "equal single tyres: on tracks that are equal to a centimetre"
    yield "at … t: at most 18 t, with three axles 26 t, as in the EU; national limits may"
    yield "        be lower"
    yield "in the other direction: in the opposite lane"
    yield "… elements: fewer, longer ones"
    if has_speeds:
        yield "at … m/s: all runs at one speed; needed, ends and report are not computed"


def _not_advised(found: SurveyForecast) -> Iterator[str]:
    """Yield which rows the advice leaves out, and why."""
    if found.planned.plan.site.vehicles[0].tandem is None:
        yield "The advice does not rank tandems, whose forecast is too optimistic, nor fewer"
        yield "elements, because the same loss in a longer element is more damage."
    else:
        yield "The advice does not rank fewer elements, because the same loss in a longer"
        yield "element is more damage."


def _aligned(rows: list[list[str]]) -> Iterator[str]:
    """Yield rows with their first cells aligned left, the others right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    for first, *cells in rows:
        aligned = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        yield "  ".join([first.ljust(widths[0]), *aligned]).rstrip()


def _elements(found: SurveyForecast) -> list[list[str]]:
    planned, count = found.planned, found.question.crossings
    ends = list(accumulate(planned.plan.site.bridges[0].lengths_m, initial=0.0))
    once, whole = planned.once, planned.expected
    heads = [
        "element",
        "from m",
        "to m",
        "± after 1",
        f"± after {count}",
        "seen",
        "vs others",
        "smallest",
        "clear",
    ]
    return [
        heads,
        *(
            [
                f"EI_{e + 1}",
                f"{ends[e]:.2f}",
                f"{ends[e + 1]:.2f}",
                _percent(once.std[e]),
                _percent(whole.std[e]),
                _percent(whole.seen[e]),
                _percent(whole.seen_among_others[e]),
                _percent(whole.smallest_loss[e]),
                _percent(whole.smallest_clear_loss[e]),
            ]
            for e in range(len(ends) - 1)
        ),
    ]


def _comparison(found: SurveyForecast) -> list[list[str]]:
    rows = [["what if", "overall", "mid", "smallest", "needed", "ends", "report"]]
    rows += [_cells(one, one.plan.label) for one in (found.planned, *found.others)]
    rows += [
        [
            f"at {at.speed_m_per_s:g} m/s",
            _percent(at.level_std),
            _percent(at.std_middle),
            _percent(at.smallest_middle),
            "",
            "",
            "",
        ]
        for at in found.speeds
    ]
    if found.rougher is not None:
        name = f"road class {chr(ord(found.road.road_class) + 1)}"
        rows.append(_cells(found.rougher, name))
    return rows


def _cells(one: PlanForecast, name: str) -> list[str]:
    e = one.middle
    return [
        name,
        _percent(one.expected.level_std),
        _percent(one.expected.std[e]),
        _percent(one.expected.smallest_loss[e]),
        _count(one.needed_middle),
        _count(one.needed_ends),
        _count(one.clear_middle),
    ]


def _count(crossings: int | None) -> str:
    return "–" if crossings is None else str(crossings)


def _percent(share: float) -> str:
    """Return two significant digits."""
    value = 100.0 * share
    return f"{value:.1f} %" if value < 9.95 else f"{value:.0f} %"
