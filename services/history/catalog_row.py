"""What the catalogue says of one recording: a row, made when it is closed."""

import hashlib
import json
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise
from typing import BinaryIO, Final, NamedTuple

from schemas.signals import NS_PER_S, decode_accel, decode_gnss
from schemas.topics import Key, topic
from services.common.errors import InputError
from services.common.stores import Entry, Folder, opened
from services.identification.bridges import Box
from services.recordings.mcap_ranges import ChunkIndexes, chunk_messages, read_index
from services.recordings.mcap_scan import RawMessage
from services.recordings.recording import our_channel

LONGEST_SILENCE_S: Final = 1.0
"""A truck sends batches of 50 to 100 ms: a stream that says nothing for longer has a gap."""
_BLOCK_BYTES = 1 << 20


class Row(NamedTuple):
    """One recording; times in ns since 1970 UTC."""

    path: str
    """Relative to the folder of the catalogue, with forward slashes."""
    size_bytes: int
    modified_ns: int
    """0 where the store does not say."""
    content: bytes
    """SHA-256 of the whole file."""
    realms: tuple[str, ...]
    vehicles: tuple[str, ...]
    first_ns: int
    """When the first thing was measured; 0 where there is none, as `last_ns`."""
    last_ns: int
    messages: int
    rates_hz: dict[str, float]
    """Of each accelerometer, as declared by the first batch; and of `gnss`, as it came."""
    gaps: int
    """How often a truck that was on said nothing for more than a second."""
    gap_s: float
    """How long that is together."""
    box: Box | None
    """Where its trucks were; None without positions."""

    @property
    def day(self) -> str:
        """The day of its first time, UTC."""
        return f"{datetime.fromtimestamp(self.first_ns / NS_PER_S, UTC):%Y-%m-%d}"


def row_of(folder: Folder, entry: Entry) -> Row:
    """Read a closed recording once for its row, and once for its hash.

    InputError if it cannot be read, is still open or was cut off, or holds no message of ours.
    """
    where = f"{folder.name}/{entry.name}"
    with opened(folder, entry.name) as file:
        index = read_index(file, entry.size_bytes)
        if index is None:
            raise InputError(
                f"{where}: has no index: it is being written, or was cut off "
                "(driveby recover makes it whole)"
            )
        noted = _Noted()
        try:
            for key, boot_id, message in _messages(where, file, index):
                noted.add(key, boot_id, message)
        except ValueError as error:
            raise InputError(f"{where}: {error} (driveby recover makes it whole)") from None
        if not noted.messages:
            raise InputError(f"{where}: holds no driveby message; a recording is expected")
        content = content_of(file)
    return noted.row(entry, content)


def content_of(file: BinaryIO) -> bytes:
    """SHA-256 of a file."""
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


class _Noted:
    """What has been read of a recording so far."""

    def __init__(self) -> None:
        self.messages = 0
        self._times: dict[tuple[Key, int], list[int]] = {}
        self._rates: dict[str, float] = {}
        self._realms: set[str] = set()
        self._places: list[tuple[float, float]] = []

    def add(self, key: Key, boot_id: int, message: RawMessage) -> None:
        self.messages += 1
        self._realms.add(key.realm)
        if key.owner != "vehicle":
            return
        row = topic(key.owner, key.stream)
        if not row.latched:
            self._times.setdefault((key, boot_id), []).append(message.log_time_ns)
        try:
            if key.stream == "gnss":
                fix = decode_gnss(message.data)
                self._places.append((fix.latitude_deg, fix.longitude_deg))
            elif key.stream == "accel" and not any(name != "gnss" for name in self._rates):
                channels = decode_accel(message.data).channels
                self._rates |= {name: channel.rate_hz for name, channel in channels.items()}
        except ValueError:
            return  # it counts as a message and tells nothing else

    def row(self, entry: Entry, content: bytes) -> Row:
        gaps = [gap for key, times in self._times.items() for gap in _gaps(key[0], times)]
        every = [t for times in self._times.values() for t in (min(times), max(times))]
        steps = sorted(
            b - a
            for (key, _), times in self._times.items()
            if key.stream == "gnss"
            for a, b in pairwise(sorted(times))
            if b > a
        )
        rates = dict(self._rates)
        if steps:
            rates["gnss"] = round(NS_PER_S / steps[len(steps) // 2], 2)
        return Row(
            entry.name,
            entry.size_bytes,
            entry.modified_ns,
            content,
            tuple(sorted(self._realms)),
            tuple(sorted({key.identifier for key, _ in self._times})),
            min(every, default=0),
            max(every, default=0),
            self.messages,
            rates,
            len(gaps),
            round(sum(gaps) / NS_PER_S, 3),
            _box(self._places),
        )


def _gaps(key: Key, times: list[int]) -> list[int]:
    """Silences within a boot in ns: between two boots a truck was off, which is none."""
    if topic(key.owner, key.stream).nominal_rate_hz is None:
        return []
    steps = (b - a for a, b in pairwise(sorted(times)))
    return [step for step in steps if step > LONGEST_SILENCE_S * NS_PER_S]


def _box(places: list[tuple[float, float]]) -> Box | None:
    """The smallest box round all places; across the meridian of 180 degrees if that is smaller."""
    if not places:
        return None
    south, north = min(p[0] for p in places), max(p[0] for p in places)
    west, east = min(p[1] for p in places), max(p[1] for p in places)
    turned = [p[1] % 360.0 for p in places]
    if max(turned) - min(turned) < east - west:
        west, east = min(turned), max(turned)
        if west > 180.0:
            west, east = west - 360.0, east - 360.0
    return Box(south, west, north, east)


def details_text(row: Row) -> str:
    """What is no column of its own, as text."""
    told = {
        "realms": row.realms,
        "vehicles": row.vehicles,
        "rates_hz": row.rates_hz,
        "gaps": row.gaps,
        "gap_s": row.gap_s,
        "messages": row.messages,
    }
    return json.dumps(told, separators=(",", ":"))
