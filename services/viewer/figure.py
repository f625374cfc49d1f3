"""The figure of one crossing: flexural rigidity along the span, and the road profile."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from schemas.results import RoadResult
from services.common.arrays import Floats
from services.common.language import ENGLISH
from services.identification.comparison import Comparison, Estimate
from services.identification.result_parts import detrended
from services.viewer.crossing_view import (
    VEHICLE_COLOURS,
    CrossingView,
    comparison_of,
    describe_crossing,
    summary_line,
)
from services.viewer.drawing import (
    ABOVE_LEGEND_PT,
    BAR_EDGE,
    INK,
    LEFT,
    MUTED,
    NOMINAL_LINE,
    REASON_LINE_IN,
    RIGHT,
    STYLE,
    TRUTH_MARKER,
    WIDTH_IN,
    add_ratio_axis,
    banner_height_in,
    bar_places,
    draw_bars,
    draw_verdict,
    finding_lines,
    legend_beside_title,
    mark_bridge,
    reason_lines,
    simplify_axes,
    write_centred,
    write_figure,
)
from services.viewer.element_labels import (
    AFTER,
    BEFORE,
    Anchors,
    arrow_names,
    change_texts,
    columns_gnm2,
    cut_height,
    draw_baseline,
    draw_intervals,
    end_with_names,
    label_elements,
)
from services.viewer.residual_size import TREND_DEGREE

HEIGHT_IN = 7.1
_TREND = "cubic trend: mostly drift"
_ERROR = "mean − truth, without offset, tilt and bend"
_HEIGHT_WITHOUT_ROAD_IN = 4.4
_HEADING_IN, _BANNER_IN = 1.17, 0.36
"""Height of the heading above the first panel, and of a banner in addition."""
_LEGEND_IN = 0.21
_VERDICT_IN = 0.65
"""Distance of the verdict from the figure's top."""
_EXPLANATION_LINE_IN, _EXPLANATION_GAP_IN = 0.165, 0.1
"""Height of a line that explains a rejection above the panels, and of the gap to the banner."""


def crossing_figure(
    path: Path,
    *,
    crossing: CrossingView,
    element_truth: list[float] | None = None,
    road_truth: tuple[Floats, Floats] | None = None,
    baseline: Estimate | None = None,
) -> None:
    """Draw one crossing into a PNG or SVG file; an existing file is replaced.

    `element_truth` is the true rigidity of each element as a ratio to the nominal value;
    `road_truth` the true profile as chainage and height in metres. Both are known only for
    simulated crossings. With a `baseline` the elements are compared with it.
    """
    with matplotlib.rc_context(STYLE):
        figure = draw_crossing(
            crossing, element_truth=element_truth, road_truth=road_truth, baseline=baseline
        )
    write_figure(path, figure)


def true_road_as_measured(road: RoadResult, truth: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Return chainage and height (m,) of a true road with level, slope and bend of the estimate.

    Twice integrated accelerations determine none of the three; the rest can be compared.
    """
    x_m = np.array(road.x_m)
    height_m = np.interp(x_m, *truth)
    apart = height_m - np.array(road.mean_m)
    return x_m, height_m - np.polynomial.Polynomial.fit(x_m, apart, 2)(x_m)


def draw_crossing(
    crossing: CrossingView,
    *,
    element_truth: list[float] | None,
    road_truth: tuple[Floats, Floats] | None,
    baseline: Estimate | None = None,
) -> Figure:
    """Return the figure, to be drawn in `STYLE`."""
    has_road = crossing.road is not None or road_truth is not None
    # The truth needs the panel in which a rejection is explained otherwise.
    explanation = _explanation(crossing) if element_truth is not None else []
    more_in = _more_heading_in(crossing, baseline, explanation)
    height_in = more_in + (HEIGHT_IN if has_road else _HEIGHT_WITHOUT_ROAD_IN)
    heading_in = more_in + _HEADING_IN
    figure = Figure(figsize=(WIDTH_IN, height_in), facecolor="white")
    FigureCanvasAgg(figure)
    ratios = (3.0, 2.0, 1.15) if has_road else (1.0,)
    grid = figure.add_gridspec(
        len(ratios),
        1,
        height_ratios=ratios,
        hspace=0.27,
        left=LEFT,
        right=RIGHT,
        top=1.0 - heading_in / height_in,
        bottom=0.51 / height_in,
    )
    rigidity = figure.add_subplot(grid[0])
    panels = [rigidity]
    panels += [figure.add_subplot(grid[n], sharex=rigidity) for n in range(1, len(ratios))]
    _draw_heading(figure, crossing, baseline, explanation)
    _draw_rigidity(rigidity, crossing, element_truth, baseline)
    if has_road:
        _draw_profiles(panels[1], crossing, road_truth)
        _draw_differences(panels[2], crossing, road_truth)
    for axes in panels:
        simplify_axes(axes)
        mark_bridge(axes, (0.0, *crossing.interior_supports_m, crossing.span_m))
    for axes in panels[:-1]:
        axes.tick_params(labelbottom=False)
    rigidity.set_xlim(*_chainage_limits(crossing))
    panels[-1].set_xlabel("chainage from the start of the bridge (m)")
    return figure


def _more_heading_in(
    crossing: CrossingView, baseline: Estimate | None, explanation: list[str]
) -> float:
    """Return the height of all but a line of finding: banner, explanation and legend."""
    found = comparison_of(crossing, baseline)
    legend_in = _LEGEND_IN if _is_change(found) else 0.0  # the title is above the legend
    if crossing.verdict == "good":
        lines = finding_lines(describe_crossing(crossing, found))
        return legend_in + REASON_LINE_IN * max(0, len(lines) - 1)
    lines = reason_lines(crossing.verdict, crossing.reason_texts)
    banner_in = _BANNER_IN + REASON_LINE_IN * (len(lines) - 1)
    if not explanation:
        return legend_in + banner_in
    gap_in = _EXPLANATION_GAP_IN
    return legend_in + banner_in + gap_in + _EXPLANATION_LINE_IN * len(explanation)


def _draw_heading(
    figure: Figure, crossing: CrossingView, baseline: Estimate | None, explanation: list[str]
) -> None:
    inch = 1.0 / figure.get_figheight()
    title = "Stiffness and road profile from one crossing alone (not fused)"
    figure.text(LEFT, 1.0 - 0.18 * inch, title, fontsize=14, fontweight="bold", va="top")
    summary = textwrap.shorten(summary_line(crossing), width=105, placeholder=" …")
    small: dict[str, Any] = {"fontsize": 9.5, "color": MUTED, "va": "top"}
    figure.text(LEFT, 1.0 - 0.455 * inch, summary, parse_math=False, **small)
    reasons = crossing.reason_texts
    sentences = describe_crossing(crossing, comparison_of(crossing, baseline))
    draw_verdict(figure, crossing.verdict, reasons, 1.0 - _VERDICT_IN * inch, sentences)
    if explanation:
        lines = reason_lines(crossing.verdict, reasons)
        top_in = _VERDICT_IN + banner_height_in(lines) + _EXPLANATION_GAP_IN
        text = "\n".join(explanation)
        words: dict[str, Any] = {"fontsize": 9.5, "color": INK, "va": "top", "parse_math": False}
        figure.text(LEFT, 1.0 - top_in * inch, text, **words)


def _draw_rigidity(
    axes: Axes, crossing: CrossingView, truth: list[float] | None, baseline: Estimate | None
) -> None:
    edges = crossing.element_edges_m
    nominal = crossing.nominal_nm2 / 1e9
    centres = (edges[:-1] + edges[1:]) / 2.0
    found = comparison_of(crossing, baseline)
    is_change = _is_change(found)
    axes.set_title(ENGLISH.text("figure.rigidity"))
    if is_change:
        numbers = ENGLISH.text("figure.numbers_change")
        axes.set_title(f"{axes.get_title('left')} {numbers}", pad=ABOVE_LEGEND_PT)
    axes.set_ylabel("EI (GN·m²)")
    axes.stairs(nominal, edges, baseline=None, label="nominal", **NOMINAL_LINE)
    top = 1.1 * float(nominal.max())
    if truth is not None:
        true_values = np.asarray(truth) * nominal
        # To the side of the interval's line, which may be shorter than the marker.
        beside = centres - 0.22 * np.diff(edges)
        axes.plot(beside, true_values, label="truth", zorder=9, **TRUTH_MARKER)
        top = max(top, 1.1 * float(true_values.max()))
    if crossing.rigidity_nm2 is not None:
        highest = _draw_estimate(axes, crossing, found, baseline if is_change else None)
        top = end_with_names(axes, max(top, highest))
    elif truth is None:
        write_centred(axes, "\n".join(_explanation(crossing)))
    axes.set_ylim(0.0, top)
    legend_beside_title(axes, arrow_names(axes))
    if not is_change:
        add_ratio_axis(axes, nominal)


def _is_change(found: Comparison | None) -> bool:
    return found is not None and found.reference == "baseline"


def _draw_estimate(
    axes: Axes, crossing: CrossingView, found: Comparison | None, baseline: Estimate | None
) -> float:
    """Draw bars, intervals and labels in GN·m²; return the end of the vertical axis."""
    assert crossing.rigidity_nm2 is not None  # noqa: S101 - its caller checked
    edges, estimate = crossing.element_edges_m, crossing.rigidity_nm2 / 1e9
    weak = () if found is None or crossing.is_doubtful else found.weak
    low, high, cut = estimate, estimate, np.inf
    before = None if baseline is None else columns_gnm2(baseline)
    if crossing.interval_nm2 is not None:
        low, high = crossing.interval_nm2.T / 1e9
        drawn = [(estimate, low, high)] + ([] if before is None else [before])
        cut = cut_height(crossing.nominal_nm2.max() / 1e9, *drawn)
    places, highest = bar_places(edges), 0.0
    if before is not None:
        draw_baseline(axes, bar_places(edges, *BEFORE), before, cut)
        places, highest = bar_places(edges, *AFTER), min(cut, float(before[2].max()))
    numbers = {one.number for one in weak}
    doubtful, open_ones = crossing.is_doubtful, crossing.unresolved
    draw_bars(axes, places, estimate, numbers, doubtful=doubtful, unresolved=open_ones)
    if crossing.interval_nm2 is not None:
        colour = MUTED if doubtful else BAR_EDGE
        label = "95 % interval" if crossing.interval_has_meaning else "interval (not valid)"
        draw_intervals(axes, places, (low, high), colour=colour, label=label, cut=cut)
    lowest, upper = np.minimum(estimate, low), np.minimum(cut, np.maximum(estimate, high))
    if before is None or found is None:
        texts = [f"{ratio:.3f}" for ratio in estimate / (crossing.nominal_nm2 / 1e9)]
        losses = {one.number: f"{100.0 * (1.0 - one.ratio):.0f} % less" for one in weak}
    else:  # the numbers themselves are the changes
        texts, losses = change_texts(found), {}
    highest = max(highest, float(upper.max()))
    anchors = Anchors(places, lowest, upper)
    return label_elements(axes, edges, anchors, texts, losses, highest)


def _draw_profiles(axes: Axes, crossing: CrossingView, truth: tuple[Floats, Floats] | None) -> None:
    axes.set_title("Road profile")
    if crossing.road is not None or truth is not None:
        axes.set_ylabel("height (mm)")
    if truth is not None:
        axes.plot(truth[0], truth[1] * 1e3, color="#b9c0c7", linewidth=5.0, label="truth")
    road = crossing.road
    if road is None and truth is None:
        _leave_empty(axes)
    elif road is None:
        axes.set_title("Road profile (none was estimated)")
    else:
        axes.plot(
            road.x_m,
            road.front_m * 1e3,
            color=VEHICLE_COLOURS["front"],
            linewidth=1.7,
            label=_profile_of(crossing, "front"),
        )
        axes.plot(
            road.x_m,
            road.rear_m * 1e3,
            color=VEHICLE_COLOURS["rear"],
            linewidth=1.7,
            linestyle=(0, (3.2, 2.2)),
            label=_profile_of(crossing, "rear"),
        )
    legend_beside_title(axes)


def _profile_of(crossing: CrossingView, which: str) -> str:
    article = "the " if crossing.first_axle == 1 else ""
    return f"profile of {article}{crossing.axle_names[which]}"


def _draw_differences(
    axes: Axes, crossing: CrossingView, truth: tuple[Floats, Floats] | None
) -> None:
    axes.set_title("Differences")
    road = crossing.road
    if road is None:
        _leave_empty(axes)
        return
    mean = (road.front_m + road.rear_m) / 2.0
    between = road.front_m - road.rear_m
    error = None if truth is None else _without_line(road.x_m, mean, truth)
    largest = float(np.nanmax(np.abs(between)))
    if error is not None and not np.isnan(error).all():
        largest = max(largest, float(np.nanmax(np.abs(error))))
    unit, factor = _unit_of_length(largest)
    axes.set_ylabel(unit)
    axes.axhline(0.0, color=MUTED, linewidth=0.7)
    if error is not None:
        axes.plot(road.x_m, error * factor, color="#8a939c", linewidth=1.6, label=_ERROR)
    if road.x_m.size > TREND_DEGREE + 1:
        trend = np.polynomial.Polynomial.fit(road.x_m, between, TREND_DEGREE)(road.x_m)
        axes.plot(road.x_m, trend * factor, color=INK, linewidth=0.9, linestyle=":", label=_TREND)
    axes.plot(
        road.x_m,
        between * factor,
        color=INK,
        linewidth=1.1,
        label=crossing.difference_name,
    )
    legend_beside_title(axes)


def _without_line(x_m: Floats, mean_m: Floats, truth: tuple[Floats, Floats]) -> Floats:
    """Return the error of a mean profile (n,) without its offset and tilt; NaN beyond the truth.

    Twice integrated accelerations determine neither of the two.
    """
    error = mean_m - np.interp(x_m, *truth, left=np.nan, right=np.nan)
    known = np.isfinite(error)
    if known.sum() > 2:
        error[known] = detrended(x_m[known], error[known])
    return error


def _unit_of_length(largest_m: float) -> tuple[str, float]:
    """Return millimetres, micrometres or nanometres, whichever gives readable tick labels."""
    if largest_m >= 1e-4:
        return "mm", 1e3
    return ("µm", 1e6) if largest_m >= 1e-7 else ("nm", 1e9)


def _explanation(crossing: CrossingView) -> list[str]:
    """Return all reasons of a rejection, which the banner may shorten, and what to do next."""
    if crossing.rigidity_nm2 is not None:
        return []
    advice = dict.fromkeys(ENGLISH.remedy(code, crossing.method) for code in crossing.reasons)
    why, then = (
        [line for text in texts for line in textwrap.wrap(f"• {text}", 95, subsequent_indent="  ")]
        for texts in (crossing.reason_texts, advice)
    )
    lines = ["No estimate: the crossing was rejected.", *why]
    return [*lines, "What to do next:", *then] if then else lines


def _leave_empty(axes: Axes) -> None:
    write_centred(axes, "No road profile was estimated.")
    axes.set_yticks([])


def _chainage_limits(crossing: CrossingView) -> tuple[float, float]:
    """Return the limits of bridge and road, at most half a span beyond each end."""
    margin = 0.03 * crossing.span_m
    left, right = 0.0, crossing.span_m
    if crossing.road is not None:
        left = max(min(left, float(crossing.road.x_m.min())), -crossing.span_m / 2.0)
        right = min(max(right, float(crossing.road.x_m.max())), 1.5 * crossing.span_m)
    return left - margin, right + margin
