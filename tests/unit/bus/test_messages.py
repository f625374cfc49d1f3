"""Decoded messages for subscribers outside the program, and why none come."""

import logging
from pathlib import Path

import pytest

from services.bus import messages
from services.bus.messages import subscribe
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.common.errors import InputError


def test_expression_wider_than_the_rights_is_refused_with_one_line(credentials: Path) -> None:
    with pytest.raises(InputError) as caught:
        next(subscribe("tls/127.0.0.1:1", "driveby/v1/**", tls=credentials / "viewer"))
    assert str(caught.value) == (
        "key expression 'driveby/v1/**': is wider than the rights of viewer/viewer, so that "
        "nothing would be received; a part of one of driveby/v1/*/bridge/**, "
        "driveby/v1/*/service/*/health, driveby/v1/*/service/*/progress is expected"
    )


def test_malformed_expression_is_refused_with_one_line() -> None:
    with pytest.raises(InputError, match=r"^key expression 'driveby//x': is malformed"):
        next(subscribe("tcp/127.0.0.1:1", "driveby//x"))


def test_malformed_messages_are_left_out(endpoint: str) -> None:
    with open_session(listen=endpoint) as session:
        publisher = Publisher(session, "live")
        publisher.put("bridge", "b-1", "state", b"no message")
        publisher.put("bridge", "b-2", "state", b"")
        received = subscribe(endpoint, "driveby/v1/*/bridge/**")
        key, message = next(received)
        received.close()
        publisher.close()
    assert (key.identifier, message.DESCRIPTOR.full_name) == ("b-2", "driveby.v1.BridgeState")


@pytest.mark.parametrize("is_secured", [False, True])
def test_silence_is_explained_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    credentials: Path,
    endpoint: str,
    tls_endpoint: str,
    is_secured: bool,
) -> None:
    where, listener, viewer = endpoint, None, None
    if is_secured:
        where, listener, viewer = tls_endpoint, credentials / "logger", credentials / "viewer"
    monkeypatch.setattr(messages, "_SILENCE_S", 0.0)
    with open_session(listen=where, tls=listener) as session, caplog.at_level(logging.WARNING):
        publisher = Publisher(session, "live")

        class Published(logging.Handler):
            """What is published once the line is there ends the test."""

            def emit(self, record: logging.LogRecord) -> None:
                publisher.put("service", "logger", "health", b"")

        handler = Published()
        messages._log.addHandler(handler)
        try:
            received = subscribe(where, "driveby/v1/*/service/*/health", tls=viewer)
            next(received)
            received.close()
        finally:
            messages._log.removeHandler(handler)
            publisher.close()
    (line,) = caplog.messages
    assert line.startswith(
        f"nothing received for 0 s on driveby/v1/*/service/*/health at {where}: "
        "nothing is published there"
    )
    assert (
        line.endswith("lacks viewer/viewer, which is new or revoked, see docs/security.md#changes")
        == is_secured
    )
