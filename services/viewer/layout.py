"""The layout of a Rerun file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set

import rerun as rr
import rerun.blueprint as rrb

from services.viewer.bridge_view import BridgeView
from services.viewer.crossing_scene import CrossingScene
from services.viewer.crossing_tab import crossing_layout, when_and_where
from services.viewer.crossing_view import CrossingView, DetectedCrossingView
from services.viewer.panels.place import bridge_places, map_view
from services.viewer.panels.signals import acceleration_plots
from services.viewer.rerun_parts import CHAINAGE, RATIO_LEGEND, TIME, series_plot
from services.viewer.rerun_places import BridgeOnMap
from services.viewer.strip import STRIP_PAPER
from services.viewer.vehicle_signals import VehicleSignals

_LEAST_SPEED_M_PER_S = 1.0
"""Lowest speed at which a crossing is played: a truck may have stopped on the bridge."""


def bridge_root(bridge: BridgeView) -> str:
    """Return the entity path of a bridge."""
    return f"bridge/{rr.escape_entity_path_part(bridge.bridge)}"


def passing_root(passing: DetectedCrossingView) -> str:
    """Return the entity path of a crossing that was not identified."""
    return f"passing/{passing.bridge}/{passing.vehicle}/{round(1e3 * passing.entry_time_s)}"


def blueprint(
    vehicles: Mapping[str, VehicleSignals],
    crossings: Sequence[CrossingScene],
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
    channels = {vehicle: signals.channels for vehicle, signals in vehicles.items()}
    found: list[rrb.Container] = [_overview_layout(b, on_map.get(b.bridge)) for b in overviews]
    found += map(crossing_layout, crossings)
    seen = [
        _passing_layout(one, channels.get(one.vehicle, set()), on_map.get(one.bridge))
        for one in passings
    ]
    drive = _drive_layout(channels, has_results=bool(found), has_about=about is not None)
    tabs = [*found, drive, *seen] if found else [drive, *seen]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        _time_panel([scene.crossing for scene in crossings], has_results=bool(found)),
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


def _overview_layout(bridge: BridgeView, on_map: BridgeOnMap | None) -> rrb.Container:
    """Lay out the figure of the bridge, a summary for a short look, and its position."""
    picture = rrb.Spatial2DView(
        origin=f"{bridge_root(bridge)}/picture",
        name="Stiffness, and all crossings",
        background=(255, 255, 255),
    )
    is_coloured = bridge.estimate is not None and not bridge.is_doubtful
    side = rrb.Vertical(
        rrb.TextDocumentView(origin=f"{bridge_root(bridge)}/finding", name="Finding"),
        bridge_places(on_map, legend=RATIO_LEGEND if is_coloured else ""),
    )
    name = f"Bridge {bridge.owner_id or bridge.bridge}"
    return rrb.Horizontal(picture, side, column_shares=[5, 2], name=name)


def _passing_layout(
    passing: DetectedCrossingView, channels: Set[str], bridge: BridgeOnMap | None
) -> rrb.Container:
    """Lay out the accelerations of a crossing that was not identified."""
    root = passing_root(passing)
    plots = acceleration_plots(f"{root}/acceleration", channels)
    return rrb.Vertical(
        *plots,
        bridge_places(bridge, root, has_elements=False, legend=""),
        name=f"{when_and_where(passing)}, not identified",
    )


def _drive_layout(
    channels: Mapping[str, Set[str]], *, has_results: bool, has_about: bool
) -> rrb.Container:
    plots: list[rrb.View] = []
    for vehicle, known in channels.items():
        plots += acceleration_plots(f"vehicle/{vehicle}/acceleration", known, f"{vehicle}:")
        plots.append(series_plot(f"vehicle/{vehicle}/speed", f"{vehicle}: Speed (m/s)"))
    places = rrb.Tabs(
        rrb.Spatial2DView(
            origin="plan_of_drive",
            name="Plan of the drive (m, north up)",
            background=STRIP_PAPER,
        ),
        map_view("/map/**"),
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
