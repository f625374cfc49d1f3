"""Publication of recordings, byte for byte, in a realm of their own."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import NamedTuple

from schemas.signals import Identity
from schemas.topics import Key, Message, check_realm
from services.bus.credentials import check_speaks_for
from services.bus.delivery import DeliveryTracker
from services.bus.playback import (
    apply_backpressure,
    check_speed,
    confirm,
    declare_and_wait,
    stopped_by_signals,
)
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.common.errors import FailureError, InputError
from services.common.naming import count_of
from services.replay.choice import selection_of
from services.replay.drive import ReplayDrive, open_drive, warn_of_silence
from services.replay.player import Command, Controls, PlaybackResult, PlaybackSettings, play
from services.replay.settings import ReplaySettings

_log = logging.getLogger(__name__)
CONNECT_TIMEOUT_S = 10.0
"""Timeout for a router that was started a moment before."""
SUBSCRIBER_TIMEOUT_S = 10.0
"""Timeout for a subscriber, longer than a truck's, because a replay without one is useless."""

Display = Callable[[str, ReplayDrive, threading.Event], AbstractContextManager[Controls]]
"""Display of a drive in a realm with commands; QUIT is one when the event is set."""


class ReplayStatistics(NamedTuple):
    """Statistics of published messages."""

    realm: str
    by_stream: dict[str, int]
    trucks: tuple[str, ...]
    """Trucks under their new names."""
    rounds: int
    drive_s: float
    """Published duration of the drive, all rounds together."""
    took_s: float
    jumped_over: int
    """Number of messages skipped by jumps to a crossing."""
    skipped_s: float
    """Silence of the drive that was skipped."""
    is_confirmed: bool
    """Whether a logger confirmed the messages."""

    @property
    def messages(self) -> int:
        """Number of messages of all streams."""
        return sum(self.by_stream.values())


def run(
    asked: ReplaySettings,
    *,
    display: Display | None = None,
    report: Callable[[ReplayStatistics], None] = lambda statistics: None,
    connect_timeout_s: float | None = CONNECT_TIMEOUT_S,
    subscriber_timeout_s: float = SUBSCRIBER_TIMEOUT_S,
) -> int:
    """Publish recordings in the realm `replay-{name}` as one drive; return 0.

    Payloads and identities are the recorded ones; the spacing is that of the recorded log times
    divided by `speed` (0: as fast as possible). Recorded bridge results and events are published
    too. Return when a logger has everything on disk or, without a logger, when subscribers have had
    the time to fetch missing messages. A logger that saw the same recording twice under one name,
    or in a `loop`, treats the second as duplicates. `display` shows the position and takes
    commands.

    Raise InputError for a missing file, one that is not a recording, a message that no logger would
    accept, an empty selection, and a name that is not an identifier or that of the recorded realm.
    Raise FailureError if the endpoint does not answer within `connect_timeout_s` (None: wait for
    ever), no subscriber appears within `subscriber_timeout_s`, or the logger did not confirm
    everything.
    """
    realm, drive, course = _prepared(asked)
    with (
        stopped_by_signals() as stop,
        open_session(connect=asked.address, timeout_s=connect_timeout_s, tls=asked.tls) as session,
    ):
        publisher = Publisher(session, realm)
        delivery = DeliveryTracker(session, realm)
        try:
            _wait_for_subscriber(drive, publisher, asked.address, subscriber_timeout_s)
            with (display or _headless_controls)(realm, drive, stop) as controls:
                began_s = time.monotonic()
                played = _play_rounds(drive, publisher, delivery, course, controls, loop=asked.loop)
                took_s = time.monotonic() - began_s
            confirm(delivery, sum(played[0].by_stream.values()))
            statistics = _statistics(realm, drive, played, took_s, delivery)
            _log.info("%s published in realm %s", count_of(statistics.messages, "message"), realm)
            report(statistics)
        finally:
            delivery.close()
            publisher.close()
    return 0


def _prepared(asked: ReplaySettings) -> tuple[str, ReplayDrive, PlaybackSettings]:
    """Check everything before connecting; return the realm, the drive and how it is played."""
    name = asked.realm_name
    choice = selection_of(asked)
    check_speed(asked.speed)
    try:
        realm = check_realm(f"replay-{name}")
    except ValueError as error:
        raise InputError(f"name {name!r}: {error}") from None
    check_speaks_for(asked.tls, "replay")
    drive = open_drive(asked.recordings, realm, choice, asked.site)
    if asked.speed > 0.0 and not asked.skip_gaps:
        warn_of_silence(drive)
    course = PlaybackSettings(asked.speed, asked.skip_gaps, asked.paused, drive.crossings_ns)
    return realm, drive, course


def _wait_for_subscriber(
    drive: ReplayDrive, publisher: Publisher, address: str, timeout_s: float
) -> None:
    keys = [where._replace(identifier=named) for where, named in drive.names.items()]
    if not declare_and_wait(publisher, keys, timeout_s):
        raise FailureError(
            f"no subscriber to realm {publisher.realm} at {address}; start "
            f"`driveby logger --realm {publisher.realm}` or another subscriber of "
            f"driveby/v1/{publisher.realm}/** first"
        )


class _Round(NamedTuple):
    played: PlaybackResult
    by_stream: Counter[str]


def _play_rounds(
    drive: ReplayDrive,
    publisher: Publisher,
    delivery: DeliveryTracker,
    course: PlaybackSettings,
    controls: Controls,
    *,
    loop: bool,
) -> list[_Round]:
    rounds: list[_Round] = []
    while not rounds or (loop and not rounds[-1].played.has_quit):
        sent: Counter[str] = Counter()

        def put(message: Message, sent: Counter[str] = sent) -> None:
            _, owner, _, stream = message.key
            identifier = drive.names[message.key]
            identity = Identity(message.boot_id, message.sequence)
            publisher.put(owner, identifier, stream, message.payload, identity)
            if not rounds:  # a logger counts no message twice
                delivery.sent(Key(publisher.realm, owner, identifier, stream), identity)
            sent[stream] += 1
            apply_backpressure(delivery, sent.total())

        rounds.append(_Round(play(drive.messages(), put, course, controls), sent))
        course = rounds[-1].played.course
    return rounds


def _statistics(
    realm: str, drive: ReplayDrive, rounds: list[_Round], took_s: float, delivery: DeliveryTracker
) -> ReplayStatistics:
    by_stream: Counter[str] = Counter()
    for one in rounds:
        by_stream.update(one.by_stream)
    trucks = {named for where, named in drive.names.items() if where.owner == "vehicle"}
    return ReplayStatistics(
        realm,
        dict(sorted(by_stream.items())),
        tuple(sorted(trucks)),
        len(rounds),
        sum(one.played.covered_ns for one in rounds) * 1e-9,
        took_s,
        sum(one.played.jumped_over for one in rounds),
        sum(one.played.skipped_ns for one in rounds) * 1e-9,
        delivery.has_logger,
    )


@contextmanager
def _headless_controls(realm: str, drive: ReplayDrive, stop: threading.Event) -> Iterator[Controls]:
    """Yield controls without a display, which only a signal ends."""
    yield Controls(lambda s: Command.QUIT if stop.wait(s) else None, lambda status: None)
