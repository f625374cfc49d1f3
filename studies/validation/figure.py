"""The figure of a calibration: widths of intervals on many simulated crossings.

Only histograms are computed here: the results are those of `validation.calibration`.
"""

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MultipleLocator, PercentFormatter

from pre_core.arrays import FloatArray
from services.common.files import write_atomically
from services.viewer.crossing_view import VEHICLE_COLOURS
from services.viewer.drawing import DPI, GRID, INK, MUTED, STYLE
from studies.validation.calibration_statistics import Scores

WIDTH_IN, HEIGHT_IN = 9.0, 7.0
_POINT, _OTHER = VEHICLE_COLOURS["front"], VEHICLE_COLOURS["rear"]
_BAND = "#eef1f4"
_WIDEST_Z = 4.0
_BINS_Z = 32
_WIDTH_TICKS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0]


def calibration_figure(
    path: Path, scores: Scores, ranks: dict[str, FloatArray], source: str
) -> None:
    """Draw z-scores, coverage, ranks and widths of many crossings into a PNG file.

    `ranks` are by group of parameters, all crossings and parameters of the group in one array;
    `source` describes the runs in a line.
    """
    with matplotlib.rc_context(STYLE):
        figure = draw_calibration(scores, ranks, source)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomically(path, buffer.getvalue())


def draw_calibration(scores: Scores, ranks: dict[str, FloatArray], source: str) -> Figure:
    """Return the figure."""
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        2, 2, left=0.08, right=0.985, top=0.845, bottom=0.075, hspace=0.42, wspace=0.22
    )
    _draw_z(figure.add_subplot(grid[0, 0]), scores)
    _draw_coverage(figure.add_subplot(grid[0, 1]), scores)
    _draw_ranks(figure.add_subplot(grid[1, 0]), ranks)
    _draw_widths(figure.add_subplot(grid[1, 1]), scores)
    figure.text(0.02, 0.977, "Are the intervals true?", fontsize=14, fontweight="bold", va="top")
    figure.text(0.02, 0.937, source, fontsize=9.5, color=MUTED, va="top")
    return figure


def _draw_z(axes: Axes, scores: Scores) -> None:
    z = scores.z_log.ravel()
    edges = np.linspace(-_WIDEST_Z, _WIDEST_Z, _BINS_Z + 1)
    inside = np.abs(z) <= _WIDEST_Z
    counts, _ = np.histogram(z[inside], edges)
    axes.stairs(counts, edges, fill=True, color=_POINT, alpha=0.75)
    x = np.linspace(-_WIDEST_Z, _WIDEST_Z, 200)
    expected = z.size * (edges[1] - edges[0]) * np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi)
    axes.plot(x, expected, color=INK, linewidth=1.5)
    axes.set_title("Error of ln EI over its standard deviation")
    axes.set_ylabel("elements of crossings")
    axes.text(
        0.98,
        0.93,
        "line: what true\nintervals give",
        transform=axes.transAxes,
        ha="right",
        va="top",
        color=MUTED,
        fontsize=8.5,
    )
    beyond = int(np.sum(~inside))
    if beyond:
        text = f"{beyond} beyond ±{_WIDEST_Z:g}"
        axes.text(0.02, 0.93, text, transform=axes.transAxes, va="top", color=_OTHER, fontsize=8.5)
    _simplify_axes(axes)


def _draw_coverage(axes: Axes, scores: Scores) -> None:
    covered = scores.is_covered.mean(axis=0)
    n = scores.is_covered.shape[0]
    element = np.arange(1, covered.size + 1)
    axes.axhspan(0.90, 0.99, color=_BAND, zorder=0)
    axes.axhline(0.95, color=INK, linewidth=1.2)
    error = np.sqrt(covered * (1.0 - covered) / n)
    axes.errorbar(element, covered, error, color=_POINT, marker="o", linestyle="none", markersize=5)
    axes.set_ylim(min(0.86, float(covered.min()) - 0.06), 1.005)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.yaxis.set_major_locator(MultipleLocator(0.05))
    axes.set_xticks(element)
    axes.set_title("Truths within the 95 % interval, by element")
    axes.set_xlabel("element")
    axes.text(
        0.02,
        0.03,
        "grey: target; bars: one standard error",
        transform=axes.transAxes,
        color=MUTED,
        fontsize=8.5,
    )
    _simplify_axes(axes)


def _draw_ranks(axes: Axes, ranks: dict[str, FloatArray]) -> None:
    """Draw the empirical distribution of ranks less the uniform one, with its 95 % band."""
    colours = [_POINT, _OTHER, "#4b8f5c", "#8a5fa8", "#9a7b2f", MUTED]
    x = np.linspace(0.0, 1.0, 201)
    fewest = min((values.shape[0] for values in ranks.values()), default=1)
    # Kolmogorov: 95 % of the empirical distributions of n independent ranks stay within.
    largest = band = 1.358 / np.sqrt(max(fewest, 1))
    for colour, (name, values) in zip(colours, ranks.items(), strict=False):
        below = np.searchsorted(np.sort(values.ravel()), x, side="right") / values.size
        axes.plot(x, below - x, color=colour, linewidth=1.4, label=name)
        largest = max(largest, float(np.abs(below - x).max()))
    axes.axhspan(-band, band, color=_BAND, zorder=0)
    axes.axhline(0.0, color=INK, linewidth=1.2)
    axes.set_ylim(-1.6 * largest, 1.6 * largest)
    axes.set_xlim(0.0, 1.0)
    axes.set_title("Ranks of the truth, less the uniform")
    axes.set_xlabel("share of the posterior below the truth")
    axes.legend(loc="upper right", ncols=5, columnspacing=0.9, handlelength=1.1, fontsize=8.5)
    text = "grey: 95 % of single parameters"
    axes.text(0.02, 0.05, text, transform=axes.transAxes, color=MUTED, fontsize=8.5)
    _simplify_axes(axes)


def _draw_widths(axes: Axes, scores: Scores) -> None:
    axes.loglog(scores.bound.ravel(), scores.std_log.ravel(), ".", color=_POINT, markersize=4)
    known = scores.bound[np.isfinite(scores.bound)]
    if known.size:
        span = np.array([0.8 * known.min(), 1.25 * known.max()])
        axes.plot(span, span, color=INK, linewidth=1.2)
        axes.plot(span, 1.25 * span, color=MUTED, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.set_xlim(*span)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(FixedLocator(_WIDTH_TICKS))
        axis.set_minor_locator(FixedLocator([]))
        axis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.set_title("Standard deviation of ln EI")
    axes.set_xlabel("Cramér-Rao bound of the same data")
    axes.text(
        0.98,
        0.05,
        "line: the bound; dashed: 1.25 times",
        transform=axes.transAxes,
        ha="right",
        color=MUTED,
        fontsize=8.5,
    )
    _simplify_axes(axes)


def _simplify_axes(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=GRID, linewidth=0.8, zorder=0.5)
    axes.set_axisbelow(True)
    axes.tick_params(length=3)
