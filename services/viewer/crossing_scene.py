"""A crossing with everything that its panels draw, and the form of a panel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from typing import Generic, NamedTuple, TypeVar

import rerun as rr
import rerun.blueprint as rrb

from services.identification.comparison import Comparison, Estimate
from services.viewer.bridge_view import BridgeView
from services.viewer.crossing_view import CrossingView, comparison_of
from services.viewer.rerun_parts import RerunStream
from services.viewer.rerun_places import BridgeOnMap
from services.viewer.vehicle_signals import VehicleSignals

DataT = TypeVar("DataT")


class CrossingScene(NamedTuple):
    """One crossing, where it was, and what was measured there."""

    crossing: CrossingView
    root: str
    """Entity path of the crossing."""
    compared: Comparison | None
    baseline: Estimate | None = None
    place: BridgeOnMap | None = None
    """Position of the bridge, if it is known."""
    is_mapped: bool = False
    """Whether the plan has the surroundings of the bridge."""
    signals: VehicleSignals | None = None
    channels: Set[str] = frozenset()
    """Accelerometers of the truck in the whole drive."""


class Panel(NamedTuple, Generic[DataT]):
    """A view of a crossing in Rerun: a module of `panels`, and a line in `crossing_tab`."""

    data: Callable[[CrossingScene], DataT | None]
    """Return what the panel shows; with None it is neither laid out nor drawn."""
    layout: Callable[[CrossingScene, DataT], rrb.Container | rrb.View]
    log: Callable[[RerunStream, CrossingScene, DataT], None]


def crossing_root(crossing: CrossingView) -> str:
    """Return the entity path of a crossing."""
    return f"crossing/{rr.escape_entity_path_part(crossing.crossing_id)}/{crossing.method}"


def scenes_of(
    crossings: Sequence[CrossingView],
    vehicles: Mapping[str, VehicleSignals],
    bridges: Sequence[BridgeOnMap],
    mapped: Sequence[BridgeOnMap],
    overviews: Sequence[BridgeView],
) -> list[CrossingScene]:
    """Return the scenes of crossings; the plan has the surroundings of the bridges `mapped`."""
    places = {bridge.identifier: bridge for bridge in bridges}
    channels = {vehicle: signals.channels for vehicle, signals in vehicles.items()}
    baselines = {bridge.bridge: bridge.baseline for bridge in overviews}
    names = {bridge.identifier for bridge in mapped}
    return [
        CrossingScene(
            one,
            crossing_root(one),
            comparison_of(one, baselines.get(one.bridge)),
            baselines.get(one.bridge),
            places.get(one.bridge),
            one.bridge in names,
            vehicles.get(one.vehicle),
            channels.get(one.vehicle, frozenset()),
        )
        for one in crossings
    ]
