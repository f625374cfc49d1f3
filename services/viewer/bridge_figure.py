"""The figure of one bridge: its stiffness along the span, and all crossings used for it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.markers import CARETUP

from services.common.arrays import Floats
from services.common.language import ENGLISH, Language
from services.common.naming import count_of
from services.viewer.bridge_view import BridgeView, summary_of_bridge
from services.viewer.crossing_view import VERDICT_COLOURS, CrossingView
from services.viewer.drawing import (
    ABOVE_LEGEND_PT,
    BANNERS,
    BAR_EDGE,
    INK,
    LEFT,
    MUTED,
    NOMINAL_LINE,
    RIGHT,
    STYLE,
    WIDTH_IN,
    BarPlaces,
    add_ratio_axis,
    bar_places,
    draw_bars,
    legend_beside_title,
    mark_bridge,
    simplify_axes,
    simplify_numbers,
    wrapped,
    write_centred,
    write_figure,
)
from services.viewer.element_labels import (
    AFTER,
    BEFORE,
    anchors_clear_of,
    arrow_names,
    change_texts,
    columns_gnm2,
    cut_height,
    draw_baseline,
    draw_intervals,
    end_with_names,
    label_elements,
)

_MAX_LISTED = 12
_SIGNS = {"good": "●", "unused": "○", "suspect": "◇", "rejected": "×"}
"""Signs of good crossings, of unused good ones, and of the other verdicts, without colour."""
_MARKERS = {"suspect": "D", "rejected": "X"}


_SMALL, _SMALLER = 8.0, 6.5
"""Sizes of the values of single crossings, in points; the latter for many elements."""
_MANY = 11
_ROW_IN = 0.2
"""Height of a line in the list of crossings."""
_STEM = 0.05
"""Length of an arrow's line, relative to the height of its tip."""


_FEWEST_DOTS = 2
"""Smallest number of crossings of which each has dots: a single one is the state itself."""


class _Line(NamedTuple):
    """A line of the list of crossings: a text with a sign, or EI / nominal of each element."""

    sign: str
    text: str
    values: tuple[str, ...] = ()


def bridge_figure(path: Path, bridge: BridgeView) -> None:
    """Draw one bridge into a PNG or SVG file; an existing file is replaced."""
    with matplotlib.rc_context(STYLE):
        figure = draw_bridge(bridge)
    write_figure(path, figure)


def draw_bridge(
    bridge: BridgeView, *, with_heading: bool = True, language: Language = ENGLISH
) -> Figure:
    """Return the figure, to be drawn in `STYLE`; without heading and list it is one panel.

    The heading and the list are English.
    """
    listed = _listed(bridge) if with_heading else []
    lines = _heading(bridge) if with_heading else []
    heading_in = 1.35 + 0.17 * max(0, len(lines) - 2) if with_heading else 0.47
    # A report has room for a low panel, as wide as its text.
    panel_in, list_in = 3.6 if with_heading else 1.35, _ROW_IN * len(listed)
    list_in += 0.35 if listed else 0.0
    below_in = 0.5 if with_heading else 0.43
    height = heading_in + panel_in + below_in + list_in
    figure = Figure(figsize=(WIDTH_IN, height), facecolor="white")
    FigureCanvasAgg(figure)
    bottom = (list_in + below_in) / height
    axes = figure.add_axes((LEFT, bottom, RIGHT - LEFT, panel_in / height))
    _draw_panel(axes, bridge, language)
    if with_heading:
        _draw_heading(figure, bridge, lines)
        _list_crossings(figure, listed, (list_in - 0.1) / height, _ROW_IN / height)
        _write_values(figure, axes, bridge, listed, (list_in - 0.1) / height)
    return figure


def _draw_panel(axes: Axes, bridge: BridgeView, language: Language) -> None:
    nominal = bridge.nominal_nm2 / 1e9
    axes.set_xlim(-0.03 * bridge.span_m, 1.03 * bridge.span_m)
    axes.set_ylabel(language.text("figure.ei"))
    label = language.text("figure.nominal")
    axes.stairs(nominal, bridge.edges_m, baseline=None, label=label, **NOMINAL_LINE)
    top = 1.1 * float(nominal.max())
    if bridge.estimate is None:
        write_centred(axes, _why_nothing(bridge))
    else:
        top = end_with_names(axes, max(top, _draw_state(axes, bridge, language)))
    axes.set_ylim(0.0, top)
    legend_beside_title(axes, arrow_names(axes, language))
    title = language.text("figure.rigidity")
    if bridge.estimate is not None:
        title += f" {language.text(f'figure.numbers_{_meaning(bridge)}')}"
    axes.set_title(title, pad=ABOVE_LEGEND_PT)
    simplify_axes(axes)
    simplify_numbers(axes, language)
    if _meaning(bridge) == "ratio":
        add_ratio_axis(axes, nominal, language)
    mark_bridge(axes, (0.0, *bridge.interior_supports_m, bridge.span_m))
    axes.set_xlabel(language.text("figure.chainage"))


def _draw_state(axes: Axes, bridge: BridgeView, language: Language) -> float:
    """Draw the state, the baseline next to it and single crossings; return the axis' end."""
    assert bridge.estimate is not None  # noqa: S101 - its caller checked
    mean, low, high = columns = columns_gnm2(bridge.estimate)
    before = None if bridge.baseline is None else columns_gnm2(bridge.baseline)
    drawn = [c for c in bridge.crossings if c.rigidity_nm2 is not None]
    dots = _dots(drawn, mean.size)
    resolved = [n for n in range(mean.size) if n + 1 not in bridge.unresolved]
    counts = np.array([_kind_of(bridge, one) == "good" for one in drawn[: len(dots)]], dtype=bool)
    highest = max(0.0, bridge.nominal_nm2.max() / 1e9, *dots[counts][:, resolved].flat)
    farthest = dots.max(initial=0.0)
    cut = cut_height(highest, columns, *([] if before is None else [before]), farthest=farthest)
    places = bar_places(bridge.edges_m)
    if before is not None:
        places = bar_places(bridge.edges_m, *AFTER)
        draw_baseline(axes, bar_places(bridge.edges_m, *BEFORE), before, cut, language)
        highest = max(highest, float(before[2].max()))
    weak = () if bridge.comparison is None else bridge.comparison.weak
    draw_bars(
        axes,
        places,
        mean,
        {element.number for element in weak},
        doubtful=bridge.is_doubtful,
        unresolved=bridge.unresolved,
        language=language,
    )
    colour = MUTED if bridge.is_doubtful else BAR_EDGE
    label = language.text("figure.interval")
    draw_intervals(axes, places, (low, high), colour=colour, label=label, cut=cut)
    beyond = np.where(dots > cut, cut, np.nan)
    dots[dots > cut] = np.nan
    _draw_crossings(axes, bridge, places, drawn, (dots, beyond), language)
    ends = np.minimum(high, cut)
    drawn_to = (*dots[dots > 0.0], *beyond[beyond > 0.0])
    highest = min(cut, max(highest, float(ends.max()), *drawn_to))
    return _label(axes, bridge, places, (mean, low, ends), dots, highest, language)


def _label(
    axes: Axes,
    bridge: BridgeView,
    places: BarPlaces,
    columns: tuple[Floats, Floats, Floats],
    dots: Floats,
    highest: float,
    language: Language,
) -> float:
    """Write numbers, losses and names of elements; return the axis' end."""
    mean, low, ends = columns
    anchors = anchors_clear_of(axes, places, (low, ends), dots, 1.1 * highest)
    losses = {}
    weak = () if bridge.comparison is None else bridge.comparison.weak
    if _meaning(bridge) == "ratio":  # otherwise the numbers themselves are the changes
        losses = {
            element.number: language.text("figure.less", loss=100.0 * (1.0 - element.ratio))
            for element in weak
        }
    texts = _numbers(bridge, mean, language)
    return label_elements(axes, bridge.edges_m, anchors, texts, losses, highest)


def _dots(drawn: list[CrossingView], elements: int) -> Floats:
    """Return the estimates of single crossings in GN·m² (k, n); none of only one crossing."""
    if len(drawn) < _FEWEST_DOTS:
        return np.zeros((0, elements))
    return np.array([c.rigidity_nm2 for c in drawn], dtype=np.float64) / 1e9


def _meaning(bridge: BridgeView) -> str:
    """Return what the numbers in a figure are: its `ratio` to nominal, or the `change`."""
    return "ratio" if bridge.baseline is None or bridge.comparison is None else "change"


def _numbers(bridge: BridgeView, mean: Floats, language: Language) -> list[str]:
    """Return the number of each bar, all with one meaning."""
    if _meaning(bridge) == "change":
        assert bridge.comparison is not None  # noqa: S101 - its meaning says so
        return change_texts(bridge.comparison, language)
    return [language.number(ratio, ".3f") for ratio in mean / (bridge.nominal_nm2 / 1e9)]


def _draw_crossings(
    axes: Axes,
    bridge: BridgeView,
    places: BarPlaces,
    drawn: list[CrossingView],
    heights: tuple[Floats, Floats],
    language: Language,
) -> None:
    """Draw the estimates (k, n) of single crossings next to the interval.

    An arrow stands at the second height for an estimate that is beyond it.
    """
    dots, beyond = heights
    named: set[str] = set()
    shifts = np.linspace(-0.4, -0.26, len(dots))
    for place, crossing, values, ends in zip(shifts, drawn, dots, beyond, strict=False):
        kind = _kind_of(bridge, crossing)
        at_m = places.centres_m + place * places.lengths_m
        is_beyond = np.isfinite(ends)
        if is_beyond.any():
            from_m, tip = at_m[is_beyond], ends[is_beyond]
            axes.vlines(from_m, (1.0 - _STEM) * tip, tip, color=INK, linewidth=1.2, zorder=9)
            arrow: dict[str, Any] = {"linestyle": "none", "color": INK, "zorder": 9}
            axes.plot(from_m, tip, marker=CARETUP, markersize=6.0, **arrow)
        axes.plot(
            at_m,
            values,
            linestyle="none",
            marker=_MARKERS.get(kind, "o"),
            markersize=4.2,
            color=INK,
            markerfacecolor=INK if kind == "good" else "white",
            markeredgewidth=0.9,
            zorder=9,  # above the plates of all labels: they hid measurements
            label=None if kind in named else language.text(f"figure.crossing.{kind}"),
        )
        named.add(kind)


def _kind_of(bridge: BridgeView, crossing: CrossingView) -> str:
    """Return the verdict of a crossing, `unused` for a good one that the numbers do not include."""
    is_unused = crossing.verdict == "good" and crossing.crossing_id not in bridge.used
    return "unused" if is_unused else crossing.verdict


def _draw_heading(figure: Figure, bridge: BridgeView, lines: list[str]) -> None:
    height = figure.get_figheight()
    name = bridge.bridge if bridge.owner_id is None else f"{bridge.owner_id} ({bridge.bridge})"
    title = textwrap.shorten(f"Bridge {name}, {bridge.span_m:g} m", width=52, placeholder=" …")
    large: dict[str, Any] = {"fontsize": 14, "fontweight": "bold", "va": "top"}
    figure.text(LEFT, 1.0 - 0.18 / height, title, parse_math=False, **large)
    top = 1.0 - 0.47 / height
    banner = None
    if bridge.is_doubtful:
        colours = {"facecolor": BANNERS["suspect"], "edgecolor": VERDICT_COLOURS["suspect"]}
        banner = {"boxstyle": "round,pad=0.35", "linewidth": 1.4} | colours
    words = "\n".join(lines)
    left = LEFT if banner is None else LEFT + 0.006  # the banner's edge is beside the words
    figure.text(left, top, words, fontsize=9.5, color=INK, va="top", bbox=banner)


def _heading(bridge: BridgeView) -> list[str]:
    """Return the lines of text above the figure."""
    doubt = f"DOUBTFUL: {_doubt(bridge)} " if bridge.is_doubtful else ""
    sentences = summary_of_bridge(bridge)
    if bridge.estimate is None:
        number = len(bridge.crossings)
        sentences = f"No finding: none of {number} crossings could be used."
        if number == 1:
            sentences = "No finding: the only crossing could not be used."
    return wrapped(doubt + sentences, 112, 6)


def _doubt(bridge: BridgeView) -> str:
    """Return in a sentence why the figure is doubtful."""
    if bridge.state is not None and bridge.state.reason_texts:
        return bridge.state.reason_texts[0]
    return "a crossing that was used is suspect."


def _why_nothing(bridge: BridgeView) -> str:
    if not bridge.crossings:
        return "No truck has crossed this bridge."
    reasons = dict.fromkeys(text for c in bridge.crossings for text in c.reason_texts)
    lines = ["No estimate. The reasons:"]
    return "\n".join([*lines, *(f"• {text}" for text in list(reasons)[:6])])


def _listed(bridge: BridgeView) -> list[_Line]:
    """Return the lines of the list of crossings; the last may count others."""
    listed = bridge.crossings[-_MAX_LISTED:]
    more = len(bridge.crossings) - len(listed)
    rows = [line for crossing in reversed(listed) for line in _rows(bridge, crossing)]
    return rows + ([_Line("", f"… and {count_of(more, 'earlier crossing')}")] if more else [])


def _list_crossings(figure: Figure, listed: Sequence[_Line], top: float, step: float) -> None:
    for number, (sign, row, _) in enumerate(listed):
        y = top - number * step
        colour = MUTED if row.startswith("…") else INK
        figure.text(LEFT, y, sign, fontsize=9, va="top")
        figure.text(LEFT + 0.018, y, row, fontsize=8.5, va="top", color=colour, parse_math=False)


def _write_values(
    figure: Figure, axes: Axes, bridge: BridgeView, listed: Sequence[_Line], top: float
) -> None:
    """Write the values of single crossings below the elements, where their dots are."""
    centres_m = bar_places(bridge.edges_m).centres_m
    left, right = axes.get_xlim()
    at = LEFT + (RIGHT - LEFT) * (centres_m - left) / (right - left)
    size = _SMALLER if centres_m.size > _MANY else _SMALL
    step = _ROW_IN / figure.get_figheight()
    for number, line in enumerate(listed):
        y = top - number * step
        if line.values:
            figure.text(
                LEFT, y, "EI / nominal", fontsize=_SMALLER, ha="right", va="top", color=MUTED
            )
        for x, value in zip(at, line.values, strict=False):
            figure.text(x, y, value, fontsize=size, ha="center", va="top", color=MUTED)


def _rows(bridge: BridgeView, crossing: CrossingView) -> list[_Line]:
    """Return the lines of a crossing with all of its reasons, and its values if it has a dot.

    The first line has its sign.
    """
    moment = datetime.fromtimestamp(crossing.entry_time_s, UTC)
    way = "start to end" if crossing.forward else "end to start"
    used = ", used" if crossing.crossing_id in bridge.used else ""
    why = f": {' '.join(crossing.reason_texts)}" if crossing.reason_texts else ""
    line = (
        f"{moment:%Y-%m-%d %H:%M} UTC, {crossing.vehicle}, {way}, "
        f"{crossing.speed_m_per_s:.1f} m/s, {crossing.verdict}{used}{why}"
    )
    lines = textwrap.wrap(line, 116, subsequent_indent="    ")
    signs = [_SIGNS[_kind_of(bridge, crossing)], *[""] * len(lines)]
    rows = [_Line(sign, text) for sign, text in zip(signs, lines, strict=False)]
    drawn = [one for one in bridge.crossings if one.rigidity_nm2 is not None]
    if crossing.rigidity_nm2 is None or len(drawn) < _FEWEST_DOTS:
        return rows
    ratios = crossing.rigidity_nm2 / crossing.nominal_nm2
    return [*rows, _Line("", "", tuple(f"{one:.3f}" for one in ratios))]
