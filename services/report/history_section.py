"""The section on a bridge's history: its periods next to each other."""

from collections.abc import Iterator

import matplotlib

from services.common.language import ENGLISH, Language, utc_day
from services.history.bridge_history import BridgeHistory, statements
from services.report.alarm_words import alarm_sentence
from services.report.html import Html, inlined_svg, table, tag
from services.viewer.drawing import STYLE, figure_bytes
from services.viewer.history_figure import (
    HistoryView,
    draw_history,
    history_view,
    low_references,
    reference_sentence,
)


def history_summary(past: BridgeHistory, language: Language = ENGLISH) -> str:
    """Return number of crossings and state of alarms, for the first page."""
    active = len(past.active_alarms)
    alarms = language.choice("history.alarms", active)
    if not active:
        which = "no_alarm" if past.watch.found_nothing else "not_watched"
        alarms = language.text(f"history.{which}")
    return language.text("history.summary", how_much=_how_much(past, language), alarms=alarms)


def history_section(past: BridgeHistory, prefix: str, language: Language = ENGLISH) -> Html:
    """Return the section; empty for a history without values."""
    drawn = history_view(past)
    if not drawn.points:
        return Html("")
    with matplotlib.rc_context(STYLE):
        svg = figure_bytes(draw_history(drawn, with_heading=False, language=language), "svg")
    wording = language.text(
        "history.from_to",
        how_much=_how_much(past, language),
        first=utc_day(past.periods[0].begin_s),
        last=utc_day(past.periods[-1].end_s - 1.0),
    )
    label = language.text("history.figure", summary=wording)
    reference = ". ".join((reference_sentence(drawn, language), *low_references(drawn, language)))
    how = language.text("history.how", unit=language.text(past.unit), reference=reference)
    return tag(
        "section",
        tag("h2", language.text("history.heading")),
        tag("p", wording),
        *_alarms(past, language),
        tag("figure", inlined_svg(svg, prefix, label), class_="wide"),
        _elements(drawn, language),
        tag("p", how, class_="note"),
        class_="past",
    )


def _how_much(past: BridgeHistory, language: Language) -> str:
    number = sum(one.crossings for one in past.periods)
    many = len(past.periods)
    unit = language.text(past.unit if many == 1 else f"{past.unit}s")
    return language.choice("history.how_much", number, periods=many, unit=unit)


def _alarms(past: BridgeHistory, language: Language) -> Iterator[Html]:
    lines = []
    for alarm in past.alarms:
        note = alarm.acknowledged
        state = language.text("history.active")
        if note is not None:
            values = {"by": note.by, "day": utc_day(note.time), "note": note.note}
            which = "acknowledged_note" if note.note else "acknowledged"
            state = language.text(f"history.{which}", **values)
        sentence = alarm_sentence(alarm, language)
        raised = utc_day(alarm.raised)
        line = language.text("history.alarm", day=raised, alarm=sentence, state=state)
        lines.append(tag("li", line))
    if lines:
        yield tag("ul", *lines)
    for wording in statements(past, language):
        yield tag(
            "p", wording.text, class_="reassuring" if wording.is_reassuring else "not-watched"
        )


def _elements(drawn: HistoryView, language: Language) -> Html:
    """Return the table of the newest period, and of what it is related to."""
    newest = drawn.points[-1]
    references = [drawn.reference(n) for n in range(len(newest.mean))]
    name, which, unit = references[0].name, references[0].kind, language.text(drawn.unit)
    heads = [
        language.text("table.element"),
        language.text(f"history.column.{which}", name=name, unit=unit),
        language.text("history.newest", unit=unit),
        language.text("table.interval"),
        language.text(f"history.ratio.{which}", unit=unit),
    ]
    rows = []
    for n, (mean, reference) in enumerate(zip(newest.mean, references, strict=True)):
        rows.append(
            [
                str(n + 1),
                language.number(reference.ei_nm2 / 1e9, ".2f"),
                language.number(mean / 1e9, ".2f"),
                language.text("cell.range", low=newest.low[n] / 1e9, high=newest.high[n] / 1e9),
                language.number(mean / reference.ei_nm2, ".3f"),
            ]
        )
    return table(heads, rows)
