"""EI of each element, as bars and as a strip along the span with its uncertainty."""

from __future__ import annotations

from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from services.common.arrays import Floats
from services.viewer.crossing_scene import CrossingScene, Panel
from services.viewer.crossing_view import VEHICLE_COLOURS
from services.viewer.rerun_parts import (
    BASELINE,
    LABEL,
    MUTED,
    WEAK,
    RerunStream,
    flat_view,
    log_labels,
    log_strips,
    rgb,
)
from services.viewer.strip import (
    STRIP_HEIGHT,
    STRIP_WIDTH,
    rigidity_strip,
    strip_row,
    strip_top,
)

_ARROW_PX: Final = 24.0
"""Height of the tip of an arrow."""


def _layout(scene: CrossingScene, _: Floats) -> rrb.Container:
    doubt = "DOUBTFUL: " if scene.crossing.is_doubtful else ""
    return rrb.Tabs(
        flat_view(
            f"{scene.root}/strip",
            f"{doubt}EI / nominal" if doubt else "EI / nominal, 95 % interval",
            (-20.0, STRIP_WIDTH + 150.0),
            (-20.0, STRIP_HEIGHT + 150.0),
        ),
        rrb.BarChartView(
            origin=f"{scene.root}/rigidity",
            name=f"{doubt}EI (GN·m²) over chainage (m)",
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        active_tab=0,
    )


def log_rigidity(recording: RerunStream, scene: CrossingScene, rigidity_nm2: Floats) -> None:
    """Log EI of each element as bars, and as a strip along the span."""
    crossing, root, baseline = scene.crossing, scene.root, scene.baseline
    edges = crossing.element_edges_m
    lengths = np.diff(edges)
    doubtful = crossing.is_doubtful
    recording.log(
        f"{root}/rigidity",
        rr.BarChart(
            rigidity_nm2 / 1e9,
            abscissa=edges[:-1] + 0.05 * lengths,  # Rerun expects the beginning of a bar
            widths=0.9 * lengths,
            color=rgb(MUTED if doubtful else VEHICLE_COLOURS["front"]),
        ),
        static=True,
    )
    weak = () if scene.compared is None or doubtful else scene.compared.weak
    top = strip_top(crossing)
    strip = rigidity_strip(crossing, doubtful=doubtful, weak={one.number for one in weak})
    # A picture in a file format is not drawn at all while the chainage is negative (Rerun 0.41).
    recording.log(f"{root}/strip/density", rr.Image(strip), static=True)
    nominal = strip_row(np.ones(lengths.size), top)
    _log_level(recording, f"{root}/strip/nominal", edges, nominal, "nominal", MUTED)
    if baseline is not None and baseline.mean.size == lengths.size:
        stored = strip_row(baseline.mean / crossing.nominal_nm2, top)
        _log_level(recording, f"{root}/strip/baseline", edges, stored, "baseline", BASELINE)
    across = (edges[:-1] + lengths / 2.0) * STRIP_WIDTH / crossing.span_m
    ratio = rigidity_nm2 / crossing.nominal_nm2
    highest = ratio
    if crossing.interval_nm2 is not None and crossing.interval_has_meaning:
        low, highest = crossing.interval_nm2.T / crossing.nominal_nm2
        tips = 0.12 * lengths * STRIP_WIDTH / crossing.span_m
        _log_whiskers(recording, f"{root}/strip/interval", across, tips, (low, highest), top)
    names = [f"EI_{number}" for number in range(1, len(across) + 1)]
    ratios = [f"{value:.3f}" for value in ratio]
    down = np.full(len(across), STRIP_HEIGHT + 15.0)
    log_labels(recording, f"{root}/strip/name", names, across, down)
    log_labels(recording, f"{root}/strip/ratio", ratios, across, down + 60.0)
    if weak:
        where = [element.number - 1 for element in weak]
        less = [f"{100.0 * (1.0 - element.ratio):.0f} % less" for element in weak]
        over = strip_row(highest[where], top) - 70.0
        log_labels(recording, f"{root}/strip/weak", less, across[where], over, colour=WEAK)


def _log_whiskers(
    recording: RerunStream,
    entity: str,
    across: Floats,
    tips: Floats,
    limits: tuple[Floats, Floats],
    top: float,
) -> None:
    """Draw intervals; one that exceeds the strip ends in an arrow."""
    low, high = limits
    rows = np.stack((strip_row(low, top), strip_row(high, top)), axis=1)
    strips = [[(x, bottom), (x, end)] for x, (bottom, end) in zip(across, rows, strict=True)]
    for limit, row in zip(limits, rows.T, strict=True):
        inside = limit <= top
        ends = zip(across[inside], tips[inside], row[inside], strict=True)
        strips += [[(x - tip, y), (x + tip, y)] for x, tip, y in ends]
    beyond = high > top
    for x, tip in zip(across[beyond], tips[beyond], strict=True):
        strips.append([(x - tip, _ARROW_PX), (x, 0.0), (x + tip, _ARROW_PX)])
    log_strips(recording, entity, strips, [(255, 255, 255)], 1.0)


def _log_level(
    recording: RerunStream,
    entity: str,
    edges_m: Floats,
    rows: Floats,
    name: str,
    colour: str,
) -> None:
    """Draw a line across the strip, at a height for each element."""
    x = np.repeat(edges_m, 2)[1:-1] * STRIP_WIDTH / edges_m[-1]
    log_strips(recording, entity, [np.column_stack((x, np.repeat(rows, 2)))], [rgb(colour)], 0.75)
    beside, last = np.array([STRIP_WIDTH + 80.0]), rows[-1:] - 25.0  # it stands below its place
    of_name = LABEL if colour == MUTED else colour
    log_labels(recording, f"{entity}/name", [name], beside, last, colour=of_name)


PANEL: Final = Panel(lambda scene: scene.crossing.rigidity_nm2, _layout, log_rigidity)
