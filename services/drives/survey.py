"""What a recording holds, without identifying anything: trucks, times, gaps, crossings.

One pass over the file. A crossing is a stay on a bridge of the site file, found in the positions as
the worker finds it; whether it can be identified is another question.
"""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import NamedTuple, TypeVar

from schemas.signals import NS_PER_S, GnssFix, decode_accel, decode_gnss
from schemas.site import Site
from schemas.site_file import parse_site
from schemas.topics import Key, topic
from services.common.errors import InputError
from services.common.intervals import Intervals
from services.common.progress import Offset, unwatched
from services.identification.bridges import Bridges, Passing, passings_of
from services.identification.streams import Boot, boot_of
from services.recordings.recording import Message, RecordingInfo, read_info

LONGEST_SILENCE_S = 1.0
"""A truck sends batches of 50 to 100 ms: a stream that says nothing for longer has a gap."""

T = TypeVar("T")


class Gap(NamedTuple):
    """A time in which a stream of a truck that was on says nothing."""

    vehicle: str
    stream: str
    begin_ns: int
    end_ns: int


class Stream(NamedTuple):
    """What there is of one kind of message of one truck."""

    messages: int
    missing: int
    """Numbers of the sequence that are not in the file, between the first and the last."""
    rate_hz: float | None
    """Messages per second while the stream says something; None for what comes on occasion."""


class Truck(NamedTuple):
    """One truck in one realm."""

    realm: str
    vehicle: str
    boots: int
    first_ns: int
    last_ns: int
    streams: dict[str, Stream]
    channel_rates_hz: dict[str, float]
    """By accelerometer, as declared."""


class Survey(NamedTuple):
    """What one recording holds."""

    path: Path
    size_bytes: int
    info: RecordingInfo
    site: Site | None
    site_error: str | None
    """Why the site file in it cannot be used, in one line."""
    first_ns: int
    """When the first thing was measured: a latched message may be hours older than the file."""
    last_ns: int
    trucks: tuple[Truck, ...]
    gaps: tuple[Gap, ...]
    passings: tuple[Passing, ...]
    """In order of time."""


def survey(
    path: Path,
    site: Site | None = None,
    look: Callable[[Message], object] = lambda message: None,
    progress: Offset = unwatched,
) -> Survey:
    """Read a recording and say what is in it; InputError if it is missing or not MCAP.

    `site` takes the place of the one that the recording carries; `look` is given every message of
    a topic that is logged, `progress` is told how far the file has been read. What cannot be
    decoded is counted as a message and tells nothing else.
    """
    streams: dict[tuple[Key, int], _Heard] = {}
    fixes: dict[tuple[str, str, int], dict[int, GnssFix]] = {}
    rates: dict[tuple[str, str], dict[str, float]] = {}

    def note(message: Message) -> None:
        look(message)
        where = message.key
        heard = streams.setdefault((where, message.boot_id), _Heard([], Intervals()))
        if heard.sequences.add(message.sequence):
            heard.times_ns.append(message.log_time_ns)
        if where.owner == "vehicle" and where.stream == "gnss":
            fix = _decoded(decode_gnss, message)
            if fix is not None:
                whose = (where.realm, where.identifier, message.boot_id)
                fixes.setdefault(whose, {})[message.sequence] = fix
        elif where.owner == "vehicle" and where.stream == "accel":
            known = rates.setdefault((where.realm, where.identifier), {})
            if not known and (batch := _decoded(decode_accel, message)) is not None:
                known.update((name, channel.rate_hz) for name, channel in batch.channels.items())

    info = read_info(path, note, progress)
    known, site_error = (site, None) if site is not None else _own_site(path, info.site_toml)
    boots = {name: boot_of(of_boot) for name, of_boot in fixes.items()}
    times = [t for (where, _), h in streams.items() if not _is_latched(where) for t in h.times_ns]
    return Survey(
        path,
        path.stat().st_size,
        info,
        known,
        site_error,
        min(times, default=info.first_time_ns),
        max(times, default=info.last_time_ns),
        _trucks(streams, rates),
        _gaps(streams),
        () if known is None else _passings(known, boots),
    )


class _Heard(NamedTuple):
    times_ns: list[int]
    sequences: Intervals


def _decoded(decode: Callable[[bytes], T], message: Message) -> T | None:
    try:
        return decode(message.payload)
    except ValueError:
        return None


def _is_latched(where: Key) -> bool:
    return topic(where.owner, where.stream).latched


def _own_site(path: Path, text: str | None) -> tuple[Site | None, str | None]:
    if text is None:
        return None, None
    try:
        return parse_site(text, f"{path}: site.toml"), None
    except InputError as error:
        return None, str(error)


def _trucks(
    streams: dict[tuple[Key, int], _Heard], rates: dict[tuple[str, str], dict[str, float]]
) -> tuple[Truck, ...]:
    by_truck: dict[tuple[str, str], dict[tuple[str, int], _Heard]] = {}
    for (where, boot_id), heard in streams.items():
        if where.owner == "vehicle":
            whose = by_truck.setdefault((where.realm, where.identifier), {})
            whose[(where.stream, boot_id)] = heard
    found = []
    for (realm, vehicle), heards in sorted(by_truck.items()):
        moving = [h for (stream, _), h in heards.items() if not topic("vehicle", stream).latched]
        times = [t for heard in moving or heards.values() for t in heard.times_ns]
        names = sorted({stream for stream, _ in heards})
        found.append(
            Truck(
                realm,
                vehicle,
                len({boot_id for _, boot_id in heards}),
                min(times),
                max(times),
                {
                    name: _stream(name, [h for (n, _), h in heards.items() if n == name])
                    for name in names
                },
                rates.get((realm, vehicle), {}),
            )
        )
    return tuple(found)


def _stream(name: str, heards: list[_Heard]) -> Stream:
    steps = [b - a for heard in heards for a, b in pairwise(sorted(heard.times_ns)) if b > a]
    has_rate = topic("vehicle", name).nominal_rate_hz is not None and steps
    return Stream(
        sum(heard.sequences.size for heard in heards),
        sum(b - a + 1 for heard in heards for a, b in heard.sequences.holes()),
        NS_PER_S / median(steps) if has_rate else None,
    )


def _gaps(streams: dict[tuple[Key, int], _Heard]) -> tuple[Gap, ...]:
    """Silences within a boot: between two boots a truck was off, which is none."""
    found = []
    for (where, _), heard in streams.items():
        if topic(where.owner, where.stream).nominal_rate_hz is None or where.owner != "vehicle":
            continue
        times = sorted(heard.times_ns)
        found += [
            Gap(where.identifier, where.stream, before, after)
            for before, after in pairwise(times)
            if after - before > LONGEST_SILENCE_S * NS_PER_S
        ]
    return tuple(sorted(found, key=lambda gap: (gap.begin_ns, gap.vehicle, gap.stream)))


def _passings(site: Site, boots: dict[tuple[str, str, int], Boot]) -> tuple[Passing, ...]:
    trucks = {vehicle.id: vehicle for vehicle in site.vehicles}
    bridges = Bridges(site.bridges, site.receiver)
    found = [
        passing
        for (realm, vehicle, _), boot in boots.items()
        if vehicle in trucks and boot.fixes().time_s.size
        for passing in passings_of(bridges, realm, trucks[vehicle], boot)
    ]
    return tuple(sorted(found, key=lambda passing: (passing.entry_ns, passing.vehicle)))
