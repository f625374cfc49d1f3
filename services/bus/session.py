"""Zenoh sessions of services.

A service looks like this:

    with open_session(connect=endpoint, timeout_s=10) as session:
        with Subscription(session, selector("live", "vehicle")) as vehicles:
            publisher = Publisher(session, "live")
            while not stop:
                received = vehicles.receive(0.2)      # None after 0.2 s of silence
                if received is not None:
                    ...
                    publisher.put("bridge", bridge, "estimate", estimate.SerializeToString())
            publisher.close()

`publisher` and `subscription` describe how no message is lost, `delivery` how a publisher confirms
arrival.
"""

import contextlib
import ipaddress
import json
import logging
import math
import os
import re
import socket
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import zenoh

from schemas.topics import check_realm
from services.bus.credentials import (
    CONFIGURATION,
    LISTENERS,
    check_credentials,
    link_settings,
    watch_expiry,
)
from services.bus.tls_probe import cause_of_failure
from services.common.endpoints import default_endpoint
from services.common.errors import FailureError, InputError
from services.common.files import read_bytes

_log = logging.getLogger(__name__)
_ENDPOINT = re.compile(r"(tcp|tls|quic|ws|unixsock-stream)/\S+")
_TRY_ONCE_MS = 0
"""Setting of a client whose attempt is not repeated by Zenoh: a refused one ends at once, so that
Python can handle a signal before the next one. One that is neither refused nor answered ends after
`_HANDSHAKE_S`."""
_HANDSHAKE_S = 10.0
"""Limit of a handshake, Zenoh's own: it takes four round trips, more where packets are lost."""
_PAUSE_S = 0.1
"""Pause between attempts that are refused at once."""
_CONNECT_S = 1.0
"""Duration of attempts before `is_over` is checked again."""
_PATIENCE_WITH_SUBSCRIBER_US = 1_000_000
"""Timeout of a blocked subscriber. Zenoh's default is 5 s; a subscriber that is cut off connects
again and fetches missing messages."""
_CAUSE_S = 60.0
"""Interval of probes for the cause of a failure, each of which delays Zenoh's next handshake."""
_RUNTIME = "(rx: (handover: acc), acc: (worker_threads: 2))"
"""Threads of a router: the waiting threads also read. Waking Zenoh's own pool of receiving threads
for every message costs more than handling it. There are two, because new connections need one too
and one may be blocked by a frozen subscriber."""


def checked_realm(realm: str) -> str:
    """Return a realm; raise InputError if it is invalid."""
    try:
        return check_realm(realm)
    except ValueError as error:
        raise InputError(str(error)) from None


def open_session(
    *,
    connect: str | None = None,
    listen: str | None = None,
    timeout_s: float | None = None,
    tls: Path | None = None,
    insecure: bool = False,
    handshake_s: float = _HANDSHAKE_S,
) -> zenoh.Session:
    """Open a session: a client of the router at `connect`, or a router that listens at `listen`.

    A client waits `timeout_s` (None: for ever) for the router, and up to `handshake_s` longer for
    the end of an attempt that is neither answered nor refused. It reconnects by itself after the
    connection is lost. It must be closed, or the process does not end; it is a context manager.

    `tls` is a folder of `driveby certs`: both sides authenticate, only TLS is used, and the
    router's access control limits every client. Without it the router is reachable from this
    machine only, unless `insecure` opens it to everyone who reaches the address.

    In a process whose first session is a router's, the environment variable ZENOH_RUNTIME, unless
    set, is chosen for many publishers.

    Raise InputError for a malformed endpoint, bad credentials, or an address open to strangers;
    FailureError on timeout or if the address is not available.
    """
    if (connect is None) == (listen is None):
        raise ValueError("either connect or listen")
    endpoint = _check_endpoint(connect or listen or "", tls)
    if listen is not None and tls is None and not insecure and not _is_on_this_machine(listen):
        raise InputError(
            f"{listen} can be reached by other machines, and without --tls FOLDER anybody there "
            "could publish as a truck; add --insecure if that is intended (see docs/security.md)"
        )
    if listen is not None:
        os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)  # read at a process's first session
    deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
    config = _configuration(endpoint, tls, is_client=connect is not None)
    config.insert_json5("transport/unicast/open_timeout", str(round(1e3 * handshake_s)))
    while True:
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            _log.debug("zenoh: %s", error)
            if listen is not None:
                raise FailureError(_why_not_listening(endpoint, error)) from None
            # Zenoh could wait by itself, but Python would handle no signal meanwhile.
            if time.monotonic() >= deadline:
                raise FailureError(_why_not_connected(endpoint, timeout_s, tls)) from None
            time.sleep(_PAUSE_S)
        else:
            if tls is not None:
                watch_expiry(tls)
            return session


def wait_for_router(
    endpoint: str, tls: Path | None, is_over: Callable[[], bool]
) -> zenoh.Session | None:
    """Return a session once a router answers; None if `is_over` before.

    Raise InputError for a malformed endpoint or bad credentials.
    """
    logged = ""
    while not is_over():
        # Zenoh itself would wait for ever, and Python would handle no signal.
        try:
            session = open_session(connect=endpoint, timeout_s=_CONNECT_S, tls=tls)
        except FailureError as error:
            if str(error) != logged:  # the cause may change, from no router to a wrong certificate
                _log.warning("%s; retrying", error)
            logged = str(error)
        else:
            if logged:
                _log.info("%s: connected", endpoint)
            return session
    return None


def _why_not_connected(endpoint: str, timeout_s: float | None, tls: Path | None) -> str:
    within = f" within {timeout_s:g} s" if timeout_s else ""
    cause = _cause(endpoint, tls, int(time.monotonic() // _CAUSE_S))
    if cause is not None:
        return f"no router answers at {endpoint}{within}: {cause}"
    return (
        f"no router answers at {endpoint}{within}; "
        "start `driveby logger` first or give its address with --endpoint"
    )


@lru_cache(maxsize=16)
def _cause(endpoint: str, tls: Path | None, _period: int) -> str | None:
    """Return the cause of a failure, once a period: services attempt a connection every second."""
    return cause_of_failure(endpoint, tls)


def _why_not_listening(endpoint: str, error: zenoh.ZError) -> str:
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with contextlib.suppress(OSError, ValueError), socket.create_connection((host, int(port)), 1):
        return f"cannot listen at {endpoint}: the address is in use, is another logger running?"
    return f"cannot listen at {endpoint}: {_first_sentence(error).rstrip(':')}"


def _configuration(endpoint: str, tls: Path | None, *, is_client: bool) -> zenoh.Config:
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "client" if is_client else "router",
        "connect/endpoints": [endpoint] if is_client else [],
        "listen/endpoints": [] if is_client else [endpoint],
        "connect/timeout_ms": _TRY_ONCE_MS,
        "connect/retry": {
            "period_init_ms": 100,
            "period_max_ms": 500,
            "period_increase_factor": 2,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
    }
    if not is_client:
        # A router blocks on a subscriber that has stopped reading, and blocks all others with it.
        block = "transport/link/tx/queue/congestion_control/block/wait_before_close"
        settings[block] = _PATIENCE_WITH_SUBSCRIBER_US
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    if tls is not None:
        _add_security(config, tls.absolute(), is_client=is_client)
    return config


def _add_security(config: zenoh.Config, tls: Path, *, is_client: bool) -> None:
    subject = check_credentials(tls)
    for name, value in link_settings(tls).items():
        config.insert_json5(f"transport/link/{name}", json.dumps(value))
    if is_client:
        return
    if subject.role not in LISTENERS:
        raise InputError(f"{tls}: is the certificate of {subject}; only a logger's may listen")
    config.insert_json5("access_control", json.dumps(_access_control(tls)))


def listed_participants(tls: Path) -> frozenset[str]:
    """Return the common names that the access control of a listener's folder admits."""
    subjects = _access_control(tls)["subjects"]
    return frozenset(name for one in subjects for name in one.get("cert_common_names") or ())


def _access_control(tls: Path) -> dict[str, Any]:
    """Return the access control of a folder; raise InputError if it would admit everything."""
    path = tls / CONFIGURATION
    read_bytes(path)  # reports the error better than Zenoh
    try:
        access: Any = json.loads(zenoh.Config.from_file(path).get_json("access_control"))
    except zenoh.ZError as error:
        raise InputError(f"{path}: {_first_sentence(error)}") from None
    if not (access["enabled"] and access["default_permission"] == "deny" and access["subjects"]):
        raise InputError(f"{path}: permits everything to everybody; create it with `driveby certs`")
    return dict(access)


def _check_endpoint(endpoint: str, tls: Path | None) -> str:
    if not _ENDPOINT.fullmatch(endpoint):
        raise InputError(
            f"endpoint {endpoint!r}: PROTOCOL/HOST:PORT is expected, e.g. {default_endpoint(tls)}"
        )
    is_tls = endpoint.startswith("tls/")
    if tls is not None and not is_tls:
        raise InputError(f"endpoint {endpoint!r}: with --tls it must begin with tls/")
    if tls is None and is_tls:
        raise InputError(f"endpoint {endpoint!r}: needs --tls FOLDER, see `driveby certs --help`")
    return endpoint


def _is_on_this_machine(endpoint: str) -> bool:
    """Return whether only programs on this machine can reach an endpoint."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return True
    host = re.split(r"[?#]", address)[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a host name may be that of any interface


def _first_sentence(error: Exception) -> str:
    """Return the readable part of a Zenoh error, without places in its source."""
    return re.split(r" at /|\[", str(error), maxsplit=1)[0].strip()
