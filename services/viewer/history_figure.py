"""The figure of a bridge's history: EI of each element over time, alarms, temperature."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from services.common.language import ENGLISH, Language, utc_day
from services.history.bridge_history import BridgeHistory, Statement, StoredBaseline, statements
from services.history.periods import Unit, begin_of, period_name
from services.viewer.crossing_view import VERDICT_COLOURS
from services.viewer.drawing import (
    BAR_EDGE,
    GRID,
    INK,
    LEFT,
    MUTED,
    RIGHT,
    STYLE,
    WEAK_EDGE,
    WIDTH_IN,
    LocalisedNumbers,
    write_figure,
)

_PANEL_IN, _TEMPERATURE_IN = 0.92, 0.75
_PANELS_LEFT = 0.115
"""Left edge of the panels: the reference of each stands next to it, as large as ticks."""
_SMALL_PT = 9.0
"""Smallest size of letters: 7 pt in a report's column of 180 mm."""
_NAME_AT = 0.86
"""Height of an element's name next to its panel, above its reference."""
_MAX_CHARACTERS = 100
"""Maximum length of an acknowledgement's note, one line."""
_LINE_CHARACTERS = 105
"""Maximum length of a line of a sentence."""
_MAX_PER_CENT = 400.0
"""Upper end of the axes; an interval beyond it means that the element is unresolved."""
_LOW = 0.75
"""Share of the elements' median EI below which a reference is suspected to have a loss already."""
_LEAST_DAYS = {"day": 3.0, "week": 7.0, "month": 31.0}
"""Minimum time shown before the first and after the last middle of a period: all of it, at least.

A point in the middle of an axis of two weeks would seem to be of that day, not of that month.
"""


class PeriodPoint(NamedTuple):
    """A bridge in one period; time in s since 1970 UTC, EI in N·m²."""

    time_s: float
    mean: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    verdict: str
    temperature_deg_c: float | None


class AlarmMark(NamedTuple):
    """An alarm in the figure."""

    element: int
    """Number of the element, from 1."""
    is_stiffer: bool
    since_s: float
    raised_s: float
    sentence: str
    acknowledged: str
    """Name and time of the acknowledgement; empty without one."""
    note: str = ""
    """Note of the acknowledgement."""


class HistoryReference(NamedTuple):
    """The EI of an element that is 100 %."""

    name: str
    """Period, or name of the baseline's results file."""
    is_baseline: bool
    ei_nm2: float

    @property
    def kind(self) -> str:
        """Return the end of the names of its sentences."""
        return "baseline" if self.is_baseline else "first"

    def label(self, language: Language) -> str:
        """Return its name next to an axis."""
        return language.text("history.baseline") if self.is_baseline else self.name


class HistoryView(NamedTuple):
    """Data of the figure of a bridge's history."""

    bridge: str
    unit: Unit
    points: tuple[PeriodPoint, ...]
    marks: tuple[AlarmMark, ...]
    statements: tuple[Statement, ...]
    """Sentences where no alarm is active."""
    baseline: StoredBaseline | None = None

    def reference(self, n: int) -> HistoryReference:
        """Return what element `n`, from 0, is related to: the baseline, else the first period.

        That is the first period with a good state of as many elements as the newest one. A loss in
        most periods is therefore a loss here, which it is not against a median of all periods.
        """
        elements = len(self.points[-1].mean)
        if self.baseline is not None and n < elements == len(self.baseline.mean_nm2):
            return HistoryReference(self.baseline.name, True, self.baseline.mean_nm2[n])
        known = [point for point in self.points if len(point.mean) > n]
        alike = [point for point in known if len(point.mean) == elements] or known
        first = next((point for point in alike if point.verdict == "good"), alike[0])
        name = period_name(begin_of(first.time_s, self.unit), self.unit)
        return HistoryReference(name, False, first.mean[n])


def history_figure(path: Path, past: BridgeHistory) -> None:
    """Draw a bridge's history into a PNG or SVG file; an existing file is replaced."""
    with matplotlib.rc_context(STYLE):
        figure = draw_history(history_view(past))
    write_figure(path, figure)


def history_view(past: BridgeHistory) -> HistoryView:
    """Return the data of the figure: the periods with an estimate."""
    points = []
    for one in past.periods:
        if one.state is not None and one.state.elements:
            of = list(one.state.elements.values())
            points.append(
                PeriodPoint(
                    0.5 * (one.begin_s + one.end_s),
                    tuple(e.mean for e in of),
                    tuple(e.q025 for e in of),
                    tuple(e.q975 for e in of),
                    one.state.verdict or "good",
                    one.temperature_deg_c,
                )
            )
    marks = tuple(
        AlarmMark(
            alarm.element,
            alarm.direction == "stiffer",
            alarm.since,
            alarm.raised,
            alarm.sentence(),
            "" if alarm.acknowledged is None else
            f"{alarm.acknowledged.by}, {utc_day(alarm.acknowledged.time)}",
            "" if alarm.acknowledged is None else alarm.acknowledged.note,
        )
        for alarm in past.alarms
    )  # fmt: skip
    sentences = tuple(statements(past))
    return HistoryView(past.bridge, past.unit, tuple(points), marks, sentences, past.baseline)


def draw_history(
    history: HistoryView, *, with_heading: bool = True, language: Language = ENGLISH
) -> Figure:
    """Return the figure, to be drawn in `STYLE`: a panel per element, with one scale.

    Values are per cent of each element's own reference, so that elements can be compared. The
    sentences of alarms and of monitoring in the heading are those of the view.
    """
    elements = max((len(point.mean) for point in history.points), default=0)
    has_temperature = any(p.temperature_deg_c is not None for p in history.points)
    lines = _heading(history, language) if with_heading else []
    heading = 0.62 + 0.2 * len(lines) if with_heading else 0.12
    bottom = 0.45
    below = _TEMPERATURE_IN + 0.12 if has_temperature else 0.0
    height = heading + _PANEL_IN * elements + below + bottom
    figure = Figure(figsize=(WIDTH_IN, height))
    FigureCanvasAgg(figure)
    if with_heading:
        figure.text(
            LEFT, 1.0 - 0.28 / height,
            language.text("history.figure_title", bridge=history.bridge), va="top",
            fontsize=13, fontweight="bold", color=INK, parse_math=False,
        )  # fmt: skip
    for number, (text, colour) in enumerate(lines):
        top = 1.0 - (0.58 + 0.2 * number) / height
        figure.text(LEFT, top, text, va="top", fontsize=9.5, color=colour, parse_math=False)
    limits, width = _limits(history, elements), RIGHT - _PANELS_LEFT
    first = None
    for n in range(elements):
        at = 1.0 - (heading + _PANEL_IN * (n + 1)) / height
        axes = figure.add_axes((_PANELS_LEFT, at, width, (_PANEL_IN - 0.12) / height), sharex=first)
        first = first or axes
        _draw_element(axes, history, n, limits, language)
        axes.tick_params(labelbottom=n == elements - 1 and not has_temperature)
    if first is not None:
        days = _dates(point.time_s for point in history.points)
        least = _LEAST_DAYS.get(history.unit, 7.0)
        margin = max(least, 0.04 * (max(days) - min(days)))
        first.set_xlim(min(days) - margin, max(days) + margin)
    if has_temperature and first is not None:
        size = (_PANELS_LEFT, bottom / height, width, (_TEMPERATURE_IN - 0.1) / height)
        _draw_temperature(figure.add_axes(size, sharex=first), history, language)
    return figure


def _heading(history: HistoryView, language: Language) -> list[tuple[str, str]]:
    many = len(history.points)
    unit = language.text(history.unit if many == 1 else f"{history.unit}s")
    lines = [(language.choice("history.figure_bars", many, unit=unit), MUTED)]
    if history.points:
        lines.append((reference_sentence(history, language), MUTED))
        for text in low_references(history, language):
            lines += [(line, INK) for line in textwrap.wrap(text, _LINE_CHARACTERS)]
    for mark in history.marks:
        if not mark.acknowledged:
            wording = language.text("history.figure_alarm", alarm=mark.sentence)
            lines.append((wording, _colour(mark)))
            continue
        by = _short(mark.acknowledged)
        lines.append((language.text("history.figure_noted", alarm=mark.sentence, by=by), INK))
        if mark.note:
            lines.append((f"“{_short(mark.note)}”", MUTED))
    if any(not mark.acknowledged for mark in history.marks):
        command = f"driveby alarm ack {history.bridge} --by NAME --note TEXT"
        lines.append((language.text("history.figure_ack", command=command), MUTED))
    for one in history.statements:
        colour = VERDICT_COLOURS["good"] if one.is_reassuring else INK
        lines += [(line, colour) for line in textwrap.wrap(one.text, _LINE_CHARACTERS)]
    return lines


def reference_sentence(history: HistoryView, language: Language) -> str:
    """Return what 100 % is; the first element stands for all."""
    reference = history.reference(0)
    unit = language.text(history.unit)
    return language.text(f"history.reference.{reference.kind}", name=reference.name, unit=unit)


def low_references(history: HistoryView, language: Language) -> list[str]:
    """Return a sentence on elements that were weak before the first period, or none.

    A loss before the reference is no change since.
    """
    rigidity = np.array([history.reference(n).ei_nm2 for n in range(len(history.points[-1].mean))])
    is_low = rigidity < _LOW * np.median(rigidity)
    names = [f"EI_{n + 1}" for n in np.flatnonzero(is_low)]
    if not names:
        return []
    share = 100.0 * _LOW
    return [language.text("history.low_reference", elements=language.listed(names), share=share)]


def _short(text: str) -> str:
    return text if len(text) <= _MAX_CHARACTERS else text[: _MAX_CHARACTERS - 1] + "…"


def _colour(mark: AlarmMark) -> str:
    if mark.acknowledged:
        return INK
    return BAR_EDGE if mark.is_stiffer else WEAK_EDGE


def _limits(history: HistoryView, elements: int) -> tuple[float, float]:
    """Return the limits of all panels: the whole intervals of good periods, or of all."""
    good = [point for point in history.points if point.verdict == "good"]
    ends = [90.0, 110.0]
    for n in range(elements):
        whole = history.reference(n).ei_nm2
        for point in (point for point in good or history.points if len(point.mean) > n):
            ends += [100.0 * point.low[n] / whole, 100.0 * point.high[n] / whole]
    low, high = min(ends), max(ends)
    margin = 0.05 * (high - low)
    return max(0.0, low - margin), min(high + margin, _MAX_PER_CENT)


def _draw_element(
    axes: Axes, history: HistoryView, n: int, limits: tuple[float, float], language: Language
) -> None:
    reference = history.reference(n)
    axes.axhline(100.0, color=MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
    for is_good in (True, False):
        some = [p for p in history.points if len(p.mean) > n and (p.verdict == "good") == is_good]
        if not some:
            continue
        colour = BAR_EDGE if is_good else "#8a8f94"
        times = _dates(p.time_s for p in some)
        mean, low, high = (
            np.array([100.0 * getattr(p, name)[n] / reference.ei_nm2 for p in some])
            for name in ("mean", "low", "high")
        )
        axes.vlines(times, low, high, color=colour, linewidth=1.6, alpha=0.75)
        axes.plot(times, mean, linestyle="none", marker="o", markersize=3.2, color=colour)
    for mark in history.marks:
        if mark.element == n + 1:
            _draw_mark(axes, history, mark, limits[1], language)
    axes.set_ylim(*limits)
    axes.set_ylabel(f"EI_{n + 1}", rotation=0, ha="right", va="center", labelpad=6, y=_NAME_AT)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0f} %")
    axes.yaxis.tick_right()
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    # Outside the panel, as points may be anywhere within it.
    axes.annotate(
        f"100 %:\n{reference.label(language)}\n"
        f"{language.number(reference.ei_nm2 / 1e9, '#.3g').rstrip('.,')} GN·m²", (0.0, _NAME_AT),
        xycoords="axes fraction", xytext=(-6, -7),
        textcoords="offset points", ha="right", va="top", fontsize=_SMALL_PT, color=MUTED,
    )  # fmt: skip
    _over_time(axes, language)


def _draw_mark(
    axes: Axes, history: HistoryView, mark: AlarmMark, top: float, language: Language
) -> None:
    """Draw an alarm with its words, on the side of its line where there is more room."""
    colour = _colour(mark)
    since, raised = _dates([mark.since_s, mark.raised_s])
    axes.axvspan(since, raised, color=colour, alpha=0.13, linewidth=0.0)
    axes.axvline(raised, color=colour, linewidth=1.6)
    wording = language.text(f"history.mark.{'stiffer' if mark.is_stiffer else 'weaker'}")
    if mark.acknowledged:
        wording = language.text("history.mark_noted", mark=wording)
    middle_s = 0.5 * (history.points[0].time_s + history.points[-1].time_s)
    is_late = mark.raised_s > middle_s
    axes.annotate(
        wording, (raised, top), xytext=(-4 if is_late else 4, -3), textcoords="offset points",
        ha="right" if is_late else "left", va="top", fontsize=_SMALL_PT, color=colour,
        fontweight="bold",
    )  # fmt: skip


def _draw_temperature(axes: Axes, history: HistoryView, language: Language) -> None:
    known = [p for p in history.points if p.temperature_deg_c is not None]
    axes.plot(
        _dates(p.time_s for p in known), [p.temperature_deg_c or 0.0 for p in known],
        color="#CC79A7", marker="o", markersize=2.5, linewidth=1.0,
    )  # fmt: skip
    axes.set_ylabel("°C", rotation=0, ha="right", va="center", labelpad=6)
    axes.yaxis.set_major_formatter(LocalisedNumbers(language))
    axes.yaxis.tick_right()
    axes.grid(color=GRID, linewidth=0.8)
    _over_time(axes, language)


class _LocalisedDates(ConciseDateFormatter):
    """Dates with the month names of a language, whatever the locale of the process."""

    def __init__(self, locator: Any, language: Language) -> None:
        super().__init__(locator, tz=UTC)  # type: ignore[no-untyped-call]
        english, own = (one.text("history.month_names").split(",") for one in (ENGLISH, language))
        self._names = dict(zip(english, own, strict=True))

    def format_ticks(self, values: Any) -> list[str]:
        """Return the labels of ticks."""
        labels: list[str] = super().format_ticks(values)  # type: ignore[no-untyped-call]
        return [re.sub("[A-Z][a-z]{2}", self._localised, label) for label in labels]

    def get_offset(self) -> str:
        """Return the part of the date that all ticks share."""
        shared: str = super().get_offset()  # type: ignore[no-untyped-call]
        return re.sub("[A-Z][a-z]{2}", self._localised, shared)

    def _localised(self, found: re.Match[str]) -> str:
        return self._names.get(found[0], found[0])


def _over_time(axes: Axes, language: Language) -> None:
    locator: Any = AutoDateLocator(tz=UTC)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(_LocalisedDates(locator, language))
    for side in ("top", "left", "right"):
        axes.spines[side].set_visible(False)


def _dates(times_s: Iterable[float]) -> list[float]:
    days: list[float] = [date2num(datetime.fromtimestamp(t, UTC)) for t in times_s]  # type: ignore[no-untyped-call]
    return days
