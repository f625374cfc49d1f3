"""The command `driveby health --metrics`: figures of services in the format of Prometheus.

It is a viewer of the bus. A service with `--serve` keeps the latest health of every service and
answers each request from memory, so services listen at no port for it.
"""

import logging
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Final

import zenoh

from schemas.messages import decode
from schemas.metrics import CONTENT_TYPE, ServiceFigures, exposition
from schemas.proto import driveby_pb2 as pb
from schemas.topics import Key, check_identifier, check_realms, key, selector
from services.bus.playback import stopped_by_signals
from services.bus.session import open_session, wait_for_router
from services.bus.subscription import RawSample, Subscription
from services.cli.health import OLDEST_S, realms_hint, realms_of, silence_hint
from services.common.errors import FailureError, InputError

_log = logging.getLogger(__name__)
_MAX_SERVICES: Final = 1000
_FORGOTTEN_S: Final = 86_400.0
"""Age of a health after which its service is no longer listed."""
_MORE_S: Final = 0.5
"""Longest wait in s for the next service's answer after one."""


class HealthBoard:
    """The latest health of each service; thread-safe."""

    def __init__(self) -> None:
        self._latest: dict[tuple[str, str], pb.Health] = {}
        self._lock = threading.Lock()

    def add(self, received: RawSample) -> bool:
        """Add a message; return False if it is not a service's health."""
        try:
            where: Key = received.key()
            message = decode("driveby.v1.Health", received.payload)
        except ValueError:
            return False
        if not isinstance(message, pb.Health) or where.stream != "health":
            return False
        with self._lock:
            name = (where.realm, where.identifier)
            if name not in self._latest and len(self._latest) >= _MAX_SERVICES:
                self._latest.pop(next(iter(self._latest)))
            self._latest[name] = message
        return True

    def services(self, now_s: float) -> list[ServiceFigures]:
        """Return all services; the figures of one that is silent or has ended are left out."""
        with self._lock:
            latest = dict(self._latest)
        found = []
        for (realm, service), message in latest.items():
            time_s = message.time_ns * 1e-9
            is_recent = now_s - time_s <= OLDEST_S and not message.ended
            figures = message.figures if is_recent else {}
            if now_s - time_s <= _FORGOTTEN_S:
                found.append(
                    ServiceFigures(realm, service, is_recent and message.ok, time_s, figures)
                )
        return found


def metrics_command(
    *, service: str | None, endpoint: str, tls: Path | None, realm: str, patience_s: float = 5.0
) -> str:
    """Return the metrics of one service, or of all in a realm or pattern of realms.

    InputError: a bad realm or name. FailureError: no router answers, or no service does.
    """
    where, board = _selected(service, realm), HealthBoard()
    with (
        open_session(
            connect=endpoint, timeout_s=patience_s, tls=tls, handshake_s=patience_s
        ) as session,
        Subscription(session, where) as subscription,
    ):
        deadline_s = time.monotonic() + patience_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            received = subscription.receive(left_s)
            if received is not None and board.add(received):
                deadline_s = min(deadline_s, time.monotonic() + (_MORE_S if not service else 0.0))
        elsewhere = [] if board.services(time.time()) else realms_of(session, service)
    found = board.services(time.time())
    if not found:
        who = service or "every service"
        hint = realms_hint(elsewhere) or silence_hint(where, tls)
        raise FailureError(f"{who} in realm {realm} sends nothing at {endpoint}; {hint}")
    return exposition(found)


def serve_metrics(
    *,
    service: str | None,
    endpoint: str,
    tls: Path | None,
    realm: str,
    address: tuple[str, int],
    ready: Callable[[str], None],
) -> None:
    """Answer HTTP requests for /metrics at an address until a signal.

    `ready` gets the URL. InputError: a bad realm or name. FailureError: the address is not
    available.
    """
    where, board = _selected(service, realm), HealthBoard()
    host, port = address
    try:
        server = _MetricsServer(address, board)
    except OSError as error:
        raise FailureError(f"cannot listen at {host}:{port}: {error.strerror}") from None
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    with server, stopped_by_signals() as stop:
        thread.start()
        ready(f"http://{host}:{server.server_port}/metrics")
        try:
            while not stop.is_set():
                bus = wait_for_router(endpoint, tls, stop.is_set)
                if bus is not None:
                    _follow(bus, where, board, stop.is_set)
        finally:
            server.shutdown()


def _follow(
    bus: zenoh.Session, where: str, board: HealthBoard, is_over: Callable[[], bool]
) -> None:
    """Store every health message, until silence suggests that the connection is stale."""
    with bus, Subscription(bus, where) as subscription:
        heard_s = time.monotonic()
        while not is_over() and time.monotonic() - heard_s < OLDEST_S:
            received = subscription.receive(0.2)
            if received is not None and board.add(received):
                heard_s = time.monotonic()
    if not is_over():
        _log.warning("no health for %.0f s; connecting again", OLDEST_S)


def _selected(service: str | None, realm: str) -> str:
    try:
        check_realms(realm)
        if service is None:
            return selector(realm, "service", "health")
        return key(realm, "service", check_identifier(service), "health")
    except ValueError as error:
        raise InputError(str(error)) from None


class _MetricsServer(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], board: HealthBoard) -> None:
        super().__init__(address, _Handler)
        self.board = board


class _Handler(BaseHTTPRequestHandler):
    server: _MetricsServer
    timeout = 10.0

    def do_GET(self) -> None:
        if self.path.partition("?")[0] != "/metrics":
            self.send_error(404, "only /metrics is served")
            return
        body = exposition(self.server.board.services(time.time())).encode()
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, text: str, *arguments: object) -> None:
        """Log HTTP requests with --verbose only."""
        _log.debug(text, *arguments)
