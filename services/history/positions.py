"""Crossings in recordings of a catalogue, found from positions alone.

A row's box tells whether a recording came near a bridge at all. Of one that did, the first and the
last positions are read: faster than `_FASTEST_M_PER_S` no truck is, so between two of them it was
near those bridges only that the rectangle round both meets, with what it can have driven meanwhile
round it. Where there are such bridges, the positions in the middle are read, and so on down to ten
seconds. All positions are read only round such times. No acceleration is decoded, and none is
decompressed in chunks that are not read.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from itertools import pairwise
from math import cos, radians
from typing import BinaryIO, Final, NamedTuple

from mcap.records import ChunkIndex

from schemas.signals import NS_PER_S, GnssFix, decode_gnss
from schemas.site import Site
from schemas.topics import Key
from services.common.errors import InputError
from services.common.stores import Folder, opened
from services.history.catalog_row import Row
from services.identification.bridges import AWAY_S, Box, Bridges, Passing, passings_of
from services.identification.streams import boot_of
from services.recordings.mcap_ranges import chunk_messages, read_index
from services.recordings.recording import our_channel

_STEP_NS: Final = 10 * NS_PER_S
_FASTEST_M_PER_S: Final = 60.0
_METRES_PER_DEGREE: Final = 110_500.0
"""Of latitude, nowhere less."""
_AROUND_NS: Final = round((2.0 * AWAY_S + 10.0) * NS_PER_S)
"""Read before and behind a time near a bridge: as much as finding stays looks at."""
_Whose = tuple[str, str]
"""Realm and vehicle."""
_Span = tuple[int, int]


class Looked(NamedTuple):
    """What was found, and what it took."""

    crossings: tuple[Passing, ...]
    """In order of their entries."""
    problems: tuple[str, ...]
    files_read: int
    chunks_read: int
    chunks: int
    """In the files that were read."""


def crossings_of(folder: Folder, rows: Iterable[Row], site: Site) -> Looked:
    """All stays of the site's trucks on its bridges in recordings of a catalogue.

    A drive that goes on from one recording into the next is one drive. What cannot be read is a
    problem, a line each.
    """
    bridges = Bridges(site.bridges, site.receiver)
    trucks = {vehicle.id: vehicle for vehicle in site.vehicles}
    problems: list[str] = []
    found: list[Passing] = []
    read = _Read(folder, bridges)
    near = [row for row in rows if row.box is not None and bridges.meeting(row.box)]
    by_vehicle: defaultdict[str, list[Row]] = defaultdict(list)
    for row in near:
        for vehicle in row.vehicles:
            if vehicle in trucks:
                by_vehicle[vehicle].append(row)
    for vehicle, some in sorted(by_vehicle.items()):
        fixes: defaultdict[tuple[str, int], dict[int, GnssFix]] = defaultdict(dict)
        spans: list[_Span] = []
        for row in sorted(some, key=lambda one: one.first_ns):
            try:
                spans += read.add(row, vehicle, fixes)
            except (InputError, ValueError) as error:
                where = f"{folder.name}/{row.path}"
                problems.append(str(error) if where in str(error) else f"{where}: {error}")
        for (realm, _), of_boot in fixes.items():
            for part in _parts(of_boot, _merged(spans)):
                for one in passings_of(bridges, realm, trucks[vehicle], boot_of(part)):
                    within = [
                        r.path
                        for r in some
                        if r.first_ns <= one.exit_ns and one.entry_ns <= r.last_ns
                    ]
                    found.append(one._replace(recordings=tuple(within)))
    found.sort(key=lambda one: (one.entry_ns, one.vehicle, one.bridge))
    return Looked(tuple(found), tuple(problems), read.files, read.chunks_read, read.chunks)


class _Read:
    """Reads positions, and counts what that takes."""

    def __init__(self, folder: Folder, bridges: Bridges) -> None:
        self._folder = folder
        self._bridges = bridges
        self.files = self.chunks = self.chunks_read = 0

    def add(
        self, row: Row, vehicle: str, fixes: dict[tuple[str, int], dict[int, GnssFix]]
    ) -> list[_Span]:
        """Add the fixes of a truck near bridges, by realm and boot; when it was near one."""
        with ExitStack() as stack:
            file = stack.enter_context(opened(self._folder, row.path))
            index = read_index(file, row.size_bytes)
            if index is None:
                raise InputError(
                    f"{self._folder.name}/{row.path}: has no index where its row says one is; "
                    "driveby catalog mends the row"
                )
            ours = {
                n: known
                for n, channel in index.channels.items()
                if (known := our_channel(row.path, channel))
                and (known[0].identifier, known[0].stream) == (vehicle, "gnss")
            }
            chunks = [
                c for c in index.chunks if not ours.keys().isdisjoint(c.message_index_offsets)
            ]
            self.files += 1
            self.chunks += len(index.chunks)
            done: dict[int, list[tuple[str, int, GnssFix]]] = {}

            def fixes_of(chunk: ChunkIndex) -> list[tuple[str, int, GnssFix]]:
                at = chunk.chunk_start_offset
                if at not in done:
                    self.chunks_read += 1
                    done[at] = list(_fixes(file, chunk, ours))
                return done[at]

            chunks.sort(key=lambda chunk: chunk.message_start_time)
            among = self._bridges.meeting(row.box) if row.box is not None else []
            spans = _merged(self._near(chunks, fixes_of, among))
            for chunk in chunks:
                span = (chunk.message_start_time, chunk.message_end_time)
                if any(a <= span[1] and span[0] <= b for a, b in spans):
                    for realm, boot_id, fix in fixes_of(chunk):
                        fixes[(realm, boot_id)][fix.sequence] = fix
            return spans

    def _near(
        self,
        chunks: Sequence[ChunkIndex],
        fixes_of: Callable[[ChunkIndex], list[tuple[str, int, GnssFix]]],
        among: Sequence[int],
    ) -> Iterator[_Span]:
        """When a truck may have been near a bridge, with what is looked at before and behind."""
        at: dict[int, list[GnssFix]] = {}

        def fixes(number: int) -> list[GnssFix]:
            if number not in at:
                some = (fix for _, _, fix in fixes_of(chunks[number]))
                at[number] = sorted(some, key=lambda fix: fix.wall_time_ns)
            return at[number]

        # A chunk of far apart times has what came late: it is read whatever lies round it.
        late = {n for n, c in enumerate(chunks) if _length_ns(c) >= _STEP_NS}
        ends = sorted({0, len(chunks) - 1, *late}) if chunks else []
        waiting = [*pairwise([*ends[:1], *ends]), *((number, number) for number in late)]
        while waiting:
            first, last = waiting.pop()
            some = sorted((*fixes(first), *fixes(last)), key=lambda fix: fix.wall_time_ns)
            near = [
                (before.wall_time_ns, after.wall_time_ns)
                for before, after in pairwise([*some[:1], *some])
                if self._bridges.meeting(_reach(before, after), among)
            ]
            longest = max((b - a for a, b in near), default=0)
            if near and last - first > 1 and longest > _STEP_NS:
                middle = (first + last) // 2
                waiting += [(first, middle), (middle, last)]
            else:
                yield from ((a - _AROUND_NS, b + _AROUND_NS) for a, b in near)


def _length_ns(chunk: ChunkIndex) -> int:
    return int(chunk.message_end_time - chunk.message_start_time)


def _fixes(
    file: BinaryIO, chunk: ChunkIndex, ours: dict[int, tuple[Key, int]]
) -> Iterator[tuple[str, int, GnssFix]]:
    for message in chunk_messages(file, chunk, ours):
        key, boot_id = ours[message.channel_id]
        try:
            yield key.realm, boot_id, decode_gnss(message.data)
        except ValueError:
            continue  # bytes that are no fix tell nothing of where the truck was


def _reach(one: GnssFix, other: GnssFix) -> Box:
    """Where a truck may have been between two fixes: the rectangle round both, and some more."""
    seconds = (other.wall_time_ns - one.wall_time_ns) / NS_PER_S
    reach_m = 0.5 * _FASTEST_M_PER_S * seconds
    north = reach_m / _METRES_PER_DEGREE
    high = max(abs(one.latitude_deg), abs(other.latitude_deg)) + north
    east = min(north / max(cos(radians(min(high, 90.0))), 1e-3), 180.0)
    west_deg, east_deg = sorted((one.longitude_deg, other.longitude_deg))
    if east_deg - west_deg > 180.0:
        west_deg, east_deg = east_deg, west_deg + 360.0
    return Box(
        min(one.latitude_deg, other.latitude_deg) - north,
        west_deg - east,
        max(one.latitude_deg, other.latitude_deg) + north,
        east_deg + east,
    )


def _merged(spans: Iterable[_Span]) -> list[_Span]:
    merged: list[_Span] = []
    for begin, end in sorted(spans):
        if merged and begin <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        else:
            merged.append((begin, end))
    return merged


def _parts(fixes: dict[int, GnssFix], spans: list[_Span]) -> Iterator[dict[int, GnssFix]]:
    """The fixes of each span: between two of them nobody knows where the truck was."""
    for begin, end in spans:
        part = {n: fix for n, fix in fixes.items() if begin <= fix.wall_time_ns <= end}
        if part:
            yield part
