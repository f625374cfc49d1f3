"""The picture of a plan: how surely a loss is seen with more and more crossings, by element."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pre_core.survey.detection import SURE
from services.planning.survey import Survey
from services.viewer.drawing import LEFT, MUTED, RIGHT, STYLE, WIDTH_IN, quieten, write_figure

Floats = NDArray[np.float64]

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1b1f24")
"""Okabe and Ito's: told apart by all eyes."""
_DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 1.5, 1, 1.5)))
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def survey_figure(path: Path, found: Survey) -> None:
    """Draw a plan into a PNG or SVG file; an existing file is replaced."""
    with matplotlib.rc_context(STYLE):
        figure = draw_survey(found)
    write_figure(path, figure)


def draw_survey(found: Survey) -> Figure:
    """The figure itself, to be drawn in `STYLE`: probabilities above, standard deviations below."""
    figure = Figure(figsize=(WIDTH_IN, 6.6), facecolor="white")
    FigureCanvasAgg(figure)
    width = RIGHT - LEFT
    seen = figure.add_axes((LEFT, 0.555, width, 0.385))
    wide = figure.add_axes((LEFT, 0.085, width, 0.385))
    counts = np.array([one.crossings for one in found.growth])
    _draw(
        seen,
        counts,
        np.array([one.seen for one in found.growth]),
        f"Probability that a loss of {found.asked.loss:.0%} is seen, by element",
    )
    std = 100.0 * np.array([one.std for one in found.growth])
    seen.axhline(SURE, color=MUTED, linewidth=1.0, linestyle=(0, (4, 3)), zorder=1)
    seen.set_ylim(0.0, 1.03)
    seen.set_ylabel("probability")
    _name_lines(seen, std.shape[1])
    _draw(wide, counts, std, "Standard deviation of EI, by element")
    wide.set_ylim(0.0, 1.1 * float(std.max()))
    wide.set_ylabel("% of EI")
    wide.set_xlabel("crossings")
    return figure


def _draw(axes: Axes, counts: Floats, values: Floats, title: str) -> None:
    """A line for each element (n, e)."""
    axes.set_title(title)
    elements = values.shape[1]
    for e in range(elements):
        axes.plot(
            counts,
            values[:, e],
            color=_COLOURS[e % len(_COLOURS)],
            linestyle=_DASHES[(e // len(_COLOURS)) % len(_DASHES)],
            marker=_MARKERS[e % len(_MARKERS)],
            markersize=4.5,
            linewidth=1.6,
            label=f"$EI_{{{e + 1}}}$",
            zorder=3,
        )
    axes.set_xscale("log")
    axes.set_xlim(0.93 * counts[0], 1.04 * counts[-1])
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    quieten(axes)


def _name_lines(axes: Axes, elements: int) -> None:
    """The lines' names beside the panel, in the elements' order."""
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        handlelength=1.8,
        handletextpad=0.5,
        labelspacing=0.5 if elements <= 11 else 0.15,
        fontsize=9 if elements <= 11 else 6.5,
    )
