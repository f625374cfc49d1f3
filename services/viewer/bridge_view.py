"""Data of one bridge's figure: its latest state, and all crossings."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from schemas.reasons import Reason
from schemas.results import BridgeResult, CrossingResult, Results
from schemas.site import Bridge, Site
from services.common.arrays import Floats
from services.common.language import ENGLISH, Language
from services.identification import comparison
from services.identification.comparison import (
    Comparison,
    Estimate,
    compare,
    estimate_of_state,
    origin_of_state,
    unresolved_elements,
)
from services.viewer.baseline import named_baseline
from services.viewer.crossing_view import CrossingView, view_of_crossing


class BridgeView(NamedTuple):
    """One bridge as drawn."""

    bridge: str
    owner_id: str | None
    edges_m: Floats  # (n + 1,)
    nominal_nm2: Floats  # (n,)
    interior_supports_m: tuple[float, ...]
    crossings: tuple[CrossingView, ...]
    """Crossings in order of time."""
    used: frozenset[str]
    """Ids of the crossings that the state includes."""
    estimate: Estimate | None
    """Estimate of the state; None if no crossing could be used."""
    is_doubtful: bool
    """Whether the state or one of its crossings is suspect, or its method has no intervals."""
    comparison: Comparison | None
    baseline: Estimate | None = None
    """Stored state to compare with."""
    state: BridgeResult | None = None
    """State that `estimate` belongs to."""

    @property
    def span_m(self) -> float:
        """Length of the bridge between its outer bearings, m."""
        return float(self.edges_m[-1])

    @property
    def unresolved(self) -> frozenset[int]:
        """Numbers of elements too uncertain to resolve a loss of half their EI."""
        if self.state is None or self.estimate is None:
            return frozenset()
        return unresolved_elements(self.state.elements.values())

    @property
    def vague(self) -> frozenset[int]:
        """Numbers of elements that the measurement or its baseline does not resolve."""
        found = self.comparison
        return self.unresolved if found is None else self.unresolved | found.unresolved_before

    @property
    def ambiguous_neighbours(self) -> tuple[int, ...]:
        """Unresolved neighbours of weak elements, where the loss may be instead."""
        return comparison.ambiguous_neighbours(self.comparison, self.vague)


def views_of_bridges(
    results: Results,
    site: Site,
    folder: Path | None = None,
    baselines: Mapping[str, BridgeResult] = MappingProxyType({}),
) -> list[BridgeView]:
    """Return the view of every bridge of the site that was crossed.

    `baselines` are stored states by bridge. With a `folder` those of other bridges that the site
    file names are read from there; raise InputError if one does not fit.
    """
    crossed = {crossing.bridge for crossing in results.crossings}
    views = []
    for bridge in site.bridges:
        if bridge.id in crossed:
            stored = None
            if bridge.id in baselines:
                stored = estimate_of_state(baselines[bridge.id])
            elif folder is not None:
                stored = named_baseline(bridge, folder)[0]
            views.append(view_of_bridge(bridge, results, stored))
    return views


def describe_bridge(
    view: BridgeView, language: Language = ENGLISH, without: Collection[comparison.Stated] = ()
) -> list[str]:
    """Return sentences on the result, as in the state's own finding, except for `without`."""
    level = None if view.state is None else view.state.level
    return comparison.describe_comparison(
        view.comparison, view.unresolved, level, language, without
    )


def origin_of(view: BridgeView) -> str:
    """Return in a sentence which crossings the numbers are of; empty without numbers."""
    if view.estimate is None or view.state is None:
        return ""
    return origin_of_state(view.state)


def summary_of_bridge(view: BridgeView) -> str:
    """Return the sentences of a figure: the result, elements weak in the baseline, the origin."""
    before: tuple[comparison.Element, ...] = ()
    if view.baseline is not None and view.comparison is not None:
        before = comparison.weak_before(view.baseline, view.nominal_nm2, view.edges_m)
    weak = comparison.describe_weak_before(before)
    return " ".join((*describe_bridge(view), *weak, origin_of(view))).strip()


def view_of_bridge(bridge: Bridge, results: Results, baseline: Estimate | None) -> BridgeView:
    """Return the view of one bridge in results; `baseline` is its stored state."""
    crossings = sorted(
        (crossing for crossing in results.crossings if crossing.bridge == bridge.id),
        key=lambda crossing: crossing.entry_time,
    )
    state = results.bridges.get(bridge.id)
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2)
    edges = np.concatenate(([0.0], np.cumsum(bridge.lengths_m)))
    estimate, used = None, frozenset[str]()
    if state is not None and len(state.elements) == nominal.size:
        used = frozenset(state.crossings_used)
        estimate = estimate_of_state(state, bridge.lengths_m)
    of_state = [crossing for crossing in crossings if crossing.crossing_id in used]
    is_doubtful = (
        estimate is not None
        and state is not None
        and (not of_state or state.verdict == "suspect" or any(map(_is_doubtful, of_state)))
    )
    return BridgeView(
        bridge.id,
        bridge.owner_id,
        edges,
        nominal,
        bridge.interior_supports_m,
        tuple(view_of_crossing(crossing, bridge) for crossing in crossings),
        used,
        estimate,
        is_doubtful,
        None if estimate is None else compare(estimate, nominal, edges, baseline),
        baseline,
        state,
    )


def _is_doubtful(crossing: CrossingResult) -> bool:
    return crossing.verdict != "good" or Reason.NO_NOISE_MODEL in crossing.reasons
