"""The figure of all crossings of a bridge: EI by each of them, and the road profiles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from services.common.language import ENGLISH, Language
from services.viewer.crossing_view import CrossingView
from services.viewer.drawing import (
    LEFT,
    MUTED,
    NOMINAL_LINE,
    RIGHT,
    WIDTH_IN,
    BarPlaces,
    add_ratio_axis,
    legend_beside_title,
    mark_bridge,
    simplify_axes,
    simplify_numbers,
    write_centred,
)
from services.viewer.element_labels import (
    arrow_names,
    cut_height,
    draw_lines,
    end_with_names,
    name_elements,
)

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000")
"""Okabe and Ito's; more crossings than these are all in the first."""
_HEIGHT_IN = 3.4


def draw_crossings(
    crossings: Sequence[tuple[int, CrossingView]], language: Language = ENGLISH
) -> Figure:
    """Return the figure of numbered crossings of one bridge, to be drawn in `STYLE`."""
    figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN), facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        2, 1, height_ratios=(3.0, 2.0), hspace=0.5, left=LEFT, right=RIGHT, top=0.91, bottom=0.13
    )
    rigidity, road = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    bridge = crossings[0][1]
    nominal = bridge.nominal_nm2 / 1e9
    rigidity.set_title(language.text("figure.by_crossing"))
    rigidity.set_ylabel(language.text("figure.ei"))
    rigidity.stairs(nominal, bridge.element_edges_m, baseline=None, **NOMINAL_LINE)
    highest = _draw_intervals(rigidity, crossings, language)
    rigidity.set_ylim(0.0, end_with_names(rigidity, 1.02 * highest))
    road.set_title(language.text("figure.road"))
    road.set_ylabel(language.text("figure.height"))
    _draw_roads(road, crossings, language)
    for axes in (rigidity, road):
        legend_beside_title(axes, arrow_names(axes, language))
        simplify_axes(axes)
        simplify_numbers(axes, language)
        mark_bridge(axes, (0.0, *bridge.interior_supports_m, bridge.span_m))
        axes.set_xlim(-0.03 * bridge.span_m, 1.03 * bridge.span_m)
    rigidity.set_xticks(bridge.element_edges_m, [])
    for end in bridge.element_edges_m[1:]:
        rigidity.axvline(end, color="#d5dade", linewidth=0.6, zorder=0.6)
    name_elements(rigidity, bridge.element_edges_m)
    add_ratio_axis(rigidity, nominal, language)
    road.set_xlabel(language.text("figure.chainage"))
    return figure


def _colour_of(place: int, count: int) -> str:
    return _COLOURS[place] if count <= len(_COLOURS) else _COLOURS[0]


def _label_of(place: int, crossings: Sequence[tuple[int, CrossingView]], language: Language) -> str:
    """Return the label of a crossing; of many the first of each verdict stands for all."""
    verdict = crossings[place][1].verdict
    if len(crossings) <= len(_COLOURS):
        label = language.text("figure.crossing_number", number=crossings[place][0])
        return label if verdict == "good" else f"{label}, {language.text(verdict)}"
    if verdict in [one.verdict for _, one in crossings[:place]]:
        return ""
    if verdict != "good":
        return language.text(f"figure.crossing.{verdict}")
    return language.text("figure.more", first=crossings[0][0], last=crossings[-1][0])


def _draw_intervals(
    axes: Axes, crossings: Sequence[tuple[int, CrossingView]], language: Language
) -> float:
    """Draw an interval for each crossing and element; return the highest value.

    A suspect crossing has the open diamond of the bridge's figure, in its own colour.
    """
    edges, nominal = crossings[0][1].element_edges_m, crossings[0][1].nominal_nm2 / 1e9
    highest = float(nominal.max())
    shifts = np.linspace(-0.34, 0.34, len(crossings)) if len(crossings) > 1 else np.zeros(1)
    columns = {
        place: (one.rigidity_nm2 / 1e9, *(one.interval_nm2.T / 1e9))
        for place, (_, one) in enumerate(crossings)
        if one.rigidity_nm2 is not None and one.interval_nm2 is not None
    }
    cut = cut_height(highest, *columns.values())
    width = 2.2 if len(crossings) <= len(_COLOURS) else 1.2
    for place, (mean, low, high) in columns.items():
        lengths = np.diff(edges)
        places = BarPlaces((edges[:-1] + edges[1:]) / 2.0 + shifts[place] * lengths, lengths)
        good = crossings[place][1].verdict == "good"
        colour = _colour_of(place, len(crossings))
        draw_lines(axes, places, (low, high), colour=colour, cut=cut, width=width)
        axes.plot(
            places.centres_m,
            np.where(mean > cut, np.nan, mean),
            linestyle="none",
            marker="o" if good else "D",
            markersize=4.2,
            color=colour,
            markerfacecolor=colour if good else "white",
            zorder=5,
            label=_label_of(place, crossings, language),
        )
        highest = max(highest, float(np.minimum(np.maximum(high, mean), cut).max()))
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
