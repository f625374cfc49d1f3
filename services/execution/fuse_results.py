"""Fusion of the crossings of several results files, each crossing once."""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

from schemas.results import BridgeResult, CrossingResult, ResultHeader, Results, results
from schemas.settings import IdentificationSettings
from services.common.errors import InputError
from services.common.progress import Parts, no_part_progress
from services.finding.stays import MERGE_S
from services.identification.bridge_state import (
    FusionSettings,
    RecentCrossings,
    add_crossings,
    state_of,
    usable,
    with_common_shares,
)
from services.identification.usable import ONE_REALM
from services.recordings.recording import program_version


class FusedElements(NamedTuple):
    """Elements of a bridge, as its newest crossing has them."""

    id: str
    lengths_m: tuple[float, ...]
    nominal_flexural_rigidity_nm2: tuple[float, ...]


class FusedResults(NamedTuple):
    """Results of several files as one, with the fused bridges."""

    results: Results
    bridges: dict[str, FusedElements]
    """Bridges with a state, by name."""
    unfused: dict[str, int]
    """Numbers of crossings of bridges without a crossing that can be fused."""
    repeated: int
    """Number of results of crossings that a newer file has too."""


class CrossingsToFuse(NamedTuple):
    """Crossings of one realm in order of time, the newest result of each."""

    last: Results
    """Newest file."""
    crossings: tuple[CrossingResult, ...]
    repeated: int

    @property
    def by_bridge(self) -> dict[str, list[CrossingResult]]:
        """Crossings of each bridge, by its name."""
        names = sorted({crossing.bridge for crossing in self.crossings})
        return {name: [one for one in self.crossings if one.bridge == name] for name in names}


def crossings_to_fuse(name: str, files: Sequence[Results]) -> CrossingsToFuse:
    """Return the crossings of the files, each once.

    Raise InputError if they are of several realms, or if a truck enters a bridge twice in less than
    5 s; `name` is the place that such an error begins with.
    """
    ordered = sorted(files, key=lambda one: one.created)
    crossings = {c.crossing_id: c for one in ordered for c in one.crossings}
    realms = sorted({crossing.realm for crossing in crossings.values()})
    if len(realms) > 1:
        raise InputError(f"{name}: has crossings of realms {', '.join(realms)}; {ONE_REALM}")
    repeated = sum(len(one.crossings) for one in ordered) - len(crossings)
    by_time = sorted(crossings.values(), key=lambda crossing: crossing.entry_time)
    _check_entries(name, [one for one in by_time if one.parameters is not None])
    return CrossingsToFuse(ordered[-1], tuple(by_time), repeated)


def _check_entries(name: str, by_time: Sequence[CrossingResult]) -> None:
    """Raise InputError for two entries of one truck on one bridge that are one crossing."""
    newest: dict[tuple[str, str], CrossingResult] = {}
    for one in by_time:
        before = newest.get((one.vehicle, one.bridge))
        if before is not None and one.entry_time - before.entry_time < MERGE_S:
            raise InputError(
                f"{name}: {before.crossing_id} and {one.crossing_id} begin less than "
                f"{MERGE_S:g} s apart, which is one crossing: give one result of it, and start "
                "each simulated one at another time"
            )
        newest[one.vehicle, one.bridge] = one


def fuse_crossings(
    name: str,
    found: CrossingsToFuse,
    stored: tuple[str, Mapping[str, BridgeResult]] | None,
    report: Parts,
    *,
    fuse_suspect: bool,
) -> FusedResults:
    """Fuse the crossings of each bridge.

    `stored` are states to compare with, by bridge, and the name of their file. Raise InputError if
    one does not fit, or if no crossing can be fused; `name` is the place that such an error begins
    with.
    """
    created_s = time.time()  # as identification does, before the work
    baselines = {} if stored is None else stored[1]
    fusing = FusionSettings(baselines, fuse_suspect, IdentificationSettings().threads)
    elements_of = {bridge: _elements(bridge, of) for bridge, of in found.by_bridge.items()}
    for bridge, elements in elements_of.items():
        if stored is not None and elements is not None and bridge in baselines:
            _check_baseline(stored[0], baselines[bridge], elements)
    states: dict[str, BridgeResult] = {}
    bridges: dict[str, FusedElements] = {}
    unfused: dict[str, int] = {}
    for bridge, of in found.by_bridge.items():
        state, elements = _state(bridge, of, fusing, report), elements_of[bridge]
        if state is None or elements is None:
            unfused[bridge] = len(of)
        else:
            states[bridge], bridges[bridge] = state, elements
    if not found.crossings:
        raise InputError(
            f"{name}: holds no crossing; driveby identify --into writes crossings with --json"
        )
    if not states:
        raise InputError(f"{name}: no crossing that could be fused; identify with method pre")
    last = found.last
    header = ResultHeader(program_version(), created_s, last.site_hash, last.settings, last.seed)
    every = results(header, with_common_shares(list(found.crossings), states), states)
    return FusedResults(every, bridges, unfused, found.repeated)


def fuse_bridge(name: str, crossings: Sequence[CrossingResult]) -> BridgeResult | None:
    """Return the state of one bridge from all its crossings; None if none can be fused."""
    fusing = FusionSettings(threads=IdentificationSettings().threads)
    return _state(name, list(crossings), fusing, no_part_progress)


def _state(
    name: str, crossings: list[CrossingResult], fusing: FusionSettings, report: Parts
) -> BridgeResult | None:
    counts = [one for one in map(usable, crossings) if one is not None]
    state = state_of(add_crossings(RecentCrossings(), counts), name, fusing, partial(report, name))
    report(name, "done", 1.0)
    return state


def _check_baseline(path: str, baseline: BridgeResult, elements: FusedElements) -> None:
    stored, now = len(baseline.elements), len(elements.lengths_m)
    if stored != now:
        raise InputError(
            f"{path}: {elements.id} has {stored} elements there and {now} in the results, "
            "the baseline must have the same"
        )


def _elements(name: str, crossings: list[CrossingResult]) -> FusedElements | None:
    """Return the bridge of the newest crossing that can be fused."""
    for crossing in reversed(crossings):
        of = crossing.fusion_likelihood
        if of is not None:
            lengths = of.element_lengths_m
            nominal = tuple(c.location for c in of.bridge[-len(lengths) :])
            return FusedElements(name, lengths, nominal)
    return None
