"""One crossing in a Rerun file: result, evidence, uncertainty.

Rerun has no plot of y over x: data along the span are drawn as lines and pictures.
Longer than other modules, because each of its many views is a dozen lines, and no other room uses
any of them.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr

from services.common.geodesy import bridge_frame, to_chainage
from services.identification.comparison import Comparison, Estimate
from services.viewer.crossing_view import (
    VEHICLE_COLOURS,
    CrossingSpan,
    CrossingView,
    FloatArray,
    comparison_of,
    describe_crossing,
    summary_line,
)
from services.viewer.deflection import DeflectionFrames, deflection_frames
from services.viewer.layout import ENDS, PRIOR_POSTERIOR_ROW, crossing_root, is_doubtful
from services.viewer.prior_posterior import PriorPosterior, prior_posterior_rows
from services.viewer.rerun_parts import (
    BASELINE,
    MUTED,
    WEAK,
    IntArray,
    RerunStream,
    chainage_column,
    columns_of,
    log_channel,
    log_labels,
    log_line,
    log_markdown,
    log_round_beginning,
    ratio_colours,
    rgb,
    send_scalars,
)
from services.viewer.rerun_places import (
    BridgeOnMap,
    log_bridge,
    log_marker,
    log_track_on_plan,
    log_truck_on_plan,
)
from services.viewer.rerun_residuals import log_residuals
from services.viewer.strip import (
    STRIP_HEIGHT,
    STRIP_WIDTH,
    rigidity_strip,
    strip_row,
    strip_top,
)
from services.viewer.vehicle_signals import VehicleSignals

Channels = Mapping[str, tuple[IntArray, FloatArray]]
"""Wall time (ns) and acceleration (m/s²) of each accelerometer of a truck."""

WINDOW_S = 1.0  # of accelerations before the entry and after the exit that a crossing shows
_BENT_SHARE = 0.06
"""Height of the largest deflection in the drawing, as a share of the span."""


def log_crossing(
    recording: RerunStream,
    crossing: CrossingView,
    bridge: BridgeOnMap | None,
    signals: VehicleSignals | None,
    channels: Channels,
    baseline: Estimate | None = None,
) -> None:
    """Log everything of one crossing below its root; `bridge` is its position, if known."""
    root = crossing_root(crossing)
    compared = comparison_of(crossing, baseline)
    log_markdown(recording, f"{root}/verdict", verdict_markdown(crossing, compared))
    log_rigidity(recording, root, crossing, compared, baseline)
    _log_prior_posterior(recording, root, crossing, compared)
    log_residuals(recording, root, crossing)
    passage = deflection_frames(crossing)
    if passage is not None:
        _log_passage(recording, root, crossing, passage)
    if bridge is not None:
        log_bridge(
            recording,
            bridge,
            crossing.resolved_ratio,
            doubtful=is_doubtful(crossing),
            map_entity=f"{root}/map",
            plan_entity=f"{root}/plan",
        )
    log_acceleration(recording, root, crossing, channels)
    if signals is not None:
        log_position(recording, root, crossing, signals, bridge)
    if crossing.road is not None:
        _log_road(recording, root, crossing)


def front_axle_chainage(crossing: CrossingSpan, time_s: FloatArray) -> FloatArray:
    """Return the front axle's chainage (n,), m, at the mean speed: for display only."""
    travelled = crossing.speed_m_per_s * (time_s - crossing.entry_time_s)
    return travelled if crossing.forward else crossing.span_m - travelled


def log_acceleration(
    recording: RerunStream, root: str, crossing: CrossingSpan, channels: Channels
) -> None:
    """Log the accelerations of a stay ± 1 s on both timelines; nothing without samples."""
    first_ns = round((crossing.entry_time_s - WINDOW_S) * 1e9)
    last_ns = round((crossing.exit_time_s + WINDOW_S) * 1e9)
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
        _log_ends(recording, f"{root}/acceleration/{ENDS}", crossing)


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
    shown_m = chainage_m[:, None] + WINDOW_S * crossing.speed_m_per_s * np.array([-1.0, 1.0])
    log_round_beginning(recording, entity, shown_m)


def log_position(
    recording: RerunStream,
    root: str,
    crossing: CrossingSpan,
    signals: VehicleSignals,
    bridge: BridgeOnMap | None,
) -> None:
    """Log the truck on map and plan, also for the timeline of the chainage."""
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


def log_rigidity(
    recording: RerunStream,
    root: str,
    crossing: CrossingView,
    compared: Comparison | None,
    baseline: Estimate | None,
) -> None:
    """Log EI of each element as bars, and as a strip along the span; nothing if rejected."""
    if crossing.rigidity_nm2 is None:
        return
    edges = crossing.element_edges_m
    lengths = np.diff(edges)
    doubtful = is_doubtful(crossing)
    recording.log(
        f"{root}/rigidity",
        rr.BarChart(
            crossing.rigidity_nm2 / 1e9,
            abscissa=edges[:-1] + 0.05 * lengths,  # Rerun expects the beginning of a bar
            widths=0.9 * lengths,
            color=rgb(MUTED if doubtful else VEHICLE_COLOURS["front"]),
        ),
        static=True,
    )
    weak = () if compared is None or doubtful else compared.weak
    top = strip_top(crossing)
    strip = rigidity_strip(crossing, doubtful=doubtful, weak={one.number for one in weak})
    # A picture in a file format is not drawn at all while the chainage is negative (Rerun 0.41).
    recording.log(f"{root}/strip/density", rr.Image(strip), static=True)
    nominal = strip_row(np.ones(lengths.size), top)
    _log_level(recording, f"{root}/strip/nominal", edges, nominal, "nominal", MUTED)
    if baseline is not None and baseline.mean.size == lengths.size:
        stored = strip_row(baseline.mean / crossing.nominal_nm2, top)
        _log_level(recording, f"{root}/strip/baseline", edges, stored, "baseline", BASELINE)
    across = (edges[:-1] + lengths / 2.0) * STRIP_WIDTH / crossing.span_m
    ratio = crossing.rigidity_nm2 / crossing.nominal_nm2
    highest = ratio
    if crossing.interval_nm2 is not None and crossing.interval_has_meaning:
        low, highest = crossing.interval_nm2.T / crossing.nominal_nm2
        tips = 0.12 * lengths * STRIP_WIDTH / crossing.span_m
        _log_whiskers(recording, f"{root}/strip/interval", across, tips, (low, highest), top)
    names = [f"EI_{number}" for number in range(1, len(across) + 1)]
    ratios = [f"{value:.3f}" for value in ratio]
    down = np.full(len(across), STRIP_HEIGHT + 15.0)
    log_labels(recording, f"{root}/strip/name", names, across, down)
    log_labels(recording, f"{root}/strip/ratio", ratios, across, down + 60.0)
    if weak:
        where = [element.number - 1 for element in weak]
        less = [f"{100.0 * (1.0 - element.ratio):.0f} % less" for element in weak]
        over = strip_row(highest[where], top) - 70.0
        log_labels(recording, f"{root}/strip/weak", less, across[where], over, colour=WEAK)


def _log_whiskers(
    recording: RerunStream,
    entity: str,
    across: FloatArray,
    tips: FloatArray,
    limits: tuple[FloatArray, FloatArray],
    top: float,
) -> None:
    """Draw intervals; one that exceeds the strip has no bar at that end."""
    low, high = limits
    rows = np.stack((strip_row(low, top), strip_row(high, top)), axis=1)
    strips = [[(x, bottom), (x, end)] for x, (bottom, end) in zip(across, rows, strict=True)]
    for limit, row in zip(limits, rows.T, strict=True):
        inside = limit <= top
        ends = zip(across[inside], tips[inside], row[inside], strict=True)
        strips += [[(x - tip, y), (x + tip, y)] for x, tip, y in ends]
    recording.log(
        entity,
        rr.LineStrips2D(strips, colors=[(255, 255, 255)], radii=rr.Radius.ui_points(1.0)),
        static=True,
    )


def _log_level(
    recording: RerunStream,
    entity: str,
    edges_m: FloatArray,
    rows: FloatArray,
    name: str,
    colour: str,
) -> None:
    """Draw a line across the strip, at a height for each element."""
    x = np.repeat(edges_m, 2)[1:-1] * STRIP_WIDTH / edges_m[-1]
    recording.log(
        entity,
        rr.LineStrips2D(
            [np.column_stack((x, np.repeat(rows, 2)))],
            colors=[rgb(colour)],
            radii=rr.Radius.ui_points(0.75),
        ),
        static=True,
    )
    beside, last = np.array([STRIP_WIDTH + 80.0]), rows[-1:] - 25.0  # it stands below its place
    log_labels(recording, f"{entity}/name", [name], beside, last, colour=colour)


def _log_prior_posterior(
    recording: RerunStream, root: str, crossing: CrossingView, compared: Comparison | None
) -> None:
    """Draw a line for each parameter: its prior, wide and grey, and its posterior on top."""
    rows = prior_posterior_rows(crossing.parameters) if crossing.interval_has_meaning else []
    if not rows:
        return
    weak = set() if compared is None else {f"EI_{element.number}" for element in compared.weak}
    doubtful = is_doubtful(crossing)

    def colour(row: PriorPosterior) -> tuple[int, int, int]:
        plain = WEAK if row.name in weak else "#56B4E9"
        return rgb("#d5d9dd" if doubtful else plain)

    down: FloatArray = PRIOR_POSTERIOR_ROW * np.arange(len(rows), dtype=np.float64)
    recording.log(
        f"{root}/learned/prior",
        rr.LineStrips2D(
            [[(row.prior[0], y), (row.prior[1], y)] for row, y in zip(rows, down, strict=True)],
            colors=[rgb("#3a4148")],
            radii=rr.Radius.ui_points(5.0),
        ),
        static=True,
    )
    recording.log(
        f"{root}/learned/interval",
        rr.LineStrips2D(
            [[(row.low, y), (row.high, y)] for row, y in zip(rows, down, strict=True)],
            colors=[colour(row) for row in rows],
            radii=rr.Radius.ui_points(2.0),
        ),
        static=True,
    )
    recording.log(
        f"{root}/learned/estimate",
        rr.Points2D(
            [(row.estimate, y) for row, y in zip(rows, down, strict=True)],
            colors=[colour(row) for row in rows],
            radii=rr.Radius.ui_points(3.5),
        ),
        static=True,
    )
    ends = (down[0] - 0.2, down[-1] + 0.2)
    recording.log(
        f"{root}/learned/nominal",
        rr.LineStrips2D(
            [[(0.0, ends[0]), (0.0, ends[1])]],
            colors=[rgb(MUTED)],
            radii=rr.Radius.ui_points(0.5),
        ),
        static=True,
    )
    up = down - 0.2  # a label is drawn below its point
    names = [row.name for row in rows]
    log_labels(recording, f"{root}/learned/name", names, np.full(len(rows), -2.9), up)
    shares = [f"{100.0 * row.share:.2g} % of prior" for row in rows]
    log_labels(recording, f"{root}/learned/share", shares, np.full(len(rows), 3.3), up)


def _log_passage(
    recording: RerunStream, root: str, crossing: CrossingView, passage: DeflectionFrames
) -> None:
    """Draw the truck on the deflected bridge, a picture for each position of the front axle."""
    assert crossing.rigidity_nm2 is not None  # noqa: S101 - otherwise there are no frames
    span = crossing.span_m
    enlarged = _BENT_SHARE * span / max(passage.largest_m, 1e-9)
    chainage = passage.front_m
    travelled = chainage if crossing.forward else span - chainage
    time_s = crossing.entry_time_s + travelled / crossing.speed_m_per_s
    columns = columns_of(np.rint(time_s * 1e9).astype(np.int64), chainage)
    entity = f"{root}/passage"
    _log_scene(recording, entity, crossing, passage, enlarged)
    count = crossing.nominal_nm2.size
    colours = ratio_colours(crossing.resolved_ratio, count, doubtful=is_doubtful(crossing))
    ends = [int(np.flatnonzero(passage.element == n)[0]) for n in range(count)]
    ends.append(passage.x_m.size - 1)
    for n, colour in enumerate(colours):
        piece = slice(ends[n], ends[n + 1] + 1)
        x = passage.x_m[piece]
        strips = [[np.column_stack((x, -enlarged * bent[piece]))] for bent in passage.deflection_m]
        element = f"{entity}/bridge/EI_{n + 1}"
        style = rr.LineStrips2D.from_fields(colors=[colour], radii=rr.Radius.ui_points(3.0))
        recording.log(element, style, static=True)
        recording.send_columns(
            element, columns, rr.LineStrips2D.columns(strips=[s[0] for s in strips])
        )
    wheel = 0.012 * span
    axles = np.column_stack((passage.front_m, passage.rear_m))
    hubs = np.stack((axles, -enlarged * passage.under_axles_m - wheel), axis=2)  # (f, 2, 2)
    recording.log(
        f"{entity}/wheels",
        rr.Points2D.from_fields(colors=[rgb("#E8EAED")], radii=wheel),
        static=True,
    )
    recording.send_columns(
        f"{entity}/wheels",
        columns,
        rr.Points2D.columns(positions=hubs.reshape(-1, 2)).partition(np.full(len(hubs), 2)),
    )
    body = [_body(front, rear, wheel) for front, rear in hubs]
    recording.log(
        f"{entity}/truck",
        rr.LineStrips2D.from_fields(colors=[rgb("#E8EAED")], radii=rr.Radius.ui_points(1.5)),
        static=True,
    )
    recording.send_columns(f"{entity}/truck", columns, rr.LineStrips2D.columns(strips=body))


def _body(front: FloatArray, rear: FloatArray, wheel: float) -> FloatArray:
    """Return the outline of a two-axle truck, closed, with the cab over the front axle."""
    along = front - rear
    up = np.array([0.0, -wheel])

    def at(share: float, high: float) -> FloatArray:
        return np.asarray(rear + share * along + high * up)

    outline = (-0.25, 1.5), (-0.25, 4.0), (0.72, 4.0), (0.72, 5.5), (1.1, 5.5), (1.2, 3.5)
    return np.array([at(*corner) for corner in (*outline, (1.2, 1.5), outline[0])])


def _log_scene(
    recording: RerunStream,
    entity: str,
    crossing: CrossingView,
    passage: DeflectionFrames,
    enlarged: float,
) -> None:
    """Draw the static parts: undeflected line, road on both sides, bearings, scale."""
    span = crossing.span_m
    supports = (0.0, *crossing.interior_supports_m, span)
    side = 0.025 * span
    recording.log(
        f"{entity}/still",
        rr.LineStrips2D(
            [
                [(-0.1 * span, 0.0), (0.0, 0.0)],
                [(span, 0.0), (1.1 * span, 0.0)],
                *(
                    [(x, 0.0), (x - side, 2 * side), (x + side, 2 * side), (x, 0.0)]
                    for x in supports
                ),
            ],
            colors=[rgb(MUTED)],
            radii=rr.Radius.ui_points(1.0),
        ),
        static=True,
    )
    recording.log(
        f"{entity}/unbent",
        rr.LineStrips2D(
            [[(0.0, 0.0), (span, 0.0)]], colors=[rgb("#4a525a")], radii=rr.Radius.ui_points(0.5)
        ),
        static=True,
    )
    text = f"at most {1e3 * passage.largest_m:.2g} mm, drawn {enlarged:.0f} times larger"
    log_labels(recording, f"{entity}/scale", [text], np.array([span / 2]), np.array([0.085 * span]))


def _log_road(recording: RerunStream, root: str, crossing: CrossingView) -> None:
    road = crossing.road
    if road is None:
        return
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


def verdict_markdown(crossing: CrossingView, compared: Comparison | None = None) -> str:
    """Return verdict, reasons, result and a table of all parameters, as Markdown."""
    lines = [f"# {crossing.verdict.capitalize()}", ""]
    if crossing.verdict == "suspect":
        lines += ["**Doubtful. Do not rely on these values.**", ""]
    lines += [summary_line(crossing), ""]
    lines += [f"- {text}" for text in crossing.reason_texts]
    if crossing.rigidity_nm2 is None:
        return "\n".join([*lines, "", "No estimate is given for a rejected crossing."])
    wording = describe_crossing(crossing, compared)
    if wording:
        lines += ["", " ".join(wording)]
    lines += ["", "| | estimate | 95 % interval | ratio |", "|---|---|---|---|"]
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
