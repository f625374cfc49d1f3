"""The evidence of a report: all crossings of a bridge together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import matplotlib

from schemas.results import CrossingResult, is_torsion_declared
from services.common.language import Language, utc_second
from services.report.bridge import BridgeReport
from services.report.html import Html, inlined_svg, joined, table, tag
from services.report.measurement import sensor_lines, truck_line, vehicles_of
from services.report.place import ends_of
from services.report.quality import reasons_of
from services.viewer.crossing_view import view_of_crossing
from services.viewer.crossings_figure import draw_crossings
from services.viewer.drawing import STYLE, figure_bytes

MAX_PICTURES = 12
"""Maximum number of crossings of a bridge in the figure, the newest ones."""
_COLUMNS = 6
"""Maximum number of crossings next to each other in a table of measures."""
_COLUMNS_WITH_MEANINGS = 3
_DIAGNOSTICS = ("r_hat", "ess", "pareto_k", "position_shift_m", "line_hz")
_FORMATS = {"r_hat": ".3f", "pareto_k": ".3f"}
"""Formats that show how near a value is to its limit, 1.05 and 0.7, in as many digits for all."""

Numbered = tuple[int, CrossingResult]


class Measure(NamedTuple):
    """A number of a crossing, with the keys of its name and its meaning."""

    name: str
    meaning: str
    value: str


def evidence(report: BridgeReport, prefix: str, language: Language) -> Iterator[Html]:
    """Yield what measured, the list of crossings, their figure, reasons and numbers."""
    numbered = list(enumerate(report.crossings, start=1))
    yield _what_measured(report, language)
    yield _crossings(report, numbered, language)
    yield from _reasons(numbered, language)
    shown = pictured(report)
    if shown:
        views = [(n, view_of_crossing(crossing, report.bridge)) for n, crossing in shown]
        with matplotlib.rc_context(STYLE):
            svg = figure_bytes(draw_crossings(views, language), "svg")
        label = language.text("figure.crossings", number=len(shown))
        yield tag("figure", inlined_svg(svg, prefix, label), class_="wide")
    yield from _measures(numbered, language)


def pictured(report: BridgeReport) -> list[Numbered]:
    """Return the crossings in the figure, with their numbers."""
    known = enumerate(report.crossings, start=1)
    return [one for one in known if one[1].parameters is not None][-MAX_PICTURES:]


def facts(rows: Sequence[tuple[str, str]]) -> Html:
    """Return a table of names and texts."""
    body = (tag("tr", tag("th", what), tag("td", text)) for what, text in rows)
    return tag("table", tag("tbody", *body), class_="facts")


def road_of(crossing: CrossingResult, language: Language) -> str | None:
    """Return class and roughness of the road of a crossing; None without them."""
    road = crossing.road
    if road is None:
        return None
    parts = []
    if road.iso_class is not None:
        parts.append(language.text("road.class", name=road.iso_class))
    if road.iri_m_per_km is not None:
        parts.append(language.text("road.iri", iri=road.iri_m_per_km))
    return ", ".join(parts) or None


def _what_measured(report: BridgeReport, language: Language) -> Html:
    vehicles = vehicles_of(report.site, report.crossings)
    trucks = "; ".join(truck_line(vehicle, language) for vehicle in vehicles)
    sensors = "; ".join(
        line for vehicle in vehicles for line in sensor_lines(report.site, vehicle, language)
    )
    files = ", ".join(report.sources)
    programs = ", ".join(report.programs)
    rows = [
        (language.text("fact.truck"), trucks),
        (language.text("fact.sensors"), sensors),
        (language.text("fact.road"), _newest_road(report.crossings, language)),
        (language.text("fact.source"), f"{files}; {programs}"),
        (
            language.text("fact.computed"),
            language.text("fact.computed_at", time=utc_second(report.computed_s)),
        ),
    ]
    return facts([row for row in rows if row[1]])


def _newest_road(crossings: Sequence[CrossingResult], language: Language) -> str:
    for crossing in reversed(crossings):
        road = road_of(crossing, language)
        if road is not None:
            return language.text("road.newest", road=road)
    return language.text("road.unknown")


def _crossings(report: BridgeReport, numbered: Sequence[Numbered], language: Language) -> Html:
    ends = ends_of(report.bridge, language)
    keys = ("number", "time", "truck", "way", "speed", "method", "verdict", "used", "reasons")
    state = report.view.state
    left_out = {} if state is None else {c.crossing_id: c.reason for c in state.crossings_left_out}
    rows = []
    for number, crossing in numbered:
        why = [code.value for code in crossing.reasons]
        if crossing.crossing_id in left_out and crossing.verdict == "good":
            reason = left_out[crossing.crossing_id]
            why.append(language.left_out.get(reason, reason))
        start, end = ends if crossing.direction == "start_to_end" else reversed(ends)
        is_used = crossing.crossing_id in report.view.used
        rows.append(
            [
                str(number),
                utc_second(crossing.entry_time),
                crossing.vehicle,
                language.text("crossings.way_cell", start=start, end=end),
                language.number(crossing.speed_m_per_s, ".1f"),
                crossing.method.replace("_", " "),
                language.text(crossing.verdict),
                language.text("crossings.used_cell" if is_used else "crossings.unused_cell"),
                ", ".join(why),
            ]
        )
    heads = [language.text(f"crossings.{key}") for key in keys]
    return table(heads, rows, [crossing.verdict for _, crossing in numbered])


def _reasons(numbered: Sequence[Numbered], language: Language) -> Iterator[Html]:
    """Yield each reason once, with its crossings and what to do about it."""
    found: dict[str, list[int]] = {}
    advice: dict[str, str] = {}
    for number, crossing in numbered:
        sentences = reasons_of(crossing, language)
        for code, sentence in zip(crossing.reasons, sentences, strict=True):
            found.setdefault(f"{sentence} ({code.value})", []).append(number)
            advice[f"{sentence} ({code.value})"] = language.remedy(code, crossing.method)
    if not found:
        return
    yield tag("h3", language.text("heading.reasons"))
    items = []
    for sentence, numbers in found.items():
        listed = ", ".join(map(str, numbers))
        which = language.choice("crossings.of", len(numbers), numbers=listed)
        items.append(tag("li", f"{which}: {sentence} ", tag("em", advice[sentence])))
    yield tag("ul", *items)


def _measures(numbered: Sequence[Numbered], language: Language) -> Iterator[Html]:
    """Yield tables with a column for each crossing that has numbers."""
    columns = [
        (number, {one.name: one for one in measures_of(crossing, language)})
        for number, crossing in numbered
    ]
    columns = [column for column in columns if column[1]]
    if columns:
        yield tag("h3", language.text("heading.measures"))
    for first in range(0, len(columns), _COLUMNS):
        yield _measures_table(columns[first : first + _COLUMNS], language)


def _measures_table(columns: Sequence[tuple[int, dict[str, Measure]]], language: Language) -> Html:
    """Return a table of measures; their meanings have a column unless it would be too narrow."""
    has_meanings = len(columns) <= _COLUMNS_WITH_MEANINGS
    rows = []
    for name in dict.fromkeys(name for _, measures in columns for name in measures):
        known = [measures.get(name) for _, measures in columns]
        key = next(one.meaning for one in known if one is not None)
        label, meaning = language.text(f"measure.{name}"), language.text(f"meaning.{key}")
        cells = ["" if one is None else one.value for one in known]
        if has_meanings:
            rows.append([label, *cells, meaning])
        else:
            rows.append([joined(label, tag("small", f" {meaning}")), *cells])
    numbers = [f"{language.text('crossings.number')} {number}" for number, _ in columns]
    heads = [language.text("measures.name"), *numbers]
    if has_meanings:
        heads.append(language.text("measures.meaning"))
    return tag("div", table(heads, rows), class_="measures" if has_meanings else "many measures")


def measures_of(crossing: CrossingResult, language: Language) -> Iterator[Measure]:
    """Yield the numbers of a crossing that judge it."""
    if crossing.chi2_per_dof is not None:
        yield Measure("chi2", "chi2", _plain(crossing.chi2_per_dof, language))
    if crossing.scale_error is not None:
        yield Measure("scale", "scale", language.number(100.0 * crossing.scale_error, ".1f"))
    derived = crossing.derived
    if derived is not None:
        deflection_mm = 1e3 * derived.max_deflection_m.mean
        yield Measure("f1", "f1", language.number(derived.f1_hz.mean, ".2f"))
        yield Measure("deflection", "deflection", language.number(deflection_mm, ".2f"))
        if derived.springs_believed is not None:
            share = language.number(100.0 * derived.springs_believed, ".0f")
            yield Measure("springs", "springs", share)
        for name, ends in (
            ("restraint", derived.probability_sprung),
            ("compliance", derived.probability_giving),
        ):
            if ends is not None:
                both = {"start": 100.0 * ends.start, "end": 100.0 * ends.end}
                yield Measure(name, "ends", language.text("cell.ends", **both))
        if is_torsion_declared(crossing):
            yield Measure("torsion", "torsion_declared", language.text("torsion.declared"))
        elif derived.probability_torsion is not None:
            percent = 100.0 * derived.probability_torsion
            text = language.text("torsion.probability", share=percent)
            yield Measure("torsion", "torsion", text)
    road = crossing.road
    if road is not None and road.iri_m_per_km is not None:
        yield Measure("iri", "iri", language.number(road.iri_m_per_km, ".1f"))
    for key in _DIAGNOSTICS:
        if key in crossing.diagnostics:
            value = crossing.diagnostics[key]
            form = _FORMATS.get(key)
            text = _plain(value, language) if form is None else language.number(value, form)
            yield Measure(key, key, text)


def _plain(value: float, language: Language) -> str:
    return language.number(value, ",.0f" if abs(value) >= 100.0 else ".3g")
