"""Publishes recordings again, byte for byte, in a realm of their own."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import NamedTuple

from schemas.signals import Identity
from schemas.topics import Key, check_realm
from services.bus.credentials import check_speaks_for
from services.bus.delivery import Delivery
from services.bus.playback import check_speed, confirm, hold_back, settle, stopped_by_signals
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.common.errors import FailureError, InputError
from services.recordings.recording import Message
from services.replay.choice import EVERYTHING, Choice
from services.replay.drive import Drive, open_drive, warn_of_silence
from services.replay.player import Command, Controls, Course, Played, play

__all__ = ["Statistics", "run"]

_log = logging.getLogger(__name__)
CONNECT_TIMEOUT_S = 10.0
"""A router that was started a moment before is there by then."""
SUBSCRIBER_TIMEOUT_S = 10.0
"""A replay that nobody hears is of no use: it waits longer than a truck does."""

Display = Callable[[str, Drive, threading.Event], AbstractContextManager[Controls]]
"""Shows a drive in a realm, and takes commands; QUIT is one when the event is set."""


class Statistics(NamedTuple):
    """What was published."""

    realm: str
    by_stream: dict[str, int]
    trucks: tuple[str, ...]
    """Under the names that they were given."""
    rounds: int
    drive_s: float
    """How much of the drive was published, all rounds together."""
    took_s: float
    jumped_over: int
    """Messages left out by jumps to a crossing."""
    skipped_s: float
    """Silence of the drive that was not waited for."""
    is_confirmed: bool
    """By a logger; without one nobody confirms anything."""

    @property
    def messages(self) -> int:
        """How many, of all streams."""
        return sum(self.by_stream.values())


def run(
    *,
    recordings: list[Path],
    endpoint: str,
    speed: float,
    name: str,
    choice: Choice = EVERYTHING,
    skip_gaps: bool = False,
    loop: bool = False,
    start_paused: bool = False,
    site: Path | None = None,
    display: Display | None = None,
    report: Callable[[Statistics], None] = lambda statistics: None,
    connect_timeout_s: float | None = CONNECT_TIMEOUT_S,
    subscriber_timeout_s: float = SUBSCRIBER_TIMEOUT_S,
    tls: Path | None = None,
) -> int:
    """Publish what recordings hold in the realm `replay-{name}`, as one drive; return 0.

    Payloads and identities are the recorded ones; the spacing is that of the recorded log times
    divided by `speed` (0: as fast as possible). A recording that holds bridge results and events
    has these published again too. Returns when a logger has everything on disk, or, where there
    is no logger, when subscribers have had the time to fetch what they missed. The same recording
    replayed twice under one name, or in a `loop`, is taken for duplicates by a logger that saw
    both.

    `recordings` may be folders. `display` shows where it is and takes commands; `site` tells where
    bridges are if the recordings do not; `tls` is a folder of credentials, see `open_session`.

    InputError: no such file, not a recording, a message that no logger would take, a choice that
    leaves nothing, a name that is no identifier or that of the realm that was recorded.
    FailureError: nobody answers at the endpoint within `connect_timeout_s` (None: wait for ever),
    nobody subscribes within `subscriber_timeout_s`, or the logger did not confirm everything.
    """
    check_speed(speed)
    try:
        realm = check_realm(f"replay-{name}")
    except ValueError as error:
        raise InputError(f"name {name!r}: {error}") from None
    check_speaks_for(tls, "replay")
    drive = open_drive(recordings, realm, choice, site)
    if speed > 0.0 and not skip_gaps:
        warn_of_silence(drive)
    course = Course(speed, skip_gaps, start_paused, drive.crossings_ns)
    with (
        stopped_by_signals() as stop,
        open_session(connect=endpoint, timeout_s=connect_timeout_s, tls=tls) as session,
    ):
        publisher = Publisher(session, realm)
        delivery = Delivery(session, realm)
        try:
            keys = [where._replace(identifier=named) for where, named in drive.names.items()]
            if not settle(publisher, keys, subscriber_timeout_s):
                raise FailureError(
                    f"nobody subscribes to realm {realm} at {endpoint}; start "
                    f"`driveby logger --realm {realm}` or another subscriber of "
                    f"driveby/v1/{realm}/** first"
                )
            with (display or _unseen)(realm, drive, stop) as controls:
                began_s = time.monotonic()
                played = _play_rounds(drive, publisher, delivery, course, controls, loop=loop)
                took_s = time.monotonic() - began_s
            confirm(delivery, sum(played[0].by_stream.values()))
            statistics = _statistics(realm, drive, played, took_s, delivery)
            _log.info("%d messages published in realm %s", statistics.messages, realm)
            report(statistics)
        finally:
            delivery.close()
            publisher.close()
    return 0


class _Round(NamedTuple):
    played: Played
    by_stream: Counter[str]


def _play_rounds(
    drive: Drive,
    publisher: Publisher,
    delivery: Delivery,
    course: Course,
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
            hold_back(delivery, sent.total())

        rounds.append(_Round(play(drive.messages(), put, course, controls), sent))
        course = rounds[-1].played.course
    return rounds


def _statistics(
    realm: str, drive: Drive, rounds: list[_Round], took_s: float, delivery: Delivery
) -> Statistics:
    by_stream: Counter[str] = Counter()
    for one in rounds:
        by_stream.update(one.by_stream)
    trucks = {named for where, named in drive.names.items() if where.owner == "vehicle"}
    return Statistics(
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
def _unseen(realm: str, drive: Drive, stop: threading.Event) -> Iterator[Controls]:
    """Nobody looks: only a signal ends it."""
    yield Controls(lambda s: Command.QUIT if stop.wait(s) else None, lambda status: None)
