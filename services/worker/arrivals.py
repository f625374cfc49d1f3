"""In which order and when what comes from the bus is looked at. No I/O, no clock."""

from typing import NamedTuple

from schemas.topics import Key
from services.identification.streams import device_time_ns

GONE_AFTER_S = 3.0
"""A truck whose token has gone is given this long for what is still on its way."""
_SILENT_S = 10.0
"""So long must a truck be silent that has no token, such as a replayed one, to have gone."""
_LOST_AFTER_S = 120.0
"""A token also goes when only the connection is lost. So long after it, what is missing in the
middle of a crossing is taken to be lost: who comes back brings it."""
_HISTORY_S = 1.0
"""A truck that is new here sends its history stream by stream: what comes in the first second is
put in order of time before it is looked at."""


class Arrived(NamedTuple):
    """A message of a truck."""

    key: Key
    boot_id: int
    payload: bytes
    received_s: float
    """When it came, on any steady clock: it may wait long before anybody looks at it."""


class Token(NamedTuple):
    """A truck has come to the bus or left it."""

    realm: str
    vehicle: str
    is_alive: bool
    received_s: float


class Gone(NamedTuple):
    """A truck that left and did not come back, shortly or for good."""

    realm: str
    vehicle: str
    for_good: bool


class _Leave(NamedTuple):
    """Since when nothing tells that a truck is there, and how long that is too little to tell."""

    since_s: float
    patience_s: float


_Name = tuple[str, str, int]
"""Realm, vehicle and boot."""
_Vehicle = tuple[str, str]
"""Realm and vehicle."""


class Arrivals:
    """Puts what comes in the order in which it is to be looked at.

    What came first must be told first. `now_s` is a moment up to which everything that came has
    been told: where more waits, the moment at which the last that was told came, not the clock's.
    """

    def __init__(self) -> None:
        self._known: set[_Name] = set()
        self._new: dict[_Name, list[Arrived]] = {}
        self._since: dict[_Name, float] = {}
        self._alive: set[_Vehicle] = set()
        self._leaves: dict[_Vehicle, _Leave] = {}
        self._lost: dict[_Vehicle, float] = {}
        """When a truck that has gone is taken not to come back."""

    def add(self, arrived: Arrived) -> list[Arrived]:
        """Take a message in; return it if it can be looked at now."""
        truck = (arrived.key.realm, arrived.key.identifier)
        if truck not in self._alive:
            self._leaves[truck] = _Leave(arrived.received_s, _SILENT_S)
            self._lost.pop(truck, None)
        name = (arrived.key.realm, arrived.key.identifier, arrived.boot_id)
        if name in self._known:
            return [arrived]
        self._new.setdefault(name, []).append(arrived)
        self._since.setdefault(name, arrived.received_s)
        return []

    def note(self, token: Token) -> None:
        """Note that a truck has come or gone."""
        truck = (token.realm, token.vehicle)
        if token.is_alive:
            self._alive.add(truck)
            self._leaves.pop(truck, None)
            self._lost.pop(truck, None)
        else:
            self._alive.discard(truck)
            self._leaves[truck] = _Leave(token.received_s, GONE_AFTER_S)

    def due(self, now_s: float) -> list[Arrived]:
        """What trucks that are new have sent in their first second, in order of time."""
        due: list[Arrived] = []
        for name in [n for n, since_s in self._since.items() if since_s + _HISTORY_S <= now_s]:
            self._known.add(name)
            del self._since[name]
            due += sorted(self._new.pop(name), key=_device_time_ns)
        return due

    def gone(self, now_s: float) -> list[Gone]:
        """The trucks of which it has turned out since the last call that they have gone."""
        gone = [t for t, leave in self._leaves.items() if sum(leave) <= now_s]
        lost = [truck for truck, lost_s in self._lost.items() if lost_s <= now_s]
        for truck in gone:
            self._lost[truck] = self._leaves.pop(truck).since_s + _LOST_AFTER_S
        for truck in lost:
            del self._lost[truck]
        return [Gone(*t, for_good=False) for t in gone] + [Gone(*t, for_good=True) for t in lost]

    def leaving(self) -> dict[_Vehicle, bool]:
        """Trucks that may be about to go, and whether something of theirs waits here."""
        waiting = {name[:2] for name in self._new}
        return {truck: truck in waiting for truck in self._leaves}

    def is_leaving(self, key: Key) -> bool:
        """Whether the truck of a key may be about to go."""
        return (key.realm, key.identifier) in self._leaves

    def hurry(self) -> None:
        """Wait for nobody longer than for a truck whose token has gone."""
        for truck, leave in self._leaves.items():
            patience_s = min(leave.patience_s, GONE_AFTER_S)
            self._leaves[truck] = leave._replace(patience_s=patience_s)


def _device_time_ns(arrived: Arrived) -> int:
    try:
        return device_time_ns(arrived.key.stream, arrived.payload)
    except ValueError:
        return 0  # the engine will say what is wrong
