"""The layout of a Rerun file: which view stands where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from datetime import UTC, datetime

import rerun as rr
import rerun.blueprint as rrb

from services.viewer.bridge_view import BridgeView
from services.viewer.crossing_view import CrossingView, PassingView
from services.viewer.deflection import passage_of
from services.viewer.learned import learned_of
from services.viewer.rerun_parts import CHAINAGE, RATIO_LEGEND, TIME
from services.viewer.rerun_places import PLAN_MARGIN, BridgeOnMap, plan_root
from services.viewer.rerun_residuals import RESIDUALS_BOUNDS
from services.viewer.strip import STRIP_HEIGHT, STRIP_PAPER, STRIP_WIDTH
from services.viewer.vehicle_signals import VehicleSignals

ENDS = "ends"
"""Beside the channels of a crossing: the ends of the bridge."""
LEARNED_ROW = 0.4
"""From one unknown to the next, in prior standard deviations: the view has one scale."""


def crossing_root(crossing: CrossingView) -> str:
    """Entity path under which everything of one crossing stands."""
    return f"crossing/{rr.escape_entity_path_part(crossing.crossing_id)}/{crossing.method}"


def bridge_root(bridge: BridgeView) -> str:
    """Entity path under which everything of one bridge stands."""
    return f"bridge/{rr.escape_entity_path_part(bridge.bridge)}"


def passing_root(passing: PassingView) -> str:
    """Entity path of a crossing that was not identified."""
    return f"passing/{passing.bridge}/{passing.vehicle}/{round(1e3 * passing.entry_time_s)}"


def blueprint(
    vehicles: Mapping[str, VehicleSignals],
    crossings: Sequence[CrossingView],
    overviews: Sequence[BridgeView] = (),
    passings: Sequence[PassingView] = (),
    *,
    bridges: Sequence[BridgeOnMap] = (),
    about: str | None = None,
) -> rrb.Blueprint:
    """A tab for every bridge and every crossing, the first one open, and one for the drive.

    Without any result the drive comes first, on the timeline that it has; then the crossings that
    were seen in it.
    """
    on_map = {bridge.identifier: bridge for bridge in bridges}
    channels = {
        vehicle: {name for batch in signals.accel for name in batch.channels}
        for vehicle, signals in vehicles.items()
    }
    found: list[rrb.Container] = [_overview_layout(b, on_map.get(b.bridge)) for b in overviews]
    found += [
        _crossing_layout(one, channels.get(one.vehicle, set()), on_map.get(one.bridge))
        for one in crossings
    ]
    seen = [
        _passing_layout(one, channels.get(one.vehicle, set()), on_map.get(one.bridge))
        for one in passings
    ]
    drive = _drive_layout(channels, has_results=bool(found), has_about=about is not None)
    tabs = [*found, drive, *seen] if found else [drive, *seen]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline=CHAINAGE if found else TIME, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _crossing_layout(
    crossing: CrossingView, channels: Set[str], bridge: BridgeOnMap | None
) -> rrb.Container:
    """Verdict and place, what was found, and what it was found from; only what there is."""
    root = crossing_root(crossing)
    plots = acceleration_plots(f"{root}/acceleration", channels)
    if crossing.road is not None:
        plots = [
            _plot(f"{root}/road", "Road profile (mm)"),
            _plot(f"{root}/road_difference", "Front minus rear (mm)"),
            *plots,
        ]
    coloured = crossing.rigidity_nm2 is not None
    columns: list[tuple[rrb.Container | rrb.View, int]] = [
        (_verdict_and_place(root, bridge, coloured=coloured), 5)
    ]
    if crossing.rigidity_nm2 is not None:
        columns.append((_rigidity_layout(root, crossing), 6))
    evidence: list[rrb.Container | rrb.View] = []
    if plots:
        evidence.append(rrb.Vertical(*plots, name="Road and signals"))
    if crossing.interval_has_meaning and learned_of(crossing.parameters):
        evidence.append(_learned_view(root, crossing))
    if crossing.residuals is not None:
        evidence.append(_residuals_view(root))
    if evidence:
        beside = rrb.Tabs(*evidence, active_tab=0) if len(evidence) > 1 else evidence[0]
        columns.append((beside, 5))
    return rrb.Horizontal(
        *(column for column, _ in columns),
        column_shares=[share for _, share in columns],
        name=tab_name(crossing),
    )


def tab_name(crossing: CrossingView) -> str:
    """Which crossing, and what is to be thought of it: there may be many of one bridge."""
    return f"{_when_and_where(crossing)}, {crossing.verdict}"


def _when_and_where(crossing: CrossingView | PassingView) -> str:
    moment = datetime.fromtimestamp(crossing.entry_time_s, UTC)
    way = "→" if crossing.forward else "←"
    return f"{moment:%Y-%m-%d %H:%M} {way} {crossing.bridge}"


def _verdict_and_place(root: str, bridge: BridgeOnMap | None, *, coloured: bool) -> rrb.Container:
    verdict = rrb.TextDocumentView(origin=f"{root}/verdict", name="Verdict")
    places = bridge_places(bridge, root, coloured=coloured)
    return rrb.Vertical(verdict, places, row_shares=[5, 3])


def _overview_layout(bridge: BridgeView, on_map: BridgeOnMap | None) -> rrb.Container:
    """The picture of the bridge, for who has one minute, and where it is."""
    picture = rrb.Spatial2DView(
        origin=f"{bridge_root(bridge)}/picture",
        name="Stiffness, and all crossings",
        background=(255, 255, 255),
    )
    side = rrb.Vertical(
        rrb.TextDocumentView(origin=f"{bridge_root(bridge)}/finding", name="Finding"),
        bridge_places(on_map, coloured=bridge.estimate is not None),
    )
    name = f"Bridge {bridge.owner_id or bridge.bridge}"
    return rrb.Horizontal(picture, side, column_shares=[5, 2], name=name)


def is_doubtful(crossing: CrossingView) -> bool:
    """Whether what was found is not to be relied upon."""
    return crossing.verdict != "good" or not crossing.interval_has_meaning


def _rigidity_layout(root: str, crossing: CrossingView) -> rrb.Container:
    doubt = "DOUBTFUL: " if is_doubtful(crossing) else ""
    along = rrb.Tabs(
        rrb.Spatial2DView(
            origin=f"{root}/strip",
            name=f"{doubt}EI along the span, of nominal, 95 % interval",
            background=STRIP_PAPER,
            visual_bounds=rrb.VisualBounds2D(
                x_range=(-20.0, STRIP_WIDTH + 150.0), y_range=(-20.0, STRIP_HEIGHT + 150.0)
            ),
        ),
        rrb.BarChartView(
            origin=f"{root}/rigidity",
            name=f"{doubt}EI (GN·m²) over chainage (m)",
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        active_tab=0,
    )
    if passage_of(crossing) is None:
        return along
    span = crossing.span_m
    passage = rrb.Spatial2DView(
        origin=f"{root}/passage",
        name=f"{doubt}The bridge under the truck (static; move the time)",
        background=STRIP_PAPER,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-0.15 * span, 1.15 * span), y_range=(-0.25 * span, 0.15 * span)
        ),
    )
    return rrb.Vertical(along, passage, row_shares=[5, 3])


def _learned_view(root: str, crossing: CrossingView) -> rrb.View:
    rows = len(learned_of(crossing.parameters))
    return rrb.Spatial2DView(
        origin=f"{root}/learned",
        name="Told beyond the prior (grey)",
        background=STRIP_PAPER,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-3.6, 4.2), y_range=(-2.0 * LEARNED_ROW, (rows + 1) * LEARNED_ROW)
        ),
    )


def _residuals_view(root: str) -> rrb.View:
    x_range, y_range = RESIDUALS_BOUNDS
    return rrb.Spatial2DView(
        origin=f"{root}/residuals",
        name="Left over by band",
        background=STRIP_PAPER,
        visual_bounds=rrb.VisualBounds2D(x_range=x_range, y_range=y_range),
    )


def _passing_layout(
    passing: PassingView, channels: Set[str], bridge: BridgeOnMap | None
) -> rrb.Container:
    """The accelerations of a crossing that nobody has identified."""
    root = passing_root(passing)
    plots = acceleration_plots(f"{root}/acceleration", channels)
    return rrb.Vertical(
        *plots,
        bridge_places(bridge, root, has_elements=False, coloured=False),
        name=f"{_when_and_where(passing)}, not identified",
    )


def _drive_layout(
    channels: Mapping[str, Set[str]], *, has_results: bool, has_about: bool
) -> rrb.Container:
    plots: list[rrb.View] = []
    for vehicle, known in channels.items():
        plots += acceleration_plots(f"vehicle/{vehicle}/acceleration", known, f"{vehicle}:")
        plots.append(_plot(f"vehicle/{vehicle}/speed", f"{vehicle}: Speed (m/s)"))
    places = rrb.Tabs(
        rrb.Spatial2DView(origin="plan_of_drive", name="Plan of the drive (m, north up)"),
        _map("/map/**"),
        active_tab=0,
    )
    side: rrb.Container = places
    if has_about:
        page = rrb.TextDocumentView(origin="about", name="What was recorded")
        side = rrb.Vertical(page, places)
    # A crossing is on both timelines, a drive has no chainage: Rerun shows one timeline at a time.
    name = f"Whole drive (choose the timeline {TIME})" if has_results else "Recording"
    return rrb.Horizontal(side, rrb.Vertical(*plots), column_shares=[2, 3], name=name)


def acceleration_plots(
    origin: str, channels: Set[str], vehicle: str = "", *, window_s: float | None = None
) -> list[rrb.View]:
    """Body and axles apart: those of the axles are ten times larger. Only what the truck has.

    All of it, or with `window_s` what lies so shortly before the moment that is looked at.
    """
    plots = []
    for part, name in (("sprung", "Body"), ("unsprung", "Axle"), ("", "Other")):
        own = sorted(one for one in channels if _part(one) == part)
        if own:
            four = [f"{part}_front", f"{part}_rear"] if part else []
            entities = [*four, *(one for one in own if one not in four), ENDS]
            title = f"{vehicle} {name} accelerations (m/s²)".strip()
            plots.append(_plot(origin, title, entities, window_s))
    return plots


def _part(channel: str) -> str:
    """By the beginning of its name what a channel is plotted with: the site file is not at hand."""
    part = channel.partition("_")[0]
    return part if part in ("sprung", "unsprung") else ""


def _plot(
    origin: str,
    name: str,
    only: Sequence[str] | None = None,
    window_s: float | None = None,
) -> rrb.View:
    """A plot of all of a series, not only of what lies before the time cursor, or of a window."""
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
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
    )


def bridge_places(
    bridge: BridgeOnMap | None,
    root: str | None = None,
    *,
    has_elements: bool = True,
    coloured: bool,
    name: str | None = None,
) -> rrb.Container | rrb.View:
    """The plan of a bridge and beside it the map, which needs a network for its background.

    With the root of a crossing the truck is that of this crossing, and so are the elements, if it
    has any. They are `coloured` if something is known of them.
    """
    own = [f"/{root}/map"] if root is not None and has_elements else ["/map/bridge/**"]
    own += ["/map/position/**"] if root is None else [f"/{root}/position"]
    on_map = _map("/map/track/**", "/map/fixes/**", *own, zoom=18.0)
    if bridge is None:
        return on_map
    plan, span = plan_root(bridge.identifier), bridge.span_m
    around = [f"/{plan}/{part}/**" for part in ("bearings", "scale", "north")]
    drawn = [f"/{root}/plan/**"]
    if root is None:
        drawn = [f"/{plan}/{part}/**" for part in ("track", "truck")]
    if root is None or not has_elements:
        drawn.append(f"/{plan}/elements/**")
    view = rrb.Spatial2DView(
        origin="/",
        contents=[*around, *drawn],
        name=f"Plan (m), EI: {RATIO_LEGEND}" if coloured else "Plan (m)",
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-PLAN_MARGIN * span, (1.0 + PLAN_MARGIN) * span),
            y_range=(-0.25 * span, 0.4 * span),
        ),
    )
    return rrb.Tabs(view, on_map, active_tab=0, name=name)


def _map(*contents: str, zoom: float | None = None) -> rrb.View:
    return rrb.MapView(
        origin="/", contents=list(contents), name="Map (tiles need a network)", zoom=zoom
    )
