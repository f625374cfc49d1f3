"""What is heard on a bus, drawn as it comes: trucks, accelerations, crossings, results.

There is one timeline, the time of the samples (UTC): what came late, or is a drive of long ago,
stands where it belongs. Nothing is drawn that was logged for all times but how things look, so that
a server which keeps the newest for late viewers can let go of all that is old.
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
from schemas.results import BridgeResult, Crossing
from schemas.results_on_the_wire import estimate_to_crossing, state_to_bridge
from schemas.signals import AccelBatch, GnssFix, decode_accel, decode_gnss
from schemas.site import Site
from services.bus.listening import Heard
from services.common.geodesy import to_chainage
from services.identification.comparison import compare, estimate_of_state, sentences
from services.viewer.crossing_view import (
    VERDICT_COLOURS,
    CrossingView,
    Elements,
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
    Dated,
    bridge_text,
    clock_text,
    extremes,
    log_roads,
    log_trend,
    log_trend_look,
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
    log_truck_look,
    plan_root,
    send_places,
)

MOST_TRUCKS: Final = 6
"""Trucks whose accelerations are drawn; of others there is the position."""
MOST_BRIDGES: Final = 8
"""Bridges that have a tab of their own: those that were met or crossed first."""
_TRACK_FIXES: Final = 300
"""So many fixes, one a second, of the way that a truck has come are on the map."""
_NEAR_M: Final = 2_000.0
"""A truck so near to a bridge is on its plan."""
_SOON_NS: Final = 120_000_000_000
"""A result that comes later after the truck has left is dated when it left."""
_TICKS_S: Final = 20.0
"""So long after the last that was heard time goes on, so that a state that has just begun is seen.
Then it stands still, and the window of accelerations still has what came last."""
_PLACES_EVERY_S: Final = 1.0
"""How often a truck is moved on the map and the plans: each time takes a kilobyte at every place
of a server that keeps what was for late viewers."""
_GAP_NS: Final = 200_000_000
"""A line of accelerations is broken where nothing came for so long."""
_LANE_STEP_NS: Final = 1_000_000
"""Two states of a crossing are not at the same moment, or the first one would not be seen."""

LANE_STATES: Final = {
    "on the bridge": "#0072B2",
    "complete": "#56B4E9",
    "waits for a certificate": "#CC79A7",
    "identifying": "#999999",
    **VERDICT_COLOURS,
}
_STATES: Final = {
    pb.DETECTED: "on the bridge",
    pb.COMPLETE: "complete",
    pb.WAITING_NOT_VALIDATED: "waits for a certificate",
    pb.IDENTIFYING: "identifying",
}


class _Truck:
    """What has come of a truck and is not drawn yet, and what is drawn of it."""

    def __init__(self) -> None:
        self.batches: list[AccelBatch] = []
        self.fixes: list[GnssFix] = []
        self.track: deque[tuple[float, float]] = deque(maxlen=_TRACK_FIXES)
        self.channels: set[str] = set()
        self.drawn_to_ns = 0
        self.placed_s = -math.inf
        self.track_ns = 0


class LivePicture:
    """Draws into a stream of Rerun; its own memory does not grow with time."""

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
        self._told: dict[str, Elements] = {}
        """Of bridges that are in no site file, by their results."""
        self._bridges: dict[str, None] = {}
        """Those that are drawn, in the order in which they were met."""
        self._drawn: dict[str, tuple[float, str]] = {}
        """Of each bridge when the crossing was driven whose result is shown, and its text."""
        self._below: dict[str, str] = {}
        """Of each bridge, which crossing's numbers are shown: a rejected one has none."""
        self._findings: dict[str, str] = {}
        self._alarms: dict[str, Alarm] = {}
        """Those that stand."""
        self._trends: set[str] = set()
        self._lanes: dict[tuple[str, str], int] = {}
        """Of each bridge and truck, up to when its crossings are drawn."""
        self._latest_ns = 0
        self._latest_s = self._heard_s = clock()
        """When the newest sample came, and the last message."""
        self._layout_is_old = True

    @property
    def is_empty(self) -> bool:
        """Whether nothing at all has been heard yet."""
        return not self._trucks and not self._bridges

    def take(self, heard: Heard) -> None:
        """Take a message; what cannot be decoded is left out, the logger has counted it."""
        key, _, payload = heard
        self._heard_s = self._clock()
        try:
            match (key.owner, key.stream):
                case ("vehicle", "accel"):
                    self._take_batch(key.identifier, decode_accel(payload))
                case ("vehicle", "gnss"):
                    self._take_fix(key.identifier, decode_gnss(payload))
                case ("bridge", "crossing"):
                    self._take_state(pb.Crossing.FromString(payload))
                case ("bridge", "estimate"):
                    self._take_result(estimate_to_crossing(pb.Estimate.FromString(payload))[0])
                case ("bridge", "state"):
                    self._take_bridge(*state_to_bridge(pb.BridgeState.FromString(payload)))
                case ("bridge", "alarm"):
                    self._take_alarm(alarm_of(pb.Alarm.FromString(payload), key.realm))
        except (ValueError, DecodeError):
            return

    def flush(self) -> None:
        """Draw what has come of trucks since the last call; call it a few times a second."""
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

    def _take_batch(self, vehicle: str, batch: AccelBatch) -> None:
        truck = self._truck(vehicle)
        self._note_time(batch.wall_time_ns)
        plotted = sum(bool(one.channels) for one in self._trucks.values())
        if not truck.channels and plotted >= MOST_TRUCKS:
            return
        for channel in batch.channels.keys() - truck.channels:
            truck.channels.add(channel)
            entity = f"vehicle/{vehicle}/acceleration/{channel}"
            log_line(self._recording, entity, channel.replace("_", " "), channel_colour(channel))
            self._layout_is_old = True
        truck.batches.append(batch)

    def _take_fix(self, vehicle: str, fix: GnssFix) -> None:
        truck = self._truck(vehicle)
        self._note_time(fix.wall_time_ns)
        truck.fixes.append(fix)

    def _take_state(self, crossing: pb.Crossing) -> None:
        state = _STATES.get(crossing.state)
        if state is None:
            return  # DONE: the estimate has said more
        self._meet(crossing.bridge)
        moment_ns = crossing.entry_time_ns if state == "on the bridge" else crossing.time_ns
        if state in ("identifying", "waits for a certificate"):
            moment_ns = self._moment_ns(crossing.vehicle, crossing.exit_time_ns)
        self._draw_lane(crossing.bridge, crossing.vehicle, state, moment_ns)

    def _take_result(self, crossing: Crossing) -> None:
        moment_ns = self._moment_ns(crossing.vehicle, round(crossing.exit_time * 1e9))
        self._meet(crossing.bridge)
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

    def _take_bridge(self, bridge: str, time_ns: int, state: BridgeResult) -> None:
        self._meet(bridge)
        found = self._site.get(bridge)
        elements = self._told.get(bridge) if found is None else found.elements
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
            log_trend_look(self._recording, trend_root(bridge), nominal.size)
        log_trend(self._recording, trend_root(bridge), time_ns, estimate, nominal)
        used = len(state.crossings_used)
        said = state.finding or " ".join(sentences(compared))
        self._findings[bridge] = f"**All {used}:** {said}" if used > 1 else ""
        moment_ns = max(time_ns, self._lanes_end_ns(bridge))
        self._draw_text(bridge, moment_ns)
        if found is not None:
            is_doubtful = state.verdict not in (None, "good")
            self._draw_bridge(found.on_map, estimate.mean / nominal, moment_ns, is_doubtful)

    def _take_alarm(self, alarm: Alarm) -> None:
        """Alarms stand for months: one alone gives a bridge no tab, a truck does."""
        note_alarm(self._alarms, alarm)
        if alarm.bridge in self._bridges:
            now_ns = self._now_ns() if self._latest_ns else 0
            self._draw_text(alarm.bridge, max(now_ns, self._lanes_end_ns(alarm.bridge)))

    def _tick(self) -> None:
        if self._latest_ns and self._clock() - self._heard_s < _TICKS_S:
            Dated(self._recording, self._now_ns()).log("now", rr.Scalars(0.0))

    def _now_ns(self) -> int:
        """The moment that it is on the clock of the samples."""
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
            self._meet(bridge)
            if bridge in self._bridges:
                along, left = to_chainage(self._site[bridge].frame, *places.T)
                entity = f"{plan_root(bridge)}/truck/{vehicle}"
                send_places(self._recording, entity, np.column_stack((along, -left)), time_ns)

    def _draw_track(self, vehicle: str, truck: _Truck, fixes: Sequence[GnssFix]) -> None:
        """The way that it has come, once a second."""
        for fix in fixes:
            if fix.wall_time_ns - truck.track_ns < 1_000_000_000:
                continue
            truck.track_ns = fix.wall_time_ns
            truck.track.append((fix.latitude_deg, fix.longitude_deg))
        if len(truck.track) > 1:
            look = {"radii": rr.Radius.ui_points(1.0), "colors": [rgb(MUTED)]}
            line = rr.GeoLineStrings(lat_lon=[np.array(truck.track)], **look)
            Dated(self._recording, truck.track_ns).log(f"map/track/{vehicle}", line)

    def _draw_lane(self, bridge: str, vehicle: str, state: str, moment_ns: int) -> None:
        """The state of the crossings of a truck over a bridge, from a moment on."""
        if bridge not in self._bridges:
            return
        entity = lane_entity(bridge, vehicle)
        if (bridge, vehicle) not in self._lanes:
            colours = [(*rgb(colour), 255) for colour in LANE_STATES.values()]
            look = rr.StateConfiguration(values=list(LANE_STATES), colors=colours)
            self._recording.log(entity, look, static=True)
        before_ns = self._lanes.get((bridge, vehicle), 0)
        if state == "on the bridge" and moment_ns < before_ns:
            return  # of a crossing whose truck is over the next bridge already
        moment_ns = max(moment_ns, before_ns + _LANE_STEP_NS)
        self._lanes[bridge, vehicle] = moment_ns
        Dated(self._recording, moment_ns).log(entity, rr.StateChange(state=state))

    def _draw_result(self, view: CrossingView, moment_ns: int) -> str:
        """EI along the span with the roads below it; what was found in words."""
        root = result_root(view.bridge)
        compared = comparison_of(view, None)
        self._recording.set_time("time", timestamp=np.datetime64(moment_ns - 1000, "ns"))
        self._recording.log(root, rr.Clear(recursive=True))
        dated = Dated(self._recording, moment_ns)
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
        Dated(self._recording, moment_ns).log(f"said/{bridge}", document)

    def _draw_bridge(
        self, bridge: BridgeOnMap, ratios: FloatArray | None, moment_ns: int, doubtful: bool
    ) -> None:
        log_bridge(
            Dated(self._recording, moment_ns),
            bridge,
            ratios,
            doubtful=doubtful,
            map_entity=f"map/bridge/{bridge.identifier}",
            plan_entity=f"{plan_root(bridge.identifier)}/elements",
        )

    def _meet(self, bridge: str) -> None:
        """Draw a bridge for the first time."""
        if bridge in self._bridges or len(self._bridges) >= MOST_BRIDGES:
            return
        self._bridges[bridge] = None
        self._layout_is_old = True
        self._draw_text(bridge, self._latest_ns)
        found = self._site.get(bridge)
        if found is not None:
            log_surroundings(self._recording, found.on_map, {})
            self._draw_bridge(found.on_map, None, self._latest_ns, doubtful=False)
            for vehicle in self._trucks:
                log_truck_look(self._recording, f"{plan_root(bridge)}/truck/{vehicle}", vehicle)

    def _truck(self, vehicle: str) -> _Truck:
        truck = self._trucks.get(vehicle)
        if truck is None:
            truck = self._trucks[vehicle] = _Truck()
            self._layout_is_old = True
            log_marker(self._recording, f"map/position/{vehicle}")
            log_line(self._recording, f"vehicle/{vehicle}/speed", "speed", "#009E73")
            for bridge in self._bridges:
                log_truck_look(self._recording, f"{plan_root(bridge)}/truck/{vehicle}", vehicle)
        return truck

    def _near(self, places: FloatArray) -> list[str]:
        """The bridges of the site file near the last of these places."""
        if not self._starts.size:
            return []
        north, east = ((self._starts - places[-1]) * M_PER_DEGREE).T
        apart_m = np.hypot(north, east * np.cos(np.radians(places[-1, 0])))
        names = list(self._site)
        return [names[n] for n in np.flatnonzero(apart_m < _NEAR_M)]

    def _elements(self, crossing: Crossing) -> Elements | None:
        on_site = self._site.get(crossing.bridge)
        if on_site is not None:
            fits = f"EI_{on_site.elements.elements}" in (crossing.parameters or {})
            return on_site.elements if fits or crossing.parameters is None else None
        told = elements_of_result(crossing)
        if told is not None and crossing.bridge in self._bridges:
            self._told[crossing.bridge] = told
        return told

    def _note_time(self, time_ns: int) -> None:
        if time_ns > self._latest_ns:
            self._latest_ns, self._latest_s = time_ns, self._clock()

    def _moment_ns(self, vehicle: str, exit_ns: int) -> int:
        """When something was found, on the clock of the samples."""
        now_ns = self._now_ns() if vehicle in self._trucks else 0
        return now_ns if exit_ns < now_ns < exit_ns + _SOON_NS else exit_ns

    def _lanes_end_ns(self, bridge: str) -> int:
        return max((ns for (name, _), ns in self._lanes.items() if name == bridge), default=0)
