"""The truck: a gateway that publishes sensor data, and recordings that simulate sensors.

A program with its own sensors uses `gateway`; `run` plays a recording.
"""

import contextlib
import logging
import math
import threading
import time
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from functools import partial
from heapq import merge
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import zenoh

from schemas.signals import (
    NS_PER_S,
    Identity,
    decode_accel,
    decode_gnss,
    decode_info,
    encode_accel,
    encode_gnss,
    encode_info,
    location_class,
)
from schemas.topics import Message
from services.bus.credentials import check_speaks_for
from services.bus.playback import (
    GAP_S,
    check_speed,
    confirm,
    declare_and_wait,
    publish_paced,
    stopped_by_signals,
)
from services.bus.session import checked_realm, open_session
from services.common.errors import FailureError, InputError
from services.common.naming import count_of
from services.recordings.recording import check_message, read_messages
from services.truck.gateway import Connect, Gateway
from services.truck.settings import TruckSettings
from services.truck.spool import Spool

_log = logging.getLogger(__name__)
CONNECT_TIMEOUT_S = 10.0
"""Timeout for a router that was started a moment before."""
_LONG_WAIT_S = 10.0
"""Shortest silence that needs an explanation to the user."""
_OLD_S = 60.0
"""Age of published samples that needs an explanation."""
SUBSCRIBER_TIMEOUT_S = 1.0
"""Timeout for a subscriber; the cache serves late ones."""


def run(asked: TruckSettings, *, connect_timeout_s: float | None = CONNECT_TIMEOUT_S) -> int:
    """Play one vehicle of a recording as if it were driving now; return 0.

    A folder of CSV files may replace the recording (docs/contract.md). The playback is a new boot
    of that truck: new boot_id, sequences from 0, and times shifted as a whole so that the recording
    ends now (at `speed` 1 or less: begins now). **Only the publication is faster than real time,
    not the data**: rates and the time between samples stay those of the recording, because they
    are physics. Shifted to the end, no stamp lies in the future. With a spool messages of an
    earlier drive are offered too, and the router may come later. Return when a logger has
    everything on disk (see `services.bus.delivery`).

    Raise InputError if the recording is missing, invalid or without that vehicle, or the spool is
    another truck's; FailureError if the endpoint does not answer within `connect_timeout_s` (None:
    wait for ever; irrelevant with a spool), nothing subscribes until the end (a spool keeps the
    messages), the logger did not confirm everything, or messages are neither spooled nor sent.
    """
    check_speed(asked.speed)
    realm = checked_realm(asked.realm)
    streams = _read_vehicle(asked.recording, asked.vehicle, asked.site)
    vehicle = next(iter(streams.values()))[0].key.identifier
    check_speaks_for(asked.tls, "truck", vehicle)
    with stopped_by_signals() as stop, contextlib.ExitStack() as stack:
        if asked.spool is None:
            bus: zenoh.Session | Connect = stack.enter_context(
                open_session(connect=asked.address, timeout_s=connect_timeout_s, tls=asked.tls)
            )
        else:
            bus = partial(open_session, connect=asked.address, timeout_s=0.0, tls=asked.tls)
        spool = None
        if asked.spool is not None:
            spool = Spool(asked.spool, budget_bytes=asked.spool_budget << 20)
        gateway = Gateway(bus, realm, vehicle, spool)
        stack.callback(gateway.close)
        times = _times(streams, asked.speed, skip_gaps=asked.skip_gaps)
        _log_timing(times)
        messages = _driven_now(asked.recording, streams, realm, gateway.boot_id, times)
        keys = [queue[0].key for queue in streams.values()]
        if gateway.is_online and not declare_and_wait(
            gateway.publisher, keys, SUBSCRIBER_TIMEOUT_S
        ):
            # A real truck continues as well; its cache serves late subscribers.
            gateway.warn_without_subscriber()
        sent = _publish(gateway, messages, asked, stop)
        is_spooled = spool is not None
        confirm(gateway.delivery, sent, gateway.subscriber_complaint, is_spooled=is_spooled)
        _report_end(gateway, sent, asked.address)
    return 0


def _report_end(gateway: Gateway, sent: int, address: str) -> None:
    """Log where the messages are; raise FailureError if some are neither on the disk nor sent."""
    number = f"{count_of(sent, 'message')} of {gateway.vehicle}"
    if gateway.is_online:
        gateway.log.info("%s published in realm %s", number, gateway.publisher.realm)
        return
    if gateway.unspooled:
        raise FailureError(
            f"{gateway.unspooled} of {number} are lost: no room in the spool, and no router "
            f"answered at {address}; the spool keeps the others"
        )
    gateway.log.warning(
        "%s kept in the spool and none published, as no router answered at %s", number, address
    )


def _publish(
    gateway: Gateway, messages: Iterable[Message], asked: TruckSettings, stop: threading.Event
) -> int:
    """Publish the messages at their pace; return how many."""

    def put(message: Message) -> None:
        identity = Identity(message.boot_id, message.sequence)
        gateway.put(message.key.stream, message.payload, identity, patient=True)

    longest_gap_s = GAP_S if asked.skip_gaps else math.inf
    return publish_paced(
        messages, put, gateway.delivery, speed=asked.speed, stop=stop, longest_gap_s=longest_gap_s
    )


def _read_vehicle(
    recording: Path, vehicle: str | None, site: Path | None
) -> dict[str, list[Message]]:
    """Return the messages of one vehicle by stream, each stream in the order of its creation."""
    streams: dict[str, list[Message]] = {}
    vehicles: set[str] = set()
    for message in _messages(recording, vehicle, site):
        if message.key.owner != "vehicle":
            continue
        vehicles.add(message.key.identifier)
        if vehicle in (None, message.key.identifier):
            streams.setdefault(message.key.stream, []).append(message)
    names = ", ".join(sorted(vehicles)) or "no vehicle at all"
    if not streams:
        raise InputError(f"{recording}: no vehicle {vehicle!r}; it holds {names}")
    if vehicle is None and len(vehicles) > 1:
        raise InputError(f"{recording}: several vehicles; name one with --vehicle: {names}")
    for messages in streams.values():
        messages.sort(key=lambda message: (message.boot_id, message.sequence))
    return streams


def _messages(source: Path, vehicle: str | None, site: Path | None) -> Iterator[Message]:
    """Yield the truck's future messages; raise InputError at the first invalid one."""
    if not source.is_dir():
        for message in read_messages(source):
            if message.key.owner == "vehicle":
                check_message(source, message)
            yield message
        return
    if site is None:
        raise InputError(f"{source}: a folder of CSV files needs --site")
    from services.drives.importing import messages_of

    yield from messages_of(source, site, vehicle)


class _DriveTiming(NamedTuple):
    """Times of a playback."""

    first_ns: int
    ahead_ns: int
    """Lead of the last sample over the clock, which is the age of the first one."""
    takes_s: float
    waits_s: float
    """Duration of silences in which nothing is published."""
    longest_ns: tuple[int, int]
    """Begin and end of its longest silence."""


def _times(streams: dict[str, list[Message]], speed: float, *, skip_gaps: bool) -> _DriveTiming:
    recorded = sorted(message.log_time_ns for queue in streams.values() for message in queue)
    gaps = [(a, b) for a, b in pairwise(recorded) if b - a > GAP_S * NS_PER_S]
    silent_ns = sum(b - a for a, b in gaps)
    duration_ns = recorded[-1] - recorded[0]
    waited_ns = duration_ns - silent_ns if skip_gaps else duration_ns
    takes_ns = round(waited_ns / speed) if speed else 0
    waits_ns = 0 if skip_gaps or not speed else round(silent_ns / speed)
    longest = max(gaps, key=lambda gap: gap[1] - gap[0], default=(recorded[0], recorded[0]))
    ahead_ns = max(0, duration_ns - takes_ns)
    return _DriveTiming(recorded[0], ahead_ns, takes_ns * 1e-9, waits_ns * 1e-9, longest)


def _log_timing(times: _DriveTiming) -> None:
    """Log waits and ages of samples that may look like a fault."""
    if times.waits_s > _LONG_WAIT_S:
        begin_ns, end_ns = times.longest_ns
        _log.warning(
            "nothing was recorded for up to %.0f s (between runs): of the %.0f s that the drive "
            "takes, %.0f s are spent waiting; --skip-gaps skips them",
            *((end_ns - begin_ns) * 1e-9, times.takes_s, times.waits_s),
        )
    if times.ahead_ns > _OLD_S * NS_PER_S:
        begins = datetime.fromtimestamp(time.time() - times.ahead_ns * 1e-9, UTC)
        _log.info(
            "all times are shifted so that drive and publication end together; the drive begins "
            "at %s UTC, and its first samples are %.0f s old when they are published",
            *(f"{begins:%Y-%m-%d %H:%M:%S}", times.ahead_ns * 1e-9),
        )


def _driven_now(
    recording: Path,
    streams: dict[str, list[Message]],
    realm: str,
    boot_id: int,
    times: _DriveTiming,
) -> Iterator[Message]:
    """Yield all streams merged by time, with the times and identities of a drive that happens now.

    Raise InputError if the times of the recording are so far apart that some leave this century.
    """
    first_ns = times.first_ns
    wall_shift_ns = time.time_ns() - first_ns - times.ahead_ns
    device_start_ns = max(0, time.monotonic_ns() - times.ahead_ns)
    device_shifts: dict[int, int] = {}
    for index, message in _merged(streams.values()):
        try:
            restamped = _restamped(
                message,
                Identity(boot_id, index),
                realm,
                wall_shift_ns,
                device_start_ns + message.log_time_ns - first_ns,
                device_shifts,
            )
        except ValueError as error:
            where = f"{message.key.stream} {message.sequence}"
            raise InputError(f"{recording}: {where} cannot be driven now: {error}") from None
        yield restamped


def _merged(streams: Iterable[list[Message]]) -> Iterator[tuple[int, Message]]:
    return merge(*(enumerate(queue) for queue in streams), key=lambda item: item[1].log_time_ns)


def _restamped(
    message: Message,
    identity: Identity,
    realm: str,
    wall_shift_ns: int,
    device_time_ns: int,
    device_shifts: dict[int, int],
) -> Message:
    """Return the message with another boot and time; samples, rates and positions unchanged.

    The device clock keeps its own intervals within a recorded boot: `device_shifts` holds the
    offset of each recorded boot, determined by its first message.
    """
    wall_time_ns = message.log_time_ns + wall_shift_ns
    times: dict[str, Any] = {
        "boot_id": identity.boot_id,
        "sequence": identity.sequence,
        "wall_time_ns": wall_time_ns,
    }

    def device(recorded_ns: int) -> int:
        shift_ns = device_shifts.setdefault(message.boot_id, device_time_ns - recorded_ns)
        return max(0, recorded_ns + shift_ns)

    match message.key.stream:
        case "accel":
            batch = decode_accel(message.payload)
            times["device_time_ns"] = device(batch.device_time_ns)
            payload = encode_accel(batch._replace(**times))
        case "gnss":
            fix = decode_gnss(message.payload)
            times["device_time_ns"] = device(fix.device_time_ns)
            payload = encode_gnss(fix._replace(**times))
        case "info":
            info = decode_info(message.payload)
            times["device_time_ns"] = device(info.device_time_ns)
            payload = encode_info(info._replace(**times))
        case _:
            location: Any = location_class().FromString(message.payload)
            seconds, nanoseconds = divmod(wall_time_ns, NS_PER_S)
            location.timestamp.seconds, location.timestamp.nanos = seconds, nanoseconds
            payload = location.SerializeToString(deterministic=True)
    return Message(
        message.key._replace(realm=realm),
        payload,
        *identity,
        wall_time_ns,
        message.publish_time_ns,
    )
