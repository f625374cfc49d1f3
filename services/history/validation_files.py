"""Validation records of a folder: writing them, the passed ones, and what is not validated."""

import logging
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from schemas.results import CrossingResult
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.validation_records import (
    LEAST_COVERAGE,
    ValidationCrossing,
    ValidationRecord,
    VehicleBridgePair,
    load_validation,
    pair_hash,
    validation_json,
    validation_path,
)
from services.common.errors import InputError
from services.common.files import make_folder, write_atomically
from services.common.language import ENGLISH, Language
from services.common.truck_choice import truck_to_try

_log = logging.getLogger(__name__)

_MAX_REASONS = 2
"""Maximum number of reasons that a failed validation is explained by."""


def save(folder: Path, certificate: ValidationRecord) -> Path:
    """Write a validation record; return its path. Raise InputError or FailureError on failure."""
    make_folder(folder)
    path = validation_path(folder, certificate.hash)
    write_atomically(path, validation_json(certificate))
    return path


def check_validations(folder: Path | None) -> None:
    """Raise InputError for an invalid folder of validation records; None is valid."""
    if folder is not None and not folder.is_dir():
        raise InputError(f"--validations: {folder} is not a folder of validation records")


def passed_validations(
    folder: Path, site: Site, settings: IdentificationSettings
) -> dict[VehicleBridgePair, str]:
    """Return the hash of the passed validation record, by pair of a site that has one.

    An unreadable file is a warning; an absent folder has none.
    """
    vehicles = {vehicle.id for vehicle in site.vehicles}
    bridges = {bridge.id for bridge in site.bridges}
    found = {}
    for path in sorted(folder.glob("*.json")):
        one = _readable(path)
        if one is None:
            continue
        is_ours = one.vehicle in vehicles and one.bridge in bridges
        if is_ours and one.passed and one.hash == pair_hash(site, one.pair, settings):
            found[one.pair] = one.hash
    return found


def pairs_with_intervals(crossings: Iterable[CrossingResult]) -> list[VehicleBridgePair]:
    """Return the pairs of results with intervals, each once."""
    pairs = (
        VehicleBridgePair(one.vehicle, one.bridge)
        for one in crossings
        if one.method == "pre" and one.parameters is not None
    )
    return list(dict.fromkeys(pairs))


def pairs_without_validation(crossings: Iterable[CrossingResult]) -> list[VehicleBridgePair]:
    """Return the pairs of results with intervals that name no validation record, each once."""
    return pairs_with_intervals(one for one in crossings if one.certificate is None)


Records = Mapping[VehicleBridgePair, ValidationRecord | None]
"""Validation records of pairs, None of those without one."""


def records_of(folder: Path, site: Site, pairs: Iterable[VehicleBridgePair]) -> Records:
    """Return the records of pairs of a site. An unreadable one is a warning, and none."""
    return {pair: _record_of(folder, site, pair) for pair in pairs}


def validation_notes(
    folder: Path, site: Site, records: Records, language: Language = ENGLISH
) -> Iterator[str]:
    """Yield a sentence for each pair of a bridge that failed, then one for all untried ones.

    A pair whose record has passed since its identification has none. `folder` is that of the
    records.
    """
    untried = []
    for pair, record in records.items():
        if record is None:
            untried.append(pair)
        elif not record.passed:
            figures = record.figures
            kind = truck_to_try(site.vehicle(pair.vehicle), site.bridge(pair.bridge))
            text = language.text(
                "caution.validation_failed",
                truck=pair.vehicle,
                good=figures.good,
                crossings=figures.crossings,
                covered=figures.covered,
                intervals=figures.intervals,
                least=100.0 * LEAST_COVERAGE,
                remedy=language.text(f"caution.try.{kind}"),
            )
            yield " ".join(filter(None, (text, frequent_reasons(record.crossings, language))))
    if untried:
        trucks = language.listed([pair.vehicle for pair in untried])
        text = language.text("caution.unvalidated", trucks=trucks, folder=folder)
        known = _pairs_in(folder)
        otherwise = [pair.vehicle for pair in untried if pair in known]
        if otherwise:
            names = language.listed(otherwise)
            text += " " + language.text("caution.validated_otherwise", trucks=names)
        yield text


def has_failed_validation(records: Records) -> bool:
    """Return whether any of the records has failed."""
    return any(record is not None and not record.passed for record in records.values())


def frequent_reasons(tried: Iterable[ValidationCrossing], language: Language = ENGLISH) -> str:
    """Return a sentence on the usual reasons of crossings that are not good; "" without any."""
    counted = Counter(code for one in tried if one.verdict != "good" for code in one.reasons)
    usual = sorted(counted.items(), key=lambda item: (-item[1], item[0]))[:_MAX_REASONS]
    sentences = ((language.reasons.get(code, code), number) for code, number in usual)
    listed = "; ".join(f"{text.removesuffix('.')} ({number})" for text, number in sentences)
    return language.text("caution.validation_reasons", reasons=listed) if listed else ""


def validations_passed(records: Records, language: Language = ENGLISH) -> Iterator[str]:
    """Yield a sentence for each pair whose validation record has passed."""
    for pair, record in records.items():
        if record is not None and record.passed:
            figures = record.figures
            yield language.text(
                "quality.validated",
                truck=pair.vehicle,
                covered=figures.covered,
                intervals=figures.intervals,
                least=figures.intervals - figures.most_missed,
            )


class ValidatedPairs:
    """Pairs of results with intervals, by bridge, for the sentences on their validations."""

    def __init__(self, crossings: Iterable[CrossingResult] = ()) -> None:
        """Collect the pairs of these results."""
        self._pairs: defaultdict[str, set[VehicleBridgePair]] = defaultdict(set)
        self._unvalidated: defaultdict[str, set[VehicleBridgePair]] = defaultdict(set)
        for crossing in crossings:
            self.add(crossing)

    def add(self, crossing: CrossingResult) -> None:
        """Add the pair of a result."""
        self._pairs[crossing.bridge].update(pairs_with_intervals([crossing]))
        self._unvalidated[crossing.bridge].update(pairs_without_validation([crossing]))

    def notes(self, folder: Path, site: Site, bridge: str) -> Iterator[str]:
        """Yield the sentences on the pairs of a bridge: failed, untried, passed."""
        records = records_of(folder, site, sorted(self._pairs[bridge]))
        unvalidated = {pair: records[pair] for pair in sorted(self._unvalidated[bridge])}
        yield from validation_notes(folder.absolute(), site, unvalidated)
        yield from validations_passed(records)


def _record_of(folder: Path, site: Site, pair: VehicleBridgePair) -> ValidationRecord | None:
    """Return the record of a pair of the site; None without one."""
    try:
        path = validation_path(folder, pair_hash(site, pair, IdentificationSettings()))
    except KeyError:  # the site file is another one
        return None
    return _readable(path) if path.exists() else None


def _pairs_in(folder: Path) -> frozenset[VehicleBridgePair]:
    """Return the pairs of all readable records of a folder, whatever values they are for."""
    return _scanned_pairs(folder, folder.stat().st_mtime_ns) if folder.is_dir() else frozenset()


@lru_cache(maxsize=4)
def _scanned_pairs(folder: Path, changed_ns: int) -> frozenset[VehicleBridgePair]:
    """Return the pairs of a folder last changed at `changed_ns`; a fleet's bridges share one."""
    found = set()
    for path in folder.glob("*.json"):
        with suppress(InputError):
            found.add(load_validation(path).pair)
    return frozenset(found)


def _readable(path: Path) -> ValidationRecord | None:
    """Return the record of a file; None if it cannot be read, which is a warning."""
    try:
        return load_validation(path)
    except InputError as error:
        _log.warning("%s", error)
        return None
