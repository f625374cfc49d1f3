"""The figure of all crossings of a bridge: EI by each of them, and the profiles they rolled on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from services.common.language import ENGLISH, Language
from services.viewer.crossing_view import VERDICT_COLOURS, CrossingView
from services.viewer.drawing import (
    LEFT,
    MUTED,
    NOMINAL_LINE,
    RIGHT,
    WIDTH_IN,
    add_ratio_axis,
    legend_beside_title,
    mark_bridge,
    simplify_axes,
    simplify_numbers,
    write_centred,
)

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000")
"""Okabe and Ito's; more crossings than these are all in the first."""
_HEIGHT_IN = 4.6


def draw_crossings(
    crossings: Sequence[tuple[int, CrossingView]], language: Language = ENGLISH
) -> Figure:
    """Return the figure of numbered crossings of one bridge, to be drawn in `STYLE`."""
    figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN), facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        2, 1, height_ratios=(3.0, 2.0), hspace=0.4, left=LEFT, right=RIGHT, top=0.93, bottom=0.11
    )
    rigidity, road = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    bridge = crossings[0][1]
    nominal = bridge.nominal_nm2 / 1e9
    rigidity.set_title(language.text("figure.by_crossing"))
    rigidity.set_ylabel(language.text("figure.ei"))
    rigidity.stairs(nominal, bridge.element_edges_m, baseline=None, **NOMINAL_LINE)
    highest = max(float(nominal.max()), _draw_intervals(rigidity, crossings, language))
    rigidity.set_ylim(0.0, 1.08 * highest)
    road.set_title(language.text("figure.road"))
    road.set_ylabel(language.text("figure.height"))
    _draw_roads(road, crossings, language)
    for axes in (rigidity, road):
        legend_beside_title(axes)
        simplify_axes(axes)
        simplify_numbers(axes, language)
        mark_bridge(axes, (0.0, *bridge.interior_supports_m, bridge.span_m))
        axes.set_xlim(-0.03 * bridge.span_m, 1.03 * bridge.span_m)
    rigidity.set_xticks(bridge.element_edges_m, [])
    for number, (start, end) in enumerate(
        zip(bridge.element_edges_m, bridge.element_edges_m[1:], strict=False), start=1
    ):
        rigidity.axvline(end, color="#d5dade", linewidth=0.6, zorder=0.6)
        rigidity.annotate(
            f"$EI_{{{number}}}$",
            ((start + end) / 2.0, 0.0),
            xytext=(0, 5),
            textcoords="offset points",
            ha="center",
            color=MUTED,
        )
    add_ratio_axis(rigidity, nominal, language)
    road.set_xlabel(language.text("figure.chainage"))
    return figure


def _colour_of(place: int, count: int) -> str:
    return _COLOURS[place] if count <= len(_COLOURS) else _COLOURS[0]


def _label_of(place: int, crossings: Sequence[tuple[int, CrossingView]], language: Language) -> str:
    """Return the label of a crossing; of many the first stands for all."""
    if len(crossings) <= len(_COLOURS):
        return language.text("figure.crossing_number", number=crossings[place][0])
    if place:
        return ""
    return language.text("figure.more", first=crossings[0][0], last=crossings[-1][0])


def _draw_intervals(
    axes: Axes, crossings: Sequence[tuple[int, CrossingView]], language: Language
) -> float:
    """Draw an interval for each crossing and element; return the highest value."""
    highest = 0.0
    edges = crossings[0][1].element_edges_m
    lengths = np.diff(edges)
    shifts = np.linspace(-0.34, 0.34, len(crossings)) if len(crossings) > 1 else np.zeros(1)
    for place, (_, crossing) in enumerate(crossings):
        if crossing.rigidity_nm2 is None or crossing.interval_nm2 is None:
            continue
        at = (edges[:-1] + edges[1:]) / 2.0 + shifts[place] * lengths
        low, high = crossing.interval_nm2.T / 1e9
        good = crossing.verdict == "good"
        colour = _colour_of(place, len(crossings)) if good else VERDICT_COLOURS[crossing.verdict]
        width = 2.2 if len(crossings) <= len(_COLOURS) else 1.2
        axes.vlines(at, low, high, color=colour, linewidth=width, zorder=4)
        axes.plot(
            at,
            crossing.rigidity_nm2 / 1e9,
            linestyle="none",
            marker="o",
            markersize=4.2,
            color=colour,
            markerfacecolor=colour if good else "white",
            zorder=5,
            label=_label_of(place, crossings, language),
        )
        highest = max(highest, float(high.max()), float(crossing.rigidity_nm2.max()) / 1e9)
    return highest


def _wheel(wheel: str, crossings: Sequence[tuple[int, CrossingView]], language: Language) -> str:
    """Return the names of the axles that are `wheel` ("front" or "rear") of some crossing."""
    found = []
    for first in sorted({one.first_axle for _, one in crossings}):
        number = first if wheel == "front" else first + 1
        of_pair = language.text(f"figure.{wheel}")
        found.append(of_pair if first == 1 else language.text("figure.axle", number=number))
    return ", ".join(found)


def _draw_roads(
    axes: Axes, crossings: Sequence[tuple[int, CrossingView]], language: Language
) -> None:
    """Draw the profile under each wheel: the front's as a line, the rear's dashed."""
    roads = [(k, one.road) for k, (_, one) in enumerate(crossings) if one.road is not None]
    if not roads:
        write_centred(axes, language.text("figure.none"))
        return
    for wheel, line in (("front", "-"), ("rear", (0, (3.2, 2.2)))):
        axes.plot([], [], color=MUTED, linestyle=line, label=_wheel(wheel, crossings, language))
        for place, road in roads:
            axes.plot(
                road.x_m,
                (road.front_m if wheel == "front" else road.rear_m) * 1e3,
                color=_colour_of(place, len(crossings)),
                linestyle=line,
                linewidth=1.1,
                alpha=0.9 if len(roads) <= len(_COLOURS) else 0.4,
            )
