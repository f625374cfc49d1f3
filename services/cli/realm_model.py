"""State of a realm for `driveby watch`: messages in; trucks, crossings, bridges out.

No bus, no terminal, no clock: the time is given with each message.
"""

import math
from collections import deque
from typing import Final, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from schemas.alarms import Alarm, alarm_of
from schemas.proto import driveby_pb2 as pb
from schemas.results import (
    BridgeResult,
    CrossingResult,
    LowestElement,
    lowest_element,
    verdict_line,
)
from schemas.results_on_the_wire import estimate_to_crossing, state_to_bridge
from schemas.signals import decode_accel, decode_gnss
from services.bus.realm_listener import BusMessage
from services.common.crossing_states import ON_BRIDGE, words_of_state
from services.common.errors import one_line
from services.common.language import utc_second
from services.common.naming import count_of, entry_in_name
from services.identification.comparison import Comparison, compare, estimate_of_state
from services.viewer.crossing_view import (
    ResultElements,
    comparison_of,
    elements_of_result,
    view_of_crossing,
)

_RATE_S: Final = 5.0
"""Duration in s over which rates are computed."""
_LAGS: Final = 100
"""Number of batches, of 5 to 10 s, by which a steady lag is recognised."""
_STEADY_S: Final = 0.5
"""Largest spread of a steady lag: data that are sent late catch up meanwhile."""
SILENT_S: Final = 3.0
"""Silence in s after which a truck does not drive."""
_MAX_CROSSINGS: Final = 200
_MAX_TRUCKS: Final = 200
_MAX_BRIDGES: Final = 200
_MAX_SERVICES: Final = 50


class TruckRow:
    """State of one truck, by its last messages."""

    def __init__(self) -> None:
        self.batches: deque[float] = deque(maxlen=1000)
        self.fixes: deque[float] = deque(maxlen=1000)
        self.channels: dict[str, float] = {}
        """Rate of each accelerometer in Hz."""
        self.speed_m_per_s: float | None = None
        self.lag_s = 0.0
        """Age of its newest samples at their arrival, s."""
        self.lags_s: deque[float] = deque(maxlen=_LAGS)
        """Ages of its last batches."""
        self.received_s = 0.0

    @property
    def steady_lag_s(self) -> float | None:
        """Lag that was equal for all last batches; None if it varied, or there are few."""
        if len(self.lags_s) < _LAGS or max(self.lags_s) - min(self.lags_s) > _STEADY_S:
            return None
        return min(self.lags_s)

    def rates(self, now_s: float) -> tuple[float, float]:
        """Return batches and fixes per second."""
        counts = [sum(now_s - s <= _RATE_S for s in times) for times in (self.batches, self.fixes)]
        return counts[0] / _RATE_S, counts[1] / _RATE_S


class CrossingRow(NamedTuple):
    """One crossing."""

    crossing_id: str
    vehicle: str
    bridge: str
    forward: bool
    entry_ns: int
    state: str
    """State of its identification; once it has a result, the verdict."""
    fraction: float | None = None
    ratios: tuple[float, ...] = ()
    """EI of each element over nominal."""
    weak: frozenset[int] = frozenset()
    """Numbers of the elements that are clearly less stiff than the others."""
    lowest: LowestElement | None = None
    reason: str = ""
    """Codes of its reasons."""

    @property
    def is_over(self) -> bool:
        """Whether it has its result."""
        return self.state in ("good", "suspect", "rejected", "done")


class BridgeRow(NamedTuple):
    """One bridge, from all crossings up to now."""

    used: int
    verdict: str
    ratios: tuple[float, ...]
    weak: frozenset[int]
    lowest: str
    finding: str


class ServiceRow(NamedTuple):
    """One service, by its last `health`."""

    ok: bool
    time_ns: int
    figures: dict[str, float]
    note: str
    ended: bool = False
    """Whether it has stopped in order."""

    @property
    def is_worker(self) -> bool:
        """Whether it identifies crossings."""
        return "identifying" in self.figures


class RealmModel:
    """State of one realm, of bounded size.

    `sees_trucks` is whether the credentials permit to read trucks' data, `began_s` the steady time
    from which on messages are received.
    """

    def __init__(self, *, sees_trucks: bool = True, began_s: float = -math.inf) -> None:
        self.sees_trucks = sees_trucks
        self.began_s = began_s
        self.trucks: dict[str, TruckRow] = {}
        self.crossings: dict[str, CrossingRow] = {}
        """Crossings by identity, in the order of their first messages."""
        self.bridges: dict[str, BridgeRow] = {}
        self.alarms: dict[str, Alarm] = {}
        """The last alarm of each bridge, acknowledged or not."""
        self.services: dict[str, ServiceRow] = {}
        self.work: dict[str, str] = {}
        """Present work of a service besides crossings, such as a site validation."""
        self._boots: dict[str, int] = {}
        """Boot of the last message of each service."""
        self._elements: dict[str, ResultElements] = {}

    def ingest(self, message: BusMessage, now_s: float, now_ns: int) -> str | None:
        """Add a message at a time: steady clock in s, wall clock in ns.

        Return a line on what is new for a reader of a log. Undecodable messages are skipped.
        """
        key, identity, payload = message
        if key.owner == "service":
            self._note_boot(key.identifier, identity.boot_id)
        try:
            match (key.owner, key.stream):
                case ("vehicle", "accel" | "gnss"):
                    return self._take_signal(key.identifier, key.stream, payload, now_s, now_ns)
                case ("bridge", "crossing"):
                    return self._take_state(pb.Crossing.FromString(payload), now_ns)
                case ("bridge", "estimate"):
                    return self._take_result(
                        estimate_to_crossing(pb.Estimate.FromString(payload))[0]
                    )
                case ("bridge", "state"):
                    bridge, _, state = state_to_bridge(pb.BridgeState.FromString(payload))
                    return self._take_bridge(bridge, state)
                case ("bridge", "alarm"):
                    return self._take_alarm(alarm_of(pb.Alarm.FromString(payload), key.realm))
                case ("service", "health"):
                    return self._take_health(key.identifier, pb.Health.FromString(payload))
                case ("service", "progress"):
                    self._take_progress(key.identifier, pb.Progress.FromString(payload))
        except (ValueError, DecodeError):
            pass
        return None

    @property
    def waiting(self) -> int:
        """Number of crossings without a result whose truck has left."""
        return sum(not row.is_over and row.state != ON_BRIDGE for row in self.rows())

    def rows(self) -> list[CrossingRow]:
        """Return the crossings, the newest first."""
        return sorted(self.crossings.values(), key=lambda row: row.entry_ns, reverse=True)

    def _take_signal(
        self, vehicle: str, stream: str, payload: bytes, now_s: float, now_ns: int
    ) -> str | None:
        truck = self.trucks.get(vehicle)
        is_new = truck is None or now_s - truck.received_s > SILENT_S
        if truck is None:
            if len(self.trucks) >= _MAX_TRUCKS:
                self.trucks.pop(min(self.trucks, key=lambda name: self.trucks[name].received_s))
            truck = self.trucks[vehicle] = TruckRow()
        truck.received_s = now_s
        if stream == "accel":
            batch = decode_accel(payload)
            truck.channels = {name: one.rate_hz for name, one in batch.channels.items()}
            truck.batches.append(now_s)
            lasts_s = max(one.samples.size / one.rate_hz for one in batch.channels.values())
            truck.lag_s = (now_ns - batch.wall_time_ns) * 1e-9 - lasts_s
            truck.lags_s.append(truck.lag_s)
        else:
            truck.speed_m_per_s = decode_gnss(payload).speed_m_per_s
            truck.fixes.append(now_s)
        return f"{vehicle} drives" if is_new else None

    def _take_state(self, message: pb.Crossing, now_ns: int) -> str | None:
        truck = self.trucks.get(message.vehicle)
        lag_ns = 0 if truck is None else round(1e9 * truck.lag_s)
        state = words_of_state(message, now_ns - lag_ns, sees_trucks=self.sees_trucks)
        row = self.crossings.get(message.crossing_id)
        if not state or (row is not None and (row.is_over or row.state == state)):
            return None
        forward = message.direction != pb.END_TO_START
        if row is None:
            self._make_room()
            row = CrossingRow(
                message.crossing_id, message.vehicle, message.bridge, forward,
                message.entry_time_ns, state,
            )  # fmt: skip
        self.crossings[row.crossing_id] = row._replace(state=state, fraction=None)
        return f"{_named(row)}: {state}"

    def _take_result(self, crossing: CrossingResult) -> str:
        row = CrossingRow(
            crossing.crossing_id,
            crossing.vehicle,
            crossing.bridge,
            crossing.direction == "start_to_end",
            _entry_ns(crossing),
            crossing.verdict,
            lowest=lowest_element(crossing),
            reason=", ".join(crossing.reasons),
        )
        elements = elements_of_result(crossing)
        if elements is not None:
            if len(self._elements) >= _MAX_BRIDGES:
                self._elements.pop(next(iter(self._elements)))
            self._elements[crossing.bridge] = elements
            row = _with_elements(row, crossing, elements)
        self._make_room()
        self.crossings[row.crossing_id] = row
        return f"{_named(row)}: {verdict_line(crossing)}"

    def _take_bridge(self, bridge: str, state: BridgeResult) -> str | None:
        elements = self._elements.get(bridge)
        ratios: tuple[float, ...] = ()
        weak = frozenset[int]()
        lowest = state.weakest_element or ""
        if elements is not None and len(state.elements) == elements.elements:
            nominal = elements.nominal_flexural_rigidity_nm2
            over = [
                LowestElement(name, one.mean / ei, one.q025 / ei, one.q975 / ei)
                for (name, one), ei in zip(state.elements.items(), nominal, strict=True)
            ]
            ratios = tuple(one.ratio for one in over)
            edges_m = np.concatenate(([0.0], np.cumsum(elements.lengths_m)))
            weak = _weak(compare(estimate_of_state(state), np.array(nominal), edges_m))
            lowest = str(min(over, key=lambda one: one.ratio))
        if bridge not in self.bridges and len(self.bridges) >= _MAX_BRIDGES:
            self.bridges.pop(next(iter(self.bridges)))
        used = len(state.crossings_used)
        finding = state.finding or ("" if lowest else " ".join(state.reason_texts))
        row = BridgeRow(used, state.verdict or "", ratios, weak, lowest, finding)
        if self.bridges.get(bridge) == row:
            return None
        self.bridges[bridge] = row
        return (
            f"{bridge}, {count_of(used, 'crossing')} fused: "
            f"{row.finding or row.lowest or row.verdict}"
        )

    def _take_alarm(self, alarm: Alarm) -> str | None:
        before = self.alarms.get(alarm.bridge)
        if before == alarm:
            return None  # it is republished after a restart of its service
        if before is None and len(self.alarms) >= _MAX_BRIDGES:
            self.alarms.pop(min(self.alarms, key=lambda name: _order_of_removal(self.alarms[name])))
        self.alarms[alarm.bridge] = alarm
        return f"alarm of {alarm.bridge}, {alarm_state(alarm)}: {alarm.sentence()}"

    def _note_boot(self, service: str, boot_id: int) -> None:
        """Forget the work of a service's process that another one has replaced."""
        if self._boots.get(service) != boot_id:
            if len(self._boots) >= _MAX_SERVICES:
                self._boots.pop(next(iter(self._boots)))
            self._boots[service] = boot_id
            self.work.pop(service, None)

    def _take_health(self, name: str, message: pb.Health) -> str:
        if name not in self.services and len(self.services) >= _MAX_SERVICES:
            self.services.pop(next(iter(self.services)))
        service = ServiceRow(
            message.ok, message.time_ns, dict(message.figures), message.note, message.ended
        )
        self.services[name] = service
        figures = service_figures(service)
        if service.ended:
            self.work.pop(name, None)
            return f"{name} has ended" + ("" if service.ok else f", NOT WELL: {figures}")
        return f"{name} is {'well' if service.ok else 'NOT WELL'}{figures and f': {figures}'}"

    def _take_progress(self, service: str, message: pb.Progress) -> None:
        row = self.crossings.get(message.crossing_id)
        if row is not None and not row.is_over:
            self.crossings[row.crossing_id] = row._replace(fraction=message.fraction)
        elif not message.crossing_id and message.fraction < 1.0:
            self.work[service] = f"{message.stage}, {100.0 * message.fraction:.0f} %"
        else:
            self.work.pop(service, None)

    def _make_room(self) -> None:
        if len(self.crossings) >= _MAX_CROSSINGS:
            self.crossings.pop(min(self.crossings, key=lambda name: self.crossings[name].entry_ns))


def _entry_ns(crossing: CrossingResult) -> int:
    """Return the entry in the crossing's name, as its states have it; else the estimated one."""
    entry = entry_in_name(crossing.crossing_id)
    if entry is None:
        return round(crossing.entry_time * 1e9)
    return round(entry.timestamp() * 1e3) * 1_000_000


def route_text(row: CrossingRow) -> str:
    """Return vehicle, bridge and direction."""
    return f"{row.vehicle} {'→' if row.forward else '←'} {row.bridge}"


def _named(row: CrossingRow) -> str:
    """Return a crossing's direction and entry time, which distinguish it in a log."""
    return f"{route_text(row)}, entry {utc_second(row.entry_ns * 1e-9)}"


def _order_of_removal(alarm: Alarm) -> tuple[bool, float]:
    """Return a sort key for removal: acknowledged alarms before active ones, then the oldest."""
    return alarm.acknowledged is None, alarm.raised


def alarm_state(alarm: Alarm) -> str:
    """Return whether an alarm is active, or who acknowledged it."""
    note = alarm.acknowledged
    return "active" if note is None else f"acknowledged by {one_line(note.by)}"


def service_figures(service: ServiceRow, age_s: float | None = None) -> str:
    """Return the figures of a service that are shown besides its health.

    With the age of its message, the time of the longest identification goes on.
    """
    known = service.figures
    parts = []
    number = round(known.get("identifying", 0.0))
    if age_s is not None and number:
        longest_s = known.get("identifying_longest_s", 0.0) + max(age_s, 0.0)
        several = f" {number} crossings, the longest" if number > 1 else ""
        parts.append(f"identifying{several} for {longest_s:.0f} s")
    if "rate_per_s" in known:
        parts.append(f"{known['rate_per_s']:.0f} messages/s")
    parts += [f"{name} {known[name]:.0f}" for name in ("queue", "lost", "dropped") if name in known]
    if service.note:
        parts.append(service.note)
    return ", ".join(parts)


def _with_elements(
    row: CrossingRow, crossing: CrossingResult, elements: ResultElements
) -> CrossingRow:
    view = view_of_crossing(crossing, elements)
    if view.rigidity_nm2 is None or view.interval_nm2 is None:
        return row
    ratios = tuple((view.rigidity_nm2 / view.nominal_nm2).tolist())
    compared = comparison_of(view) if view.verdict == "good" else None
    return row._replace(ratios=ratios, weak=_weak(compared))


def _weak(compared: Comparison | None) -> frozenset[int]:
    return frozenset(one.number for one in (compared.weak if compared else ()))
