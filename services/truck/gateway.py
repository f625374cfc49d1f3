"""The gateway on a truck's computer: each message goes to its own disk first, then to the bus.

    def connect():
        return open_session(connect="tcp/127.0.0.1:7447", timeout_s=0.0)

    gateway = Gateway(connect, "live", "truck-1", Spool(Path("spool/truck-1")))
    gateway.info(Path("site.toml").read_text(), device_time_ns=..., wall_time_ns=...)
    for samples in my_driver():                      # every 50 ms
        channels = {"sprung_front": AccelChannel(1000.0, samples)}
        gateway.accel(channels, device_time_ns=..., wall_time_ns=...)
    gateway.close()

`docs/examples/own_driver.py` is a complete program. The caller never waits for the network: a
message is appended to the spool and queued, and a thread publishes it. If the queue is full,
because the router accepts nothing, the message stays in the spool, and the logger requests it
(`schemas.spool`) once it notices the gap. Messages that a logger has confirmed are freed. Without a
router at the start a thread tries until there is one. Without a spool, messages are published at
once, and those that no subscriber has fetched are lost with this process.
"""

import contextlib
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import zenoh
from zenoh import handlers

from schemas.events import Event, encode_event
from schemas.signals import (
    AccelBatch,
    AccelChannel,
    GnssFix,
    Identity,
    VehicleInfo,
    encode_accel,
    encode_gnss,
    encode_identity,
    encode_info,
    encode_location,
)
from schemas.spool import (
    encode_contents,
    encode_page,
    parse_query,
    parse_spool_key,
    spool_key,
    spool_selector,
)
from schemas.topics import Key, check_identifier, check_realm, gateway_service, key, topic
from schemas.vehicle_info import vehicle_part
from services.bus.delivery import DeliveryTracker
from services.bus.participants import SubscriberCheck
from services.bus.publisher import Publisher
from services.common.errors import FailureError
from services.common.log_lines import about
from services.common.naming import count_of
from services.truck.logger_watch import LoggerWatch
from services.truck.spool import Spool

__all__ = ["Gateway"]

_log = logging.getLogger(__name__)
_OUTBOX_MESSAGES = 10_000
"""Capacity of the queue to the bus; further messages stay in the spool and are requested."""
_SYNC_PERIOD_S = 0.5
"""Interval of syncs: older messages survive a power cut."""
_FREE_EVERY = 10  # syncs
_GOODBYE_S = 5.0
"""Time for the bus to accept waiting messages at the end; the spool keeps the others."""
_QUERIES_WAITING = 100
"""Capacity for queries of the spool: a few loggers, each every two seconds."""
_COMPLAINT_PERIOD_S = 60.0
"""Interval of log lines about a failing disk, which fails at every message, or no subscriber."""
_CONNECT_PAUSE_S = 0.2
"""Pause between two attempts, each of which may fail at once."""
_FIRST_ANSWER_S = 1.0
"""Wait for the first attempt; the truck then records while it goes on."""
_KEPT = "the spool keeps the messages"
_MEANWHILE = "all messages go to the spool meanwhile"
Connect = Callable[[], zenoh.Session]
"""Function that opens a session, or raises FailureError if there is no answer now."""


class Gateway:
    """A publisher of one truck's messages with identities of this boot; not thread-safe.

    A spool belongs to the gateway from then on and is closed with it.
    """

    def __init__(
        self,
        session: zenoh.Session | Connect,
        realm: str,
        vehicle: str,
        spool: Spool | None = None,
    ) -> None:
        """Join the bus. With a spool, `session` may be a function that opens one.

        A thread calls it at once, and after a FailureError repeatedly; the spool accepts messages
        after a second at the latest. The gateway closes a session that it has opened.
        """
        self.vehicle = check_identifier(vehicle)
        self.log = logging.LoggerAdapter(_log, about(realm=realm, vehicle=vehicle))
        boot_id = None if spool is None else spool.boot_id
        self.publisher = Publisher(None, check_realm(realm), boot_id)
        self.delivery = DeliveryTracker(None, realm)
        self.deferred = 0
        """Messages that were spooled and not published, because the bus did not take them."""
        self.unspooled = 0
        """Messages that the disk did not take; they are published once there is a router."""
        self.is_online = False
        """Whether there is a session; once there is one, it connects again by itself."""
        self._next: Counter[str] = Counter()
        self._complained_s = float("-inf")
        self._unsubscribed_s = float("-inf")
        self._subscribers: SubscriberCheck | None = None
        self._logger_watch: LoggerWatch | None = None
        self._alive: Any = None
        self._own_session: zenoh.Session | None = None
        self._spool = None if spool is None else _SpoolService(self, spool)
        self._closing = threading.Event()
        self._connecting: threading.Thread | None = None
        self._answered = threading.Event()
        self._failed: Exception | None = None
        if isinstance(session, zenoh.Session):
            self._join(session)
            return
        if spool is None:
            raise ValueError("without a spool a session is needed")
        self._connecting = threading.Thread(
            target=self._connect, args=(session,), name="connect", daemon=True
        )
        self._connecting.start()
        if not self._answered.wait(_FIRST_ANSWER_S):
            self._answered.set()
            self.log.warning("%s: no router has answered yet; %s", vehicle, _MEANWHILE)
        elif self._failed is not None:
            raise self._failed

    @property
    def boot_id(self) -> int:
        """The boot of all messages of this gateway, higher than any before it."""
        return self.publisher.boot_id

    def info(self, site_toml: str, *, device_time_ns: int, wall_time_ns: int) -> None:
        """Publish the truck's description, also for late subscribers.

        `site_toml` is a site file, or the truck's own part of one; only that part is sent. Raise
        InputError if it has no such vehicle, or its part is longer than a message may be.
        """
        own = vehicle_part(site_toml, self.vehicle)
        identity = self._identity("info")
        info = VehicleInfo(*identity, device_time_ns, wall_time_ns, self.vehicle, own)
        self.put("info", encode_info(info), identity)

    def accel(
        self, channels: dict[str, AccelChannel], *, device_time_ns: int, wall_time_ns: int
    ) -> None:
        """Publish 50-100 ms of accelerations, m/s², up, without gravity; times of their first."""
        identity = self._identity("accel")
        batch = AccelBatch(*identity, device_time_ns, wall_time_ns, channels)
        self.put("accel", encode_accel(batch), identity)

    def gnss(self, fix: GnssFix) -> None:
        """Publish a fix, as `gnss` and as `location`; its boot_id and sequence are replaced."""
        identity = self._identity("gnss")
        own = fix._replace(boot_id=identity.boot_id, sequence=identity.sequence)
        self.put("gnss", encode_gnss(own), identity)
        self.put("location", encode_location(own), self._identity("location"))

    def event(self, event: Event) -> bool:
        """Publish an event about this truck; return False if the bus does not accept it now.

        Events are not spooled, and the call does not wait.
        """
        if not self.is_online:
            return False
        put = _Put("service", gateway_service(self.vehicle), "event", encode_event(event), None)
        if self._spool is not None:
            return self._spool.publish(put, wait=False)
        self.publisher.put(*put)
        return True

    def put(
        self, stream: str, payload: bytes, identity: Identity, *, patient: bool = False
    ) -> None:
        """Publish an encoded message; the sequences of each stream ascend from 0.

        With `patient` it waits for room in the queue, as the reader of a file can, rather than
        leave the message to the spool. Raise ValueError if the payload is larger than its topic
        allows.
        """
        row = topic("vehicle", stream)
        if not row.message or len(payload) > row.max_bytes:
            raise ValueError(f"vehicle/{stream}: {len(payload)} bytes; at most {row.max_bytes}")
        if self._spool is None:
            self.publisher.put("vehicle", self.vehicle, stream, payload, identity)
        else:
            spooled = self._append(self._spool.spool, stream, payload, identity)
            # A message that is on no disk has to be published, however long that takes.
            wait = self.is_online and (patient or not spooled)
            put = _Put("vehicle", self.vehicle, stream, payload, identity)
            if not self._spool.publish(put, wait=wait):
                self.deferred += 1
        self._next[stream] = identity.sequence + 1
        self.delivery.sent(Key(self.publisher.realm, "vehicle", self.vehicle, stream), identity)

    def subscriber_complaint(self) -> str | None:
        """Return why nothing receives this truck, and that a spool keeps its messages, or None."""
        if self._subscribers is None or self.delivery.has_logger:
            return None
        why = self._subscribers.complaint()
        return why if why is None or self._spool is None else f"{why}; {_KEPT}"

    def warn_without_subscriber(self) -> None:
        """Log why nothing receives this truck, if nothing does, at most once a minute."""
        now_s = time.monotonic()
        if now_s < self._unsubscribed_s + _COMPLAINT_PERIOD_S:
            return
        why = self.subscriber_complaint()
        if why is not None:
            self._unsubscribed_s = now_s
            self.log.warning("%s", why)

    def log_absence(self) -> None:
        """Log once that the router or logger has left, and once that it is back."""
        if self._logger_watch is None:
            return
        news = self._logger_watch.news(time.monotonic())
        if news is not None:
            level = logging.WARNING if self._logger_watch.is_absent else logging.INFO
            self.log.log(level, "%s: %s", self.vehicle, news)

    def close(self) -> None:
        """Leave the bus. The next boot offers spooled messages that no logger has on disk."""
        self._closing.set()
        if self._connecting is not None:
            self._connecting.join()
        if self._alive is not None:
            self._alive.undeclare()
        if self._spool is not None:
            self._spool.close()
        for check in (self._subscribers, self._logger_watch):
            if check is not None:
                check.close()
        self.delivery.close()
        self.publisher.close()
        if self._own_session is not None:
            self._own_session.close()  # type: ignore[no-untyped-call]

    def _connect(self, connect: Connect) -> None:
        logged = ""
        while not self._closing.is_set():
            is_late = self._answered.is_set()
            try:
                self._own_session = connect()
                self._join(self._own_session)
            except FailureError as error:
                if str(error) != logged:  # from no router to a wrong certificate, for instance
                    self.log.warning("%s: %s; %s", self.vehicle, error, _MEANWHILE)
                logged = str(error)
                self._answered.set()
                self._closing.wait(_CONNECT_PAUSE_S)
            except Exception as error:
                if is_late:  # an unattended truck continues without this thread
                    self.log.exception("%s: connecting failed for good", self.vehicle)
                self._failed = error
                self._answered.set()
                return
            else:
                if self._answered.is_set():
                    self.log.info("%s: connected", self.vehicle)
                self._answered.set()
                return

    def _join(self, session: zenoh.Session) -> None:
        self.publisher.connect(session)
        self.delivery.connect(session)
        # Present while this process runs: services notice trucks by it.
        alive = key(self.publisher.realm, "vehicle", self.vehicle, "alive")
        self._alive = session.liveliness().declare_token(alive)
        where = Key(self.publisher.realm, "vehicle", self.vehicle, "accel")
        self._subscribers = SubscriberCheck(session, where)
        self._logger_watch = LoggerWatch(session, self.publisher.realm)
        self.is_online = True
        if self._spool is not None:
            self._spool.join(session)

    def _identity(self, stream: str) -> Identity:
        """Return the identity of the next message, which only a successful `put` uses up."""
        return Identity(self.boot_id, self._next[stream])

    def _append(self, spool: Spool, stream: str, payload: bytes, identity: Identity) -> bool:
        try:
            spool.append(stream, identity.sequence, payload)
            return True
        except OSError as error:
            self.unspooled += 1
            if time.monotonic() >= self._complained_s + _COMPLAINT_PERIOD_S:
                self._complained_s = time.monotonic()
                self.log.error(
                    "%s: spool: %s; %s in memory only, until a router takes them",
                    self.vehicle, error.strerror, count_of(self.unspooled, "message"),
                )  # fmt: skip
            return False


class _Put(NamedTuple):
    """Arguments of `Publisher.put`."""

    owner: str
    identifier: str
    stream: str
    payload: bytes
    identity: Identity | None


class _SpoolService:
    """Three threads: one publishes, one syncs and frees, one answers queries."""

    def __init__(self, gateway: Gateway, spool: Spool) -> None:
        self.spool = spool
        self._gateway = gateway
        self._realm = gateway.publisher.realm
        self._outbox: queue.Queue[_Put | None] = queue.Queue(_OUTBOX_MESSAGES)
        self._closing = threading.Event()
        self._queryable: zenoh.Queryable[Any] | None = None
        self._threads: list[threading.Thread] = []
        self._start("sync", self._sync_all)

    def join(self, session: zenoh.Session) -> None:
        """Publish and answer queries from now on."""
        self._queryable = session.declare_queryable(
            spool_selector(self._realm, self._gateway.vehicle),
            handlers.FifoChannel(_QUERIES_WAITING),
            complete=True,
        )
        self._start("publish", self._publish_all)
        self._start("answer", self._answer_all, self._queryable.handler)

    def _start(self, name: str, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments, name=f"spool-{name}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def publish(self, put: _Put, *, wait: bool) -> bool:
        """Queue a message for publication; return False if the queue is full."""
        try:
            self._outbox.put(put, block=wait)
            return True
        except queue.Full:
            return False

    def close(self) -> None:
        """Publish waiting messages within a few seconds, and close the spool."""
        deadline = time.monotonic() + (_GOODBYE_S if self._queryable is not None else 0.0)
        while not self._outbox.empty() and time.monotonic() < deadline:
            time.sleep(0.01)
        self._closing.set()
        if self._queryable is not None:
            self._queryable.undeclare()  # type: ignore[no-untyped-call]
        with contextlib.suppress(queue.Full):  # then the thread sees _closing after its message
            self._outbox.put_nowait(None)
        for thread in self._threads:
            thread.join(timeout=_GOODBYE_S)
        self._free()
        try:
            self.spool.close()
        except (OSError, FailureError) as error:
            self._gateway.log.error("%s: spool: %s", self._gateway.vehicle, error)

    def _publish_all(self) -> None:
        publisher, vehicle = self._gateway.publisher, self._gateway.vehicle
        while (put := self._outbox.get()) is not None and not self._closing.is_set():
            try:
                publisher.put(*put)
            except zenoh.ZError as error:  # it stays in the spool
                self._gateway.log.debug("%s: %s", vehicle, error)

    def _sync_all(self) -> None:
        rounds = 0
        while not self._closing.wait(_SYNC_PERIOD_S):
            rounds += 1
            self._gateway.log_absence()
            try:
                self.spool.sync()
            except (OSError, FailureError) as error:
                self._gateway.log.error("%s: spool: %s", self._gateway.vehicle, error)
            if rounds % _FREE_EVERY == 0:
                self._free()
                self._gateway.warn_without_subscriber()

    def _free(self) -> None:
        try:
            self.spool.confirm(self._gateway.delivery.confirmed(self._gateway.vehicle))
        except (OSError, FailureError) as error:  # freed later
            self._gateway.log.error("%s: spool: %s", self._gateway.vehicle, error)

    def _answer_all(self, queries: handlers.Handler[zenoh.Query]) -> None:
        # A thread of our own: one of Zenoh's that calls Python while the interpreter ends
        # would crash the process.
        while True:
            try:
                query = queries.recv()
            except zenoh.ZError:  # undeclared
                return
            with query:
                try:
                    self._answer(query)
                except (ValueError, OSError, zenoh.ZError) as error:
                    self._gateway.log.warning("%s: spool query: %s", self._gateway.vehicle, error)

    def _answer(self, query: zenoh.Query) -> None:
        parameters: Any = query.parameters  # pairs, whatever the type stubs say
        wanted = parse_query(dict(parameters))
        if wanted is None:
            for stream in self.spool.streams():
                where = self._key(stream)
                if query.key_expr.intersects(zenoh.KeyExpr(where)):
                    contents = encode_contents(time.time_ns(), self.spool.contents(stream))
                    self._reply(query, where, contents)
            return
        where = str(query.key_expr)
        page = self.spool.read(parse_spool_key(where).stream, *wanted)
        for sequence, payload in page.messages:
            self._reply(query, where, payload, encode_identity(wanted.boot_id, sequence))
        self._reply(query, where, encode_page(wanted, page.next_sequence))

    def _reply(
        self, query: zenoh.Query, where: str, payload: bytes, attachment: bytes | None = None
    ) -> None:
        # With the priority and congestion control of the query: Zenoh ignores others.
        query.reply(where, payload, attachment=attachment)

    def _key(self, stream: str) -> str:
        return spool_key(Key(self._realm, "vehicle", self._gateway.vehicle, stream))
