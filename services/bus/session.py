"""The bus: Zenoh sessions, publishers that keep what they sent, subscribers that fetch again.

For a service it comes down to

    with open_session(connect=endpoint, timeout_s=10) as session:
        with Subscription(session, selector("live", "vehicle")) as vehicles:
            publisher = Publisher(session, "live")
            while not stop:
                received = vehicles.receive(0.2)      # None after 0.2 s of silence
                if received is not None:
                    ...
                    publisher.put("bridge", bridge, "estimate", estimate.SerializeToString())
            publisher.close()

How nothing is lost. Publishers block instead of dropping, keep their last messages (the topic
table says how many) and announce the number of the last one twice a second. A subscriber asks for
the history of every publisher that it meets and for every number that it misses. That alone loses
a gap now and then when router and subscriber die together, so a thread asks once more for every
gap that has lasted. What comes twice that way is told by its identity; a subscriber
that must not see anything twice uses `Seen`.

How a publisher knows that its messages arrived. A put returns when Zenoh has it, no more. Loggers
publish on `durable` how many messages of each stream and boot are on their disk, after fsync:
`Delivery` waits for that. Where no logger answers, `LINGER_S` leaves subscribers the time for two
announcements and the queries that follow from them.
"""

import contextlib
import ipaddress
import json
import logging
import math
import os
import queue
import re
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh
from zenoh import ext, handlers

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.signals import Identity, decode_identity, encode_identity
from schemas.topics import MAX_KEY_CHARACTERS, TOPICS, Key, key, parse_key, selector, topic
from services.bus.credentials import (
    CONFIGURATION,
    LISTENERS,
    check_credentials,
    link_settings,
)
from services.common.errors import FailureError, InputError
from services.common.files import read_bytes
from services.common.intervals import Intervals

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
DEFAULT_TLS_ENDPOINT = "tls/127.0.0.1:7447"
LINGER_S = 1.5
"""Two heartbeats and the time to answer the queries that they cause."""

_log = logging.getLogger(__name__)
_ENDPOINT = re.compile(r"(tcp|tls|quic|ws|unixsock-stream)/\S+")
_HEARTBEAT_S = 0.5
_IDLE_POLL_S = 0.005
_CONNECT_TRY_MS = 500
_GAP_PATIENCE_S = 0.5
_GAP_TRIES = 3
_GAP_QUERY_TIMEOUT_S = 5.0
_MAX_HOLES_PER_ROUND = 100
_MAX_HOLES_PER_SOURCE = 10_000
_MAX_SOURCES = 10_000
_PATIENCE_WITH_SUBSCRIBER_US = 1_000_000
"""Zenoh's own is 5 s; who is cut off connects again and gets what it missed."""
_QUERIES_WAITING = 100
_RUNTIME = "(rx: (handover: acc), acc: (worker_threads: 2))"
"""Of a router: what comes is read by the threads that wait for it. Zenoh's own pool of receiving
threads has to be woken for every message, which costs more than all that it does with one. There
are two, as new connections wait for them too and one may be held up by a frozen subscriber."""
_SourceName = tuple[str, zenoh.ZenohId, int]
"""A key, and a publisher of Zenoh: session and number in it."""
_DURABLES_WAITING = 100


class Received(NamedTuple):
    """A message as it came from the bus; nothing of it has been checked yet.

    `key_text` may be any key, `attachment` may be missing: see `checked`.
    """

    key_text: str
    payload: bytes
    attachment: bytes | None
    recovered: bool
    """It was missing and has been asked for."""
    spooled: bool = False
    """It came from the truck's own disk: there is no better copy of it."""

    def identity(self) -> Identity:
        """Return (boot_id, sequence); ValueError if the attachment is missing or malformed."""
        return decode_identity(self.attachment)

    def key(self) -> Key:
        """Return the key taken apart; ValueError if it is not in the topic table."""
        return parse_key(self.key_text)


def open_session(
    *,
    connect: str | None = None,
    listen: str | None = None,
    timeout_s: float | None = None,
    tls: Path | None = None,
    insecure: bool = False,
) -> zenoh.Session:
    """Open a session: a client of the router at `connect`, or a router that listens at `listen`.

    A client waits `timeout_s` (None: for ever) for the router and connects again by itself
    whenever the connection is lost. It must be closed, or the process does not end; it is a
    context manager.

    `tls` is a folder of `driveby certs`: both sides prove who they are, nothing but TLS is spoken,
    and a router lets everybody say and hear only what its access control allows. Without it only
    this machine can be listened to, unless `insecure` says that whoever reaches the address may
    say and hear everything.

    A process whose first session is a router's has Zenoh's threads set up for many publishers, by
    the environment variable ZENOH_RUNTIME, unless it is set already.

    InputError for a malformed endpoint, bad credentials, or an address open to strangers;
    FailureError if nobody answers in time or the address cannot be listened at.
    """
    if (connect is None) == (listen is None):
        raise ValueError("either connect or listen")
    endpoint = _check_endpoint(connect or listen or "", tls)
    if listen is not None and tls is None and not insecure and not _is_on_this_machine(listen):
        raise InputError(
            f"{listen} can be reached by other machines, and without --tls FOLDER anybody there "
            "could publish as a truck; say --insecure if that is wanted (see docs/security.md)"
        )
    if listen is not None:
        os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)  # read at a process's first session
    deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
    config = _configuration(endpoint, tls, is_client=connect is not None)
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            _log.debug("zenoh: %s", error)
            if listen is not None:
                raise FailureError(_why_not_listening(endpoint, error)) from None
            # Zenoh would wait by itself, but meanwhile Python hears no signal.
            if time.monotonic() >= deadline:
                raise FailureError(_why_not_connected(endpoint, timeout_s, tls)) from None


def default_endpoint(tls: Path | None) -> str:
    """Return where a logger listens and the others connect unless told otherwise."""
    return DEFAULT_ENDPOINT if tls is None else DEFAULT_TLS_ENDPOINT


def _why_not_connected(endpoint: str, timeout_s: float | None, tls: Path | None) -> str:
    refused = "" if tls is None else ", or the one there refuses or does not prove a certificate"
    within = f" within {timeout_s:g} s" if timeout_s else ""
    return (
        f"no router answers at {endpoint}{within}{refused}; "
        "start `driveby logger` first or give another endpoint"
    )


def _why_not_listening(endpoint: str, error: zenoh.ZError) -> str:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with contextlib.suppress(OSError, ValueError), socket.create_connection((host, int(port)), 1):
        return f"cannot listen at {endpoint}: the address is in use, is another logger running?"
    return f"cannot listen at {endpoint}: {_first_sentence(error).rstrip(':')}"


def _configuration(endpoint: str, tls: Path | None, *, is_client: bool) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "client" if is_client else "router",
        "connect/endpoints": [endpoint] if is_client else [],
        "listen/endpoints": [] if is_client else [endpoint],
        "connect/timeout_ms": _CONNECT_TRY_MS,
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
    }
    if not is_client:
        # A router waits for a subscriber that has stopped reading, and with it wait all others.
        block = "transport/link/tx/queue/congestion_control/block/wait_before_close"
        settings[block] = _PATIENCE_WITH_SUBSCRIBER_US
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    if tls is not None:
        _add_security(config, tls.absolute(), is_client=is_client)
    return config


def _add_security(config: zenoh.Config, tls: Path, *, is_client: bool) -> None:
    subject = check_credentials(tls)
    for name, value in link_settings(tls).items():
        config.insert_json5(f"transport/link/{name}", json.dumps(value))
    if is_client:
        return
    if subject.role not in LISTENERS:
        raise InputError(f"{tls}: is the certificate of {subject}; only a logger's may listen")
    config.insert_json5("access_control", json.dumps(_access_control(tls)))


def _access_control(tls: Path) -> dict[str, Any]:
    """The access control in the configuration of a folder; InputError if it would let all pass."""
    path = tls / CONFIGURATION
    read_bytes(path)  # says what is wrong better than Zenoh
    try:
        access: Any = json.loads(zenoh.Config.from_file(path).get_json("access_control"))
    except zenoh.ZError as error:
        raise InputError(f"{path}: {_first_sentence(error)}") from None
    if not (access["enabled"] and access["default_permission"] == "deny" and access["subjects"]):
        raise InputError(f"{path}: lets everybody do everything; make it with `driveby certs`")
    return dict(access)


class Publisher:
    """Publishes messages of the topic table in one realm, each with its identity.

    A publisher of Zenoh is declared at the first put to a key and kept until `close()`. May be
    used from several threads.
    """

    def __init__(
        self, session: zenoh.Session | None, realm: str, boot_id: int | None = None
    ) -> None:
        """Publish through a session; None: nothing can be put before `connect`."""
        self.realm = realm
        self.boot_id = time.time_ns() if boot_id is None else boot_id
        """The start of this process unless given: higher after every restart."""
        self._opened = session
        self._publishers: dict[str, ext.AdvancedPublisher] = {}
        self._next_sequence: Counter[str] = Counter()
        self._latest: dict[str, tuple[bytes, bytes]] = {}
        self._queryables: list[zenoh.Queryable[Any]] = []
        self._answering: list[threading.Thread] = []
        self._lock = threading.Lock()

    def put(
        self,
        owner: str,
        identifier: str,
        stream: str,
        payload: bytes,
        identity: Identity | None = None,
    ) -> Identity:
        """Publish one message and return its identity.

        Without `identity` it gets this publisher's boot_id and the next sequence of its key,
        beginning at 0. Blocks while the connection is congested. Of a latched topic the last
        message is kept for late subscribers and answers `session.get(key)`.
        ValueError if the key is not in the table or the payload larger than it allows.
        """
        where = key(self.realm, owner, identifier, stream)
        row = topic(owner, stream)
        if not row.message or len(payload) > row.max_bytes:
            raise ValueError(f"{where}: {len(payload)} bytes; at most {row.max_bytes}")
        with self._lock:
            if identity is None:
                identity = Identity(self.boot_id, self._next_sequence[where])
                self._next_sequence[where] += 1
            attachment = encode_identity(*identity)
            publisher = self._declare(where)
            if row.latched:
                self._latest[where] = (payload, attachment)
            # Within the lock, or two threads could send two messages in the wrong order.
            publisher.put(payload, attachment=attachment)
        return identity

    def connect(self, session: zenoh.Session) -> None:
        """Give a publisher that was made without one its session."""
        self._opened = session

    @property
    def _session(self) -> zenoh.Session:
        if self._opened is None:
            raise RuntimeError("the publisher has no session yet")
        return self._opened

    def declare(self, owner: str, identifier: str, stream: str) -> None:
        """Declare the publisher of a key before its first message.

        Subscribers ask a new publisher for its history; doing so before the data flow keeps the
        streams of one truck in step with each other from the first message on.
        """
        with self._lock:
            self._declare(key(self.realm, owner, identifier, stream))

    def wait_for_subscriber(
        self, owner: str, identifier: str, stream: str, timeout_s: float
    ) -> bool:
        """Wait until somebody subscribes to a key; False if nobody did in time."""
        probe = self._session.declare_publisher(key(self.realm, owner, identifier, stream))
        try:
            deadline = time.monotonic() + timeout_s
            while not _matches(probe):
                if time.monotonic() >= deadline:
                    return False
                time.sleep(_IDLE_POLL_S)
            return True
        finally:
            probe.undeclare()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Undeclare all; what was put and not yet fetched is lost (see `Delivery`)."""
        with self._lock:
            for queryable in self._queryables:
                queryable.undeclare()  # type: ignore[no-untyped-call]
            for thread in self._answering:
                thread.join()
            for publisher in self._publishers.values():
                publisher.undeclare()  # type: ignore[no-untyped-call]
            self._queryables.clear()
            self._publishers.clear()

    def _declare(self, where: str) -> ext.AdvancedPublisher:
        publisher = self._publishers.get(where)
        if publisher is None:
            parsed = parse_key(where)
            row = topic(parsed.owner, parsed.stream)
            publisher = self._publishers[where] = _declare_publisher(self._session, where)
            if row.latched:
                self._answer_queries(where)
        return publisher

    def _answer_queries(self, where: str) -> None:
        # A thread of our own: one of Zenoh's that still calls Python while the interpreter ends
        # takes the process down with it.
        queryable = self._session.declare_queryable(
            where, handlers.FifoChannel(_QUERIES_WAITING), complete=True
        )
        thread = threading.Thread(
            target=self._answer, args=(where, queryable.handler), name="answer", daemon=True
        )
        thread.start()
        self._queryables.append(queryable)
        self._answering.append(thread)

    def _answer(self, where: str, queries: handlers.Handler[zenoh.Query]) -> None:
        while True:
            try:
                query = queries.recv()
            except zenoh.ZError:  # undeclared
                return
            latest = self._latest.get(where)
            with query:
                if latest is not None:
                    query.reply(where, latest[0], attachment=latest[1])


class Subscription:
    """Receives all messages under a key expression, old ones of living publishers first.

    A message may come twice (after a reconnection) and recovered ones come late: `Seen` tells
    duplicates, and the sequence orders a stream. One thread receives.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key_expression: str,
        *,
        capacity: int | None = None,
    ) -> None:
        """Subscribe; `capacity` messages may wait (default: the largest of the topic table).

        More would make the publishers wait, and after a second the router cuts the connection:
        receive quickly and do long work in another thread.
        """
        self._session = session
        self._fetched: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        self._sources: dict[_SourceName, _Source] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self.fetched = 0
        """Messages that the gap query brought."""
        self._subscriber = ext.declare_advanced_subscriber(
            session,
            key_expression,
            handlers.FifoChannel(capacity or max(row.queue for row in TOPICS)),
            history=ext.HistoryConfig(detect_late_publishers=True),
            recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )
        self._handler = self._subscriber.handler
        self._filler = threading.Thread(target=self._fill_gaps, name="gap-fill", daemon=True)
        self._filler.start()

    def receive(self, timeout_s: float = 0.0) -> Received | None:
        """Return the next message, or None if none came within `timeout_s`."""
        received = self._next()
        if received is not None or timeout_s <= 0:
            return received
        deadline = time.monotonic() + timeout_s
        while received is None and (left_s := deadline - time.monotonic()) > 0:
            time.sleep(min(_IDLE_POLL_S, left_s))
            received = self._next()
        return received

    def close(self) -> None:
        """Stop receiving; what has already come can still be had from `receive`."""
        if not self._closing.is_set():
            self._closing.set()
            self._filler.join()
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _next(self) -> Received | None:
        try:
            sample = self._handler.try_recv()
        except zenoh.ZError:  # closed and empty
            sample = None
        recovered = False
        if sample is None:
            if self._fetched.empty():
                return None
            sample, recovered = self._fetched.get(), True
            self.fetched += 1
        where = str(sample.key_expr)
        self._note(where, sample)
        attachment = sample.attachment
        return Received(
            where,
            sample.payload.to_bytes(),
            None if attachment is None else attachment.to_bytes(),
            recovered,
        )

    def _note(self, where: str, sample: zenoh.Sample) -> None:
        """Remember the publisher's own numbering of the sample, which shows what is missing."""
        source = sample.source_info
        if source is None:
            return
        name = (where, source.source_id.zid, source.source_id.eid)
        with self._lock:
            found = self._sources.get(name)
            if found is None:
                if len(where) > MAX_KEY_CHARACTERS:
                    return
                if len(self._sources) >= _MAX_SOURCES:
                    # The oldest: a publisher that has gone, or a stranger who makes up names.
                    del self._sources[next(iter(self._sources))]
                found = self._sources[name] = _Source()
            if found.numbers.runs < _MAX_HOLES_PER_SOURCE:
                found.numbers.add(source.source_sn)

    def _fill_gaps(self) -> None:
        while not self._closing.wait(_GAP_PATIENCE_S):
            for name, hole in self._due_holes():
                if self._closing.is_set():
                    return
                try:
                    self._fetch(name, hole)
                except zenoh.ZError as error:  # the session is closing or the router away
                    _log.debug("gap query for %s: %s", name[0], error)

    def _due_holes(self) -> list[tuple[_SourceName, tuple[int, int]]]:
        """Return holes that have lasted a round and were not asked for too often."""
        due = []
        with self._lock:
            for name, source in self._sources.items():
                holes = source.numbers.holes_from_zero()
                tries = {hole: source.tries.get(hole, -1) + 1 for hole in holes}
                source.tries = tries
                due += [(name, hole) for hole, n in tries.items() if 0 < n <= _GAP_TRIES]
        return due[:_MAX_HOLES_PER_ROUND]

    def _fetch(self, name: _SourceName, hole: tuple[int, int]) -> None:
        where, zid, eid = name
        replies = self._session.get(
            f"{where}/@adv/pub/{zid}/{eid}/**?_sn={hole[0]}..{hole[1]}",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_GAP_QUERY_TIMEOUT_S,
        )
        for reply in replies:
            sample = reply.ok
            if sample is not None:
                self._fetched.put(sample)


class Seen:
    """Which messages have been seen, by identity; its memory grows with gaps, not with time."""

    def __init__(self) -> None:
        self.streams: dict[tuple[Key, int], Intervals] = {}
        """By (key, boot_id)."""

    def add(self, where: Key, identity: Identity) -> bool:
        """Note a message; False if it had been seen before."""
        return self.numbers(where, identity.boot_id).add(identity.sequence)

    def numbers(self, where: Key, boot_id: int) -> Intervals:
        """Return the sequences that have been seen of a key and boot, to be added to."""
        name = (where, boot_id)
        numbers = self.streams.get(name)
        if numbers is None:
            numbers = self.streams[name] = Intervals()
        return numbers


class Delivery:
    """Follows what loggers of a realm have on disk, so that a publisher knows when it may leave."""

    def __init__(self, session: zenoh.Session | None, realm: str) -> None:
        """Follow the loggers of a realm; without a session from `connect` on."""
        self.realm = realm
        self._sent: Counter[tuple[str, str, str, int]] = Counter()
        self._durable: dict[str, dict[tuple[str, str, str, int], _OnDisk]] = {}
        self._lock = threading.Lock()
        self._subscriber: ext.AdvancedSubscriber[Any] | None = None
        if session is not None:
            self.connect(session)

    def connect(self, session: zenoh.Session) -> None:
        """Listen from now on, to what was said before, too."""
        # Each message tells everything: of many that nobody has read the last few are enough.
        self._subscriber = ext.declare_advanced_subscriber(
            session,
            selector(self.realm, "service", "durable"),
            handlers.RingChannel(_DURABLES_WAITING),
            history=ext.HistoryConfig(detect_late_publishers=True),
            recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
        )

    def sent(self, where: Key, identity: Identity) -> None:
        """Count a message that was published; every identity once."""
        self._sent[(where.owner, where.identifier, where.stream, identity.boot_id)] += 1

    @property
    def has_logger(self) -> bool:
        """Whether any logger has spoken yet."""
        return bool(self._durable)

    def missing(self) -> int:
        """Return how many sent messages the logger that has most of them does not have yet."""
        self._read()
        by_logger = [
            sum(
                max(0, number - durable.get(name, _OnDisk(0, -1)).messages)
                for name, number in self._sent.items()
            )
            for durable in self._durable.values()
        ]
        return min(by_logger, default=self._sent.total())

    def wait(self, timeout_s: float, most_missing: int = 0) -> int:
        """Wait until at most so many messages are not on disk; return how many are not.

        Where no logger has spoken within `LINGER_S`, it waits no longer: subscribers have had
        the time to ask for what they missed.
        """
        began = time.monotonic()
        while (missing := self.missing()) > most_missing:
            waited_s = time.monotonic() - began
            if waited_s >= timeout_s or (waited_s >= LINGER_S and not self.has_logger):
                break
            time.sleep(_IDLE_POLL_S)
        return missing

    def confirmed(self, vehicle: str) -> dict[tuple[str, int], int]:
        """Return up to where at least one logger has everything, by (stream, boot_id)."""
        self._read()
        highest: dict[tuple[str, int], int] = {}
        for durable in self._durable.values():
            for (owner, identifier, stream, boot_id), on_disk in durable.items():
                if (owner, identifier) == ("vehicle", vehicle) and on_disk.sequence >= 0:
                    name = (stream, boot_id)
                    highest[name] = max(highest.get(name, -1), on_disk.sequence)
        return highest

    def close(self) -> None:
        """Stop following."""
        if self._subscriber is not None:
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def _read(self) -> None:
        if self._subscriber is None:
            return
        with self._lock:
            newest: dict[str, bytes] = {}
            while (sample := self._subscriber.try_recv()) is not None:
                newest[str(sample.key_expr)] = sample.payload.to_bytes()  # each tells everything
            for where, payload in newest.items():
                try:
                    message = decode("driveby.v1.Durable", payload)
                    service = parse_key(where).identifier
                except ValueError as error:
                    _log.warning("durable: %s", error)
                    continue
                if isinstance(message, pb.Durable):
                    self._durable[service] = {
                        (s.owner, s.identifier, s.stream, s.boot_id): _OnDisk(
                            s.count, s.sequence if s.HasField("sequence") else -1
                        )
                        for s in message.streams
                    }


class _OnDisk(NamedTuple):
    messages: int
    sequence: int
    """The highest with nothing missing below it; -1: none."""


def subscribe_latest(
    session: zenoh.Session, key_expression: str, capacity: int = 100
) -> Iterator[Received | None]:
    """Yield the newest messages for a live display, and None whenever there is none at the time.

    It never holds anybody up: of more than `capacity` waiting messages the oldest are dropped.
    The consumer decides how long to sleep on None; closing the generator ends the subscription.
    """
    subscriber = ext.declare_advanced_subscriber(
        session,
        key_expression,
        handlers.RingChannel(capacity),
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
    )
    try:
        while True:
            sample = subscriber.try_recv()
            if sample is None:
                yield None
                continue
            attachment = sample.attachment
            yield Received(
                str(sample.key_expr),
                sample.payload.to_bytes(),
                None if attachment is None else attachment.to_bytes(),
                False,
            )
    finally:
        subscriber.undeclare()  # type: ignore[no-untyped-call]


def get_latest(session: zenoh.Session, key_expression: str, timeout_s: float = 5.0) -> list[bytes]:
    """Ask for the last message of every latched topic under a key expression; their payloads."""
    replies = session.get(key_expression, target=zenoh.QueryTarget.ALL, timeout=timeout_s)
    samples = [reply.ok for reply in replies]
    return [sample.payload.to_bytes() for sample in samples if sample is not None]


class _Source:
    """One publisher of Zenoh: its own numbers that came, and how often holes were asked for."""

    def __init__(self) -> None:
        self.numbers = Intervals()
        self.tries: dict[tuple[int, int], int] = {}


def _declare_publisher(session: zenoh.Session, where: str) -> ext.AdvancedPublisher:
    parsed = parse_key(where)
    row = topic(parsed.owner, parsed.stream)
    reliable = row.delivery == "reliable"
    block, drop = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
    return ext.declare_advanced_publisher(
        session,
        where,
        encoding=zenoh.Encoding("application/protobuf").with_schema(row.message),
        congestion_control=block if reliable else drop,
        reliability=zenoh.Reliability.RELIABLE,
        cache=ext.CacheConfig(
            row.cache, replies_config=ext.RepliesConfig(congestion_control=block)
        ),
        sample_miss_detection=ext.MissDetectionConfig(
            heartbeat=_HEARTBEAT_S, sporadic_heartbeat=None
        ),
        publisher_detection=True,
    )


def _matches(publisher: zenoh.Publisher) -> bool:
    # An object with a flag, which is always true itself; the type stubs call it a bool.
    status: Any = publisher.matching_status
    return bool(getattr(status, "matching", status))


def _check_endpoint(endpoint: str, tls: Path | None) -> str:
    if not _ENDPOINT.fullmatch(endpoint):
        raise InputError(
            f"endpoint {endpoint!r}: PROTOCOL/HOST:PORT is expected, e.g. {default_endpoint(tls)}"
        )
    is_tls = endpoint.startswith("tls/")
    if tls is not None and not is_tls:
        raise InputError(f"endpoint {endpoint!r}: with --tls it must begin with tls/")
    if tls is None and is_tls:
        raise InputError(f"endpoint {endpoint!r}: needs --tls FOLDER, see `driveby certs --help`")
    return endpoint


def _is_on_this_machine(endpoint: str) -> bool:
    """Whether only programs on this machine can reach what listens at an endpoint."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return True
    host = re.split(r"[?#]", address)[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a name may be that of any interface


def _first_sentence(error: Exception) -> str:
    """Return what a user can read of an error of Zenoh: without the places in its source."""
    return re.split(r" at /|\[", str(error), maxsplit=1)[0].strip()
