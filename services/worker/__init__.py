"""Identifies crossings as they happen: from the bus to the bus, and into a results file."""

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.results import Crossing, Header, results, results_json
from schemas.settings import IdentificationSettings
from schemas.site import parse_site, site_hash
from schemas.topics import Key, check_identifier, check_realm, parse_key, selector
from services.common.bus import Publisher, Seen, Subscription, open_session
from services.common.credentials import check_speaks_for
from services.common.errors import FailureError, InputError
from services.common.files import read_text, write_atomically
from services.common.playback import stopped_by_signals
from services.common.recording import Message, RecordingWriter, program_version
from services.common.streams import device_time_ns
from services.worker.engine import Engine, Output
from services.worker.warm_up import warm_up

__all__ = ["run"]

_log = logging.getLogger(__name__)
_POLL_S = 0.1
_HEALTH_PERIOD_S = 60.0
_GONE_AFTER_S = 3.0
"""A truck whose token has gone is given this long for what is still on its way."""
_SILENT_S = 10.0
"""So long must a truck be silent that has no token, such as a replayed one, to have gone."""
_LONGEST_QUEUE = 200_000
_HISTORY_S = 1.0
"""A truck that is new here sends its history stream by stream: what comes in the first second is
put in order of time before it is looked at."""
_CONNECT_S = 1.0


class _Arrived(NamedTuple):
    key: Key
    boot_id: int
    payload: bytes


class _Token(NamedTuple):
    """A truck has come to the bus or left it."""

    realm: str
    vehicle: str
    is_alive: bool


_Name = tuple[str, str, int]
"""Realm, vehicle and boot."""


class _Arrivals:
    """Puts what comes in the order in which it is to be looked at.

    Takes the moments (s, any steady clock) at which things come; no I/O.
    """

    def __init__(self) -> None:
        self._known: set[_Name] = set()
        self._new: dict[_Name, list[_Arrived]] = {}
        self._since: dict[_Name, float] = {}
        self._alive: set[tuple[str, str]] = set()
        self._leaves: dict[tuple[str, str], float] = {}
        """When a truck is taken to have gone, unless it says something."""

    def add(self, arrived: _Arrived, now_s: float) -> list[_Arrived]:
        """Take a message in; return it if it can be looked at now."""
        truck = (arrived.key.realm, arrived.key.identifier)
        if truck not in self._alive:
            self._leaves[truck] = now_s + _SILENT_S
        name = (arrived.key.realm, arrived.key.identifier, arrived.boot_id)
        if name in self._known:
            return [arrived]
        self._new.setdefault(name, []).append(arrived)
        self._since.setdefault(name, now_s)
        return []

    def note(self, token: _Token, now_s: float) -> None:
        """Note that a truck has come or gone."""
        truck = (token.realm, token.vehicle)
        if token.is_alive:
            self._alive.add(truck)
            self._leaves.pop(truck, None)
        else:
            self._alive.discard(truck)
            self._leaves[truck] = now_s + _GONE_AFTER_S

    def due(self, now_s: float) -> list[_Arrived]:
        """What trucks that are new have sent in their first second, in order of time."""
        due: list[_Arrived] = []
        for name in [n for n, since_s in self._since.items() if since_s + _HISTORY_S <= now_s]:
            self._known.add(name)
            del self._since[name]
            due += sorted(self._new.pop(name), key=_device_time_ns)
        return due

    def gone(self, now_s: float) -> list[tuple[str, str]]:
        """Realm and vehicle of the trucks that left and did not come back."""
        gone = [truck for truck, leaves_s in self._leaves.items() if leaves_s <= now_s]
        for truck in gone:
            del self._leaves[truck]
        return gone


def _device_time_ns(arrived: _Arrived) -> int:
    try:
        return device_time_ns(arrived.key.stream, arrived.payload)
    except ValueError:
        return 0  # the engine will say what is wrong


class _ResultFiles:
    """What has been found, as a recording and as JSON beside it; made with the first result."""

    def __init__(self, path: Path, site_toml: str, header: Header) -> None:
        self.path = path
        self._site_toml = site_toml
        self._header = header
        self._writer: RecordingWriter | None = None
        self._crossings: list[Crossing] = []
        self._failed = False

    def write(self, message: Message, result: Crossing | None, engine: Engine) -> None:
        """Add a message, and a result to the JSON file; FailureError if that is not possible."""
        try:
            self._write(message, result, engine)
        except OSError as error:
            self._failed = True
            raise FailureError(f"{self.path}: cannot be written: {error.strerror}") from error

    def _write(self, message: Message, result: Crossing | None, engine: Engine) -> None:
        if self._writer is None:
            self._writer = RecordingWriter(
                self.path,
                reason="first result",
                realm=message.key.realm,
                site_toml=self._site_toml,
            )
        self._writer.write(message)
        self._writer.sync()
        if result is not None:
            self._crossings.append(result)
            content = results(self._header, self._crossings, engine.bridges())
            write_atomically(self.path.with_suffix(".json"), results_json(content))

    def finish(self) -> None:
        """Close the recording; after a failed write it stays as it is on the disk."""
        if self._writer is not None and not self._failed:
            self._writer.finish("stopped by a signal", {"crossings": len(self._crossings)})
        elif self._writer is not None:
            self._writer.abandon()


def run(
    *,
    endpoint: str,
    realm: str,
    site: Path,
    folder: Path,
    file: Path | None,
    method: str,
    service_id: str,
    ready: Callable[[], None] | None = None,
    tls: Path | None = None,
) -> int:
    """Identify all crossings of a realm until SIGINT or SIGTERM; return 0.

    Results are published and written to `folder/REALM/results-TIME.mcap` (or `file`) and `.json`
    beside it. Waits for the router for ever. `ready` is called once, when the worker listens.
    `tls` is a folder of credentials, see `open_session`.
    InputError: a bad site file, realm or id. FailureError: a result cannot be written.
    """
    _check_names(realm, service_id)
    check_speaks_for(tls, "worker", service_id)
    text = read_text(site)
    known = parse_site(text, str(site))
    settings = IdentificationSettings.model_validate({"method": method})
    header = Header(
        version=program_version(),
        created=time.time(),
        site_hash=site_hash(known),
        settings=settings.model_dump(mode="json"),
        seed=settings.seed,
    )
    if file is None:
        moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
        file = folder / realm / f"results-{moment}.mcap"
    if file.exists():
        raise InputError(f"{file}: exists, and results are never overwritten; give another name")
    files = _ResultFiles(file, text, header)
    with stopped_by_signals() as stop, contextlib.ExitStack() as stack:
        warm_up()
        bus = _connected(endpoint, tls, stop)
        if bus is None:
            return 0
        stack.enter_context(bus)
        publisher = Publisher(bus, realm)

        def report(crossing_id: str, stage: str, fraction: float) -> None:
            _say_progress(publisher, service_id, crossing_id, stage, fraction)

        engine = Engine(known, settings, header, stopwatch=time.perf_counter, report=report)
        arrivals: queue.Queue[_Arrived | _Token] = queue.Queue(_LONGEST_QUEUE)
        failed = threading.Event()
        receiver = threading.Thread(
            target=_receive, args=(bus, realm, arrivals, stop, failed), name="receive", daemon=True
        )
        receiver.start()
        try:
            _serve(engine, arrivals, publisher, service_id, files, stop, ready)
        finally:
            stop.set()
            receiver.join()
            publisher.close()
            files.finish()
        if failed.is_set():
            raise FailureError(f"{endpoint}: the connection to the bus failed, see the log")
    return 0


def _check_names(realm: str, service_id: str) -> None:
    try:
        check_realm(realm)
        check_identifier(service_id)
    except ValueError as error:
        raise InputError(str(error)) from None


def _connected(endpoint: str, tls: Path | None, stop: threading.Event) -> zenoh.Session | None:
    """A session as soon as a router answers; None if a signal came first."""
    while not stop.is_set():
        # Zenoh itself would wait for ever, and no signal would be heard meanwhile.
        with contextlib.suppress(FailureError):
            return open_session(connect=endpoint, timeout_s=_CONNECT_S, tls=tls)
    return None


def _receive(
    bus: zenoh.Session,
    realm: str,
    arrivals: "queue.Queue[_Arrived | _Token]",
    stop: threading.Event,
    failed: threading.Event,
) -> None:
    """Take everything off the bus quickly: an identification must not hold up a publisher.

    Sets `failed` and `stop` if it cannot go on: a worker that hears nothing must not look alive.
    """
    try:
        _take_all(bus, realm, arrivals, stop)
    except zenoh.ZError as error:
        if not stop.is_set():
            failed.set()
            _log.error("the connection to the bus failed: %s", error)
    finally:
        stop.set()


def _take_all(
    bus: zenoh.Session,
    realm: str,
    arrivals: "queue.Queue[_Arrived | _Token]",
    stop: threading.Event,
) -> None:
    seen = Seen()
    alive = bus.liveliness().declare_subscriber(
        selector(realm, "vehicle", "alive"), zenoh.handlers.FifoChannel(1000), history=True
    )
    with Subscription(bus, selector(realm, "vehicle")) as vehicles:
        while not stop.is_set():
            received = vehicles.receive(_POLL_S)
            token = alive.handler.try_recv()
            try:
                if token is not None:
                    key = parse_key(str(token.key_expr))
                    is_alive = token.kind == zenoh.SampleKind.PUT
                    _put(arrivals, _Token(key.realm, key.identifier, is_alive), stop)
                if received is None:
                    continue
                key, identity = received.key(), received.identity()
            except ValueError as error:
                _log.warning("refused: %.200s", error)
                continue
            if key.stream in ("accel", "gnss") and seen.add(key, identity):
                _put(arrivals, _Arrived(key, identity.boot_id, received.payload), stop)
    alive.undeclare()  # type: ignore[no-untyped-call]


def _put(
    arrivals: "queue.Queue[_Arrived | _Token]", item: _Arrived | _Token, stop: threading.Event
) -> None:
    """Wait for room in the queue, but not beyond the end of the service."""
    while not stop.is_set():
        with contextlib.suppress(queue.Full):
            arrivals.put(item, timeout=_POLL_S)
            return


def _serve(
    engine: Engine,
    queued: "queue.Queue[_Arrived | _Token]",
    publisher: Publisher,
    service_id: str,
    files: _ResultFiles,
    stop: threading.Event,
    ready: Callable[[], None] | None,
) -> None:
    arrivals = _Arrivals()
    told: set[str] = set()
    next_health_s = 0.0
    if ready is not None:
        ready()
    while not stop.is_set():
        if time.monotonic() >= next_health_s:
            next_health_s = time.monotonic() + _HEALTH_PERIOD_S
            _say_health(publisher, service_id, queued.qsize())
        batch: list[_Arrived] = []
        with contextlib.suppress(queue.Empty):
            one = queued.get(timeout=_POLL_S)
            if isinstance(one, _Token):
                arrivals.note(one, time.monotonic())
            else:
                batch += arrivals.add(one, time.monotonic())
        # In this order: what has come in the queue is newer than a history that is due.
        for arrived in arrivals.due(time.monotonic()) + batch:
            try:
                _publish(engine.feed(arrived.key, arrived.payload), engine, publisher, files)
            except ValueError as error:
                name = f"{arrived.key.stream} of {arrived.key.identifier}"
                _log.warning("refused %s: %s", name, error)
        for realm, vehicle in arrivals.gone(time.monotonic()):
            _publish(engine.gone(realm, vehicle), engine, publisher, files)
        for vehicle in engine.unknown_vehicles - told:
            told.add(vehicle)
            _log.warning("%s drives, but the site file has no such vehicle", vehicle)


def _publish(
    outputs: Iterable[Output], engine: Engine, publisher: Publisher, files: _ResultFiles
) -> None:
    for output in outputs:
        _, owner, identifier, stream = output.key
        identity = publisher.put(owner, identifier, stream, output.payload)
        now_ns = time.time_ns()
        message = Message(output.key, output.payload, *identity, now_ns, now_ns)
        files.write(message, output.result, engine)
        if output.result is not None:
            result = output.result
            _log.info("%s: %s %s", result.crossing_id, result.verdict, ", ".join(result.reasons))


def _say_progress(
    publisher: Publisher, service_id: str, crossing_id: str, stage: str, fraction: float
) -> None:
    progress = pb.Progress(
        schema_version=1,
        time_ns=time.time_ns(),
        crossing_id=crossing_id,
        stage=stage,
        fraction=fraction,
    )
    publisher.put("service", service_id, "progress", progress.SerializeToString())


def _say_health(publisher: Publisher, service_id: str, waiting: int) -> None:
    health = pb.Health(
        schema_version=1,
        time_ns=time.time_ns(),
        service=service_id,
        ok=True,
        figures={"queue": float(waiting)},
    )
    publisher.put("service", service_id, "health", health.SerializeToString())
