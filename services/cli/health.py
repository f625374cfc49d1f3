"""`driveby health`: whether a service does its work, asked over the bus that it works on.

The answer is the service's own latest `health`, which its main loop says every minute and which its
session keeps for who comes later: to have it there must be a router that answers, certificates that
it takes, and a service that connects, is let through and has not stopped.
"""

import time
from pathlib import Path

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.topics import check_identifier, check_realm, key
from services.bus.session import open_session
from services.bus.subscription import Subscription
from services.common.errors import FailureError, InputError

OLDEST_S = 150.0
"""Two and a half times the period."""
_ANSWER_S = 5.0
"""A service that is well answers from memory, at once but for the network."""


def health_command(
    *, service: str, endpoint: str, tls: Path | None, realm: str, patience_s: float = _ANSWER_S
) -> str:
    """Return a line that says how a service is, with what it says of itself, if anything.

    InputError: a bad realm or name. FailureError: no router answers, the service says nothing, has
    said nothing for `OLDEST_S`, or says itself that it is not well.
    """
    try:
        where = key(check_realm(realm), "service", check_identifier(service), "health")
    except ValueError as error:
        raise InputError(str(error)) from None
    with (
        open_session(connect=endpoint, timeout_s=patience_s, tls=tls) as session,
        Subscription(session, where) as subscription,
    ):
        latest = _latest(subscription, patience_s)
    if latest is None:
        raise FailureError(f"{service} in realm {realm} says nothing at {endpoint}")
    age_s = time.time() - latest.time_ns * 1e-9
    if age_s > OLDEST_S:
        raise FailureError(f"{service} in realm {realm} has said nothing for {age_s:.0f} s")
    if not latest.ok:
        raise FailureError(
            f"{service} in realm {realm} is not well: {latest.note or 'see its log'}"
        )
    note = f"; {latest.note}" if latest.note else ""
    return f"{service} in realm {realm} is well, {max(age_s, 0.0):.0f} s ago{note}"


def _latest(subscription: Subscription, patience_s: float) -> pb.Health | None:
    """The first that comes, which is the last that was said; None if none comes in time."""
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
