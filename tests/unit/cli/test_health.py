"""`driveby health` of a service that does not answer."""

import pytest

from services.bus.session import open_session
from services.cli.health import health_command
from services.common.errors import FailureError


def test_silent_service_is_named_with_its_realm(endpoint: str) -> None:
    with open_session(listen=endpoint), pytest.raises(FailureError) as caught:
        health_command(service="logger", endpoint=endpoint, tls=None, realm="sim-a", patience_s=0.5)
    assert str(caught.value) == (
        f"logger in realm sim-a sends nothing at {endpoint}; --realm NAME asks another"
    )
