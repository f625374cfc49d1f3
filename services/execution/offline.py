"""Recordings become results, offline, through the worker's own engine."""

import logging
import time
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path

from schemas.certificates import Pair
from schemas.results import Header, Results, results
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import load_site, parse_site, site_hash
from services.common.errors import InputError
from services.execution.blas import one_blas_thread
from services.execution.dispatch import Execution, awaited, dispatched
from services.execution.here import Here, Report
from services.execution.overview import (
    Overview,
    as_they_were_made,
    look_over,
    malformed,
    messages_of_trucks,
)
from services.identification.bridge_state import NOTHING_STORED, Fusing, with_common_shares
from services.identification.engine import Engine
from services.identification.identify import Keep
from services.identification.outputs import Said
from services.recordings.recording import Message, program_version, read_site

_log = logging.getLogger(__name__)


def _unwatched(crossing_id: str, stage: str, fraction: float) -> None:
    """For who does not want to know how far a crossing is."""


def site_of(recordings: list[Path], site: Path | None) -> Site:
    """The site file given, or else the one stored in the first recording that has one."""
    if site is not None:
        return load_site(site)
    for path in recordings:
        text = read_site(path)
        if text is not None:
            return parse_site(text, f"{path}: site.toml")
    raise InputError(f"{recordings[0]}: no site file is stored in it, give one with --site")


def header_of(site: Site, settings: IdentificationSettings, created_s: float) -> Header:
    """What results say of how they came about; `created_s` is in seconds since 1970 UTC."""
    return Header(
        version=program_version(),
        created=created_s,
        site_hash=site_hash(site),
        settings=settings.model_dump(mode="json"),
        seed=settings.seed,
    )


def identify_recordings(
    recordings: list[Path],
    site: Site,
    settings: IdentificationSettings,
    report: Report = _unwatched,
    keep: Keep = lambda crossing_id, draws: None,
    fusing: Fusing = NOTHING_STORED,
    certificates: Mapping[Pair, str] | None = None,
) -> Results:
    """Results of all crossings in the recordings, in order of time; `keep` is given their draws.

    They name the `certificates` of their vehicles and bridges, where there are such.
    """
    name = ", ".join(str(path) for path in recordings)
    overview = look_over(name, messages_of_trucks(recordings), site)
    return identify_drives(overview, site, settings, report, keep, fusing, certificates)


def identify_drives(
    drives: Overview,
    site: Site,
    settings: IdentificationSettings,
    report: Report = _unwatched,
    keep: Keep = lambda crossing_id, draws: None,
    fusing: Fusing = NOTHING_STORED,
    certificates: Mapping[Pair, str] | None = None,
    execution: Execution | None = None,
) -> Results:
    """Results of all crossings in the drives, which are read again, message by message.

    `report` is told of every crossing how far it is, and in the end that all of it is done; how far
    and with which draws an `execution` elsewhere (None: here) tells by itself.
    InputError if the site knows none of the trucks.
    """
    header = header_of(site, settings, time.time())
    fusing = fusing._replace(threads=settings.threads)
    engine = Engine(site, settings, header, fusing, certificates=certificates, tells_states=False)
    execution = Here(report=report, keep=keep) if execution is None else execution
    _check_vehicles(drives.name, site, drives.drove)
    for message in drives.near:
        engine.expect(message.key, message.payload, for_ever=True)
    with one_blas_thread():
        outputs = chain(
            chain.from_iterable(
                dispatched(engine, execution, _said(drives.name, engine, message))
                for message in as_they_were_made(drives)
            ),
            dispatched(engine, execution, engine.finish()),
            awaited(engine, execution),
            dispatched(engine, execution, engine.fuse_all()),
            awaited(engine, execution),
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
    """InputError if the site knows none of the trucks; a warning for each that it does not know."""
    known = {vehicle.id for vehicle in site.vehicles}
    strangers = ", ".join(sorted(drove - known))
    if drove and not drove & known:
        raise InputError(f"{name}: {strangers} drove, but the site has no such vehicle")
    if strangers:
        _log.warning("%s drove too, but the site has no such vehicle", strangers)


def _said(name: str, engine: Engine, message: Message) -> Iterator[Said]:
    try:
        return engine.feed(message.key, message.payload)
    except ValueError as error:
        wrong = malformed(name, message, error)
        if message.key.stream == "info":  # nothing that it could say is needed
            _log.warning("%s", wrong)
            return iter(())
        raise wrong from error
