"""Contents of a recording, without any identification: trucks, times, gaps, crossings.

One pass over the file. A crossing is a stay on a bridge of the site file, detected in the positions
as the worker does it; whether it can be identified is another question.
"""

from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

from schemas.signals import NS_PER_S
from schemas.site import Site
from schemas.site_file import parse_site
from schemas.topics import Key, Message, topic
from services.catalogue.silences import Arrivals, Silence, no_arrivals, silences
from services.common.errors import InputError
from services.common.intervals import Intervals
from services.common.progress import Offset, no_progress
from services.finding.bridges import Bridges, DetectedCrossing, detect_crossings
from services.finding.drive import DriveMessages, Drives
from services.finding.streams import batch_extent, boot_of, missing_samples
from services.recordings.recording import RecordingInfo, read_info


class Gap(NamedTuple):
    """A silence of one stream that is no pause of its truck; times in ns."""

    vehicle: str
    stream: str
    begin_ns: int
    end_ns: int


class SampleGaps(NamedTuple):
    """Missing samples of a truck's accelerations within its boots; each costs a crossing it meets.

    A rejected crossing has the reason `gap_on_bridge`.
    """

    number: int = 0
    total_s: float = 0.0
    longest_s: float = 0.0


class StreamSummary(NamedTuple):
    """Statistics of one kind of message of one truck."""

    messages: int
    missing: int
    """Number of absent sequence numbers between the first and the last one."""
    rate_hz: float | None
    """Messages per second while the stream is active; None for occasional messages."""


class TruckSummary(NamedTuple):
    """One truck in one realm; times in ns."""

    realm: str
    vehicle: str
    boots: int
    first_ns: int
    last_ns: int
    streams: dict[str, StreamSummary]
    channel_rates_hz: dict[str, float]
    """Declared rate of each accelerometer, Hz."""
    sample_gaps: SampleGaps = SampleGaps()


class RecordingSummary(NamedTuple):
    """Contents of one recording; times in ns."""

    path: Path
    size_bytes: int
    info: RecordingInfo
    site: Site | None
    site_error: str | None
    """Reason in one line why the stored site file is unusable."""
    first_ns: int
    """First time of measurement; a latched message may be hours older than the file."""
    last_ns: int
    trucks: tuple[TruckSummary, ...]
    gaps: tuple[Gap, ...]
    passings: tuple[DetectedCrossing, ...]
    """Detected crossings in order of time."""


def summarise_recording(
    path: Path,
    site: Site | None = None,
    on_message: Callable[[Message], object] = lambda message: None,
    progress: Offset = no_progress,
) -> RecordingSummary:
    """Summarise a recording; InputError if it is missing or not MCAP.

    `site` replaces the site file that the recording carries. `take` is called with every message of
    a logged topic, `progress` with the number of bytes read. An undecodable message is counted and
    otherwise ignored.
    """
    streams: dict[tuple[Key, int], _StreamArrivals] = {}
    extents: dict[tuple[Key, int], _Extents] = {}
    drives = Drives(most_batches=1)

    def note(message: Message) -> None:
        on_message(message)
        where = message.key
        arrivals = streams.setdefault(
            (where, message.boot_id), _StreamArrivals(no_arrivals(), Intervals())
        )
        if arrivals.sequences.add(message.sequence):
            arrivals.received.add(message.log_time_ns, message.sequence)
            if where.owner == "vehicle" and where.stream == "accel":
                extents.setdefault((where, message.boot_id), _Extents()).add(message)
        drives.add(message)

    info = read_info(path, note, progress)
    known, site_error = (site, None) if site is not None else _own_site(path, info.site_toml)
    silent = list(silences((name, one.received) for name, one in streams.items()))
    latched = {where for where, _ in streams if topic(where.owner, where.stream).latched}
    times = [t for (where, _), h in streams.items() if where not in latched for t in h.times_ns]
    return RecordingSummary(
        path,
        path.stat().st_size,
        info,
        known,
        site_error,
        min(times, default=info.first_time_ns),
        max(times, default=info.last_time_ns),
        _trucks(streams, _rates(drives.all()), _sample_gaps(extents, silent)),
        _gaps(silent),
        () if known is None else _passings(known, drives.all()),
    )


class _StreamArrivals(NamedTuple):
    received: Arrivals
    sequences: Intervals

    @property
    def times_ns(self) -> "array[int]":
        """Times of its messages, ns."""
        return self.received.times_ns


class _Extents:
    """Extents of the batches of one boot, in arrays: a day has a million batches."""

    def __init__(self) -> None:
        self._sequences, self._times_ns, self._sizes = array("q"), array("q"), array("q")
        self._logged_ns = array("q")
        self._rate_hz = 0.0

    def add(self, message: Message) -> None:
        """Add a message; ignore a malformed one."""
        try:
            extent = batch_extent(message.payload)
        except ValueError:
            return
        self._rate_hz = max(self._rate_hz, extent.rate_hz)
        self._sequences.append(message.sequence)
        self._times_ns.append(extent.device_time_ns)
        self._sizes.append(extent.samples)
        self._logged_ns.append(message.log_time_ns)

    def gaps_s(self, pauses_ns: Sequence[int]) -> list[float]:
        """Return the lengths of the gaps between samples in s; `pauses_ns` begin with a batch."""
        if not self._sequences:
            return []
        sequences, times_ns, sizes, logged_ns = (
            np.array(one) for one in (self._sequences, self._times_ns, self._sizes, self._logged_ns)
        )
        order = np.argsort(sequences, kind="stable")
        missing = missing_samples(sequences[order], times_ns[order], sizes[order], self._rate_hz)
        is_gap = (missing > 0) & ~np.isin(logged_ns[order][:-1], pauses_ns)
        return [float(number) / self._rate_hz for number in missing[is_gap]]


def _sample_gaps(
    extents: Mapping[tuple[Key, int], _Extents], silent: Iterable[Silence]
) -> dict[tuple[str, str], SampleGaps]:
    """Return the gaps of samples by realm and vehicle."""
    lengths: dict[tuple[str, str], list[float]] = {}
    pauses: dict[tuple[Key, int], list[int]] = {}
    for silence in silent:
        if silence.is_pause:
            pauses.setdefault((silence.where, silence.boot_id), []).append(silence.begin_ns)
    for (where, boot_id), one in extents.items():
        gaps_s = one.gaps_s(pauses.get((where, boot_id), []))
        lengths.setdefault((where.realm, where.identifier), []).extend(gaps_s)
    return {
        truck: SampleGaps(len(some), sum(some), max(some, default=0.0))
        for truck, some in lengths.items()
    }


def _rates(drives: Iterable[DriveMessages]) -> dict[tuple[str, str], dict[str, float]]:
    """Return the rates of each truck's channels, as its first batch declares them."""
    rates: dict[tuple[str, str], dict[str, float]] = {}
    for drive in drives:
        for batch in drive.batches():
            declared = {name: channel.rate_hz for name, channel in batch.channels.items()}
            rates.setdefault((drive.realm, drive.vehicle), declared)
    return rates


def _own_site(path: Path, text: str | None) -> tuple[Site | None, str | None]:
    if text is None:
        return None, None
    try:
        return parse_site(text, f"{path}: site.toml"), None
    except InputError as error:
        return None, str(error)


def _trucks(
    streams: dict[tuple[Key, int], _StreamArrivals],
    rates: dict[tuple[str, str], dict[str, float]],
    gaps: Mapping[tuple[str, str], SampleGaps],
) -> tuple[TruckSummary, ...]:
    by_truck: dict[tuple[str, str], dict[tuple[str, int], _StreamArrivals]] = {}
    for (where, boot_id), arrivals in streams.items():
        if where.owner == "vehicle":
            of_one = by_truck.setdefault((where.realm, where.identifier), {})
            of_one[(where.stream, boot_id)] = arrivals
    found = []
    for (realm, vehicle), of_truck in sorted(by_truck.items()):
        moving = [h for (stream, _), h in of_truck.items() if not topic("vehicle", stream).latched]
        times = [t for arrivals in moving or of_truck.values() for t in arrivals.times_ns]
        names = sorted({stream for stream, _ in of_truck})
        found.append(
            TruckSummary(
                realm,
                vehicle,
                len({boot_id for _, boot_id in of_truck}),
                min(times),
                max(times),
                {
                    name: _stream(name, [h for (n, _), h in of_truck.items() if n == name])
                    for name in names
                },
                rates.get((realm, vehicle), {}),
                gaps.get((realm, vehicle), SampleGaps()),
            )
        )
    return tuple(found)


def _stream(name: str, of_truck: list[_StreamArrivals]) -> StreamSummary:
    steps = [
        b - a for arrivals in of_truck for a, b in pairwise(sorted(arrivals.times_ns)) if b > a
    ]
    has_rate = topic("vehicle", name).nominal_rate_hz is not None and steps
    return StreamSummary(
        sum(arrivals.sequences.size for arrivals in of_truck),
        sum(b - a + 1 for arrivals in of_truck for a, b in arrivals.sequences.gaps()),
        NS_PER_S / median(steps) if has_rate else None,
    )


def _gaps(silent: Iterable[Silence]) -> tuple[Gap, ...]:
    found = [
        Gap(one.where.identifier, one.where.stream, one.begin_ns, one.end_ns)
        for one in silent
        if not one.is_pause
    ]
    return tuple(sorted(found, key=lambda gap: (gap.begin_ns, gap.vehicle, gap.stream)))


def _passings(site: Site, drives: Iterable[DriveMessages]) -> tuple[DetectedCrossing, ...]:
    trucks = {vehicle.id: vehicle for vehicle in site.vehicles}
    bridges = Bridges(site.bridges, site.receiver)
    found = [
        passing
        for drive in drives
        if drive.vehicle in trucks and drive.fixes
        for passing in detect_crossings(
            bridges, drive.realm, trucks[drive.vehicle], boot_of(drive.fixes)
        )
    ]
    return tuple(sorted(found, key=lambda passing: (passing.entry_ns, passing.vehicle)))
