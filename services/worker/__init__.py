"""Live identification of crossings: from the bus to a results file, and from there to the bus.

Every crossing gets one result, whenever the worker is stopped or killed. A message is on the disk
before it is on the bus, so the results files have everything that was published. A new run reads
them: it republishes unchanged what the bus may have missed, publishes the pending messages, and
identifies no crossing that has a result. One without a result is detected again in the data that
its truck still keeps (`cache` in the table of topics), or in a logger's recordings (`backfill`).

Real crossings (realm `live`) wait until simulated ones of the same truck on the same bridge have
shown that the method recovers the truth (`validation_runner`).

Longer than other modules, because publishing, storing and counting a message has one order.
"""

import contextlib
import logging
import math
import queue
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.results import VERDICTS
from schemas.settings import IdentificationSettings
from schemas.signals import TRUCK_DECODERS, Identity
from schemas.site_file import parse_site, read_site_text
from schemas.topics import (
    HEALTH_PERIOD_S,
    Key,
    Message,
    check_identifier,
    check_realm,
    is_from_recording,
    parse_key,
    selector,
)
from schemas.validation_records import VehicleBridgePair
from services.bus.credentials import check_speaks_for
from services.bus.liveness import LivenessProbe, StaleConnectionError
from services.bus.playback import leave_at_once, set_by_signals, stopped_by_signals
from services.bus.publisher import Publisher
from services.bus.realm_listener import OtherRealms
from services.bus.session import wait_for_router
from services.bus.subscription import SeenSequences, Subscription
from services.common.errors import FailureError, InputError
from services.common.files import check_folder_writable
from services.common.log_lines import about
from services.execution.dispatch import CrossingExecutor, collect, dispatch, drain
from services.execution.hang_watchdog import LIMIT_S, TaskLimits
from services.execution.offline import header_of
from services.execution.processes import ProcessExecutor
from services.history.validation_files import passed_validations
from services.identification.bridge_state import Fusing
from services.identification.engine import Engine
from services.identification.known import search_hash
from services.identification.outputs import EngineOutput, Output
from services.ledger.baselines import baselines_of
from services.ledger.crossing_log import Ledger
from services.ledger.runs import (
    KNOWN_AGE_S,
    EarlierRuns,
    ResultFiles,
    free_results_path,
    read_earlier,
)
from services.worker.arrivals import GONE_AFTER_S, ArrivalQueue, LivenessToken, TruckMessage
from services.worker.backfill import DAYS, MARGIN_S, Backfill, BackfillSource
from services.worker.health import QueueLag, Workload, log_result, publish_health, workload
from services.worker.site_file_watcher import EditedSite, SiteFileWatcher
from services.worker.validation_runner import ValidationRunner

__all__ = ["run"]

_log = logging.getLogger(__name__)
_Queue = queue.Queue[TruckMessage | LivenessToken]
_POLL_S = 0.1
"""Longest delay in s after which a stop, a token or a result is noticed without a message."""
_LONGEST_QUEUE = 200_000
"""Messages, two hours of one truck or a minute of a hundred; beyond them publishers wait."""
_SOONEST_HEALTH_S = 5.0
"""Shortest time in s between two health messages, as the backlog may change often."""
_MAX_NAMED = 10
"""Maximum number of crossings in one line of the log."""
_CATCH_UP_EVERY_S = 0.2


class SiteReload(NamedTuple):
    """Detection of an edited site file, and its adoption."""

    watch: SiteFileWatcher
    asked: threading.Event
    """Set when a reload is requested."""
    retarget: Callable[[EditedSite], Iterator[EngineOutput]]

    def edited(self, now_s: float) -> EditedSite | None:
        """Return the site file, if it was edited since the last call."""
        is_asked = self.asked.is_set()
        if is_asked:  # a request after this check is not lost
            self.asked.clear()
        return self.watch.edited(now_s, is_asked=is_asked)


@dataclass(frozen=True)
class WorkerService:
    """Parts of a run: engine, executor, and destinations of their outputs."""

    id: str
    engine: Engine
    execution: CrossingExecutor
    certificates: ValidationRunner
    publisher: Publisher
    files: ResultFiles
    verdicts: Counter[str] = field(default_factory=lambda: Counter(dict.fromkeys(VERDICTS, 0)))
    """Numbers of this run's results, by verdict."""

    def publish(self, outputs: Iterable[Output]) -> None:
        """Write each message to the disk and only then to the bus.

        FailureError: one cannot be written or published.
        """
        for output in _guard_engine(outputs):
            _, owner, identifier, stream = output.key
            identity = self.files.next_identity(output.key, self.publisher.boot_id)
            now_ns = time.time_ns()
            message = Message(output.key, output.payload, *identity, now_ns, now_ns)
            self.files.write(message, output.result, self.engine.bridges())
            try:
                self.publisher.put(owner, identifier, stream, output.payload, identity)
            except ValueError as error:
                raise FailureError(
                    f"{stream} of {identifier} cannot be published: {error}"
                ) from error
            if output.result is not None:
                self.verdicts[output.result.verdict] += 1
                log_result(output.result)

    def process_outputs(self, outputs: Iterable[EngineOutput]) -> None:
        """Publish the engine's messages, and execute its tasks."""
        self.publish(dispatch(self.engine, self.execution, outputs, self.certificates.request))

    def publish_health(self, behind: QueueLag, load: Workload) -> None:
        """Publish `health`."""
        put = partial(self.publisher.put, "service", self.id, "health")
        publish_health(
            put, self.id, self.execution, behind, load,
            verdicts=self.verdicts, note=self.certificates.note,
        )  # fmt: skip


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
    processes: int = 1,
    limit_s: float = LIMIT_S,
    certificates: Path | None = None,
    validate: bool | None = None,
    recordings: Path | None = None,
    recordings_days: float = DAYS,
) -> int:
    """Identify all crossings of a realm until SIGINT or SIGTERM; return 0.

    Results are written to `folder/REALM/results-TIME.mcap` and `.json` beside it, and published.
    The run resumes what earlier runs left there, unless it has a `file` of its own or the realm is
    one of replays. It waits for the router without limit. `ready` is called once, when the worker
    listens. `tls` is a folder of credentials, see `open_session`. Crossings are identified in
    `processes` processes; one that takes more than `limit_s` of processor time for one is ended.

    A crossing whose vehicle and bridge have no validation record in the folder `certificates` (by
    default one in `folder`) waits for one, which is computed meanwhile: if `validate` is true, or
    None and the realm is `live`. Data that trucks no longer send are read from the logger's
    `recordings` (by default in `folder`) of the last `recordings_days` days, unless this run has a
    `file` of its own or the realm is one of replays.
    InputError: a bad site file, realm or id, or a method without validation. FailureError: a result
    or a validation record cannot be written.
    """
    _check_names(realm, service_id)
    check_speaks_for(tls, "worker", service_id)
    are_required = realm == "live" if validate is None else validate
    if are_required and method != "pre":
        raise InputError(
            f"--method {method.replace('_', '-')}: has no certificates, which realm live and "
            "--validate-first ask for; take pre, or --skip-validation"
        )
    text = read_site_text(site)
    known = parse_site(text, str(site))
    settings = IdentificationSettings.model_validate({"method": method})
    header = header_of(known, settings, time.time())
    fusing = Fusing(baselines_of(known, site.parent), threads=settings.threads)
    earlier = EarlierRuns()
    catches_up, age_s = False, 0.0
    watch: SiteFileWatcher | None = None
    if file is None:
        file = free_results_path(folder / realm)
        watch = SiteFileWatcher(site, known)  # a file of its own has room for one site file
        if not is_from_recording(realm):
            catches_up = recordings_days > 0.0
            age_s = recordings_days * 86_400.0
            earlier = read_earlier(
                folder / realm,
                realm,
                time.time(),
                search_hash(header),
                fusing,
                max(KNOWN_AGE_S, age_s + MARGIN_S) if catches_up else KNOWN_AGE_S,
            )
    check_folder_writable(file.parent)
    if file.exists():
        raise InputError(f"{file}: exists, and results are never overwritten; give another name")
    if certificates is None:
        certificates = folder / "certificates"
    if are_required:
        check_folder_writable(certificates)
    elif realm == "live":
        _log.warning("site validation is off (--skip-validation)")
    ledger = Ledger(earlier.crossings, time.time())
    files = ResultFiles(file, text, header, earlier.previous, ledger.note)
    # After a second signal: published messages are on the disk, and the next run resumes.
    with stopped_by_signals(leave_at_once) as stop, contextlib.ExitStack() as stack:

        def report(crossing_id: str, stage: str, fraction: float) -> None:
            _publish_progress(publisher, service_id, crossing_id, stage, fraction)

        execution = stack.enter_context(
            ProcessExecutor(processes, report=report, limits=TaskLimits(processor_s=limit_s))
        )
        bus = wait_for_router(endpoint, tls, stop.is_set)
        if bus is None:
            return 0
        stack.enter_context(bus)
        publisher = Publisher(bus, realm)
        engine = Engine(
            known,
            settings,
            header,
            fusing,
            certificates=passed_validations(certificates, known, settings),
            are_required=are_required,
            has_room=lambda: execution.has_room,
        )
        certified = ValidationRunner(certificates, known, settings, execution)
        backfill = None
        if catches_up:
            source = BackfillSource(recordings or folder, realm, age_s)
            backfill = Backfill(source, known, settings, ledger)
            stack.callback(backfill.close)
        execution.wait_until_warm()
        arrivals: _Queue = queue.Queue(_LONGEST_QUEUE)
        closing, failed = threading.Event(), threading.Event()

        def receive() -> None:
            try:
                _receive(bus, realm, arrivals, closing, failed)
            finally:
                stop.set()

        receiver = threading.Thread(target=receive, name="receive", daemon=True)
        try:
            service = WorkerService(service_id, engine, execution, certified, publisher, files)
            _resume(service, earlier)
            del earlier  # it covers two days
            receiver.start()

            def retarget(edited: EditedSite) -> Iterator[EngineOutput]:
                now = header._replace(created=time.time(), site_hash=edited.hash)
                found = passed_validations(certificates, edited.site, settings)
                path = free_results_path(files.path.parent)
                files.rotate(path, edited.text, now)
                certified.retarget(edited.site)
                if backfill is not None:
                    backfill.retarget(edited.site)
                _log.info("%s was edited: %s applies now, results in %s", site, edited.hash, path)
                anew = fusing._replace(baselines=edited.baselines)
                yield from engine.retarget(edited.site, now, anew, found)

            with set_by_signals(signal.SIGHUP) as asked:
                editing = None if watch is None else SiteReload(watch, asked, retarget)
                _serve(service, arrivals, stop, ready, backfill, editing)
        except BaseException:
            files.abandon()
            raise
        finally:
            closing.set()
            if receiver.is_alive():
                receiver.join()
            publisher.close()
        if failed.is_set():
            files.abandon()
            raise FailureError(f"{endpoint}: the connection to the bus failed, see the log")
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
    arrivals: _Queue,
    closing: threading.Event,
    failed: threading.Event,
) -> None:
    """Take everything off the bus quickly: an identification must not delay a publisher.

    Set `failed` if that is impossible: a worker that receives nothing must not look alive.
    """
    try:
        _receive_all(bus, realm, arrivals, closing)
    except Exception as error:  # whatever it is, nothing more would be received
        if not closing.is_set():
            failed.set()
            unforeseen = not isinstance(error, zenoh.ZError | StaleConnectionError)
            _log.error("the connection to the bus failed: %s", error, exc_info=unforeseen)


def _receive_all(
    bus: zenoh.Session,
    realm: str,
    arrivals: _Queue,
    closing: threading.Event,
) -> None:
    seen = SeenSequences()
    other_realms, is_hinted = OtherRealms(bus, realm), False
    tokens = selector(realm, "vehicle", "alive")
    alive = bus.liveliness().declare_subscriber(
        tokens, zenoh.handlers.FifoChannel(1000), history=True
    )
    probe = LivenessProbe(bus, tokens, other_realms.alive)
    with Subscription(bus, selector(realm, "vehicle")) as vehicles:
        while not closing.is_set():
            received = vehicles.receive(_POLL_S)
            token = alive.handler.try_recv()
            now_s = time.monotonic()
            try:
                if token is not None:
                    key = parse_key(str(token.key_expr))
                    is_alive = token.kind == zenoh.SampleKind.PUT
                    probe.heard(now_s)
                    _put(
                        arrivals, LivenessToken(key.realm, key.identifier, is_alive, now_s), closing
                    )
                if received is None:
                    other_realms.look()
                    probe.poll(now_s)
                    if not is_hinted and not seen.streams and (line := other_realms.line()):
                        is_hinted = True
                        _log.warning("%s", line)
                    continue
                probe.heard(now_s)
                key, identity = received.key(), received.identity()
            except ValueError as error:
                _log.warning("refused: %.200s", error)
                continue
            if key.stream not in TRUCK_DECODERS:
                continue
            try:
                # A router that cuts off a reader in the middle of a message leaves the rest of it
                # to the next one. A good copy follows, which must not count as known.
                _check_whole(received.payload, key, identity)
            except ValueError as error:
                fields = about(vehicle=key.identifier)
                _log.warning(
                    "refused %s of %s: %.200s", key.stream, key.identifier, error, extra=fields
                )
                continue
            if seen.add(key, identity):
                arrived = TruckMessage(key, *identity, received.payload, now_s)
                _put(arrivals, arrived, closing)
    alive.undeclare()  # type: ignore[no-untyped-call]
    other_realms.close()


def _check_whole(payload: bytes, key: Key, identity: Identity) -> None:
    """Raise ValueError for a malformed payload, or one that differs from its attachment."""
    message = TRUCK_DECODERS[key.stream](payload)
    if (message.boot_id, message.sequence) != identity:
        raise ValueError(
            f"says that it is {message.sequence} of boot {message.boot_id}, and came as "
            f"{identity.sequence} of boot {identity.boot_id}"
        )


def _put(arrivals: _Queue, item: TruckMessage | LivenessToken, closing: threading.Event) -> None:
    """Wait for room in the queue, but not beyond the end of the service."""
    while not closing.is_set():
        with contextlib.suppress(queue.Full):
            arrivals.put(item, timeout=_POLL_S)
            return


def _resume(service: WorkerService, earlier: EarlierRuns) -> None:
    """Resume earlier runs: republish what may not have been received, and finish the rest.

    Pending states of bridges are published once they are computed, while the worker listens.
    """
    again = [*earlier.unconfirmed, *(m for m in earlier.latched if m not in earlier.unconfirmed)]
    for message in again:
        _, owner, identifier, stream = message.key
        identity = Identity(message.boot_id, message.sequence)
        try:
            service.publisher.put(owner, identifier, stream, message.payload, identity)
        except ValueError as error:
            _log.warning("cannot republish: %s", error)
    finished = list(service.engine.resume(earlier.crossings, earlier.states()))
    service.process_outputs(finished)
    if earlier.previous is not None:
        _log.info(
            "%d messages of earlier runs, the last in %s; republished %d, finished %d",
            *(len(earlier.published), earlier.previous, len(again), len(finished)),
        )
    waited = [
        known.crossing_id
        for known in earlier.crossings
        if pb.WAITING_NOT_VALIDATED in known.states and not known.is_identified
    ]
    if waited:
        _log.warning(
            "%d crossings waited for a site validation when an earlier run ended (%s): they "
            "continue if their trucks still have them or they are in the logger's recordings",
            *(len(waited), ", ".join(waited[-_MAX_NAMED:])),
        )


def _serve(
    service: WorkerService,
    queued: _Queue,
    stop: threading.Event,
    ready: Callable[[], None] | None,
    backfill: Backfill | None = None,
    editing: SiteReload | None = None,
) -> None:
    """Identify until `stop`, and then finish what the next run could not receive again.

    After the stop this takes at most `GONE_AFTER_S`.
    """
    engine, execution, certificates = service.engine, service.execution, service.certificates
    arrivals = ArrivalQueue()
    warned: set[str] = set()
    next_health_s = soonest_health_s = next_catch_up_s = 0.0
    published_load: Workload | None = None
    leave_at_s = math.inf
    progress: tuple[VehicleBridgePair, float] | None = None
    now_s = time.monotonic()
    lag_s = 0.0
    if ready is not None:
        ready()
    # A truck that keeps sending also reaches the next run, so the worker does not wait for it.
    while now_s < leave_at_s and (
        not stop.is_set() or not queued.empty() or _has_undecided_departures(engine, arrivals)
    ):
        if time.monotonic() >= soonest_health_s or certificates.has_news:
            soonest_health_s = time.monotonic() + _SOONEST_HEALTH_S
            load = workload(engine, execution, backfill)
            is_due = time.monotonic() >= next_health_s or certificates.has_news
            if is_due or load != published_load:
                next_health_s = time.monotonic() + HEALTH_PERIOD_S
                certificates.has_news = False
                published_load = load
                service.publish_health(QueueLag(queued.qsize(), lag_s), load)
                lag_s = 0.0
        batch: list[TruckMessage] = []
        one = _next(queued)
        # After a long identification the queue holds the messages received meanwhile: their times
        # of reception decide whether a truck has left, not the times of their processing.
        now_s = time.monotonic() if one is None else one.received_s
        lag_s = max(lag_s, time.monotonic() - now_s)
        if isinstance(one, LivenessToken):
            arrivals.note(one)
        elif one is not None:
            engine.expect(one.key, one.payload)  # it may be processed behind another truck's
            batch += arrivals.add(one)
        # Keep this order: the messages in the queue are newer than a history that is due.
        for arrived in arrivals.due(now_s) + batch:
            if stop.is_set() and not arrivals.is_leaving(arrived.key):
                continue  # the truck sends it to the next run again
            name = f"{arrived.key.stream} of {arrived.key.identifier}"
            try:
                outputs = engine.feed(arrived.key, arrived.payload)
            except ValueError as error:
                _log.warning("refused %s: %s", name, error)
                continue
            service.process_outputs(outputs)
        if stop.is_set():
            leave_at_s = min(leave_at_s, time.monotonic() + GONE_AFTER_S)
            arrivals.hurry()
            certificates.end()
        for gone in arrivals.gone(now_s):
            service.process_outputs(engine.gone(gone.realm, gone.vehicle, for_good=gone.for_good))
        service.publish(collect(engine, execution))
        if not stop.is_set():
            passed = certificates.advance(time.monotonic(), engine.waiting_pairs)
            for pair, digest in passed.items():
                engine.certify(pair, digest)
            if certificates.progress not in (None, progress):
                progress = certificates.progress
                pair, share = progress
                validating = f"validating {pair}"
                _publish_progress(service.publisher, service.id, "", validating, share)
            if engine.has_released and execution.has_room:
                service.process_outputs(engine.release())
            if backfill is not None and time.monotonic() >= next_catch_up_s:
                next_catch_up_s = time.monotonic() + _CATCH_UP_EVERY_S
                outputs = backfill.advance(
                    engine,
                    time.monotonic(),
                    has_room=execution.is_idle and not engine.has_released,
                    want=certificates.request,
                )
                service.process_outputs(outputs)
        edited = None if stop.is_set() or editing is None else editing.edited(time.monotonic())
        if editing is not None and edited is not None:
            # Every result belongs to one site file: running tasks belong to the previous one.
            service.publish(drain(engine, execution))
            service.process_outputs(editing.retarget(edited))
            warned.clear()
        for vehicle in engine.unknown_vehicles - warned:
            warned.add(vehicle)
            fields = about(vehicle=vehicle)
            _log.warning("%s drives, but the site file has no such vehicle", vehicle, extra=fields)
    service.publish(drain(engine, execution))
    waiting = [name for names in engine.waiting().values() for name in names]
    if waiting:
        _log.warning(
            "%d crossings still wait for a site validation or a process (%s): the next run gets "
            "them from their trucks, or from the logger's recordings",
            *(len(waiting), ", ".join(waiting[-_MAX_NAMED:])),
        )


def _next(queued: _Queue) -> TruckMessage | LivenessToken | None:
    try:
        return queued.get(timeout=_POLL_S)
    except queue.Empty:
        return None


def _has_undecided_departures(engine: Engine, arrivals: ArrivalQueue) -> bool:
    """Return whether a departing truck may have a crossing that is not decided."""
    return any(waits or engine.has_undecided(*truck) for truck, waits in arrivals.leaving().items())


def _guard_engine(outputs: Iterable[Output]) -> Iterator[Output]:
    """Yield the engine's messages; blame an error within it on no message."""
    try:
        yield from outputs
    except ValueError as error:
        _log.error("internal error", exc_info=True)
        raise FailureError(f"a crossing could not be processed: {error}") from error


def _publish_progress(
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
