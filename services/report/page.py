"""The page itself: a first page for each bridge, then the evidence for each crossing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime

import matplotlib

from schemas.results import Crossing
from services.common.progress import Steps, unwatched_steps
from services.identification.comparison import Comparison
from services.report.bridge import BridgeReport, advice
from services.report.html import Html, inlined_svg, joined, table, tag
from services.report.past import past_in_short, past_section
from services.report.place import ends_of, place_of, start_of
from services.report.style import CSS
from services.report.words import words_of
from services.viewer.bridge_figure import draw_bridge
from services.viewer.crossing_view import view_of_crossing
from services.viewer.drawing import STYLE, figure_bytes
from services.viewer.figure import draw_crossing

_MOST_PICTURES = 12
"""So many crossings of a bridge have pictures; the others have their numbers."""
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
_HOW_TO_READ = (
    "EI is the flexural rigidity: how hard the bridge is to bend at a place. A 95 % interval holds "
    "the truth in 95 of 100 cases, if what is declared of truck and sensors is true. Nominal is "
    "what the owner wrote down of the sound bridge."
)
_AGAIN = (
    (
        "Before the next survey drive a minute on any road and run driveby check on the recording: "
        "it finds faults of sensors, wiring and site file on the spot."
    ),
    "Then drive over the bridge twice or more, if it can be in both directions.",
)
_NOT_MEANT = (
    (
        "It is a hint where to look at the next inspection, never a condition rating. It says "
        "nothing of strength, load capacity or safety."
    ),
    (
        "It says how stiff the line is along which the truck drove, deck and pavement included, "
        "and not why. Temperature, moisture, bearings and pavement change stiffness too."
    ),
    (
        "What was not found may be there all the same: a smaller loss, one beside the truck's "
        "line, or one that does not change the stiffness in bending."
    ),
    (
        "Intervals of 95 % were checked on simulated crossings only; no real bridge of known "
        "condition has been measured with this program yet."
    ),
)


def page(reports: Sequence[BridgeReport], progress: Steps = unwatched_steps) -> str:
    """The whole report as one HTML file that needs nothing else, neither network nor scripts.

    `progress` is told of each picture.
    """
    steps = sum(map(_pictures, reports))
    done = 0

    def drawn() -> None:
        nonlocal done
        done += 1
        progress(done, steps)

    progress(0, steps)
    title = ", ".join(_name(report) for report in reports) or "no bridge"
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", f"Stiffness of {title}"),
        tag("style", Html(CSS)),
    )
    bodies = [_bridge(report, f"b{n}-", drawn) for n, report in enumerate(reports)]
    if not bodies:
        bodies = [joined(tag("h1", "No crossing"), tag("p", "No truck crossed a known bridge."))]
    return f"<!DOCTYPE html>\n{tag('html', head, tag('body', *bodies), lang='en')}\n"


def _pictures(report: BridgeReport) -> int:
    """How many there are of a bridge."""
    shown = sum(crossing.parameters is not None for crossing in report.crossings)
    past = report.past is not None
    return (report.view.estimate is not None) + past + min(shown, _MOST_PICTURES)


def _bridge(report: BridgeReport, prefix: str, drawn: Callable[[], None]) -> Html:
    finding = report.finding
    first = tag(
        "section",
        tag("h1", f"Bridge {_name(report)}"),
        tag("p", "Stiffness along the span, measured by trucks that drove over it", class_="sub"),
        tag(
            "div",
            tag("strong", finding.headline),
            *(tag("p", sentence) for sentence in finding.sentences),
            class_=f"finding {finding.kind}",
        ),
        _facts(report),
        *_result(report, prefix, drawn),
        tag("h2", "What this does not mean"),
        tag("ul", *(tag("li", text) for text in _not_meant(report))),
        *_caveats(report),
        class_="first",
    )
    newest_first = list(reversed(report.crossings))
    heading = joined(tag("h2", "Evidence, crossing by crossing"))
    if finding.kind == "doubtful" and report.view.estimate is not None:
        heading = joined(*_what_to_do(report.crossings), heading)
    evidence, pictures = [], 0
    for n, crossing in enumerate(newest_first):
        has_picture = crossing.parameters is not None and pictures < _MOST_PICTURES
        pictures += has_picture
        evidence.append(_crossing(report, crossing, f"{prefix}c{n}-" if has_picture else None))
        if has_picture:
            drawn()
    # What has no numbers fits on the first sheet.
    beginning = "break" if report.view.estimate is not None else "evidence"
    past = Html("")
    if report.past is not None:
        past = past_section(report.past, f"{prefix}h-")
        drawn()
        beginning = "break" if past else beginning
    body = joined(first, past, tag("section", heading, class_=beginning), *evidence)
    meanings = (tag("p", tag("strong", f"{word}:"), f" {text}") for word, text in words_of(body))
    return joined(body, tag("section", tag("h2", "Words"), *meanings, class_="words"))


def _not_meant(report: BridgeReport) -> Sequence[str]:
    if report.view.estimate is None:
        text = "It means neither that the bridge is sound nor that it is damaged"
        no_number = report.finding.kind == "nothing"
        return (text + (": nothing was measured that could tell." if no_number else "."),)
    return _NOT_MEANT


def _facts(report: BridgeReport) -> Html:
    bridge, crossings = report.bridge, report.crossings
    spans = bridge.lengths_of_spans_m
    length = f"{bridge.span_m:g} m"
    if len(spans) > 1:
        length += f" over {len(spans)} spans ({', '.join(f'{s:g}' for s in spans)} m)"
    first, last = _day(crossings[0].entry_time), _day(crossings[-1].entry_time)
    trucks = ", ".join(sorted({crossing.vehicle for crossing in crossings}))
    compared = "each other (no baseline is stored)"
    if report.baseline_name is not None:
        compared = f"the baseline {report.baseline_name}"
    elements = f"{bridge.elements} elements from its start, {start_of(bridge)}"
    rows = [
        ("Bridge", f"{length}, {elements}"),
        ("Driven", (first if first == last else f"{first} to {last}") + f", by {trucks}"),
        ("Quality", report.quality),
        *([] if report.view.estimate is None else [("Compared with", compared)]),
        ("Road", _road(crossings)),
        *([("Sensors", "; ".join(report.sensors))] if report.sensors else []),
        *([] if report.past is None else [("Over time", past_in_short(report.past))]),
        ("Source", f"{', '.join(report.sources)}; {', '.join(report.programs)}"),
    ]
    return tag(
        "table",
        tag("tbody", *(tag("tr", tag("th", what), tag("td", text)) for what, text in rows)),
        class_="facts",
    )


def _result(report: BridgeReport, prefix: str, drawn: Callable[[], None]) -> Iterator[Html]:
    view = report.view
    if view.estimate is None:
        yield tag("h2", "Why")
        counted: dict[str, int] = {}
        for crossing in report.crossings:
            for text in crossing.reason_texts:
                counted[text] = counted.get(text, 0) + 1
        total = len(report.crossings)
        rows = sorted(counted.items(), key=lambda item: -item[1])
        yield tag("ul", *(tag("li", f"{text} ({number} of {total})") for text, number in rows))
        yield from _what_to_do(report.crossings)
        return
    with matplotlib.rc_context(STYLE):
        svg = figure_bytes(draw_bridge(view, with_heading=False), "svg")
    drawn()
    said = " ".join(report.finding.sentences)
    yield tag("figure", inlined_svg(svg, prefix, f"EI along the span. {said}"))
    yield _elements(report)
    if report.finding.kind == "weak":
        yield tag("h2", "What to do next")
        yield tag("ul", *(tag("li", text) for text in _next_steps(report)))


def _elements(report: BridgeReport) -> Html:
    view = report.view
    assert view.estimate is not None  # noqa: S101 - its caller looked
    than = "Against the baseline" if report.baseline_name is not None else "Against the others"
    heads = ["Element", "From–to (m)", "EI (GN·m²)", "95 % interval", "Of nominal", than, "Remark"]
    rows, classes = [], []
    compared = view.comparison.elements if view.comparison is not None else ()
    for n, mean in enumerate(view.estimate.mean):
        low, high = view.estimate.low[n] / 1e9, view.estimate.high[n] / 1e9
        change = remark = ""
        if compared:
            element = compared[n]
            change = f"{_signed(element.ratio)} ({_signed(element.low)} to {_signed(element.high)})"
            remark = "less stiff" if element.is_weak else "stiffer" if element.is_stiff else ""
        if n + 1 in view.unresolved and not remark:
            remark = "not resolved"
        rows.append(
            [
                str(n + 1),
                f"{view.edges_m[n]:.1f}–{view.edges_m[n + 1]:.1f}",
                f"{mean / 1e9:.2f}",
                f"{low:.2f}–{high:.2f}",
                f"{mean / view.nominal_nm2[n]:.3f}",
                change,
                remark + ("?" if remark in ("less stiff", "stiffer") and view.is_doubtful else ""),
            ]
        )
        classes.append("" if view.is_doubtful else {"less stiff": "weak"}.get(remark, ""))
    return table(heads, rows, classes)


def _caveats(report: BridgeReport) -> Iterator[Html]:
    if report.view.estimate is None:
        return
    comparison = report.view.comparison
    yield tag("p", _HOW_TO_READ, class_="note")
    if comparison is None:
        return
    compared = ""
    if comparison.reference == "others":
        compared = (
            "No baseline is stored, and a nominal value is often a guess, so each element is "
            f"compared with the middle of the others. The middle of all is {comparison.level:.2f} "
            "of the nominal value: this says nothing where that is a guess, and is true of the "
            "whole bridge where it was measured. A loss that all elements share cannot be seen "
            "without a baseline. "
        )
    yield tag("p", compared + _visible(comparison), class_="note")


def _next_steps(report: BridgeReport) -> Iterator[str]:
    """Where to look, and how a second survey would tell more than this one."""
    view = report.view
    elements = () if view.comparison is None else view.comparison.elements
    weak = [one for one in elements if one.is_weak]
    places = ", ".join(f"element {one.number} ({place_of(one, report.bridge)})" for one in weak)
    at_end = any(one.number in (1, len(elements)) for one in weak)
    bearing = ", and at the bearing there" if at_end else ""
    no_baseline = report.baseline_name is None
    unlike = " Was it built unlike the others? Then the difference is no damage."
    yield f"Have somebody look at {places}{bearing}.{unlike if no_baseline else ''}"
    used = [one for one in report.crossings if one.crossing_id in view.used]
    once = [
        text
        for text, values in (
            ("on another day", {_day(one.entry_time) for one in used}),
            ("in the other direction", {one.direction for one in used}),
            ("with another truck", {one.vehicle for one in used}),
        )
        if len(values) < 2
    ]
    if once:
        again = once[0] if len(once) == 1 else f"{', '.join(once[:-1])} and {once[-1]}"
        yield f"Drive again {again}: what is found again is neither weather nor the drive."
    if no_baseline:
        yield (
            "Keep these results as a baseline: the next survey then tells what has changed since, "
            "whatever nominal is."
        )


def _visible(comparison: Comparison) -> str:
    losses = sorted(element.visible_loss for element in comparison.elements)
    return (
        f"An element {100.0 * losses[0]:.0f} % less stiff would have been called clear where this "
        f"measurement is sharpest, one {100.0 * losses[-1]:.0f} % less stiff where it is bluntest."
    )


def _what_to_do(crossings: Sequence[Crossing]) -> Iterator[Html]:
    yield tag("h2", "What to do next")
    yield tag("ul", *(tag("li", text) for text in (*advice(crossings), *_AGAIN)))


def _crossing(report: BridgeReport, crossing: Crossing, prefix: str | None) -> Html:
    ends = ends_of(report.bridge)
    way = " to ".join(ends if crossing.direction == "start_to_end" else reversed(ends))
    used = ", used for the numbers above" if crossing.crossing_id in report.view.used else ""
    parts: list[Html] = [
        tag("h3", f"{_moment(crossing.entry_time)}: {crossing.verdict}{used}"),
        tag(
            "p",
            f"{crossing.vehicle}, from {way}, {crossing.speed_m_per_s:.1f} m/s, method "
            f"{crossing.method.replace('_', ' ')} ({crossing.crossing_id})",
        ),
    ]
    if crossing.reasons:
        pairs = zip(crossing.reasons, crossing.reason_texts, strict=True)
        parts.append(tag("ul", *(tag("li", f"{text} ({code.value})") for code, text in pairs)))
    numbers = list(_numbers(crossing))
    if numbers:
        parts.append(table(["Measure", "Value", "Meaning"], [list(row) for row in numbers]))
    if prefix is not None:
        with matplotlib.rc_context(STYLE):
            figure = draw_crossing(
                view_of_crossing(crossing, report.bridge), element_truth=None, road_truth=None
            )
        svg = figure_bytes(figure, "svg")
        label = f"Crossing of {_moment(crossing.entry_time)}, verdict {crossing.verdict}"
        parts.append(tag("figure", inlined_svg(svg, prefix, label)))
    return tag("section", *parts, class_=f"crossing {crossing.verdict}")


def _numbers(crossing: Crossing) -> Iterator[tuple[str, str, str]]:
    if crossing.chi2_per_dof is not None:
        yield (
            "misfit (χ² per degree of freedom)",
            _number(crossing.chi2_per_dof),
            "of model and signals, over the declared noise; 1 is expected, above 1.25 is doubtful",
        )
    if crossing.scale_error is not None:
        yield (
            "common error",
            f"{100.0 * crossing.scale_error:.1f} %",
            "standard deviation that all elements share (mass of the truck, gain of the sensors)",
        )
    derived = crossing.derived
    if derived is not None:
        f1, deflection = derived.f1_hz, derived.max_deflection_m
        yield (
            "first natural frequency",
            f"{f1.mean:.2f} Hz ({f1.q025:.2f} to {f1.q975:.2f})",
            "of the bridge that fits",
        )
        yield (
            "largest deflection",
            f"{deflection.mean * 1e3:.3f} mm",
            "under this truck",
        )
        if derived.springs_believed is not None:
            share = f"{100.0 * derived.springs_believed:.0f} %"
            said = "100 %: the truck's springs act in proportion, as assumed; low: they rub"
            yield "springs believed", share, said
        for ends, what in (
            (derived.probability_sprung, "bearings held against turning"),
            (derived.probability_giving, "bearings that sink under load"),
        ):
            if ends is not None:
                percent = (
                    f"{100.0 * ends.start:.0f} % at the start, {100.0 * ends.end:.0f} % at the end"
                )
                yield what, percent, "how likely that is, in place of bearings that do neither"
        if derived.probability_torsion is not None:
            percent = f"{100.0 * derived.probability_torsion:.0f} %"
            yield "deck that twists", percent, "how likely it is that it does under this lane"
    road = crossing.road
    if road is not None and (road.iri_m_per_km is not None or road.iso_class is not None):
        yield "road", _one_road(crossing) or "", "International Roughness Index, ISO 8608 class"
    meanings = {
        "r_hat": ("agreement (R-hat)", "of one part of the draws with the others; below 1.05"),
        "ess": ("effective draws", "how many independent ones they are worth; at least 100"),
        "position_shift_m": (
            "shift of positions (m)",
            "along the road, by which the satellite receiver seems to have erred",
        ),
        "iterations": ("evaluations", "how often the model was computed"),
    }
    for key, (name, meaning) in meanings.items():
        if key in crossing.diagnostics:
            yield name, _number(crossing.diagnostics[key]), meaning


def _number(value: float) -> str:
    text = f"{value:,.0f}" if abs(value) >= 100.0 else f"{value:.3g}"
    return text.replace("-", "−")


def _road(crossings: Sequence[Crossing]) -> str:
    found = [text for crossing in reversed(crossings) if (text := _one_road(crossing))]
    return f"{found[0]} (newest crossing with a road)" if found else "not known"


def _one_road(crossing: Crossing) -> str | None:
    road = crossing.road
    if road is None:
        return None
    parts = []
    if road.iso_class is not None:
        parts.append(f"class {road.iso_class} of ISO 8608")
    if road.iri_m_per_km is not None:
        parts.append(f"IRI {road.iri_m_per_km:.1f} m/km")
    return ", ".join(parts) or None


def _name(report: BridgeReport) -> str:
    bridge = report.bridge
    return bridge.id if bridge.owner_id is None else f"{bridge.owner_id} ({bridge.id})"


def _signed(ratio: float) -> str:
    change = round(100.0 * (ratio - 1.0))
    return f"{change:+d} %".replace("-", "−") if change else "0 %"


def _day(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d}"


def _moment(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"
