"""Identifies crossings as they happen: from the bus to the bus, and into a results file."""

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
from services.common.errors import FailureError, InputError
from services.common.files import read_text, write_atomically
from services.common.playback import stopped_by_signals
from services.common.recording import Message, RecordingWriter, program_version
from services.worker.engine import Engine, Output
from services.worker.warm_up import warm_up

__all__ = ["run"]

_log = logging.getLogger(__name__)
_POLL_S = 0.1
_HEALTH_PERIOD_S = 60.0
_GONE_AFTER_S = 3.0
"""A truck whose token has gone is given this long for what is still on its way."""
_LONGEST_QUEUE = 200_000


class _Arrived(NamedTuple):
    key: Key
    payload: bytes


class _Gone(NamedTuple):
    realm: str
    vehicle: str
    due_s: float


class _ResultFiles:
    """What has been found, as a recording and as JSON beside it; made with the first result."""

    def __init__(self, path: Path, site_toml: str, header: Header) -> None:
        self.path = path
        self._site_toml = site_toml
        self._header = header
        self._writer: RecordingWriter | None = None
        self._crossings: list[Crossing] = []

    def write(self, message: Message, result: Crossing | None, engine: Engine) -> None:
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
        if self._writer is not None:
            self._writer.finish("stopped by a signal", {"crossings": len(self._crossings)})


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
) -> int:
    """Identify all crossings of a realm until SIGINT or SIGTERM; return 0.

    Results are published and written to `folder/REALM/results-TIME.mcap` (or `file`) and `.json`
    beside it. Waits for the router for ever. `ready` is called once, when the worker listens.
    InputError: a bad site file, realm or id. FailureError: a result cannot be written.
    """
    _check_names(realm, service_id)
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
    files = _ResultFiles(file, text, header)
    warm_up()
    with stopped_by_signals() as stop, open_session(connect=endpoint) as bus:
        publisher = Publisher(bus, realm)

        def report(crossing_id: str, stage: str, fraction: float) -> None:
            _say_progress(publisher, service_id, crossing_id, stage, fraction)

        engine = Engine(known, settings, header, stopwatch=time.perf_counter, report=report)
        arrivals: queue.Queue[_Arrived | _Gone] = queue.Queue(_LONGEST_QUEUE)
        receiver = threading.Thread(
            target=_receive, args=(bus, realm, arrivals, stop), name="receive", daemon=True
        )
        receiver.start()
        try:
            _serve(engine, arrivals, publisher, service_id, files, stop, ready)
        finally:
            stop.set()
            receiver.join()
            publisher.close()
            files.finish()
    return 0


def _check_names(realm: str, service_id: str) -> None:
    try:
        check_realm(realm)
        check_identifier(service_id)
    except ValueError as error:
        raise InputError(str(error)) from None


def _receive(
    bus: zenoh.Session,
    realm: str,
    arrivals: "queue.Queue[_Arrived | _Gone]",
    stop: threading.Event,
) -> None:
    """Take everything off the bus quickly: an identification must not hold up a publisher."""
    seen = Seen()
    alive = bus.liveliness().declare_subscriber(
        selector(realm, "vehicle", "alive"), zenoh.handlers.FifoChannel(1000)
    )
    with Subscription(bus, selector(realm, "vehicle")) as vehicles:
        while not stop.is_set():
            received = vehicles.receive(_POLL_S)
            token = alive.handler.try_recv()
            if token is not None and token.kind == zenoh.SampleKind.DELETE:
                key = parse_key(str(token.key_expr))
                arrivals.put(_Gone(key.realm, key.identifier, time.monotonic() + _GONE_AFTER_S))
            if received is None:
                continue
            try:
                key, identity = received.key(), received.identity()
            except ValueError as error:
                _log.warning("refused a message on %.80s: %s", received.key_text, error)
                continue
            if seen.add(key, identity):
                arrivals.put(_Arrived(key, received.payload))
    alive.undeclare()  # type: ignore[no-untyped-call]


def _serve(
    engine: Engine,
    arrivals: "queue.Queue[_Arrived | _Gone]",
    publisher: Publisher,
    service_id: str,
    files: _ResultFiles,
    stop: threading.Event,
    ready: Callable[[], None] | None,
) -> None:
    gone: list[_Gone] = []
    told: set[str] = set()
    next_health_s = 0.0
    if ready is not None:
        ready()
    while not stop.is_set():
        if time.monotonic() >= next_health_s:
            next_health_s = time.monotonic() + _HEALTH_PERIOD_S
            _say_health(publisher, service_id, arrivals.qsize())
        try:
            arrived = arrivals.get(timeout=_POLL_S)
        except queue.Empty:
            due = [one for one in gone if one.due_s <= time.monotonic()]
            gone = [one for one in gone if one.due_s > time.monotonic()]
            for one in due:
                _publish(engine.gone(one.realm, one.vehicle), engine, publisher, files)
            continue
        if isinstance(arrived, _Gone):
            gone.append(arrived)
            continue
        try:
            _publish(engine.feed(arrived.key, arrived.payload), engine, publisher, files)
        except ValueError as error:
            _log.warning("refused %s of %s: %s", arrived.key.stream, arrived.key.identifier, error)
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
        try:
            files.write(message, output.result, engine)
        except OSError as error:
            raise FailureError(f"{files.path}: cannot be written: {error.strerror}") from error
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
