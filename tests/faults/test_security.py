"""Strangers and insiders who try more than they may, with real sessions on loopback.

Nobody here uses the checks that our own programs make before they connect: an intruder would not.
Each attempt that must fail is made once where it must succeed, so that a test which could not
notice anything would be found out.
"""

import json
import shutil
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh
from cryptography import x509

from schemas.topics import selector
from services.bus.credentials import CONFIGURATION, Subject, link_settings
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.common.errors import FailureError
from services.security import certs
from services.security.certs import certs_command
from services.security.settings import CertsSettings
from tests.endpoints import free_endpoint
from tests.intruders import V1, listen_to, put_all, raw_session, settle
from tests.receiving import get_latest
from tests.waiting import LONGEST_S, until

REFUSED_S = 2.0
"""How long a session may take to come about; one that may takes a tenth of it."""
ACCEL = f"{V1}/live/vehicle/truck-1/accel"
KEYS = (
    ACCEL,
    f"{V1}/live/vehicle/truck-1/info",
    f"{V1}/live/vehicle/truck-1/accel/@adv/pub/1/1/_",
    f"{V1}/live/vehicle/truck-2/accel",
    f"{V1}/live/vehicle/truck-2/accel/@adv/pub/1/1/_",
    f"{V1}/live/vehicle/truck-1/nonsense",
    f"{V1}/live/bridge/b-1/estimate",
    f"{V1}/live/bridge/b-1/state",
    f"{V1}/live/service/logger/durable",
    f"{V1}/live/service/logger/event",
    f"{V1}/live/service/worker/durable",
    f"{V1}/live/service/worker/progress",
    f"{V1}/replay-x/vehicle/truck-2/accel",
    f"{V1}/replay-x/service/logger/durable",
    "driveby/v2/live/vehicle/truck-1/accel",
    "something/else",
)
WIDE = (
    "**",
    f"{V1}/**",
    f"{V1}/live/vehicle/*/accel",
    f"{V1}/live/vehicle/truck-$*/accel",
    f"{V1}/live/*/truck-1/accel",
)
"""Key expressions: a put to one reaches every subscriber of a key that it matches."""
MAY_PUBLISH = {
    "truck-1": KEYS[:3],
    "viewer": (),
    "worker": (*KEYS[6:8], f"{V1}/live/service/worker/progress"),
    "replay": (f"{V1}/replay-x/vehicle/truck-2/accel",),
}
MAY_READ = {
    "truck-1": [key for key in KEYS if key.endswith("durable")],
    "viewer": (*KEYS[6:8], f"{V1}/live/service/worker/progress"),
    "worker": [
        k for k in KEYS if k.startswith(V1) and (k.endswith("durable") or "service" not in k)
    ],
}


@pytest.fixture
def endpoint(tls_endpoint: str) -> str:
    """Here everything speaks TLS."""
    return tls_endpoint


@pytest.fixture
def router(credentials: Path, endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(listen=endpoint, tls=credentials / "logger") as session:
        yield session


@pytest.fixture
def careless_router(credentials: Path, endpoint: str) -> Iterator[zenoh.Session]:
    """The negative control: as `router`, but everybody who is let in may do everything."""
    with raw_session(endpoint, credentials / "logger", listen=True) as session:
        yield session


@pytest.mark.parametrize("who", MAY_PUBLISH)
def test_everybody_publishes_only_their_own_keys(
    who: str, credentials: Path, router: zenoh.Session, endpoint: str
) -> None:
    heard = listen_to(router, ["**", "**/@adv/**"])
    with raw_session(endpoint, credentials / who) as session:
        put_all(session, [*WIDE, *KEYS])
    assert sorted(key for key, _ in heard) == sorted(MAY_PUBLISH[who])


def test_without_access_control_everything_would_be_heard(
    credentials: Path, careless_router: zenoh.Session, endpoint: str
) -> None:
    heard = listen_to(careless_router, ["**", "**/@adv/**"])
    with raw_session(endpoint, credentials / "viewer") as session:
        put_all(session, [*WIDE, *KEYS])
    assert {key for key, _ in heard} == {*WIDE, *KEYS}


@pytest.mark.parametrize("who", MAY_READ)
def test_everybody_reads_only_what_they_need(
    who: str, credentials: Path, router: zenoh.Session, endpoint: str
) -> None:
    assert published_and_asked_for(router, endpoint, credentials / who) == set(MAY_READ[who])


def test_without_access_control_everything_could_be_read(
    credentials: Path, careless_router: zenoh.Session, endpoint: str
) -> None:
    assert published_and_asked_for(careless_router, endpoint, credentials / "viewer") == set(KEYS)


def published_and_asked_for(router: zenoh.Session, endpoint: str, folder: Path) -> set[str]:
    """What somebody hears of what the router says, and what of it is answered: the same keys."""
    queryables = [
        router.declare_queryable(key, lambda query, key=key: query.reply(key, key.encode()))
        for key in KEYS
    ]
    with raw_session(endpoint, folder) as session:
        heard = listen_to(session, [*WIDE, *KEYS])
        settle(session)  # the router knows the subscriptions now
        for key in KEYS:
            router.put(key, key.encode(), congestion_control=zenoh.CongestionControl.BLOCK)
        answered = set()
        for key in [*WIDE, *KEYS]:
            for reply in session.get(key, target=zenoh.QueryTarget.ALL, timeout=LONGEST_S):
                if reply.ok is not None:
                    answered.add(str(reply.ok.key_expr))
        settle(session)
    for queryable in queryables:
        queryable.undeclare()
    assert {key for key, _ in heard} == answered
    return answered


def test_truck_cannot_announce_another_truck(
    credentials: Path, router: zenoh.Session, endpoint: str
) -> None:
    there: set[str] = set()
    router.liveliness().declare_subscriber(
        selector(None, "vehicle", "alive"), lambda token: there.add(str(token.key_expr))
    )
    with raw_session(endpoint, credentials / "truck-2") as session:
        session.liveliness().declare_token(f"{V1}/live/vehicle/truck-1/alive")
        session.liveliness().declare_token(f"{V1}/live/vehicle/truck-2/alive")
        settle(session)
        # Heard in a thread of Zenoh's, one after the other.
        until(lambda: f"{V1}/live/vehicle/truck-2/alive" in there, "its own")
        assert there == {f"{V1}/live/vehicle/truck-2/alive"}
    with raw_session(endpoint, credentials / "truck-1") as session:
        session.liveliness().declare_token(f"{V1}/live/vehicle/truck-1/alive")
        until(lambda: len(there) == 2, "the other's own")


def test_a_spool_is_answered_by_its_truck_alone_and_asked_by_no_other(
    credentials: Path, router: zenoh.Session, endpoint: str
) -> None:
    spool = f"{V1}/live/vehicle/truck-1/accel/spool"
    query = "?boot=1;from=0;to=9"

    def answers(session: zenoh.Session, key: str) -> list[bytes]:
        replies = session.get(
            key,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=LONGEST_S,
        )
        return sorted(reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None)

    with (
        raw_session(endpoint, credentials / "truck-1") as owner,
        raw_session(endpoint, credentials / "truck-2") as other,
    ):
        # The impostor also answers a query that is its own business with somebody else's data.
        impostor = [
            other.declare_queryable(spool, lambda q: q.reply(spool, b"impostor")),
            other.declare_queryable(
                f"{V1}/live/vehicle/truck-2/accel/spool", lambda q: q.reply(ACCEL, b"impostor")
            ),
        ]
        settle(other)
        assert answers(router, spool + query) == []
        assert answers(router, f"{V1}/live/vehicle/*/accel/spool") == []
        owner.declare_queryable(spool, lambda q: q.reply(spool, b"own"))
        settle(owner)
        assert answers(router, spool + query) == [b"own"]
        assert answers(router, f"{V1}/*/vehicle/*/*/spool") == [b"own"]
        for queryable in impostor:
            queryable.undeclare()  # or it would answer itself
        assert answers(other, spool + query) == []
        assert answers(other, f"{V1}/**") == []


def test_history_and_latched_topics_work_under_access_control(
    credentials: Path, router: zenoh.Session, endpoint: str
) -> None:
    """Late subscribers get all of a truck's history; a viewer gets the latest result, not more."""

    def history(session: zenoh.Session, key_expression: str, number: int) -> list[RawSample]:
        found: list[RawSample] = []
        with Subscription(session, key_expression) as subscription:
            settle(session)  # the other side knows of it, and what it had to say has been said
            deadline = time.monotonic() + LONGEST_S
            while time.monotonic() < deadline:
                received = subscription.receive(0.1)
                found += [received] if received is not None else []
                if len(found) >= number and (number or received is None):
                    break
        return found

    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S, tls=credentials / "truck-1") as truck,
        open_session(connect=endpoint, timeout_s=LONGEST_S, tls=credentials / "worker") as worker,
        open_session(connect=endpoint, timeout_s=LONGEST_S, tls=credentials / "viewer") as viewer,
    ):
        sensors, results = Publisher(truck, "live"), Publisher(worker, "live")
        logger = Publisher(router, "live")
        for number in range(200):
            sensors.put("vehicle", "truck-1", "accel", b"%d" % number)
        results.put("bridge", "b-1", "state", b"weak")
        logger.put("service", "logger", "durable", b"safe")
        vehicles, bridges = selector("live", "vehicle"), selector("live", "bridge")
        assert len(history(router, f"{V1}/**", 201)) == 201
        assert len(history(worker, vehicles, 200)) == 200
        assert [one.payload for one in history(viewer, bridges, 1)] == [b"weak"]
        states, written = (
            selector("live", "bridge", "state"),
            selector("live", "service", "durable"),
        )
        until(lambda: get_latest(viewer, states) == [b"weak"], "the state")
        until(lambda: get_latest(truck, written) == [b"safe"], "what is on disk")
        assert history(viewer, vehicles, 0) == []
        assert history(truck, bridges, 0) == []
        for publisher in (sensors, results, logger):
            publisher.close()


def test_a_gap_is_fetched_again_under_access_control(credentials: Path, endpoint: str) -> None:
    """The router goes away and another comes; what the truck said meanwhile is asked for."""
    first = open_session(listen=endpoint, tls=credentials / "logger")
    truck = open_session(connect=endpoint, timeout_s=LONGEST_S, tls=credentials / "truck-1")
    sensors = Publisher(truck, "live")
    for number in range(50):
        sensors.put("vehicle", "truck-1", "accel", b"%d" % number)
    first.close()
    for number in range(50, 100):  # said to nobody
        sensors.put("vehicle", "truck-1", "accel", b"%d" % number)
    payloads: set[bytes] = set()
    with (
        open_session(listen=endpoint, tls=credentials / "logger") as second,
        Subscription(second, f"{V1}/**") as subscription,
    ):
        deadline = time.monotonic() + LONGEST_S
        while len(payloads) < 100 and time.monotonic() < deadline:
            received = subscription.receive(0.1)
            if received is not None:
                payloads.add(received.payload)
        sensors.close()
        truck.close()
    assert payloads == {b"%d" % number for number in range(100)}


def opens(
    endpoint: str,
    folder: Path | None,
    settings: dict[str, object] | None = None,
    timeout_s: float = REFUSED_S,
) -> bool:
    """Whether a session comes about; an answer of no is shown to be one by a yes beside it.

    Who must be let in gets all the time that a slow machine needs for it.
    """
    try:
        raw_session(endpoint, folder, timeout_s=timeout_s, settings=settings).close()
    except zenoh.ZError:
        return False
    return True


def end_of_validity(certificate: Path) -> datetime:
    """The certificate's last valid second: certificates know whole seconds only."""
    return x509.load_pem_x509_certificate(certificate.read_bytes()).not_valid_after_utc


def test_strangers_are_not_let_in(
    credentials: Path, router: zenoh.Session, endpoint: str, tmp_path: Path
) -> None:
    foreign = tmp_path / "foreign"
    certs_command(CertsSettings(folder=foreign, trucks=["truck-1"]))
    trusting = tmp_path / "trusting"  # another authority's truck that believes our router
    shutil.copytree(foreign / "truck-1", trusting)
    shutil.copy(credentials / "truck-1" / "ca.pem", trusting)
    expired, renewed = (copied(credentials, tmp_path / name) for name in ("expired", "renewed"))
    certs_command(CertsSettings(folder=expired, renew=["truck-1"], days=0))
    certs_command(CertsSettings(folder=renewed, renew=["truck-1"], days=1))
    ended = end_of_validity(expired / "truck-1" / "cert.pem")
    until(lambda: datetime.now(UTC) > ended + timedelta(seconds=1), "the end of the certificate")
    believing: dict[str, object] = {
        "transport/link/tls": {"root_ca_certificate": str(credentials / "truck-1" / "ca.pem")}
    }
    attempts = {
        "ours": (endpoint, credentials / "truck-1", None, LONGEST_S),
        "ours, renewed": (endpoint, renewed / "truck-1", None, LONGEST_S),
        "expired": (endpoint, expired / "truck-1", None),
        "another authority's": (endpoint, trusting, None),
        "another authority's that does not believe ours": (endpoint, foreign / "truck-1", None),
        "no certificate": (endpoint, None, believing),
        "no TLS": (endpoint.replace("tls/", "tcp/"), None, None),
    }
    with ThreadPoolExecutor(len(attempts)) as pool:
        opened = dict(zip(attempts, pool.map(lambda a: opens(*a), attempts.values()), strict=True))
    assert [name for name, is_open in opened.items() if is_open] == ["ours", "ours, renewed"]
    assert opens(endpoint, credentials / "truck-2", None, LONGEST_S), "the router survives them all"


def copied(credentials: Path, target: Path) -> Path:
    shutil.copytree(credentials, target)
    return target


@pytest.mark.faults
@pytest.mark.parametrize("names_the_host", [False, True])
def test_a_truck_cannot_pose_as_the_router(
    credentials: Path,
    endpoint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    names_the_host: bool,
) -> None:
    """Two things keep it from that: its certificate names no host, and is not one for servers."""
    copy = copied(credentials, tmp_path / "pose")
    if names_the_host:
        real = certs._alternative_names
        monkeypatch.setattr(
            certs, "_alternative_names", lambda subject, _: real(subject, certs.LOCAL_HOSTS)
        )
        certs_command(CertsSettings(folder=copy, renew=["truck-1"]))
    victim = credentials / "truck-2"
    with raw_session(endpoint, copy / "truck-1", listen=True):
        assert not opens(endpoint, victim)
        with pytest.raises(FailureError, match="its certificate is not that of a router or logger"):
            open_session(connect=endpoint, timeout_s=0.1, tls=victim)
    with raw_session(endpoint, credentials / "router", listen=True):
        assert opens(endpoint, victim, None, LONGEST_S)


@pytest.mark.faults
def test_a_router_of_another_name_is_not_believed(
    credentials: Path, endpoint: str, tmp_path: Path
) -> None:
    """The certificate names 127.0.0.1; here it is reached as 127.0.0.2, which it does not name."""
    elsewhere = endpoint.replace("127.0.0.1", "127.0.0.2")
    with raw_session(elsewhere, credentials / "logger", listen=True):
        assert not opens(elsewhere, credentials / "truck-1")
    copy = copied(credentials, tmp_path / "named")
    certs_command(CertsSettings(folder=copy, renew=["logger"], host=["127.0.0.2"]))
    with raw_session(elsewhere, copy / "logger", listen=True):
        assert opens(elsewhere, credentials / "truck-1", None, LONGEST_S)


def test_a_revoked_truck_says_nothing(credentials: Path, endpoint: str, tmp_path: Path) -> None:
    """Its key still opens a connection, for Zenoh knows no list of revoked certificates."""
    copy = copied(credentials, tmp_path / "revoked")
    certs_command(CertsSettings(folder=copy, revoke=["truck-1"]))
    with open_session(listen=endpoint, tls=copy / "logger") as router:
        heard = listen_to(router, ["**"])
        for name in ("truck-1", "truck-2"):
            with raw_session(endpoint, credentials / name) as session:
                put_all(session, [f"{V1}/live/vehicle/{name}/accel"])
    assert [key for key, _ in heard] == [f"{V1}/live/vehicle/truck-2/accel"]


def test_a_router_between_trucks_and_logger_filters_both(credentials: Path, endpoint: str) -> None:
    """As in compose.yaml: a router of Zenoh's own, made from its ready-made configuration."""
    own = free_endpoint("tls")
    config = zenoh.Config.from_file(credentials / "router" / CONFIGURATION)
    for name, value in link_settings(credentials / "router").items():
        config.insert_json5(f"transport/link/{name}", json.dumps(value))
    config.insert_json5("listen/endpoints", json.dumps([own]))
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with (
        open_session(listen=endpoint, tls=credentials / "logger") as logger,
        zenoh.open(config) as router,
        open_session(connect=own, timeout_s=LONGEST_S, tls=credentials / "truck-1") as truck,
    ):
        del router
        sensors = Publisher(truck, "live")
        for number in range(100):
            sensors.put("vehicle", "truck-1", "accel", b"%d" % number)
        truck.put(f"{V1}/live/vehicle/truck-2/accel", b"impostor")
        with Subscription(logger, f"{V1}/**") as subscription:
            truck.put(f"{V1}/live/vehicle/truck-2/accel", b"impostor")
            found = set()
            deadline = time.monotonic() + LONGEST_S
            while len(found) < 100 and time.monotonic() < deadline:
                received = subscription.receive(0.1)
                if received is not None:
                    found.add((received.key_text, received.payload))
        assert found == {(ACCEL, b"%d" % number) for number in range(100)}
        announcements = Publisher(logger, "live")
        announcements.put("service", "logger", "durable", b"safe")
        written = selector("live", "service", "durable")
        until(lambda: get_latest(truck, written) == [b"safe"], "what is on disk")
        # The logger says nothing in a truck's name, not even from inside its own process.
        heard = listen_to(truck, [f"{V1}/live/service/logger/durable"])

        def is_heard() -> bool:
            # Until the router has passed the subscription on, messages reach nobody.
            logger.put(f"{V1}/live/service/worker/durable", b"impostor")
            logger.put(f"{V1}/live/service/logger/durable", b"safe")
            return bool(heard)

        until(is_heard, "a message of the logger")
        settle(truck)
        assert {payload for _, payload in heard} == {b"safe"}
        sensors.close()
        announcements.close()


@pytest.mark.faults
def test_a_link_ends_when_its_certificate_expires(
    credentials: Path, router: zenoh.Session, endpoint: str, tmp_path: Path
) -> None:
    for seconds in (4, 16, 64, 256):  # a busy machine takes longer to connect
        copy = copied(credentials, tmp_path / f"for-{seconds}-s")
        authority = certs._existing(copy)
        assert authority is not None
        subject, days = Subject("truck", "truck-1"), seconds / 86400
        certs._issue(copy, authority, authority.key(), subject, (), days=days)
        try:
            session = raw_session(endpoint, copy / "truck-1", timeout_s=seconds)
        except zenoh.ZError:
            continue
        with session:
            if list(session.info.routers_zid()):
                until(lambda of=session: not list(of.info.routers_zid()), "the end of the link")
                break
    else:
        pytest.fail("no session was open before its certificate expired")
    with raw_session(endpoint, credentials / "truck-1") as session:
        assert len(list(session.info.routers_zid())) == 1


@pytest.mark.faults
def test_noise_at_the_port_does_not_disturb_open_sessions(
    credentials: Path, router: zenoh.Session, endpoint: str
) -> None:
    """Whoever comes anew waits, for Zenoh rests a moment after each handshake that fails."""
    heard = listen_to(router, [ACCEL])
    host, port = endpoint.removeprefix("tls/").split(":")
    failing = 20
    with raw_session(endpoint, credentials / "truck-1") as truck:
        for _ in range(failing):
            with socket.create_connection((host, int(port))) as stranger:
                stranger.sendall(b"\x16\x03\x01 no handshake" * 100)
            put_all(truck, [ACCEL] * 5)
        assert len(heard) == 5 * failing
        began = time.monotonic()
        with raw_session(endpoint, credentials / "truck-2", timeout_s=LONGEST_S) as late:
            put_all(late, [f"{V1}/live/vehicle/truck-2/accel"])
        delay_s = time.monotonic() - began
    print(f"{failing} handshakes that failed held up the next connection by {delay_s:.1f} s")
