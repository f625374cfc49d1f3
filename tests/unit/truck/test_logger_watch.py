"""A truck's log when its router or logger leaves during a drive, and when it is back."""

import contextlib
import logging
from functools import partial
from pathlib import Path

import pytest
import zenoh

from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.truck.gateway import Gateway
from services.truck.spool import Spool
from tests.waiting import LONGEST_S, until

LEFT = "truck-1: the logger has left; the spool keeps all messages until it is back"
LOST = "truck-1: connection to the router lost; the spool keeps all messages until it is back"
BACK = "truck-1: the logger is back and requests what it lacks"


def logger_of(session: zenoh.Session, name: str = "logger") -> Publisher:
    publisher = Publisher(session, "live")
    publisher.put("service", name, "durable", b"")
    return publisher


@pytest.mark.parametrize("is_secured", [False, True])
def test_truck_logs_once_that_its_logger_left_and_is_back(
    is_secured: bool,
    endpoint: str,
    tls_endpoint: str,
    credentials: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    where = tls_endpoint if is_secured else endpoint
    caplog.set_level(logging.INFO, "services.truck.gateway")

    def session(role: str, *, listens: bool = False) -> zenoh.Session:
        tls = credentials / role if is_secured else None
        if listens:
            return open_session(listen=where, tls=tls)
        return open_session(connect=where, timeout_s=LONGEST_S, tls=tls)

    def lines() -> list[str]:
        return [line for line in caplog.messages if line in (LEFT, LOST, BACK)]

    router = session("logger", listens=True)
    own = logger_of(router)
    gateway = Gateway(partial(session, "truck-1"), "live", "truck-1", Spool(tmp_path / "spool"))
    with contextlib.closing(gateway):
        until(lambda: gateway._logger_watch is not None, "the connection")
        watch = gateway._logger_watch
        assert watch is not None
        until(lambda: watch._was_there, "the logger")
        own.close()
        until(lambda: lines() == [LEFT], "the logger's leave")
        own = logger_of(router)
        until(lambda: lines() == [LEFT, BACK], "the logger's return")
        own.close()
        router.close()
        until(lambda: len(lines()) == 3, "the loss")
        router = session("logger", listens=True)
        own = logger_of(router)
        until(lambda: len(lines()) == 4, "the connection")
    assert lines()[2] in (LEFT, LOST)
    assert lines()[3] == BACK
    own.close()
    router.close()


def test_truck_without_a_logger_from_the_start_logs_no_leave(
    endpoint: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "services.truck.gateway")
    connect = partial(open_session, connect=endpoint, timeout_s=LONGEST_S)
    with open_session(listen=endpoint):
        gateway = Gateway(connect, "live", "truck-1", Spool(tmp_path / "spool"))
        with contextlib.closing(gateway):
            until(lambda: gateway._unsubscribed_s > 0.0, "the line on a missing subscriber")
    assert not [line for line in caplog.messages if line in (LEFT, LOST, BACK)]
