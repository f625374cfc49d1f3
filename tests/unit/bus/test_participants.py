"""Certificates that a router's access control ignores, seen from both ends of a link."""

import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from schemas.topics import Key, selector
from services.bus.participants import SubscriberCheck, UnlistedParticipants
from services.bus.session import listed_participants, open_session
from services.security.certs import certs_command
from services.security.settings import CertsSettings
from tests.intruders import raw_session
from tests.waiting import LONGEST_S, until

TRUCK = Key("live", "vehicle", "truck-1", "accel")
LACKS = (
    "its list of participants lacks this certificate, which is new or revoked, see "
    "docs/security.md#changes"
)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def lacking(credentials: Path, tmp_path: Path) -> Path:
    """Credentials whose lists lack truck-1, which has its folder all the same."""
    shutil.copytree(credentials, tmp_path / "lacking")
    certs_command(CertsSettings(folder=tmp_path / "lacking", revoke=["truck-1"]))
    return tmp_path / "lacking"


def router(stack: ExitStack, endpoint: str, folder: Path | None, realm: str | None) -> None:
    session = stack.enter_context(open_session(listen=endpoint, tls=folder))
    if realm is not None:
        kept = session.declare_subscriber(selector(realm, "vehicle"))
        stack.callback(kept.undeclare)


def checked(stack: ExitStack, endpoint: str, folder: Path | None) -> SubscriberCheck:
    session = open_session(connect=endpoint, timeout_s=LONGEST_S, tls=folder)
    check = SubscriberCheck(stack.enter_context(session), TRUCK)
    stack.callback(check.close)
    return check


def expect(check: SubscriberCheck, complaint: str | None) -> None:
    """Subscribers become known a moment after the connection."""
    until(lambda: check.complaint() == complaint, f"complaint {complaint}")


def test_unlisted_truck_is_named_by_its_check(
    stack: ExitStack, lacking: Path, tls_endpoint: str
) -> None:
    router(stack, tls_endpoint, lacking / "logger", "live")
    check = checked(stack, tls_endpoint, lacking / "truck-1")
    expect(check, f"nothing at logger/logger subscribes to truck-1: {LACKS}")


def test_listed_truck_with_a_subscriber_has_no_complaint(
    stack: ExitStack, credentials: Path, tls_endpoint: str
) -> None:
    router(stack, tls_endpoint, credentials / "logger", "live")
    expect(checked(stack, tls_endpoint, credentials / "truck-1"), None)


def test_subscriber_of_another_realm_is_named(
    stack: ExitStack, credentials: Path, tls_endpoint: str
) -> None:
    router(stack, tls_endpoint, credentials / "logger", "sim-*")
    check = checked(stack, tls_endpoint, credentials / "truck-1")
    expect(check, "nothing subscribes to truck-1 in realm live, only in others (--realm)")


def test_without_certificates_the_logger_is_missing(stack: ExitStack, endpoint: str) -> None:
    router(stack, endpoint, None, None)
    check = checked(stack, endpoint, None)
    expect(check, "nothing subscribes to truck-1 in realm live; start `driveby logger`")


def test_router_without_a_logger_may_lack_either(
    stack: ExitStack, lacking: Path, tls_endpoint: str
) -> None:
    access = zenoh.Config.from_file(lacking / "router" / "zenoh.json5").get_json("access_control")
    settings: dict[str, object] = {"access_control": json.loads(access)}
    stack.enter_context(
        raw_session(tls_endpoint, lacking / "router", listen=True, settings=settings)
    )
    check = checked(stack, tls_endpoint, lacking / "truck-1")
    lacks = "nothing at router/router subscribes to truck-1: no logger is connected to it, or "
    expect(check, lacks + LACKS)


def test_lost_connection_is_no_complaint(lacking: Path, tls_endpoint: str) -> None:
    with ExitStack() as stack:
        with ExitStack() as there:
            router(there, tls_endpoint, lacking / "logger", "live")
            check = checked(stack, tls_endpoint, lacking / "truck-1")
            assert check.complaint() is not None
        until(lambda: check.complaint() is None, "the end of the link")


def test_router_sees_unlisted_certificates_come_and_go(
    stack: ExitStack, lacking: Path, tls_endpoint: str
) -> None:
    session = stack.enter_context(open_session(listen=tls_endpoint, tls=lacking / "logger"))
    watch = UnlistedParticipants(session, listed_participants(lacking / "logger"))
    stack.callback(watch.close)
    come: list[str] = []

    def connected() -> list[str]:
        come.extend(watch.arrivals())
        return watch.connected

    with open_session(connect=tls_endpoint, timeout_s=LONGEST_S, tls=lacking / "truck-2"):
        for _ in range(2):
            with open_session(connect=tls_endpoint, timeout_s=LONGEST_S, tls=lacking / "truck-1"):
                until(connected, "the truck")
                assert watch.connected == ["truck/truck-1"]
            until(lambda: not connected(), "its end")
    assert come == ["truck/truck-1", "truck/truck-1"]
