"""A gateway for trucks that speak ROS 2: from their Zenoh router to ours.

It is a client of both. What it hears of the topics in the site file's `[ros2]` becomes batches and
fixes (`services.drives.ros2_truck`), which a `Gateway` publishes as any truck's.
"""

import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import zenoh
from zenoh import handlers

from schemas.events import Event, EventKind
from schemas.signals import GnssFix
from schemas.site_file import load_site, vehicle_toml
from schemas.topics import check_realm
from services.bus.credentials import check_speaks_for
from services.bus.playback import confirm, stopped_by_signals
from services.bus.session import open_session
from services.common.errors import FailureError, InputError, one_line
from services.drives.importing import vehicle_of
from services.drives.ros2_complaints import (
    DROPPED,
    TOO_LARGE,
    UNKNOWN_TYPE,
    UNPUBLISHED,
    UNREADABLE,
    Refusals,
)
from services.drives.ros2_messages import IMU, MAX_PAYLOAD_BYTES, check_rosbags, unknown_hash
from services.drives.ros2_truck import Accel, Ros2Truck
from services.truck.bounded_queue import BoundedQueue
from services.truck.gateway import Connect, Gateway
from services.truck.rmw_zenoh import decode_attachment, key_expression, type_and_hash
from services.truck.spool import DEFAULT_BUDGET_BYTES, Spool

_log = logging.getLogger(__name__)
CONNECT_TIMEOUT_S: Final = 10.0
"""A router that was started a moment before is there by then."""
_WAITING: Final = 20_000
"""Messages of a topic: more than ten seconds of the fastest. Beyond it the oldest are dropped and
counted; nobody at the ROS router is held up."""
_WAITING_BYTES: Final = 24 << 20
"""The same in bytes: `_WAITING` messages of a sensor have some 19 MB."""
_OVERHEAD_BYTES: Final = 500
"""Memory of a waiting message besides its content: 263 by `sys.getsizeof`, and what an
allocator adds."""
_AT_ONCE: Final = 50
"""Of a topic, before another one has its turn."""
_MOST_BYTES: Final = MAX_PAYLOAD_BYTES + 1024
"""Of a message with its key and what is attached to it."""
_PAUSE_S: Final = 0.005
_TELL_EVERY_S: Final = 10.0
_EVENT_EVERY_S: Final = 60.0
"""What is refused and dropped is an event once in this time, with counts by topic."""
_MOST_PUBLISHERS: Final = 1000
"""Of which it is remembered what has come; beyond them it begins anew."""
_MOST_REFUSED: Final = 100
"""Types and hashes that are told of; a stranger could make up as many as it likes."""


def run(
    *,
    ros: str,
    endpoint: str,
    realm: str,
    site: Path,
    vehicle: str | None,
    tls: Path | None = None,
    spool: Path | None = None,
    spool_budget_bytes: int = DEFAULT_BUDGET_BYTES,
    ready: Callable[[], None] = lambda: None,
) -> int:
    """Publish what a ROS 2 truck says at the router `ros` to the one at `endpoint`, until stopped.

    No message ends it: what cannot be used is counted, logged and published as an event.

    `site` names the topics (`[ros2]`); `vehicle` chooses one of several trucks. With a folder
    `spool` messages go to disk there first, and our router may come later (see `services.truck`);
    that of ROS must be there. `ready` is called when all topics are subscribed to.

    InputError: bad arguments, or a site file without the truck's `[ros2]`. FailureError: nobody
    answers at an address in time, or a logger did not confirm all at the end.
    """
    check_rosbags()
    try:
        check_realm(realm)
    except ValueError as error:
        raise InputError(str(error)) from None
    known = load_site(site)
    vehicle = vehicle_of(known, str(site), vehicle)
    # It is counted as all else; the sensor's topic is free for another one.
    truck = Ros2Truck(known, str(site), vehicle, wrong_rate=lambda error: None)
    check_speaks_for(tls, "truck", vehicle)
    with stopped_by_signals() as stop, contextlib.ExitStack() as stack:
        ros_session = stack.enter_context(_open_ros(ros))
        if spool is None:
            bus: zenoh.Session | Connect = stack.enter_context(
                open_session(connect=endpoint, timeout_s=CONNECT_TIMEOUT_S, tls=tls)
            )
        else:
            bus = partial(open_session, connect=endpoint, timeout_s=0.0, tls=tls)
        spooled = None if spool is None else Spool(spool, budget_bytes=spool_budget_bytes)
        gateway = Gateway(bus, realm, vehicle, spooled)
        stack.callback(gateway.close)
        out = _Out(gateway, vehicle_toml(known, vehicle), truck)
        telling = _Telling(gateway, truck)
        with _Hearing(ros_session, truck) as hearing:
            ready()
            _hear(hearing, truck, out, telling, stop)
        for item in truck.finish():
            out.put(item)
        telling.tell(closing=True)
        confirm(gateway.delivery, out.sent)
        _log.info("%d messages of %s published in realm %s", out.sent, vehicle, realm)
    return 0


def _open_ros(ros: str) -> zenoh.Session:
    try:
        return open_session(connect=ros, timeout_s=CONNECT_TIMEOUT_S)
    except FailureError:
        raise FailureError(
            f"no router of ROS 2 answers at {ros} within {CONNECT_TIMEOUT_S:g} s; "
            "it is started by `ros2 run rmw_zenoh_cpp rmw_zenohd`"
        ) from None


def _hear(
    hearing: "_Hearing",
    truck: Ros2Truck,
    out: "_Out",
    telling: "_Telling",
    stop: threading.Event,
) -> None:
    told_s = time.monotonic()
    while not stop.is_set():
        has_heard = False
        for topic in truck.table.topics():
            for _ in range(_AT_ONCE):
                heard = hearing.next(topic)
                if heard is None:
                    break
                has_heard = True
                for item in hearing.taken(topic, heard):
                    out.put(item)
        if time.monotonic() >= told_s + _TELL_EVERY_S:
            told_s = time.monotonic()
            hearing.count_drops()
            telling.tell()
            hearing.tell_silence()
        if not has_heard:
            stop.wait(_PAUSE_S)
    hearing.count_drops()


class _Telling:
    """Logs what was left out, and publishes it as events."""

    def __init__(self, gateway: Gateway, truck: Ros2Truck) -> None:
        self._gateway = gateway
        self._truck = truck
        self._event_s = float("-inf")

    def tell(self, *, closing: bool = False) -> None:
        """Log a line for each kind with news; publish events if a minute has passed, or at last."""
        for line in self._truck.complaints.news():
            _log.warning("%s: %s", self._gateway.vehicle, line)
        now_s = time.monotonic()
        if not closing and now_s < self._event_s + _EVENT_EVERY_S:
            return
        for refusals in self._truck.complaints.refusals():
            # What finds no way now is in the counts of the next event.
            if self._publish(refusals):
                self._truck.complaints.reported(refusals.topic)
                self._event_s = now_s

    def _publish(self, refusals: Refusals) -> bool:
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


class _Out:
    """Publishes; what the truck is comes before all else that it says."""

    def __init__(self, gateway: Gateway, toml: str, truck: Ros2Truck) -> None:
        self.sent = 0
        self._gateway = gateway
        self._toml = toml
        self._complaints = truck.complaints
        self._gnss = truck.table.gnss
        self._topics = {name: imu.topic for name, imu in truck.table.imu.by_channel().items()}

    def put(self, item: Accel | GnssFix) -> None:
        """Publish an item; one that no message can hold is counted."""
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
        except ValueError as error:  # times of a stranger's clock
            if isinstance(item, GnssFix):
                topic = self._gnss
            else:
                topic = self._topics[next(iter(item.channels))]
            self._complaints.add(topic, UNPUBLISHED, example=one_line(str(error))[:200])


class _Heard(NamedTuple):
    """A message as it came: copied, as one of Zenoh's keeps the whole of what it came in."""

    key: str
    attachment: bytes | None
    payload: bytes


class _Hearing:
    """The subscriptions, and what is to be said of messages before they are looked into."""

    def __init__(self, session: zenoh.Session, truck: Ros2Truck) -> None:
        self._truck = truck
        self._waiting = {
            topic: BoundedQueue[_Heard](_WAITING, _WAITING_BYTES) for topic in truck.table.topics()
        }
        self._too_large: Counter[str] = Counter()
        """Written by Zenoh's threads."""
        self._counted_too_large: Counter[str] = Counter()
        self._subscribers: list[zenoh.Subscriber[None]] = []
        self._refused: set[str] = set()
        self._latest: dict[tuple[str, bytes], int] = {}
        """By topic and publisher: the number of its last message."""
        self._heard: set[str] = set()
        self._silent: set[str] = set()
        for topic in truck.table.topics():
            # By Zenoh's own thread: another one would need a queue before it, which has no bound in
            # bytes.
            receive = handlers.Callback(partial(self._receive, topic), indirect=False)
            where = key_expression(truck.table.domain, topic)
            self._subscribers.append(session.declare_subscriber(where, receive))

    def __enter__(self) -> "_Hearing":
        return self

    def __exit__(self, *_: object) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]

    def next(self, topic: str) -> _Heard | None:
        """Return the next message of a topic, or None if none waits."""
        return self._waiting[topic].get()

    def _receive(self, topic: str, sample: zenoh.Sample) -> None:
        """Keep a message that a sensor could have sent, in the thread that Zenoh receives in."""
        key = str(sample.key_expr)
        attached = sample.attachment
        size = len(key) + len(sample.payload) + (0 if attached is None else len(attached))
        if size > _MOST_BYTES:
            self._too_large[topic] += 1
            return
        attachment = None if attached is None else attached.to_bytes()
        heard = _Heard(key, attachment, sample.payload.to_bytes())
        self._waiting[topic].put(heard, size + _OVERHEAD_BYTES)

    def count_drops(self) -> None:
        """Count what came and was not kept since the last call."""
        complaints = self._truck.complaints
        for topic, waiting in self._waiting.items():
            dropped = waiting.dropped()
            complaints.add(topic, DROPPED, dropped.messages)
            too_large = self._too_large[topic]
            complaints.add(topic, TOO_LARGE, too_large - self._counted_too_large[topic])
            self._counted_too_large[topic] = too_large

    def taken(self, topic: str, heard: _Heard) -> list[Accel | GnssFix]:
        """Return what of a message can be published now."""
        complaints = self._truck.complaints
        try:
            name, told_hash = type_and_hash(heard.key)
            attachment = decode_attachment(heard.attachment)
        except ValueError as error:
            complaints.add(topic, UNREADABLE, example=f"the first {error}")
            return []
        of = next((one for one in self._truck.types(topic) if one.dds_name == name), None)
        if of is None:
            wanted = " or ".join(one.name for one in self._truck.types(topic))
            self._refuse(topic, f"is of {one_line(name[:80])}, {wanted} is expected; refused")
            return []
        problem = unknown_hash(of, told_hash)
        if problem is not None:
            self._refuse(topic, f"{one_line(problem)}; refused")
            return []
        self._heard.add(topic)
        if not self._is_next(topic, attachment.publisher, attachment.sequence):
            return []
        return self._truck.take(topic, of, heard.payload, attachment.sent_ns, attachment.publisher)

    def tell_silence(self) -> None:
        """Name the topics of which nothing has come since it was asked last, once."""
        for topic in self._truck.table.topics():
            if topic in self._heard:
                self._silent.discard(topic)
            elif topic not in self._silent:
                self._silent.add(topic)
                _log.warning(
                    "%s: nothing on %s in domain %d for %.0f s",
                    *(self._truck.table.vehicle, topic, self._truck.table.domain, _TELL_EVERY_S),
                )
        self._heard.clear()

    def _is_next(self, topic: str, publisher: bytes, sequence: int) -> bool:
        """Count what was lost on the way; False of what has come before."""
        complaints = self._truck.complaints
        name = (topic, publisher)
        before = self._latest.get(name)
        if before is not None and sequence <= before:
            complaints.add(topic, "messages that came again, left out")
            return False
        if before is not None:
            complaints.add(topic, "messages lost on the way", sequence - before - 1)
        elif len(self._latest) >= _MOST_PUBLISHERS:
            self._latest.clear()
        self._latest[name] = sequence
        return True

    def _refuse(self, topic: str, why: str) -> None:
        self._truck.complaints.add(topic, UNKNOWN_TYPE, example=f"the first {why}")
        line = f"{topic}: {why}"
        if line not in self._refused and len(self._refused) < _MOST_REFUSED:
            self._refused.add(line)
            _log.error("%s: %s", self._truck.table.vehicle, line)
