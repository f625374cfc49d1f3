"""A gateway for trucks with ROS 2: from their Zenoh router to ours.

It is a client of both. Messages of the topics in the site file's `[ros2]` become batches and fixes
(`services.drives.ros2_truck`), which a `Gateway` publishes like those of any truck.
"""

import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import zenoh
from zenoh import handlers

from schemas.events import Event, EventKind
from schemas.signals import GnssFix
from schemas.site_file import load_site, vehicle_toml
from services.bus.credentials import check_speaks_for
from services.bus.playback import confirm, stopped_by_signals
from services.bus.session import checked_realm, open_session
from services.common.errors import FailureError, one_line
from services.common.naming import count_of
from services.drives.importing import vehicle_of
from services.drives.ros2_anomalies import (
    DROPPED,
    TOO_LARGE,
    UNKNOWN_TYPE,
    UNPUBLISHED,
    UNREADABLE,
    TopicRefusals,
)
from services.drives.ros2_messages import IMU, MAX_PAYLOAD_BYTES, check_rosbags, unknown_hash
from services.drives.ros2_truck import Accel, Ros2Truck
from services.truck.bounded_queue import BoundedQueue
from services.truck.gateway import Connect, Gateway
from services.truck.rmw_zenoh import decode_attachment, key_expression, type_and_hash
from services.truck.settings import GatewaySettings
from services.truck.spool import Spool

_log = logging.getLogger(__name__)
CONNECT_TIMEOUT_S: Final = 10.0
"""Timeout for a router that was started a moment before."""
_WAITING: Final = 20_000
"""Messages of a topic that may wait: more than ten seconds of the fastest. Beyond it the oldest are
dropped and counted; no ROS process is held up."""
_WAITING_BYTES: Final = 24 << 20
"""Bytes of a topic that may wait: `_WAITING` messages of a sensor have some 19 MB."""
_OVERHEAD_BYTES: Final = 500
"""Memory of a waiting message besides its content: 263 by `sys.getsizeof`, and the allocator's."""
_AT_ONCE: Final = 50
"""Messages of a topic before another one has its turn."""
_MAX_BYTES: Final = MAX_PAYLOAD_BYTES + 1024
"""Largest message with its key and attachment."""
_PAUSE_S: Final = 0.005
_LOG_EVERY_S: Final = 10.0
_EVENT_EVERY_S: Final = 60.0
"""Interval of events on refused and dropped messages, with counts by topic."""
_MAX_PUBLISHERS: Final = 1000
"""Number of publishers with remembered sequences; beyond, all are forgotten."""
_MAX_REFUSED: Final = 100
"""Number of reported types and hashes, because a hostile sender could invent any number."""


def run(asked: GatewaySettings, ready: Callable[[], None] = lambda: None) -> int:
    """Publish the messages of a ROS 2 truck to a router of the bus, until stopped.

    No message ends it: unusable ones are counted, logged and published as an event. With a spool
    our router may come later; that of ROS must be present. `ready` is called when all topics are
    subscribed to.

    Raise InputError for bad arguments, or a site file without the truck's `[ros2]`; FailureError if
    a router does not answer in time, nothing subscribes until the end, or a logger did not confirm
    everything then.
    """
    check_rosbags()
    realm, endpoint, tls = checked_realm(asked.realm), asked.address, asked.tls
    known = load_site(asked.site)
    vehicle = vehicle_of(known, str(asked.site), asked.vehicle)
    # It is counted like others; the sensor's topic is free for another one.
    truck = Ros2Truck(known, str(asked.site), vehicle, wrong_rate=lambda error: None)
    check_speaks_for(tls, "truck", vehicle)
    with stopped_by_signals() as stop, contextlib.ExitStack() as stack:
        ros_session = stack.enter_context(_open_ros(asked.ros))
        if asked.spool is None:
            bus: zenoh.Session | Connect = stack.enter_context(
                open_session(connect=endpoint, timeout_s=CONNECT_TIMEOUT_S, tls=tls)
            )
        else:
            bus = partial(open_session, connect=endpoint, timeout_s=0.0, tls=tls)
        folder, budget_bytes = asked.spool, asked.spool_budget << 20
        spooled = None if folder is None else Spool(folder, budget_bytes=budget_bytes)
        gateway = Gateway(bus, realm, vehicle, spooled)
        stack.callback(gateway.close)
        out = _InfoFirstPublisher(gateway, vehicle_toml(known, vehicle), truck)
        reports = _Reports(gateway, truck)
        with _RosSubscriptions(ros_session, truck) as subscriptions:
            ready()
            _forward(subscriptions, truck, out, reports, stop)
        for item in truck.finish():
            out.put(item)
        reports.report(closing=True)
        confirm(
            gateway.delivery,
            out.sent,
            gateway.subscriber_complaint,
            is_spooled=spooled is not None,
        )
        sent = count_of(out.sent, "message")
        gateway.log.info("%s of %s published in realm %s", sent, vehicle, realm)
    return 0


def _open_ros(ros: str) -> zenoh.Session:
    try:
        return open_session(connect=ros, timeout_s=CONNECT_TIMEOUT_S)
    except FailureError:
        raise FailureError(
            f"no router of ROS 2 answers at {ros} within {CONNECT_TIMEOUT_S:g} s; "
            "it is started by `ros2 run rmw_zenoh_cpp rmw_zenohd`"
        ) from None


def _forward(
    subscriptions: "_RosSubscriptions",
    truck: Ros2Truck,
    out: "_InfoFirstPublisher",
    reports: "_Reports",
    stop: threading.Event,
) -> None:
    logged_s = time.monotonic()
    while not stop.is_set():
        is_any_received = False
        for topic in truck.table.topics():
            for _ in range(_AT_ONCE):
                message = subscriptions.next(topic)
                if message is None:
                    break
                is_any_received = True
                for item in subscriptions.accept(topic, message):
                    out.put(item)
        if time.monotonic() >= logged_s + _LOG_EVERY_S:
            logged_s = time.monotonic()
            subscriptions.count_drops()
            reports.report()
            subscriptions.report_silence()
        if not is_any_received:
            stop.wait(_PAUSE_S)
    subscriptions.count_drops()


class _Reports:
    """Log and events of unused messages."""

    def __init__(self, gateway: Gateway, truck: Ros2Truck) -> None:
        self._gateway = gateway
        self._truck = truck
        self._event_s = float("-inf")

    def report(self, *, closing: bool = False) -> None:
        """Log a line for each kind with news; publish events after a minute, or at the end."""
        for line in self._truck.anomalies.news():
            self._gateway.log.warning("%s: %s", self._gateway.vehicle, line)
        now_s = time.monotonic()
        if not closing and now_s < self._event_s + _EVENT_EVERY_S:
            return
        for refusals in self._truck.anomalies.refusals():
            # The next event includes counts that cannot be published now.
            if self._publish(refusals):
                self._truck.anomalies.reported(refusals.topic)
                self._event_s = now_s

    def _publish(self, refusals: TopicRefusals) -> bool:
        numbers = {EventKind.REFUSED: refusals.refused, EventKind.DROPPED: refusals.dropped}
        return all(
            self._gateway.event(
                Event(
                    kind,
                    time.time_ns(),
                    refusals.text,
                    vehicle=self._gateway.vehicle,
                    stream="accel" if self._truck.types(refusals.topic) == (IMU,) else "gnss",
                    boot_id=self._gateway.boot_id,
                    messages=number,
                )
            )
            for kind, number in numbers.items()
            if number
        )


class _InfoFirstPublisher:
    """A publisher that sends the truck's description before all other messages."""

    def __init__(self, gateway: Gateway, toml: str, truck: Ros2Truck) -> None:
        self.sent = 0
        self._gateway = gateway
        self._toml = toml
        self._anomalies = truck.anomalies
        self._gnss = truck.table.gnss
        self._topics = {name: imu.topic for name, imu in truck.table.imu.by_channel().items()}

    def put(self, item: Accel | GnssFix) -> None:
        """Publish an item; count one that fits no message."""
        times = {"device_time_ns": item.device_time_ns, "wall_time_ns": item.wall_time_ns}
        try:
            if not self.sent:
                self._gateway.info(self._toml, **times)
                self.sent = 1
            if isinstance(item, GnssFix):
                self._gateway.gnss(item)
                self.sent += 2
            else:
                self._gateway.accel(item.channels, **times)
                self.sent += 1
        except ValueError as error:  # times of a foreign clock
            if isinstance(item, GnssFix):
                topic = self._gnss
            else:
                topic = self._topics[next(iter(item.channels))]
            self._anomalies.add(topic, UNPUBLISHED, example=one_line(str(error))[:200])


class _RosMessage(NamedTuple):
    """A received message, copied, because Zenoh's object keeps the whole network buffer."""

    key: str
    attachment: bytes | None
    payload: bytes


class _RosSubscriptions:
    """The subscriptions, and the checks of messages before they are decoded."""

    def __init__(self, session: zenoh.Session, truck: Ros2Truck) -> None:
        self._truck = truck
        self._waiting = {
            topic: BoundedQueue[_RosMessage](_WAITING, _WAITING_BYTES)
            for topic in truck.table.topics()
        }
        self._too_large: Counter[str] = Counter()
        """Written by Zenoh's threads."""
        self._counted_too_large: Counter[str] = Counter()
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._refused: set[str] = set()
        self._latest: dict[tuple[str, bytes], int] = {}
        """Number of the last message by topic and publisher."""
        self._received_topics: set[str] = set()
        self._silent: set[str] = set()
        for topic in truck.table.topics():
            # By Zenoh's own thread: another one would need a queue before it, which has no bound in
            # bytes.
            receive = handlers.Callback(partial(self._receive, topic), indirect=False)
            where = key_expression(truck.table.domain, topic)
            self._subscribers.append(session.declare_subscriber(where, receive))

    def __enter__(self) -> "_RosSubscriptions":
        return self

    def __exit__(self, *_: object) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]

    def next(self, topic: str) -> _RosMessage | None:
        """Return the next message of a topic, or None if none waits."""
        return self._waiting[topic].get()

    def _receive(self, topic: str, sample: zenoh.Sample) -> None:
        """Queue a plausible sensor message, in the receiving thread of Zenoh."""
        key = str(sample.key_expr)
        attached = sample.attachment
        size = len(key) + len(sample.payload) + (0 if attached is None else len(attached))
        if size > _MAX_BYTES:
            self._too_large[topic] += 1
            return
        attachment = None if attached is None else attached.to_bytes()
        message = _RosMessage(key, attachment, sample.payload.to_bytes())
        self._waiting[topic].put(message, size + _OVERHEAD_BYTES)

    def count_drops(self) -> None:
        """Count the messages dropped since the last call."""
        anomalies = self._truck.anomalies
        for topic, waiting in self._waiting.items():
            dropped = waiting.dropped()
            anomalies.add(topic, DROPPED, dropped.messages)
            too_large = self._too_large[topic]
            anomalies.add(topic, TOO_LARGE, too_large - self._counted_too_large[topic])
            self._counted_too_large[topic] = too_large

    def accept(self, topic: str, message: _RosMessage) -> list[Accel | GnssFix]:
        """Return the parts of a message that can be published now."""
        anomalies = self._truck.anomalies
        try:
            name, reported_hash = type_and_hash(message.key)
            attachment = decode_attachment(message.attachment)
        except ValueError as error:
            anomalies.add(topic, UNREADABLE, example=f"the first {error}")
            return []
        of = next((one for one in self._truck.types(topic) if one.dds_name == name), None)
        if of is None:
            wanted = " or ".join(one.name for one in self._truck.types(topic))
            self._refuse(topic, f"is of {one_line(name[:80])}, {wanted} is expected; refused")
            return []
        problem = unknown_hash(of, reported_hash)
        if problem is not None:
            self._refuse(topic, f"{one_line(problem)}; refused")
            return []
        self._received_topics.add(topic)
        if not self._is_next(topic, attachment.publisher, attachment.sequence):
            return []
        return self._truck.convert(
            topic, of, message.payload, attachment.sent_ns, attachment.publisher
        )

    def report_silence(self) -> None:
        """Log the topics without messages since the last call, once."""
        for topic in self._truck.table.topics():
            if topic in self._received_topics:
                self._silent.discard(topic)
            elif topic not in self._silent:
                self._silent.add(topic)
                _log.warning(
                    "%s: nothing on %s in domain %d for %.0f s",
                    *(self._truck.table.vehicle, topic, self._truck.table.domain, _LOG_EVERY_S),
                )
        self._received_topics.clear()

    def _is_next(self, topic: str, publisher: bytes, sequence: int) -> bool:
        """Count lost messages; return False for a repeated one."""
        anomalies = self._truck.anomalies
        name = (topic, publisher)
        before = self._latest.get(name)
        if before is not None and sequence <= before:
            anomalies.add(topic, "messages received again, left out")
            return False
        if before is not None:
            anomalies.add(topic, "messages lost on the way", sequence - before - 1)
        elif len(self._latest) >= _MAX_PUBLISHERS:
            self._latest.clear()
        self._latest[name] = sequence
        return True

    def _refuse(self, topic: str, why: str) -> None:
        self._truck.anomalies.add(topic, UNKNOWN_TYPE, example=f"the first {why}")
        line = f"{topic}: {why}"
        if line not in self._refused and len(self._refused) < _MAX_REFUSED:
            self._refused.add(line)
            _log.error("%s: %s", self._truck.table.vehicle, line)
