"""Intake of messages before they are written: checks, counts, duplicates.

No I/O and no clock of its own: messages go in, messages and events come out. Hostile senders cannot
exhaust memory: streams, boots of each, gaps, and sources of refusals are bounded. One vehicle
cannot use up the limits of others: they apply to one vehicle in all realms, because access control
ties it to a certificate.
"""

import zlib
from bisect import bisect_right
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from schemas.events import Event, EventKind
from schemas.messages import check_stamp
from schemas.signals import Identity
from schemas.topics import Key, Message, Topic, topic
from services.bus.subscription import RawSample, SeenSequences
from services.common.intervals import Intervals
from services.common.naming import count_of
from services.logger.clock_watch import ClockWatch
from services.logger.known_streams import StreamCache, StreamRecord
from services.logger.shared_names import SharedNames

GAP_PATIENCE_S = 5.0
"""Time to fetch a missing message before a gap is recorded."""
MAX_RUNS = 10_000
"""Largest number of contiguous ranges of one stream and boot, one more than gaps."""
RATE_FACTOR = 50
"""Largest rate relative to nominal, for longer than a cache lasts; no sensor exceeds it."""
_RATE_ON_OCCASION_HZ = 100.0
"""Limit of a stream without a nominal rate."""
_LEAST_BURST = 1000
"""Number of messages that a restored link may bring at once, whatever the stream."""
_MAX_REFUSED_SOURCES = 100
"""Largest number of sources with a count of their own in a report; others are counted together."""
_REFUSALS_PERIOD_S = 60.0
"""Interval of events on refusals of one source, with a count."""
_RECENT = 256
"""Number of checksums of a stream, to distinguish a repeated message from another of its number."""


class Refusals(NamedTuple):
    """Messages refused since the last report, of one vehicle or of unknown source."""

    realm: str
    """The realm of the first one."""
    first_reason: str
    number: int


@dataclass
class Intake:
    """The messages received so far, and events to report."""

    realm: str | None
    """Realm of events without a known key; None: live."""
    own_service: str
    own_boot_id: int
    """Boot of this logger's own messages, which come back from the bus and are already written."""
    seen: SeenSequences = field(default_factory=SeenSequences)
    counts: Counter[str] = field(default_factory=Counter)
    """Counts: received (of logged topics), accepted, refused, duplicates, recovered, missing, lost.
    """
    forgotten: list[tuple[Key, int]] = field(default_factory=list)
    """Streams and boots without memory any more; the caller empties it."""
    settled: list[tuple[Key, int, int, int]] = field(default_factory=list)
    """Stream, boot, first and last of messages that will never be written; the caller empties it.
    """
    shared_names: SharedNames = field(default_factory=SharedNames)
    _streams: StreamCache = field(init=False)
    _clocks: ClockWatch = field(default_factory=ClockWatch)
    _refused: dict[str, Refusals] = field(default_factory=dict)
    _refused_reported_s: dict[str, float] = field(default_factory=dict)
    _late: Counter[tuple[Key, int]] = field(default_factory=Counter)
    _lost: dict[tuple[Key, int], Intervals] = field(default_factory=dict)
    """Lost messages to report."""
    _given_up: dict[tuple[Key, int], Intervals] = field(default_factory=dict)
    """Lost messages, which may arrive all the same: a truck with a full disk holds only those that
    are on their way."""
    _gaps: dict[tuple[Key, int], dict[tuple[int, int], float]] = field(default_factory=dict)
    _reported: dict[tuple[Key, int], Intervals] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._streams = StreamCache(self._forget)

    def accept(self, received: RawSample, now_ns: int) -> Message | None:
        """Return the message to write, or None if it is refused, not logged or a duplicate."""
        where: Key | None = None
        identity: Identity | None = None
        try:
            where = received.key()
            row = topic(where.owner, where.stream)
            if not row.logged:
                return None
            identity = received.identity()
            if where.identifier == self.own_service and identity.boot_id == self.own_boot_id:
                return None
            self.counts["received"] += 1
            stamp = check_stamp(row, received.payload)
            if stamp.identity not in (None, identity):
                raise ValueError(
                    f"{row.owner}/{row.stream}: the payload has {stamp.identity[0]}, "
                    f"{stamp.identity[1]} where its attachment has {identity[0]}, {identity[1]}"
                )
            stream = self._streams.of(where, identity, now_ns)
            if not received.recovered:
                _check_rate(row, stream, stamp.wall_time_ns, now_ns)
            is_new = self._is_new(where, identity, stream, received.payload)
        except ValueError as error:
            self._refuse(where, str(error))
            if received.spooled and where is not None and identity is not None:
                # There is no better copy: it would be requested for ever.
                self._settle(where, *identity)
            return None
        if not is_new:
            self.counts["duplicates"] += 1
            return None
        self.counts["accepted"] += 1
        if not received.recovered:
            self._clocks.note(where, identity, stamp, now_ns)
            self.shared_names.note(where, identity.boot_id, now_ns)
        return Message(where, received.payload, *identity, stamp.wall_time_ns, now_ns)

    def adopt(self, where: Key, boot_id: int, first: int, last: int, now_ns: int) -> bool:
        """Note messages on disk from an earlier run; return False (a refusal) beyond the limits."""
        try:
            self._streams.of(where, Identity(boot_id, first), now_ns)
        except ValueError as error:
            self._refuse(where, str(error))
            return False
        self.seen.numbers(where, boot_id).add_range(first, last)
        return True

    def forget_seen(self, where: Key, boot_id: int, numbers: Intervals) -> None:
        """Treat messages as new when they come again, because their file is gone."""
        seen = self.seen.streams.get((where, boot_id))
        if seen is not None:
            for first, last in numbers.ranges():
                seen.remove_range(first, last)

    def mark_lost(self, where: Key, boot_id: int, first: int, last: int, now_ns: int) -> None:
        """Give up messages that no publisher holds any more."""
        try:
            self._streams.of(where, Identity(boot_id, first), now_ns)
        except ValueError as error:
            self._refuse(where, str(error))
            return
        seen = self.seen.numbers(where, boot_id)
        for a, b in seen.missing_of([(first, last)]):
            self.counts["lost"] += seen.add_range(a, b)
            for memory in (self._lost, self._given_up):
                memory.setdefault((where, boot_id), Intervals()).add_range(a, b)
            self.settled.append((where, boot_id, a, b))

    def report(
        self, now_ns: int, now_s: float, *, closing: bool = False
    ) -> list[tuple[Key, Event]]:
        """Return the events that are due, each with a key of the realm and vehicle concerned.

        `now_s` is a monotonic clock. When `closing`, current gaps are reported at once.
        """
        events = self._clocks.steps(self.realm or "live", now_ns, now_s)
        events += self._refusals(now_ns, now_s, closing=closing)
        for (where, boot_id), number in self._late.items():
            text = "received late and written later in the file"
            events.append(_event(where, boot_id, EventKind.RECOVERED, now_ns, text, number))
        self._late.clear()
        for (where, boot_id), numbers in self._lost.items():
            for first, last in numbers.ranges():
                text = "lost; no longer in the truck's spool"
                events.append(
                    _event(where, boot_id, EventKind.LOST, now_ns, text, last - first + 1, first)
                )
        self._lost.clear()
        patience_s = 0.0 if closing else GAP_PATIENCE_S
        events += self._gap_events(now_ns, now_s, patience_s)
        events += self._clocks.drifts(now_ns, now_s)
        return events

    def lag_s(self) -> float:
        """Return the longest delay of live messages since the last call."""
        return self._clocks.lag_s()

    def clock_figures(self) -> dict[str, float]:
        """Return each truck's lag behind the logger's clock, and its drift, by name."""
        return self._clocks.figures()

    def _forget(self, where: Key, boot_id: int) -> None:
        name = (where, boot_id)
        for memory in (self.seen.streams, self._gaps, self._reported, self._given_up):
            memory.pop(name, None)
        self.forgotten.append(name)
        self._clocks.forget(where, boot_id)
        self.shared_names.forget(where, boot_id)

    def _is_new(self, where: Key, identity: Identity, stream: StreamRecord, payload: bytes) -> bool:
        name = (where, identity.boot_id)
        numbers = self.seen.numbers(where, identity.boot_id)
        highest = numbers.highest
        sequence = identity.sequence
        if numbers.runs >= MAX_RUNS and not _touches(numbers, sequence):
            raise ValueError(f"{where.stream}: more than {MAX_RUNS} gaps in the sequence")
        crc = zlib.crc32(payload)
        if not numbers.add(sequence):
            if stream.recent.get(identity, crc) != crc:
                raise ValueError(
                    f"{where.stream}: sequence {sequence} received again with other content"
                )
            given_up = self._given_up.get(name, Intervals())
            if given_up.runs > MAX_RUNS or not given_up.remove_range(sequence, sequence):
                return False
        stream.recent[identity] = crc
        if len(stream.recent) > _RECENT:
            del stream.recent[next(iter(stream.recent))]
        if highest is not None and sequence < highest:
            self._late[name] += 1
            self.counts["recovered"] += 1
        return True

    def _settle(self, where: Key, boot_id: int, sequence: int) -> None:
        name = (where, boot_id)
        if name in self.seen.streams and self.seen.add(where, Identity(boot_id, sequence)):
            self.settled.append((where, boot_id, sequence, sequence))

    def _refuse(self, where: Key | None, reason: str) -> None:
        self.counts["refused"] += 1
        realm = where.realm if where else self.realm or "live"
        vehicle = where.identifier if where and where.owner == "vehicle" else ""
        # The number of realms of a vehicle must not affect others.
        name = vehicle or _no_vehicle(realm)
        if name not in self._refused and len(self._refused) >= _MAX_REFUSED_SOURCES:
            name = _no_vehicle(self.realm or "live")
        before = self._refused.get(name, Refusals(realm, reason, 0))
        self._refused[name] = before._replace(number=before.number + 1)

    def _refusals(self, now_ns: int, now_s: float, *, closing: bool) -> list[tuple[Key, Event]]:
        events: list[tuple[Key, Event]] = []
        reported = self._refused_reported_s
        for name in [name for name, at_s in reported.items() if now_s - at_s >= _REFUSALS_PERIOD_S]:
            del reported[name]
        for name, refusals in list(self._refused.items()):
            if not closing and (name in reported or len(reported) >= _MAX_REFUSED_SOURCES):
                continue
            vehicle = "" if name == _no_vehicle(refusals.realm) else name
            reported[name] = now_s
            del self._refused[name]
            event = Event(
                EventKind.REFUSED,
                now_ns,
                refusals.first_reason,
                vehicle=vehicle,
                messages=refusals.number,
            )
            events.append((Key(refusals.realm, "vehicle", vehicle, ""), event))
        return events

    def _gap_events(self, now_ns: int, now_s: float, patience_s: float) -> list[tuple[Key, Event]]:
        events = []
        missing = 0
        for name, numbers in self.seen.streams.items():
            since = self._gaps.pop(name, {})
            if numbers.runs < 2:
                continue
            gaps = {gap: _since(since, gap, now_s) for gap in numbers.gaps()}
            self._gaps[name] = gaps
            reported = self._reported.setdefault(name, Intervals())
            for gap, first_s in gaps.items():
                if now_s - first_s < patience_s:
                    continue
                missing += gap[1] - gap[0] + 1
                for first, last in reported.missing_of([gap]):
                    reported.add_range(first, last)
                    where, boot_id = name
                    number = last - first + 1
                    events.append(
                        _event(where, boot_id, EventKind.GAP, now_ns, "missing", number, first)
                    )
        self.counts["missing"] = missing
        return events


def _no_vehicle(realm: str) -> str:
    """Return the name under which refusals without a vehicle are counted."""
    return f"/{realm}"  # no vehicle can be called that


def _check_rate(row: Topic, stream: StreamRecord, log_time_ns: int, now_ns: int) -> None:
    """Raise ValueError if a stream is faster than any sensor, by the clock and by its own times.

    Both are necessary: a replay is fast by the clock, a truck with a stopped wall clock by its
    times.
    """
    nominal_hz = row.nominal_rate_hz
    limit_hz = RATE_FACTOR * nominal_hz if nominal_hz is not None else _RATE_ON_OCCASION_HZ
    burst = float(max(2 * row.cache, _LEAST_BURST))
    passed_ns = max(now_ns - stream.arrival_ns, log_time_ns - stream.log_time_ns, 0)
    tokens = burst if stream.tokens < 0.0 else stream.tokens + passed_ns * 1e-9 * limit_hz
    stream.arrival_ns = now_ns
    stream.log_time_ns = max(stream.log_time_ns, log_time_ns)
    stream.tokens = min(burst, tokens)
    if stream.tokens < 1.0:
        raise ValueError(f"{row.owner}/{row.stream}: more than {limit_hz:.0f} messages a second")
    stream.tokens -= 1.0


def _touches(numbers: Intervals, sequence: int) -> bool:
    return any(n in numbers for n in (sequence, sequence - 1, sequence + 1))


def _since(before: dict[tuple[int, int], float], gap: tuple[int, int], now_s: float) -> float:
    """Return the start of a gap, also if it was part of a larger one."""
    if gap in before:
        return before[gap]
    larger = list(before)
    at = bisect_right(larger, gap[0], key=lambda one: one[0]) - 1
    if at >= 0 and larger[at][1] >= gap[1]:
        return before[larger[at]]
    return now_s


def _event(
    where: Key,
    boot_id: int,
    kind: EventKind,
    now_ns: int,
    text: str,
    number: int,
    first: int | None = None,
) -> tuple[Key, Event]:
    vehicle = where.identifier if where.owner == "vehicle" else ""
    event = Event(
        kind,
        now_ns,
        f"{count_of(number, 'message')} of {where.owner}/{where.identifier}/{where.stream} {text}",
        vehicle=vehicle,
        stream=where.stream,
        boot_id=boot_id,
        first_sequence=first or 0,
        last_sequence=0 if first is None else first + number - 1,
        messages=number,
    )
    return where, event
