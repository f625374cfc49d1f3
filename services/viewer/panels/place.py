"""The place of a crossing: elements and truck on a plan without network, and on the map."""

from __future__ import annotations

from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from services.common.geodesy import bridge_frame, to_chainage
from services.viewer.crossing_scene import CrossingScene, Panel
from services.viewer.crossing_view import (
    BESIDE_S,
    CrossingSpan,
    CrossingView,
    front_axle_chainage,
)
from services.viewer.rerun_parts import RATIO_LEGEND, RerunStream, chainage_column, flat_view
from services.viewer.rerun_places import (
    PLAN_MARGIN,
    BridgeOnMap,
    log_bridge,
    log_marker,
    log_track_on_plan,
    log_truck_on_plan,
    plan_root,
)
from services.viewer.vehicle_signals import VehicleSignals


def _layout(scene: CrossingScene, crossing: CrossingView) -> rrb.Container | rrb.View:
    is_coloured = crossing.rigidity_nm2 is not None and not crossing.is_doubtful
    legend = RATIO_LEGEND if is_coloured else ""
    return bridge_places(scene.place if scene.is_mapped else None, scene.root, legend=legend)


def _log(recording: RerunStream, scene: CrossingScene, crossing: CrossingView) -> None:
    if scene.place is not None:
        log_bridge(
            recording,
            scene.place,
            crossing.resolved_ratio,
            doubtful=crossing.is_doubtful,
            map_entity=f"{scene.root}/map",
            plan_entity=f"{scene.root}/plan",
        )
    log_position(recording, scene.root, crossing, scene.signals, scene.place)


PANEL: Final = Panel(lambda scene: scene.crossing, _layout, _log)


def bridge_places(
    bridge: BridgeOnMap | None,
    root: str | None = None,
    *,
    has_elements: bool = True,
    legend: str,
    name: str | None = None,
) -> rrb.Container | rrb.View:
    """Lay out the plan of a bridge and the map, whose background needs a network.

    With the root of a crossing, truck and elements are those of this crossing. The `legend` of
    the elements is part of the title.
    """
    own = [f"/{root}/map"] if root is not None and has_elements else ["/map/bridge/**"]
    own += ["/map/position/**"] if root is None else [f"/{root}/position"]
    on_map = map_view("/map/track/**", "/map/fixes/**", *own, zoom=18.0)
    if bridge is None:
        return on_map
    plan, span = plan_root(bridge.identifier), bridge.span_m
    around = [f"/{plan}/{part}/**" for part in ("bearings", "scale", "north")]
    drawn = [f"/{root}/plan/**"]
    if root is None:
        drawn = [f"/{plan}/{part}/**" for part in ("track", "truck")]
    if root is None or not has_elements:
        drawn.append(f"/{plan}/elements/**")
    view = flat_view(
        "/",
        f"Plan (m), {legend}" if legend else "Plan (m)",
        (-PLAN_MARGIN * span, (1.0 + PLAN_MARGIN) * span),
        (-0.25 * span, 0.4 * span),
        [*around, *drawn],
    )
    return rrb.Tabs(view, on_map, active_tab=0, name=name)


def map_view(*contents: str, zoom: float | None = None) -> rrb.View:
    """Return a map of some entities."""
    return rrb.MapView(origin="/", contents=list(contents), name="Map", zoom=zoom)


def log_position(
    recording: RerunStream,
    root: str,
    crossing: CrossingSpan,
    signals: VehicleSignals | None,
    bridge: BridgeOnMap | None,
) -> None:
    """Log the truck on map and plan, also for the timeline of the chainage."""
    fixes = [
        fix
        for fix in (() if signals is None else signals.gnss)
        if crossing.entry_time_s - BESIDE_S
        <= fix.wall_time_ns / 1e9
        <= crossing.exit_time_s + BESIDE_S
    ]
    if not fixes:
        return
    entity = f"{root}/position"
    log_marker(recording, entity)
    time_ns = np.array([fix.wall_time_ns for fix in fixes])
    chainage = front_axle_chainage(crossing, time_ns / 1e9)
    positions = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])
    recording.send_columns(
        entity, [chainage_column(chainage)], rr.GeoPoints.columns(positions=positions)
    )
    if bridge is not None:
        along, left = to_chainage(bridge_frame(bridge), *positions.T)
        places = np.column_stack((along, -left))
        log_track_on_plan(recording, f"{root}/plan/track", places)
        log_truck_on_plan(recording, f"{root}/plan/truck", places, time_ns, chainage)
