"""The figure of a plan: probability of detecting a loss against crossings, by element."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pre_core.constants import DETECTION_PROBABILITY
from services.common.arrays import Floats
from services.planning.advice import tyres_of
from services.planning.survey import SurveyForecast
from services.viewer.drawing import (
    LEFT,
    MUTED,
    NOMINAL_LINE,
    RIGHT,
    STYLE,
    WIDTH_IN,
    simplify_axes,
    write_figure,
)

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#1b1f24")
"""Okabe and Ito's colours, distinguishable by all eyes."""
_DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 1.5, 1, 1.5)))
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def survey_figure(path: Path, found: SurveyForecast) -> None:
    """Draw a plan into a PNG or SVG file; an existing file is replaced."""
    with matplotlib.rc_context(STYLE):
        figure = draw_survey(found)
    write_figure(path, figure)


def draw_survey(found: SurveyForecast) -> Figure:
    """Return the figure, to be drawn in `STYLE`: probabilities above, deviations below."""
    figure = Figure(figsize=(WIDTH_IN, 7.3), facecolor="white")
    FigureCanvasAgg(figure)
    site = found.planned.plan.site
    title = f"Survey of {site.bridges[0].id} by {site.vehicles[0].id}"
    large: Any = {"fontsize": 14, "fontweight": "bold", "va": "top"}
    figure.text(LEFT, 0.975, title, parse_math=False, **large)
    figure.text(LEFT, 0.933, _assumptions(found), fontsize=9, color=MUTED, va="top")
    width = RIGHT - LEFT
    seen = figure.add_axes((LEFT, 0.51, width, 0.345))
    wide = figure.add_axes((LEFT, 0.075, width, 0.345))
    counts = np.array([one.crossings for one in found.growth])
    _draw(
        seen,
        counts,
        np.array([one.seen for one in found.growth]),
        f"Probability of detecting a loss of {100.0 * found.question.loss:.0f} %, by element",
    )
    std = 100.0 * np.array([one.std for one in found.growth])
    seen.set_ylim(0.0, 1.03)
    seen.set_ylabel("probability")
    seen.axhline(
        DETECTION_PROBABILITY,
        label=f"{100.0 * DETECTION_PROBABILITY:.0f} %",
        zorder=1,
        **NOMINAL_LINE,
    )
    _name_lines(seen, std.shape[1])
    _draw(wide, counts, std, "Standard deviation of EI, by element")
    wide.set_ylim(0.0, 1.1 * float(std.max()))
    wide.set_ylabel("% of EI")
    wide.set_xlabel("crossings")
    return figure


def _assumptions(found: SurveyForecast) -> str:
    """Return the bridge, truck and road that the forecast assumes, in one line."""
    site = found.planned.plan.site
    bridge, noise = site.bridges[0], max(site.sensor.noise_density_ug_per_rthz)
    return " · ".join(
        (
            f"{bridge.span_m:g} m in {bridge.elements} elements",
            f"{site.vehicles[0].total_mass_kg / 1e3:.1f} t",
            tyres_of(found.planned),
            f"{found.question.speed_m_per_s:g} m/s",
            f"road class {found.road.road_class}",
            f"sensors of {noise:g} µg/√Hz",
        )
    )


def _draw(axes: Axes, counts: Floats, values: Floats, title: str) -> None:
    """Draw a line for each element (n, e)."""
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
    simplify_axes(axes)


def _name_lines(axes: Axes, elements: int) -> None:
    """Name the lines next to the panel, in the elements' order."""
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        handlelength=1.8,
        handletextpad=0.5,
        labelspacing=0.5 if elements <= 11 else 0.15,
        fontsize=9 if elements <= 11 else 6.5,
    )
