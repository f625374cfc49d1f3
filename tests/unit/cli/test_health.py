"""`driveby health` of a service that does not answer."""

import socket
import time
from pathlib import Path

import pytest

from schemas.proto import driveby_pb2 as pb
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.cli.health import health_command
from services.common.errors import FailureError
from tests.waiting import until


def test_silent_service_is_named_with_its_realm(endpoint: str) -> None:
    with open_session(listen=endpoint), pytest.raises(FailureError) as caught:
        health_command(service="logger", endpoint=endpoint, tls=None, realm="sim-a", patience_s=0.5)
    assert str(caught.value) == (
        f"logger in realm sim-a sends nothing at {endpoint}; it was not started or has ended, or "
        "it is in another realm (--realm NAME; live for a logger of several realms)"
    )


def test_unreachable_address_names_the_option_for_another(endpoint: str) -> None:
    with pytest.raises(FailureError) as caught:
        health_command(service="logger", endpoint=endpoint, tls=None, realm="live", patience_s=0.5)
    assert str(caught.value) == (
        f"no router answers at {endpoint} within 0.5 s; start `driveby logger` first or give its "
        "address with --endpoint"
    )


def test_frozen_router_is_named_within_the_patience() -> None:
    """Zenoh alone would wait for 10 s, once or more often."""
    with socket.create_server(("127.0.0.1", 0)) as frozen:
        endpoint = f"tcp/127.0.0.1:{frozen.getsockname()[1]}"
        began_s = time.monotonic()
        with pytest.raises(FailureError, match="accepts connections and answers none"):
            health_command(
                service="logger", endpoint=endpoint, tls=None, realm="live", patience_s=0.5
            )
        assert time.monotonic() - began_s < 9.0


def test_silence_with_credentials_names_the_list(credentials: Path, tls_endpoint: str) -> None:
    tls = credentials / "viewer"
    with (
        open_session(listen=tls_endpoint, tls=credentials / "logger"),
        pytest.raises(FailureError, match="or the router's list of participants lacks viewer/vie"),
    ):
        health_command(
            service="logger", endpoint=tls_endpoint, tls=tls, realm="live", patience_s=0.5
        )


def test_silence_with_credentials_of_a_truck_names_its_role(
    credentials: Path, tls_endpoint: str
) -> None:
    with (
        open_session(listen=tls_endpoint, tls=credentials / "logger"),
        pytest.raises(FailureError, match="; truck/truck-1 may not read it; use the credentials"),
    ):
        health_command(
            service="logger",
            endpoint=tls_endpoint,
            tls=credentials / "truck-1",
            realm="live",
            patience_s=0.5,
        )


def test_service_that_has_ended_is_not_well(endpoint: str) -> None:
    with open_session(listen=endpoint) as session:
        publisher = Publisher(session, "live")
        sent = pb.Health(schema_version=1, service="logger", ok=True, ended=True)
        sent.time_ns = time.time_ns()
        publisher.put("service", "logger", "health", sent.SerializeToString())
        with pytest.raises(FailureError, match="logger in realm live has ended"):
            health_command(service="logger", endpoint=endpoint, tls=None, realm="live")
        publisher.close()


def test_clock_of_a_service_that_is_ahead_is_reported(endpoint: str) -> None:
    with open_session(listen=endpoint) as session:
        publisher = Publisher(session, "live")
        sent = pb.Health(schema_version=1, service="logger", ok=True, note="disk", figures={})
        sent.time_ns = time.time_ns() + 3600 * 10**9
        publisher.put("service", "logger", "health", sent.SerializeToString())
        line = health_command(service="logger", endpoint=endpoint, tls=None, realm="live")
        publisher.close()
    start, clock = line.rsplit("; ", 1)
    assert start == "logger in realm live is well (health sent 0 s ago); disk"
    assert clock.startswith("its clock is 3")
    assert clock.endswith(" s ahead of this machine's")


def test_silent_service_is_found_in_its_own_realm(endpoint: str) -> None:
    """A logger of several realms, or of a pattern, publishes its health in realm live."""
    with open_session(listen=endpoint) as session:
        publisher = Publisher(session, "live")
        sent = pb.Health(schema_version=1, service="logger", ok=True, time_ns=time.time_ns())
        publisher.put("service", "logger", "health", sent.SerializeToString())
        with pytest.raises(FailureError) as caught:
            health_command(
                service="logger", endpoint=endpoint, tls=None, realm="sim-two", patience_s=0.5
            )
        publisher.close()
    assert str(caught.value) == (
        f"logger in realm sim-two sends nothing at {endpoint}; it answers with --realm live"
    )


def test_services_of_one_name_are_counted(endpoint: str) -> None:
    with (
        open_session(listen=endpoint),
        open_session(connect=endpoint) as first,
        open_session(connect=endpoint) as second,
    ):
        publishers = [Publisher(session, "live") for session in (first, second)]

        def line() -> str:
            return health_command(service="worker", endpoint=endpoint, tls=None, realm="live")

        def declare(publisher: Publisher) -> None:
            sent = pb.Health(schema_version=1, service="worker", ok=True, time_ns=time.time_ns())
            publisher.put("service", "worker", "health", sent.SerializeToString())

        declare(publishers[0])
        alone = line()
        declare(publishers[1])
        # The router learns of a publisher when its declaration arrives, and each client again.
        lines = [alone]

        def are_both_counted() -> bool:
            lines.append(line())
            return ";" in lines[-1]

        until(are_both_counted)
        for publisher in publishers:
            publisher.close()
    assert alone == "worker in realm live is well (health sent 0 s ago)"
    assert (
        lines[-1].partition(";")[2] == " one of 2 services of this name; give each one another --id"
    )
