"""Parts of the live view: time stamps, decimation of samples, roads, trends, texts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr

from schemas.alarms import Alarm
from schemas.results import CrossingResult, lowest_element
from schemas.site import Site
from services.common.arrays import Floats, Ints
from services.common.geodesy import BridgeFrame, bridge_frame
from services.identification.comparison import Estimate
from services.viewer.crossing_view import VEHICLE_COLOURS, CrossingView, ElementGeometry
from services.viewer.rerun_parts import MUTED, TIME, log_labels, log_line, rgb
from services.viewer.rerun_places import M_PER_DEGREE, BridgeOnMap, bridges_of_site
from services.viewer.strip import STRIP_HEIGHT, STRIP_WIDTH

PERIOD_S: Final = 0.02
"""Interval in s of which the smallest and the largest acceleration are drawn."""
ROADS_MIDDLE: Final = STRIP_HEIGHT + 330.0
"""Distance of the roads from the strip's top in pixels; they reach `ROADS_REACH` from there."""
ROADS_REACH: Final = 120.0
_QUALITY: Final = 95
_MAX_ALARMS: Final = 1000
_LOWEST: Final = "#FFFFFF"
"""Colour of the lowest element, which every bridge has: not that of a weak one."""
_NEAR_M: Final = 2_000.0
"""Distance in m up to which a truck is on a bridge's plan."""
NO_RESULT: Final = "No result yet. Results appear seconds after a truck leaves the bridge."


class SiteBridge(NamedTuple):
    """A bridge of the site file."""

    on_map: BridgeOnMap
    elements: ElementGeometry
    frame: BridgeFrame


def of_site(site: Site | None) -> dict[str, SiteBridge]:
    """Return the bridges of a site file by name; none without one."""
    if site is None:
        return {}
    return {
        bridge.id: SiteBridge(on_map, bridge, bridge_frame(bridge))
        for bridge, on_map in zip(site.bridges, bridges_of_site(site), strict=True)
    }


def bridges_near(names: Iterable[str], starts: Floats, places: Floats) -> list[str]:
    """Return the bridges, at `starts` (n, 2), near the last of the positions (m, 2)."""
    if not starts.size:
        return []
    north, east = ((starts - places[-1]) * M_PER_DEGREE).T
    apart_m = np.hypot(north, east * np.cos(np.radians(places[-1, 0])))
    return [name for name, is_near in zip(names, apart_m < _NEAR_M, strict=True) if is_near]


class TimestampedStream:
    """A recording that logs everything at one time, also entities that files log as static."""

    def __init__(self, recording: rr.RecordingStream, time_ns: int) -> None:
        self._recording = recording
        self._time = np.datetime64(time_ns, "ns")

    def log(self, entity_path: str, entity: Any, *, static: bool = False) -> None:
        """Log one entity; compress a picture, as the server keeps it for later viewers."""
        self._recording.set_time(TIME, timestamp=self._time)
        kept = entity.compress(jpeg_quality=_QUALITY) if isinstance(entity, rr.Image) else entity
        self._recording.log(entity_path, kept)

    def send_columns(
        self, entity_path: str, indexes: Iterable[Any], columns: Iterable[Any]
    ) -> None:
        """Log a series, which has its own times."""
        self._recording.send_columns(entity_path, indexes, columns)


def extremes(time_ns: Ints, samples: Floats, rate_hz: float) -> tuple[Ints, Floats]:
    """Return the smallest and largest sample of every `PERIOD_S` with their times, (≤ 2n/k,).

    A NaN, which breaks a line, stays.
    """
    size = max(1, round(PERIOD_S * rate_hz))
    if size < 3:
        return time_ns, samples
    count = -(-samples.size // size)
    filled = np.append(samples, np.full(count * size - samples.size, samples[-1]))
    rows = filled.reshape(count, size)
    first = np.arange(count) * size
    chosen = np.concatenate((first + rows.argmin(axis=1), first + rows.argmax(axis=1)))
    kept = np.unique(np.minimum(chosen, samples.size - 1))
    return time_ns[kept], samples[kept]


def log_roads(stream: TimestampedStream, root: str, crossing: CrossingView) -> None:
    """Draw the road profile of each wheel below the strip, on its scale along the span."""
    road = crossing.road
    if road is None:
        return
    largest_m = max(road.largest_m, 1e-6)
    across = road.x_m * STRIP_WIDTH / crossing.span_m
    entity = f"{root}/strip/road"
    ends = [[(0.0, ROADS_MIDDLE), (float(STRIP_WIDTH), ROADS_MIDDLE)]]
    thin = rr.Radius.ui_points(0.5)
    stream.log(f"{entity}/level", rr.LineStrips2D(ends, colors=[rgb(MUTED)], radii=thin))
    # The two lines coincide: the one drawn first is wider, so that both are visible.
    for wheel, height_m, width in (("front", road.front_m, 2.0), ("rear", road.rear_m, 0.75)):
        down = ROADS_MIDDLE - ROADS_REACH * height_m / largest_m
        line = rr.LineStrips2D(
            [np.column_stack((across, down))],
            colors=[rgb(VEHICLE_COLOURS[wheel])],
            radii=rr.Radius.ui_points(width),
            draw_order=1.0 if wheel == "front" else 2.0,
        )
        stream.log(f"{entity}/{wheel}", line)
    names = crossing.axle_names
    under = "both wheels" if crossing.first_axle == 1 else f"{names['front']} and {names['rear']}"
    apart_mm = 1e3 * float(np.sqrt(np.mean((road.front_m - road.rear_m) ** 2)))
    label = f"road under {under}, ± {1e3 * largest_m:.1f} mm, difference {apart_mm:.2g} mm (RMS)"
    place = np.array([STRIP_WIDTH / 2.0]), np.array([ROADS_MIDDLE + ROADS_REACH + 5.0])
    log_labels(stream, f"{entity}/name", [label], *place)


def log_trend_style(recording: rr.RecordingStream, root: str, elements: int) -> None:
    """Define the style of a bridge's trend: all elements alike, the lowest with its interval."""
    styles = [(f"EI_{n}", f"EI_{n}", VEHICLE_COLOURS["front"], 2.0) for n in range(1, elements + 1)]
    styles += [
        ("lowest/mean", "lowest", _LOWEST, 4.0),
        ("lowest/low", "2.5 %", _LOWEST, 1.5),
        ("lowest/high", "97.5 %", _LOWEST, 1.5),
    ]
    for entity, name, colour, size in styles:
        log_line(recording, f"{root}/{entity}", name, colour, width=size / 2.0)
        # A single crossing is not a line.
        point = rr.SeriesPoints(colors=[rgb(colour)], names=name, marker_sizes=size)
        recording.log(f"{root}/{entity}", point, static=True)


def log_trend(
    recording: rr.RecordingStream, root: str, time_ns: int, fused: Estimate, nominal: Floats
) -> None:
    """Log EI of each element over nominal after a crossing, and the interval of the lowest."""
    stream = TimestampedStream(recording, time_ns)
    for number, ratio in enumerate(fused.mean / nominal, start=1):
        stream.log(f"{root}/EI_{number}", rr.Scalars(float(ratio)))
    lowest = int((fused.mean / nominal).argmin())
    for name, values in (("mean", fused.mean), ("low", fused.low), ("high", fused.high)):
        ratio = float(values[lowest] / nominal[lowest])
        stream.log(f"{root}/lowest/{name}", rr.Scalars(ratio))


def bridge_text(alarm: Alarm | None, *found: str) -> str:
    """Return the text on a bridge as Markdown: an active alarm, then the result."""
    texts = [_alarm_text(alarm), "\n\n".join(filter(None, found)) or NO_RESULT]
    return "\n\n".join(filter(None, texts))


def note_alarm(active: dict[str, Alarm], alarm: Alarm) -> None:
    """Keep the alarm of each bridge until it is acknowledged, at most `_MAX_ALARMS` of them."""
    active.pop(alarm.bridge, None)
    if alarm.acknowledged is not None:
        return
    if len(active) >= _MAX_ALARMS:
        active.pop(min(active, key=lambda bridge: active[bridge].raised))
    active[alarm.bridge] = alarm


def _alarm_text(alarm: Alarm | None) -> str:
    if alarm is None:
        return ""
    raised = np.datetime64(round(alarm.raised), "s").astype("datetime64[D]")
    wording = alarm.sentence()
    return f"### Alarm\n\n**{wording[0].upper()}{wording[1:]}.** Raised {raised}, not acknowledged."


def clock_text(crossing: CrossingResult) -> str:
    """Return the time of a crossing, UTC."""
    moment = np.datetime64(int(crossing.entry_time), "s")
    return f"{str(moment).replace('T', ' ')} UTC"


def result_text(crossing: CrossingResult) -> str:
    """Return verdict, reasons and lowest element of a crossing, as Markdown."""
    way = "→" if crossing.direction == "start_to_end" else "←"
    lines = [f"### {crossing.verdict.capitalize()}: {crossing.vehicle} {way} {crossing.bridge}"]
    lines.append(clock_text(crossing))
    if crossing.verdict == "suspect":
        lines.append("**Doubtful. Do not rely on these values.**")
    lowest = lowest_element(crossing)
    if lowest is not None:
        lines.append(f"Lowest: {lowest}")
    lines += [f"- {text}" for text in crossing.reason_texts]
    return "\n\n".join(lines)
