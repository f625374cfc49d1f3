"""The site file that results belong to: results themselves do not say where their bridge is."""

import logging
from pathlib import Path

from schemas.results import Results
from schemas.site import Site
from schemas.site_file import load_site, parse_site, site_hash
from services.common.errors import InputError
from services.recordings.recording import read_site

_log = logging.getLogger(__name__)


def site_of_results(path: Path, results: Results, site: Path | None = None) -> Site:
    """The site file given, or that of a recording in the same folder as the results.

    One that is not what the results were made with is taken with a warning: who corrects an
    owner's name of a bridge wants it in the report. InputError if there is none, or it lacks a
    bridge of the results.
    """
    known, name = (load_site(site), str(site)) if site is not None else _beside(path, results)
    missing = wanted_bridges(results) - {bridge.id for bridge in known.bridges}
    if missing:
        raise InputError(f"{path}: has results of {min(missing)}, which {name} does not know")
    if site_hash(known) != results.site_hash:
        _log.warning("%s: was made with another site file than %s", path, name)
    return known


def wanted_bridges(results: Results) -> set[str]:
    """The bridges that results tell something of."""
    return {crossing.bridge for crossing in results.crossings} | set(results.bridges)


def site_within(recording: Path) -> Site | None:
    """The site file stored in a recording; None if there is none."""
    toml = read_site(recording)
    return None if toml is None else parse_site(toml, str(recording))


def _beside(path: Path, results: Results) -> tuple[Site, str]:
    possible: list[tuple[Site, str]] = []
    for recording in sorted(path.absolute().parent.glob("*.mcap")):
        try:
            site = site_within(recording)
        except InputError:
            continue  # another one may be the right one
        if site is not None and site_hash(site) == results.site_hash:
            return site, str(recording)
        if site is not None and wanted_bridges(results) <= {bridge.id for bridge in site.bridges}:
            possible.append((site, str(recording)))
    if possible:
        return possible[0]
    raise InputError(
        f"{path}: results do not say where their bridge is: give --site, or put the recording "
        "(.mcap) that they come from into the same folder"
    )
