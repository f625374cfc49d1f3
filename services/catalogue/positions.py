"""Crossings in catalogued recordings, detected from positions alone.

A row's box shows whether a recording came near a bridge at all. Of such a recording the first and
the last positions are read: no truck is faster than `_FASTEST_M_PER_S`, so between the two it can
only have been near bridges that meet the rectangle round both, extended by the distance driven
meanwhile. Where there are such bridges, the positions in the middle are read, and so on down to ten
seconds. All positions are read only around such times. No acceleration is decoded, and none is
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
from services.catalogue.row import CatalogRow
from services.common.errors import InputError
from services.common.stores import Folder, opened
from services.finding.bridges import AWAY_S, Box, Bridges, DetectedCrossing, detect_crossings
from services.finding.streams import boot_of
from services.recordings.mcap_ranges import chunk_messages, read_index
from services.recordings.recording import our_channel

_STEP_NS: Final = 10 * NS_PER_S
_FASTEST_M_PER_S: Final = 60.0
_METRES_PER_DEGREE: Final = 110_500.0
"""Length of a degree of latitude, at least, in m."""
_AROUND_NS: Final = round((2.0 * AWAY_S + 10.0) * NS_PER_S)
"""Time read before and after a stay near a bridge, as the detection of stays needs it."""
_Truck = tuple[str, str]
"""Realm and vehicle."""
_Span = tuple[int, int]


class CatalogScan(NamedTuple):
    """Detected crossings, and the amount of data that was read for them."""

    crossings: tuple[DetectedCrossing, ...]
    """Detected crossings in order of their entries."""
    problems: tuple[str, ...]
    files_read: int
    chunks_read: int
    chunks: int
    """Number of chunks in the files that were read."""


def crossings_of(folder: Folder, rows: Iterable[CatalogRow], site: Site) -> CatalogScan:
    """Return all stays of the site's trucks on its bridges in catalogued recordings.

    A drive that continues from one recording into the next is one drive. Unreadable input is a
    problem, one line each.
    """
    bridges = Bridges(site.bridges, site.receiver)
    trucks = {vehicle.id: vehicle for vehicle in site.vehicles}
    problems: list[str] = []
    found: list[DetectedCrossing] = []
    read = _PositionReader(folder, bridges)
    near = [row for row in rows if row.box is not None and bridges.meeting(row.box)]
    by_vehicle: defaultdict[str, list[CatalogRow]] = defaultdict(list)
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
                for one in detect_crossings(bridges, realm, trucks[vehicle], boot_of(part)):
                    within = [
                        r.path
                        for r in some
                        if r.first_ns <= one.exit_ns and one.entry_ns <= r.last_ns
                    ]
                    found.append(one._replace(recordings=tuple(within)))
    found.sort(key=lambda one: (one.entry_ns, one.vehicle, one.bridge))
    return CatalogScan(tuple(found), tuple(problems), read.files, read.chunks_read, read.chunks)


class _PositionReader:
    """Reader of positions, with counts of the files and chunks read."""

    def __init__(self, folder: Folder, bridges: Bridges) -> None:
        self._folder = folder
        self._bridges = bridges
        self.files = self.chunks = self.chunks_read = 0

    def add(
        self, row: CatalogRow, vehicle: str, fixes: dict[tuple[str, int], dict[int, GnssFix]]
    ) -> list[_Span]:
        """Add a truck's fixes near bridges, by realm and boot; return the spans near bridges."""
        with ExitStack() as stack:
            file = stack.enter_context(opened(self._folder, row.path))
            index = read_index(file, row.size_bytes)
            if index is None:
                raise InputError(
                    f"{self._folder.name}/{row.path}: has no index where its row has one; "
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
        """Yield the spans in which a truck may have been near a bridge, with their margins."""
        at: dict[int, list[GnssFix]] = {}

        def fixes(number: int) -> list[GnssFix]:
            if number not in at:
                some = (fix for _, _, fix in fixes_of(chunks[number]))
                at[number] = sorted(some, key=lambda fix: fix.wall_time_ns)
            return at[number]

        # A chunk with a long time span holds late messages: it is read whatever surrounds it.
        spans_ns = [chunk.message_end_time - chunk.message_start_time for chunk in chunks]
        late = {number for number, span_ns in enumerate(spans_ns) if span_ns >= _STEP_NS}
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


def _fixes(
    file: BinaryIO, chunk: ChunkIndex, ours: dict[int, tuple[Key, int]]
) -> Iterator[tuple[str, int, GnssFix]]:
    for message in chunk_messages(file, chunk, ours):
        key, boot_id = ours[message.channel_id]
        try:
            yield key.realm, boot_id, decode_gnss(message.data)
        except ValueError:
            continue  # bytes that are not a fix carry no position


def _reach(one: GnssFix, other: GnssFix) -> Box:
    """Return the box in which a truck may have been between two fixes: both, with a margin."""
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
    """Yield the fixes of each span; between two spans the truck's path is unknown."""
    for begin, end in spans:
        part = {n: fix for n, fix in fixes.items() if begin <= fix.wall_time_ns <= end}
        if part:
            yield part
