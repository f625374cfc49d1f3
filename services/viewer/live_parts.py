"""Pieces of the live picture: what is dated, few points for many samples, roads, trends, texts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr

from schemas.alarms import Alarm
from schemas.results import Crossing, lowest_element
from schemas.site import Site
from services.common.geodesy import BridgeFrame, bridge_frame
from services.identification.comparison import Estimate
from services.viewer.crossing_view import VEHICLE_COLOURS, CrossingView, Elements, FloatArray
from services.viewer.rerun_parts import (
    MUTED,
    TIME,
    WEAK,
    IntArray,
    log_labels,
    log_line,
    rgb,
)
from services.viewer.rerun_places import BridgeOnMap, bridges_of_site
from services.viewer.strip import STRIP_HEIGHT, STRIP_WIDTH

PERIOD_S: Final = 0.02
"""Of accelerations the smallest and the largest sample of each such time is drawn."""
ROADS_MIDDLE: Final = STRIP_HEIGHT + 330.0
"""How far below the strip's top the roads stand, in its pixels; `ROADS_REACH` up and down."""
ROADS_REACH: Final = 120.0
_QUALITY: Final = 95
_MOST_ALARMS: Final = 1000
NO_RESULT: Final = "No result yet. One comes some seconds after a truck has left the bridge."


class OnSite(NamedTuple):
    """A bridge of the site file."""

    on_map: BridgeOnMap
    elements: Elements
    frame: BridgeFrame


def of_site(site: Site | None) -> dict[str, OnSite]:
    """The bridges of a site file by name; none without one."""
    if site is None:
        return {}
    return {
        bridge.id: OnSite(on_map, bridge, bridge_frame(bridge))
        for bridge, on_map in zip(site.bridges, bridges_of_site(site), strict=True)
    }


class Dated:
    """A recording into which all is logged at one moment, also what a file says for all times."""

    def __init__(self, recording: rr.RecordingStream, time_ns: int) -> None:
        self._recording = recording
        self._time = np.datetime64(time_ns, "ns")

    def log(self, entity_path: str, entity: Any, *, static: bool = False) -> None:
        """Log one thing; a picture is compressed, as the server keeps it for late viewers."""
        self._recording.set_time(TIME, timestamp=self._time)
        kept = entity.compress(jpeg_quality=_QUALITY) if isinstance(entity, rr.Image) else entity
        self._recording.log(entity_path, kept)

    def send_columns(
        self, entity_path: str, indexes: Iterable[Any], columns: Iterable[Any]
    ) -> None:
        """Log a series, which has its own times."""
        self._recording.send_columns(entity_path, indexes, columns)


def extremes(time_ns: IntArray, samples: FloatArray, rate_hz: float) -> tuple[IntArray, FloatArray]:
    """The smallest and the largest of the samples of every `PERIOD_S`, where they are; (≤ 2n/k,).

    A NaN, which breaks a line, stays one.
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


def log_roads(dated: Dated, root: str, crossing: CrossingView) -> None:
    """The road as each wheel felt it, below the strip and on its scale along the span."""
    road = crossing.road
    if road is None:
        return
    largest_m = float(max(np.abs(road.front_m).max(), np.abs(road.rear_m).max(), 1e-6))
    across = road.x_m * STRIP_WIDTH / crossing.span_m
    entity = f"{root}/strip/road"
    ends = [[(0.0, ROADS_MIDDLE), (float(STRIP_WIDTH), ROADS_MIDDLE)]]
    thin = rr.Radius.ui_points(0.5)
    dated.log(f"{entity}/level", rr.LineStrips2D(ends, colors=[rgb(MUTED)], radii=thin))
    # The two lie on one another: the one drawn first is wider, so that both are seen.
    for wheel, height_m, width in (("front", road.front_m, 2.0), ("rear", road.rear_m, 0.75)):
        down = ROADS_MIDDLE - ROADS_REACH * height_m / largest_m
        line = rr.LineStrips2D(
            [np.column_stack((across, down))],
            colors=[rgb(VEHICLE_COLOURS[wheel])],
            radii=rr.Radius.ui_points(width),
            draw_order=1.0 if wheel == "front" else 2.0,
        )
        dated.log(f"{entity}/{wheel}", line)
    apart_mm = 1e3 * float(np.sqrt(np.mean((road.front_m - road.rear_m) ** 2)))
    said = f"road under both wheels, ± {1e3 * largest_m:.1f} mm; they differ by {apart_mm:.2g} mm"
    place = np.array([STRIP_WIDTH / 2.0]), np.array([ROADS_MIDDLE + ROADS_REACH + 5.0])
    log_labels(dated, f"{entity}/name", [said], *place)


def log_trend_look(recording: rr.RecordingStream, root: str, elements: int) -> None:
    """How the trend of a bridge looks: all elements alike, the lowest with its interval."""
    looks = [(f"EI_{n}", f"EI_{n}", VEHICLE_COLOURS["front"], 2.0) for n in range(1, elements + 1)]
    looks += [
        ("lowest/mean", "lowest", WEAK, 4.0),
        ("lowest/low", "2.5 %", WEAK, 1.5),
        ("lowest/high", "97.5 %", WEAK, 1.5),
    ]
    for entity, name, colour, size in looks:
        log_line(recording, f"{root}/{entity}", name, colour, width=size / 2.0)
        # A line of one crossing is none.
        point = rr.SeriesPoints(colors=[rgb(colour)], names=name, marker_sizes=size)
        recording.log(f"{root}/{entity}", point, static=True)


def log_trend(
    recording: rr.RecordingStream, root: str, time_ns: int, fused: Estimate, nominal: FloatArray
) -> None:
    """EI of each element over nominal after a crossing, and the interval of the lowest."""
    dated = Dated(recording, time_ns)
    for number, ratio in enumerate(fused.mean / nominal, start=1):
        dated.log(f"{root}/EI_{number}", rr.Scalars(float(ratio)))
    lowest = int((fused.mean / nominal).argmin())
    for name, values in (("mean", fused.mean), ("low", fused.low), ("high", fused.high)):
        ratio = float(values[lowest] / nominal[lowest])
        dated.log(f"{root}/lowest/{name}", rr.Scalars(ratio))


def bridge_text(alarm: Alarm | None, *found: str) -> str:
    """All that is said of a bridge, as Markdown: an alarm that stands, then what was found."""
    texts = [_alarm_text(alarm), "\n\n".join(filter(None, found)) or NO_RESULT]
    return "\n\n".join(filter(None, texts))


def note_alarm(standing: dict[str, Alarm], alarm: Alarm) -> None:
    """Keep the alarm of each bridge until somebody acknowledges it; not more than so many."""
    standing.pop(alarm.bridge, None)
    if alarm.acknowledged is not None:
        return
    if len(standing) >= _MOST_ALARMS:
        standing.pop(min(standing, key=lambda bridge: standing[bridge].raised))
    standing[alarm.bridge] = alarm


def _alarm_text(alarm: Alarm | None) -> str:
    if alarm is None:
        return ""
    raised = np.datetime64(round(alarm.raised), "s").astype("datetime64[D]")
    said = alarm.sentence()
    return f"### Alarm\n\n**{said[0].upper()}{said[1:]}.** Raised {raised}, not acknowledged."


def clock_text(crossing: Crossing) -> str:
    """When a crossing was driven, in UTC."""
    moment = np.datetime64(round(crossing.entry_time), "s")
    return f"{str(moment).replace('T', ' ')} UTC"


def result_text(crossing: Crossing) -> str:
    """Verdict, reasons and lowest element of a crossing, as Markdown."""
    way = "→" if crossing.direction == "start_to_end" else "←"
    lines = [f"### {crossing.verdict.capitalize()}: {crossing.vehicle} {way} {crossing.bridge}"]
    lines.append(clock_text(crossing))
    if crossing.verdict == "suspect":
        lines.append("**Doubtful: to be looked at, not to be relied upon.**")
    lowest = lowest_element(crossing)
    if lowest is not None:
        lines.append(f"Lowest: {lowest}")
    lines += [f"- {text}" for text in crossing.reason_texts]
    return "\n\n".join(lines)
