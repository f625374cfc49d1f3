"""The steps of a running worker, one method each, in the order in which they repeat."""

import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from schemas.topics import HEALTH_PERIOD_S
from schemas.validation_records import VehicleBridgePair
from services.common.log_lines import about
from services.common.naming import count_of
from services.execution.dispatch import collect, drain
from services.history.validation_files import passed_validations
from services.identification.outputs import EngineOutput
from services.ledger.runs import free_results_path
from services.worker.arrivals import GONE_AFTER_S, ArrivalQueue, LivenessToken, TruckMessage
from services.worker.backfill import Backfill
from services.worker.health import QueueLag, Workload, workload
from services.worker.receiving import POLL_S, ArrivalsQueue
from services.worker.service import Search, WorkerService, named, publish_progress
from services.worker.site_file_watcher import EditedSite, SiteFileWatcher

_log = logging.getLogger(__name__)
_SOONEST_HEALTH_S: Final = 5.0
"""Shortest time in s between two health messages, as the backlog may change often."""
_CATCH_UP_EVERY_S: Final = 0.2


class SiteReload(NamedTuple):
    """Detection of an edited site file, and its adoption."""

    watch: SiteFileWatcher
    requested: threading.Event
    """Set when a reload is requested."""
    first: Search
    """The search with which the run began."""

    def edited(self, now_s: float) -> EditedSite | None:
        """Return the site file, if it was edited since the last call."""
        is_asked = self.requested.is_set()
        if is_asked:  # a request after this check is not lost
            self.requested.clear()
        return self.watch.edited(now_s, is_asked=is_asked)

    def retarget(
        self, service: WorkerService, backfill: Backfill | None, edited: EditedSite
    ) -> Iterator[EngineOutput]:
        """Continue with the edited file, and with results files of its own."""
        first = self.first
        header = first.header._replace(created=time.time(), site_hash=edited.hash)
        found = passed_validations(first.certificates, edited.site, first.settings)
        path = free_results_path(service.files.path.parent)
        service.files.rotate(path, edited.text, header)
        service.certificates.retarget(edited.site)
        service.site_fit.retarget(edited.site.bridges)
        if backfill is not None:
            backfill.retarget(edited.site)
        _log.info("%s was edited: %s applies now, results in %s", first.path, edited.hash, path)
        fusing = first.fusing._replace(baselines=edited.baselines.states)
        yield from service.engine.retarget(edited.site, header, fusing, found)


class Loop:
    """Repetition of the steps until `stop`, and then until the present crossings are finished.

    Crossings of trucks that have left are finished, because the next run would not receive their
    data. After the stop the loop waits at most `GONE_AFTER_S` for departing trucks.
    """

    def __init__(
        self,
        service: WorkerService,
        queued: ArrivalsQueue,
        stop: threading.Event,
        backfill: Backfill | None = None,
        editing: SiteReload | None = None,
    ) -> None:
        self._service, self._engine = service, service.engine
        self._queued, self._stop = queued, stop
        self._backfill, self._editing = backfill, editing
        self._arrivals = ArrivalQueue()
        self._warned: set[str] = set()
        self._next_health_s = self._soonest_health_s = self._next_catch_up_s = 0.0
        self._load: Workload | None = None
        """Counts of the last health message."""
        self._lag_s = 0.0
        self._progress: tuple[VehicleBridgePair, float] | None = None
        self._leave_at_s = math.inf
        self._now_s = time.monotonic()
        """Time of reception of the current message, else the present."""

    def run(self, ready: Callable[[], None] | None = None) -> None:
        """Identify until the stop; `ready` is called once at the beginning."""
        if ready is not None:
            ready()
        while self._goes_on():
            self.publish_health()
            self.feed(self.receive())
            if self._stop.is_set():
                self.hurry()
            self.decide_departures()
            self._service.publish(collect(self._engine, self._service.execution))
            if not self._stop.is_set():
                self.validate()
                self.catch_up()
            if not self._stop.is_set():
                self.reread_site()
            self.warn_of_unknown_vehicles()
        self.finish()

    def _goes_on(self) -> bool:
        # A truck that keeps sending also reaches the next run, so the worker does not wait for it.
        return self._now_s < self._leave_at_s and (
            not self._stop.is_set() or not self._queued.empty() or self._has_undecided_departures()
        )

    def _has_undecided_departures(self) -> bool:
        """Return whether a departing truck may have a crossing that is not decided."""
        return any(
            waits or self._engine.has_undecided(*truck)
            for truck, waits in self._arrivals.leaving().items()
        )

    def publish_health(self) -> None:
        """Publish health when it is due, and earlier when the backlog has changed."""
        service, has_news = self._service, self._service.certificates.has_news
        if time.monotonic() < self._soonest_health_s and not has_news:
            return
        self._soonest_health_s = time.monotonic() + _SOONEST_HEALTH_S
        load = workload(self._engine, service.execution, self._backfill)
        if time.monotonic() >= self._next_health_s or has_news or load != self._load:
            self._next_health_s = time.monotonic() + HEALTH_PERIOD_S
            service.certificates.has_news = False
            self._load = load
            refused = service.refused.total()
            service.publish_health(QueueLag(self._queued.qsize(), self._lag_s, refused), load)
            self._lag_s = 0.0

    def receive(self) -> list[TruckMessage]:
        """Wait for the next message or token; return the messages whose turn it is."""
        batch: list[TruckMessage] = []
        one = self._next()
        # After a long identification the queue holds the messages received meanwhile: their times
        # of reception decide whether a truck has left, not the times of their processing.
        self._now_s = time.monotonic() if one is None else one.received_s
        self._lag_s = max(self._lag_s, time.monotonic() - self._now_s)
        if isinstance(one, LivenessToken):
            self._arrivals.note(one)
        elif one is not None:
            self._engine.expect(one.key, one.payload)  # it may be fed behind another truck's
            batch += self._arrivals.add(one)
        # Keep this order: the messages in the queue are newer than a history that is due.
        return self._arrivals.due(self._now_s) + batch

    def _next(self) -> TruckMessage | LivenessToken | None:
        try:
            return self._queued.get(timeout=POLL_S)
        except queue.Empty:
            return None

    def feed(self, messages: list[TruckMessage]) -> None:
        """Feed the engine, and publish what follows."""
        for one in messages:
            if self._stop.is_set() and not self._arrivals.is_leaving(one.key):
                continue  # the truck sends it to the next run again
            try:
                self._service.site_fit.note(one.key, one.payload, self._now_s)
                outputs = self._engine.feed(one.key, one.payload)
            except ValueError as error:
                name = f"{one.key.stream} of {one.key.identifier}"
                _log.warning("refused %s: %s", name, error)
                self._service.refused["engine"] += 1
                continue
            self._service.process_outputs(outputs)

    def hurry(self) -> None:
        """Shorten all waiting after the stop; log once what is still finished."""
        if self._leave_at_s == math.inf:
            execution = self._service.execution
            left = count_of(len(execution.running) + execution.waiting, "crossing")
            _log.info("stopping: finishing %s; a second signal ends at once", left)
        self._leave_at_s = min(self._leave_at_s, time.monotonic() + GONE_AFTER_S)
        self._arrivals.hurry()
        self._service.certificates.end()

    def decide_departures(self) -> None:
        """Decide the crossings of trucks that have left."""
        for gone in self._arrivals.gone(self._now_s):
            outputs = self._engine.gone(gone.realm, gone.vehicle, for_good=gone.for_good)
            self._service.process_outputs(outputs)

    def validate(self) -> None:
        """Advance the validation of trucks and bridges; release the crossings that waited."""
        service, engine, certificates = self._service, self._engine, self._service.certificates
        passed = certificates.advance(time.monotonic(), engine.waiting_pairs)
        for pair, digest in passed.items():
            engine.certify(pair, digest)
        if certificates.progress not in (None, self._progress):
            self._progress = certificates.progress
            pair, share = self._progress
            publish_progress(service.publisher, service.id, "", f"validating {pair}", share)
        if engine.has_released and service.execution.has_room:
            service.process_outputs(engine.release())

    def catch_up(self) -> None:
        """Take crossings from recordings while no crossing of a live truck waits."""
        if self._backfill is None or time.monotonic() < self._next_catch_up_s:
            return
        self._next_catch_up_s = time.monotonic() + _CATCH_UP_EVERY_S
        outputs = self._backfill.advance(
            self._engine,
            time.monotonic(),
            has_room=self._service.execution.is_idle and not self._engine.has_released,
            want=self._service.certificates.request,
        )
        self._service.process_outputs(outputs)

    def reread_site(self) -> None:
        """Adopt the site file if it was edited."""
        if self._editing is None or (edited := self._editing.edited(time.monotonic())) is None:
            return
        # Every result belongs to one site file: running tasks belong to the previous one.
        self._service.publish(drain(self._engine, self._service.execution))
        outputs = self._editing.retarget(self._service, self._backfill, edited)
        self._service.process_outputs(outputs)
        self._warned.clear()

    def warn_of_unknown_vehicles(self) -> None:
        """Log each vehicle that the site file does not have, once."""
        for vehicle in self._engine.unknown_vehicles - self._warned:
            self._warned.add(vehicle)
            fields = about(vehicle=vehicle)
            _log.warning("%s drives, but the site file has no such vehicle", vehicle, extra=fields)

    def finish(self) -> None:
        """Publish the results of running tasks, and log the crossings left to the next run."""
        self._service.publish(drain(self._engine, self._service.execution))
        waiting = [name for names in self._engine.waiting().values() for name in names]
        if waiting:
            _log.warning(
                "%s still waiting for a site validation or a process (%s); the next run gets them "
                "from their trucks or from the logger's recordings",
                *(count_of(len(waiting), "crossing"), named(waiting)),
            )
