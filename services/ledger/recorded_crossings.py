"""Crossings in recordings: stays of trucks on bridges, and the data of selected stays.

A worker that was away finds here the data that trucks no longer send. Positions are read first,
accelerations only around the selected stays, so memory holds the positions of a few files and the
data of a few crossings, however long the drives are. The worker's own engine decides about the
data, with its names and states.
"""

import contextlib
from array import array
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from schemas.proto import driveby_pb2 as pb
from schemas.settings import IdentificationSettings
from schemas.signals import NS_PER_S, decode_gnss
from schemas.site import Site
from schemas.topics import Message
from services.common.arrays import Ints
from services.common.errors import InputError
from services.finding.bridges import Bridges
from services.finding.crossing_data import Complete
from services.finding.finder import Finder, Found
from services.finding.stays import AxleGeometry, Passage, are_one
from services.finding.streams import Fixes, device_time_ns
from services.finding.traffic import UnlistedVehicle
from services.identification.known import CrossingRecord
from services.identification.methods import window_of
from services.identification.names import ReportedCrossings
from services.identification.outputs import IdentificationTask, Output, crossing_output
from services.identification.waiting import CrossingFromRecording, pending_of
from services.recordings.recording import is_being_written, read_messages

AROUND_NS: Final = 60 * NS_PER_S
"""Time read before and after a crossing, for the sense of travel and for late messages."""


class RecordedStay(NamedTuple):
    """A stay of a truck on a bridge; times in ns since 1970 UTC unless noted otherwise."""

    vehicle: str
    boot_id: int
    bridge: str
    entry_ns: int
    exit_ns: int
    entry_s: float
    """Entry on the truck's own clock."""
    received_ns: int
    """Time at which the logger received the last position of the stay."""
    passage: Passage


class StayScan(NamedTuple):
    """Stays of one truck in a set of recordings."""

    stays: tuple[RecordedStay, ...]
    ranges: dict[Path, tuple[int, int]]
    """First and last measurement time of each file's messages, ns."""
    warnings: tuple[str, ...]


class FetchResult(NamedTuple):
    """Data of requested stays, as far as the recordings hold them."""

    found: tuple[tuple[RecordedStay, CrossingFromRecording], ...]
    missing: tuple[RecordedStay, ...]
    """Stays whose data may still arrive."""


def scan_stays(files: Sequence[Path], realm: str, vehicle: str, site: Site) -> StayScan:
    """Return all stays of a truck, also an unlisted one, in recordings of one realm.

    The files follow each other; a message in two of them counts once. A file that is being written
    is read up to its end; what is unreadable is a warning.
    """
    positions = _Positions()
    ranges: dict[Path, tuple[int, int]] = {}
    warnings: list[str] = []
    for path in files:
        for message in _messages(path, realm, vehicle, warnings):
            if message.key.stream not in ("accel", "gnss"):
                continue
            time_ns = message.log_time_ns
            first_ns, last_ns = ranges.get(path, (time_ns, time_ns))
            ranges[path] = min(first_ns, time_ns), max(last_ns, time_ns)
            positions.add(message)
    car: AxleGeometry = {v.id: v for v in site.vehicles}.get(vehicle) or UnlistedVehicle()
    bridges = Bridges(site.bridges, site.receiver)
    found: list[RecordedStay] = []
    for boot_id, fixes, wall_ns, came_ns in positions.by_boot():
        for number, stay in bridges.all_stays(car, fixes):
            at = int(np.searchsorted(fixes.time_s, stay.entry_s, side="right")) - 1
            last = min(int(np.searchsorted(fixes.time_s, stay.exit_s)), fixes.time_s.size - 1)
            offset_ns = int(wall_ns[max(at, 0)]) - round(fixes.time_s[max(at, 0)] * NS_PER_S)
            found.append(
                RecordedStay(
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
    return StayScan(tuple(found), ranges, tuple(warnings))


class _Positions:
    """Positions of a truck, each once."""

    def __init__(self) -> None:
        self._boots: dict[int, dict[int, int]] = {}
        """Row number by boot and sequence number."""
        self._rows = array("d")
        self._walls, self._received = array("q"), array("q")

    def add(self, message: Message) -> None:
        known = self._boots.setdefault(message.boot_id, {})
        if message.key.stream != "gnss" or message.sequence in known:
            return
        try:
            fix = decode_gnss(message.payload)
        except ValueError:
            return
        known[message.sequence] = len(self._walls)
        self._walls.append(fix.wall_time_ns)
        self._received.append(message.publish_time_ns)
        time_s = fix.device_time_ns / NS_PER_S
        place = fix.latitude_deg, fix.longitude_deg
        self._rows.extend((time_s, *place, fix.speed_m_per_s, fix.altitude_m))

    def by_boot(self) -> Iterator[tuple[int, Fixes, Ints, Ints]]:
        """Yield each boot with its fixes, and with their wall times and times of reception in ns.

        They are in the order of the worker (`Boot.fixes`): by time, each time once.
        """
        table = np.array(self._rows).reshape(-1, len(Fixes._fields))
        for boot_id, numbers in self._boots.items():
            order = np.array([numbers[sequence] for sequence in sorted(numbers)], dtype=np.int64)
            if order.size < 2:
                continue
            columns = table[order].T
            by_time = np.lexsort(columns[::-1])
            by_time = by_time[np.diff(columns[0][by_time], prepend=-np.inf) > 0.0]
            fixes = Fixes(*np.ascontiguousarray(columns[:, by_time]))
            walls, received = (np.array(one)[order] for one in (self._walls, self._received))
            yield boot_id, fixes, walls[by_time], received[by_time]


def fetch_crossings(
    files: Sequence[Path],
    realm: str,
    wanted: Sequence[RecordedStay],
    known: Sequence[CrossingRecord],
    site: Site,
    settings: IdentificationSettings,
    *,
    is_final: bool,
) -> FetchResult:
    """Return the data of stays of one boot of a truck, with the messages to publish about them.

    `known` are the crossings of that truck that have been published. If `is_final`, missing data
    are given up; otherwise a stay with missing data stays pending.
    """
    vehicle, boot_id = wanted[0].vehicle, wanted[0].boot_id
    messages: dict[tuple[str, int], Message] = {}
    for path in files:
        for message in _messages(path, realm, vehicle, []):
            if message.boot_id == boot_id and _is_wanted(message, wanted):
                messages.setdefault((message.key.stream, message.sequence), message)
    found: list[tuple[RecordedStay, CrossingFromRecording]] = []
    missing: list[RecordedStay] = []
    for stay in wanted:
        near = [m for m in messages.values() if _is_wanted(m, [stay])]
        one = _decided(near, stay, known, site, settings)
        if one is not None and (is_final or _is_whole(one.pending.task, near)):
            found.append((stay, one))
        else:
            missing.append(stay)
    return FetchResult(tuple(found), tuple(missing))


def _messages(path: Path, realm: str, vehicle: str, warnings: list[str]) -> Iterator[Message]:
    """Yield a file's messages of a truck; append read errors to the warnings."""
    problems: list[str] = []
    is_growing = False
    try:
        is_growing = is_being_written(path)
        for message in read_messages(path, warn=problems.append):
            where = message.key
            if (where.realm, where.owner, where.identifier) == (realm, "vehicle", vehicle):
                yield message
    except (InputError, OSError) as error:
        problems.append(str(error))
    if not is_growing:  # a growing file usually ends in the middle of a chunk
        warnings += problems


def _is_wanted(message: Message, stays: Sequence[RecordedStay]) -> bool:
    if message.key.stream == "info":
        return True
    return message.key.stream in ("accel", "gnss") and any(
        stay.entry_ns - AROUND_NS <= message.log_time_ns <= stay.exit_ns + AROUND_NS
        for stay in stays
    )


def _decided(
    messages: list[Message],
    wanted: RecordedStay,
    known: Sequence[CrossingRecord],
    site: Site,
    settings: IdentificationSettings,
) -> CrossingFromRecording | None:
    """Return the result of a finder for one stay, from the messages around it."""
    names = ReportedCrossings(known)
    finder = Finder(site, window_of(settings.method), names.recognise)
    for one in _fed(finder, sorted(messages, key=_moment)):
        at = one.detection
        times = at.entry_ns, at.exit_ns
        if at.bridge == wanted.bridge and are_one(*times, wanted.entry_ns, wanted.exit_ns):
            reported = names.reported(at)
            pending = pending_of(one, IdentificationTask(0, one.data, settings), reported)
            return CrossingFromRecording(tuple(_begun(one, reported)), pending, *times)
    return None


def _fed(finder: Finder, messages: Iterable[Message]) -> list[Complete]:
    """Return the complete crossings found in messages; malformed messages are left out."""
    found: list[Found] = []
    for message in messages:
        with contextlib.suppress(ValueError):
            found.extend(finder.feed(message.key, message.payload))
    found.extend(finder.finish())
    return [one for one in found if isinstance(one, Complete)]


def _begun(one: Complete, reported: Collection[pb.CrossingState]) -> Iterator[Output]:
    """Yield a crossing's messages up to its identification, except the `reported` states."""
    found = one.detection._replace(stay=one.data.stay)
    if pb.DETECTED not in reported:  # as it is while the truck is on the bridge
        on_it = found._replace(stay=found.stay._replace(passage=Passage.ENDS_ON_BRIDGE))
        yield crossing_output(on_it, pb.DETECTED, found.entry_ns)
    if pb.COMPLETE not in reported:
        yield crossing_output(found, pb.COMPLETE, found.exit_ns)


def _moment(message: Message) -> tuple[int, int]:
    if message.key.stream == "info":
        return -1, message.sequence
    try:
        return device_time_ns(message.key.stream, message.payload), message.sequence
    except ValueError:
        return -1, message.sequence


def _is_whole(task: IdentificationTask, messages: list[Message]) -> bool:
    """Return whether all messages of a crossing are present."""
    data = task.data
    if data.stay.passage in (Passage.BEGINS_ON_BRIDGE, Passage.ENDS_ON_BRIDGE):
        return False
    fixes = sorted(m.sequence for m in messages if m.key.stream == "gnss")
    if data.samples is None or fixes[-1] - fixes[0] != len(fixes) - 1:
        return False
    begin_s, end_s = window_of(task.settings.method)(data.stay, data.bridge, data.vehicle)
    step_s = 2.0 / data.samples.rate_hz
    channels = data.samples.channels.values()
    covered_s = max((values.size for values in channels), default=0) / data.samples.rate_hz
    return (
        (data.samples.start_s <= begin_s + step_s or _starts_with_boot(messages))
        and data.samples.start_s + covered_s >= end_s - step_s
        and all(np.isfinite(values).all() for values in channels)
    )


def _starts_with_boot(messages: list[Message]) -> bool:
    """Return whether the first batch of the boot is present, so that nothing preceded it."""
    return any(m.key.stream == "accel" and m.sequence == 0 for m in messages)
