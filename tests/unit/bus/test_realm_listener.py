"""What a display hears: each message once, at nobody's cost, and who drives elsewhere."""

from collections.abc import Iterator

import pytest
import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.signals import Identity
from schemas.topics import key
from services.bus import liveness
from services.bus.publisher import Publisher
from services.bus.realm_listener import BusMessage, RealmListener, other_realms_hint
from services.bus.session import open_session
from services.bus.subscription import Subscription
from services.common.errors import InputError
from tests.endpoints import free_endpoint
from tests.receiving import several
from tests.waiting import until


@pytest.fixture
def publisher(client: zenoh.Session) -> Iterator[Publisher]:
    publisher = Publisher(client, "live")
    yield publisher
    publisher.close()


def gathered(listening: RealmListener, number: int) -> list[BusMessage]:
    found: list[BusMessage] = []
    until(lambda: found.extend(listening.heard()) or len(found) >= number, f"{number} messages")
    return found


def arrived(router: zenoh.Session, number: int) -> None:
    """Wait until so many messages are on no way any more: what is would come as if said now."""
    with Subscription(router, "driveby/v1/live/**") as subscription:
        several(subscription, number)


def test_each_message_once_with_what_was_before(
    router: zenoh.Session, publisher: Publisher
) -> None:
    for number in range(100):
        publisher.put("vehicle", "truck-1", "accel", b"%d" % number)
    before, now, last = (
        pb.BridgeState(finding="before").SerializeToString(),
        pb.Estimate(crossing_id="now").SerializeToString(),
        pb.Estimate(crossing_id="last").SerializeToString(),
    )
    alarm = pb.Alarm(bridge="b-1", text="stands").SerializeToString()
    publisher.put("bridge", "b-1", "state", before)
    publisher.put("bridge", "b-1", "alarm", alarm)
    arrived(router, 102)
    listening = RealmListener(router, "live", past_s=1.0)
    found = gathered(listening, 22)
    publisher.put("bridge", "b-1", "alarm", alarm[:-1], Identity(7, 3))
    publisher.put("bridge", "b-1", "estimate", now[:-1], Identity(7, 3))  # cut off in the middle
    publisher.put("bridge", "b-1", "estimate", now, Identity(7, 3))
    publisher.put("bridge", "b-1", "estimate", now, Identity(7, 3))  # as after a new start
    publisher.put("bridge", "b-1", "estimate", last)
    found += gathered(listening, 2)
    listening.close()
    assert [one.payload for one in found if one.key.stream == "accel"] == [
        b"%d" % number
        for number in range(80, 100)  # a second of what the truck still has
    ]
    published = [one.payload for one in found if one.key.owner == "bridge"]
    # Streams have an order each, and none among each other.
    assert sorted(published[:2]) == sorted([before, alarm])
    assert published[2:] == [now, last]


def test_idle_subscriber_delays_no_process(router: zenoh.Session, publisher: Publisher) -> None:
    listening = RealmListener(router, "live")
    assert list(listening.heard()) == []
    for number in range(30_000):  # more than may wait: a subscriber that keeps all would block
        publisher.put("vehicle", "truck-1", "accel", b"%d" % number)
    found: list[BusMessage] = []
    until(lambda: found.extend(listening.heard()) or (found and found[-1].payload == b"29999"))
    listening.close()
    assert len(found) < 30_000


def test_a_connection_that_brings_nothing_is_made_anew(
    router: zenoh.Session, publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(liveness, "_SILENCE_S", 0.0)
    endpoint = free_endpoint()
    with open_session(listen=endpoint), open_session(connect=endpoint) as deaf:
        asked: list[bool] = []
        listening = RealmListener(deaf, "live", reconnect=lambda: asked.append(True) or router)
        publisher.put("vehicle", "truck-1", "accel", b"missed")
        listening.alive.add("truck-1")  # and its leave is not heard either
        found = gathered(listening, 1)
        publisher.put("vehicle", "truck-1", "accel", b"now")
        found += gathered(listening, 1)
        listening.close()
    assert [one.payload for one in found] == [b"missed", b"now"]
    assert asked == [True]


def test_a_truck_that_drives_in_another_realm_is_named(
    router: zenoh.Session, client: zenoh.Session
) -> None:
    listening = RealmListener(router, "live")
    other = Publisher(client, "replay-monday")
    other.put("vehicle", "truck-7", "info", b"")
    token = client.liveliness().declare_token(key("sim-x", "vehicle", "truck-1", "alive"))
    until(lambda: list(listening.heard()) or len(listening.elsewhere) == 2, "both realms")
    assert other_realms_hint("live", listening.elsewhere) == (
        "nothing in realm live, but truck-7 in replay-monday and truck-1 in sim-x; "
        "use --realm replay-monday"
    )
    token.undeclare()
    until(lambda: list(listening.heard()) or "sim-x" not in listening.elsewhere, "its leave")
    here = client.liveliness().declare_token(key("live", "vehicle", "truck-2", "alive"))
    until(lambda: list(listening.heard()) or listening.alive == {"truck-2"}, "the one here")
    here.undeclare()
    until(lambda: list(listening.heard()) or not listening.alive, "its leave")
    other.close()
    listening.close()


def test_of_many_trucks_elsewhere_some_are_named() -> None:
    assert other_realms_hint("live", {}) is None
    trucks = {f"truck-{n}" for n in range(9)}
    assert other_realms_hint("live", {"sim-a": trucks}) == (
        "nothing in realm live, but truck-0, truck-1, truck-2 … in sim-a; use --realm sim-a"
    )


def test_a_realm_that_is_none(router: zenoh.Session) -> None:
    with pytest.raises(InputError, match="realm 'monday' must be live"):
        RealmListener(router, "monday")
