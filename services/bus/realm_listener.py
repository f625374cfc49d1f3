"""Messages of a realm for displays, which must never delay a publisher.

If messages arrive too quickly the oldest are dropped, and missing ones are not requested. A stale
connection is replaced.
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
from schemas.topics import Key, parse_key, selector, topic
from services.bus.access_control import read_by
from services.bus.credentials import check_credentials
from services.bus.liveness import LivenessProbe, StaleConnectionError
from services.bus.presence import Presence
from services.bus.session import checked_realm, wait_for_router
from services.bus.subscription import RawSample, SeenSequences, subscribe_latest

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
_MAX_AT_ONCE: Final = 5_000
"""Largest number of messages of one stream before the others have their turn."""
_MAX_SEEN: Final = 10_000
"""Largest number of streams and boots with remembered sequences; beyond, all are forgotten."""
_MAX_NAMED: Final = 100
"""Largest number of trucks of other realms, more than anyone reads."""
_TOKENS_WAITING: Final = 1_000


class BusMessage(NamedTuple):
    """A message of the topic table with its identity; a truck's payload is not checked."""

    key: Key
    identity: Identity
    payload: bytes


class OtherRealms:
    """The trucks of this realm and of others, to detect the wrong realm."""

    def __init__(self, session: zenoh.Session, realm: str) -> None:
        self.realm = realm
        # A truck has a token while it drives; a replayed one has none, but publishes its info.
        self._named = subscribe_latest(session, selector(None, "vehicle", "info"), _OTHERS_WAITING)
        self._tokens = session.liveliness().declare_subscriber(
            selector(None, "vehicle", "alive"), handlers.RingChannel(_TOKENS_WAITING), history=True
        )
        self.alive: set[str] = set()
        """The trucks of this realm that are there now."""
        self.trucks: dict[str, set[str]] = {}
        """Other realms and the trucks active in them."""

    def look(self) -> None:
        """Process the messages since the last call."""
        while (token := self._tokens.try_recv()) is not None:
            self._note(str(token.key_expr), is_there=token.kind == zenoh.SampleKind.PUT)
        for _ in range(_OTHERS_WAITING):
            sample = next(self._named)
            if sample is None:
                return
            self._note(sample.key_text, is_there=None)

    def line(self) -> str | None:
        """Return a hint to trucks in other realms if this one is silent; None without any."""
        return other_realms_hint(self.realm, self.trucks)

    def close(self) -> None:
        """Stop listening."""
        self._named.close()  # type: ignore[attr-defined]
        self._tokens.undeclare()  # type: ignore[no-untyped-call]

    def _note(self, key_text: str, *, is_there: bool | None) -> None:
        """Note that a truck has come (True), gone (False) or published its info (None)."""
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
        elif sum(map(len, self.trucks.values())) < _MAX_NAMED:
            self.trucks.setdefault(key.realm, set()).add(key.identifier)


class RealmListener:
    """A listener to one realm that also notices trucks in others.

    `past_s` is the duration of past measurements to receive, as far as trucks keep them; of other
    messages come those that publishers keep. `reconnect` returns a session to replace a stale one,
    or None to stop listening.
    """

    def __init__(
        self,
        session: zenoh.Session,
        realm: str,
        *,
        past_s: float = 0.0,
        reconnect: Callable[[], zenoh.Session | None] = lambda: None,
    ) -> None:
        """Listen; raise InputError if the realm is invalid."""
        self.realm = checked_realm(realm)
        self._past_s = past_s
        self._reconnect = reconnect
        self._seen = SeenSequences()
        self._heard_s = time.monotonic()
        self._is_open = False
        self._begin(session, past_s)

    def _begin(self, session: zenoh.Session, past_s: float) -> None:
        self._streams = [
            subscribe_latest(
                session,
                selector(self.realm, "vehicle", stream),
                _SIGNALS_WAITING,
                _history_depth(stream, past_s),
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
        self._elsewhere = OtherRealms(session, self.realm)
        self._presence = Presence(session, self.realm)
        tokens = selector(self.realm, "vehicle", "alive")
        self._hearing = LivenessProbe(session, tokens, self._elsewhere.alive)
        self._is_open = True

    @property
    def alive(self) -> set[str]:
        """The trucks of this realm that are present now."""
        return self._elsewhere.alive

    @property
    def elsewhere(self) -> dict[str, set[str]]:
        """Other realms and the trucks in them."""
        return self._elsewhere.trucks

    @property
    def lost_s(self) -> float | None:
        """Steady time in s at which the connection was lost; None while it stands."""
        return self._presence.lost_s

    @property
    def gone_s(self) -> dict[str, float]:
        """Services of this realm that have left, each with the steady time in s."""
        return self._presence.gone_s

    def heard(self) -> Iterator[BusMessage]:
        """Yield the messages since the last call, each once; return when there are none."""
        if not self._is_open:
            return
        self._elsewhere.look()
        self._presence.look(time.monotonic())
        is_silent = True
        for stream in self._streams:
            for _ in range(_MAX_AT_ONCE):
                received = next(stream)
                if received is None:
                    break
                is_silent = False
                one = self._new(received)
                if one is not None:
                    yield one
        self._replace_stale(is_silent=is_silent)

    def _replace_stale(self, *, is_silent: bool) -> None:
        """Connect again if the connection is stale."""
        now_s = time.monotonic()
        if not is_silent:
            self._heard_s = now_s
            self._hearing.heard(now_s)
            return
        try:
            self._hearing.poll(now_s)
        except StaleConnectionError as error:
            _log.warning("%s; connecting again", error)
            self.close()
            session = self._reconnect()
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
        self._presence.close()

    def _new(self, received: RawSample) -> BusMessage | None:
        """Return a message of the table that has not been received before, else None."""
        try:
            key, identity = received.key(), received.identity()
            if key.owner == "bridge":
                # A message mangled by a cut connection must not replace the good copy that follows.
                _OF_BRIDGES[key.stream].FromString(received.payload)
        except (ValueError, DecodeError):
            return None  # the logger counts and reports refused messages
        if len(self._seen.streams) > _MAX_SEEN:
            self._seen = SeenSequences()
        return (
            BusMessage(key, identity, received.payload) if self._seen.add(key, identity) else None
        )


@contextlib.contextmanager
def open_listener(
    endpoint: str,
    tls: Path | None,
    realm: str,
    is_over: Callable[[], bool],
    *,
    past_s: float = 0.0,
) -> Iterator[RealmListener | None]:
    """Yield a listener once a router answers; None if `is_over` before.

    Raise InputError for a bad realm, endpoint or credentials.
    """
    checked_realm(realm)
    with contextlib.ExitStack() as open_now:

        def connect() -> zenoh.Session | None:
            open_now.close()
            session = wait_for_router(endpoint, tls, is_over)
            return None if session is None else open_now.enter_context(session)

        session = connect()
        if session is None:
            yield None
            return
        heard = RealmListener(session, realm, past_s=past_s, reconnect=connect)
        try:
            yield heard
        finally:
            heard.close()


def sees_trucks(tls: Path | None, realm: str) -> bool:
    """Return whether credentials permit to read trucks' data; InputError for bad ones."""
    if tls is None:
        return True
    wanted = zenoh.KeyExpr(selector(realm, "vehicle", _SIGNALS[0]))
    return any(zenoh.KeyExpr(keys).intersects(wanted) for keys in read_by(check_credentials(tls)))


def other_realms_hint(realm: str, elsewhere: dict[str, set[str]]) -> str | None:
    """Return a hint to trucks in other realms, for a silent one; None without any."""
    if not elsewhere:
        return None
    where = [
        f"{', '.join(sorted(trucks)[:3])}{' …' if len(trucks) > 3 else ''} in {other}"
        for other, trucks in sorted(elsewhere.items())[:3]
    ]
    first = min(elsewhere)
    return f"nothing in realm {realm}, but {' and '.join(where)}; use --realm {first}"


def _history_depth(stream: str, past_s: float) -> int:
    """Return the number of messages of a stream that cover `past_s`; at least one."""
    row = topic("vehicle", stream)
    return max(1, min(row.cache, math.ceil(past_s * (row.nominal_rate_hz or 0.0))))
