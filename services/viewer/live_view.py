"""The live view of a bus: trucks, accelerations, crossings and results as they are received.

There is one timeline, the time of the samples (UTC): late data, or data of an old drive, appear at
their own time. Nothing is static but styles, so that a server that keeps the newest data for later
viewers can drop all old ones.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import rerun as rr
from google.protobuf.message import DecodeError

from schemas.alarms import Alarm, alarm_of
from schemas.proto import driveby_pb2 as pb
from schemas.results import BridgeResult, CrossingResult
from schemas.results_on_the_wire import estimate_to_crossing, state_to_bridge
from schemas.signals import AccelBatch, GnssFix, decode_accel, decode_gnss
from schemas.site import Site
from services.bus.realm_listener import BusMessage
from services.common.geodesy import to_chainage
from services.identification.comparison import compare, estimate_of_state, sentences
from services.viewer.crossing_view import (
    VERDICT_COLOURS,
    CrossingView,
    ElementGeometry,
    FloatArray,
    comparison_of,
    elements_of_result,
    summary_line,
    view_of_crossing,
)
from services.viewer.layout import is_doubtful
from services.viewer.live_layout import (
    lane_entity,
    live_blueprint,
    result_root,
    trend_root,
)
from services.viewer.live_parts import (
    TimestampedStream,
    bridge_text,
    clock_text,
    extremes,
    log_roads,
    log_trend,
    log_trend_style,
    note_alarm,
    of_site,
    result_text,
)
from services.viewer.rerun_crossing import log_rigidity
from services.viewer.rerun_file import acceleration_series
from services.viewer.rerun_parts import (
    MUTED,
    channel_colour,
    columns_of,
    log_line,
    rgb,
    send_scalars,
)
from services.viewer.rerun_places import (
    M_PER_DEGREE,
    BridgeOnMap,
    log_bridge,
    log_marker,
    log_surroundings,
    log_truck_style,
    plan_root,
    send_places,
)

MAX_TRUCKS: Final = 6
"""Maximum number of trucks with accelerations; of others only the position is drawn."""
MAX_BRIDGES: Final = 8
"""Maximum number of bridges with a tab: those that were approached or crossed first."""
_TRACK_FIXES: Final = 300
"""Number of fixes, one per second, of a truck's track on the map."""
_NEAR_M: Final = 2_000.0
"""Distance in m up to which a truck is on a bridge's plan."""
_SOON_NS: Final = 120_000_000_000
"""Delay in ns after the exit beyond which a result is dated at the exit."""
_TICKS_S: Final = 20.0
"""Time in s for which the view's clock continues after the last message.

A state that has just started is visible by it. Then the clock stops, and the window of
accelerations still holds the last ones.
"""
_PLACES_EVERY_S: Final = 1.0
"""Interval in s at which a truck is moved on the map and the plans.

Each move takes a kilobyte per view, at a server that keeps the history for later viewers.
"""
_GAP_NS: Final = 200_000_000
"""Gap in ns at which a line of accelerations is broken."""
_LANE_STEP_NS: Final = 1_000_000
"""Smallest time in ns between two states of a crossing, so that the first one is visible."""

LANE_STATES: Final = {
    "on the bridge": "#0072B2",
    "complete": "#56B4E9",
    "waits for validation": "#CC79A7",
    "identifying": "#999999",
    **VERDICT_COLOURS,
}
_STATES: Final = {
    pb.DETECTED: "on the bridge",
    pb.COMPLETE: "complete",
    pb.WAITING_NOT_VALIDATED: "waits for validation",
    pb.IDENTIFYING: "identifying",
}


class _Truck:
    """Data of a truck that are not drawn yet, and the state of its picture."""

    def __init__(self) -> None:
        self.batches: list[AccelBatch] = []
        self.fixes: list[GnssFix] = []
        self.track: deque[tuple[float, float]] = deque(maxlen=_TRACK_FIXES)
        self.channels: set[str] = set()
        self.drawn_to_ns = 0
        self.placed_s = -math.inf
        self.track_ns = 0


class LiveView:
    """The view of a realm in a Rerun stream; its own memory does not grow with time."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        site: Site | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._recording = recording
        self._clock = clock
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        self._trucks: dict[str, _Truck] = {}
        self._site = of_site(site)
        self._starts = np.array([one.on_map.start for one in self._site.values()]).reshape(-1, 2)
        self._elements_of_results: dict[str, ElementGeometry] = {}
        """Elements of bridges that are in no site file, from their results."""
        self._bridges: dict[str, None] = {}
        """Drawn bridges, in order of their first appearance."""
        self._drawn: dict[str, tuple[float, str]] = {}
        """Entry time of the crossing whose result is shown, and its text, by bridge."""
        self._below: dict[str, str] = {}
        """Crossing whose values are shown, by bridge: a rejected one has none."""
        self._findings: dict[str, str] = {}
        self._alarms: dict[str, Alarm] = {}
        """Alarms that stand."""
        self._trends: set[str] = set()
        self._lanes: dict[tuple[str, str], int] = {}
        """Time up to which crossings are drawn, by bridge and truck."""
        self._latest_ns = 0
        self._latest_s = self._received_s = clock()
        """Times of the newest sample and of the last message."""
        self._layout_is_old = True

    @property
    def is_empty(self) -> bool:
        """Whether no message has been received yet."""
        return not self._trucks and not self._bridges

    def ingest(self, message: BusMessage) -> None:
        """Add a message; skip an undecodable one, which the logger counts."""
        key, _, payload = message
        self._received_s = self._clock()
        try:
            match (key.owner, key.stream):
                case ("vehicle", "accel"):
                    self._add_batch(key.identifier, decode_accel(payload))
                case ("vehicle", "gnss"):
                    self._add_fix(key.identifier, decode_gnss(payload))
                case ("bridge", "crossing"):
                    self._add_state(pb.Crossing.FromString(payload))
                case ("bridge", "estimate"):
                    self._add_result(estimate_to_crossing(pb.Estimate.FromString(payload))[0])
                case ("bridge", "state"):
                    self._add_bridge_state(*state_to_bridge(pb.BridgeState.FromString(payload)))
                case ("bridge", "alarm"):
                    self._add_alarm(alarm_of(pb.Alarm.FromString(payload), key.realm))
        except (ValueError, DecodeError):
            return

    def flush(self) -> None:
        """Draw the new data of trucks; call it a few times a second."""
        for name, truck in self._trucks.items():
            self._draw_accelerations(name, truck)
            self._draw_position(name, truck)
        self._tick()
        if self._layout_is_old and not self.is_empty:
            self._layout_is_old = False
            shown = {name: truck.channels for name, truck in self._trucks.items() if truck.channels}
            on_map = [self._site[name].on_map for name in self._bridges if name in self._site]
            layout = live_blueprint(shown, list(self._bridges), on_map)
            self._recording.send_blueprint(layout)

    def _add_batch(self, vehicle: str, batch: AccelBatch) -> None:
        truck = self._truck(vehicle)
        self._note_time(batch.wall_time_ns)
        plotted = sum(bool(one.channels) for one in self._trucks.values())
        if not truck.channels and plotted >= MAX_TRUCKS:
            return
        for channel in batch.channels.keys() - truck.channels:
            truck.channels.add(channel)
            entity = f"vehicle/{vehicle}/acceleration/{channel}"
            log_line(self._recording, entity, channel.replace("_", " "), channel_colour(channel))
            self._layout_is_old = True
        truck.batches.append(batch)

    def _add_fix(self, vehicle: str, fix: GnssFix) -> None:
        truck = self._truck(vehicle)
        self._note_time(fix.wall_time_ns)
        truck.fixes.append(fix)

    def _add_state(self, crossing: pb.Crossing) -> None:
        state = _STATES.get(crossing.state)
        if state is None:
            return  # DONE: the estimate contains more
        self._add_bridge(crossing.bridge)
        moment_ns = crossing.entry_time_ns if state == "on the bridge" else crossing.time_ns
        if state in ("identifying", "waits for validation"):
            moment_ns = self._moment_ns(crossing.vehicle, crossing.exit_time_ns)
        self._draw_lane(crossing.bridge, crossing.vehicle, state, moment_ns)

    def _add_result(self, crossing: CrossingResult) -> None:
        moment_ns = self._moment_ns(crossing.vehicle, round(crossing.exit_time * 1e9))
        self._add_bridge(crossing.bridge)
        self._draw_lane(crossing.bridge, crossing.vehicle, crossing.verdict, moment_ns)
        elements = self._elements(crossing)
        drawn_s, _ = self._drawn.get(crossing.bridge, (0.0, ""))
        if crossing.entry_time < drawn_s or crossing.bridge not in self._bridges:
            return
        text = result_text(crossing)
        if elements is not None:
            view = view_of_crossing(crossing, elements)
            text += f"\n\n{summary_line(view)}"
            if view.rigidity_nm2 is not None:
                text += self._draw_result(view, moment_ns)
                self._below[crossing.bridge] = clock_text(crossing)
        if crossing.verdict == "rejected" and crossing.bridge in self._below:
            text += f"\n\nBelow: still the crossing of {self._below[crossing.bridge]}."
        self._drawn[crossing.bridge] = (crossing.entry_time, text)
        self._draw_text(crossing.bridge, moment_ns)

    def _add_bridge_state(self, bridge: str, time_ns: int, state: BridgeResult) -> None:
        self._add_bridge(bridge)
        found = self._site.get(bridge)
        elements = self._elements_of_results.get(bridge) if found is None else found.elements
        if bridge not in self._bridges or elements is None:
            return
        nominal = np.array(elements.nominal_flexural_rigidity_nm2)
        if len(state.elements) != nominal.size:
            return
        edges_m = np.concatenate(([0.0], np.cumsum(elements.lengths_m)))
        estimate = estimate_of_state(state)
        compared = compare(estimate, nominal, edges_m)
        if bridge not in self._trends:
            self._trends.add(bridge)
            log_trend_style(self._recording, trend_root(bridge), nominal.size)
        log_trend(self._recording, trend_root(bridge), time_ns, estimate, nominal)
        used = len(state.crossings_used)
        wording = state.finding or " ".join(sentences(compared))
        self._findings[bridge] = f"**All {used}:** {wording}" if used > 1 else ""
        moment_ns = max(time_ns, self._lanes_end_ns(bridge))
        self._draw_text(bridge, moment_ns)
        if found is not None:
            is_doubtful = state.verdict not in (None, "good")
            self._draw_bridge(found.on_map, estimate.mean / nominal, moment_ns, is_doubtful)

    def _add_alarm(self, alarm: Alarm) -> None:
        """Add an alarm. It stands for months: a truck gives a bridge a tab, an alarm does not."""
        note_alarm(self._alarms, alarm)
        if alarm.bridge in self._bridges:
            now_ns = self._now_ns() if self._latest_ns else 0
            self._draw_text(alarm.bridge, max(now_ns, self._lanes_end_ns(alarm.bridge)))

    def _tick(self) -> None:
        if self._latest_ns and self._clock() - self._received_s < _TICKS_S:
            TimestampedStream(self._recording, self._now_ns()).log("now", rr.Scalars(0.0))

    def _now_ns(self) -> int:
        """Return the present time on the clock of the samples."""
        return self._latest_ns + round(1e9 * (self._clock() - self._latest_s))

    def _draw_accelerations(self, vehicle: str, truck: _Truck) -> None:
        if not truck.batches:
            return
        batches = sorted(truck.batches, key=lambda one: one.wall_time_ns)
        truck.batches = []
        for channel, (time_ns, samples) in acceleration_series(batches).items():
            times, values = extremes(time_ns, samples, batches[0].channels[channel].rate_hz)
            if truck.drawn_to_ns and times[0] - truck.drawn_to_ns > _GAP_NS:
                times = np.insert(times, 0, truck.drawn_to_ns + _GAP_NS // 2)
                values = np.insert(values, 0, np.nan)
            entity = f"vehicle/{vehicle}/acceleration/{channel}"
            send_scalars(self._recording, entity, values, time_ns=times)
        last = batches[-1]
        longest_s = max(one.samples.size / one.rate_hz for one in last.channels.values())
        truck.drawn_to_ns = last.wall_time_ns + round(1e9 * longest_s)

    def _draw_position(self, vehicle: str, truck: _Truck) -> None:
        now_s = self._clock()
        if not truck.fixes or now_s - truck.placed_s < _PLACES_EVERY_S:
            return
        truck.placed_s = now_s
        fixes = sorted(truck.fixes, key=lambda one: one.wall_time_ns)
        truck.fixes = []
        places = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])
        time_ns = np.array([fix.wall_time_ns for fix in fixes])
        columns = rr.GeoPoints.columns(positions=places)
        self._recording.send_columns(f"map/position/{vehicle}", columns_of(time_ns, None), columns)
        speeds = np.array([fix.speed_m_per_s for fix in fixes])
        send_scalars(self._recording, f"vehicle/{vehicle}/speed", speeds, time_ns=time_ns)
        self._draw_track(vehicle, truck, fixes)
        for bridge in self._near(places):
            self._add_bridge(bridge)
            if bridge in self._bridges:
                along, left = to_chainage(self._site[bridge].frame, *places.T)
                entity = f"{plan_root(bridge)}/truck/{vehicle}"
                send_places(self._recording, entity, np.column_stack((along, -left)), time_ns)

    def _draw_track(self, vehicle: str, truck: _Truck, fixes: Sequence[GnssFix]) -> None:
        """Draw the track, one fix per second."""
        for fix in fixes:
            if fix.wall_time_ns - truck.track_ns < 1_000_000_000:
                continue
            truck.track_ns = fix.wall_time_ns
            truck.track.append((fix.latitude_deg, fix.longitude_deg))
        if len(truck.track) > 1:
            style = {"radii": rr.Radius.ui_points(1.0), "colors": [rgb(MUTED)]}
            line = rr.GeoLineStrings(lat_lon=[np.array(truck.track)], **style)
            TimestampedStream(self._recording, truck.track_ns).log(f"map/track/{vehicle}", line)

    def _draw_lane(self, bridge: str, vehicle: str, state: str, moment_ns: int) -> None:
        """Draw a state of a truck's crossings of a bridge, from a time on."""
        if bridge not in self._bridges:
            return
        entity = lane_entity(bridge, vehicle)
        if (bridge, vehicle) not in self._lanes:
            colours = [(*rgb(colour), 255) for colour in LANE_STATES.values()]
            style = rr.StateConfiguration(values=list(LANE_STATES), colors=colours)
            self._recording.log(entity, style, static=True)
        before_ns = self._lanes.get((bridge, vehicle), 0)
        if state == "on the bridge" and moment_ns < before_ns:
            return  # it belongs to a crossing whose truck is already over the next bridge
        moment_ns = max(moment_ns, before_ns + _LANE_STEP_NS)
        self._lanes[bridge, vehicle] = moment_ns
        TimestampedStream(self._recording, moment_ns).log(entity, rr.StateChange(state=state))

    def _draw_result(self, view: CrossingView, moment_ns: int) -> str:
        """Draw EI along the span with the roads below it; return sentences on the result."""
        root = result_root(view.bridge)
        compared = comparison_of(view, None)
        self._recording.set_time("time", timestamp=np.datetime64(moment_ns - 1000, "ns"))
        self._recording.log(root, rr.Clear(recursive=True))
        dated = TimestampedStream(self._recording, moment_ns)
        log_rigidity(dated, root, view, compared, None)
        log_roads(dated, root, view)
        on_site = self._site.get(view.bridge)
        if on_site is not None and view.rigidity_nm2 is not None:
            ratios = view.rigidity_nm2 / view.nominal_nm2
            self._draw_bridge(on_site.on_map, ratios, moment_ns, is_doubtful(view))
        return "" if compared is None else f"\n\n{' '.join(sentences(compared))}"

    def _draw_text(self, bridge: str, moment_ns: int) -> None:
        texts = (self._drawn.get(bridge, (0.0, ""))[1], self._findings.get(bridge, ""))
        text = bridge_text(self._alarms.get(bridge), *texts)
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        TimestampedStream(self._recording, moment_ns).log(f"said/{bridge}", document)

    def _draw_bridge(
        self, bridge: BridgeOnMap, ratios: FloatArray | None, moment_ns: int, doubtful: bool
    ) -> None:
        log_bridge(
            TimestampedStream(self._recording, moment_ns),
            bridge,
            ratios,
            doubtful=doubtful,
            map_entity=f"map/bridge/{bridge.identifier}",
            plan_entity=f"{plan_root(bridge.identifier)}/elements",
        )

    def _add_bridge(self, bridge: str) -> None:
        """Draw a bridge for the first time."""
        if bridge in self._bridges or len(self._bridges) >= MAX_BRIDGES:
            return
        self._bridges[bridge] = None
        self._layout_is_old = True
        self._draw_text(bridge, self._latest_ns)
        found = self._site.get(bridge)
        if found is not None:
            log_surroundings(self._recording, found.on_map, {})
            self._draw_bridge(found.on_map, None, self._latest_ns, doubtful=False)
            for vehicle in self._trucks:
                log_truck_style(self._recording, f"{plan_root(bridge)}/truck/{vehicle}", vehicle)

    def _truck(self, vehicle: str) -> _Truck:
        truck = self._trucks.get(vehicle)
        if truck is None:
            truck = self._trucks[vehicle] = _Truck()
            self._layout_is_old = True
            log_marker(self._recording, f"map/position/{vehicle}")
            log_line(self._recording, f"vehicle/{vehicle}/speed", "speed", "#009E73")
            for bridge in self._bridges:
                log_truck_style(self._recording, f"{plan_root(bridge)}/truck/{vehicle}", vehicle)
        return truck

    def _near(self, places: FloatArray) -> list[str]:
        """Return the bridges of the site file near the last of these positions."""
        if not self._starts.size:
            return []
        north, east = ((self._starts - places[-1]) * M_PER_DEGREE).T
        apart_m = np.hypot(north, east * np.cos(np.radians(places[-1, 0])))
        names = list(self._site)
        return [names[n] for n in np.flatnonzero(apart_m < _NEAR_M)]

    def _elements(self, crossing: CrossingResult) -> ElementGeometry | None:
        on_site = self._site.get(crossing.bridge)
        if on_site is not None:
            fits = f"EI_{on_site.elements.elements}" in (crossing.parameters or {})
            return on_site.elements if fits or crossing.parameters is None else None
        elements = elements_of_result(crossing)
        if elements is not None and crossing.bridge in self._bridges:
            self._elements_of_results[crossing.bridge] = elements
        return elements

    def _note_time(self, time_ns: int) -> None:
        if time_ns > self._latest_ns:
            self._latest_ns, self._latest_s = time_ns, self._clock()

    def _moment_ns(self, vehicle: str, exit_ns: int) -> int:
        """Return the time of a result on the clock of the samples."""
        now_ns = self._now_ns() if vehicle in self._trucks else 0
        return now_ns if exit_ns < now_ns < exit_ns + _SOON_NS else exit_ns

    def _lanes_end_ns(self, bridge: str) -> int:
        return max((ns for (name, _), ns in self._lanes.items() if name == bridge), default=0)
