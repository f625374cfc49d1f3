"""The page of a bridge's past: what a history says of it, months beside each other."""

from collections.abc import Iterator
from datetime import UTC, datetime

import matplotlib
import numpy as np

from services.history.past import Past, statements
from services.report.html import Html, inlined_svg, table, tag
from services.viewer.drawing import STYLE, figure_bytes
from services.viewer.history_figure import History, draw_history, history_of

_HOW = (
    "Each bar is what all crossings of a {unit} say together, in per cent of the element's own "
    "median over time, with its 95 % interval. A wave that all elements share comes from the "
    "seasons: temperature changes stiffness. An alarm means that an element has changed by more "
    "than chance, season, usual slow movement and shared errors, and clearly by more than the "
    "smallest change of interest."
)


def past_in_short(past: Past) -> str:
    """How much there is, and whether an alarm stands, for the first page."""
    standing = sum(alarm.acknowledged is None for alarm in past.alarms)
    alarms = {1: "an alarm stands"}.get(standing, f"{standing} alarms stand")
    if not standing:
        alarms = "no alarm stands" if past.watch.found_nothing else "not watched for changes"
    return f"{_how_much(past)}; {alarms} (see the bridge over time)"


def past_section(past: Past, prefix: str) -> Html:
    """The section; empty of a past without numbers."""
    drawn = history_of(past)
    if not drawn.points:
        return Html("")
    with matplotlib.rc_context(STYLE):
        svg = figure_bytes(draw_history(drawn), "svg")
    first, last = past.periods[0].begin_s, past.periods[-1].end_s
    said = f"{_how_much(past)}, {_day(first)} to {_day(last)}."
    return tag(
        "section",
        tag("h2", "The bridge over time"),
        tag("p", said),
        *_alarms(past),
        tag("figure", inlined_svg(svg, prefix, f"EI of each element over time. {said}")),
        _elements(drawn),
        tag("p", _HOW.format(unit=past.unit), class_="note"),
        class_="past",
    )


def _how_much(past: Past) -> str:
    number = sum(one.crossings for one in past.periods)
    many = f"{past.unit}{'s' if len(past.periods) != 1 else ''}"
    return f"{number} crossings in {len(past.periods)} {many}"


def _alarms(past: Past) -> Iterator[Html]:
    lines = []
    for alarm in past.alarms:
        note = alarm.acknowledged
        state = "It stands: nobody has taken note of it."
        if note is not None:
            about = f": {note.note}" if note.note else "."
            state = f"{note.by} took note of it on {_day(note.time)}{about}"
        lines.append(tag("li", f"Alarm of {_day(alarm.raised)}: {alarm.sentence()}. {state}"))
    if lines:
        yield tag("ul", *lines)
    for said in statements(past):
        yield tag("p", said.text, class_="reassuring" if said.is_reassuring else "not-watched")


def _elements(drawn: History) -> Html:
    """What is usual of each element, and what the newest period says."""
    newest = drawn.points[-1]
    heads = [
        "Element",
        f"Median of all {drawn.unit}s (GN·m²)",
        f"Newest {drawn.unit} (GN·m²)",
        "95 % interval",
        "Of the median",
    ]
    rows = []
    for n, mean in enumerate(newest.mean):
        usual = float(np.median([p.mean[n] for p in drawn.points if len(p.mean) > n]))
        rows.append(
            [
                str(n + 1),
                f"{usual / 1e9:.2f}",
                f"{mean / 1e9:.2f}",
                f"{newest.low[n] / 1e9:.2f}–{newest.high[n] / 1e9:.2f}",
                f"{mean / usual:.3f}",
            ]
        )
    return table(heads, rows)


def _day(time_s: float) -> str:
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d}"
