"""What the logger does with a message before it is written: checks, counts, tells duplicates.

No I/O and no clock of its own: messages go in, messages and events come out.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from schemas.events import Event, EventKind
from schemas.messages import check_payload
from schemas.signals import Identity
from schemas.topics import Key, topic
from services.common.bus import Received, Seen
from services.common.recording import Message

GAP_PATIENCE_S = 5.0
"""How long a missing message may take to be fetched before a gap is written down."""
_MAX_REFUSED_SOURCES = 1000


class Refusals(NamedTuple):
    """Messages refused since the last report, of one vehicle or of nobody known."""

    first_reason: str
    number: int


@dataclass
class Intake:
    """What has come so far, and what is to be reported about it."""

    realm: str | None
    """Realm to which events belong that concern no known key; None: live."""
    own_service: str
    own_boot_id: int
    """What this logger says itself comes back from the bus, and has been written already."""
    seen: Seen = field(default_factory=Seen)
    counts: Counter[str] = field(default_factory=Counter)
    """received (of logged topics), accepted, refused, duplicates, recovered, lost."""
    _refused: dict[tuple[str, str], Refusals] = field(default_factory=dict)
    _late: Counter[tuple[Key, int]] = field(default_factory=Counter)
    _holes: dict[tuple[Key, int], dict[tuple[int, int], float]] = field(default_factory=dict)
    _reported: dict[tuple[Key, int], set[tuple[int, int]]] = field(default_factory=dict)

    def take(self, received: Received, now_ns: int) -> Message | None:
        """Return the message to write, or None if it is refused, not logged or a duplicate."""
        where: Key | None = None
        try:
            where = received.key()
            row = topic(where.owner, where.stream)
            if not row.logged:
                return None
            identity = received.identity()
            if where.identifier == self.own_service and identity.boot_id == self.own_boot_id:
                return None
            self.counts["received"] += 1
            log_time_ns = check_payload(row, received.payload)
        except ValueError as error:
            self._refuse(where, str(error))
            return None
        if not self._is_new(where, identity):
            self.counts["duplicates"] += 1
            return None
        self.counts["accepted"] += 1
        return Message(where, received.payload, *identity, log_time_ns, now_ns)

    def report(
        self, now_ns: int, now_s: float, *, closing: bool = False
    ) -> list[tuple[Key, Event]]:
        """Return the events that are due, each with a key of the realm and vehicle concerned.

        `now_s` is a monotonic clock. When `closing`, what is missing now is reported at once.
        """
        events: list[tuple[Key, Event]] = []
        for (realm, vehicle), refusals in self._refused.items():
            event = Event(
                EventKind.REFUSED,
                now_ns,
                refusals.first_reason,
                vehicle=vehicle,
                messages=refusals.number,
            )
            events.append((Key(realm, "vehicle", vehicle, ""), event))
        self._refused.clear()
        for (where, boot_id), number in self._late.items():
            text = "came late and stand later in the file"
            events.append(_event(where, boot_id, EventKind.RECOVERED, now_ns, text, number))
        self._late.clear()
        patience_s = 0.0 if closing else GAP_PATIENCE_S
        events += self._gaps(now_ns, now_s, patience_s)
        return events

    def _is_new(self, where: Key, identity: Identity) -> bool:
        name = (where, identity.boot_id)
        before = self.seen.streams.get(name)
        highest = before.highest if before is not None else None
        if not self.seen.add(where, identity):
            return False
        if highest is not None and identity.sequence < highest:
            self._late[name] += 1
            self.counts["recovered"] += 1
        return True

    def _refuse(self, where: Key | None, reason: str) -> None:
        self.counts["refused"] += 1
        realm = where.realm if where else self.realm or "live"
        vehicle = where.identifier if where and where.owner == "vehicle" else ""
        name = (realm, vehicle)
        if name not in self._refused and len(self._refused) >= _MAX_REFUSED_SOURCES:
            name = (self.realm or "live", "")
        first_reason, number = self._refused.get(name, Refusals(reason, 0))
        self._refused[name] = Refusals(first_reason, number + 1)

    def _gaps(self, now_ns: int, now_s: float, patience_s: float) -> list[tuple[Key, Event]]:
        events = []
        for name, numbers in self.seen.streams.items():
            holes = numbers.holes()
            since = self._holes.pop(name, {})
            if not holes:
                continue
            self._holes[name] = {hole: since.get(hole, now_s) for hole in holes}
            reported = self._reported.setdefault(name, set())
            for hole, first_s in self._holes[name].items():
                if hole in reported or now_s - first_s < patience_s:
                    continue
                reported.add(hole)
                first, last = hole
                self.counts["lost"] += last - first + 1
                where, boot_id = name
                key_, event = _event(
                    where, boot_id, EventKind.GAP, now_ns, "missing", last - first + 1
                )
                events.append((key_, event._replace(first_sequence=first, last_sequence=last)))
        return events


def _event(
    where: Key, boot_id: int, kind: EventKind, now_ns: int, text: str, number: int
) -> tuple[Key, Event]:
    vehicle = where.identifier if where.owner == "vehicle" else ""
    event = Event(
        kind,
        now_ns,
        f"{number} messages of {where.owner}/{where.identifier}/{where.stream} {text}",
        vehicle=vehicle,
        stream=where.stream,
        boot_id=boot_id,
        messages=number,
    )
    return where, event
