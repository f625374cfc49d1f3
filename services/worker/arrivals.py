"""Order and time in which messages from the bus are processed. No I/O, no clock."""

from collections import defaultdict
from collections.abc import Mapping
from typing import Final, NamedTuple

from schemas.signals import NS_PER_S
from schemas.topics import Key, is_from_recording, topic
from services.common.intervals import Intervals
from services.finding.streams import device_time_ns

GONE_AFTER_S = 3.0
"""Time in s that a truck without a token has for messages still in transit."""
_SILENT_S = 10.0
"""Silence in s after which a truck that never had a token, such as a replayed one, has left."""
_LOST_AFTER_S = 120.0
"""Time in s after a token's loss from which missing data count as lost.

A token is also lost when only the connection is; a truck that returns sends the missing data.
"""
_HISTORY_S = 1.0
"""Least time in s over which the history of a new or returned truck is collected.

It sends its history stream by stream, in pieces that a busy machine delays: all is sorted by time
before it is processed.
"""
_STALLED_HISTORY_S = 10.0
"""Time in s without an older message after which a history is processed as it is."""
_APART_NS = 5 * NS_PER_S
"""Time in ns by which one stream of a complete history may end before the other.

A crossing whose positions were processed long before its accelerations would count as lost.
"""
_TIMED: Final = ("accel", "gnss")
"""Streams that a crossing needs together."""
_LONGEST_HISTORY_S = 60.0
"""Time in s after which a history is processed in any case."""
_KEPT_BOOTS = 8
"""Number of the latest boots of a truck of which sequences are remembered."""


class TruckMessage(NamedTuple):
    """A message of a truck."""

    key: Key
    boot_id: int
    sequence: int
    payload: bytes
    received_s: float
    """Time of its reception by any steady clock; its processing may be much later."""


class LivenessToken(NamedTuple):
    """The arrival of a truck on the bus, or its departure."""

    realm: str
    vehicle: str
    is_alive: bool
    received_s: float


class DepartedTruck(NamedTuple):
    """A truck that left, for now or for good."""

    realm: str
    vehicle: str
    for_good: bool


class _Leave(NamedTuple):
    """Start of a truck's absence, and the absence after which it has left."""

    since_s: float
    patience_s: float


_Name = tuple[str, str, int]
"""Realm, vehicle and boot."""
_Vehicle = tuple[str, str]
"""Realm and vehicle."""


class _History:
    """Messages of a new or returned truck, collected until none that it still keeps is missing.

    `known` holds the highest sequence received before by stream, up to which none is waited for.
    """

    def __init__(self, began_s: float, known: Mapping[str, int]) -> None:
        self.messages: list[TruckMessage] = []
        self._began_s = self._grew_s = began_s
        self._sequences: defaultdict[str, Intervals] = defaultdict(Intervals)
        """Received sequences by stream."""
        for stream, highest in known.items():
            self._sequences[stream].add_range(0, highest)
        self._newest_ns = dict.fromkeys(_TIMED, 0)
        """Latest device time by stream."""

    def add(self, message: TruckMessage) -> None:
        self.messages.append(message)
        stream = message.key.stream
        sequences = self._sequences[stream]
        newest = sequences.highest
        sequences.add(message.sequence)
        is_older = newest is not None and message.sequence < newest
        if stream in _TIMED:
            time_ns = _device_time_ns(message)
            is_older |= time_ns < max(self._newest_ns.values()) - _APART_NS
            self._newest_ns[stream] = max(self._newest_ns[stream], time_ns)
        if is_older:
            self._grew_s = message.received_s

    def restart(self, now_s: float) -> None:
        """Wait as long as for a new history: the truck is back, and sends the rest."""
        self._began_s = self._grew_s = now_s

    def is_complete(self, now_s: float) -> bool:
        """Return whether nothing is missing."""
        return now_s - self._began_s >= _HISTORY_S and not self._has_missing()

    def has_stalled(self, now_s: float) -> bool:
        """Return whether what is missing is unlikely to come, although the truck is there."""
        return (
            now_s - self._grew_s >= _STALLED_HISTORY_S
            or now_s - self._began_s >= _LONGEST_HISTORY_S
        )

    def _has_missing(self) -> bool:
        """Return whether one stream ends long before the other, or sequences are missing.

        They are between others or before the first. A boot's sequences begin at 0, and a truck
        keeps as many as `cache` in the table of topics. A replay may begin anywhere.
        """
        if max(self._newest_ns.values()) - min(self._newest_ns.values()) > _APART_NS:
            return True
        realm = self.messages[0].key.realm
        return any(
            sequences.runs > 1
            or (
                sequences.contiguous_from_zero is None
                and sequences.size < topic("vehicle", stream).cache
                and not is_from_recording(realm)
            )
            for stream, sequences in self._sequences.items()
        )


class ArrivalQueue:
    """Queue that puts messages into their order of processing.

    Messages are passed in the order of their reception. `now_s` is a time up to which all received
    messages have been passed: the time of the last one passed where more wait, not the clock's.
    """

    def __init__(self) -> None:
        self._known: set[_Name] = set()
        """Boots whose messages are processed at once."""
        self._highest: defaultdict[_Name, dict[str, int]] = defaultdict(dict)
        """Highest sequence received by stream."""
        self._new: dict[_Name, _History] = {}
        self._away: set[_Vehicle] = set()
        """Trucks that left: those that return send what they measured meanwhile."""
        self._alive: set[_Vehicle] = set()
        self._cut_off: set[_Vehicle] = set()
        """Trucks whose token was lost; some of their messages may still have been in transit."""
        self._leaves: dict[_Vehicle, _Leave] = {}
        self._lost: dict[_Vehicle, float] = {}
        """Time at which the absence of a truck that left counts as permanent."""

    def add(self, message: TruckMessage) -> list[TruckMessage]:
        """Add a message; return it if it can be processed now."""
        truck = (message.key.realm, message.key.identifier)
        self._note_return(truck, message.received_s)
        if truck not in self._alive:
            self._leaves[truck] = _Leave(message.received_s, _SILENT_S)
            self._lost.pop(truck, None)
        name = (*truck, message.boot_id)
        if name not in self._highest:
            self._forget_boots(truck)
        highest, is_known = self._highest[name], name in self._known
        if not is_known and name not in self._new:
            self._new[name] = _History(message.received_s, highest)
        stream = message.key.stream
        highest[stream] = max(highest.get(stream, 0), message.sequence)
        if is_known:
            return [message]
        self._new[name].add(message)
        return []

    def _forget_boots(self, truck: _Vehicle) -> None:
        """Forget the oldest boots of a truck, of which each start brings one more."""
        boots = [name for name in self._highest if name[:2] == truck and name not in self._new]
        for name in boots[: 1 - _KEPT_BOOTS]:
            del self._highest[name]
            self._known.discard(name)

    def _note_return(self, truck: _Vehicle, now_s: float) -> None:
        """Collect a history of a truck that left and is back, as of a new one."""
        if truck in self._away:
            self._away.remove(truck)
            self._known = {name for name in self._known if name[:2] != truck}
            self._restart_histories(truck, now_s)

    def _restart_histories(self, truck: _Vehicle, now_s: float) -> None:
        for name, history in self._new.items():
            if name[:2] == truck:
                history.restart(now_s)

    def note(self, token: LivenessToken) -> None:
        """Record that a truck arrived or departed."""
        truck = (token.realm, token.vehicle)
        if token.is_alive:
            self._note_return(truck, token.received_s)
            if truck in self._cut_off:
                self._cut_off.remove(truck)
                self._restart_histories(truck, token.received_s)
            self._alive.add(truck)
            self._leaves.pop(truck, None)
            self._lost.pop(truck, None)
        else:
            self._alive.discard(truck)
            self._cut_off.add(truck)
            self._leaves[truck] = _Leave(token.received_s, GONE_AFTER_S)

    def due(self, now_s: float) -> list[TruckMessage]:
        """Return the messages of trucks' histories that are complete, in order of time.

        One of a truck that left before it had sent all is kept until the truck is lost: it may be
        back with the rest, or a recording may have it.
        """
        if not self._new:
            return []
        due: list[TruckMessage] = []
        for name, history in list(self._new.items()):
            if history.is_complete(now_s) or self._is_given_up(name[:2], history, now_s):
                self._known.add(name)
                due += sorted(self._new.pop(name).messages, key=_device_time_ns)
        return due

    def _is_given_up(self, truck: _Vehicle, history: _History, now_s: float) -> bool:
        """Return whether an incomplete history is processed as it is."""
        if truck in self._away or truck in self._cut_off:
            return truck not in self._leaves and self._lost.get(truck, now_s) <= now_s
        return history.has_stalled(now_s)

    def gone(self, now_s: float) -> list[DepartedTruck]:
        """Return the trucks found to have left since the last call."""
        gone = self._departed(now_s)
        lost = [truck for truck, lost_s in self._lost.items() if lost_s <= now_s]
        self._away.update(gone)
        for truck in gone:
            self._lost[truck] = self._leaves.pop(truck).since_s + _LOST_AFTER_S
        for truck in lost:
            del self._lost[truck]
        return [DepartedTruck(*t, for_good=False) for t in gone] + [
            DepartedTruck(*t, for_good=True) for t in lost
        ]

    def _departed(self, now_s: float) -> list[_Vehicle]:
        """Return the trucks whose absence has lasted long enough."""
        return [truck for truck, leave in self._leaves.items() if sum(leave) <= now_s]

    def leaving(self) -> dict[_Vehicle, bool]:
        """Return trucks that may be leaving, and whether messages of theirs wait here."""
        waiting = {name[:2] for name in self._new}
        return {truck: truck in waiting for truck in self._leaves}

    def is_leaving(self, key: Key) -> bool:
        """Return whether the truck of a key may be leaving."""
        return (key.realm, key.identifier) in self._leaves

    def hurry(self) -> None:
        """Wait for no truck longer than for one whose token is lost."""
        for truck, leave in self._leaves.items():
            patience_s = min(leave.patience_s, GONE_AFTER_S)
            self._leaves[truck] = leave._replace(patience_s=patience_s)


def _device_time_ns(message: TruckMessage) -> int:
    try:
        return device_time_ns(message.key.stream, message.payload)
    except ValueError:
        return 0  # the engine reports the error
