"""What a picture of one bridge shows: its latest state, and what every crossing said."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from schemas.reasons import Reason
from schemas.results import BridgeResult, Crossing, Results
from schemas.site import Bridge, Site
from services.identification import comparison
from services.identification.comparison import (
    Comparison,
    Estimate,
    compare,
    estimate_of_state,
    unresolved_elements,
)
from services.viewer.baseline import named_baseline
from services.viewer.crossing_view import (
    CrossingView,
    FloatArray,
    view_of_crossing,
)


class BridgeView(NamedTuple):
    """One bridge as it is drawn."""

    bridge: str
    owner_id: str | None
    edges_m: FloatArray  # (n + 1,)
    nominal_nm2: FloatArray  # (n,)
    interior_supports_m: tuple[float, ...]
    crossings: tuple[CrossingView, ...]
    """All that there are, in order of time."""
    used: frozenset[str]
    """Those that the state was made of."""
    estimate: Estimate | None
    """None if no crossing could be used."""
    is_doubtful: bool
    """Whether the state or a crossing in it is suspect, or its method knows no intervals."""
    comparison: Comparison | None
    baseline: Estimate | None = None
    """What was stored of the bridge, to compare with."""
    state: BridgeResult | None = None
    """What `estimate` is of."""

    @property
    def span_m(self) -> float:
        """Length of the bridge between its outer bearings."""
        return float(self.edges_m[-1])

    @property
    def unresolved(self) -> frozenset[int]:
        """Numbers of the elements of which too little is known to tell a loss of half of them."""
        if self.state is None or self.estimate is None:
            return frozenset()
        return unresolved_elements(self.state.elements.values())

    @property
    def elsewhere(self) -> tuple[int, ...]:
        """Numbers of the unresolved neighbours of weak elements: the loss may be theirs."""
        return comparison.elsewhere(self.comparison, self.unresolved)


def views_of_bridges(results: Results, site: Site, folder: Path | None = None) -> list[BridgeView]:
    """Every bridge of the site that was crossed.

    With a `folder` the baselines that the site file names are looked for there; InputError if one
    does not fit.
    """
    crossed = {crossing.bridge for crossing in results.crossings}
    return [
        view_of_bridge(b, results, None if folder is None else named_baseline(b, folder)[0])
        for b in site.bridges
        if b.id in crossed
    ]


def told(view: BridgeView) -> list[str]:
    """What was found, in words, as the state's own finding says it."""
    level = None if view.state is None else view.state.level
    return comparison.told(view.comparison, view.unresolved, level)


def view_of_bridge(bridge: Bridge, results: Results, baseline: Estimate | None) -> BridgeView:
    """Take results of one bridge apart; `baseline` is what was stored of it."""
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


def _is_doubtful(crossing: Crossing) -> bool:
    return crossing.verdict != "good" or Reason.NO_NOISE_MODEL in crossing.reasons
