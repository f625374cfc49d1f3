"""The logger: hosts the router and records every topic that the table marks as logged."""

import contextlib
import logging
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import zenoh

from schemas.events import Event, EventKind
from schemas.proto import driveby_pb2 as pb
from schemas.signals import Identity
from schemas.topics import (
    HEALTH_PERIOD_S,
    PREFIX,
    Message,
    check_identifier,
    check_realms,
    realm_chunk,
    single_realm,
)
from services.bus.credentials import check_speaks_for
from services.bus.playback import leave_at_once, stopped_by_signals
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.common.disk import DISK, is_virtual
from services.common.errors import FailureError, InputError
from services.common.files import check_folder_writable
from services.common.interrupts import handled_by
from services.common.intervals import Intervals
from services.common.log_lines import about
from services.common.naming import count_of
from services.logger.completeness import Completeness
from services.logger.drops import QUEUE_IS_FULL, Drop
from services.logger.file_layout import RecordingTarget
from services.logger.first_connection import FirstConnection
from services.logger.folder_lock import locked_folder
from services.logger.health_line import clock_note, health_line
from services.logger.housekeeping import Housekeeping, RetentionPolicy
from services.logger.intake import Intake
from services.logger.memory import give_back_memory
from services.logger.open_files import RotationLimits
from services.logger.own_events import OwnEvents
from services.logger.rate_limited_log import RateLimitedLog
from services.logger.settings import LoggerSettings
from services.logger.unlisted import UnlistedLog
from services.logger.writer import FileWriter, count_all

_log = logging.getLogger(__name__)
_ANNOUNCE_PERIOD_S = 0.1
"""Longest delay of an event to the bus."""
_DURABLE_PERIOD_S = 1.0
"""Interval of `durable`, which covers all trucks and may travel over a mobile network."""
_REPORT_PERIOD_S = 1.0
"""Interval of counting received and missing messages."""
_DRAIN_S = 2.5
"""Time at the end for messages that have already arrived; the others are counted."""
_COUNT_S = 1.0
"""Time for that counting, because a flood would keep the logger alive."""
_PAUSE_S = 0.05
"""Pause without messages. Many messages in a row cost a quarter less each than a few."""
_AT_ONCE_S = 0.02
"""Time of receiving before other work gets its turn."""
_FETCH_ROOM = 32 << 20
"""Free bytes in the writer's queue below which trucks are not asked for missing messages."""
_GOODBYE_S = 0.2
"""Time for the connection to send the last messages, because a put only queues."""
_DROPS_PERIOD_S = 60.0
"""Interval of events on a source's losses other than by a full queue, with a count."""
_MAX_DROPS_REPORTED = 1000
"""Number of sources with remembered reports; beyond, all are reported again."""
_EVENTS_LOGGED = 20
"""Log lines for events of a kind per minute; recordings and bus have all of them."""


def run(asked: LoggerSettings, ready: Callable[[], None] | None = None) -> int:
    """Record until SIGINT or SIGTERM, then finish the files; return 0, or 1 if anything was lost.

    No file is ever overwritten. SIGUSR1 starts the next file of every truck at once. Recordings of
    an earlier run without END are recovered meanwhile. `ready` is called once, when messages can be
    received. A second signal ends the process at once; the files stay readable.

    Raise InputError for a file that exists or cannot be created, a folder in which another logger
    records, a malformed endpoint, realm or site file; FailureError if the address is in use, the
    disk has too little space, or writing failed.
    """
    limits = asked.limits
    place, realms = _check(asked, limits)
    own = OwnEvents(asked.service_id, time.time_ns())
    with (
        stopped_by_signals(on_second=leave_at_once) as stop,
        open_session(listen=asked.address, tls=asked.tls, insecure=asked.insecure) as bus,
        locked_folder(asked.folder) if asked.file is None else contextlib.nullcontext(),
    ):
        writer = FileWriter(place, limits, own=own)
        try:
            intake = Intake(place.realm, asked.service_id, own.boot_id)
            logger = _Logger(place, realms, writer, intake, own, asked)
            with _rotated_by_signal(writer):
                gone = _record(logger, bus, stop, ready, asked.budget_bytes)
        except BaseException:
            writer.finish("logger failed", {})
            raise
    if writer.failure is not None:
        raise FailureError(writer.failure)
    return 1 if writer.dropped or gone else 0


def _check(asked: LoggerSettings, limits: RotationLimits) -> tuple[RecordingTarget, Sequence[str]]:
    """Return where to write and the realms; raise as `run` does."""
    if asked.file is not None and asked.budget_bytes is not None:
        raise InputError("--budget needs a folder of recordings, not --file")
    realms = _check_realms(asked.realms)
    target = RecordingTarget(asked.folder, asked.file, single_realm(realms), _site_text(asked.site))
    _check_service(asked.service_id)
    check_speaks_for(asked.tls, "logger", asked.service_id)
    check_folder_writable(asked.written)
    if asked.file is not None and asked.file.exists():
        raise InputError(
            f"{asked.file}: exists, and recordings are never overwritten; give another name"
        )
    _check_room(asked.written, limits.min_free_bytes)
    return target, realms


class _Logger(NamedTuple):
    place: RecordingTarget
    realms: Sequence[str]
    writer: FileWriter
    intake: Intake
    own: OwnEvents
    asked: LoggerSettings


def _record(
    logger: _Logger,
    bus: zenoh.Session,
    stop: threading.Event,
    ready: Callable[[], None] | None,
    budget_bytes: int | None,
) -> int:
    """Record until stopped; return the number of messages lost with files deleted meanwhile."""
    place = logger.place
    folder = place.folder if place.file is None else None
    completeness = Completeness(bus, folder, logger.realms, logger.intake, logger.writer)
    announcements = _Announcements(bus, logger, completeness)
    house = RetentionPolicy(
        place.folder,
        logger.realms,
        logger.writer.limits.min_free_bytes,
        budget_bytes,
        announcements.event,
    )
    housekeeping = Housekeeping(house) if folder is not None else None
    subscriptions = deque(
        Subscription(bus, f"{PREFIX}/{realm_chunk(realm)}/**") for realm in logger.realms
    )
    if place.site_text is None:
        _log.info("recordings will contain no site file (--site): `identify` will ask for one")
    try:
        if ready is not None:
            ready()
        next_report_s = time.monotonic()
        while not stop.is_set() and logger.writer.failure is None:
            now_s = _take_batch(logger, subscriptions, stop)
            for fetched in completeness.step(now_s, hold=not logger.writer.has_room(_FETCH_ROOM)):
                _take(logger, fetched)
            if now_s >= next_report_s:
                next_report_s = now_s + _REPORT_PERIOD_S
                completeness.report(now_s)
                _report(logger, announcements, closing=False)
        if housekeeping is not None:
            housekeeping.close()
        for subscription in subscriptions:
            subscription.close()
        _drain(logger, subscriptions)
        _report(logger, announcements, closing=True)
        reason = "stopped by a signal"  # nothing is written after a write error
        logger.writer.finish(reason, count_all(logger.intake.counts, logger.writer))
        completeness.report(time.monotonic())  # a file may have been missing only now
        return completeness.gone()
    finally:
        if housekeeping is not None:
            housekeeping.close()
        completeness.close()
        for subscription in subscriptions:
            subscription.close()
        announcements.close()


def _take_batch(
    logger: _Logger, subscriptions: deque[Subscription], stop: threading.Event
) -> float:
    """Process the messages received within a short time, or pause; return the monotonic time."""
    received = _receive(subscriptions)
    if received is None:
        stop.wait(_PAUSE_S)
    began_s = now_s = time.monotonic()
    while received is not None:
        _take(logger, received)
        now_s = time.monotonic()
        received = _receive(subscriptions) if now_s - began_s < _AT_ONCE_S else None
    return now_s


def _receive(subscriptions: deque[Subscription]) -> RawSample | None:
    """Return a received message, of each subscription in turn; None if there is none."""
    for _ in range(len(subscriptions)):
        subscriptions.rotate(-1)
        received = subscriptions[-1].receive()
        if received is not None:
            return received
    return None


def _take(logger: _Logger, received: RawSample) -> None:
    if not logger.writer.has_room(len(received.payload)):
        # Not even accepted, so that it can be fetched from the truck later.
        logger.writer.count_drop(None)
        return
    message = logger.intake.accept(received, time.time_ns())
    if message is not None and not logger.writer.put(message):
        numbers = Intervals()
        numbers.add(message.sequence)
        logger.intake.forget_seen(message.key, message.boot_id, numbers)


def _drain(logger: _Logger, subscriptions: deque[Subscription]) -> None:
    """Process messages that have already arrived for a limited time; count the others."""
    deadline = time.monotonic() + _DRAIN_S
    while (received := _receive(subscriptions)) is not None:
        if time.monotonic() < deadline:
            _take(logger, received)
        elif time.monotonic() < deadline + _COUNT_S:
            logger.writer.count_drop(None)
        else:
            return


def _report(logger: _Logger, announcements: "_Announcements", *, closing: bool) -> None:
    now_ns = time.time_ns()
    for where, event in logger.intake.report(now_ns, time.monotonic(), closing=closing):
        announcements.event(where.realm, event)
    for sender, line in logger.intake.shared_names.news():
        fields = about(realm=sender.realm, **{sender.owner: sender.identifier})
        _log.warning("%s", line, extra=fields)
    announcements.report_drops(now_ns, closing=closing)


class _Announcements:
    """Publisher thread of `durable`, `event` and `health`.

    A put to a congested connection blocks, which must delay neither receiving nor writing.
    """

    def __init__(self, bus: zenoh.Session, logger: _Logger, completeness: Completeness) -> None:
        self._bus = bus
        self._completeness = completeness
        self._logger = logger
        self._publishers: dict[str, Publisher] = {}
        self._boot_id = logger.own.boot_id
        self._pending: list[Message] = []
        self._lock = threading.Lock()
        self._drops: dict[tuple[str, str], Drop] = {}
        self._drops_reported_s: dict[tuple[str, str], float] = {}
        self._complaints = RateLimitedLog(_log, _EVENTS_LOGGED)
        self._unlisted = UnlistedLog(bus, logger.asked.tls)
        self._first = FirstConnection(bus, logger.asked.address)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="announce", daemon=True)
        self._thread.start()

    def event(self, realm: str, event: Event) -> None:
        """Write an event to the recording of the vehicle concerned, and publish it."""
        who = f"{event.vehicle}: " if event.vehicle else ""
        fields = about(realm=realm, vehicle=event.vehicle)
        kind = event.kind
        self._complaints.warn(f"event {kind}", "%s: %s%s", kind, who, event.text, extra=fields)
        message = self._logger.own.message(realm, event)
        self._logger.writer.put(message, always=True)
        with self._lock:
            self._pending.append(message)

    def report_drops(self, now_ns: int, *, closing: bool = False) -> None:
        """Record the number and cause of dropped messages, each cause once a minute.

        A full queue is reported at once.
        """
        for drop in self._logger.writer.drops():
            name = (drop.vehicle, drop.why)
            before = self._drops.get(name, drop._replace(messages=0))
            self._drops[name] = before._replace(messages=before.messages + drop.messages)
        now_s = time.monotonic()
        for name, drop in list(self._drops.items()):
            is_queue = drop.why == QUEUE_IS_FULL
            reported_s = self._drops_reported_s.get(name, -_DROPS_PERIOD_S)
            if not (closing or is_queue or now_s - reported_s >= _DROPS_PERIOD_S):
                continue
            del self._drops[name]
            if len(self._drops_reported_s) >= _MAX_DROPS_REPORTED:
                self._drops_reported_s.clear()
            self._drops_reported_s[name] = now_s
            kind = EventKind.QUEUE_FULL if is_queue else EventKind.DROPPED
            text = f"{count_of(drop.messages, 'message')} {drop.why}"
            event = Event(kind, now_ns, text, vehicle=drop.vehicle, messages=drop.messages)
            self.event(drop.realm, event)

    def close(self) -> None:
        """Publish the last messages and stop."""
        self._closing.set()
        self._thread.join(timeout=_GOODBYE_S * 5)
        time.sleep(_GOODBYE_S)  # a put only hands over; leave the connection time to send
        for publisher in self._publishers.values():
            publisher.close()
        self._unlisted.close()
        self._complaints.flush(closing=True)

    def _run(self) -> None:
        version = -1
        next_durable_s = 0.0
        next_health_s = time.monotonic()  # at once: whatever started the logger waits for it
        while True:
            closing = self._closing.wait(_ANNOUNCE_PERIOD_S)
            self._publish_events()
            self._complaints.flush()
            self._unlisted.log_arrivals()
            self._first.log(time.monotonic())
            is_due = closing or time.monotonic() >= next_durable_s
            if is_due and self._logger.writer.durable_version() != version:
                next_durable_s = time.monotonic() + _DURABLE_PERIOD_S
                version = self._publish_durable()
            if closing or time.monotonic() >= next_health_s:
                next_health_s = time.monotonic() + HEALTH_PERIOD_S
                self._publish_health(ended=closing)
                give_back_memory()
            if closing:
                return

    def _publisher(self, realm: str) -> Publisher:
        publisher = self._publishers.get(realm)
        if publisher is None:
            publisher = self._publishers[realm] = Publisher(self._bus, realm, self._boot_id)
        return publisher

    def _publish_events(self) -> None:
        with self._lock:
            pending, self._pending = self._pending, []
        while self._logger.writer.unpublished:
            pending.append(self._logger.writer.unpublished.popleft())
        for message in pending:
            _, owner, name, stream = message.key
            identity = Identity(message.boot_id, message.sequence)
            self._publisher(message.key.realm).put(owner, name, stream, message.payload, identity)

    def _publish_durable(self) -> int:
        version, by_realm = self._logger.writer.durable()
        for realm, message in by_realm.items():
            message.time_ns = time.time_ns()
            payload = message.SerializeToString(deterministic=True)
            self._publisher(realm).put("service", self._logger.asked.service_id, "durable", payload)
        return version

    def _publish_health(self, *, ended: bool) -> None:
        writer = self._logger.writer
        figures: dict[str, float] = dict(count_all(self._logger.intake.counts, writer))
        figures |= writer.take_figures()
        if writer.room.free_bytes is not None:
            figures["disk_free_bytes"] = writer.room.free_bytes
        figures |= self._completeness.figures()
        shared = self._logger.intake.shared_names.note_text(time.time_ns())
        notes = (writer.failure or "", self._unlisted.note, clock_note(figures), shared)
        message = pb.Health(
            schema_version=1,
            time_ns=time.time_ns(),
            service=self._logger.asked.service_id,
            ok=writer.failure is None and not writer.dropped and not writer.room.is_low,
            figures={name: float(value) for name, value in figures.items()},
            note="; ".join(note for note in notes if note),
            ended=ended,
        )
        realm = self._logger.place.realm or "live"
        payload = message.SerializeToString(deterministic=True)
        self._publisher(realm).put("service", self._logger.asked.service_id, "health", payload)
        _log.info("%s", health_line(figures), extra={"figures": figures})


def _check_realms(realms: Sequence[str]) -> tuple[str, ...]:
    try:
        checked = tuple(dict.fromkeys(check_realms(realm) for realm in realms))
    except ValueError as error:
        raise InputError(str(error)) from None
    return ("*",) if "*" in checked else checked


def _check_service(service_id: str) -> None:
    try:
        check_identifier(service_id)
    except ValueError as error:
        raise InputError(f"service: {error}") from None


def _site_text(site: Path | None) -> Callable[[], str] | None:
    if site is None:
        return None
    from services.logger.site_text import RecordedSite

    return RecordedSite(site).current


def _check_room(folder: Path, min_free_bytes: int) -> None:
    free_bytes = DISK.free_bytes(folder)
    if free_bytes < min_free_bytes:
        if is_virtual(folder):
            raise InputError(f"{folder}: cannot be created, its file system stores no files")
        raise FailureError(
            f"only {free_bytes / 1e6:.0f} MB left on the disk of {folder}, "
            f"{min_free_bytes / 1e6:.0f} MB are wanted (--min-free)"
        )


@contextlib.contextmanager
def _rotated_by_signal(writer: FileWriter) -> Iterator[None]:
    with handled_by(lambda *_: writer.rotate(), signal.SIGUSR1):
        yield
