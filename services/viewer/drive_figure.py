"""The figure of a whole drive over its own time: accelerations of body and axles, and speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure

from schemas.signals import AccelBatch
from services.common.arrays import Floats
from services.drives.runs import Run
from services.viewer.crossing_view import CrossingSpan
from services.viewer.drawing import (
    GRID,
    INK,
    LEFT,
    RIGHT,
    STYLE,
    WEAK_BAR,
    WIDTH_IN,
    figure_bytes,
)
from services.viewer.rerun_parts import channel_colour
from services.viewer.vehicle_signals import VehicleSignals

_HEIGHT_IN = 5.2
_LONGEST_TITLE = 80
"""Largest number of characters of a title; of a longer path the end is shown."""
_MAX_RANGES = 1500
"""Largest number of ranges of values along the time."""
_GAP_S = 3.0
"""Shortest time without values that interrupts a line."""


class Envelope(NamedTuple):
    """Smallest and largest values of a signal in pieces of the time, all (k,)."""

    time_s: Floats
    low: Floats
    high: Floats


def draw_drive(vehicle: str, signals: VehicleSignals, crossings: Sequence[CrossingSpan]) -> Figure:
    """Return the figure, to be drawn in `STYLE`; crossings are shaded."""
    names = sorted({name for batch in signals.accel for name in batch.channels})
    curves = {name: _of_batches(signals.accel, name) for name in names}
    time_s = np.array([fix.wall_time_ns / 1e9 for fix in signals.gnss])
    speed = np.array([fix.speed_m_per_s for fix in signals.gnss])
    return _draw(vehicle, curves, time_s, speed, crossings)


def run_picture(run: Run) -> bytes:
    """Return a PNG of one run as it is read from tables, before it becomes a recording."""
    curves = {name: _of_samples(run.accel_time_s, one) for name, one in run.channels.items()}
    with matplotlib.rc_context(STYLE):
        figure = _draw(run.source, curves, run.gnss.time_s, run.gnss.speed_m_per_s, ())
    return figure_bytes(figure, "png", dpi=120)


def _draw(
    title: str,
    curves: Mapping[str, Envelope],
    fix_time_s: Floats,
    speed_m_per_s: Floats,
    crossings: Sequence[CrossingSpan],
) -> Figure:
    figure = Figure(figsize=(WIDTH_IN, _HEIGHT_IN), facecolor="white")
    FigureCanvasAgg(figure)
    grid: Any = figure.subplots(3, 1, sharex=True)
    panels: list[Axes] = list(grid)
    figure.subplots_adjust(left=LEFT, right=RIGHT, top=0.86, bottom=0.11, hspace=0.42)
    heading = title if len(title) <= _LONGEST_TITLE else f"…{title[1 - _LONGEST_TITLE :]}"
    figure.text(LEFT, 0.975, heading, fontsize=12, fontweight="bold", va="top", parse_math=False)
    body = {name: one for name, one in curves.items() if not name.startswith("unsprung")}
    axles = {name: one for name, one in curves.items() if name.startswith("unsprung")}
    _draw_curves(panels[0], "Body accelerations (m/s²)", body)
    _draw_curves(panels[1], "Axle accelerations (m/s²)", axles)
    panels[2].set_title("Speed (m/s)")
    times, speed = _interrupted(fix_time_s, speed_m_per_s)
    panels[2].plot(_days(times), speed, color=INK, linewidth=1.2)
    locator: Any = AutoDateLocator(tz=UTC)  # type: ignore[no-untyped-call]
    form: Any = ConciseDateFormatter(locator, tz=UTC)  # type: ignore[no-untyped-call]
    panels[2].xaxis.set_major_locator(locator)
    panels[2].xaxis.set_major_formatter(form)
    panels[2].set_xlabel("time (UTC)")
    for axes in panels:
        for crossing in crossings:
            begin, end = _days(np.array([crossing.entry_time_s, crossing.exit_time_s]))
            axes.axvspan(begin, end, color=WEAK_BAR, alpha=0.18, linewidth=0)
        axes.grid(color=GRID, linewidth=0.8)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    return figure


def _draw_curves(axes: Axes, title: str, curves: Mapping[str, Envelope]) -> None:
    axes.set_title(title, parse_math=False)
    for name, curve in curves.items():
        times, low = _interrupted(curve.time_s, curve.low)
        _, high = _interrupted(curve.time_s, curve.high)
        colour, label = channel_colour(name), name.replace("_", " ")
        days = _days(times)
        axes.fill_between(days, low, high, color=colour, alpha=0.7, linewidth=0.4, label=label)
    if curves:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=4, borderpad=0.0)


def _of_batches(batches: Sequence[AccelBatch], channel: str) -> Envelope:
    """Return the envelope of a channel, of a few batches each."""
    size = -(-len(batches) // _MAX_RANGES) or 1
    rows = []
    for first in range(0, len(batches), size):
        some = [b for b in batches[first : first + size] if channel in b.channels]
        samples = [b.channels[channel].samples for b in some if b.channels[channel].samples.size]
        if samples:
            low, high = min(np.nanmin(one) for one in samples), max(map(np.nanmax, samples))
            rows.append((some[0].wall_time_ns / 1e9, low, high))
    return Envelope(*np.array(rows, dtype=np.float64).reshape(-1, 3).T)


def _of_samples(time_s: Floats, values: Floats) -> Envelope:
    """Return the envelope of even samples (n,)."""
    size = -(-values.size // _MAX_RANGES) or 1
    first = np.arange(0, values.size, size)
    return Envelope(
        time_s[first],
        np.asarray(np.minimum.reduceat(values, first), dtype=np.float64),
        np.asarray(np.maximum.reduceat(values, first), dtype=np.float64),
    )


def _interrupted(time_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return times and values (n,) with a NaN in every gap, where a line then breaks."""
    gaps = np.flatnonzero(np.diff(time_s) > _GAP_S) + 1
    between = 0.5 * (time_s[gaps - 1] + time_s[gaps]) if gaps.size else time_s[:0]
    return np.insert(time_s, gaps, between), np.insert(values, gaps, np.nan)


def _days(time_s: Floats) -> Floats:
    """Return times (n,) as Matplotlib counts them, in days."""
    moments = [datetime.fromtimestamp(one, UTC) for one in time_s.tolist()]
    return np.array([date2num(one) for one in moments])  # type: ignore[no-untyped-call]
