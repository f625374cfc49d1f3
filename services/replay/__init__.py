"""Publishes recordings again, byte for byte, in a realm of their own."""

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from schemas.signals import Identity
from schemas.topics import Key, check_realm, parse_key, topic
from services.bus.credentials import check_speaks_for
from services.bus.delivery import Delivery
from services.bus.playback import check_speed, confirm, play, settle, stopped_by_signals
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.common.errors import FailureError, InputError
from services.recordings.recording import Message, check_message, read_info, read_messages

__all__ = ["run"]

_log = logging.getLogger(__name__)
CONNECT_TIMEOUT_S = 10.0
"""A router that was started a moment before is there by then."""
SUBSCRIBER_TIMEOUT_S = 10.0
"""A replay that nobody hears is of no use: it waits longer than a truck does."""


def run(
    *,
    recordings: list[Path],
    endpoint: str,
    speed: float,
    name: str,
    connect_timeout_s: float | None = CONNECT_TIMEOUT_S,
    subscriber_timeout_s: float = SUBSCRIBER_TIMEOUT_S,
    tls: Path | None = None,
) -> int:
    """Publish what recordings hold in the realm `replay-{name}`, one after the other; return 0.

    Payloads and identities are the recorded ones; the spacing is that of the recorded log times
    divided by `speed` (0: as fast as possible). A recording that holds bridge results and events
    has these published again too. Returns when a logger has everything on disk, or, where there
    is no logger, when subscribers have had the time to fetch what they missed; the same
    recording replayed twice under one name is taken for duplicates by a logger that saw both.

    `tls` is a folder of credentials, see `open_session`.

    InputError: no such file, not a recording, a message that no logger would take, a name that is
    no identifier. FailureError: nobody
    answers at the endpoint within `connect_timeout_s` (None: wait for ever), nobody subscribes
    within `subscriber_timeout_s`, or the logger did not confirm everything.
    """
    check_speed(speed)
    try:
        realm = check_realm(f"replay-{name}")
    except ValueError as error:
        raise InputError(f"name {name!r}: {error}") from None
    check_speaks_for(tls, "replay")
    keys = _keys(recordings)
    with (
        stopped_by_signals() as stop,
        open_session(connect=endpoint, timeout_s=connect_timeout_s, tls=tls) as session,
    ):
        publisher = Publisher(session, realm)
        delivery = Delivery(session, realm)
        try:
            if not settle(publisher, keys, subscriber_timeout_s):
                raise FailureError(
                    f"nobody subscribes to realm {realm} at {endpoint}; start "
                    f"`driveby logger --realm {realm}` or another subscriber of "
                    f"driveby/v1/{realm}/** first"
                )

            def put(message: Message) -> None:
                _, owner, identifier, stream = message.key
                identity = Identity(message.boot_id, message.sequence)
                publisher.put(owner, identifier, stream, message.payload, identity)
                delivery.sent(Key(realm, owner, identifier, stream), identity)

            sent = play(_all(recordings), put, delivery, speed=speed, stop=stop)
            confirm(delivery, sent)
            _log.info("%d messages published in realm %s", sent, realm)
        finally:
            delivery.close()
            publisher.close()
    return 0


def _keys(recordings: list[Path]) -> list[Key]:
    """Return the keys in all recordings, in the order of their first message.

    Every message is looked at before anybody is connected to: what no logger would take could not
    be confirmed, and the logger is not to blame.
    """
    if not recordings:
        raise InputError("no recording: give one or more .mcap files")
    keys: dict[Key, None] = {}
    for path in recordings:
        info = read_info(path, partial(check_message, path))
        if not info.messages:
            raise InputError(f"{path}: holds no driveby message; a recording is expected")
        if info.truncated or info.damaged_chunks:
            _log.warning("%s: damaged, only its whole chunks are replayed", path)
        keys.update((parse_key(name), None) for name in info.messages)
    return [name for name in keys if topic(name.owner, name.stream).logged]


def _all(recordings: list[Path]) -> Iterator[Message]:
    for path in recordings:
        for message in read_messages(path):
            if topic(message.key.owner, message.key.stream).logged:
                yield message
