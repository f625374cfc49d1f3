"""The layout of a Rerun file: which view stands where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import rerun as rr
import rerun.blueprint as rrb

from services.viewer.bridge_view import BridgeView
from services.viewer.crossing_view import CrossingView
from services.viewer.strip import STRIP_HEIGHT, STRIP_PAPER, STRIP_WIDTH
from services.viewer.vehicle_signals import VehicleSignals

TIME, CHAINAGE = "time", "chainage_mm"
"""The two timelines."""


def crossing_root(crossing: CrossingView) -> str:
    """Entity path under which everything of one crossing stands."""
    return f"crossing/{rr.escape_entity_path_part(crossing.crossing_id)}/{crossing.method}"


def blueprint(
    vehicles: Mapping[str, VehicleSignals],
    crossings: Sequence[CrossingView],
    overviews: Sequence[BridgeView] = (),
) -> rrb.Blueprint:
    """A tab for every bridge and every crossing, the first one open, and one for the drive."""
    drive = _drive_layout(vehicles)
    layouts: list[rrb.Container] = [_overview_layout(bridge) for bridge in overviews]
    layouts += [_crossing_layout(one, vehicles.get(one.vehicle)) for one in crossings]
    content = rrb.Tabs(*layouts, drive, active_tab=0) if layouts else drive
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state="collapsed", timeline=CHAINAGE if layouts else TIME),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _crossing_layout(crossing: CrossingView, signals: VehicleSignals | None) -> rrb.Container:
    """What was found at the left, what it was found from in the middle; only what there is."""
    root = crossing_root(crossing)
    plots = _acceleration_plots(f"{root}/acceleration", signals)
    if crossing.road is not None:
        plots = [
            _plot(f"{root}/road", "Road profile (mm)"),
            _plot(f"{root}/road_difference", "Front minus rear (mm)"),
            *plots,
        ]
    side = rrb.Vertical(
        _map(more=f"{root}/position", zoom=18.0),
        rrb.TextDocumentView(origin=f"{root}/verdict", name="Verdict"),
        row_shares=[2, 5],
    )
    columns = [(side, 4)]
    if plots:
        columns.insert(0, (rrb.Vertical(*plots), 6))
    if crossing.rigidity_nm2 is not None:
        columns.insert(0, (_rigidity_layout(root, doubtful=is_doubtful(crossing)), 5))
    return rrb.Horizontal(
        *(column for column, _ in columns),
        column_shares=[share for _, share in columns],
        name=tab_name(crossing),
    )


def tab_name(crossing: CrossingView) -> str:
    """Which crossing, and what is to be thought of it: there may be many of one bridge."""
    moment = datetime.fromtimestamp(crossing.entry_time_s, UTC)
    way = "→" if crossing.forward else "←"
    return f"{moment:%Y-%m-%d %H:%M} {way} {crossing.bridge}, {crossing.verdict}"


def bridge_root(bridge: BridgeView) -> str:
    """Entity path under which everything of one bridge stands."""
    return f"bridge/{rr.escape_entity_path_part(bridge.bridge)}"


def _overview_layout(bridge: BridgeView) -> rrb.Container:
    """The picture of the bridge, for who has one minute, and where it is."""
    picture = rrb.Spatial2DView(
        origin=f"{bridge_root(bridge)}/picture",
        name="Stiffness, and all crossings",
        background=(255, 255, 255),
    )
    side = rrb.Vertical(
        rrb.TextDocumentView(origin=f"{bridge_root(bridge)}/finding", name="Finding"), _map()
    )
    name = f"Bridge {bridge.owner_id or bridge.bridge}"
    return rrb.Horizontal(picture, side, column_shares=[3, 1], name=name)


def is_doubtful(crossing: CrossingView) -> bool:
    """Whether what was found is not to be relied upon."""
    return crossing.verdict != "good" or not crossing.interval_has_meaning


def _rigidity_layout(root: str, *, doubtful: bool) -> rrb.Vertical:
    doubt = "DOUBTFUL: " if doubtful else ""
    return rrb.Vertical(
        rrb.BarChartView(
            origin=f"{root}/rigidity",
            name=f"{doubt}EI of each element (GN·m²) over chainage (m)",
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        rrb.Spatial2DView(
            origin=f"{root}/strip",
            name=f"{doubt}EI along the span, ratio to nominal (line)",
            background=STRIP_PAPER,
            visual_bounds=rrb.VisualBounds2D(
                x_range=(-20.0, STRIP_WIDTH + 20.0), y_range=(-20.0, STRIP_HEIGHT + 150.0)
            ),
        ),
        row_shares=[5, 6],
    )


def _drive_layout(vehicles: Mapping[str, VehicleSignals]) -> rrb.Container:
    plots: list[rrb.View] = []
    for vehicle, signals in vehicles.items():
        plots += _acceleration_plots(f"vehicle/{vehicle}/acceleration", signals, f"{vehicle}:")
        plots.append(_plot(f"vehicle/{vehicle}/speed", f"{vehicle}: Speed (m/s)"))
    return rrb.Horizontal(_map(), rrb.Vertical(*plots), column_shares=[2, 3], name="Whole drive")


def _acceleration_plots(
    origin: str, signals: VehicleSignals | None, vehicle: str = ""
) -> list[rrb.View]:
    """Body and axles apart: those of the axles are ten times larger. Only what the truck has."""
    channels = {channel for batch in signals.accel for channel in batch.channels} if signals else ()
    return [
        _plot(origin, f"{vehicle} {name} accelerations (m/s²)".strip(), part)
        for part, name in (("sprung", "Body"), ("unsprung", "Axle"))
        if f"{part}_front" in channels or f"{part}_rear" in channels
    ]


def _plot(origin: str, name: str, only: str | None = None) -> rrb.View:
    """A plot of all of a series, not only of what lies before the time cursor."""
    infinite = rrb.TimeRangeBoundary.infinite()
    whole = [
        rrb.VisibleTimeRange(timeline, start=infinite, end=infinite)
        for timeline in (TIME, CHAINAGE)
    ]
    contents = (
        "$origin/**" if only is None else [f"$origin/{only}_{axle}" for axle in ("front", "rear")]
    )
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents,
        name=name,
        time_ranges=whole,
        axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(start=infinite, end=infinite)),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )


def _map(*, more: str | None = None, zoom: float | None = None) -> rrb.View:
    contents = ["/map/**"] if more is None else ["/map/**", f"/{more}"]
    return rrb.MapView(origin="/", contents=contents, name="Map", zoom=zoom)
