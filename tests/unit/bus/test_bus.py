"""The bus over real sessions in this process: identity, latching, fetching again, delivery."""

import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.signals import Identity
from schemas.topics import Key, selector
from services.bus import subscription as subscription_module
from services.bus.delivery import LINGER_S, DeliveryTracker
from services.bus.publisher import Publisher
from services.bus.session import open_session, wait_for_router
from services.bus.subscription import (
    RawSample,
    SeenSequences,
    Subscription,
    subscribe_latest,
)
from services.common.errors import FailureError, InputError
from tests.receiving import get_latest
from tests.slow_proxy import slow_proxy
from tests.waiting import LONGEST_S, until

ACCEL = Key("live", "vehicle", "truck-1", "accel")


def receive(subscription: Subscription, number: int) -> list[RawSample]:
    found: list[RawSample] = []
    deadline = time.monotonic() + LONGEST_S
    while len(found) < number and time.monotonic() < deadline:
        received = subscription.receive(0.1)
        if received is not None:
            found.append(received)
    return found


def put_all(publisher: Publisher, payloads: list[bytes]) -> None:
    for payload in payloads:
        publisher.put("vehicle", "truck-1", "accel", payload)


def test_messages_come_in_order_with_their_identity(
    router: zenoh.Session, client: zenoh.Session
) -> None:
    publisher = Publisher(client, "live", boot_id=5)
    with Subscription(router, selector("live", "vehicle")) as subscription:
        assert publisher.wait_for_subscriber("vehicle", "truck-1", "accel", LONGEST_S)
        payloads = [b"%d" % number for number in range(1000)]
        put_all(publisher, payloads)
        found = receive(subscription, 1000)
        assert [received.payload for received in found] == payloads
        assert [received.identity() for received in found] == [(5, n) for n in range(1000)]
        assert {received.key() for received in found} == {ACCEL}
        publisher.close()


def test_waiting_for_a_subscriber_ends(client: zenoh.Session) -> None:
    assert not Publisher(client, "live").wait_for_subscriber("vehicle", "truck-1", "accel", 0.2)


def test_late_subscriber_receives_earlier_messages(
    router: zenoh.Session, client: zenoh.Session
) -> None:
    publisher = Publisher(client, "live")
    put_all(publisher, [b"%d" % number for number in range(500)])
    with Subscription(router, selector(None, "vehicle")) as subscription:
        assert len(receive(subscription, 500)) == 500
    publisher.close()


def test_what_was_lost_is_fetched_again(
    router: zenoh.Session, client: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Samples vanish between Zenoh and us, as in the rare reconnection that loses a gap."""
    publisher = Publisher(client, "live", boot_id=1)
    with Subscription(router, selector("live", "vehicle")) as subscription:
        handler = subscription._handler
        vanishing = {3, 4, 5, 9}

        class Lossy:
            def try_recv(self) -> Any:
                sample = handler.try_recv()
                while sample is not None and sample.source_info.source_sn in vanishing:
                    vanishing.remove(sample.source_info.source_sn)
                    sample = handler.try_recv()
                return sample

        monkeypatch.setattr(subscription, "_handler", Lossy())
        publisher.declare("vehicle", "truck-1", "accel")
        put_all(publisher, [b"%d" % number for number in range(20)])
        found = receive(subscription, 20)
        assert not vanishing
        assert sorted(int(received.payload) for received in found) == list(range(20))
        late = [int(received.payload) for received in found if received.recovered]
        assert sorted(late) == [3, 4, 5, 9]
        assert subscription.fetched == 4
        assert {received.identity().boot_id for received in found} == {1}
    publisher.close()


def test_a_latched_topic_reaches_late_subscribers_and_answers_queries(
    router: zenoh.Session, client: zenoh.Session
) -> None:
    publisher = Publisher(client, "live")
    for number in range(3):
        publisher.put("bridge", "b-1", "state", b"%d" % number)
    publisher.put("bridge", "b-2", "state", b"other")
    states = selector("live", "bridge", "state")
    # The router hears of who answers, and that they left, when it hears of it.
    until(lambda: sorted(get_latest(router, states)) == [b"2", b"other"], "both states")
    assert get_latest(router, "driveby/v1/live/bridge/b-1/state") == [b"2"]
    with Subscription(router, selector("live", "bridge")) as subscription:
        assert sorted(received.payload for received in receive(subscription, 2)) == [b"2", b"other"]
    publisher.close()
    until(lambda: get_latest(router, states, timeout_s=1.0) == [], "silence")


def test_a_live_display_sees_the_newest_and_holds_nobody_up(
    router: zenoh.Session, client: zenoh.Session
) -> None:
    newest = subscribe_latest(router, selector("live", "vehicle"), capacity=10)
    assert next(newest) is None
    publisher = Publisher(client, "live")
    put_all(publisher, [b"%d" % number for number in range(2000)])
    deadline = time.monotonic() + LONGEST_S
    seen: list[bytes] = []
    while b"1999" not in seen and time.monotonic() < deadline:
        received = next(newest)
        if received is None:
            time.sleep(0.2)  # a slow display
        else:
            seen.append(received.payload)
    newest.close()  # type: ignore[attr-defined]
    publisher.close()
    assert seen[-1] == b"1999"
    assert len(seen) < 2000


def test_two_threads_may_publish(router: zenoh.Session, client: zenoh.Session) -> None:
    publisher = Publisher(client, "live")
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads take turns as often as they can
    with Subscription(router, selector("live", "vehicle")) as subscription:
        threads = [
            threading.Thread(target=put_all, args=(publisher, [b"x"] * 3000)) for _ in range(2)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        sys.setswitchinterval(before)
        found = receive(subscription, 6000)
        # Numbers follow each other on the wire, too: a reader may rely on the order.
        assert [received.identity().sequence for received in found] == list(range(6000))
    publisher.close()


def test_what_is_not_in_the_table_cannot_be_published(client: zenoh.Session) -> None:
    publisher = Publisher(client, "live")
    for owner, name, stream, payload in (
        ("vehicle", "truck-1", "speed", b""),
        ("vehicle", "../x", "accel", b""),
        ("vehicle", "truck-1", "alive", b""),
        ("vehicle", "truck-1", "gnss", b"\x00" * 5000),
    ):
        with pytest.raises(ValueError, match=r"topic|identifier|at most"):
            publisher.put(owner, name, stream, payload)
    publisher.close()


def durable(publisher: Publisher, number: int) -> None:
    message = pb.Durable(schema_version=1)
    message.streams.add(
        owner="vehicle", identifier="truck-1", stream="accel", boot_id=1, count=number
    )
    publisher.put("service", "logger", "durable", message.SerializeToString())


@pytest.fixture
def delivery(client: zenoh.Session) -> Iterator[DeliveryTracker]:
    delivery = DeliveryTracker(client, "live")
    for number in range(10):
        delivery.sent(ACCEL, Identity(1, number))
    yield delivery
    delivery.close()


def test_delivery_waits_until_everything_is_on_disk(
    router: zenoh.Session, delivery: DeliveryTracker
) -> None:
    logger = Publisher(router, "live")
    durable(logger, 4)
    output = threading.Event()

    def print_the_rest() -> None:
        output.set()
        durable(logger, 10)

    timer = threading.Timer(0.5, print_the_rest)
    timer.start()
    assert delivery.wait(LONGEST_S) == 0
    assert output.is_set()
    timer.join()
    logger.close()


def test_delivery_says_what_is_missing(router: zenoh.Session, delivery: DeliveryTracker) -> None:
    logger = Publisher(router, "live")
    durable(logger, 4)
    assert delivery.wait(LONGEST_S, most_missing=6) == 6
    assert delivery.has_logger
    assert delivery.wait(0.3) == 6
    logger.close()


def test_without_a_logger_delivery_only_lingers(delivery: DeliveryTracker) -> None:
    began = time.monotonic()
    assert delivery.wait(LONGEST_S) == 10
    assert LINGER_S <= time.monotonic() - began < LONGEST_S
    assert not delivery.has_logger


def test_nobody_answers(endpoint: str) -> None:
    with pytest.raises(FailureError, match=rf"^no router answers at {endpoint} within 0\.5 s"):
        open_session(connect=endpoint, timeout_s=0.5)


def test_router_that_answers_late_is_logged_once(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(wait_for_router, endpoint, None, lambda: False)
        until(lambda: bool(caplog.messages))
        with open_session(listen=endpoint):
            session = waiting.result(LONGEST_S)
            assert session is not None
            session.close()  # type: ignore[no-untyped-call]
    first, second = caplog.messages
    assert first.startswith(f"no router answers at {endpoint} ")
    assert second == f"{endpoint}: connected"


def test_client_connects_over_a_slow_link(router: zenoh.Session, endpoint: str) -> None:
    """And again after it was cut; a handshake over it takes more than a second."""
    with slow_proxy(endpoint, 0.3) as proxy:
        client = open_session(connect=proxy.endpoint, timeout_s=0.0)
        publisher = Publisher(client, "live")
        with Subscription(router, selector("live", "vehicle")) as subscription:
            put_all(publisher, [b"0"])
            receive(subscription, 1)
            proxy.cut()
            put_all(publisher, [b"1"])
            [found] = receive(subscription, 1)
            assert found.payload == b"1"
        publisher.close()
        client.close()


def test_a_client_pauses_between_attempts_to_reconnect() -> None:
    server = socket.create_server(("127.0.0.1", 0))
    endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
    server.close()
    router = open_session(listen=endpoint)
    client = open_session(connect=endpoint, timeout_s=LONGEST_S)
    router.close()
    attempts: list[float] = []
    with socket.create_server(("127.0.0.1", server_port(endpoint))) as refusing:
        refusing.settimeout(LONGEST_S)
        while len(attempts) < 5:
            refusing.accept()[0].close()
            attempts.append(time.monotonic())
    client.close()
    assert attempts[-1] - attempts[0] > 0.2


def server_port(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def test_the_address_is_taken(router: zenoh.Session, endpoint: str) -> None:
    with pytest.raises(FailureError, match=rf"^cannot listen at {endpoint}") as caught:
        open_session(listen=endpoint)
    assert "cargo" not in str(caught.value)


@pytest.mark.parametrize("endpoint", ["", "127.0.0.1:7447", "tcp/", "http/localhost:1", "tcp/a b"])
def test_malformed_endpoints(endpoint: str) -> None:
    with pytest.raises(InputError, match="PROTOCOL/HOST:PORT"):
        open_session(connect=endpoint, timeout_s=0.1)


def test_a_client_connects_again_by_itself(endpoint: str) -> None:
    """With a time limit on the first connection, too."""
    first = open_session(listen=endpoint)
    client = open_session(connect=endpoint, timeout_s=LONGEST_S)
    publisher = Publisher(client, "live")
    put_all(publisher, [b"0", b"1"])
    first.close()
    put_all(publisher, [b"2"])  # said to nobody
    with open_session(listen=endpoint) as second:
        with Subscription(second, selector("live", "vehicle")) as subscription:
            found = receive(subscription, 3)
            assert [received.payload for received in found] == [b"0", b"1", b"2"]
        publisher.close()
        client.close()


def test_seen_detects_duplicates_by_identity() -> None:
    seen = SeenSequences()
    assert seen.add(ACCEL, Identity(1, 0))
    assert not seen.add(ACCEL, Identity(1, 0))
    assert seen.add(ACCEL, Identity(2, 0))
    assert seen.add(ACCEL._replace(identifier="truck-2"), Identity(1, 0))
    assert seen.add(ACCEL._replace(realm="sim-a"), Identity(1, 0))


def test_made_up_publishers_take_bounded_memory(
    router: zenoh.Session, client: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subscription_module, "_MAX_SOURCES", 5)
    with Subscription(router, "driveby/v1/**") as subscription:
        for number in range(20):
            publisher = Publisher(client, "live")
            publisher.put("vehicle", f"truck-{number}", "accel", b"x")
            publisher.close()
        assert len(receive(subscription, 20)) == 20
        assert len(subscription._sources) == 5
