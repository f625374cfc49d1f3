"""The streams and boots in the logger's memory: bounded, quiet ones are evicted first.

The limit that protects others applies to one vehicle in all realms: access control ties a vehicle,
and nothing else of a key, to a certificate.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from schemas.signals import Identity
from schemas.topics import Key

MAX_STREAMS = 8000
"""Largest number of streams of all vehicles, of all bridges and of all services."""
MAX_STREAMS_OF_ONE = 64
"""Largest number of streams of one owner in all realms; a vehicle has four in each."""
MAX_BOOTS = 64
"""Largest number of boots of one stream."""
_QUIET_NS = 3_600_000_000_000
"""Silence after which a stream or boot may be evicted."""
_LOOK_AGAIN_NS = 60_000_000_000
"""Interval of searches for silent streams of a full owner."""


@dataclass
class StreamRecord:
    """Memory of a key besides its received sequences."""

    boots: dict[int, int] = field(default_factory=dict)
    """Time of the last message by boot_id; the longest silent one first."""
    recent: dict[tuple[int, int], int] = field(default_factory=dict)
    """CRC of the last payloads by identity."""
    tokens: float = -1.0
    heard_ns: int = 0
    arrival_ns: int = 0
    log_time_ns: int = 0


class StreamCache:
    """Stream records by key; `forget` is called with each evicted (key, boot_id)."""

    def __init__(self, forget: Callable[[Key, int], None]) -> None:
        self._forget = forget
        self._streams: dict[Key, StreamRecord] = {}
        self._of_one: dict[tuple[str, str], list[Key]] = {}
        self._number_of: Counter[str] = Counter()
        self._full_until_ns: dict[str, int] = {}
        """Time by owner before which no stream is old enough to be evicted."""

    def __len__(self) -> int:
        return len(self._streams)

    def of(self, where: Key, identity: Identity, now_ns: int) -> StreamRecord:
        """Return the record of a key; raise ValueError beyond the limits."""
        stream = self._streams.get(where)
        if stream is None:
            self._make_room(where, now_ns)
            stream = self._streams[where] = StreamRecord()
            self._of_one.setdefault((where.owner, where.identifier), []).append(where)
            self._number_of[where.owner] += 1
        stream.heard_ns = now_ns
        boots, boot_id = stream.boots, identity.boot_id
        if boot_id not in boots and len(boots) >= MAX_BOOTS:
            oldest, heard_ns = next(iter(boots.items()))
            if abs(now_ns - heard_ns) < _QUIET_NS:
                raise ValueError(f"{where.stream}: more than {MAX_BOOTS} boots within an hour")
            del boots[oldest]
            self._forget(where, oldest)
        if len(boots) > 1:
            boots.pop(boot_id, None)  # the most recent one stands last
        boots[boot_id] = now_ns
        return stream

    def _make_room(self, where: Key, now_ns: int) -> None:
        """Evict a quiet stream if there would be one too many; raise ValueError if none is."""
        owner = where.owner
        own = self._of_one.get((owner, where.identifier), [])
        if len(own) >= MAX_STREAMS_OF_ONE:
            oldest = min(own, key=self._heard_ns)
            if abs(now_ns - self._heard_ns(oldest)) < _QUIET_NS:
                raise ValueError(
                    f"more than {MAX_STREAMS_OF_ONE} streams of {owner} {where.identifier} "
                    "within an hour"
                )
            self._drop(oldest)
        elif self._number_of[owner] >= MAX_STREAMS:
            full = ValueError(f"more than {MAX_STREAMS} streams of all {owner}s")
            if now_ns < self._full_until_ns.get(owner, 0):
                raise full
            oldest = min((one for one in self._streams if one.owner == owner), key=self._heard_ns)
            heard_ns = self._heard_ns(oldest)
            if abs(now_ns - heard_ns) < _QUIET_NS:
                # At most a minute: the clock may be set meanwhile.
                until_ns = min(heard_ns + _QUIET_NS, now_ns + _LOOK_AGAIN_NS)
                self._full_until_ns[owner] = until_ns
                raise full
            self._drop(oldest)

    def _heard_ns(self, where: Key) -> int:
        return self._streams[where].heard_ns

    def _drop(self, where: Key) -> None:
        for boot_id in self._streams.pop(where).boots:
            self._forget(where, boot_id)
        self._number_of[where.owner] -= 1
        own = self._of_one[(where.owner, where.identifier)]
        own.remove(where)
        if not own:
            del self._of_one[(where.owner, where.identifier)]
