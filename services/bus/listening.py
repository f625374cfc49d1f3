"""What travels in a realm, for who only looks: a display must never hold anybody up.

What comes too quickly is dropped, the oldest first, and nothing that was missed is asked for. A
connection that stands and brings nothing is made anew.
"""

import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import zenoh
from google.protobuf.message import DecodeError, Message
from zenoh import handlers

from schemas.proto import driveby_pb2 as pb
from schemas.signals import Identity
from schemas.topics import Key, check_realm, parse_key, selector, topic
from services.bus.hearing import DeafError, Hearing
from services.bus.session import connected
from services.bus.subscription import Received, Seen, subscribe_latest
from services.common.errors import InputError

_log = logging.getLogger(__name__)

_SIGNALS: Final = ("accel", "gnss")
_OTHERS: Final = (
    ("vehicle", "info"),
    ("bridge", "crossing"),
    ("bridge", "estimate"),
    ("bridge", "state"),
    ("bridge", "alarm"),
    ("service", "health"),
    ("service", "progress"),
)
_OF_BRIDGES: Final[dict[str, type[Message]]] = {
    "crossing": pb.Crossing,
    "estimate": pb.Estimate,
    "state": pb.BridgeState,
    "alarm": pb.Alarm,
}
_SIGNALS_WAITING: Final = 12_000
_OTHERS_WAITING: Final = 1_000
_MOST_AT_ONCE: Final = 5_000
"""So many of a stream are handed over before the others have their turn."""
_MOST_SEEN: Final = 10_000
"""Streams and boots of which it is remembered what has come; beyond them it begins anew."""
_MOST_NAMED: Final = 100
"""Trucks of other realms: nobody reads more names."""
_TOKENS_WAITING: Final = 1_000


class Heard(NamedTuple):
    """A message of the topic table with its identity; of a truck's the payload is not looked at."""

    key: Key
    identity: Identity
    payload: bytes


class Elsewhere:
    """Which trucks are in a realm and in others: who hears nothing may be in the wrong one."""

    def __init__(self, session: zenoh.Session, realm: str) -> None:
        self.realm = realm
        # A truck has a token while it drives, a replayed one none, but it says what it is.
        self._named = subscribe_latest(session, selector(None, "vehicle", "info"), _OTHERS_WAITING)
        self._tokens = session.liveliness().declare_subscriber(
            selector(None, "vehicle", "alive"), handlers.RingChannel(_TOKENS_WAITING), history=True
        )
        self.alive: set[str] = set()
        """The trucks of this realm that are there now."""
        self.trucks: dict[str, set[str]] = {}
        """Other realms and the trucks that were heard in them."""

    def look(self) -> None:
        """Take in what has come since the last call."""
        while (token := self._tokens.try_recv()) is not None:
            self._note(str(token.key_expr), is_there=token.kind == zenoh.SampleKind.PUT)
        for _ in range(_OTHERS_WAITING):
            said = next(self._named)
            if said is None:
                return
            self._note(said.key_text, is_there=None)

    def line(self) -> str | None:
        """Who drives in other realms, for who hears nothing in this one; None if nobody does."""
        return elsewhere_line(self.realm, self.trucks)

    def close(self) -> None:
        """Look no more."""
        self._named.close()  # type: ignore[attr-defined]
        self._tokens.undeclare()  # type: ignore[no-untyped-call]

    def _note(self, key_text: str, *, is_there: bool | None) -> None:
        """A truck has come (True), gone (False) or said what it is (None)."""
        try:
            key = parse_key(key_text)
        except ValueError:
            return
        if key.realm == self.realm:
            if is_there is True and len(self.alive) < _SIGNALS_WAITING:
                self.alive.add(key.identifier)
            elif is_there is False:
                self.alive.discard(key.identifier)
            return
        if is_there is False:
            trucks = self.trucks.get(key.realm, set())
            trucks.discard(key.identifier)
            if not trucks:
                self.trucks.pop(key.realm, None)
        elif sum(map(len, self.trucks.values())) < _MOST_NAMED:
            self.trucks.setdefault(key.realm, set()).add(key.identifier)


class Listening:
    """Hears one realm, and which trucks drive in others.

    `past_s` is how much of what trucks measured before is wanted, as far as they keep it; of all
    else comes what its publishers keep. `again` gives another session in place of one that brings
    nothing any more, or None where there shall be none; then nothing more is heard.
    """

    def __init__(
        self,
        session: zenoh.Session,
        realm: str,
        *,
        past_s: float = 0.0,
        again: Callable[[], zenoh.Session | None] = lambda: None,
    ) -> None:
        """Listen; InputError if that is no realm."""
        self.realm = check_listenable(realm)
        self._past_s = past_s
        self._again = again
        self._seen = Seen()
        self._heard_s = time.monotonic()
        self._is_open = False
        self._begin(session, past_s)

    def _begin(self, session: zenoh.Session, past_s: float) -> None:
        self._streams = [
            subscribe_latest(
                session,
                selector(self.realm, "vehicle", stream),
                _SIGNALS_WAITING,
                _past(stream, past_s),
            )
            for stream in _SIGNALS
        ]
        self._streams += [
            subscribe_latest(
                session,
                selector(self.realm, owner, stream),
                _OTHERS_WAITING,
                topic(owner, stream).cache,
            )
            for owner, stream in _OTHERS
        ]
        self._elsewhere = Elsewhere(session, self.realm)
        tokens = selector(self.realm, "vehicle", "alive")
        self._hearing = Hearing(session, tokens, self._elsewhere.alive)
        self._is_open = True

    @property
    def alive(self) -> set[str]:
        """The trucks of this realm that are there now."""
        return self._elsewhere.alive

    @property
    def elsewhere(self) -> dict[str, set[str]]:
        """Other realms and the trucks that were heard in them."""
        return self._elsewhere.trucks

    def heard(self) -> Iterator[Heard]:
        """Yield what has come since the last call, each message once; return when there is none."""
        if not self._is_open:
            return
        self._elsewhere.look()
        is_silent = True
        for stream in self._streams:
            for _ in range(_MOST_AT_ONCE):
                received = next(stream)
                if received is None:
                    break
                is_silent = False
                one = self._new(received)
                if one is not None:
                    yield one
        self._check_hearing(is_silent=is_silent)

    def _check_hearing(self, *, is_silent: bool) -> None:
        """Connect again if nothing comes through the connection that stands."""
        now_s = time.monotonic()
        if not is_silent:
            self._heard_s = now_s
            self._hearing.heard(now_s)
            return
        try:
            self._hearing.look(now_s)
        except DeafError as error:
            _log.warning("%s; connecting again", error)
            self.close()
            session = self._again()
            if session is not None:
                self._begin(session, self._past_s + time.monotonic() - self._heard_s)

    def close(self) -> None:
        """Stop listening."""
        if not self._is_open:
            return
        self._is_open = False
        for stream in self._streams:
            stream.close()  # type: ignore[attr-defined]
        self._elsewhere.close()

    def _new(self, received: Received) -> Heard | None:
        """The message if it is one of the table and has not come before."""
        try:
            key, identity = received.key(), received.identity()
            if key.owner == "bridge":
                # What a cut connection has mangled must not be taken for the good copy that comes.
                _OF_BRIDGES[key.stream].FromString(received.payload)
        except (ValueError, DecodeError):
            return None  # the logger counts and names what it refuses
        if len(self._seen.streams) > _MOST_SEEN:
            self._seen = Seen()
        return Heard(key, identity, received.payload) if self._seen.add(key, identity) else None


@contextlib.contextmanager
def listening(
    endpoint: str,
    tls: Path | None,
    realm: str,
    is_over: Callable[[], bool],
    *,
    past_s: float = 0.0,
) -> Iterator[Listening | None]:
    """Hear a realm as soon as a router answers; None if it is over before one does.

    InputError: a bad realm, endpoint or credentials.
    """
    check_listenable(realm)
    with contextlib.ExitStack() as open_now:

        def connect() -> zenoh.Session | None:
            open_now.close()
            session = connected(endpoint, tls, is_over)
            return None if session is None else open_now.enter_context(session)

        session = connect()
        if session is None:
            yield None
            return
        heard = Listening(session, realm, past_s=past_s, again=connect)
        try:
            yield heard
        finally:
            heard.close()


def check_listenable(realm: str) -> str:
    """Return a realm; InputError if it is none."""
    try:
        return check_realm(realm)
    except ValueError as error:
        raise InputError(str(error)) from None


def elsewhere_line(realm: str, elsewhere: dict[str, set[str]]) -> str | None:
    """Who drives in other realms, for somebody who hears nothing in his; None if nobody does."""
    if not elsewhere:
        return None
    where = [
        f"{', '.join(sorted(trucks)[:3])}{' …' if len(trucks) > 3 else ''} in {other}"
        for other, trucks in sorted(elsewhere.items())[:3]
    ]
    first = min(elsewhere)
    return f"nothing in realm {realm}, but {' and '.join(where)}: --realm {first}"


def _past(stream: str, past_s: float) -> int:
    """How many messages of a stream cover so many seconds; the last one at least."""
    row = topic("vehicle", stream)
    return max(1, min(row.cache, math.ceil(past_s * (row.nominal_rate_hz or 0.0))))
