"""The layout of a Rerun file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from datetime import UTC, datetime

import rerun as rr
import rerun.blueprint as rrb

from services.viewer.bridge_view import BridgeView
from services.viewer.crossing_view import CrossingView, DetectedCrossingView
from services.viewer.deflection import deflection_frames
from services.viewer.prior_posterior import prior_posterior_rows
from services.viewer.rerun_parts import CHAINAGE, RATIO_LEGEND, TIME
from services.viewer.rerun_places import PLAN_MARGIN, BridgeOnMap, plan_root
from services.viewer.rerun_residuals import RESIDUALS_BOUNDS
from services.viewer.strip import STRIP_HEIGHT, STRIP_PAPER, STRIP_WIDTH
from services.viewer.vehicle_signals import VehicleSignals

_LEAST_SPEED_M_PER_S = 1.0
"""Lowest speed at which a crossing is played: a truck may have stopped on the bridge."""
ENDS = "ends"
"""Entity of the ends of the bridge, next to the channels of a crossing."""
PRIOR_POSTERIOR_ROW = 0.4
"""Distance between two parameters in prior standard deviations; the view has one scale."""


def crossing_root(crossing: CrossingView) -> str:
    """Return the entity path of a crossing."""
    return f"crossing/{rr.escape_entity_path_part(crossing.crossing_id)}/{crossing.method}"


def bridge_root(bridge: BridgeView) -> str:
    """Return the entity path of a bridge."""
    return f"bridge/{rr.escape_entity_path_part(bridge.bridge)}"


def passing_root(passing: DetectedCrossingView) -> str:
    """Return the entity path of a crossing that was not identified."""
    return f"passing/{passing.bridge}/{passing.vehicle}/{round(1e3 * passing.entry_time_s)}"


def blueprint(
    vehicles: Mapping[str, VehicleSignals],
    crossings: Sequence[CrossingView],
    overviews: Sequence[BridgeView] = (),
    passings: Sequence[DetectedCrossingView] = (),
    *,
    bridges: Sequence[BridgeOnMap] = (),
    about: str | None = None,
) -> rrb.Blueprint:
    """Return a tab for every bridge and crossing, the first one open, and one for the drive.

    Without any result the drive comes first, on its own timeline; then its detected crossings.
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
        _time_panel(crossings, has_results=bool(found)),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _time_panel(crossings: Sequence[CrossingView], *, has_results: bool) -> rrb.TimePanel:
    """Return a panel that plays the newest crossing at the truck's speed, on the bridge.

    The chainage is a sequence in mm, of which a viewer shows a number of steps each second.
    """
    if not has_results or not crossings:
        timeline = CHAINAGE if has_results else TIME
        return rrb.TimePanel(state="collapsed", timeline=timeline, play_state="paused")
    newest = max(crossings, key=lambda crossing: crossing.entry_time_s)
    return rrb.TimePanel(
        state="collapsed",
        timeline=CHAINAGE,
        play_state="playing",
        fps=1e3 * max(newest.speed_m_per_s, _LEAST_SPEED_M_PER_S),
        loop_mode="selection",
        time_selection=rrb.components.AbsoluteTimeRange(0, round(1e3 * newest.span_m)),
    )


def _difference_title(crossing: CrossingView) -> str:
    first = crossing.first_axle
    return "Front minus rear" if first == 1 else f"Axle {first} minus axle {first + 1}"


def _crossing_layout(
    crossing: CrossingView, channels: Set[str], bridge: BridgeOnMap | None
) -> rrb.Container:
    """Lay out verdict and position, result, and evidence, as far as each exists."""
    root = crossing_root(crossing)
    plots = acceleration_plots(f"{root}/acceleration", channels)
    if crossing.road is not None:
        plots = [
            _plot(f"{root}/road", "Road profile (mm)"),
            _plot(f"{root}/road_difference", f"{_difference_title(crossing)} (mm)"),
            *plots,
        ]
    coloured = crossing.rigidity_nm2 is not None and not is_doubtful(crossing)
    columns: list[tuple[rrb.Container | rrb.View, int]] = [
        (_verdict_and_place(root, bridge, coloured=coloured), 5)
    ]
    if crossing.rigidity_nm2 is not None:
        columns.append((_rigidity_layout(root, crossing), 6))
    evidence: list[rrb.Container | rrb.View] = []
    if plots:
        evidence.append(rrb.Vertical(*plots, name="Signals"))
    if crossing.interval_has_meaning and prior_posterior_rows(crossing.parameters):
        evidence.append(_prior_posterior_view(root, crossing))
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
    """Return time, place and verdict of a crossing: a bridge may have many."""
    return f"{when_and_where(crossing)}, {crossing.verdict}"


def when_and_where(crossing: CrossingView | DetectedCrossingView) -> str:
    """Return time, direction and bridge of a crossing."""
    moment = datetime.fromtimestamp(crossing.entry_time_s, UTC)
    way = "→" if crossing.forward else "←"
    return f"{moment:%Y-%m-%d %H:%M} {way} {crossing.bridge}"


def _verdict_and_place(root: str, bridge: BridgeOnMap | None, *, coloured: bool) -> rrb.Container:
    verdict = rrb.TextDocumentView(origin=f"{root}/verdict", name="Verdict")
    places = bridge_places(bridge, root, coloured=coloured)
    return rrb.Vertical(verdict, places, row_shares=[5, 3])


def _overview_layout(bridge: BridgeView, on_map: BridgeOnMap | None) -> rrb.Container:
    """Lay out the figure of the bridge, a summary for a short look, and its position."""
    picture = rrb.Spatial2DView(
        origin=f"{bridge_root(bridge)}/picture",
        name="Stiffness, and all crossings",
        background=(255, 255, 255),
    )
    side = rrb.Vertical(
        rrb.TextDocumentView(origin=f"{bridge_root(bridge)}/finding", name="Finding"),
        bridge_places(on_map, coloured=bridge.estimate is not None and not bridge.is_doubtful),
    )
    name = f"Bridge {bridge.owner_id or bridge.bridge}"
    return rrb.Horizontal(picture, side, column_shares=[5, 2], name=name)


def is_doubtful(crossing: CrossingView) -> bool:
    """Return whether a result must not be relied upon."""
    return crossing.verdict != "good" or not crossing.interval_has_meaning


def _rigidity_layout(root: str, crossing: CrossingView) -> rrb.Container:
    doubt = "DOUBTFUL: " if is_doubtful(crossing) else ""
    along = rrb.Tabs(
        rrb.Spatial2DView(
            origin=f"{root}/strip",
            name=f"{doubt}EI / nominal" if doubt else "EI / nominal, 95 % interval",
            background=STRIP_PAPER,
            visual_bounds=rrb.VisualBounds2D(
                x_range=(-20.0, STRIP_WIDTH + 150.0), y_range=(-20.0, STRIP_HEIGHT + 150.0)
            ),
        ),
        rrb.BarChartView(
            origin=f"{root}/rigidity",
            name=f"{doubt}EI (GN·m²) over m",
            plot_legend=rrb.PlotLegend(visible=False),
        ),
        active_tab=0,
    )
    if deflection_frames(crossing) is None:
        return along
    span = crossing.span_m
    passage = rrb.Spatial2DView(
        origin=f"{root}/passage",
        name=f"{doubt}The bridge under the truck",
        background=STRIP_PAPER,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-0.15 * span, 1.15 * span), y_range=(-0.25 * span, 0.15 * span)
        ),
    )
    return rrb.Vertical(along, passage, row_shares=[5, 3])


def _prior_posterior_view(root: str, crossing: CrossingView) -> rrb.View:
    rows = len(prior_posterior_rows(crossing.parameters))
    return rrb.Spatial2DView(
        origin=f"{root}/learned",
        name="Posterior and prior",
        background=STRIP_PAPER,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-3.6, 4.2),
            y_range=(-2.0 * PRIOR_POSTERIOR_ROW, (rows + 1) * PRIOR_POSTERIOR_ROW),
        ),
    )


def _residuals_view(root: str) -> rrb.View:
    x_range, y_range = RESIDUALS_BOUNDS
    return rrb.Spatial2DView(
        origin=f"{root}/residuals",
        name="Residuals",
        background=STRIP_PAPER,
        visual_bounds=rrb.VisualBounds2D(x_range=x_range, y_range=y_range),
    )


def _passing_layout(
    passing: DetectedCrossingView, channels: Set[str], bridge: BridgeOnMap | None
) -> rrb.Container:
    """Lay out the accelerations of a crossing that was not identified."""
    root = passing_root(passing)
    plots = acceleration_plots(f"{root}/acceleration", channels)
    return rrb.Vertical(
        *plots,
        bridge_places(bridge, root, has_elements=False, coloured=False),
        name=f"{when_and_where(passing)}, not identified",
    )


def _drive_layout(
    channels: Mapping[str, Set[str]], *, has_results: bool, has_about: bool
) -> rrb.Container:
    plots: list[rrb.View] = []
    for vehicle, known in channels.items():
        plots += acceleration_plots(f"vehicle/{vehicle}/acceleration", known, f"{vehicle}:")
        plots.append(_plot(f"vehicle/{vehicle}/speed", f"{vehicle}: Speed (m/s)"))
    places = rrb.Tabs(
        rrb.Spatial2DView(
            origin="plan_of_drive",
            name="Plan of the drive (m, north up)",
            background=STRIP_PAPER,
        ),
        _map("/map/**"),
        active_tab=0,
    )
    side: rrb.Container = places
    if has_about:
        page = rrb.TextDocumentView(origin="about", name="What was recorded")
        side = rrb.Vertical(page, places)
    if not has_results:
        return rrb.Horizontal(side, rrb.Vertical(*plots), column_shares=[2, 3], name="Recording")
    # A drive has no chainage, and Rerun shows one timeline at a time: its plots would be empty.
    pictures = [
        rrb.Spatial2DView(
            origin=drive_picture(vehicle), name=f"{vehicle} over time", background=(255, 255, 255)
        )
        for vehicle in channels
    ]
    signals = rrb.Vertical(*plots, name=f"All samples (timeline {TIME})")
    drawn = rrb.Tabs(*pictures, signals, active_tab=0)
    return rrb.Horizontal(side, drawn, column_shares=[2, 3], name="Whole drive")


def drive_picture(vehicle: str) -> str:
    """Return the entity path of the picture of a truck's whole drive."""
    return f"drive/{vehicle}/picture"


def acceleration_plots(
    origin: str, channels: Set[str], vehicle: str = "", *, window_s: float | None = None
) -> list[rrb.View]:
    """Return plots of body and axles, whose accelerations are ten times larger, for a truck.

    They show all samples, or with `window_s` those within so many seconds before the cursor.
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
    """Return a channel's part of the truck, from its name: the site file is not available."""
    part = channel.partition("_")[0]
    return part if part in ("sprung", "unsprung") else ""


def _plot(
    origin: str,
    name: str,
    only: Sequence[str] | None = None,
    window_s: float | None = None,
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
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )


def bridge_places(
    bridge: BridgeOnMap | None,
    root: str | None = None,
    *,
    has_elements: bool = True,
    coloured: bool,
    name: str | None = None,
) -> rrb.Container | rrb.View:
    """Lay out the plan of a bridge and the map, whose background needs a network.

    With the root of a crossing, truck and elements are those of this crossing. Elements are
    `coloured` if their EI is known.
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
        name=f"Plan (m), {RATIO_LEGEND}" if coloured else "Plan (m)",
        background=STRIP_PAPER,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-PLAN_MARGIN * span, (1.0 + PLAN_MARGIN) * span),
            y_range=(-0.25 * span, 0.4 * span),
        ),
    )
    return rrb.Tabs(view, on_map, active_tab=0, name=name)


def _map(*contents: str, zoom: float | None = None) -> rrb.View:
    return rrb.MapView(origin="/", contents=list(contents), name="Map", zoom=zoom)
