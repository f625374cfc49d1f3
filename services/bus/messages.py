"""Messages of the bus, decoded, for subscribers outside this program (docs/programmer.md)."""

import logging
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Final

import zenoh
from google.protobuf.message import Message

from schemas.messages import decode
from schemas.topics import PREFIX, Key, topic
from services.bus.access_control import read_by
from services.bus.credentials import check_credentials, unlisted_hint
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.common.errors import InputError

_log = logging.getLogger(__name__)
_CONNECT_S: Final = 10.0
"""Longest wait for the router."""
_POLL_S: Final = 0.2
_SILENCE_S: Final = 10.0
"""Silence at the start after which a line names the likely reasons."""


def subscribe(
    endpoint: str, key_expression: str = f"{PREFIX}/**", *, tls: Path | None = None
) -> Generator[tuple[Key, Message], None, None]:
    """Yield keys and decoded messages for ever, first the earlier ones that publishers keep.

    `tls` is a folder of `driveby certs`. A message may come twice after a lost connection.
    Malformed messages, which a logger counts and reports, are left out. After 10 s without any
    message a warning names the likely reasons.

    Raise InputError for a malformed endpoint or expression, bad credentials, and an expression
    wider than their rights, to which a router would send nothing; FailureError if no router
    answers within 10 s.
    """
    _check_expression(key_expression, tls)
    with (
        open_session(connect=endpoint, timeout_s=_CONNECT_S, tls=tls) as session,
        Subscription(session, key_expression) as subscription,
    ):
        began_s: float | None = time.monotonic()
        while True:
            received = subscription.receive(_POLL_S)
            if received is not None:
                began_s = None
                yield from _decoded(received)
            elif began_s is not None and time.monotonic() >= began_s + _SILENCE_S:
                began_s = None
                _log.warning("%s", _why_silent(endpoint, key_expression, tls))


def _check_expression(key_expression: str, tls: Path | None) -> None:
    try:
        wanted = zenoh.KeyExpr(key_expression)
    except zenoh.ZError:
        raise InputError(
            f"key expression {key_expression!r}: is malformed; for example {PREFIX}/*/bridge/**"
        ) from None
    if tls is None:
        return
    subject = check_credentials(tls)
    readable = read_by(subject)
    if not any(zenoh.KeyExpr(one).includes(wanted) for one in readable):
        raise InputError(
            f"key expression {key_expression!r}: is wider than the rights of {subject}, so that "
            f"nothing would be received; a part of one of {', '.join(readable)} is expected"
        )


def _decoded(received: RawSample) -> Iterator[tuple[Key, Message]]:
    try:
        key = received.key()
        message = decode(topic(key.owner, key.stream).message, received.payload)
    except ValueError as error:
        _log.debug("%s: %s", received.key_text[:200], error)
        return
    yield key, message


def _why_silent(endpoint: str, key_expression: str, tls: Path | None) -> str:
    nothing = f"nothing received for {_SILENCE_S:g} s on {key_expression} at {endpoint}"
    if tls is None:
        return f"{nothing}: nothing is published there"
    return f"{nothing}: nothing is published there, or {unlisted_hint(tls)}"
