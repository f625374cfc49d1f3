"""Identifies crossings as they happen: from the bus to a results file, and from there to the bus.

Every crossing gets one result, whenever the worker is stopped or killed. A message is on the disk
before it is on the bus, so the results files know all that anybody may have heard. A new run reads
those of the runs before: what the bus may not have got it publishes again as it was, identity and
all; what was about to be said it says; and a crossing that has a result is not identified again.
One that has none is found again in what its truck still keeps (`cache` in the table of topics: the
last five minutes), or in the recordings that a logger made of it (`catching_up`).

Real crossings (realm `live`) are identified only where simulated ones of the same truck on the same
bridge have shown that the method recovers what was put in: until then they wait (`certificates`).

Longer than other modules, because what is told, kept and published of one message has one order.
"""

import contextlib
import logging
import math
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import zenoh

from schemas.certificates import Pair
from schemas.proto import driveby_pb2 as pb
from schemas.results import verdict_line
from schemas.settings import IdentificationSettings
from schemas.signals import TRUCK_DECODERS, Identity
from schemas.site_file import parse_site, read_site_text
from schemas.topics import (
    HEALTH_PERIOD_S,
    Key,
    check_identifier,
    check_realm,
    is_replayed,
    parse_key,
    selector,
)
from services.bus.credentials import check_speaks_for
from services.bus.hearing import DeafError, Hearing
from services.bus.listening import Elsewhere
from services.bus.playback import leave_at_once, set_by_signals, stopped_by_signals
from services.bus.publisher import Publisher
from services.bus.session import connected
from services.bus.subscription import Seen, Subscription
from services.common.errors import FailureError, InputError
from services.common.files import check_folder_writable
from services.execution.dispatch import Execution, awaited, collected, dispatched
from services.execution.offline import header_of
from services.execution.processes import Processes
from services.execution.watch import LIMIT_S, Limits
from services.history.baselines import baselines_of
from services.history.certificates import found_in
from services.history.result_files import (
    KNOWN_AGE_S,
    Earlier,
    ResultFiles,
    free_results_path,
    read_earlier,
)
from services.history.store import Ledger
from services.identification.bridge_state import Fusing
from services.identification.engine import Engine
from services.identification.known import search_hash
from services.identification.outputs import Output, Said
from services.recordings.recording import Message
from services.worker.arrivals import GONE_AFTER_S, Arrivals, Arrived, Token
from services.worker.catching_up import DAYS, MARGIN_S, CatchingUp, Source
from services.worker.certificates import Certificates
from services.worker.site_watch import Edited, SiteWatch

__all__ = ["run"]

_log = logging.getLogger(__name__)
_Queue = queue.Queue[Arrived | Token]
_POLL_S = 0.1
"""So late a stop, a token or a result is seen where no message comes."""
_LONGEST_QUEUE = 200_000
"""Messages: two hours of one truck, or a minute of a hundred. Then publishers wait."""
_LONGEST_NOTE = 1000
_SOONEST_HEALTH_S = 5.0
"""Who waits and what is identified may change many times a second: so often it is told at most."""
_MOST_NAMED = 10
"""Crossings in one line of the log."""
_CATCH_UP_EVERY_S = 0.2


class Editing(NamedTuple):
    """How an edited site file is noticed, and what is done with it."""

    watch: SiteWatch
    asked: threading.Event
    """Somebody asks to read it again."""
    retarget: Callable[[Edited], Iterator[Said]]

    def edited(self, now_s: float) -> Edited | None:
        """The site file, if it was edited since the last call."""
        is_asked = self.asked.is_set()
        if is_asked:  # who asks after the look is not forgotten
            self.asked.clear()
        return self.watch.edited(now_s, is_asked=is_asked)


class Service(NamedTuple):
    """What a run works with: who decides, who computes, and where what was found goes."""

    id: str
    engine: Engine
    execution: Execution
    certificates: Certificates
    publisher: Publisher
    files: ResultFiles

    def tell(self, outputs: Iterable[Output]) -> None:
        """Write each message to the disk and only then to the bus: nobody hears what may be lost.

        FailureError: one cannot be written or published.
        """
        for output in _worked_out(outputs):
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
                result = output.result
                _log.info("%s: %s", result.crossing_id, verdict_line(result))

    def go_on(self, said: Iterable[Said]) -> None:
        """Tell what the engine says, and have done what it wants done."""
        self.tell(dispatched(self.engine, self.execution, said, self.certificates.want))


class _Behind(NamedTuple):
    """What has come and has not been looked at."""

    messages: int
    lag_s: float
    """The longest that one has waited since this was told last."""


class _Backlog(NamedTuple):
    """What is not identified yet: how long it is under way does not change it."""

    under_way: tuple[str, ...]
    waiting: int
    waiting_for_certificate: int
    in_recordings: int


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
    What earlier runs left in that folder is taken up, unless this run has a `file` of its own or
    the realm is one of replays. Waits for the router for ever. `ready` is called once, when the
    worker listens. `tls` is a folder of credentials, see `open_session`. Crossings are identified
    in so many `processes` beside this one; one that takes more than `limit_s` of processor time
    for a crossing is ended.

    A crossing whose vehicle and bridge have no certificate in the folder `certificates` (by default
    one in `folder`) waits for one, which is made meanwhile: if `validate` says so, or says nothing
    and the realm is `live`.
    What nobody sends any more is taken from the logger's `recordings` (by default in `folder`) of
    the last so many days, unless this run has a `file` of its own or the realm is one of replays.
    InputError: a bad site file, realm or id, or a method that has no certificates. FailureError: a
    result or a certificate cannot be written.
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
    earlier = Earlier()
    catches_up, age_s = False, 0.0
    watch: SiteWatch | None = None
    if file is None:
        file = free_results_path(folder / realm)
        watch = SiteWatch(site, known)  # a file of its own has room for one site file
        if not is_replayed(realm):
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
        _log.warning("--skip-validation: crossings count that nobody has validated")
    ledger = Ledger(earlier.crossings, time.time())
    files = ResultFiles(file, text, header, earlier.previous, ledger.note)
    # A second signal: what was published is on the disk, and the next run takes it up.
    with stopped_by_signals(leave_at_once) as stop, contextlib.ExitStack() as stack:

        def report(crossing_id: str, stage: str, fraction: float) -> None:
            _say_progress(publisher, service_id, crossing_id, stage, fraction)

        execution = stack.enter_context(
            Processes(processes, report=report, limits=Limits(processor_s=limit_s))
        )
        bus = connected(endpoint, tls, stop.is_set)
        if bus is None:
            return 0
        stack.enter_context(bus)
        publisher = Publisher(bus, realm)
        engine = Engine(
            known,
            settings,
            header,
            fusing,
            certificates=found_in(certificates, known, settings),
            are_required=are_required,
        )
        engine.has_room = lambda: execution.has_room
        certified = Certificates(certificates, known, settings, execution)
        catching_up = None
        if catches_up:
            source = Source(recordings or folder, realm, age_s)
            catching_up = CatchingUp(source, known, settings, header, ledger)
            stack.callback(catching_up.close)
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
            service = Service(service_id, engine, execution, certified, publisher, files)
            _resume(service, earlier)
            del earlier  # of two days
            receiver.start()

            def retarget(edited: Edited) -> Iterator[Said]:
                now = header._replace(created=time.time(), site_hash=edited.hash)
                found = found_in(certificates, edited.site, settings)
                path = free_results_path(files.path.parent)
                files.begin_anew(path, edited.text, now)
                certified.retarget(edited.site)
                if catching_up is not None:
                    catching_up.retarget(edited.site, now)
                _log.info("%s was edited: %s counts now, results in %s", site, edited.hash, path)
                anew = fusing._replace(baselines=edited.baselines)
                yield from engine.retarget(edited.site, now, anew, found)

            with set_by_signals(signal.SIGHUP) as asked:
                editing = None if watch is None else Editing(watch, asked, retarget)
                _serve(service, arrivals, stop, ready, catching_up, editing)
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
    """Take everything off the bus quickly: an identification must not hold up a publisher.

    Sets `failed` if it cannot go on: a worker that hears nothing must not look alive.
    """
    try:
        _take_all(bus, realm, arrivals, closing)
    except Exception as error:  # whatever it is, nothing more would be heard
        if not closing.is_set():
            failed.set()
            unforeseen = not isinstance(error, zenoh.ZError | DeafError)
            _log.error("the connection to the bus failed: %s", error, exc_info=unforeseen)


def _take_all(
    bus: zenoh.Session,
    realm: str,
    arrivals: _Queue,
    closing: threading.Event,
) -> None:
    seen = Seen()
    elsewhere, is_told = Elsewhere(bus, realm), False
    tokens = selector(realm, "vehicle", "alive")
    alive = bus.liveliness().declare_subscriber(
        tokens, zenoh.handlers.FifoChannel(1000), history=True
    )
    hearing = Hearing(bus, tokens, elsewhere.alive)
    with Subscription(bus, selector(realm, "vehicle")) as vehicles:
        while not closing.is_set():
            received = vehicles.receive(_POLL_S)
            token = alive.handler.try_recv()
            now_s = time.monotonic()
            try:
                if token is not None:
                    key = parse_key(str(token.key_expr))
                    is_alive = token.kind == zenoh.SampleKind.PUT
                    hearing.heard(now_s)
                    _put(arrivals, Token(key.realm, key.identifier, is_alive, now_s), closing)
                if received is None:
                    elsewhere.look()
                    hearing.look(now_s)
                    if not is_told and not seen.streams and (line := elsewhere.line()):
                        is_told = True
                        _log.warning("%s", line)
                    continue
                hearing.heard(now_s)
                key, identity = received.key(), received.identity()
            except ValueError as error:
                _log.warning("refused: %.200s", error)
                continue
            if key.stream not in TRUCK_DECODERS:
                continue
            try:
                # A router that cuts off a reader in the middle of a message leaves the rest of it
                # to whatever comes next. A good copy follows, which must not be taken for known.
                _check_whole(received.payload, key, identity)
            except ValueError as error:
                _log.warning("refused %s of %s: %.200s", key.stream, key.identifier, error)
                continue
            if seen.add(key, identity):
                arrived = Arrived(key, identity.boot_id, received.payload, now_s)
                _put(arrivals, arrived, closing)
    alive.undeclare()  # type: ignore[no-untyped-call]
    elsewhere.close()


def _check_whole(payload: bytes, key: Key, identity: Identity) -> None:
    """ValueError: the payload is malformed, or of another message than its attachment says."""
    message = TRUCK_DECODERS[key.stream](payload)
    if (message.boot_id, message.sequence) != identity:
        raise ValueError(
            f"says that it is {message.sequence} of boot {message.boot_id}, and came as "
            f"{identity.sequence} of boot {identity.boot_id}"
        )


def _put(arrivals: _Queue, item: Arrived | Token, closing: threading.Event) -> None:
    """Wait for room in the queue, but not beyond the end of the service."""
    while not closing.is_set():
        with contextlib.suppress(queue.Full):
            arrivals.put(item, timeout=_POLL_S)
            return


def _resume(service: Service, earlier: Earlier) -> None:
    """Take up what earlier runs left: say again what may not have been heard, finish the rest.

    States of bridges that they owe are told when they have been made, while others are listened to.
    """
    again = [*earlier.unsure, *(m for m in earlier.latched if m not in earlier.unsure)]
    for message in again:
        _, owner, identifier, stream = message.key
        identity = Identity(message.boot_id, message.sequence)
        try:
            service.publisher.put(owner, identifier, stream, message.payload, identity)
        except ValueError as error:
            _log.warning("not published again: %s", error)
    finished = list(service.engine.resume(earlier.crossings, earlier.states()))
    service.go_on(finished)
    if earlier.previous is not None:
        _log.info(
            "%d messages of earlier runs, the last in %s; published again %d, finished %d",
            *(len(earlier.said), earlier.previous, len(again), len(finished)),
        )
    waited = [
        known.crossing_id
        for known in earlier.crossings
        if pb.WAITING_NOT_VALIDATED in known.states and not known.is_identified
    ]
    if waited:
        _log.warning(
            "%d crossings waited for a certificate when an earlier run ended (%s): they go on if "
            "their trucks still have them or they are in the logger's recordings",
            *(len(waited), ", ".join(waited[-_MOST_NAMED:])),
        )


def _serve(
    service: Service,
    queued: _Queue,
    stop: threading.Event,
    ready: Callable[[], None] | None,
    catching_up: CatchingUp | None = None,
    editing: Editing | None = None,
) -> None:
    """Identify until `stop`, and then what nobody would give to the next run.

    Of that only what comes until `GONE_AFTER_S` after the stop was seen.
    """
    engine, execution, certificates = service.engine, service.execution, service.certificates
    arrivals = Arrivals()
    told: set[str] = set()
    next_health_s = soonest_health_s = next_catch_up_s = 0.0
    told_backlog: _Backlog | None = None
    leave_at_s = math.inf
    progress: tuple[Pair, float] | None = None
    now_s = time.monotonic()
    lag_s = 0.0
    if ready is not None:
        ready()
    # Who goes on talking goes on to the next run, too: what comes so late is not waited for.
    while now_s < leave_at_s and (
        not stop.is_set() or not queued.empty() or _may_lose(engine, arrivals)
    ):
        if time.monotonic() >= soonest_health_s or certificates.has_news:
            soonest_health_s = time.monotonic() + _SOONEST_HEALTH_S
            backlog = _backlog(engine, execution, catching_up)
            is_due = time.monotonic() >= next_health_s or certificates.has_news
            if is_due or backlog != told_backlog:
                next_health_s = time.monotonic() + HEALTH_PERIOD_S
                certificates.has_news = False
                told_backlog = backlog
                behind = _Behind(queued.qsize(), lag_s)
                _say_health(service, behind, backlog)
                lag_s = 0.0
        batch: list[Arrived] = []
        one = _next(queued)
        # After a long identification the queue holds what came meanwhile: whether a truck has gone
        # is told by when its messages came, not by when they are looked at.
        now_s = time.monotonic() if one is None else one.received_s
        lag_s = max(lag_s, time.monotonic() - now_s)
        if isinstance(one, Token):
            arrivals.note(one)
        elif one is not None:
            engine.expect(one.key, one.payload)  # its own turn may come after another truck's
            batch += arrivals.add(one)
        # In this order: what has come in the queue is newer than a history that is due.
        for arrived in arrivals.due(now_s) + batch:
            if stop.is_set() and not arrivals.is_leaving(arrived.key):
                continue  # the next run gets it from the truck again
            name = f"{arrived.key.stream} of {arrived.key.identifier}"
            try:
                outputs = engine.feed(arrived.key, arrived.payload)
            except ValueError as error:
                _log.warning("refused %s: %s", name, error)
                continue
            service.go_on(outputs)
        if stop.is_set():
            leave_at_s = min(leave_at_s, time.monotonic() + GONE_AFTER_S)
            arrivals.hurry()
            certificates.end()
        for gone in arrivals.gone(now_s):
            service.go_on(engine.gone(gone.realm, gone.vehicle, for_good=gone.for_good))
        service.tell(collected(engine, execution))
        if not stop.is_set():
            passed = certificates.advance(time.monotonic(), engine.pairs_that_wait)
            for pair, digest in passed.items():
                engine.certify(pair, digest)
            if certificates.progress not in (None, progress):
                progress = certificates.progress
                pair, share = progress
                validating = f"validating {pair}"
                _say_progress(service.publisher, service.id, "", validating, share)
            if engine.has_released and execution.has_room:
                service.go_on(engine.release())
            if catching_up is not None and time.monotonic() >= next_catch_up_s:
                next_catch_up_s = time.monotonic() + _CATCH_UP_EVERY_S
                said = catching_up.advance(
                    engine,
                    time.monotonic(),
                    has_room=execution.is_idle and not engine.has_released,
                    want=certificates.want,
                )
                service.go_on(said)
        edited = None if stop.is_set() or editing is None else editing.edited(time.monotonic())
        if editing is not None and edited is not None:
            # Every result belongs to one site file: what is under way still to that of before.
            service.tell(awaited(engine, execution))
            service.go_on(editing.retarget(edited))
            told.clear()
        for vehicle in engine.unknown_vehicles - told:
            told.add(vehicle)
            _log.warning("%s drives, but the site file has no such vehicle", vehicle)
    service.tell(awaited(engine, execution))
    waiting = [name for names in engine.waiting().values() for name in names]
    if waiting:
        _log.warning(
            "%d crossings still wait for a certificate or a process (%s): the next run gets them "
            "from their trucks, or from the logger's recordings",
            *(len(waiting), ", ".join(waiting[-_MOST_NAMED:])),
        )


def _next(queued: _Queue) -> Arrived | Token | None:
    try:
        return queued.get(timeout=_POLL_S)
    except queue.Empty:
        return None


def _may_lose(engine: Engine, arrivals: Arrivals) -> bool:
    """Whether a truck that is about to leave may have a crossing that is not decided."""
    return any(waits or engine.has_undecided(*truck) for truck, waits in arrivals.leaving().items())


def _worked_out(outputs: Iterable[Output]) -> Iterator[Output]:
    """What the engine says; an error of its own is nobody's message to blame."""
    try:
        yield from outputs
    except ValueError as error:
        _log.error("an error of the program", exc_info=True)
        raise FailureError(f"a crossing could not be worked out: {error}") from error


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


def _backlog(engine: Engine, execution: Execution, catching_up: CatchingUp | None) -> _Backlog:
    waiting = {pair: len(names) for pair, names in engine.waiting().items()}
    ready = sum(number for pair, number in waiting.items() if engine.is_certified(pair))
    return _Backlog(
        tuple(one.crossing_id for one in execution.under_way),
        execution.waiting + ready,
        sum(waiting.values()) - ready,
        0 if catching_up is None else catching_up.waiting,
    )


def _say_health(service: Service, behind: _Behind, backlog: _Backlog) -> None:
    under_way, note = service.execution.under_way, service.certificates.note
    notes = [f"{name} is being identified for {seconds:.0f} s" for name, seconds in under_way]
    notes += [f"{backlog.waiting} wait for a process"] if backlog.waiting else []
    notes += [f"{backlog.in_recordings} wait in recordings"] if backlog.in_recordings else []
    notes += [note] if note else []
    health = pb.Health(
        schema_version=1,
        time_ns=time.time_ns(),
        service=service.id,
        ok=True,
        figures={
            "queue": float(behind.messages),
            "lag_s": behind.lag_s,
            "identifying": float(len(under_way)),
            "identifying_longest_s": max((one.seconds for one in under_way), default=0.0),
            "waiting_for_process": float(backlog.waiting),
            "waiting_for_certificate": float(backlog.waiting_for_certificate),
            "waiting_in_recordings": float(backlog.in_recordings),
        },
        note="; ".join(notes)[:_LONGEST_NOTE],
    )
    service.publisher.put("service", service.id, "health", health.SerializeToString())
