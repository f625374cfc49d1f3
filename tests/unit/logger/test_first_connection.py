"""A logger at another address than its trucks use looks like one without trucks."""

import logging
import time

import pytest

from services.bus.session import open_session
from services.logger.first_connection import FirstConnection
from tests.waiting import LONGEST_S


def test_missing_connection_is_logged_once_with_the_address(
    endpoint: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with open_session(listen=endpoint) as router:
        first = FirstConnection(router, endpoint)
        first.log(time.monotonic())
        assert not caplog.messages
        later_s = time.monotonic() + 60.0
        first.log(later_s)
        first.log(later_s)
        with open_session(connect=endpoint, timeout_s=LONGEST_S):
            until_s = time.monotonic() + LONGEST_S
            while len(caplog.messages) < 2 and time.monotonic() < until_s:
                first.log(later_s)
        first.log(later_s)
    assert caplog.messages == [
        f"{endpoint}: nothing has connected yet; trucks and worker need this address (--endpoint)",
        f"{endpoint}: connected",
    ]
    assert [one.levelname for one in caplog.records] == ["WARNING", "INFO"]
