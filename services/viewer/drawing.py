"""What pictures have in common: style, colours, words, and how a doubtful result looks.

Colours are Okabe and Ito's, and nothing is told by colour alone: what is doubtful is hatched, what
is weak is darker and marked, lines differ by their dashes. Drawn with Matplotlib's objects and the
Agg canvas, never with pyplot: no global state, no window.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle
from matplotlib.ticker import MaxNLocator

from services.common.files import write_atomically
from services.identification.comparison import Element
from services.viewer.crossing_view import (
    TRUTH_COLOUR,
    VEHICLE_COLOURS,
    VERDICT_COLOURS,
    FloatArray,
)

WIDTH_IN, DPI = 9.0, 200  # 1800 pixels: sharp at the 900 of a repository page

LEFT, RIGHT = 0.085, 0.915  # of the figure's width, between which the panels stand

INK = "#1b1f24"
MUTED = "#5b6570"
GRID = "#e3e7eb"
BAR = "#cfe3f1"
BAR_EDGE = VEHICLE_COLOURS["front"]
WEAK_BAR, WEAK_EDGE = "#E69F00", "#8a4b00"
DOUBTFUL_BAR, DOUBTFUL_EDGE = "#f1f1f1", "#8a8f94"
BANNERS = {"suspect": "#fdf0d5", "rejected": "#f6e1de"}
_NOTES = {
    "suspect": "doubtful: to be looked at, not to be relied upon",
    "rejected": "no number of this crossing means anything",
}
_SVG_METADATA = ("Date", "Creator", "Format", "Type")
_CHARACTERS = 118
"""So long a line of reasons may be between the figure's edges."""

NOMINAL_LINE: dict[str, Any] = {"color": MUTED, "linewidth": 1.0, "linestyle": (0, (4, 3))}
BASELINE_LINE: dict[str, Any] = {"color": VERDICT_COLOURS["good"], "linewidth": 1.6, "zorder": 3}
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
    "hatch.linewidth": 0.7,
    "svg.hashsalt": "driveby",
}


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure drawn in `STYLE` as PNG or SVG; an existing file is replaced."""
    write_atomically(path, figure_bytes(figure, path.suffix.removeprefix(".")))


def figure_bytes(figure: Figure, form: str, *, dpi: int = DPI) -> bytes:
    """A figure as `png` or `svg`; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    metadata = dict.fromkeys(("Software",) if form == "png" else _SVG_METADATA)
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format=form, dpi=dpi, metadata=metadata)
    return buffer.getvalue()


def draw_verdict(
    figure: Figure, verdict: str, reasons: tuple[str, ...], top: float, told: Sequence[str] = ()
) -> None:
    """The verdict below a heading: a word if it is good, a banner with the reasons if not.

    Of what was `told` the first sentence stands beside a good one.
    """
    words: dict[str, Any] = {"fontsize": 9.5, "va": "top"}
    if verdict == "good":
        colour = VERDICT_COLOURS["good"]
        figure.text(LEFT, top, "verdict: good", color=colour, fontweight="bold", **words)
        if told:
            short = textwrap.shorten(told[0], width=100, placeholder=" …")
            figure.text(LEFT + 0.12, top, short, color=INK, parse_math=False, **words)
        return
    height = 0.40 / figure.get_figheight()
    figure.add_artist(
        FancyBboxPatch(
            (LEFT + 0.004, top - height + 0.004),
            RIGHT - LEFT - 0.008,
            height - 0.008,
            boxstyle="round,pad=0.004,rounding_size=0.006",
            facecolor=BANNERS[verdict],
            edgecolor=VERDICT_COLOURS[verdict],
            linewidth=1.4,
            mutation_aspect=WIDTH_IN / figure.get_figheight(),
        )
    )
    top -= 0.055 / figure.get_figheight()
    figure.text(LEFT + 0.01, top, f"verdict: {verdict}", fontweight="bold", color=INK, **words)
    figure.text(LEFT + 0.16, top, _NOTES[verdict], color=INK, **words)
    text = textwrap.shorten(" ".join(reasons), width=_CHARACTERS, placeholder=" …")
    top -= 0.165 / figure.get_figheight()
    figure.text(LEFT + 0.01, top, text, fontsize=8.5, color=INK, va="top", parse_math=False)


def draw_bars(
    axes: Axes,
    edges_m: FloatArray,
    heights: FloatArray,
    weak: set[int],
    *,
    doubtful: bool,
    unresolved: Set[int] = frozenset(),
) -> None:
    """A bar for each element: the weak ones stand out, doubtful ones are grey and hatched.

    Those that are `unresolved` are empty, with a dashed edge.
    """
    centres, lengths = (edges_m[:-1] + edges_m[1:]) / 2.0, np.diff(edges_m)
    bars = axes.bar(
        centres,
        heights,
        width=0.86 * lengths,
        color=DOUBTFUL_BAR if doubtful else BAR,
        edgecolor=DOUBTFUL_EDGE if doubtful else BAR_EDGE,
        hatch="////" if doubtful else None,
        linewidth=1.1,
        zorder=2,
        label="estimate, doubtful" if doubtful else "estimate",
    )
    if doubtful:
        return
    for number, bar in enumerate(bars, start=1):
        if number in unresolved:
            bar.set(facecolor="white", linestyle="--")
        if number in weak:
            bar.set(facecolor=WEAK_BAR, edgecolor=WEAK_EDGE, linewidth=1.8)
    if unresolved:  # a legend would show the first bar, whatever that is
        bars.set_label("")
        for name, fill, line in (("estimate", BAR, "-"), ("not resolved", "white", "--")):
            axes.add_patch(
                Rectangle(
                    (0.0, 0.0),
                    0.0,
                    0.0,
                    facecolor=fill,
                    edgecolor=BAR_EDGE,
                    linestyle=line,
                    label=name,
                )
            )


def draw_intervals(
    axes: Axes, edges_m: FloatArray, low: FloatArray, high: FloatArray, *, colour: str, label: str
) -> None:
    """The interval of each element."""
    centres, lengths = (edges_m[:-1] + edges_m[1:]) / 2.0, np.diff(edges_m)
    axes.vlines(centres, low, high, color=colour, linewidth=2.2, zorder=5, label=label)
    for end in (low, high):
        left, right = centres - 0.09 * lengths, centres + 0.09 * lengths
        axes.hlines(end, left, right, color=colour, zorder=5)


def label_loss(
    axes: Axes, element: Element, top: float, *, small: bool, doubt: str = "", up: float = 8.0
) -> None:
    """What an element has lost, over its interval that ends at `top`."""
    axes.annotate(
        f"{100.0 * (1.0 - element.ratio):.0f} % less{doubt}",
        ((element.from_m + element.to_m) / 2.0, top),
        xytext=(0, up),
        textcoords="offset points",
        ha="center",
        fontsize=8 if small else 9.5,
        fontweight="bold",
        zorder=8,
    )


def label_bars(
    axes: Axes, edges_m: FloatArray, heights: FloatArray, bottoms: FloatArray, texts: list[str]
) -> None:
    """A number in each bar below its interval, or above where the bar is too low; its name."""
    centres = (edges_m[:-1] + edges_m[1:]) / 2.0
    small = 8.5 if len(texts) > 11 else 10.5
    highest = max(float(heights.max()), float(bottoms.max()))
    for number, (centre, bottom, text) in enumerate(zip(centres, bottoms, texts, strict=True)):
        above = bottom < 0.25 * highest  # no room for the label inside a bar as low as this
        axes.annotate(
            text,
            (centre, max(heights[number], bottom) if above else bottom),
            xytext=(0, 12 if above else -10),
            textcoords="offset points",
            ha="center",
            va="bottom" if above else "top",
            fontsize=small,
            fontweight="bold",
            zorder=7,
            bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.8, "linewidth": 0},
        )
        axes.annotate(
            f"$EI_{{{number + 1}}}$",
            (centre, 0.0),
            xytext=(0, 5),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=small - 0.5,
            color=MUTED,
            zorder=7,
        )


def add_ratio_axis(axes: Axes, nominal: FloatArray) -> None:
    """Mark ratios at the right, if all elements have one nominal value, on a twin's same limits."""
    if np.ptp(nominal) > 1e-9 * nominal.max():
        return
    ratio = axes.twinx()
    low, high = axes.get_ylim()
    ratio.set_ylim(low / nominal[0], high / nominal[0])
    ratio.set_ylabel("ratio to nominal")
    ratio.spines[:].set_visible(False)
    ratio.yaxis.set_major_locator(MaxNLocator(nbins=8, steps=[1, 2, 5, 10]))
    ratio.tick_params(length=0)


def mark_bridge(axes: Axes, supports_m: tuple[float, ...]) -> None:
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


def quieten(axes: Axes) -> None:
    """Few ticks, a grid across, no frame."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(axis="y", color=GRID, linewidth=0.8, zorder=0.5)
    axes.set_axisbelow(True)
    if len(axes.get_yticks()):
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))
    axes.tick_params(length=3)


def legend_beside_title(axes: Axes) -> None:
    """The legend on the line of the panel's title."""
    handles, _ = axes.get_legend_handles_labels()
    is_long = len(handles) > 4
    if handles:
        axes.legend(
            loc="lower right",
            bbox_to_anchor=(1.008, 0.985),
            ncols=len(handles),
            columnspacing=1.1 if is_long else 1.6,
            handlelength=1.8 if is_long else 2.4,
            handletextpad=0.5 if is_long else 0.8,
            fontsize=8.5 if is_long else 9,
            borderpad=0.0,
        )


def write_centred(axes: Axes, text: str) -> None:
    """Words where a panel has nothing to show."""
    axes.text(
        *(0.5, 0.5, text),
        transform=axes.transAxes,
        ha="center",
        va="center",
        multialignment="left",
        parse_math=False,
        color=INK,
        zorder=9,
        bbox={"facecolor": "#f4f7f9", "linewidth": 0},  # hides the lines behind
    )
