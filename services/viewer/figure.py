"""The picture of one crossing as a PNG: flexural rigidity along the span, and the road.

Drawn with Matplotlib's objects and the Agg canvas, never with pyplot: no global state, no window.
"""

from __future__ import annotations

import io
import textwrap
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from services.common.files import write_atomically
from services.viewer.crossing_view import (
    TRUTH_COLOUR,
    VEHICLE_COLOURS,
    VERDICT_COLOURS,
    CrossingView,
    FloatArray,
    RoadView,
    summary_line,
)

WIDTH_IN, HEIGHT_IN, DPI = 9.0, 7.1, 200  # 1800 pixels: sharp at the 900 of a repository page

LEFT, RIGHT = 0.085, 0.915  # of the figure's width, between which the panels stand

INK = "#1b1f24"
MUTED = "#5b6570"
GRID = "#e3e7eb"
BAR = "#cfe3f1"
BAR_EDGE = VEHICLE_COLOURS["front"]

NOMINAL_LINE: dict[str, Any] = {"color": MUTED, "linewidth": 1.0, "linestyle": (0, (4, 3))}
TRUTH_MARKER: dict[str, Any] = {
    "linestyle": "none",
    "marker": "D",
    "markersize": 7.5,
    "markerfacecolor": "white",
    "markeredgecolor": TRUTH_COLOUR,
    "markeredgewidth": 1.3,
}

STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 7,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "legend.fontsize": 9,
    "legend.frameon": False,
}


def crossing_figure(
    path: Path,
    *,
    crossing: CrossingView,
    element_truth: list[float] | None,
    road_truth: tuple[FloatArray, FloatArray] | None,
) -> None:
    """Draw one crossing into a PNG file.

    `element_truth` is the true rigidity of each element as a ratio to the nominal value;
    `road_truth` the true profile as chainage and height in metres. Both are known only for
    simulated crossings. An existing file is replaced.
    """
    with matplotlib.rc_context(STYLE):
        figure = draw_crossing(crossing, element_truth=element_truth, road_truth=road_truth)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomically(path, buffer.getvalue())


def draw_crossing(
    crossing: CrossingView,
    *,
    element_truth: list[float] | None,
    road_truth: tuple[FloatArray, FloatArray] | None,
) -> Figure:
    """The figure itself, for callers that want another format than PNG."""
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        3,
        1,
        height_ratios=(3.0, 2.0, 1.15),
        hspace=0.27,
        left=LEFT,
        right=RIGHT,
        top=0.835,
        bottom=0.072,
    )
    rigidity = figure.add_subplot(grid[0])
    profile = figure.add_subplot(grid[1], sharex=rigidity)
    difference = figure.add_subplot(grid[2], sharex=rigidity)

    _draw_heading(figure, crossing)
    _draw_rigidity(rigidity, crossing, element_truth)
    _draw_profiles(profile, crossing, road_truth)
    _draw_differences(difference, crossing.road, road_truth)

    for axes in (rigidity, profile, difference):
        _quieten(axes)
        _mark_bridge(axes, (0.0, *crossing.interior_supports_m, crossing.span_m))
    for axes in (rigidity, profile):
        axes.tick_params(labelbottom=False)
    rigidity.set_xlim(*_chainage_limits(crossing))
    difference.set_xlabel("chainage from the start of the bridge (m)")
    return figure


def _draw_heading(figure: Figure, crossing: CrossingView) -> None:
    title = "Bridge stiffness and road profile from one drive over the bridge"
    figure.text(LEFT, 0.975, title, fontsize=14, fontweight="bold", va="top")
    summary = textwrap.shorten(summary_line(crossing), width=105, placeholder=" …")
    figure.text(LEFT, 0.936, summary, fontsize=9.5, color=MUTED, va="top")
    verdict = f"verdict: {crossing.verdict}"
    colour = VERDICT_COLOURS[crossing.verdict]
    figure.text(LEFT, 0.909, verdict, fontsize=9.5, fontweight="bold", color=colour, va="top")
    reasons = textwrap.shorten(" ".join(crossing.reason_texts), width=92, placeholder=" …")
    figure.text(RIGHT, 0.908, reasons, fontsize=8.5, color=MUTED, ha="right", va="top")


def _draw_rigidity(axes: Axes, crossing: CrossingView, truth: list[float] | None) -> None:
    edges = crossing.element_edges_m
    nominal = crossing.nominal_nm2 / 1e9
    centres = (edges[:-1] + edges[1:]) / 2.0
    axes.set_title("Flexural rigidity EI")
    axes.set_ylabel("EI (GN·m²)")
    axes.stairs(nominal, edges, baseline=None, label="nominal", **NOMINAL_LINE)
    highest = float(nominal.max())
    if truth is not None:
        true_values = np.asarray(truth) * nominal
        # Beside the interval's line, which may be shorter than the marker.
        beside = centres - 0.22 * np.diff(edges)
        axes.plot(beside, true_values, label="truth", zorder=4, **TRUTH_MARKER)
        highest = max(highest, float(true_values.max()))
    if crossing.rigidity_nm2 is None:
        _write_rejection(axes, crossing)
    else:
        highest = max(highest, _draw_estimate(axes, crossing, crossing.rigidity_nm2 / 1e9))
    axes.set_ylim(0.0, 1.1 * highest)
    _legend_beside_title(axes)
    if np.ptp(nominal) <= 1e-9 * nominal.max():
        _add_ratio_axis(axes, float(nominal[0]))


def _draw_estimate(axes: Axes, crossing: CrossingView, estimate: FloatArray) -> float:
    """Bars, intervals and labels, in GN·m²; returns the highest value drawn."""
    edges = crossing.element_edges_m
    centres, lengths = (edges[:-1] + edges[1:]) / 2.0, np.diff(edges)
    axes.bar(
        centres,
        estimate,
        width=0.86 * lengths,
        color=BAR,
        edgecolor=BAR_EDGE,
        linewidth=1.1,
        zorder=2,
        label="estimate",
    )
    lowest, highest = estimate, float(estimate.max())
    if crossing.interval_nm2 is not None:
        low, high = crossing.interval_nm2.T / 1e9
        colour = BAR_EDGE if crossing.interval_has_meaning else MUTED
        label = "95 % interval" if crossing.interval_has_meaning else "interval (without meaning)"
        axes.vlines(centres, low, high, color=colour, linewidth=2.2, zorder=5, label=label)
        for end in (low, high):
            axes.hlines(
                end, centres - 0.09 * lengths, centres + 0.09 * lengths, color=colour, zorder=5
            )
        lowest, highest = np.minimum(lowest, low), max(highest, float(high.max()))
    ratios = estimate / (crossing.nominal_nm2 / 1e9)
    for number, (centre, bottom, ratio) in enumerate(
        zip(centres, lowest, ratios, strict=True), start=1
    ):
        above = bottom < 0.25 * highest  # no room for the label inside a bar as low as this
        axes.annotate(
            f"{ratio:.3f}",
            (centre, max(estimate[number - 1], bottom) if above else bottom),
            xytext=(0, 12 if above else -10),
            textcoords="offset points",
            ha="center",
            va="bottom" if above else "top",
            fontsize=10.5,
            fontweight="bold",
            zorder=7,
        )
        axes.annotate(
            f"$EI_{{{number}}}$",
            (centre, 0.0),
            xytext=(0, 5),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=10,
            color=MUTED,
            zorder=7,
        )
    return highest


def _add_ratio_axis(axes: Axes, nominal: float) -> None:
    """Mark ratios at the right on a twin with the same limits: both are linear from zero."""
    ratio = axes.twinx()
    low, high = axes.get_ylim()
    ratio.set_ylim(low / nominal, high / nominal)
    ratio.set_ylabel("ratio to nominal")
    ratio.spines[:].set_visible(False)
    ratio.yaxis.set_major_locator(MaxNLocator(nbins=8, steps=[1, 2, 5, 10]))
    ratio.tick_params(length=0)


def _draw_profiles(
    axes: Axes, crossing: CrossingView, truth: tuple[FloatArray, FloatArray] | None
) -> None:
    axes.set_title("Road profile")
    if crossing.road is not None or truth is not None:
        axes.set_ylabel("height (mm)")
    if truth is not None:
        axes.plot(truth[0], truth[1] * 1e3, color="#b9c0c7", linewidth=5.0, label="truth")
    road = crossing.road
    if road is None:
        _leave_empty(axes)
    else:
        axes.plot(
            road.x_m,
            road.front_m * 1e3,
            color=VEHICLE_COLOURS["front"],
            linewidth=1.7,
            label="felt by the front wheel",
        )
        axes.plot(
            road.x_m,
            road.rear_m * 1e3,
            color=VEHICLE_COLOURS["rear"],
            linewidth=1.7,
            linestyle=(0, (3.2, 2.2)),
            label="felt by the rear wheel",
        )
    _legend_beside_title(axes)


def _draw_differences(
    axes: Axes, road: RoadView | None, truth: tuple[FloatArray, FloatArray] | None
) -> None:
    axes.set_title("Differences")
    if road is None:
        _leave_empty(axes)
        return
    mean = (road.front_m + road.rear_m) / 2.0
    between = road.front_m - road.rear_m
    error = None if truth is None else mean - np.interp(road.x_m, *truth, left=np.nan, right=np.nan)
    largest = float(np.nanmax(np.abs(between)))
    if error is not None and not np.isnan(error).all():
        largest = max(largest, float(np.nanmax(np.abs(error))))
    unit, factor = _unit_of_length(largest)
    axes.set_ylabel(unit)
    axes.axhline(0.0, color=MUTED, linewidth=0.7)
    if error is not None:
        axes.plot(road.x_m, error * factor, color="#8a939c", linewidth=1.6, label="mean − truth")
    axes.plot(
        road.x_m,
        between * factor,
        color=INK,
        linewidth=1.1,
        label="front − rear",
    )
    _legend_beside_title(axes)


def _unit_of_length(largest_m: float) -> tuple[str, float]:
    """Millimetres, micrometres or nanometres: whichever gives readable tick labels."""
    if largest_m >= 1e-4:
        return "mm", 1e3
    return ("µm", 1e6) if largest_m >= 1e-7 else ("nm", 1e9)


def _mark_bridge(axes: Axes, supports_m: tuple[float, ...]) -> None:
    """Shade the bridge and set a bearing below each of its supports."""
    axes.axvspan(supports_m[0], supports_m[-1], color="#f4f7f9", zorder=0, linewidth=0)
    for support in supports_m:
        axes.axvline(support, color=MUTED, linewidth=0.8, zorder=1)
        axes.plot(
            support,
            0.0,
            marker=6,
            markersize=7,
            color=MUTED,
            transform=axes.get_xaxis_transform(),
            clip_on=False,
            zorder=8,
        )


def _quieten(axes: Axes) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(axis="y", color=GRID, linewidth=0.8, zorder=0.5)
    axes.set_axisbelow(True)
    if len(axes.get_yticks()):
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))
    axes.tick_params(length=3)


def _legend_beside_title(axes: Axes) -> None:
    handles, _ = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            loc="lower right",
            bbox_to_anchor=(1.008, 0.985),
            ncols=len(handles),
            columnspacing=1.6,
            handlelength=2.4,
            borderpad=0.0,
        )


def _write_rejection(axes: Axes, crossing: CrossingView) -> None:
    _write_centred(
        axes, "\n".join(("No estimate: the crossing was rejected.", *crossing.reason_texts))
    )


def _write_centred(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=MUTED)


def _leave_empty(axes: Axes) -> None:
    _write_centred(axes, "No road profile was estimated.")
    axes.set_yticks([])


def _chainage_limits(crossing: CrossingView) -> tuple[float, float]:
    """The bridge and what was estimated before and after it, at most half a span on each side."""
    margin = 0.03 * crossing.span_m
    left, right = 0.0, crossing.span_m
    if crossing.road is not None:
        left = max(min(left, float(crossing.road.x_m.min())), -crossing.span_m / 2.0)
        right = min(max(right, float(crossing.road.x_m.max())), 1.5 * crossing.span_m)
    return left - margin, right + margin
