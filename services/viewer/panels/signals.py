"""The signals of a crossing: road profiles and accelerations, over time or chainage."""

from __future__ import annotations

from collections.abc import Set
from typing import Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from services.viewer.crossing_scene import CrossingScene, Panel
from services.viewer.crossing_view import (
    BESIDE_S,
    VEHICLE_COLOURS,
    CrossingSpan,
    RoadView,
    front_axle_chainage,
)
from services.viewer.rerun_parts import (
    MUTED,
    RerunStream,
    log_channel,
    log_line,
    log_round_beginning,
    rgb,
    send_scalars,
    series_plot,
)
from services.viewer.vehicle_signals import VehicleSignals, acceleration_series

_ENDS: Final = "ends"
"""Entity of the ends of the bridge, next to the channels of a crossing."""


class _Shown(NamedTuple):
    road: RoadView | None
    channels: Set[str]


def _data(scene: CrossingScene) -> _Shown | None:
    shown = _Shown(scene.crossing.road, scene.channels)
    return shown if shown.road is not None or shown.channels else None


def _layout(scene: CrossingScene, shown: _Shown) -> rrb.Container:
    root, first = scene.root, scene.crossing.first_axle
    plots = acceleration_plots(f"{root}/acceleration", shown.channels)
    if shown.road is not None:
        apart = "Front minus rear" if first == 1 else f"Axle {first} minus axle {first + 1}"
        # Of so low a plot Rerun writes one tick or two: the title has the scale.
        reach_mm = f"± {1e3 * shown.road.largest_m:.1f} mm"
        plots = [
            series_plot(f"{root}/road", f"Road profile ({reach_mm})"),
            series_plot(f"{root}/road_difference", f"{apart} (mm)", has_legend=False),
            *plots,
        ]
    return rrb.Vertical(*plots, name="Signals")


def _log(recording: RerunStream, scene: CrossingScene, shown: _Shown) -> None:
    log_accelerations(recording, scene.root, scene.crossing, scene.signals)
    if shown.road is not None:
        _log_road(recording, scene, shown.road)


PANEL: Final = Panel(_data, _layout, _log)


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
            entities = [*four, *(one for one in own if one not in four), _ENDS]
            title = f"{vehicle} {name} accelerations (m/s²)".strip()
            plots.append(series_plot(origin, title, entities, window_s))
    return plots


def _part(channel: str) -> str:
    """Return a channel's part of the truck, from its name: the site file is not available."""
    part = channel.partition("_")[0]
    return part if part in ("sprung", "unsprung") else ""


def log_accelerations(
    recording: RerunStream, root: str, crossing: CrossingSpan, signals: VehicleSignals | None
) -> None:
    """Log the accelerations of a stay ± 1 s on both timelines; nothing without samples."""
    around_s = (crossing.entry_time_s - 2.0 * BESIDE_S, crossing.exit_time_s + BESIDE_S)
    batches = () if signals is None else signals.accel
    channels = acceleration_series(
        [b for b in batches if around_s[0] * 1e9 <= b.wall_time_ns <= around_s[1] * 1e9]
    )
    first_ns = round((crossing.entry_time_s - BESIDE_S) * 1e9)
    last_ns = round((crossing.exit_time_s + BESIDE_S) * 1e9)
    for channel, (time_ns, samples) in channels.items():
        inside = (time_ns >= first_ns) & (time_ns <= last_ns)
        entity = f"{root}/acceleration/{channel}"
        log_channel(recording, entity, channel)
        send_scalars(
            recording,
            entity,
            samples[inside],
            time_ns=time_ns[inside],
            chainage_m=front_axle_chainage(crossing, time_ns[inside] / 1e9),
        )
    if channels:
        _log_ends(recording, f"{root}/acceleration/{_ENDS}", crossing)


def _log_ends(recording: RerunStream, entity: str, crossing: CrossingSpan) -> None:
    """Log when the first axle came onto the bridge and the last one left it.

    The marks are triangles on the zero line, as a plot has no vertical lines (Rerun 0.41).
    """
    recording.log(
        entity,
        rr.SeriesPoints(
            colors=[rgb(MUTED)],
            markers=["up"],
            marker_sizes=[6.0],
            names="on, off",
        ),
        static=True,
    )
    times_s = np.array([crossing.entry_time_s, crossing.exit_time_s])
    time_ns = np.rint(times_s * 1e9).astype(np.int64)
    chainage_m = front_axle_chainage(crossing, times_s)
    send_scalars(recording, entity, np.zeros(2), time_ns=time_ns, chainage_m=chainage_m)
    shown_m = chainage_m[:, None] + BESIDE_S * crossing.speed_m_per_s * np.array([-1.0, 1.0])
    log_round_beginning(recording, entity, shown_m)


def _log_road(recording: RerunStream, scene: CrossingScene, road: RoadView) -> None:
    root, crossing = scene.root, scene.crossing
    travelled = road.x_m if crossing.forward else crossing.span_m - road.x_m
    time_ns = np.rint((crossing.entry_time_s + travelled / crossing.speed_m_per_s) * 1e9).astype(
        np.int64
    )
    for wheel, height_m in (("front", road.front_m), ("rear", road.rear_m)):
        entity = f"{root}/road/{wheel}"
        # The two lines coincide: the one drawn first is wider, so that both are visible.
        width = 3.5 if wheel == "front" else 1.2
        log_line(recording, entity, crossing.axle_names[wheel], VEHICLE_COLOURS[wheel], width=width)
        send_scalars(recording, entity, height_m * 1e3, time_ns=time_ns, chainage_m=road.x_m)
        log_round_beginning(recording, entity, road.x_m)
    entity = f"{root}/road_difference/front_minus_rear"
    log_line(recording, entity, crossing.difference_name, MUTED)
    send_scalars(
        recording, entity, (road.front_m - road.rear_m) * 1e3, time_ns=time_ns, chainage_m=road.x_m
    )
    log_round_beginning(recording, entity, road.x_m)
