"""The command `driveby health`: query the health of a service over its bus.

The answer is the service's own latest `health`, which its main loop publishes every minute and its
session keeps for later subscribers. It requires a router that answers, certificates that it
accepts, and a service that connects, is admitted and has not stopped.
"""

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path

import zenoh

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.topics import PREFIX, check_identifier, check_realm, key
from services.bus.access_control import read_by
from services.bus.credentials import check_credentials, unlisted_hint
from services.bus.presence import sessions_publishing
from services.bus.session import open_session
from services.bus.subscription import Subscription
from services.common.errors import FailureError, InputError

OLDEST_S = 150.0
"""Largest age of a healthy service's message in s, two and a half periods."""
_AHEAD_S = 2.0
"""Time in s by which a message lies in the future when a clock is wrong."""
_ANSWER_S = 5.0
"""Longest wait for the answer in s; a healthy service answers from memory."""
_ELSEWHERE_S = 1.0
"""Duration in s of the search for a silent service in other realms."""
_MAX_REALMS = 3


def health_command(
    *, service: str, endpoint: str, tls: Path | None, realm: str, patience_s: float = _ANSWER_S
) -> str:
    """Return a line on the health of a service, with its own note, if any.

    InputError: a bad realm or name. FailureError: no router answers, the service sends nothing, has
    sent nothing for `OLDEST_S`, has ended, or declares itself unhealthy.
    """
    try:
        where = key(check_realm(realm), "service", check_identifier(service), "health")
    except ValueError as error:
        raise InputError(str(error)) from None
    with (
        open_session(
            connect=endpoint, timeout_s=patience_s, tls=tls, handshake_s=patience_s
        ) as session,
        Subscription(session, where) as subscription,
    ):
        latest = _latest(subscription, patience_s)
        elsewhere = realms_of(session, service) if latest is None else []
        senders = sessions_publishing(session, where, _ELSEWHERE_S) if latest is not None else 0
    if latest is None:
        hint = realms_hint(elsewhere) or silence_hint(where, tls)
        raise FailureError(f"{service} in realm {realm} sends nothing at {endpoint}; {hint}")
    if latest.ended:
        raise FailureError(f"{service} in realm {realm} has ended")
    age_s = time.time() - latest.time_ns * 1e-9
    if age_s > OLDEST_S:
        raise FailureError(f"{service} in realm {realm} has sent nothing for {age_s:.0f} s")
    if not latest.ok:
        raise FailureError(
            f"{service} in realm {realm} is not well: {latest.note or 'see its log'}"
        )
    notes = [latest.note] if latest.note else []
    if senders > 1:
        notes.append(f"one of {senders} services of this name; give each one another --id")
    if age_s < -_AHEAD_S:
        notes.append(f"its clock is {-age_s:.0f} s ahead of this machine's")
    well = f"{service} in realm {realm} is well (health sent {max(age_s, 0.0):.0f} s ago)"
    return "; ".join([well, *notes])


def silence_hint(where: str, tls: Path | None) -> str:
    """Return why no health arrives at a key: the likeliest cause first."""
    hint = (
        "it was not started or has ended, or it is in another realm (--realm NAME; live for a "
        "logger of several realms)"
    )
    if tls is None:
        return hint
    subject, wanted = check_credentials(tls), zenoh.KeyExpr(where)
    if not any(zenoh.KeyExpr(keys).intersects(wanted) for keys in read_by(subject)):
        return f"{subject} may not read it; use the credentials of a viewer"
    return f"{hint}, or {unlisted_hint(tls)}"


def realms_hint(realms: Sequence[str]) -> str:
    """Return in which realms a service answers; empty for none."""
    return f"it answers with --realm {' or '.join(realms)}" if realms else ""


def realms_of(session: zenoh.Session, service: str | None) -> list[str]:
    """Return the realms in which a service, or any (None), answers, at most `_MAX_REALMS`."""
    found: set[str] = set()
    with Subscription(session, f"{PREFIX}/*/service/{service or '*'}/health") as subscription:
        deadline_s = time.monotonic() + _ELSEWHERE_S
        while (left_s := deadline_s - time.monotonic()) > 0 and len(found) < _MAX_REALMS:
            received = subscription.receive(left_s)
            if received is not None:
                with contextlib.suppress(ValueError):  # not one of our keys
                    found.add(received.key().realm)
    return sorted(found)


def _latest(subscription: Subscription, patience_s: float) -> pb.Health | None:
    """Return the first message received, the latest published one; None if none arrives in time."""
    deadline_s = time.monotonic() + patience_s
    while time.monotonic() < deadline_s:
        received = subscription.receive(0.1)
        if received is None:
            continue
        try:
            message = decode("driveby.v1.Health", received.payload)
        except ValueError:
            continue
        if isinstance(message, pb.Health):
            return message
    return None
