"""What recordings hold, looked over once: so that they can be identified as they are read.

A recording keeps the order in which messages came. An identification wants those of a truck in the
order in which they were made: a spool brings late what could not be sent at once. So the order is
found first, at sixteen bytes a message, and what must be known from the beginning is kept: what
trucks say of themselves, and where they are near bridges. Then the messages are read again, and one
that came too early waits for those before it. The memory that takes grows with what came late, not
with the length of the drive. What is small is kept and not read twice.
"""

from array import array
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import decode_gnss
from schemas.site import Site
from schemas.topics import Key
from services.common.errors import InputError
from services.common.progress import Offset, unwatched
from services.identification.bridges import Bridges
from services.identification.streams import device_time_ns
from services.recordings.recording import Message, read_messages

STREAMS = ("accel", "gnss", "info")
_SMALL_BYTES = 64 << 20
"""Recordings of which the messages take less are not read a second time."""
_BESIDE_BYTES = 400
"""What a message takes beside its payload."""

Read = Callable[[], Iterable[Message]]
"""All messages of trucks, from the first one on, whenever it is called."""

_Truck = tuple[str, str]
"""Realm and vehicle."""


class Overview(NamedTuple):
    """Of all messages that an identification reads."""

    name: str
    """What errors call them."""
    read: Read
    order: dict[_Truck, NDArray[np.int64]]
    """Which one in the order of its making the n-th sample or fix is of those of its truck."""
    said: dict[tuple[_Truck, int], list[Message]]
    """What a truck says of itself, by boot: it holds for all of that."""
    near: list[Message]
    """Fixes near a bridge: another truck may be on it."""
    drove: set[str]
    """Vehicles that sent samples or fixes."""


def messages_of_trucks(
    recordings: Iterable[Path], next_file: Callable[[], Offset] = lambda: unwatched
) -> Read:
    """All that an identification reads; at first `next_file` is called where a file begins."""

    def of_files(watch: Callable[[], Offset]) -> Iterator[Message]:
        for path in recordings:
            for message in read_messages(path, watch()):
                if message.key.owner == "vehicle" and message.key.stream in STREAMS:
                    yield message

    return remembered(lambda again: of_files((lambda: unwatched) if again else next_file))


def remembered(read: Callable[[bool], Iterable[Message]]) -> Read:
    """As `read`, which is told whether it is asked again; but small ones are kept."""
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


def look_over(name: str, read: Read, site: Site) -> Overview:
    """Read all messages once; errors call them `name`.

    InputError: one that is malformed; no accelerations or no positions.
    """
    bridges = Bridges(site.bridges, site.receiver)
    made: dict[_Truck, tuple[array[int], array[int]]] = {}
    said: dict[tuple[_Truck, int], list[Message]] = {}
    near: list[Message] = []
    seen: set[str] = set()
    for message in read():
        key = message.key
        if key.owner != "vehicle" or key.stream not in STREAMS:
            continue
        seen.add(key.stream)
        if key.stream == "info":
            said.setdefault((_truck(key), message.boot_id), []).append(message)
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
    order = {truck: _ranks(*two) for truck, two in made.items()}
    return Overview(name, read, order, said, near, {vehicle for _, vehicle in made})


def as_they_were_made(overview: Overview) -> Iterator[Message]:
    """Of each truck boot by boot, by its own clock, what it says of itself first; read again."""
    said = dict(overview.said)
    for message in _in_order(overview):
        yield from said.pop((_truck(message.key), message.boot_id), ())
        yield message


def _in_order(overview: Overview) -> Iterator[Message]:
    """Samples and fixes; one that came too early waits for those before it."""
    came = dict.fromkeys(overview.order, 0)
    due = dict.fromkeys(overview.order, 0)
    early: dict[_Truck, dict[int, Message]] = {truck: {} for truck in overview.order}
    for message in overview.read():
        truck = _truck(message.key)
        if message.key.stream not in ("accel", "gnss") or truck not in came:
            continue
        if came[truck] == len(overview.order[truck]):
            continue  # the file has grown since
        waiting = early[truck]
        waiting[int(overview.order[truck][came[truck]])] = message
        came[truck] += 1
        while due[truck] in waiting:
            yield waiting.pop(due[truck])
            due[truck] += 1
    for waiting in early.values():  # the file is shorter than it was
        yield from (waiting[rank] for rank in sorted(waiting))


def malformed(name: str, message: Message, error: ValueError) -> InputError:
    """The error that says which message it is."""
    return InputError(f"{name}: {message.key.stream} {message.sequence}: {error}")


def _truck(key: Key) -> _Truck:
    return key.realm, key.identifier


def _ranks(boots: "array[int]", times_ns: "array[int]") -> NDArray[np.int64]:
    """Which place each message has by boot, then by time, then as they came."""
    by_time = np.lexsort((np.array(times_ns, dtype=np.int64), np.array(boots, dtype=np.uint64)))
    ranks = np.empty(by_time.size, dtype=np.int64)
    ranks[by_time] = np.arange(by_time.size)
    return ranks
