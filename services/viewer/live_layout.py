"""The layout of the live view: positions of trucks, states of crossings, signals, results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import Final

import rerun as rr
import rerun.blueprint as rrb

from services.viewer.live_parts import ROADS_MIDDLE, ROADS_REACH
from services.viewer.panels.place import bridge_places
from services.viewer.panels.signals import acceleration_plots
from services.viewer.rerun_parts import TIME, flat_view
from services.viewer.rerun_places import BridgeOnMap
from services.viewer.strip import STRIP_WIDTH

_WINDOW_S: Final = 60.0
"""Time in s of accelerations before the cursor."""
_LANES_WINDOW_S: Final = 30.0
"""Time in s of the lanes of crossings: the name of a state of three seconds fits."""
_FUSED: Final = "fused EI / nominal"
WAITING = "waiting"
"""Entity of the page shown until the first message."""


def lane_entity(bridge: str, vehicle: str) -> str:
    """Return the entity of the states of a truck's crossings of a bridge."""
    return f"crossings/{_part(bridge)}/{_part(vehicle)}"


def result_root(bridge: str) -> str:
    """Return the entity path of the newest result of a bridge."""
    return f"latest/{_part(bridge)}"


def trend_root(bridge: str) -> str:
    """Return the entity path of the fused states of a bridge over time."""
    return f"fused/{_part(bridge)}"


def waiting_blueprint() -> rrb.Blueprint:
    """Return the layout before the first message."""
    page = rrb.TextDocumentView(origin=WAITING, name="Live")
    return _blueprint(page)


def live_blueprint(
    trucks: Mapping[str, Set[str]], bridges: Sequence[str], on_map: Sequence[BridgeOnMap]
) -> rrb.Blueprint:
    """Return the layout of the drawn trucks and bridges, and of the bridges with a position."""
    upper = [_places(on_map)]
    if trucks:
        upper.append(_tabs([_truck(name, known) for name, known in trucks.items()]))
    left = rrb.Vertical(rrb.Horizontal(*upper), _lanes(), row_shares=[3, 1])
    if not bridges:
        return _blueprint(left)
    results = _tabs([_bridge(name) for name in bridges])
    return _blueprint(rrb.Horizontal(left, results, column_shares=[4 * len(upper), 5]))


def _blueprint(root: rrb.Container | rrb.View) -> rrb.Blueprint:
    return rrb.Blueprint(
        root,
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _places(on_map: Sequence[BridgeOnMap]) -> rrb.Container | rrb.View:
    plans = [bridge_places(bridge, legend=_FUSED, name=bridge.identifier) for bridge in on_map]
    return _tabs(plans) if plans else bridge_places(None, legend="")


def _lanes() -> rrb.View:
    """Lay out the lanes below plan and accelerations, wide enough for the names of states."""
    infinite = rrb.TimeRangeBoundary.infinite()
    shown = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-_LANES_WINDOW_S),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0),
    )
    return rrb.StateTimelineView(
        origin="crossings",
        name="Crossings",
        time_ranges=[rrb.VisibleTimeRange(TIME, start=infinite, end=infinite)],
        time_view=rrb.TimeAxis(view_range=shown),
    )


def _truck(vehicle: str, channels: Set[str]) -> rrb.Container:
    origin = f"vehicle/{vehicle}/acceleration"
    plots = acceleration_plots(origin, channels, f"{vehicle}:", window_s=_WINDOW_S)
    return rrb.Vertical(*plots, name=vehicle)


def _bridge(bridge: str) -> rrb.Container:
    wording = rrb.TextDocumentView(origin=f"newest/{_part(bridge)}", name="Newest result")
    strip = flat_view(
        f"{result_root(bridge)}/strip",
        "EI / nominal along the span, 95 % interval; road",
        (-20.0, STRIP_WIDTH + 150.0),
        (-20.0, ROADS_MIDDLE + ROADS_REACH + 80.0),
    )
    infinite = rrb.TimeRangeBoundary.infinite()
    trend = rrb.TimeSeriesView(
        origin=trend_root(bridge),
        name="Fused EI / nominal over time; white: lowest element",
        axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(start=infinite, end=infinite)),
        axis_y=rrb.ScalarAxis(range=(0.0, 1.6)),
        time_ranges=[rrb.VisibleTimeRange(TIME, start=infinite, end=infinite)],
        plot_legend=rrb.PlotLegend(visible=False),
    )
    return rrb.Vertical(wording, strip, trend, row_shares=[4, 6, 3], name=bridge)


def _tabs(parts: Sequence[rrb.Container | rrb.View]) -> rrb.Container | rrb.View:
    return parts[0] if len(parts) == 1 else rrb.Tabs(*parts, active_tab=0)


def _part(name: str) -> str:
    return rr.escape_entity_path_part(name)
