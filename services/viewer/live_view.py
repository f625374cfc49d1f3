"""The live view of a bus: trucks, accelerations, crossings and results as they are received.

There is one timeline, the time of the samples (UTC): late data, or data of an old drive, appear at
their own time. Nothing is static but styles, so that a server that keeps the newest data for later
viewers can drop all old ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable
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
from services.common.arrays import Floats
from services.common.crossing_states import FROM_RECORDING, words_of_state
from services.common.geodesy import to_chainage
from services.identification.comparison import (
    compare,
    describe_comparison,
    estimate_of_state,
    unresolved_elements,
)
from services.viewer.crossing_scene import CrossingScene
from services.viewer.crossing_view import (
    CrossingView,
    ElementGeometry,
    comparison_of,
    describe_crossing,
    elements_of_result,
    summary_line,
    view_of_crossing,
)
from services.viewer.live_clock import SampleClock
from services.viewer.live_lanes import CrossingLanes, RecordedCrossings
from services.viewer.live_layout import (
    live_blueprint,
    result_root,
    trend_root,
)
from services.viewer.live_parts import (
    TimestampedStream,
    bridge_text,
    bridges_near,
    clock_text,
    log_roads,
    log_trend,
    log_trend_style,
    note_alarm,
    of_site,
    result_text,
)
from services.viewer.live_trucks import LiveTruck
from services.viewer.panels.rigidity import log_rigidity
from services.viewer.rerun_parts import (
    columns_of,
    log_channel,
    log_line,
    send_scalars,
)
from services.viewer.rerun_places import (
    BridgeOnMap,
    log_bridge,
    log_marker,
    log_surroundings,
    log_truck_style,
    plan_root,
    send_named_places,
)

MAX_TRUCKS: Final = 6
"""Maximum number of trucks with accelerations; of others only the position is drawn."""
MAX_BRIDGES: Final = 8
"""Maximum number of bridges with a tab: those that were approached or crossed first."""
_PLACES_EVERY_S: Final = 1.0
"""Interval in s at which a truck is moved on the map and the plans.

Each move takes a kilobyte per view, at a server that keeps the history for later viewers.
"""


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
        self._trucks: dict[str, LiveTruck] = {}
        self._site = of_site(site)
        self._starts = np.array([one.on_map.start for one in self._site.values()]).reshape(-1, 2)
        self._elements_of_results: dict[str, ElementGeometry] = {}
        """Elements of bridges that are in no site file, from their results."""
        self._bridges: dict[str, None] = {}
        """Drawn bridges, in order of their first appearance."""
        self._drawn: dict[str, tuple[float, str]] = {}
        """Entry time of the crossing whose result is shown, and its text, by bridge."""
        self._recorded = RecordedCrossings()
        self._below: dict[str, str] = {}
        """Crossing whose values are shown, by bridge: a rejected one has none."""
        self._findings: dict[str, str] = {}
        self._alarms: dict[str, Alarm] = {}
        """Alarms that stand."""
        self._trends: set[str] = set()
        self._lanes = CrossingLanes(recording)
        self._time = SampleClock(clock)
        self._layout_is_old = True

    @property
    def is_empty(self) -> bool:
        """Whether no message has been received yet."""
        return not self._trucks and not self._bridges

    def ingest(self, message: BusMessage) -> None:
        """Add a message; skip an undecodable one, which the logger counts."""
        key, _, payload = message
        self._time.receive()
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
            truck.draw_accelerations(self._recording, name)
            self._draw_position(name, truck)
        if self._time.is_running:
            TimestampedStream(self._recording, self._time.now_ns()).log("now", rr.Scalars(0.0))
        if self._layout_is_old and not self.is_empty:
            self._layout_is_old = False
            shown = {name: truck.channels for name, truck in self._trucks.items() if truck.channels}
            on_map = [self._site[name].on_map for name in self._bridges if name in self._site]
            self._recording.send_blueprint(live_blueprint(shown, list(self._bridges), on_map))

    def _add_batch(self, vehicle: str, batch: AccelBatch) -> None:
        truck = self._truck(vehicle)
        self._time.note(batch.wall_time_ns)
        plotted = sum(bool(one.channels) for one in self._trucks.values())
        if not truck.channels and plotted >= MAX_TRUCKS:
            return
        for channel in batch.channels.keys() - truck.channels:
            truck.channels.add(channel)
            entity = f"vehicle/{vehicle}/acceleration/{channel}"
            log_channel(self._recording, entity, channel)
            self._layout_is_old = True
        truck.batches.append(batch)

    def _add_fix(self, vehicle: str, fix: GnssFix) -> None:
        truck = self._truck(vehicle)
        self._time.note(fix.wall_time_ns)
        truck.fixes.append(fix)

    def _add_state(self, crossing: pb.Crossing) -> None:
        is_driving = crossing.vehicle in self._trucks
        state = words_of_state(crossing, self._time.present_ns(is_driving=is_driving))
        if not state or crossing.state == pb.DONE:
            return  # of DONE the estimate contains more
        self._add_bridge(crossing.bridge)
        if crossing.bridge not in self._bridges:
            return
        moment_ns = self._time.moment_of_state_ns(crossing, is_driving=is_driving)
        self._lanes.draw(crossing.bridge, crossing.vehicle, state, moment_ns)
        if state == FROM_RECORDING:
            self._recorded.note(crossing)
            self._draw_text(crossing.bridge, moment_ns)

    def _add_result(self, crossing: CrossingResult) -> None:
        is_driving = crossing.vehicle in self._trucks
        moment_ns = self._time.moment_ns(round(crossing.exit_time * 1e9), is_driving=is_driving)
        self._add_bridge(crossing.bridge)
        if crossing.bridge in self._bridges:
            self._lanes.draw(crossing.bridge, crossing.vehicle, crossing.verdict, moment_ns)
        self._recorded.forget(crossing.bridge, crossing.crossing_id)
        elements = self._elements(crossing)
        drawn_s, _ = self._drawn.get(crossing.bridge, (0.0, ""))
        if crossing.entry_time < drawn_s or crossing.bridge not in self._bridges:
            return
        text = result_text(crossing)
        if elements is not None:
            view = view_of_crossing(crossing, elements)
            text += f"\n\n{summary_line(view)}"
            if view.rigidity_nm2 is not None:
                text += self._draw_result(view, view.rigidity_nm2, moment_ns)
                self._below[crossing.bridge] = clock_text(crossing)
        if crossing.verdict == "rejected" and crossing.bridge in self._below:
            text += f"\n\nBelow is still the crossing of {self._below[crossing.bridge]}."
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
        unresolved = unresolved_elements(state.elements.values())
        described = describe_comparison(compared, unresolved, state.level)
        wording = state.finding or " ".join(described)
        self._findings[bridge] = f"**All {used} crossings:** {wording}" if used > 1 else ""
        moment_ns = max(time_ns, self._lanes.end_ns(bridge))
        self._draw_text(bridge, moment_ns)
        if found is not None:
            is_doubtful = state.verdict not in (None, "good")
            self._draw_bridge(found.on_map, estimate.mean / nominal, moment_ns, is_doubtful)

    def _add_alarm(self, alarm: Alarm) -> None:
        """Add an alarm, which may be active for months: unlike a truck it gives a bridge no tab."""
        note_alarm(self._alarms, alarm)
        if alarm.bridge in self._bridges:
            now_ns = self._time.now_ns() if self._time.latest_ns else 0
            self._draw_text(alarm.bridge, max(now_ns, self._lanes.end_ns(alarm.bridge)))

    def _draw_position(self, vehicle: str, truck: LiveTruck) -> None:
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
        truck.draw_track(self._recording, vehicle, fixes)
        for bridge in bridges_near(self._site, self._starts, places):
            self._add_bridge(bridge)
            if bridge in self._bridges:
                along, left = to_chainage(self._site[bridge].frame, *places.T)
                entity = f"{plan_root(bridge)}/truck/{vehicle}"
                where, span_m = np.column_stack((along, -left)), self._site[bridge].on_map.span_m
                send_named_places(self._recording, entity, where, time_ns, span_m)

    def _draw_result(self, view: CrossingView, rigidity_nm2: Floats, moment_ns: int) -> str:
        """Draw EI along the span with the roads below it; return sentences on the result."""
        scene = CrossingScene(view, result_root(view.bridge), comparison_of(view))
        self._recording.set_time("time", timestamp=np.datetime64(moment_ns - 1000, "ns"))
        self._recording.log(scene.root, rr.Clear(recursive=True))
        dated = TimestampedStream(self._recording, moment_ns)
        log_rigidity(dated, scene, rigidity_nm2)
        log_roads(dated, scene.root, view)
        on_site = self._site.get(view.bridge)
        if on_site is not None:
            ratios = rigidity_nm2 / view.nominal_nm2
            self._draw_bridge(on_site.on_map, ratios, moment_ns, view.is_doubtful)
        wording = describe_crossing(view, scene.compared)
        return f"\n\n{' '.join(wording)}" if wording else ""

    def _draw_text(self, bridge: str, moment_ns: int) -> None:
        texts = (self._drawn.get(bridge, (0.0, ""))[1], self._findings.get(bridge, ""))
        text = bridge_text(self._alarms.get(bridge), self._recorded.text(bridge), *texts)
        document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
        TimestampedStream(self._recording, moment_ns).log(f"newest/{bridge}", document)

    def _draw_bridge(
        self, bridge: BridgeOnMap, ratios: Floats | None, moment_ns: int, doubtful: bool
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
        self._draw_text(bridge, self._time.latest_ns)
        found = self._site.get(bridge)
        if found is not None:
            log_surroundings(self._recording, found.on_map, {})
            self._draw_bridge(found.on_map, None, self._time.latest_ns, doubtful=False)
            for vehicle in self._trucks:
                log_truck_style(self._recording, f"{plan_root(bridge)}/truck/{vehicle}", vehicle)

    def _truck(self, vehicle: str) -> LiveTruck:
        truck = self._trucks.get(vehicle)
        if truck is None:
            truck = self._trucks[vehicle] = LiveTruck()
            self._layout_is_old = True
            log_marker(self._recording, f"map/position/{vehicle}")
            log_line(self._recording, f"vehicle/{vehicle}/speed", "speed", "#009E73")
            for bridge in self._bridges:
                log_truck_style(self._recording, f"{plan_root(bridge)}/truck/{vehicle}", vehicle)
        return truck

    def _elements(self, crossing: CrossingResult) -> ElementGeometry | None:
        on_site = self._site.get(crossing.bridge)
        if on_site is not None:
            fits = f"EI_{on_site.elements.elements}" in (crossing.parameters or {})
            return on_site.elements if fits or crossing.parameters is None else None
        elements = elements_of_result(crossing)
        if elements is not None and crossing.bridge in self._bridges:
            self._elements_of_results[crossing.bridge] = elements
        return elements
