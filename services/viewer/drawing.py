"""Common parts of the figures: style, colours, labels, and the look of doubtful results.

Colours are Okabe and Ito's, and no information is in colour alone: doubtful values are hatched,
weak elements are orange and marked, lines differ by their dashes. Figures use Matplotlib's objects
and the Agg canvas, never pyplot: no global state, no window.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch, Rectangle
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from matplotlib.transforms import BboxBase

from services.common.arrays import Floats
from services.common.files import write_atomically
from services.common.language import ENGLISH, Language
from services.common.naming import count_of
from services.viewer.crossing_view import TRUTH_COLOUR, VEHICLE_COLOURS, VERDICT_COLOURS

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
    "suspect": "doubtful: do not rely on these values",
    "rejected": "this crossing has no usable values",
}
_SVG_METADATA = ("Date", "Creator", "Format", "Type")
_CHARACTERS = 118
"""Maximum length of a line of reasons between the figure's edges."""
_MAX_REASON_LINES = 6
"""Maximum number of lines of reasons or a finding, more than three of the longest take."""
REASON_LINE_IN = 0.15
"""Height of a line of reasons or a finding."""
_BESIDE_VERDICT = 108
"""Maximum length of a line of a finding next to the word of a good verdict."""
ABOVE_LEGEND_PT = 22.0
"""Distance of the title from the panel, with the legend between them, in points."""
_LEGEND_PT = 9.0
_BESIDE_TITLE_PX = 10.0
"""Smallest distance of a legend from the title on its line."""

NOMINAL_LINE: dict[str, Any] = {"color": MUTED, "linewidth": 1.0, "linestyle": (0, (4, 3))}
BASELINE_COLOUR = VERDICT_COLOURS["good"]
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
    "legend.fontsize": _LEGEND_PT,
    "legend.frameon": False,
    "hatch.linewidth": 0.7,
    "svg.hashsalt": "driveby",
}


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure drawn in `STYLE` as PNG or SVG; an existing file is replaced."""
    write_atomically(path, figure_bytes(figure, path.suffix.removeprefix(".")))


def figure_bytes(figure: Figure, form: str, *, dpi: int = DPI) -> bytes:
    """Return a figure as `png` or `svg`; equal figures give equal bytes."""
    buffer = io.BytesIO()
    metadata = dict.fromkeys(("Software",) if form == "png" else _SVG_METADATA)
    with matplotlib.rc_context(STYLE):
        figure.savefig(buffer, format=form, dpi=dpi, metadata=metadata)
    return buffer.getvalue()


def finding_lines(sentences: Sequence[str]) -> list[str]:
    """Return the lines of a finding: whole sentences, with a note on those for which room lacks.

    A bare number of the others would read as one of weak elements.
    """
    lines: list[str] = []
    for shown in range(len(sentences), 0, -1):
        others = len(sentences) - shown
        note = [f"(and {count_of(others, 'more sentence')})"] if others else []
        lines = wrapped(" ".join([*sentences[:shown], *note]), _BESIDE_VERDICT)
        if len(lines) <= _MAX_REASON_LINES:
            break
    return lines


def wrapped(text: str, width: int, most: int | None = None) -> list[str]:
    """Return the lines of a text, at most `most`; a number stays with its per cent sign."""
    unbroken = text.replace(" %", "\u00a0%")
    lines = textwrap.wrap(unbroken, width, max_lines=most, placeholder=" …")
    return [line.replace("\u00a0", " ") for line in lines]


def draw_verdict(
    figure: Figure,
    verdict: str,
    reasons: tuple[str, ...],
    top: float,
    sentences: Sequence[str] = (),
) -> None:
    """Write the verdict below a heading: a word if it is good, a banner with reasons if not.

    The `sentences` stand next to a good one.
    """
    words: dict[str, Any] = {"fontsize": 9.5, "va": "top"}
    if verdict == "good":
        colour = VERDICT_COLOURS["good"]
        figure.text(LEFT, top, "verdict: good", color=colour, fontweight="bold", **words)
        if sentences:
            finding = "\n".join(finding_lines(sentences))
            small: dict[str, Any] = {"fontsize": 8.3, "va": "top", "parse_math": False}
            figure.text(LEFT + 0.12, top, finding, color=INK, **small)
        return
    lines = reason_lines(verdict, reasons)
    height = banner_height_in(lines) / figure.get_figheight()
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
    text, top = "\n".join(lines), top - 0.165 / figure.get_figheight()
    figure.text(LEFT + 0.01, top, text, fontsize=8.5, color=INK, va="top", parse_math=False)


def banner_height_in(lines: Sequence[str]) -> float:
    """Return the height of a banner with these lines of reasons, in inches."""
    return 0.40 + REASON_LINE_IN * (len(lines) - 1)


def reason_lines(verdict: str, reasons: Sequence[str]) -> list[str]:
    """Return the lines of a banner's reasons, at least one.

    Without an estimate there is one line: all reasons stand in place of the panel.
    """
    most = 1 if verdict == "rejected" else _MAX_REASON_LINES
    return textwrap.wrap(" ".join(reasons), _CHARACTERS, max_lines=most, placeholder=" …") or [""]


class BarPlaces(NamedTuple):
    """Places of the bars of elements along the bridge, m."""

    centres_m: Floats  # (n,)
    lengths_m: Floats  # (n,)


def bar_places(edges_m: Floats, begin: float = 0.0, end: float = 1.0) -> BarPlaces:
    """Return the places of bars that take this part of each element; `edges_m` is (n + 1,)."""
    lengths = np.diff(edges_m)
    return BarPlaces(edges_m[:-1] + 0.5 * (begin + end) * lengths, (end - begin) * lengths)


def draw_bars(
    axes: Axes,
    places: BarPlaces,
    heights: Floats,
    weak: set[int],
    *,
    doubtful: bool,
    unresolved: Set[int] = frozenset(),
    language: Language = ENGLISH,
) -> None:
    """Draw a bar for each element: weak ones stand out, doubtful ones are grey and hatched.

    Unresolved ones are empty, with a dashed edge.
    """
    bars = axes.bar(
        places.centres_m,
        heights,
        width=0.86 * places.lengths_m,
        color=DOUBTFUL_BAR if doubtful else BAR,
        edgecolor=DOUBTFUL_EDGE if doubtful else BAR_EDGE,
        hatch="////" if doubtful else None,
        linewidth=1.1,
        zorder=2,
        label=language.text("figure.doubtful" if doubtful else "figure.estimate"),
    )
    if doubtful:
        return
    for number, bar in enumerate(bars, start=1):
        if number in unresolved:
            bar.set(facecolor="white", linestyle="--")
        if number in weak:
            bar.set(facecolor=WEAK_BAR, edgecolor=WEAK_EDGE, linewidth=1.8)
    if unresolved:  # a legend would show the first bar, resolved or not
        bars.set_label("")
        for name, fill, line in (("estimate", BAR, "-"), ("unresolved", "white", "--")):
            axes.add_patch(
                Rectangle(
                    (0.0, 0.0),
                    0.0,
                    0.0,
                    facecolor=fill,
                    edgecolor=BAR_EDGE,
                    linestyle=line,
                    label=language.text(f"figure.{name}"),
                )
            )


def add_ratio_axis(axes: Axes, nominal: Floats, language: Language = ENGLISH) -> None:
    """Mark ratios at the right, if all elements share one nominal value, by a twin axis."""
    if np.ptp(nominal) > 1e-9 * nominal.max():
        return
    ratio = axes.twinx()
    low, high = axes.get_ylim()
    ratio.set_ylim(low / nominal[0], high / nominal[0])
    ratio.set_ylabel(language.text("figure.ratio"))
    ratio.spines[:].set_visible(False)
    ratio.yaxis.set_major_locator(MaxNLocator(nbins=8, steps=[1, 2, 5, 10]))
    ratio.yaxis.set_major_formatter(LocalisedNumbers(language))
    ratio.tick_params(length=0)


def mark_bridge(axes: Axes, supports_m: tuple[float, ...]) -> None:
    """Shade the bridge and draw a bearing below each of its supports."""
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


def simplify_axes(axes: Axes) -> None:
    """Reduce a panel to few ticks and a horizontal grid, without a frame."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(axis="y", color=GRID, linewidth=0.8, zorder=0.5)
    axes.set_axisbelow(True)
    if len(axes.get_yticks()):
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10]))
    axes.tick_params(length=3)


class LocalisedNumbers(ScalarFormatter):
    """Numbers with the decimals that all ticks need, and the decimal sign of a language."""

    def __init__(self, language: Language) -> None:
        super().__init__(useOffset=False, useLocale=False)
        self._has_decimal_comma = language.has_decimal_comma

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of a tick."""
        label: str = super().__call__(x, pos)
        return label.replace(".", ",") if self._has_decimal_comma else label


def simplify_numbers(axes: Axes, language: Language) -> None:
    """Write the ticks of both axes as the language does."""
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: language.number(round(value, 9), "g"))


def legend_beside_title(axes: Axes, also: Sequence[Line2D] = ()) -> None:
    """Place the legend on the line of the title, smaller where it is wider than its place.

    Its place is the width of the panel, less the title if that is not above the legend.

    The entries `also` follow those of the panel.
    """
    handles = [*axes.get_legend_handles_labels()[0], *also]
    if not handles:
        return
    is_long, size_pt = len(handles) > 4, _LEGEND_PT
    for _ in range(3):
        legend = axes.legend(
            handles=handles,
            loc="lower right",
            bbox_to_anchor=(1.008, 0.985),
            ncols=len(handles),
            columnspacing=0.8 if is_long else 1.6,
            handlelength=1.5 if is_long else 2.4,
            handletextpad=0.4 if is_long else 0.8,
            fontsize=size_pt,
            borderpad=0.0,
        )
        drawn, panel = legend.get_window_extent(), axes.get_window_extent()
        room = (panel.x1 - _left_of_legend(axes, drawn)) / drawn.width
        if room >= 1.0:
            return
        size_pt *= room


def _left_of_legend(axes: Axes, legend: BboxBase) -> float:
    """Return where the place of a legend begins, in pixels: the panel's edge or the title's end."""
    edge, written = float(axes.get_window_extent().x0), axes.get_title(loc="left")
    titles = (text for text in axes.findobj(Text) if written and text.get_text() == written)
    for box in (title.get_window_extent() for title in titles):
        if box.y0 < legend.y1:
            edge = max(edge, float(box.x1) + _BESIDE_TITLE_PX)
    return edge


def write_centred(axes: Axes, text: str) -> None:
    """Write text into a panel without data."""
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
