"""`driveby health` of a service that does not answer."""

import time

import pytest

from schemas.proto import driveby_pb2 as pb
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.cli.health import health_command
from services.common.errors import FailureError


def test_silent_service_is_named_with_its_realm(endpoint: str) -> None:
    with open_session(listen=endpoint), pytest.raises(FailureError) as caught:
        health_command(service="logger", endpoint=endpoint, tls=None, realm="sim-a", patience_s=0.5)
    assert str(caught.value) == (
        f"logger in realm sim-a sends nothing at {endpoint}; --realm NAME asks another"
    )


def test_clock_of_a_service_that_is_ahead_is_reported(endpoint: str) -> None:
    with open_session(listen=endpoint) as session:
        publisher = Publisher(session, "live")
        sent = pb.Health(schema_version=1, service="logger", ok=True, note="disk", figures={})
        sent.time_ns = time.time_ns() + 3600 * 10**9
        publisher.put("service", "logger", "health", sent.SerializeToString())
        line = health_command(service="logger", endpoint=endpoint, tls=None, realm="live")
        publisher.close()
    start, clock = line.rsplit("; ", 1)
    assert start == "logger in realm live is well, 0 s ago; disk"
    assert clock.startswith("its clock is 3")
    assert clock.endswith(" s ahead of this machine's")
