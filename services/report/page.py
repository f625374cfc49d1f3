"""The page of a report: a first page for each bridge, then the evidence of all crossings."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence

import matplotlib

from schemas.results import CrossingResult
from services.common.language import ENGLISH, Language, utc_day
from services.common.progress import Steps, no_step_progress
from services.identification.comparison import Element
from services.report.advice import next_steps
from services.report.bridge import BridgeReport
from services.report.cautions import weak_before
from services.report.evidence import evidence, facts, pictured
from services.report.history_section import history_section, history_summary
from services.report.html import Html, inlined_svg, joined, table, tag
from services.report.place import start_of
from services.report.quality import reasons_of
from services.report.sketch import sketch
from services.report.style import style_sheet
from services.viewer.bridge_figure import draw_bridge
from services.viewer.bridge_view import BridgeView
from services.viewer.drawing import STYLE, figure_bytes

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"

_TAG = re.compile(r"<[^>]*>")
_DOUBTFUL = ("weak", "stiff", "implausible", "lower", "higher")
"""Remarks that a doubtful measurement cannot make."""


def page(
    reports: Sequence[BridgeReport],
    progress: Steps = no_step_progress,
    language: Language = ENGLISH,
) -> str:
    """Return the whole report as one HTML file without network or scripts.

    `progress` is called for each figure.
    """
    steps = sum(map(_pictures, reports))
    done = 0

    def drawn() -> None:
        nonlocal done
        done += 1
        progress(done, steps)

    progress(0, steps)
    title = ", ".join(map(_name, reports)) or language.text("page.no_bridge")
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", language.text("page.title", bridges=title)),
        tag("style", Html(style_sheet(language))),
    )
    bodies = [_bridge(report, f"b{n}-", drawn, language) for n, report in enumerate(reports)]
    if not bodies:
        heading = tag("h1", language.text("page.no_crossing"))
        bodies = [joined(heading, tag("p", language.text("page.no_crossing_text")))]
    return f"<!DOCTYPE html>\n{tag('html', head, tag('body', *bodies), lang=language.code)}\n"


def _pictures(report: BridgeReport) -> int:
    """Return the number of figures of a bridge."""
    has_state, has_past = report.view.estimate is not None, report.past is not None
    return has_state + has_past + bool(pictured(report))


def _bridge(
    report: BridgeReport, prefix: str, drawn: Callable[[], None], language: Language
) -> Html:
    finding = report.finding
    first = tag(
        "section",
        tag("h1", language.text("page.bridge", name=_name(report))),
        tag("p", language.text("page.sub"), class_="sub"),
        tag(
            "div",
            tag("strong", finding.headline),
            *(tag("p", text) for text in _paragraphs(report)),
            *([_list(report.cautions)] if report.cautions else []),
            class_=f"finding {finding.kind}",
        ),
        tag("div", _facts(report, language), sketch(report, language), class_="about"),
        *_result(report, prefix, drawn, language),
        tag("h2", language.text("heading.next")),
        _list(next_steps(report, language)),
        tag("h2", language.text("heading.not_meant")),
        _list(_not_meant(report, language)),
        tag("p", language.text("page.signature"), class_="signature"),
        class_="first",
    )
    past = Html("")
    if report.past is not None:
        past = history_section(report.past, f"{prefix}h-", language)
        drawn()
    heading = tag("h2", language.text("heading.evidence"))
    proof = tag(
        "section",
        heading,
        *_caveats(report, language),
        *evidence(report, f"{prefix}c-", language),
        class_="evidence",
    )
    if pictured(report):
        drawn()
    body = joined(first, past, proof)
    seen = _TAG.sub(" ", body)
    meanings = (
        tag("p", tag("strong", f"{one.word}:"), f" {one.meaning}")
        for one in language.glossary
        if any(part in seen for part in one.seen_by)
    )
    words = tag("h2", language.text("heading.words"))
    return joined(body, tag("section", words, *meanings, class_="words"))


def _paragraphs(report: BridgeReport) -> list[str]:
    """Return a paragraph for each clear element, and one of all other sentences."""
    comparison, sentences = report.view.comparison, report.finding.sentences
    clear = 0 if comparison is None else len(comparison.weak) + len(comparison.stiff)
    return [*sentences[:clear], *([" ".join(sentences[clear:])] if sentences[clear:] else [])]


def _list(items: Iterator[str] | Sequence[str]) -> Html:
    return tag("ul", *(tag("li", text) for text in items))


def _not_meant(report: BridgeReport, language: Language) -> Sequence[str]:
    if report.view.estimate is None:
        which = "no_number" if report.finding.kind == "nothing" else "doubtful"
        return (language.text(f"not_meant.{which}"),)
    other = "other_alone" if report.before is None else "other"
    return [language.text(f"not_meant.{key}") for key in ("rating", "line", other, "simulated")]


def _facts(report: BridgeReport, language: Language) -> Html:
    bridge = report.bridge
    spans = bridge.lengths_of_spans_m
    length = language.text("bridge.length", span_m=bridge.span_m)
    if len(spans) > 1:
        listed = ", ".join(language.number(span, "g") for span in spans)
        length = language.text(
            "bridge.spans", span_m=bridge.span_m, number=len(spans), spans=listed
        )
    described = language.text(
        "bridge.elements", length=length, number=bridge.elements, start=start_of(bridge, language)
    )
    dates = _dates(report.crossings)
    rows = [
        ("bridge", described),
        ("driven", language.text("driven.days" if "last" in dates else "driven.day", **dates)),
        ("quality", report.quality),
    ]
    if report.view.estimate is not None:
        rows.append(("compared", _compared_with(report, language)))
    if report.past is not None:
        rows.append(("over_time", history_summary(report.past, language)))
    return facts([(language.text(f"fact.{key}"), text) for key, text in rows])


def _dates(crossings: Sequence[CrossingResult]) -> dict[str, str]:
    """Return the first day, the last one if it is another, and the trucks."""
    first, last = utc_day(crossings[0].entry_time), utc_day(crossings[-1].entry_time)
    trucks = ", ".join(sorted({crossing.vehicle for crossing in crossings}))
    return {"first": first, "trucks": trucks} | ({} if first == last else {"last": last})


def _compared_with(report: BridgeReport, language: Language) -> str:
    before = report.before
    if before is None:
        return language.text("compared.others")
    if not before.crossings:
        return language.text("compared.baseline", name=before.name)
    dates, number = _dates(before.crossings), len(before.crossings)
    when = "days" if "last" in dates else "one" if number == 1 else "day"
    excluded = language.choice("compared.excluded", before.excluded) if before.excluded else ""
    return language.text(
        f"compared.before.{when}",
        name=before.name,
        number=number,
        verdict=language.text(before.verdict),
        excluded=excluded,
        **dates,
    )


def _result(
    report: BridgeReport, prefix: str, drawn: Callable[[], None], language: Language
) -> Iterator[Html]:
    view = report.view
    if view.estimate is None:
        yield tag("h2", language.text("heading.why"))
        counted: dict[str, int] = {}
        for crossing in report.crossings:
            for text in reasons_of(crossing, language):
                counted[text] = counted.get(text, 0) + 1
        total = len(report.crossings)
        rows = sorted(counted.items(), key=lambda item: -item[1])
        which = "why.one" if total == 1 else "why.many"
        yield _list([language.text(which, reason=t, number=n, total=total) for t, n in rows])
        return
    with matplotlib.rc_context(STYLE):
        figure = draw_bridge(view, with_heading=False, language=language)
        svg = figure_bytes(figure, "svg")
    drawn()
    label = language.text("figure.bridge", finding=" ".join(report.finding.sentences))
    yield tag("figure", inlined_svg(svg, prefix, label), class_="wide")
    yield _elements(report, language)


def _elements(report: BridgeReport, language: Language) -> Html:
    """Return the table of elements: before, after and change, or against each other."""
    view, before = report.view, report.before
    assert view.estimate is not None  # noqa: S101 - its caller checked
    keys = ["element", "place", "ei", "interval", "of_nominal", "against_others", "remark"]
    if before is not None:
        keys = ["element", "place", "before", "after", "change", "remark"]
    rows, classes = [], []
    compared = view.comparison.elements if view.comparison is not None else ()
    earlier = {element.number for element in weak_before(view, before)}
    for n, mean in enumerate(view.estimate.mean):
        low, high = view.estimate.low[n] / 1e9, view.estimate.high[n] / 1e9
        element = compared[n] if compared else None
        remark = _remark(n + 1, element, view, earlier)
        ratio = language.number(mean / view.nominal_nm2[n], ".3f")
        change = "" if element is None else _change(element, language)
        ends = {"from_m": view.edges_m[n], "to_m": view.edges_m[n + 1]}
        row = [str(n + 1), language.text("cell.place", **ends)]
        if before is None:
            interval = language.text("cell.range", low=low, high=high)
            row += [language.number(mean / 1e9, ".2f"), interval, ratio, change]
        else:
            old = (before.estimate.mean[n], before.estimate.low[n], before.estimate.high[n])
            row += [_value(*old, language), _value(mean, 1e9 * low, 1e9 * high, language)]
            row.append(change)
        doubt = "?" if remark in _DOUBTFUL and view.is_doubtful else ""
        row.append(language.text(f"remark.{remark}") + doubt if remark else "")
        rows.append(row)
        classes.append(remark if remark == "weak" and not view.is_doubtful else "")
    return table([language.text(f"table.{key}") for key in keys], rows, classes)


def _remark(
    number: int,
    element: Element | None,
    view: BridgeView,
    earlier: Collection[int],
) -> str:
    """Return the key of the remark on an element; empty for none.

    `element` is its comparison, if there is one; `earlier` are the numbers of elements that were
    weak in the baseline.
    """
    if element is not None and element.is_weak:
        return "weak"
    if element is not None and element.is_stiff:
        return "implausible" if element.is_implausible else "stiff"
    if number in view.unresolved:
        return "unresolved"
    if number in view.vague:
        return "unresolved_before"
    if number in earlier:
        return "earlier"
    if view.comparison is not None and element in view.comparison.risen:
        return "higher"
    return "lower" if element is not None and element.is_lower else ""


def _value(mean: float, low: float, high: float, language: Language) -> str:
    return language.text("cell.value_in_range", mean=mean / 1e9, low=low / 1e9, high=high / 1e9)


def _change(element: Element, language: Language) -> str:
    ratio, low, high = (language.change(r) for r in (element.ratio, element.low, element.high))
    return language.text("cell.change", ratio=ratio, low=low, high=high)


def _caveats(report: BridgeReport, language: Language) -> Iterator[Html]:
    if report.view.estimate is None:
        return
    comparison = report.view.comparison
    yield tag("p", language.text("note.how_to_read"), class_="note how")
    if comparison is None:
        return
    notes = [language.text("note.change")]
    if comparison.reference == "others":
        notes = [language.text("note.no_baseline", median=comparison.median_ratio)]
    yield tag("p", " ".join(notes), class_="note")


def _name(report: BridgeReport) -> str:
    bridge = report.bridge
    return bridge.id if bridge.owner_id is None else f"{bridge.owner_id} ({bridge.id})"
