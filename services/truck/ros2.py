"""A gateway for trucks that speak ROS 2: from their Zenoh router to ours.

It is a client of both. What it hears of the topics in the site file's `[ros2]` becomes batches and
fixes (`services.drives.ros2_truck`), which a `Gateway` publishes as any truck's.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import zenoh
from zenoh import handlers

from schemas.signals import GnssFix
from schemas.site_file import load_site, vehicle_toml
from schemas.topics import check_realm
from services.bus.credentials import check_speaks_for
from services.bus.playback import confirm, stopped_by_signals
from services.bus.session import open_session
from services.common.errors import FailureError, InputError, one_line
from services.drives.importing import vehicle_of
from services.drives.ros2_messages import check_rosbags, unknown_hash
from services.drives.ros2_truck import Accel, Ros2Truck
from services.truck.gateway import Connect, Gateway
from services.truck.rmw_zenoh import decode_attachment, key_expression, type_and_hash
from services.truck.spool import DEFAULT_BUDGET_BYTES, Spool

_log = logging.getLogger(__name__)
CONNECT_TIMEOUT_S: Final = 10.0
"""A router that was started a moment before is there by then."""
_WAITING: Final = 20_000
"""Messages of a topic: more than ten seconds of the fastest. Beyond it the oldest are dropped,
which their numbers show; nobody at the ROS router is held up."""
_AT_ONCE: Final = 50
"""Of a topic, before another one has its turn."""
_PAUSE_S: Final = 0.005
_TELL_EVERY_S: Final = 10.0
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

    `site` names the topics (`[ros2]`); `vehicle` chooses one of several trucks. With a folder
    `spool` messages go to disk there first, and our router may come later (see `services.truck`);
    that of ROS must be there. `ready` is called when all topics are subscribed to.

    InputError: bad arguments, a site file without the truck's `[ros2]`, or a topic whose rate is
    not the one that the site file declares. FailureError: nobody answers at an address in time, or
    a logger did not confirm all at the end.
    """
    check_rosbags()
    try:
        check_realm(realm)
    except ValueError as error:
        raise InputError(str(error)) from None
    known = load_site(site)
    vehicle = vehicle_of(known, str(site), vehicle)
    truck = Ros2Truck(known, str(site), vehicle)
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
        out = _Out(gateway, vehicle_toml(known, vehicle))
        hearing = stack.enter_context(_Hearing(ros_session, truck))
        ready()
        _hear(hearing, truck, out, stop)
        for item in truck.finish():
            out.put(item)
        _tell(truck, vehicle)
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


def _hear(hearing: "_Hearing", truck: Ros2Truck, out: "_Out", stop: threading.Event) -> None:
    told_s = time.monotonic()
    while not stop.is_set():
        heard = False
        for topic in truck.table.topics():
            for _ in range(_AT_ONCE):
                sample = hearing.next(topic)
                if sample is None:
                    break
                heard = True
                for item in hearing.taken(topic, sample):
                    out.put(item)
        if time.monotonic() >= told_s + _TELL_EVERY_S:
            told_s = time.monotonic()
            _tell(truck, truck.table.vehicle)
            hearing.tell_silence()
        if not heard:
            stop.wait(_PAUSE_S)


def _tell(truck: Ros2Truck, vehicle: str) -> None:
    for line in truck.complaints.news():
        _log.warning("%s: %s", vehicle, line)


class _Out:
    """Publishes; what the truck is comes before all else that it says."""

    def __init__(self, gateway: Gateway, toml: str) -> None:
        self.sent = 0
        self._gateway = gateway
        self._toml = toml

    def put(self, item: Accel | GnssFix) -> None:
        times = {"device_time_ns": item.device_time_ns, "wall_time_ns": item.wall_time_ns}
        if not self.sent:
            self._gateway.info(self._toml, **times)
            self.sent = 1
        if isinstance(item, GnssFix):
            self._gateway.gnss(item)
            self.sent += 2
        else:
            self._gateway.accel(item.channels, **times)
            self.sent += 1


class _Hearing:
    """The subscriptions, and what is to be said of messages before they are looked into."""

    def __init__(self, session: zenoh.Session, truck: Ros2Truck) -> None:
        self._truck = truck
        self._subscribers: dict[str, Any] = {}
        self._refused: set[str] = set()
        self._latest: dict[tuple[str, bytes], int] = {}
        """By topic and publisher: the number of its last message."""
        self._heard: set[str] = set()
        self._silent: set[str] = set()
        for topic in truck.table.topics():
            where = key_expression(truck.table.domain, topic)
            self._subscribers[topic] = session.declare_subscriber(
                where, handlers.RingChannel(_WAITING)
            )

    def __enter__(self) -> "_Hearing":
        return self

    def __exit__(self, *_: object) -> None:
        for subscriber in self._subscribers.values():
            subscriber.undeclare()

    def next(self, topic: str) -> zenoh.Sample | None:
        """A message of a topic, if one has come."""
        sample: zenoh.Sample | None = self._subscribers[topic].handler.try_recv()
        return sample

    def taken(self, topic: str, sample: zenoh.Sample) -> list[Accel | GnssFix]:
        """What of it can be published now; InputError as `Ros2Truck.take`."""
        complaints = self._truck.complaints
        try:
            name, told_hash = type_and_hash(str(sample.key_expr))
            attached = sample.attachment
            attachment = decode_attachment(None if attached is None else attached.to_bytes())
        except ValueError as error:
            complaints.add(topic, "messages left out", example=f"the first {error}")
            return []
        of = next((one for one in self._truck.types(topic) if one.dds_name == name), None)
        if of is None:
            wanted = " or ".join(one.name for one in self._truck.types(topic))
            self._refuse(f"{topic}: is of {one_line(name[:80])}, {wanted} is expected; refused")
            return []
        problem = unknown_hash(of, told_hash)
        if problem is not None:
            self._refuse(f"{topic}: {one_line(problem)}; refused")
            return []
        self._heard.add(topic)
        if not self._is_next(topic, attachment.publisher, attachment.sequence):
            return []
        payload = sample.payload.to_bytes()
        return self._truck.take(topic, of, payload, attachment.sent_ns, attachment.publisher)

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

    def _refuse(self, line: str) -> None:
        if line not in self._refused and len(self._refused) < _MOST_REFUSED:
            self._refused.add(line)
            _log.error("%s: %s", self._truck.table.vehicle, line)
