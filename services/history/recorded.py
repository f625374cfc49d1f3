"""Crossings in recordings: where trucks were on bridges, and the data of those that are wanted.

A worker that was away finds here what trucks do not send any more. Positions are read first, and
accelerations only around the crossings that are wanted: so it takes the memory of the positions of
a few files, and of a few crossings, however long the drives are. What is read here is decided by
the worker's own engine, with its names and its states.
"""

import contextlib
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from schemas.results import Header
from schemas.settings import IdentificationSettings
from schemas.signals import NS_PER_S, decode_gnss
from schemas.site import Site
from services.common.errors import InputError
from services.identification.bridges import Bridges
from services.identification.crossing_data import window
from services.identification.engine import Engine
from services.identification.known import Known, are_one
from services.identification.outputs import Work
from services.identification.remembered import Found
from services.identification.stays import Car, Passage
from services.identification.streams import Fixes, device_time_ns
from services.identification.traffic import Stranger
from services.recordings.recording import Message, is_being_written, read_messages

AROUND_NS: Final = 60 * NS_PER_S
"""So much is read before and behind a crossing: for the sense of travel, and for late messages."""


class Stayed(NamedTuple):
    """A stay of a truck on a bridge; times in ns since 1970 UTC unless they say otherwise."""

    vehicle: str
    boot_id: int
    bridge: str
    entry_ns: int
    exit_ns: int
    entry_s: float
    """On the truck's own clock."""
    received_ns: int
    """When the logger had its last position."""
    passage: Passage


class Looked(NamedTuple):
    """What recordings of one truck hold."""

    stays: tuple[Stayed, ...]
    ranges: dict[Path, tuple[int, int]]
    """By file, the times between which its messages were made."""
    warnings: tuple[str, ...]


class Taken(NamedTuple):
    """What was wanted of recordings."""

    found: tuple[tuple[Stayed, Found], ...]
    missing: tuple[Stayed, ...]
    """Of which something has not come that may still come."""


def look(files: Sequence[Path], realm: str, vehicle: str, site: Site) -> Looked:
    """All stays of a truck, also one that the site does not know, in recordings of one realm.

    The files follow each other; a message that two of them hold counts once. One that is being
    written is read as far as it goes; what cannot be read is a warning.
    """
    boots: dict[int, dict[int, int]] = {}
    """By boot and sequence: the number of the row."""
    rows = array("d")
    walls, received = array("q"), array("q")
    ranges: dict[Path, tuple[int, int]] = {}
    warnings: list[str] = []
    for path in files:
        for message in _messages(path, realm, vehicle, warnings):
            if message.key.stream not in ("accel", "gnss"):
                continue
            time_ns = message.log_time_ns
            first_ns, last_ns = ranges.get(path, (time_ns, time_ns))
            ranges[path] = min(first_ns, time_ns), max(last_ns, time_ns)
            known = boots.setdefault(message.boot_id, {})
            if message.key.stream != "gnss" or message.sequence in known:
                continue
            try:
                fix = decode_gnss(message.payload)
            except ValueError:
                continue
            known[message.sequence] = len(walls)
            walls.append(fix.wall_time_ns)
            received.append(message.publish_time_ns)
            rows.extend(
                (
                    fix.device_time_ns / NS_PER_S,
                    fix.latitude_deg,
                    fix.longitude_deg,
                    fix.speed_m_per_s,
                    fix.altitude_m,
                )
            )
    table = np.array(rows).reshape(-1, len(Fixes._fields))
    car: Car = {v.id: v for v in site.vehicles}.get(vehicle) or Stranger()
    bridges = Bridges(site.bridges, site.receiver)
    found: list[Stayed] = []
    for boot_id, numbers in boots.items():
        order = np.array([numbers[sequence] for sequence in sorted(numbers)], dtype=np.int64)
        if order.size < 2:
            continue
        columns = table[order].T
        # As the worker orders them (`Boot.fixes`): by time, each time once.
        by_time = np.lexsort(columns[::-1])
        by_time = by_time[np.diff(columns[0][by_time], prepend=-np.inf) > 0.0]
        fixes = Fixes(*np.ascontiguousarray(columns[:, by_time]))
        wall_ns, came_ns = np.array(walls)[order][by_time], np.array(received)[order][by_time]
        for number, stay in bridges.all_stays(car, fixes):
            at = int(np.searchsorted(fixes.time_s, stay.entry_s, side="right")) - 1
            last = min(int(np.searchsorted(fixes.time_s, stay.exit_s)), fixes.time_s.size - 1)
            offset_ns = int(wall_ns[max(at, 0)]) - round(fixes.time_s[max(at, 0)] * NS_PER_S)
            found.append(
                Stayed(
                    vehicle,
                    boot_id,
                    bridges.bridge(number).id,
                    round(stay.entry_s * NS_PER_S) + offset_ns,
                    round(stay.exit_s * NS_PER_S) + offset_ns,
                    stay.entry_s,
                    int(came_ns[last]),
                    stay.passage,
                )
            )
    return Looked(tuple(found), ranges, tuple(warnings))


def take(
    files: Sequence[Path],
    realm: str,
    wanted: Sequence[Stayed],
    known: Sequence[Known],
    site: Site,
    settings: IdentificationSettings,
    header: Header,
    *,
    is_final: bool,
) -> Taken:
    """The data of stays of one boot of a truck, and what is told of them.

    `known` is what has been told of crossings of that truck. If `is_final` what is missing will
    not come any more; else a stay in which something is missing is left for later.
    """
    vehicle, boot_id = wanted[0].vehicle, wanted[0].boot_id
    messages: dict[tuple[str, int], Message] = {}
    for path in files:
        for message in _messages(path, realm, vehicle, []):
            if message.boot_id == boot_id and _is_wanted(message, wanted):
                messages.setdefault((message.key.stream, message.sequence), message)
    found: list[tuple[Stayed, Found]] = []
    missing: list[Stayed] = []
    for stay in wanted:
        near = [m for m in messages.values() if _is_wanted(m, [stay])]
        one = _decided(near, stay, known, site, settings, header)
        if one is not None and (is_final or _is_whole(one.waiting.work, near)):
            found.append((stay, one))
        else:
            missing.append(stay)
    return Taken(tuple(found), tuple(missing))


def _messages(path: Path, realm: str, vehicle: str, warnings: list[str]) -> Iterator[Message]:
    """What a file holds of a truck; what cannot be read of it is added to the warnings."""
    said: list[str] = []
    is_growing = False
    try:
        is_growing = is_being_written(path)
        for message in read_messages(path, warn=said.append):
            where = message.key
            if (where.realm, where.owner, where.identifier) == (realm, "vehicle", vehicle):
                yield message
    except (InputError, OSError) as error:
        said.append(str(error))
    if not is_growing:  # it ends in the middle of a chunk as a rule
        warnings += said


def _is_wanted(message: Message, stays: Sequence[Stayed]) -> bool:
    if message.key.stream == "info":
        return True
    return message.key.stream in ("accel", "gnss") and any(
        stay.entry_ns - AROUND_NS <= message.log_time_ns <= stay.exit_ns + AROUND_NS
        for stay in stays
    )


def _decided(
    messages: list[Message],
    wanted: Stayed,
    known: Sequence[Known],
    site: Site,
    settings: IdentificationSettings,
    header: Header,
) -> Found | None:
    """What an engine says of one stay that has nothing but its messages."""
    engine = Engine(site, settings, header, finds_only=True)
    for _ in engine.resume(known):
        pass  # it is told by the engine that has been told so, too
    for message in sorted(messages, key=_moment):
        with contextlib.suppress(ValueError):
            for _ in engine.feed(message.key, message.payload):
                pass
    for _ in engine.finish():
        pass
    times = wanted.entry_ns, wanted.exit_ns
    for one in engine.found:
        is_there = one.waiting.work.data.bridge.id == wanted.bridge
        if is_there and are_one(one.entry_ns, one.exit_ns, *times):
            return one
    return None


def _moment(message: Message) -> tuple[int, int]:
    if message.key.stream == "info":
        return -1, message.sequence
    try:
        return device_time_ns(message.key.stream, message.payload), message.sequence
    except ValueError:
        return -1, message.sequence


def _is_whole(work: Work, messages: list[Message]) -> bool:
    """Whether a crossing has all of its messages."""
    data = work.data
    if data.stay.passage in (Passage.BEGINS_ON_BRIDGE, Passage.ENDS_ON_BRIDGE):
        return False
    fixes = sorted(m.sequence for m in messages if m.key.stream == "gnss")
    if data.samples is None or fixes[-1] - fixes[0] != len(fixes) - 1:
        return False
    begin_s, end_s = window(data.stay, data.bridge, data.vehicle, work.settings.method)
    step_s = 2.0 / data.samples.rate_hz
    channels = data.samples.channels.values()
    covered_s = max((values.size for values in channels), default=0) / data.samples.rate_hz
    return (
        (data.samples.start_s <= begin_s + step_s or _starts_with_boot(messages))
        and data.samples.start_s + covered_s >= end_s - step_s
        and all(np.isfinite(values).all() for values in channels)
    )


def _starts_with_boot(messages: list[Message]) -> bool:
    """Whether nothing can have been before."""
    return any(m.key.stream == "accel" and m.sequence == 0 for m in messages)
