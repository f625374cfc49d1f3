"""A Rerun recording of a drive: accelerations, the track on the map, and what was found.

Two timelines: `time` (UTC) and `chainage_mm` (front axle, from the start of the bridge). Rerun
draws one timeline at a time, so what belongs to a crossing is there on both. It has no plot of y
over x: the flexural rigidity along the span is a bar chart and a strip drawn as an image.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from schemas.signals import AccelBatch, GnssFix
from schemas.site import Site
from services.common.files import replaced_atomically
from services.drives.signals import series_of_batches
from services.identification.comparison import sentences
from services.viewer.bridge_figure import draw_bridge
from services.viewer.bridge_view import BridgeView
from services.viewer.crossing_view import (
    VEHICLE_COLOURS,
    CrossingView,
    FloatArray,
    summary_line,
)
from services.viewer.drawing import STYLE, figure_bytes
from services.viewer.layout import (
    CHAINAGE,
    TIME,
    blueprint,
    bridge_root,
    crossing_root,
    is_doubtful,
)
from services.viewer.strip import STRIP_HEIGHT, STRIP_TOP_RATIO, STRIP_WIDTH, rigidity_strip
from services.viewer.vehicle_signals import VehicleSignals

APPLICATION = "driveby"

IntArray = NDArray[np.int64]

CHANNEL_COLOURS = {
    "sprung_front": "#56B4E9",
    "sprung_rear": "#E69F00",
    "unsprung_front": VEHICLE_COLOURS["front"],
    "unsprung_rear": VEHICLE_COLOURS["rear"],
}
MUTED = "#9AA5B1"
NEAR_M, M_PER_DEGREE = 20_000.0, 111_000.0  # a bridge and a track that one map can show
WINDOW_S = 1.0  # of accelerations before the entry and after the exit that a crossing shows


class BridgeOnMap(NamedTuple):
    """Where the two ends of a bridge are: (latitude, longitude) in degrees."""

    identifier: str
    start: tuple[float, float]
    end: tuple[float, float]


def write_rrd(
    path: Path,
    *,
    vehicles: Mapping[str, VehicleSignals],
    bridges: Sequence[BridgeOnMap],
    crossings: Sequence[CrossingView],
    overviews: Sequence[BridgeView] = (),
) -> None:
    """Write a Rerun recording with its own layout; an existing file is replaced as a whole.

    `overviews` are the bridges' states with all their crossings, and come first.
    `vehicles` are the signals by vehicle identifier. A crossing's accelerations are looked up in
    the signals of its vehicle; one without any, or with fewer channels, is drawn with what it has.
    """
    default = blueprint(vehicles, crossings, overviews)
    with (
        replaced_atomically(path) as temporary,
        rr.RecordingStream(APPLICATION, recording_id=_recording_id(crossings)) as recording,
    ):
        recording.save(temporary, default_blueprint=default)
        for bridge in bridges_near_tracks(bridges, vehicles.values()):
            _log_bridge(recording, bridge)
        for vehicle, signals in vehicles.items():
            _log_track(recording, vehicle, signals.gnss)
            for channel, (time_ns, samples) in acceleration_series(signals.accel).items():
                entity = f"vehicle/{vehicle}/acceleration/{channel}"
                _log_line(recording, entity, channel.replace("_", " "), CHANNEL_COLOURS[channel])
                _send_scalars(recording, entity, samples, time_ns=time_ns)
        for view in overviews:
            _log_overview(recording, view)
        for crossing in crossings:
            _log_crossing(recording, crossing, vehicles.get(crossing.vehicle))
        recording.flush()


def bridges_of_site(site: Site) -> list[BridgeOnMap]:
    """The bridges of a site file as the map draws them."""
    return [
        BridgeOnMap(
            bridge.id,
            (bridge.start_latitude_deg, bridge.start_longitude_deg),
            (bridge.end_latitude_deg, bridge.end_longitude_deg),
        )
        for bridge in site.bridges
    ]


def bridges_near_tracks(
    bridges: Sequence[BridgeOnMap], vehicles: Iterable[VehicleSignals]
) -> list[BridgeOnMap]:
    """The bridges within about 20 km of where a truck was; all of them if no truck was anywhere.

    The map shows all that is on it: one bridge at the other end of a country, and a track is a dot.
    """
    fixes = [fix for signals in vehicles for fix in signals.gnss]
    if not fixes:
        return list(bridges)
    track = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])
    near = []
    for bridge in bridges:
        north, east = ((track - bridge.start) * M_PER_DEGREE).T
        east = east * np.cos(np.radians(bridge.start[0]))
        if np.hypot(north, east).min() < NEAR_M:
            near.append(bridge)
    return near


def acceleration_series(batches: Sequence[AccelBatch]) -> dict[str, tuple[IntArray, FloatArray]]:
    """Join batches into one series per channel: wall time (ns) and acceleration (m/s²).

    A NaN stands in every gap longer than one and a half samples: a plot then breaks its line there
    instead of drawing an acceleration that nobody measured.
    """
    marked = {}
    for name, (times, samples) in series_of_batches(batches).items():
        rates = (batch.channels[name].rate_hz for batch in batches if name in batch.channels)
        period_ns = 1e9 / min(rates)
        gaps = np.flatnonzero(np.diff(times) > 1.5 * period_ns) + 1
        marked[name] = (
            np.insert(times, gaps, times[gaps - 1] + int(period_ns / 2)),
            np.insert(samples, gaps, np.nan),
        )
    return marked


def front_axle_chainage(crossing: CrossingView, time_s: FloatArray) -> FloatArray:
    """Chainage (m) of the front axle at the crossing's mean speed: for display, not for numbers."""
    travelled = crossing.speed_m_per_s * (time_s - crossing.entry_time_s)
    return travelled if crossing.forward else crossing.span_m - travelled


def _recording_id(crossings: Sequence[CrossingView]) -> str:
    """The same for the same crossings, so that writing anew replaces what a viewer has open."""
    return "_".join(crossing.crossing_id for crossing in crossings) or "drive"


def _log_bridge(recording: rr.RecordingStream, bridge: BridgeOnMap) -> None:
    recording.log(
        f"map/bridge/{bridge.identifier}",
        rr.GeoLineStrings(
            lat_lon=[[bridge.start, bridge.end]],
            radii=rr.Radius.ui_points(7.0),
            colors=[_rgb("#CC79A7")],
        ),
        static=True,
    )


def _log_track(recording: rr.RecordingStream, vehicle: str, fixes: Sequence[GnssFix]) -> None:
    if not fixes:
        return
    positions = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])
    time_ns = np.array([fix.wall_time_ns for fix in fixes])
    recording.log(
        f"map/track/{vehicle}",
        rr.GeoLineStrings(
            lat_lon=[positions], radii=rr.Radius.ui_points(1.0), colors=[_rgb(MUTED)]
        ),
        static=True,
    )
    recording.log(
        f"map/fixes/{vehicle}",
        rr.GeoPoints(lat_lon=positions, radii=rr.Radius.ui_points(2.0), colors=[_rgb(MUTED)]),
        static=True,
    )
    entity = f"map/position/{vehicle}"
    _log_marker(recording, entity)
    recording.send_columns(
        entity, [_time_column(time_ns)], rr.GeoPoints.columns(positions=positions)
    )
    speed = f"vehicle/{vehicle}/speed"
    _log_line(recording, speed, "speed", "#009E73")
    _send_scalars(recording, speed, np.array([fix.speed_m_per_s for fix in fixes]), time_ns=time_ns)


def _log_overview(recording: rr.RecordingStream, bridge: BridgeView) -> None:
    with matplotlib.rc_context(STYLE):
        picture = figure_bytes(draw_bridge(bridge), "png")
    root = bridge_root(bridge)
    image = rr.EncodedImage(contents=picture, media_type="image/png")
    recording.log(f"{root}/picture", image, static=True)
    said = "None of the crossings could be used."
    if bridge.estimate is not None:
        said = " ".join(sentences(bridge.comparison))
    doubt = "**Doubtful: to be looked at, not to be relied upon.** " if bridge.is_doubtful else ""
    text = f"# {bridge.owner_id or bridge.bridge}\n\n{doubt}{said}"
    document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
    recording.log(f"{root}/finding", document, static=True)


def _log_crossing(
    recording: rr.RecordingStream, crossing: CrossingView, signals: VehicleSignals | None
) -> None:
    root = crossing_root(crossing)
    recording.log(
        f"{root}/verdict",
        rr.TextDocument(verdict_markdown(crossing), media_type=rr.MediaType.MARKDOWN),
        static=True,
    )
    _log_rigidity(recording, root, crossing)
    if signals is not None:
        _log_acceleration_on_bridge(recording, root, crossing, signals)
        _log_position_on_bridge(recording, root, crossing, signals)
    if crossing.road is not None:
        _log_road(recording, root, crossing)


def _log_rigidity(recording: rr.RecordingStream, root: str, crossing: CrossingView) -> None:
    if crossing.rigidity_nm2 is None:
        return
    edges = crossing.element_edges_m
    lengths = np.diff(edges)
    recording.log(
        f"{root}/rigidity",
        rr.BarChart(
            crossing.rigidity_nm2 / 1e9,
            abscissa=edges[:-1] + 0.05 * lengths,  # Rerun wants where a bar begins
            widths=0.9 * lengths,
            color=_rgb(MUTED if is_doubtful(crossing) else VEHICLE_COLOURS["front"]),
        ),
        static=True,
    )
    strip = rigidity_strip(crossing, doubtful=is_doubtful(crossing))
    nominal_row = STRIP_HEIGHT * (1.0 - 1.0 / STRIP_TOP_RATIO)
    recording.log(f"{root}/strip/density", rr.Image(strip), static=True)
    recording.log(
        f"{root}/strip/nominal",
        rr.LineStrips2D(
            [[(0.0, nominal_row), (STRIP_WIDTH, nominal_row)]],
            colors=[_rgb(MUTED)],
            radii=rr.Radius.ui_points(0.75),
            labels=["nominal"],
            show_labels=False,
        ),
        static=True,
    )
    across = (edges[:-1] + lengths / 2.0) * STRIP_WIDTH / crossing.span_m
    names = [f"EI_{number}" for number in range(1, len(across) + 1)]
    ratios = [f"{ratio:.3f}" for ratio in crossing.rigidity_nm2 / crossing.nominal_nm2]
    _log_labels(recording, f"{root}/strip/name", names, across, STRIP_HEIGHT + 15.0)
    _log_labels(recording, f"{root}/strip/ratio", ratios, across, STRIP_HEIGHT + 75.0)


def _log_labels(
    recording: rr.RecordingStream, entity: str, labels: list[str], across: FloatArray, down: float
) -> None:
    recording.log(
        entity,
        rr.Points2D(
            np.column_stack((across, np.full(len(across), down))),
            labels=labels,
            show_labels=True,
            radii=0.0,
            colors=[_rgb(MUTED)],
        ),
        static=True,
    )


def _log_acceleration_on_bridge(
    recording: rr.RecordingStream, root: str, crossing: CrossingView, signals: VehicleSignals
) -> None:
    first_ns = round((crossing.entry_time_s - WINDOW_S) * 1e9)
    last_ns = round((crossing.exit_time_s + WINDOW_S) * 1e9)
    for channel, (time_ns, samples) in acceleration_series(signals.accel).items():
        inside = (time_ns >= first_ns) & (time_ns <= last_ns)
        entity = f"{root}/acceleration/{channel}"
        _log_line(recording, entity, channel.replace("_", " "), CHANNEL_COLOURS[channel])
        _send_scalars(
            recording,
            entity,
            samples[inside],
            time_ns=time_ns[inside],
            chainage_m=front_axle_chainage(crossing, time_ns[inside] / 1e9),
        )


def _log_position_on_bridge(
    recording: rr.RecordingStream, root: str, crossing: CrossingView, signals: VehicleSignals
) -> None:
    """The truck on the map when the timeline is the chainage."""
    fixes = [
        fix
        for fix in signals.gnss
        if crossing.entry_time_s - WINDOW_S
        <= fix.wall_time_ns / 1e9
        <= crossing.exit_time_s + WINDOW_S
    ]
    if not fixes:
        return
    entity = f"{root}/position"
    _log_marker(recording, entity)
    time_s = np.array([fix.wall_time_ns / 1e9 for fix in fixes])
    positions = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])
    recording.send_columns(
        entity,
        [_chainage_column(front_axle_chainage(crossing, time_s))],
        rr.GeoPoints.columns(positions=positions),
    )


def _log_marker(recording: rr.RecordingStream, entity: str) -> None:
    look = rr.GeoPoints.from_fields(
        radii=rr.Radius.ui_points(7.0), colors=[_rgb(VEHICLE_COLOURS["front"])]
    )
    recording.log(entity, look, static=True)


def _log_road(recording: rr.RecordingStream, root: str, crossing: CrossingView) -> None:
    road = crossing.road
    if road is None:
        return
    travelled = road.x_m if crossing.forward else crossing.span_m - road.x_m
    time_ns = np.rint((crossing.entry_time_s + travelled / crossing.speed_m_per_s) * 1e9).astype(
        np.int64
    )
    for wheel, height_m in (("front", road.front_m), ("rear", road.rear_m)):
        entity = f"{root}/road/{wheel}"
        # The two lie on one another: the one drawn first is wider, so that both are seen.
        width = 3.5 if wheel == "front" else 1.2
        _log_line(recording, entity, f"{wheel} wheel", VEHICLE_COLOURS[wheel], width=width)
        _send_scalars(recording, entity, height_m * 1e3, time_ns=time_ns, chainage_m=road.x_m)
    entity = f"{root}/road_difference/front_minus_rear"
    _log_line(recording, entity, "front − rear", MUTED)
    _send_scalars(
        recording, entity, (road.front_m - road.rear_m) * 1e3, time_ns=time_ns, chainage_m=road.x_m
    )


def _log_line(
    recording: rr.RecordingStream, entity: str, name: str, colour: str, *, width: float = 1.3
) -> None:
    recording.log(
        entity,
        rr.SeriesLines(
            colors=[_rgb(colour)],
            names=name,
            widths=width,
            # Averaging when zoomed out would hide the peaks of an acceleration.
            aggregation_policy=rr.components.AggregationPolicy.MinMax,
        ),
        static=True,
    )


def _send_scalars(
    recording: rr.RecordingStream,
    entity: str,
    values: FloatArray,
    *,
    time_ns: IntArray,
    chainage_m: FloatArray | None = None,
) -> None:
    if len(values) == 0:
        return
    indexes = [_time_column(time_ns)]
    if chainage_m is not None:
        indexes.append(_chainage_column(chainage_m))
    recording.send_columns(entity, indexes, rr.Scalars.columns(scalars=values))


def _chainage_column(chainage_m: FloatArray) -> rr.TimeColumn:
    return rr.TimeColumn(CHAINAGE, sequence=np.rint(1e3 * chainage_m).astype(np.int64))


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def _time_column(time_ns: IntArray) -> rr.TimeColumn:
    return rr.TimeColumn(TIME, timestamp=time_ns.astype("datetime64[ns]"))


def verdict_markdown(crossing: CrossingView) -> str:
    """The verdict with its reasons and a table of all parameters, as Markdown."""
    lines = [f"# {crossing.verdict.capitalize()}", ""]
    if crossing.verdict == "suspect":
        lines += ["**Doubtful: to be looked at, not to be relied upon.**", ""]
    lines += [summary_line(crossing), ""]
    lines += [f"- {text}" for text in crossing.reason_texts]
    if crossing.rigidity_nm2 is None:
        return "\n".join([*lines, "", "No estimate is given for a rejected crossing."])
    lines += ["", "| | estimate | 95 % interval | ratio to nominal |", "|---|---|---|---|"]
    for index, value in enumerate(crossing.rigidity_nm2):
        interval = "–"
        if crossing.interval_nm2 is not None and crossing.interval_has_meaning:
            low, high = crossing.interval_nm2[index] / 1e9
            interval = f"{low:.3g} … {high:.3g}"
        ratio = value / crossing.nominal_nm2[index]
        lines.append(f"| EI_{index + 1} | {value / 1e9:.4g} GN·m² | {interval} | {ratio:.3f} |")
    others = [row for row in crossing.parameters if not row.name.startswith("EI_")]
    for row in others:
        interval = f"{row.low:.4g} … {row.high:.4g}" if crossing.interval_has_meaning else "–"
        lines.append(f"| {row.name} | {row.mean:.4g} {row.unit} | {interval} | |")
    return "\n".join(lines)
