"""Live identification of crossings: from the bus to a results file, and from there to the bus.

Every crossing gets one result, whenever the worker is stopped or killed. One without a result is
detected again in the data that its truck still keeps (`cache` in the table of topics), or in a
logger's recordings (`backfill`).

Real crossings (realm `live`) wait until simulated ones of the same truck on the same bridge have
shown that the method recovers the truth (`validation_runner`).
"""

import contextlib
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import zenoh

from schemas.settings import IdentificationSettings
from schemas.site_file import parse_site, read_site_text
from schemas.topics import check_identifier, check_realm, is_from_recording, key
from services.bus.credentials import check_speaks_for
from services.bus.playback import leave_at_once, set_by_signals, stopped_by_signals
from services.bus.presence import sessions_publishing
from services.bus.publisher import Publisher
from services.bus.session import wait_for_router
from services.common.errors import FailureError, InputError
from services.common.files import check_folder_writable, lock_folder
from services.common.naming import count_of
from services.execution.hang_watchdog import TaskLimits
from services.execution.offline import header_of
from services.execution.processes import ProcessExecutor
from services.history.validation_files import passed_validations
from services.identification.bridge_state import FusionSettings
from services.identification.engine import Engine
from services.identification.known import search_hash
from services.identification.methods import METHODS
from services.identification.waiting import Validations
from services.ledger.baselines import baselines_of
from services.ledger.crossing_log import Ledger
from services.ledger.cut_off_results import recover_cut_off_results
from services.ledger.runs import (
    KNOWN_AGE_S,
    EarlierRuns,
    ResultFiles,
    free_results_path,
    read_earlier,
)
from services.worker.backfill import MARGIN_S, Backfill
from services.worker.loop import Loop, SiteReload
from services.worker.receiving import MessageReceiver
from services.worker.recording_list import BackfillSource
from services.worker.service import Search, WorkerService, publish_progress
from services.worker.settings import WorkerSettings
from services.worker.site_file_watcher import SiteFileWatcher, warn_of_simulated
from services.worker.validation_runner import ValidationRunner

_log = logging.getLogger(__name__)
_DAY_S = 86_400.0
_NAMESAKE_S = 1.0
"""Longest wait in s for the router to name workers of the same id."""
_LOCK = ".worker.lock"
_IN_USE = (
    "another worker writes its results here; stop it first, or give this one another --realm or "
    "--folder"
)


def run(asked: WorkerSettings, ready: Callable[[], None] | None = None) -> int:
    """Identify all crossings of a realm until SIGINT or SIGTERM; return 0.

    Results are written to `folder/REALM/results-TIME.mcap` and `.json` next to it, and published.
    Unless it has a `file` of its own or the realm is one of replays, the run resumes what earlier
    runs left there, and reads data that trucks no longer send from the logger's `recordings`. It
    waits for the router without limit. `ready` is called once, when the worker listens.
    InputError: a bad site file, realm or id, a method without validation, or a folder of results
    that another worker writes. FailureError: a result or a validation record cannot be written.
    """
    _check(asked)
    search = _search(asked)
    with _locked_folder(asked):
        return _run(asked, search, ready)


def _run(asked: WorkerSettings, search: Search, ready: Callable[[], None] | None) -> int:
    file = asked.file or free_results_path(asked.folder / asked.realm)
    # A file of its own has room for one site file.
    watch = SiteFileWatcher(asked.site, search.site, asked.realm) if asked.file is None else None
    earlier = _earlier_runs(asked, search)
    _check_writable(asked, file, search.certificates)
    ledger = Ledger(earlier.crossings, time.time())
    files = ResultFiles(file, search.site_toml, search.header, earlier.previous, ledger.note)
    # After a second signal: published messages are on the disk, and the next run resumes.
    with stopped_by_signals(leave_at_once) as stop, contextlib.ExitStack() as stack:

        def report(crossing_id: str, stage: str, fraction: float) -> None:
            publish_progress(publisher, asked.service_id, crossing_id, stage, fraction)

        _log.info("starting: loading kernels")
        limits = TaskLimits(processor_s=asked.limit_s)
        execution = stack.enter_context(
            ProcessExecutor(asked.processes, report=report, limits=limits)
        )
        bus = wait_for_router(asked.address, asked.tls, stop.is_set)
        if bus is None:
            _log.info("stopped by a signal before a router answered")
            return 0
        stack.enter_context(bus)
        _warn_of_namesake(bus, asked)
        publisher = Publisher(bus, asked.realm)
        engine = _engine(asked, search, execution)
        certified = ValidationRunner(search.certificates, search.site, search.settings, execution)
        service = WorkerService(asked.service_id, engine, execution, certified, publisher, files)
        service.site_fit.retarget(search.site.bridges)
        backfill = _backfill(asked, search, ledger)
        if backfill is not None:
            stack.callback(backfill.close)
        execution.wait_until_warm()
        receiver = MessageReceiver(bus, asked.realm, stop.set, service.refused)
        try:
            service.resume(earlier)
            del earlier  # it covers two days
            receiver.start()
            with set_by_signals(signal.SIGHUP) as requested:
                editing = None if watch is None else SiteReload(watch, requested, search)
                Loop(service, receiver.queued, stop, backfill, editing).run(ready)
            service.publish_end()
        except BaseException:
            files.abandon()
            raise
        finally:
            receiver.close()
            publisher.close()
        if receiver.has_failed:
            files.abandon()
            raise FailureError(f"{asked.address}: the connection to the bus failed, see the log")
        files.finish()
    _log.info("stopped by a signal; %s in this run", count_of(service.verdicts.total(), "result"))
    return 0


def _check(asked: WorkerSettings) -> None:
    """Raise InputError for a name, or for a method that cannot be validated."""
    try:
        check_realm(asked.realm)
        check_identifier(asked.service_id)
    except ValueError as error:
        raise InputError(str(error)) from None
    check_speaks_for(asked.tls, "worker", asked.service_id)
    if asked.records_are_required and not METHODS[asked.search_method].has_noise_model:
        method = asked.search_method.replace("_", "-")
        raise InputError(
            f"--method {method}: has no site validation, which realm live and --validate-first "
            "require; use --method pre or --skip-validation"
        )


def _warn_of_namesake(bus: zenoh.Session, asked: WorkerSettings) -> None:
    """Log that another worker of this id runs in the realm, whose results go elsewhere."""
    health = key(asked.realm, "service", asked.service_id, "health")
    if sessions_publishing(bus, health, _NAMESAKE_S):
        _log.warning(
            "another worker %s runs in realm %s and identifies the same crossings; stop one of "
            "them, or give this one another --id",
            *(asked.service_id, asked.realm),
        )


@contextlib.contextmanager
def _locked_folder(asked: WorkerSettings) -> Iterator[None]:
    """Hold the lock of the folder of results, complete after a kill, if the run writes there."""
    if asked.file is not None:
        yield
        return
    lock = lock_folder(asked.folder / asked.realm, _LOCK, _IN_USE)
    try:
        recover_cut_off_results(asked.folder / asked.realm)
        yield
    finally:
        os.close(lock)


def _search(asked: WorkerSettings) -> Search:
    text = read_site_text(asked.site)
    site = parse_site(text, str(asked.site))
    settings = IdentificationSettings.model_validate({"method": asked.search_method})
    header = header_of(site, settings, time.time())
    baselines = baselines_of(site, asked.site.parent)
    warn_of_simulated(asked.realm, baselines)
    fusing = FusionSettings(baselines.states, threads=settings.threads)
    certificates = asked.certificates or asked.folder / "certificates"
    return Search(asked.site, text, site, settings, header, fusing, certificates)


def _catches_up(asked: WorkerSettings) -> bool:
    return asked.file is None and not is_from_recording(asked.realm) and asked.recordings_days > 0.0


def _earlier_runs(asked: WorkerSettings, search: Search) -> EarlierRuns:
    if asked.file is not None:
        return EarlierRuns()
    age_s = asked.recordings_days * _DAY_S + MARGIN_S if _catches_up(asked) else 0.0
    earlier = read_earlier(
        asked.folder / asked.realm,
        asked.realm,
        time.time(),
        search_hash(search.header),
        search.fusing,
        max(KNOWN_AGE_S, age_s),
    )
    # Reading completes JSON files; results of an earlier replay do not count.
    return EarlierRuns() if is_from_recording(asked.realm) else earlier


def _check_writable(asked: WorkerSettings, file: Path, certificates: Path) -> None:
    """Raise InputError if the results or the validation records cannot be written."""
    check_folder_writable(file.parent)
    if file.exists():
        raise InputError(f"{file}: exists, and results are never overwritten; give another name")
    if asked.records_are_required:
        check_folder_writable(certificates)
    elif asked.realm == "live":
        _log.warning("site validation is off (--skip-validation)")


def _engine(asked: WorkerSettings, search: Search, execution: ProcessExecutor) -> Engine:
    return Engine(
        search.site,
        search.settings,
        search.header,
        search.fusing,
        validations=Validations(
            passed_validations(search.certificates, search.site, search.settings),
            asked.records_are_required,
        ),
        has_room=lambda: execution.has_room,
    )


def _backfill(asked: WorkerSettings, search: Search, ledger: Ledger) -> Backfill | None:
    if not _catches_up(asked):
        return None
    folder = asked.recordings or asked.folder
    source = BackfillSource(folder, asked.realm, asked.recordings_days * _DAY_S)
    return Backfill(source, search.site, search.settings, ledger)
