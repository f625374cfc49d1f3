"""Common parts of Rerun files: timelines, series, labels, colours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from services.common.arrays import Floats, Ints
from services.viewer.crossing_view import VEHICLE_COLOURS
from services.viewer.strip import STRIP_PAPER

TIME, CHAINAGE = "time", "chainage_mm"
"""Names of the two timelines."""

Rgb = tuple[int, int, int]


class RerunStream(Protocol):
    """Destination of entities: a recording, or a `TimestampedStream` of the live view."""

    def log(self, entity_path: str, entity: Any, *, static: bool = False) -> None:
        """Log one entity: statically, or at the present time of the recording."""

    def send_columns(
        self, entity_path: str, indexes: Iterable[Any], columns: Iterable[Any]
    ) -> None:
        """Log a series with the times of its values."""


CHANNEL_COLOURS = {
    "sprung_front": "#56B4E9",
    "sprung_rear": "#E69F00",
    "unsprung_front": VEHICLE_COLOURS["front"],
    "unsprung_rear": VEHICLE_COLOURS["rear"],
}
_OTHER_CHANNELS = ("#0072B2", "#CC79A7", "#999999", "#44AA99", "#882255", "#DDCC77")
MUTED = "#9AA5B1"
LABEL = "#FFFFFF"
"""Colour of texts in dark views: in the light theme their boxes are grey, as `MUTED` is."""
WEAK, BASELINE = "#E69F00", "#009E73"
UNKNOWN = "#CC79A7"
"""Colour of a bridge with unknown EI, distinct from those with a meaning."""
_RATIO_COLOURS = ((0.8, (230, 159, 0)), (1.0, (86, 180, 233)))
"""Colours of relative EI on plan and map."""
RATIO_LEGEND = "orange: EI / nominal ≤ 0.8"
_BEHIND = 10.0
"""Draw order of lines below others, whose default is 20."""


def channel_colour(channel: str) -> str:
    """Return the colour of a channel: a fixed one for the four, otherwise one by its name."""
    if channel in CHANNEL_COLOURS:
        return CHANNEL_COLOURS[channel]
    return _OTHER_CHANNELS[sum(channel.encode()) % len(_OTHER_CHANNELS)]


def log_channel(recording: RerunStream, entity: str, channel: str) -> None:
    """Define the line of a channel, named shortly: the plot's title has its part of the truck."""
    part, _, place = channel.partition("_")
    name = place if part in ("sprung", "unsprung") and place else channel
    log_line(recording, entity, name.replace("_", " "), channel_colour(channel))


def rgb(colour: str) -> Rgb:
    """Return red, green and blue, 0 to 255, of #RRGGBB."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def ratio_colours(ratios: Floats | None, count: int, *, doubtful: bool) -> list[Rgb]:
    """Return a colour for each of `count` elements by its relative EI (n,).

    It is grey where doubtful, and where a value is NaN: unresolved.
    """
    if ratios is None:
        return [rgb(UNKNOWN)] * count
    if doubtful:
        return [rgb(MUTED)] * count
    at = [ratio for ratio, _ in _RATIO_COLOURS]
    channels = np.array([colour for _, colour in _RATIO_COLOURS], dtype=np.float64).T
    known = np.isfinite(ratios)
    mixed = np.tile(rgb(MUTED), (count, 1))
    for place, channel in enumerate(channels):
        mixed[known, place] = np.rint(np.interp(ratios[known], at, channel))
    return [(int(red), int(green), int(blue)) for red, green, blue in mixed]


def time_column(time_ns: Ints) -> rr.TimeColumn:
    """Return the index of wall time (n,), ns since 1970 UTC."""
    return rr.TimeColumn(TIME, timestamp=time_ns.astype("datetime64[ns]"))


def chainage_column(chainage_m: Floats) -> rr.TimeColumn:
    """Return the index of the front axle's chainage (n,), in whole mm as a timeline needs."""
    return rr.TimeColumn(CHAINAGE, sequence=np.rint(1e3 * chainage_m).astype(np.int64))


def columns_of(time_ns: Ints, chainage_m: Floats | None) -> list[rr.TimeColumn]:
    """Return both indexes (n,), or without a chainage that of time."""
    indexes = [time_column(time_ns)]
    if chainage_m is not None:
        indexes.append(chainage_column(chainage_m))
    return indexes


def log_line(
    recording: RerunStream, entity: str, name: str, colour: str, *, width: float = 1.3
) -> None:
    """Define the style of a time series' line."""
    recording.log(
        entity,
        rr.SeriesLines(
            colors=[rgb(colour)],
            names=name,
            widths=width,
            # Averaging when zoomed out would hide the peaks of an acceleration.
            aggregation_policy=rr.components.AggregationPolicy.MinMax,
        ),
        static=True,
    )


def send_scalars(
    recording: RerunStream,
    entity: str,
    values: Floats,
    *,
    time_ns: Ints,
    chainage_m: Floats | None = None,
) -> None:
    """Log a time series (n,), if it has any samples."""
    if len(values):
        indexes = columns_of(time_ns, chainage_m)
        recording.send_columns(entity, indexes, rr.Scalars.columns(scalars=values))


def log_round_beginning(recording: RerunStream, entity: str, chainage_m: Floats) -> None:
    """Clear an entity at the last multiple of 10 m below a series' chainages (n,).

    Rerun counts the ticks of a plot from the first chainage with data: they were #50, #10 050 and
    so on for a road that begins 50 mm behind the start of the bridge.
    """
    first_m = 10.0 * np.floor(np.min(chainage_m, keepdims=True).ravel() / 10.0)
    recording.send_columns(entity, [chainage_column(first_m)], rr.Scalars.columns(scalars=[np.nan]))


def log_labels(
    recording: RerunStream,
    entity: str,
    labels: Sequence[str],
    across: Floats,
    down: Floats,
    *,
    colour: str = LABEL,
) -> None:
    """Draw texts in a 2-D view, each centred a little below its point; coordinates (n,)."""
    recording.log(
        entity,
        rr.Points2D(
            np.column_stack((across, down)),
            labels=list(labels),
            show_labels=True,
            radii=0.0,
            colors=[rgb(colour)],
        ),
        static=True,
    )


def log_strips(
    recording: RerunStream,
    entity: str,
    strips: Sequence[Any],
    colours: Sequence[Rgb],
    width: float,
    *,
    is_behind: bool = False,
) -> None:
    """Draw lines in a 2-D view, with a colour for all or each, `width` points to each side.

    With `is_behind` they are below all other lines; otherwise the order is undefined.
    """
    lines = rr.LineStrips2D(
        strips,
        colors=colours,
        radii=rr.Radius.ui_points(width),
        draw_order=_BEHIND if is_behind else None,
    )
    recording.log(entity, lines, static=True)


def log_markdown(recording: RerunStream, entity: str, text: str) -> None:
    """Log a page of text."""
    document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
    recording.log(entity, document, static=True)


def flat_view(
    origin: str,
    name: str,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    contents: list[str] | None = None,
) -> rrb.View:
    """Return a 2-D view with limits, of an entity or of `contents`."""
    return rrb.Spatial2DView(
        origin=origin,
        contents="$origin/**" if contents is None else contents,
        name=name,
        background=STRIP_PAPER,
        visual_bounds=rrb.VisualBounds2D(x_range=x_range, y_range=y_range),
    )


def series_plot(
    origin: str,
    name: str,
    only: Sequence[str] | None = None,
    window_s: float | None = None,
    *,
    has_legend: bool = True,
) -> rrb.View:
    """Return a plot of a whole series, not only of its part before the cursor, or of a window."""
    start = end = rrb.TimeRangeBoundary.infinite()
    timelines = [TIME, CHAINAGE]
    if window_s is not None:
        start = rrb.TimeRangeBoundary.cursor_relative(seconds=-window_s)
        end = rrb.TimeRangeBoundary.cursor_relative(seconds=0.0)
        timelines = [TIME]
    shown = [rrb.VisibleTimeRange(timeline, start=start, end=end) for timeline in timelines]
    contents = "$origin/**" if only is None else [f"$origin/{one}" for one in only]
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents,
        name=name,
        time_ranges=shown,
        axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=has_legend),
    )
