"""Stored states of bridges, with which new ones are compared."""

import logging
from collections.abc import Iterable
from pathlib import Path

from schemas.results import BridgeResult, CrossingResult, load_results
from schemas.site import Bridge, Site
from services.common.errors import InputError
from services.common.outputs import add_input

_log = logging.getLogger(__name__)


def baselines_of(
    site: Site, beside: Path | None, given: Path | None = None
) -> dict[str, BridgeResult]:
    """Return the states, by bridge, of a given results file, or of the files that the site names.

    A name in a site file is a path relative to the folder `beside` it. A site file that a recording
    carries has no folder (None); its baselines may be absent, which is a warning.

    Raise InputError if a file is no results file or has no state of the bridge.
    """
    if given is not None:
        there = load_results(given).bridges
        found = {b.id: stored_state(given, b) for b in site.bridges if b.id in there}
        if not found:
            names = ", ".join(bridge.id for bridge in site.bridges)
            raise InputError(f"{given}: has no state of {names} to compare with")
        return found
    out = {}
    for bridge in site.bridges:
        if bridge.baseline is None:
            continue
        path = (beside or Path()) / bridge.baseline
        if beside is None and not path.is_file():
            _log.warning("the baseline %s of %s is missing; see --baseline", path, bridge.id)
            continue
        out[bridge.id] = stored_state(path, bridge)
    return out


def realms_of_bridges(crossings: Iterable[CrossingResult]) -> dict[str, set[str]]:
    """Return the realms of the crossings with an estimate, by bridge."""
    found: dict[str, set[str]] = {}
    for one in crossings:
        if one.parameters is not None:
            found.setdefault(one.bridge, set()).add(one.realm)
    return found


def realms_of_baselines(
    site: Site | None, beside: Path | None, given: Path | None = None
) -> dict[str, set[str]]:
    """Return the realms of the crossings in the baselines, by bridge; chosen as in `baselines_of`.

    Crossings that a file of states alone does not contain have no realm.
    """
    if given is not None:
        return realms_of_bridges(load_results(given).crossings)
    out = {}
    for bridge in () if site is None else site.bridges:
        path = None if bridge.baseline is None else (beside or Path()) / bridge.baseline
        if path is not None and path.is_file():
            realms = realms_of_bridges(load_results(path).crossings)
            out[bridge.id] = realms.get(bridge.id, set())
    return out


def stored_state(path: Path, bridge: Bridge) -> BridgeResult:
    """Return a bridge's state from a results file; InputError if it has none with its elements."""
    add_input(path)
    state = load_results(path).bridges.get(bridge.id)
    if state is None or len(state.elements) != bridge.elements:
        raise InputError(
            f"{path}: has no state of {bridge.id} with {bridge.elements} elements to compare with"
        )
    return state
