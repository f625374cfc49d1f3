"""Index of the messages in recordings, for their identification in a second pass.

A recording keeps the order of arrival, an identification needs that of measurement: a spool
delivers late what could not be sent at once. So the order is determined first, at sixteen bytes a
message, and data required from the beginning are kept: the trucks' descriptions, and their
positions near bridges. Then the messages are read again, and one that arrived too early waits for
those before it. The memory grows with the late messages, not with the length of the drive. Small
recordings are kept and not read twice.
"""

import logging
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import decode_gnss
from schemas.site import Site
from schemas.topics import Key, Message
from services.common.errors import InputError
from services.finding.bridges import Bridges
from services.finding.streams import device_time_ns

STREAMS = ("accel", "gnss", "info")
_log = logging.getLogger(__name__)

_COMPARED = 256
"""Number of sequence numbers at the start of a boot whose content is compared."""
_SMALL_BYTES = 64 << 20
"""Size of the messages below which a recording is not read a second time."""
_BESIDE_BYTES = 400
"""Memory of a message in addition to its payload."""

Read = Callable[[], Iterable[Message]]
"""Type of a reader that returns all messages of trucks from the beginning at each call."""

_Truck = tuple[str, str]
"""Realm and vehicle."""


class MessageIndex(NamedTuple):
    """Index of the messages that an identification reads."""

    name: str
    """Name of the source in errors."""
    read: Read
    order: dict[_Truck, NDArray[np.int64]]
    """Rank by time of measurement of the n-th sample or fix of each truck."""
    infos: dict[tuple[_Truck, int], list[Message]]
    """Descriptions of each truck by boot, which apply to the whole boot."""
    near: list[Message]
    """Fixes near a bridge: another truck may be on it."""
    drove: set[str]
    """Vehicles that sent samples or fixes."""


def cached_reader(read: Callable[[bool], Iterable[Message]]) -> Read:
    """Return a reader that caches small sources; `read` is passed whether it is called again."""
    kept: list[Message] | None = None
    is_again = False

    def reading() -> Iterator[Message]:
        nonlocal kept, is_again
        if kept is not None:
            yield from kept
            return
        small: list[Message] | None = [] if not is_again else None
        messages, is_again, size = read(is_again), True, 0
        for message in messages:
            if small is not None:
                size += len(message.payload) + _BESIDE_BYTES
                small.append(message)
                if size > _SMALL_BYTES:
                    small = None
            yield message
        kept = small

    return reading


def index_messages(name: str, read: Read, site: Site) -> MessageIndex:
    """Read all messages once; errors refer to them as `name`.

    Raise InputError for a malformed message, and without accelerations or positions.
    """
    bridges = Bridges(site.bridges, site.receiver)
    made: dict[_Truck, tuple[array[int], array[int]]] = {}
    infos: dict[tuple[_Truck, int], list[Message]] = {}
    near: list[Message] = []
    seen: set[str] = set()
    repeated = _RepeatedStarts(name)
    for message in read():
        key = message.key
        if key.owner != "vehicle" or key.stream not in STREAMS:
            continue
        repeated.check(message)
        seen.add(key.stream)
        if key.stream == "info":
            infos.setdefault((_truck(key), message.boot_id), []).append(message)
            continue
        boots, times_ns = made.setdefault(_truck(key), (array("Q"), array("q")))
        try:
            if key.stream == "gnss":
                fix = decode_gnss(message.payload)
                times_ns.append(fix.device_time_ns)
                if bridges.around(fix.latitude_deg, fix.longitude_deg):
                    near.append(message)
            else:
                times_ns.append(device_time_ns(key.stream, message.payload))
        except ValueError as error:
            raise malformed(name, message, error) from error
        boots.append(message.boot_id)
    for stream, what in (("accel", "accelerations (accel)"), ("gnss", "positions (gnss)")):
        if stream not in seen:
            raise InputError(f"{name}: no {what}, a recording of a truck is expected")
    repeated.warn()
    order = {truck: _ranks(*two) for truck, two in made.items()}
    return MessageIndex(name, read, order, infos, near, {vehicle for _, vehicle in made})


class _RepeatedStarts:
    """Warning of drives of a truck with one start, of which only the first counts."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._checksums: dict[tuple[Key, int, int], set[int]] = {}

    def check(self, message: Message) -> None:
        """Note the content of a sequence number of a boot: each drive has another one."""
        if message.sequence < _COMPARED:
            identity = (message.key, message.boot_id, message.sequence)
            self._checksums.setdefault(identity, set()).add(zlib.crc32(message.payload))

    def warn(self) -> None:
        """Warn once for each truck, with the number of its drives."""
        drives: dict[_Truck, int] = {}
        for (key, _, _), contents in self._checksums.items():
            truck = _truck(key)
            drives[truck] = max(drives.get(truck, 1), len(contents))
        for (_, vehicle), number in drives.items():
            if number > 1:
                _log.warning(
                    "%s: %s has %d drives with the same start; only the first one counts "
                    "(driveby simulate --start gives another start)",
                    *(self._name, vehicle, number),
                )


def in_measurement_order(overview: MessageIndex) -> Iterator[Message]:
    """Yield the messages of each truck boot by boot, by its own clock, its description first."""
    infos = dict(overview.infos)
    for message in _in_order(overview):
        yield from infos.pop((_truck(message.key), message.boot_id), ())
        yield message


def _in_order(overview: MessageIndex) -> Iterator[Message]:
    """Yield samples and fixes; one that came too early waits for those before it."""
    came = dict.fromkeys(overview.order, 0)
    due = dict.fromkeys(overview.order, 0)
    early: dict[_Truck, dict[int, Message]] = {truck: {} for truck in overview.order}
    for message in overview.read():
        truck = _truck(message.key)
        if message.key.stream not in ("accel", "gnss") or truck not in came:
            continue
        if came[truck] == len(overview.order[truck]):
            continue  # the file has grown since the first pass
        waiting = early[truck]
        waiting[int(overview.order[truck][came[truck]])] = message
        came[truck] += 1
        while due[truck] in waiting:
            yield waiting.pop(due[truck])
            due[truck] += 1
    for waiting in early.values():  # the file is shorter than in the first pass
        yield from (waiting[rank] for rank in sorted(waiting))


def malformed(name: str, message: Message, error: ValueError) -> InputError:
    """Return the error that identifies a malformed message."""
    return InputError(f"{name}: {message.key.stream} {message.sequence}: {error}")


def _truck(key: Key) -> _Truck:
    return key.realm, key.identifier


def _ranks(boots: "array[int]", times_ns: "array[int]") -> NDArray[np.int64]:
    """Return the rank of each message (n,) by boot, then by time, then by arrival."""
    by_time = np.lexsort((np.array(times_ns, dtype=np.int64), np.array(boots, dtype=np.uint64)))
    ranks = np.empty(by_time.size, dtype=np.int64)
    ranks[by_time] = np.arange(by_time.size)
    return ranks
