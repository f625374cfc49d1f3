"""The catalogue's row of one recording, computed when it is closed."""

import hashlib
import json
from collections.abc import Iterator
from itertools import pairwise
from typing import BinaryIO, NamedTuple

from mcap.writer import MCAP0_MAGIC

from schemas.signals import NS_PER_S, decode_accel, decode_gnss
from schemas.topics import Key, topic
from services.catalogue.silences import Arrivals, no_arrivals, silences
from services.common.errors import InputError
from services.common.files import is_held
from services.common.language import utc_day
from services.common.stores import Entry, Folder, opened
from services.finding.bridges import Box
from services.recordings.mcap_ranges import ChunkIndexes, chunk_messages, read_index
from services.recordings.mcap_scan import RawMessage
from services.recordings.recording import our_channel

_BLOCK_BYTES = 1 << 20


class CatalogRow(NamedTuple):
    """One recording; times in ns since 1970 UTC."""

    path: str
    """Path relative to the folder of the catalogue, with forward slashes."""
    size_bytes: int
    modified_ns: int
    """Time of modification; 0 where the store does not give one."""
    content: bytes
    """SHA-256 of the whole file."""
    realms: tuple[str, ...]
    vehicles: tuple[str, ...]
    first_ns: int
    """First time of measurement, or without one of any message, as for `last_ns`."""
    last_ns: int
    messages: int
    rates_hz: dict[str, float]
    """Rate of each accelerometer, as its first batch declares it; observed rate of `gnss`."""
    gaps: int
    """Number of silences of more than a second that are no pauses of a truck."""
    gap_s: float
    """Total length of the gaps in s."""
    box: Box | None
    """Box round all positions of its trucks; None without positions."""

    @property
    def day(self) -> str:
        """Day of its first time, UTC."""
        return utc_day(self.first_ns / NS_PER_S)


class StillOpenError(InputError):
    """A recording that a process is writing: it gets its row when it is closed."""


def row_of(folder: Folder, entry: Entry) -> CatalogRow:
    """Read a closed recording once for its row, and once for its hash.

    Raise StillOpenError if it is being written, otherwise InputError if it is unreadable or
    truncated, or has no driveby message.
    """
    where = f"{folder.name}/{entry.name}"
    with opened(folder, entry.name) as file:
        index = read_index(file, entry.size_bytes)
        if index is None:
            if folder.is_local and is_held(file):
                raise StillOpenError(f"{where}: is being written")
            raise InputError(f"{where}: {_why_without_index(file, entry.size_bytes)}")
        builder = _RowBuilder()
        try:
            for key, boot_id, message in _messages(where, file, index):
                builder.add(key, boot_id, message)
        except ValueError as error:
            raise InputError(f"{where}: {error} (driveby recover repairs it)") from None
        if not builder.messages:
            raise InputError(f"{where}: holds no driveby message; a recording is expected")
        content = file_sha256(file)
    return builder.row(entry, content)


def _why_without_index(file: BinaryIO, size: int) -> str:
    """Return why a file has no readable index, and the remedy."""
    if not size:
        return "is empty; an MCAP recording is expected"
    file.seek(0)
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        return "is not an MCAP file; a recording (.mcap) is expected"
    end = file.seek(max(len(MCAP0_MAGIC), size - len(MCAP0_MAGIC)))
    if file.read(size - end) == MCAP0_MAGIC:
        return "its index is damaged (driveby recover repairs it)"
    return (
        "has no end: it was being written when it was copied, or its writer was killed "
        "(driveby recover FILE --set-aside makes it complete), unless another machine is writing it"
    )


def file_sha256(file: BinaryIO) -> bytes:
    """Return the SHA-256 of a file."""
    digest = hashlib.sha256()
    file.seek(0)
    while block := file.read(_BLOCK_BYTES):
        digest.update(block)
    return digest.digest()


def _messages(
    where: str, file: BinaryIO, index: ChunkIndexes
) -> Iterator[tuple[Key, int, RawMessage]]:
    ours = {n: known for n, c in index.channels.items() if (known := our_channel(where, c))}
    for chunk in index.chunks:
        for message in chunk_messages(file, chunk, ours):
            yield *ours[message.channel_id], message


class _RowBuilder:
    """Accumulator of one recording's row."""

    def __init__(self) -> None:
        self.messages = 0
        self._logged_ns: list[int] = []
        """First and last time of all messages."""
        self._arrivals: dict[tuple[Key, int], Arrivals] = {}
        self._rates: dict[str, float] = {}
        self._realms: set[str] = set()
        self._positions: list[tuple[float, float]] = []

    def add(self, key: Key, boot_id: int, message: RawMessage) -> None:
        self.messages += 1
        times_ns = [*self._logged_ns, message.log_time_ns]
        self._logged_ns = [min(times_ns), max(times_ns)]
        self._realms.add(key.realm)
        if key.owner != "vehicle":
            return
        row = topic(key.owner, key.stream)
        if not row.latched:
            arrivals = self._arrivals.setdefault((key, boot_id), no_arrivals())
            arrivals.add(message.log_time_ns, message.sequence)
        try:
            if key.stream == "gnss":
                fix = decode_gnss(message.data)
                self._positions.append((fix.latitude_deg, fix.longitude_deg))
            elif key.stream == "accel" and not any(name != "gnss" for name in self._rates):
                channels = decode_accel(message.data).channels
                self._rates |= {name: channel.rate_hz for name, channel in channels.items()}
        except ValueError:
            return  # it counts as a message and is otherwise ignored

    def row(self, entry: Entry, content: bytes) -> CatalogRow:
        gaps = [
            one.end_ns - one.begin_ns
            for one in silences(self._arrivals.items())
            if not one.is_pause
        ]
        times_ns = {name: one.times_ns for name, one in self._arrivals.items()}
        every = [t for times in times_ns.values() for t in (min(times), max(times))]
        every = every or self._logged_ns
        steps = sorted(
            b - a
            for (key, _), times in times_ns.items()
            if key.stream == "gnss"
            for a, b in pairwise(sorted(times))
            if b > a
        )
        rates = dict(self._rates)
        if steps:
            rates["gnss"] = round(NS_PER_S / steps[len(steps) // 2], 2)
        return CatalogRow(
            entry.name,
            entry.size_bytes,
            entry.modified_ns,
            content,
            tuple(sorted(self._realms)),
            tuple(sorted({key.identifier for key, _ in times_ns})),
            min(every),
            max(every),
            self.messages,
            rates,
            len(gaps),
            round(sum(gaps) / NS_PER_S, 3),
            _box(self._positions),
        )


def _box(positions: list[tuple[float, float]]) -> Box | None:
    """Return the smallest box round all positions, across the meridian of 180° if smaller."""
    if not positions:
        return None
    south, north = min(p[0] for p in positions), max(p[0] for p in positions)
    west, east = min(p[1] for p in positions), max(p[1] for p in positions)
    turned = [p[1] % 360.0 for p in positions]
    if max(turned) - min(turned) < east - west:
        west, east = min(turned), max(turned)
        if west > 180.0:
            west, east = west - 360.0, east - 360.0
    return Box(south, west, north, east)


def details_text(row: CatalogRow) -> str:
    """Return the fields without a column of their own, as JSON."""
    fields = {
        "realms": row.realms,
        "vehicles": row.vehicles,
        "rates_hz": row.rates_hz,
        "gaps": row.gaps,
        "gap_s": row.gap_s,
        "messages": row.messages,
    }
    return json.dumps(fields, separators=(",", ":"))
