"""Offline identification of recordings, through the worker's own engine."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from pathlib import Path

from schemas.results import ResultHeader, Results, results
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import load_site, parse_site, site_hash
from schemas.topics import Message
from schemas.validation_records import METHOD_EDITION, VehicleBridgePair
from services.common.errors import InputError
from services.common.progress import Offset, no_progress
from services.execution.blas import one_blas_thread
from services.execution.dispatch import CrossingExecutor, dispatch, drain
from services.execution.inline import Report
from services.finding.order import (
    STREAMS,
    MessageIndex,
    Read,
    cached_reader,
    in_measurement_order,
    malformed,
)
from services.identification.bridge_state import NOTHING_STORED, FusionSettings, with_common_shares
from services.identification.engine import Engine
from services.identification.outputs import EngineOutput
from services.identification.waiting import Validations
from services.recordings.recording import program_version, read_messages, read_site

_log = logging.getLogger(__name__)


def site_of(recordings: list[Path], site: Path | None) -> Site:
    """Return the given site file, or the one stored in the first recording that has one."""
    if site is not None:
        return load_site(site)
    for path in recordings:
        text = read_site(path)
        if text is not None:
            return parse_site(text, f"{path}: site.toml")
    raise InputError(f"{recordings[0]}: no site file is stored in it, give one with --site")


def header_of(site: Site, settings: IdentificationSettings, created_s: float) -> ResultHeader:
    """Return the header of results; `created_s` is in seconds since 1970 UTC."""
    method_version = {"method_edition": METHOD_EDITION} if settings.method == "pre" else {}
    return ResultHeader(
        version=program_version(),
        created=created_s,
        site_hash=site_hash(site),
        settings=settings.model_dump(mode="json") | method_version,
        seed=settings.seed,
    )


def messages_of_trucks(
    recordings: Iterable[Path], next_file: Callable[[], Offset] = lambda: no_progress
) -> Read:
    """Return a reader of the trucks' messages; its first pass calls `next_file` at each file."""

    def of_files(watch: Callable[[], Offset]) -> Iterator[Message]:
        for path in recordings:
            for message in read_messages(path, watch()):
                if message.key.owner == "vehicle" and message.key.stream in STREAMS:
                    yield message

    return cached_reader(lambda again: of_files((lambda: no_progress) if again else next_file))


def identify_drives(
    drives: MessageIndex,
    site: Site,
    settings: IdentificationSettings,
    execution: CrossingExecutor,
    report: Report,
    fusing: FusionSettings = NOTHING_STORED,
    certificates: Mapping[VehicleBridgePair, str] | None = None,
) -> Results:
    """Identify all crossings in the drives, which are read again, message by message.

    The execution reports progress; `report` is called with the completion of every crossing.

    Raise InputError if the site has none of the trucks.
    """
    header = header_of(site, settings, time.time())
    fusing = fusing._replace(threads=settings.threads)
    engine = Engine(
        site,
        settings,
        header,
        fusing,
        validations=Validations(certificates or {}),
        publishes_states=False,
    )
    _check_vehicles(drives.name, site, drives.drove)
    for message in drives.near:
        engine.expect(message.key, message.payload, for_ever=True)
    with one_blas_thread():
        outputs = chain(
            chain.from_iterable(
                dispatch(engine, execution, _reported(drives.name, engine, message))
                for message in in_measurement_order(drives)
            ),
            dispatch(engine, execution, engine.finish()),
            drain(engine, execution),
            dispatch(engine, execution, engine.fuse_all()),
            drain(engine, execution),
        )
        found = []
        for output in outputs:
            if output.result is not None:
                report(output.result.crossing_id, "done", 1.0)
                found.append(output.result)
    found.sort(key=lambda crossing: crossing.entry_time)
    bridges = engine.bridges()
    return results(header, with_common_shares(found, bridges), bridges)


def _check_vehicles(name: str, site: Site, drove: set[str]) -> None:
    """Raise InputError if the site has none of the trucks; warn of each one that it lacks."""
    known = {vehicle.id for vehicle in site.vehicles}
    strangers = ", ".join(sorted(drove - known))
    if drove and not drove & known:
        raise InputError(f"{name}: {strangers} drove, but the site has no such vehicle")
    if strangers:
        _log.warning("%s also drove, but the site file has no such vehicle", strangers)


def _reported(name: str, engine: Engine, message: Message) -> Iterator[EngineOutput]:
    try:
        return engine.feed(message.key, message.payload)
    except ValueError as error:
        wrong = malformed(name, message, error)
        if message.key.stream == "info":  # it is not needed here
            _log.warning("%s", wrong)
            return iter(())
        raise wrong from error
