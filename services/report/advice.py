"""Advice on the next steps, for every finding and every reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from schemas.results import CrossingResult
from services.common.language import Language, utc_day
from services.common.truck_choice import TRUCK_CHOICES, truck_to_try
from services.report.bridge import BridgeReport, still_weak
from services.report.cautions import named_elements, possibly_weak, weak_before
from services.report.place import position_of


def next_steps(report: BridgeReport, language: Language) -> Iterator[str]:
    """Yield the steps after a finding."""
    yield from _alarms(report, language)
    match report.finding.kind:
        case "weak":
            yield from _inspect(report, language)
            yield language.text("advice.look")
            yield from _earlier(report, language)
            yield from _implausible(report, language)
            yield from _stiffer(report, language)
            yield from _drive_again(report, language)
        case "known":
            still = _still_weak(report)
            yield language.choice("advice.known", len(still), elements=language.listed(still))
            yield from _possibly(report, language)
            yield from _earlier(report, language, still)
        case "sound":
            yield language.text("advice.sound")
            yield from _possibly(report, language)
            yield from _earlier(report, language)
        case "open":
            yield language.text("advice.not_ruled_out")
            yield from _possibly(report, language)
            yield from _earlier(report, language)
            yield from _implausible(report, language)
            if report.view.comparison is not None:
                yield language.text("advice.open")
                yield from _other_truck(report, language)
        case kind:
            yield language.text("advice.rejected" if kind == "nothing" else "advice.suspect")
            yield from advice_of_state(report, language)
            yield from advice(report.crossings, language)
            yield language.text("advice.check")
            yield language.text("advice.twice")
            return
    # A weak element is inspected in any case.
    if report.finding.kind != "weak" and not report.is_validated:
        yield language.text("advice.validate")
    comparison = report.view.comparison
    if report.before is not None:
        yield language.text("advice.next_survey")
    elif comparison is None or not comparison.implausible:
        yield language.text("advice.keep")


def _other_truck(report: BridgeReport, language: Language) -> Iterator[str]:
    """Yield which truck would help, given the best one of those used."""
    known = {one.id: one for one in report.site.vehicles}
    trucks = [known[one.vehicle] for one in report.used if one.vehicle in known]
    choices = [truck_to_try(truck, report.bridge) for truck in trucks]
    best = max(choices, key=TRUCK_CHOICES.index, default="single")
    yield language.text(f"advice.open_{best}")


def advice(crossings: Iterable[CrossingResult], language: Language) -> list[str]:
    """Return the advice on the reasons of crossings, for the most frequent one first."""
    counted = Counter(
        (code, crossing.method) for crossing in crossings for code in crossing.reasons
    )
    return list(dict.fromkeys(language.remedy(*one) for one, _ in counted.most_common()))


def advice_of_state(report: BridgeReport, language: Language) -> list[str]:
    """Return the advice on the reasons of the bridge's state."""
    state = report.view.state
    return [] if state is None else [language.bridge_advice[code] for code in state.reasons]


def _alarms(report: BridgeReport, language: Language) -> Iterator[str]:
    """Yield the elements that an active alarm concerns."""
    alarms = () if report.past is None else report.past.active_alarms
    numbers = sorted({alarm.element for alarm in alarms})
    if numbers:
        yield language.text("advice.alarm", elements=language.listed([str(n) for n in numbers]))


def _inspect(report: BridgeReport, language: Language) -> Iterator[str]:
    """Yield where to inspect: at weak elements, and at neighbours that may have their loss."""
    elements = () if report.view.comparison is None else report.view.comparison.elements
    adjacent = report.view.ambiguous_neighbours
    weak = [one for one in elements if one.is_weak or one.number in adjacent]
    places = language.listed(
        [
            language.text(
                "advice.place",
                number=one.number,
                position=position_of(one, report.bridge, language),
            )
            for one in weak
        ]
    )
    at_end = any(one.number in (1, len(elements)) for one in weak)
    step = language.text("advice.inspect_bearing" if at_end else "advice.inspect", places=places)
    yield step if report.before is not None else f"{step} {language.text('advice.unlike')}"


def _possibly(report: BridgeReport, language: Language) -> Iterator[str]:
    """Yield the elements that an inspection begins with where none is clearly weak."""
    numbers = [str(one.number) for one in possibly_weak(report.view)]
    if numbers:
        yield language.choice("advice.lower", len(numbers), elements=language.listed(numbers))


def _still_weak(report: BridgeReport) -> list[str]:
    """Return the numbers of the elements that are as weak as in the baseline."""
    return still_weak(report.view, None if report.before is None else report.before.estimate)


def _earlier(report: BridgeReport, language: Language, named: Sequence[str] = ()) -> Iterator[str]:
    """Yield that elements which were weak in the baseline, except `named`, are to be inspected."""
    now = () if report.view.comparison is None else report.view.comparison.weak
    known = {*named, *(str(one.number) for one in now)}
    weak = [str(one.number) for one in weak_before(report.view, report.before)]
    numbers = [number for number in weak if number not in known]
    if numbers:
        yield language.choice("advice.earlier", len(numbers), elements=language.listed(numbers))


def _implausible(report: BridgeReport, language: Language) -> Iterator[str]:
    """Yield what to do about elements that are stiffer than is plausible."""
    found = () if report.view.comparison is None else report.view.comparison.implausible
    if found:
        elements = named_elements([one.number for one in found], language)
        yield language.text("advice.implausible", elements=elements)


def _stiffer(report: BridgeReport, language: Language) -> Iterator[str]:
    """Yield what an element that is clearly stiffer means for the others: errors are opposite."""
    stiff = () if report.view.comparison is None else report.view.comparison.stiff
    numbers = [str(one.number) for one in stiff if not one.is_implausible]
    if numbers:
        against = "others" if report.before is None else "baseline"
        listed = language.listed(numbers)
        yield language.choice(f"advice.stiffer.{against}", len(numbers), elements=listed)


def _drive_again(report: BridgeReport, language: Language) -> Iterator[str]:
    """Yield how another crossing would add information."""
    used = report.used
    days = {utc_day(one.entry_time) for one in used}
    once = [
        language.text(f"advice.{key}")
        for key, values in (
            ("another_day", days),
            ("other_direction", {one.direction for one in used}),
            ("another_truck", {one.vehicle for one in used}),
        )
        if len(values) < 2
    ]
    if once:
        yield language.text("advice.again", how=language.listed(once))
