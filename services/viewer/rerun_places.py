"""Positions of bridges and trucks in a Rerun file: on the map, and on a plan without network.

The map's tiles come from the internet. The plan of a bridge has the bridge's own coordinates,
chainage to the right and the left-hand side upwards, both in metres; that of a drive has east to
the right and north upwards.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import rerun as rr

from schemas.signals import GnssFix
from schemas.site import Site
from services.common.arrays import Floats, Ints
from services.common.geodesy import bridge_frame, heading_deg, to_chainage
from services.viewer.crossing_view import VEHICLE_COLOURS
from services.viewer.rerun_parts import (
    LABEL,
    MUTED,
    UNKNOWN,
    RerunStream,
    Rgb,
    columns_of,
    log_labels,
    log_line,
    log_strips,
    ratio_colours,
    rgb,
    send_scalars,
)
from services.viewer.vehicle_signals import VehicleSignals

NEAR_M = 20_000.0
"""Distance in m between a bridge and a track that one map can show."""
M_PER_DEGREE = 111_200.0
"""Mean length of a degree of latitude in m, for drawing only."""
PLAN_MARGIN = 0.3
"""Margin of the plan before and after the bridge, as a share of the span."""
_HALF_WIDTH = 0.02
"""Half width of a bridge in the plan, as a share of the span: its width is unknown."""
_NAME_ABOVE = 0.13
"""Distance of a truck's name from it, as a share of the span."""


class BridgeOnMap(NamedTuple):
    """Position of a bridge."""

    identifier: str
    start_latitude_deg: float
    start_longitude_deg: float
    end_latitude_deg: float
    end_longitude_deg: float
    edges_m: tuple[float, ...]
    """Chainage of the n + 1 ends of its elements."""
    supports_m: tuple[float, ...]

    @property
    def start(self) -> tuple[float, float]:
        """Latitude and longitude of the start."""
        return self.start_latitude_deg, self.start_longitude_deg

    @property
    def end(self) -> tuple[float, float]:
        """Latitude and longitude of the end."""
        return self.end_latitude_deg, self.end_longitude_deg

    @property
    def span_m(self) -> float:
        """Length between the outer bearings, m."""
        return self.edges_m[-1]


def bridges_of_site(site: Site) -> list[BridgeOnMap]:
    """Return the bridges of a site file as drawn on the map."""
    return [
        BridgeOnMap(
            bridge.id,
            bridge.start_latitude_deg,
            bridge.start_longitude_deg,
            bridge.end_latitude_deg,
            bridge.end_longitude_deg,
            (0.0, *np.cumsum(bridge.lengths_m).tolist()),
            (0.0, *bridge.interior_supports_m, bridge.span_m),
        )
        for bridge in site.bridges
    ]


def bridges_near_tracks(
    bridges: Sequence[BridgeOnMap], vehicles: Iterable[VehicleSignals]
) -> list[BridgeOnMap]:
    """Return the bridges within about 20 km of a track; all of them without any track.

    The map shows everything on it: with a bridge at the other end of a country a track is a dot.
    """
    fixes = [fix for signals in vehicles for fix in signals.gnss]
    if not fixes:
        return list(bridges)
    track = _positions(fixes)
    return [
        bridge
        for bridge in bridges
        if np.hypot(*_east_north_m(track, np.array(bridge.start)).T).min() < NEAR_M
    ]


def plan_root(identifier: str) -> str:
    """Return the entity path of the plan of a bridge."""
    return f"plan/{rr.escape_entity_path_part(identifier)}"


def log_bridge(
    recording: RerunStream,
    bridge: BridgeOnMap,
    ratios: Floats | None,
    *,
    doubtful: bool,
    map_entity: str,
    plan_entity: str,
) -> None:
    """Draw the elements of a bridge on map and plan, coloured by their relative EI.

    `ratios` (n,) is None where nothing is known of the bridge, and NaN for an unresolved element.
    """
    count = len(bridge.edges_m) - 1
    colours = ratio_colours(ratios, count, doubtful=doubtful)
    _log_on_map(recording, map_entity, bridge, colours)
    edges, half = np.array(bridge.edges_m), _HALF_WIDTH * bridge.span_m
    recording.log(
        f"{plan_entity}/line",
        rr.LineStrips2D(
            [[(left, 0.0), (right, 0.0)] for left, right in pairwise(edges)],
            colors=colours,
            radii=half,
        ),
        static=True,
    )
    if ratios is not None:
        values = [f"{ratio:.2f}" if np.isfinite(ratio) else "?" for ratio in ratios]
        words = [f"EI_{n} {ratio}" for n, ratio in enumerate(values, start=1)]
        centres = (edges[:-1] + edges[1:]) / 2.0
        # Two rows: elements of a short bridge are narrower than their labels.
        down = half + np.where(np.arange(count) % 2 == 0, 0.0, 0.09 * bridge.span_m)
        log_labels(recording, f"{plan_entity}/name", words, centres, down)


def log_surroundings(
    recording: RerunStream, bridge: BridgeOnMap, vehicles: Mapping[str, VehicleSignals]
) -> None:
    """Draw the bearings, scale, north and tracks on the plan of a bridge."""
    root, span = plan_root(bridge.identifier), bridge.span_m
    frame = bridge_frame(bridge)
    bearings = [[(x, -0.06 * span), (x, 0.06 * span)] for x in bridge.supports_m]
    log_strips(recording, f"{root}/bearings", bearings, [rgb(MUTED)], 1.0)
    length = _round_length(0.3 * span)
    down = 0.29 * span
    recording.log(
        f"{root}/scale",
        rr.LineStrips2D(
            [[(0.0, down), (length, down)]],
            colors=[rgb(LABEL)],
            radii=rr.Radius.ui_points(1.0),
            labels=[f"{length:g} m"],
            show_labels=True,
        ),
        static=True,
    )
    north = np.radians(heading_deg(frame))  # clockwise from north to the right of the plan
    reach = 0.06 * span
    recording.log(
        f"{root}/north",
        rr.Arrows2D(
            origins=[(0.93 * span, down)],
            vectors=[(reach * np.cos(north), -reach * np.sin(north))],
            colors=[rgb(LABEL)],
            radii=rr.Radius.ui_points(1.0),
            labels=["N"],
            show_labels=True,
        ),
        static=True,
    )
    for vehicle, signals in vehicles.items():
        if not signals.gnss:
            continue
        chainage, left = to_chainage(frame, *_positions(signals.gnss).T)
        near = (chainage > -PLAN_MARGIN * span) & (chainage < (1.0 + PLAN_MARGIN) * span)
        near &= np.abs(left) < 0.5 * span
        places = np.column_stack((chainage, -left))
        if near.any():
            log_track_on_plan(recording, f"{root}/track/{vehicle}", places[near])
            time_ns = np.array([fix.wall_time_ns for fix in signals.gnss])[near]
            log_truck_on_plan(recording, f"{root}/truck/{vehicle}", places[near], time_ns)


def log_track_on_plan(recording: RerunStream, entity: str, places_m: Floats) -> None:
    """Draw all positions of a truck (f, 2), in the plan's coordinates."""
    recording.log(
        entity,
        rr.Points2D(
            places_m,
            radii=rr.Radius.ui_points(1.5),
            colors=[rgb(MUTED)],
            draw_order=10.0,  # below the elements, which have 20: many runs cover the plan
        ),
        static=True,
    )


def log_truck_on_plan(
    recording: RerunStream,
    entity: str,
    places_m: Floats,
    time_ns: Ints,
    chainage_m: Floats | None = None,
) -> None:
    """Draw the positions of the truck (f, 2) over time, in the plan's coordinates."""
    log_truck_style(recording, entity)
    send_places(recording, entity, places_m, time_ns, chainage_m)


def log_truck_style(recording: RerunStream, entity: str, name: str | None = None) -> None:
    """Define the style of a truck on a plan, and of its name, if there may be others.

    The name is a point of its own: Rerun writes below a point, where the bridge is.
    """
    colours = [rgb(VEHICLE_COLOURS["rear"])]
    style = rr.Points2D.from_fields(radii=rr.Radius.ui_points(6.0), colors=colours)
    recording.log(entity, style, static=True)
    if name is not None:
        label = rr.Points2D.from_fields(radii=0.0, colors=colours, labels=[name], show_labels=True)
        recording.log(f"{entity}/name", label, static=True)


def send_places(
    recording: RerunStream,
    entity: str,
    places_m: Floats,
    time_ns: Ints,
    chainage_m: Floats | None = None,
) -> None:
    """Log positions on a plan (f, 2) over time."""
    recording.send_columns(
        entity, columns_of(time_ns, chainage_m), rr.Points2D.columns(positions=places_m)
    )


def send_named_places(
    recording: RerunStream, entity: str, places_m: Floats, time_ns: Ints, span_m: float
) -> None:
    """Log positions of a truck on the plan of a bridge (f, 2), and of its name above them."""
    send_places(recording, entity, places_m, time_ns)
    send_places(recording, f"{entity}/name", places_m - [0.0, _NAME_ABOVE * span_m], time_ns)


def log_vehicle(recording: RerunStream, vehicle: str, fixes: Sequence[GnssFix]) -> None:
    """Log the track of a truck on the map, its position over time and its speed."""
    if not fixes:
        return
    positions = _positions(fixes)
    time_ns = np.array([fix.wall_time_ns for fix in fixes])
    recording.log(
        f"map/track/{vehicle}",
        rr.GeoLineStrings(lat_lon=[positions], radii=rr.Radius.ui_points(1.0), colors=[rgb(MUTED)]),
        static=True,
    )
    recording.log(
        f"map/fixes/{vehicle}",
        rr.GeoPoints(lat_lon=positions, radii=rr.Radius.ui_points(2.0), colors=[rgb(MUTED)]),
        static=True,
    )
    entity = f"map/position/{vehicle}"
    log_marker(recording, entity)
    columns = rr.GeoPoints.columns(positions=positions)
    recording.send_columns(entity, columns_of(time_ns, None), columns)
    speed = f"vehicle/{vehicle}/speed"
    log_line(recording, speed, "speed", "#009E73")
    send_scalars(recording, speed, np.array([fix.speed_m_per_s for fix in fixes]), time_ns=time_ns)


def log_drive_plan(
    recording: RerunStream,
    bridges: Sequence[BridgeOnMap],
    vehicles: Mapping[str, VehicleSignals],
) -> None:
    """Draw all tracks and the bridges near them, east to the right and north upwards."""
    tracks = {name: _positions(signals.gnss) for name, signals in vehicles.items() if signals.gnss}
    if not tracks:
        return
    middle = np.concatenate(list(tracks.values())).mean(axis=0)

    def on_plan(lat_lon: Floats) -> Floats:
        return _east_north_m(lat_lon, middle) * (1.0, -1.0)

    for name, track in tracks.items():
        places = on_plan(track)
        log_track_on_plan(recording, f"plan_of_drive/track/{name}", places)
        time_ns = np.array([fix.wall_time_ns for fix in vehicles[name].gnss])
        log_truck_on_plan(recording, f"plan_of_drive/truck/{name}", places, time_ns)
    if bridges:
        ends = [on_plan(np.array((bridge.start, bridge.end))) for bridge in bridges]
        recording.log(
            "plan_of_drive/bridges",
            rr.LineStrips2D(
                ends,
                colors=[rgb(UNKNOWN)],
                radii=rr.Radius.ui_points(5.0),
                labels=[bridge.identifier for bridge in bridges],
                show_labels=True,
            ),
            static=True,
        )


def log_marker(recording: RerunStream, entity: str) -> None:
    """Define the style of a truck on the map."""
    style = rr.GeoPoints.from_fields(
        radii=rr.Radius.ui_points(7.0), colors=[rgb(VEHICLE_COLOURS["front"])]
    )
    recording.log(entity, style, static=True)


def _log_on_map(
    recording: RerunStream, entity: str, bridge: BridgeOnMap, colours: list[Rgb]
) -> None:
    start, end = np.array(bridge.start), np.array(bridge.end)
    share = np.array(bridge.edges_m) / bridge.span_m
    edges = start + share[:, None] * (end - start)
    recording.log(
        entity,
        rr.GeoLineStrings(
            lat_lon=[[a, b] for a, b in pairwise(edges)],
            radii=rr.Radius.ui_points(7.0),
            colors=colours,
        ),
        static=True,
    )


def _positions(fixes: Sequence[GnssFix]) -> Floats:
    return np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])


def _east_north_m(lat_lon: Floats, origin: Floats) -> Floats:
    """Return metres (m, 2) to the east and to the north of the origin."""
    north, east = ((lat_lon - origin) * M_PER_DEGREE).T
    return np.column_stack((east * np.cos(np.radians(origin[0])), north))


def _round_length(length: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, … m that is not longer."""
    decade = 10.0 ** np.floor(np.log10(length))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * decade <= length) * decade)
