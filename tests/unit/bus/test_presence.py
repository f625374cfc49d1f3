"""A lost router and services that have left are noticed without waiting for their health."""

import contextlib
import time
from pathlib import Path

import pytest
import zenoh

from services.bus.presence import Presence
from services.bus.publisher import Publisher
from services.bus.session import open_session
from tests.waiting import LONGEST_S, until


def healthy(session: zenoh.Session, name: str) -> Publisher:
    publisher = Publisher(session, "live")
    publisher.put("service", name, "health", b"")
    return publisher  # whoever forgets it, ends it


def looked(presence: Presence) -> Presence:
    presence.look(time.monotonic())
    return presence


@pytest.mark.parametrize("role", [None, "viewer"])
def test_services_that_leave_are_noticed(
    role: str | None, endpoint: str, tls_endpoint: str, credentials: Path
) -> None:
    """Also with the credentials of a viewer, which may read `health` and nothing of trucks."""
    where = endpoint if role is None else tls_endpoint

    def folder(name: str) -> Path | None:
        return None if role is None else credentials / name

    with contextlib.ExitStack() as open_now:
        router = open_now.enter_context(open_session(listen=where, tls=folder("logger")))
        worker = open_session(connect=where, timeout_s=LONGEST_S, tls=folder("worker"))
        with worker:
            publishers = [healthy(worker, "worker"), healthy(router, "logger")]
            viewer = open_now.enter_context(
                open_session(connect=where, timeout_s=LONGEST_S, tls=folder(role or ""))
            )
            presence = Presence(viewer, "live")
            until(lambda: len(looked(presence)._present) == 2, "both services")
            assert (presence.gone_s, presence.lost_s) == ({}, None)
        until(lambda: list(looked(presence).gone_s) == ["worker"], "the worker's leave")
        again = open_now.enter_context(
            open_session(connect=where, timeout_s=LONGEST_S, tls=folder("worker"))
        )
        publishers.append(healthy(again, "worker"))
        until(lambda: not looked(presence).gone_s, "the worker's return")
        presence.close()


def test_a_lost_router_is_noticed_and_its_return(endpoint: str) -> None:
    router = open_session(listen=endpoint)
    publishers = [healthy(router, "logger")]
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as client:
        presence = Presence(client, "live")
        until(lambda: looked(presence)._present, "the logger")
        router.close()
        until(lambda: looked(presence).lost_s is not None, "the loss")
        until(lambda: "logger" in looked(presence).gone_s, "the logger's leave")
        gone_s = presence.gone_s["logger"]
        with open_session(listen=endpoint) as router:
            until(lambda: looked(presence).lost_s is None, "the connection")
            assert presence.gone_s.get("logger", gone_s + 1.0) > gone_s  # its time begins anew
            publishers.append(healthy(router, "logger"))
            until(lambda: not looked(presence).gone_s, "the logger's return")
        presence.close()


def test_a_router_has_lost_nothing(endpoint: str) -> None:
    with open_session(listen=endpoint) as router:
        presence = looked(Presence(router, "live"))
        assert presence.lost_s is None
        presence.close()
