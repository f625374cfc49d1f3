"""The site file that results belong to: results do not contain the position of their bridge."""

import logging
from collections.abc import Iterable, Iterator
from itertools import combinations
from pathlib import Path

from schemas.results import Results
from schemas.site import Site
from schemas.site_file import load_site, parse_site, site_hash
from schemas.validation_records import NOT_OF_A_BRIDGE
from services.common.errors import InputError
from services.recordings.recording import read_site

_log = logging.getLogger(__name__)


def site_of_results(path: Path, results: Results, site: Path | Site | None = None) -> Site:
    """Return the given site, or the one of a recording in the folder of the results.

    A site file other than that of the results is accepted with a warning, so that a corrected name
    of a bridge appears in the report. Raise InputError if there is none, or if it lacks a bridge of
    the results.
    """
    if isinstance(site, Site):
        known, name = site, "the given site"
    elif site is not None:
        known, name = load_site(site), str(site)
    else:
        known, name = _site_nearby(path, results)
    missing = wanted_bridges(results) - {bridge.id for bridge in known.bridges}
    if missing:
        raise InputError(f"{path}: has results of {min(missing)}, which {name} does not know")
    if not _is_site_of(path, results, known):
        _log.warning("%s: computed with another site file than %s", path, name)
    return known


def _is_site_of(path: Path, results: Results, site: Site) -> bool:
    """Return whether results were computed with these values.

    Keys that describe a bridge but do not affect its results may have been added since; changed
    ones are known only from a recording in the results' folder.
    """
    keys = sorted(NOT_OF_A_BRIDGE)
    subsets = [some for count in range(len(keys) + 1) for some in combinations(keys, count)]
    if any(site_hash(_without(site, some)) == results.site_hash for some in subsets):
        return True
    bare = site_hash(_without(site, keys))
    return any(
        site_hash(one) == results.site_hash and site_hash(_without(one, keys)) == bare
        for one, _ in _sites_beside(path)
    )


def _without(site: Site, keys: Iterable[str]) -> Site:
    unset = dict.fromkeys(keys)
    bridges = tuple(bridge.model_copy(update=unset) for bridge in site.bridges)
    return site.model_copy(update={"bridges": bridges})


def wanted_bridges(results: Results) -> set[str]:
    """Return the bridges that results refer to."""
    return {crossing.bridge for crossing in results.crossings} | set(results.bridges)


def site_within(recording: Path) -> Site | None:
    """Return the site file stored in a recording; None if there is none."""
    toml = read_site(recording)
    return None if toml is None else parse_site(toml, str(recording))


def _site_nearby(path: Path, results: Results) -> tuple[Site, str]:
    possible: list[tuple[Site, str]] = []
    for site, name in _sites_beside(path):
        if site_hash(site) == results.site_hash:
            return site, name
        if wanted_bridges(results) <= {bridge.id for bridge in site.bridges}:
            possible.append((site, name))
    if possible:
        return possible[0]
    raise InputError(
        f"{path}: results lack the bridge's position: give --site, or put the recording "
        "(.mcap) that they come from into the same folder"
    )


def _sites_beside(path: Path) -> Iterator[tuple[Site, str]]:
    """Yield the site files stored in the recordings of a file's folder, with their names."""
    for recording in sorted(path.absolute().parent.glob("*.mcap")):
        try:
            site = site_within(recording)
        except InputError:
            continue  # another one may be the right one
        if site is not None:
            yield site, str(recording)
