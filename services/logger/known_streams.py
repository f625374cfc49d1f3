"""Which streams and boots the logger remembers: as many as have room, the quiet ones go first.

The limit that protects others is that of one vehicle in all realms: access control ties a vehicle,
and nothing else of a key, to a certificate.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

from schemas.signals import Identity
from schemas.topics import Key

MAX_STREAMS = 8000
"""All vehicles together have no more, and again all bridges and all services."""
MAX_STREAMS_OF_ONE = 64
"""One vehicle, bridge or service has no more in all realms: a vehicle has four in each."""
MAX_BOOTS = 64
"""Boots remembered of one stream."""
_QUIET_NS = 3_600_000_000_000
"""A stream or boot that was silent for so long makes room for another one."""
_LOOK_AGAIN_NS = 60_000_000_000
"""An owner that is full is not searched for silent streams more often than this."""


@dataclass
class Stream:
    """What is remembered of a key beside the sequences that came."""

    boots: dict[int, int] = field(default_factory=dict)
    """By boot_id when it was last heard of; the longest silent one first."""
    recent: dict[tuple[int, int], int] = field(default_factory=dict)
    """By identity the CRC of the last payloads."""
    tokens: float = -1.0
    heard_ns: int = 0
    arrival_ns: int = 0
    log_time_ns: int = 0


class KnownStreams:
    """Streams by key; `forget` is called with each (key, boot_id) that goes."""

    def __init__(self, forget: Callable[[Key, int], None]) -> None:
        self._forget = forget
        self._streams: dict[Key, Stream] = {}
        self._of_one: dict[tuple[str, str], list[Key]] = {}
        self._number_of: Counter[str] = Counter()
        self._full_until_ns: dict[str, int] = {}
        """By owner: no stream is old enough before, so that none need be looked for."""

    def __len__(self) -> int:
        return len(self._streams)

    def of(self, where: Key, identity: Identity, now_ns: int) -> Stream:
        """Return what is remembered of a key; ValueError if it would be one too many."""
        stream = self._streams.get(where)
        if stream is None:
            self._make_room(where, now_ns)
            stream = self._streams[where] = Stream()
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
            boots.pop(boot_id, None)  # the one heard of last stands last
        boots[boot_id] = now_ns
        return stream

    def _make_room(self, where: Key, now_ns: int) -> None:
        """Drop a stream that is quiet if there would be one too many; ValueError if none is."""
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
                # No longer than a minute: the clock may be set meanwhile.
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
