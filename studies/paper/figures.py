"""Figures of `driveby validate`: one scenario in the style of the paper's Figure 9, and all.

Nothing is computed here: the figures show the results of the validation.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from pre_core.arrays import FloatArray
from services.common.files import write_atomically
from services.viewer.crossing_view import VEHICLE_COLOURS
from services.viewer.drawing import DPI, GRID, INK, MUTED, STYLE, TRUTH_MARKER
from studies.paper.scenarios import Scenario

WIDTH_IN = 9.0
WALK, OURS = VEHICLE_COLOURS["front"], VEHICLE_COLOURS["rear"]
PAPER = "#8a939c"
PRIOR = "#d5dbe1"

_BIN = 0.05
_WIDEST = (-0.5, 3.0)  # ratios beyond are printed, not drawn
_TICKS = np.arange(_WIDEST[0], _WIDEST[1] + 0.1, 0.5)


def posterior_figure(path: Path, scenario: Scenario, names: Sequence[str]) -> None:
    """Draw the prior and the posterior of every parameter of one scenario into a PNG file."""
    with matplotlib.rc_context(STYLE):
        _save(draw_posterior(scenario, names), path)


def overview_figure(
    path: Path, scenarios: Sequence[Scenario], published: dict[str, Any] | None
) -> None:
    """Draw the rigidities of all scenarios into a PNG file; `published` are the paper's tables."""
    with matplotlib.rc_context(STYLE):
        _save(draw_overview(scenarios, published), path)


def draw_posterior(scenario: Scenario, names: Sequence[str]) -> Figure:
    """Return the figure: histograms as probability densities over value / undamaged value."""
    vehicle = [name for name in names if not _of_bridge(name)]
    bridge = [name for name in names if _of_bridge(name)]
    rows = (max(len(vehicle), len(bridge)) + 1) // 2
    height = 1.42 * rows + 1.55
    figure = _empty(height)
    prior = dict(zip(names, scenario.prior.T, strict=True))
    posterior = dict(zip(names, scenario.random_walk.samples.T, strict=True))
    edges = _edges(scenario.random_walk.samples, scenario.prior)
    top, bottom = 1.0 - 1.42 / height, 0.27 / height
    halves = (
        figure.add_gridspec(
            rows, 2, left=left, right=left + 0.43, top=top, bottom=bottom, hspace=0.45, wspace=0.16
        )
        for left in (0.055, 0.555)
    )
    for half, group in zip(halves, (vehicle, bridge), strict=True):
        for place, name in enumerate(group):
            axes = figure.add_subplot(half[place // 2, place % 2])
            _draw_parameter(axes, prior[name], posterior[name], edges)
            _draw_ours(axes, scenario.least_squares.mean[name], edges)
            axes.plot(
                scenario.truth[name],
                0.93,
                transform=axes.get_xaxis_transform(),
                zorder=5,
                **(TRUTH_MARKER | {"markersize": 5.5}),
            )
            axes.set_title(_symbol(name), fontsize=10.5, loc="right", pad=-12)
            if place // 2 < (len(group) - 1) // 2:
                axes.tick_params(labelbottom=False)
            axes.set_xlim(edges[0], edges[-1])
    _head(
        figure,
        height,
        f"Scenario {scenario.number}: {describe(scenario)}",
        "Probability density of the random walk's particles over value / undamaged value",
        [
            Patch(facecolor=PRIOR, label="prior"),
            Patch(facecolor=WALK, alpha=0.75, label="after the random walk"),
            Line2D([], [], color=OURS, linewidth=1.5, label="least squares"),
            Line2D([], [], label="truth", **(TRUTH_MARKER | {"markersize": 5.5})),
        ],
    )
    for title, left in (("Vehicle", 0.055), ("Bridge", 0.555)):
        figure.text(left, 1.0 - 1.3 / height, title, fontsize=10.5, fontweight="bold")
    return figure


def _draw_parameter(
    axes: Axes, prior: FloatArray, posterior: FloatArray, edges: FloatArray
) -> None:
    highest = 0.0
    for values, color, alpha, zorder in ((prior, PRIOR, 1.0, 1), (posterior, WALK, 0.75, 2)):
        counts, _ = np.histogram(values, edges)
        density = counts / (values.size * np.diff(edges))
        axes.stairs(density, edges, fill=True, color=color, alpha=alpha, zorder=zorder)
        highest = max(highest, float(density.max()))
    if beyond := int(np.sum((posterior < edges[0]) | (posterior > edges[-1]))):
        axes.text(
            0.98,
            0.6,
            f"{beyond} beyond",
            transform=axes.transAxes,
            ha="right",
            color=MUTED,
            fontsize=8,
        )
    axes.set_ylim(0.0, 1.25 * highest)  # the truth stands above the histograms
    _simplify_axes(axes, grid="x")
    # No label at the very ends, where it would touch that of the next panel.
    inner = edges[-1] - edges[0]
    axes.set_xticks([x for x in _TICKS if edges[0] + 0.04 * inner < x < edges[-1] - 0.04 * inner])
    axes.yaxis.set_major_locator(MaxNLocator(nbins=3, integer=True, min_n_ticks=2))
    axes.tick_params(labelsize=8)


def _draw_ours(axes: Axes, value: float, edges: FloatArray) -> None:
    if edges[0] <= value <= edges[-1]:
        axes.axvline(value, color=OURS, linewidth=1.5, zorder=4)
        return
    side, text = ("right", f"{value:.3g} →") if value > edges[-1] else ("left", f"← {value:.3g}")
    at = 0.98 if side == "right" else 0.02
    axes.text(at, 0.84, text, transform=axes.transAxes, ha=side, va="top", color=OURS, fontsize=8)


def _edges(*clouds: FloatArray) -> FloatArray:
    """Return one set of bins for all panels, so that widths can be compared."""
    values = np.concatenate([cloud.ravel() for cloud in clouds])
    low, high = np.clip([values.min(), values.max()], *_WIDEST)
    first, last = np.floor(low / _BIN), np.ceil(high / _BIN)
    return np.asarray(_BIN * np.arange(first, last + 1.0))


def draw_overview(scenarios: Sequence[Scenario], published: dict[str, Any] | None) -> Figure:
    """Return the figure: small multiples of EI / undamaged EI over the elements."""
    columns = min(3, len(scenarios))
    rows = -(-len(scenarios) // columns)
    height = 1.8 * rows + 1.6
    figure = _empty(height)
    grid = figure.add_gridspec(
        rows,
        columns,
        left=0.06,
        right=0.985,
        top=1.0 - 1.3 / height,
        bottom=0.48 / height,
        hspace=0.36,
        wspace=0.08,
    )
    limits = (0.0, 1.6)
    for place, scenario in enumerate(scenarios):
        axes = figure.add_subplot(grid[place // columns, place % columns])
        _draw_rigidities(axes, scenario, published, limits)
        axes.set_title(f"{scenario.number}: {describe(scenario)}", fontsize=9.5)
        if place % columns:
            axes.tick_params(labelleft=False)
        else:
            axes.set_ylabel("EI / undamaged EI")
        if place + columns < len(scenarios):
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel("element")
    handles: list[Any] = [Line2D([], [], color=INK, linewidth=1.6, label="truth")]
    if published is not None:
        handles.append(_dot(PAPER, "s", "paper, mean ± std"))
    handles += [_dot(WALK, "o", "random walk, mean ± std"), _dot(OURS, "D", "least squares")]
    _head(
        figure,
        height,
        "Flexural rigidity of every element, as found in each scenario",
        "One crossing each. The spread of random-walk particles is not an uncertainty.",
        handles,
    )
    return figure


def _draw_rigidities(
    axes: Axes,
    scenario: Scenario,
    published: dict[str, Any] | None,
    limits: tuple[float, float],
) -> None:
    names = [name for name in scenario.names if name.startswith("EI_")]
    element = np.arange(1.0, len(names) + 1.0)
    truth = np.array([scenario.truth[name] for name in names])
    axes.hlines(truth, element - 0.5, element + 0.5, color=INK, linewidth=1.6, zorder=3)
    if published is not None:
        table = published["table7_normalised_estimates"]
        cell = scenario.number - 1
        mean, std = (
            np.array([table[name][key][cell] for name in names]) for key in ("mean", "std")
        )
        _bars(axes, element - 0.25, mean, std, color=PAPER, marker="s")
    mean, std = (
        np.array([values[name] for name in names])
        for values in (scenario.random_walk.mean, scenario.random_walk.std)
    )
    _bars(axes, element, mean, std, color=WALK, marker="o")
    ours = np.array([scenario.least_squares.mean[name] for name in names])
    inside = (ours >= limits[0]) & (ours <= limits[1])
    at = element + 0.25
    axes.plot(at[inside], ours[inside], "D", color=OURS, markersize=4.2, zorder=5)
    above = ours > limits[1]
    axes.plot(  # an arrowhead at the edge: the value is beyond the axis
        at[above],
        np.full(above.sum(), 0.97 * limits[1]),
        "^",
        color=OURS,
        markersize=5.5,
        zorder=5,
    )
    _simplify_axes(axes, grid="y")
    axes.set_xlim(0.4, len(names) + 0.6)
    axes.set_ylim(*limits)
    axes.set_xticks(element)
    axes.set_yticks(np.arange(0.0, limits[1], 0.5))
    axes.tick_params(axis="x", length=0)


def _bars(
    axes: Axes, at: FloatArray, mean: FloatArray, std: FloatArray, *, color: str, marker: str
) -> None:
    axes.errorbar(
        at, mean, std, color=color, marker=marker, linestyle="none", markersize=3.6, elinewidth=1.3
    )


def _dot(color: str, marker: str, label: str) -> Line2D:
    return Line2D([], [], color=color, marker=marker, markersize=4.2, linewidth=0, label=label)


def describe(scenario: Scenario) -> str:
    """Return the weakened elements in words."""
    rigidities = {n.removeprefix("EI_"): r for n, r in scenario.truth.items() if n[:3] == "EI_"}
    weak = [element for element, ratio in rigidities.items() if ratio != 1.0]
    if not weak:
        return "undamaged"
    ratios = {rigidities[element] for element in weak}
    value = "/".join(f"{ratio:g}" for ratio in sorted(ratios))
    if len(weak) == len(rigidities):
        return f"all elements at {value}"
    word = "element" if len(weak) == 1 else "elements"
    return f"{word} {' and '.join(weak)} at {value}"


def _of_bridge(name: str) -> bool:
    return name.startswith("EI_") or name in {"rhoA", "alpha", "beta"}


def _symbol(name: str) -> str:
    greek = {"rhoA": r"$\rho A$", "alpha": r"$\alpha$", "beta": r"$\beta$"}
    if name in greek:
        return greek[name]
    base, _, index = name.partition("_")
    return f"${base}_{{{index}}}$"


def _empty(height_in: float) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, height_in), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _head(
    figure: Figure, height_in: float, title: str, subtitle: str, handles: Sequence[Any]
) -> None:
    left = 0.055
    figure.text(left, 1.0 - 0.16 / height_in, title, fontsize=14, fontweight="bold", va="top")
    figure.text(left, 1.0 - 0.45 / height_in, subtitle, fontsize=9.5, color=MUTED, va="top")
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(left - 0.012, 1.0 - 0.68 / height_in),
        ncols=len(handles),
        columnspacing=2.0,
    )


def _simplify_axes(axes: Axes, *, grid: Literal["x", "y"]) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=grid, color=GRID, linewidth=0.8, zorder=0.5)
    axes.set_axisbelow(True)
    axes.tick_params(length=3)


def _save(figure: Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    write_atomically(path, buffer.getvalue())
