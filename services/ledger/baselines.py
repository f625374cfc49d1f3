"""Stored states of bridges, with which new ones are compared."""

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from schemas.results import BridgeResult, CrossingResult, Results, load_results
from schemas.site import Bridge, Site
from services.common.errors import InputError
from services.common.outputs import add_input

_log = logging.getLogger(__name__)


class Baselines(NamedTuple):
    """States to compare with, and the realms of their crossings, by bridge.

    Crossings that a file of states alone does not contain have no realm.
    """

    states: dict[str, BridgeResult]
    realms: dict[str, set[str]]


def baselines_of(site: Site, beside: Path | None, given: Path | None = None) -> Baselines:
    """Return the baselines from a given results file, or from the files that the site names.

    A name in a site file is a path relative to the folder `beside` it. A site file that a recording
    carries has no folder (None); its baselines may be absent, which is a warning.

    Raise InputError if a file is no results file or has no state of the bridge.
    """
    found = Baselines({}, {})
    if given is not None:
        stored = read_baseline(given)
        _take(found, given, stored, [one for one in site.bridges if one.id in stored.bridges])
        if not found.states:
            names = ", ".join(bridge.id for bridge in site.bridges)
            raise InputError(f"{given}: has no state of {names} to compare with")
        return found
    for bridge in site.bridges:
        if bridge.baseline is None:
            continue
        path = (beside or Path()) / bridge.baseline
        if beside is None and not path.is_file():
            _log.warning("the baseline %s of %s is missing; see --baseline", path, bridge.id)
            continue
        _take(found, path, read_baseline(path), [bridge])
    return found


def realms_of_bridges(crossings: Iterable[CrossingResult]) -> dict[str, set[str]]:
    """Return the realms of the crossings with an estimate, by bridge."""
    found: dict[str, set[str]] = {}
    for one in crossings:
        if one.parameters is not None:
            found.setdefault(one.bridge, set()).add(one.realm)
    return found


def stored_state(path: Path, bridge: Bridge) -> BridgeResult:
    """Return a bridge's state from a results file; InputError if it has none with its elements."""
    return state_in(path, read_baseline(path), bridge)


def read_baseline(path: Path) -> Results:
    """Return the results of a baseline; InputError if the file is unreadable."""
    add_input(path)  # first: the results to be written must not replace it, whatever it holds
    return load_results(path)


def _take(found: Baselines, path: Path, stored: Results, bridges: list[Bridge]) -> None:
    """Add the baselines of bridges from one results file."""
    realms = realms_of_bridges(stored.crossings)
    for bridge in bridges:
        found.states[bridge.id] = state_in(path, stored, bridge)
        found.realms[bridge.id] = realms.get(bridge.id, set())


def state_in(path: Path, stored: Results, bridge: Bridge) -> BridgeResult:
    """Return a bridge's state in results read from `path`; InputError as `stored_state`."""
    state = stored.bridges.get(bridge.id)
    if state is None or len(state.elements) != bridge.elements:
        raise InputError(
            f"{path}: has no state of {bridge.id} with {bridge.elements} elements to compare with"
        )
    return state
