"""Fused state of a bridge from its crossings.

Only the data needed for the state are kept, so that the thousandth crossing costs as much as the
first.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from pre_core.constants import NORMAL_975
from pre_core.fusion.variability import BETWEEN_SCALE
from pre_core.search.loop import Report
from schemas.reasons import BridgeReason, LeftOutReason
from schemas.results import (
    LOSSES_PERCENT,
    BridgeResult,
    CrossingResult,
    ElementState,
    LeftOut,
    Parameter,
    ThirdsState,
)
from services.common.arrays import Floats
from services.common.language import ENGLISH
from services.identification.baseline_cautions import doubts_of_baseline
from services.identification.comparison import (
    Comparison,
    compare,
    describe_clear_elements,
    describe_comparison,
    describe_weak_before,
    estimate_of_state,
    unresolved_elements,
    weak_before,
)
from services.identification.fusing import FusedBridge, fused
from services.identification.result_parts import element_edges_m, element_shares
from services.identification.usable import LISTED_AT_MOST as LISTED_AT_MOST
from services.identification.usable import FusableCrossing
from services.identification.usable import RecentCrossings as RecentCrossings
from services.identification.usable import add_crossings as add_crossings
from services.identification.usable import usable as usable

_MANY = 2
"""Smallest number of crossings excluded as contradictory that makes a state doubtful: a single one
is itself wrong, but several may show that the bridge has changed."""
_LARGEST_BETWEEN = 1.5 * BETWEEN_SCALE
"""Lower limit of the variability between crossings above which a state is doubtful. Two groups of
crossings, before and after a loss, would pass as a bridge that varies so much, with their mean as
its state."""
_CONTRADICTIONS = frozenset(
    (BridgeReason.CROSSINGS_DISAGREE, BridgeReason.NEWEST_DISAGREE, BridgeReason.MANY_LEFT_OUT)
)


class FusionSettings(NamedTuple):
    """Settings of fusion and comparison."""

    baselines: Mapping[str, BridgeResult] = {}
    """Stored states by bridge, to which probabilities of loss refer."""
    with_suspect: bool = False
    """Whether suspect crossings are fused too."""
    threads: int = 1
    """Number of threads, on which the state does not depend."""


NOTHING_STORED = FusionSettings()
_BASELINE_SHARE = 0.9
"""Share of the baseline's EI in `Derived.probability_below_90_percent_of_baseline`."""


def with_loss_probability(result: CrossingResult, baseline: BridgeResult | None) -> CrossingResult:
    """Return the result with its probabilities of loss against a stored state of the bridge."""
    if baseline is None or result.derived is None or result.parameters is None:
        return result
    stored = baseline.elements
    below = {
        name: _probability_below(_BASELINE_SHARE, now, before)
        for name, before in stored.items()
        if (now := result.parameters.get(name)) is not None
        and now.mean > 0.0 < before.mean
        and not unresolved_elements((now, before))
    }
    derived = result.derived.model_copy(
        update={"probability_below_90_percent_of_baseline": below or None}
    )
    return result.model_copy(update={"derived": derived})


def _probability_below(share: float, now: Parameter, before: ElementState) -> float:
    """Return the probability that EI is below a `share` of its earlier value, both log-normal.

    Their errors are independent.
    """
    spread = np.hypot(now.std / now.mean, before.std / before.mean)
    apart = np.log(share * before.mean / now.mean)
    return float(ndtr(apart / spread)) if spread > 0.0 else float(apart > 0.0)


def state_of(
    counted: RecentCrossings,
    bridge: str,
    fusing: FusionSettings = NOTHING_STORED,
    report: Report = lambda stage, fraction: None,
) -> BridgeResult | None:
    """Return the state of a bridge from all its good crossings; None without an estimate.

    With a method that provides no likelihood it is the latest crossing alone, and `suspect`.
    Suspect crossings alone are no state of a bridge: it is then `rejected`, without values.
    """
    if not counted.newest:
        return None
    if all(one.source is None for one in counted.newest):
        return _latest(counted)
    newest = counted.newest[-LISTED_AT_MOST:]
    verdicts = ("good", "suspect") if fusing.with_suspect else ("good",)
    wanted = [one for one in newest if one.verdict in verdicts and one.source is not None]
    left_out = {
        one.crossing_id: (
            LeftOutReason.NO_LIKELIHOOD if one.source is None else LeftOutReason.SUSPECT
        )
        for one in newest
        if one not in wanted
    }
    if not wanted:
        return BridgeResult(  # type: ignore[call-arg]
            verdict="rejected",
            reasons=(BridgeReason.NO_GOOD_CROSSING,),
            crossings_left_out=_named(left_out),
            crossings_left_out_count=counted.number,
        )
    sources = [one.source for one in wanted if one.source is not None]
    found = fused(sources, report, fusing.threads)
    left_out |= dict.fromkeys(found.excluded, LeftOutReason.DISAGREES)
    left_out |= dict.fromkeys(found.other_model, LeftOutReason.OTHER_MODEL)
    between = _summary(found.between)
    reasons = _reasons(found, between, wanted)
    baseline = fusing.baselines.get(bridge)
    elements = {f"EI_{n}": _summary(ei) for n, ei in enumerate(found.ei_nm2.T, start=1)}
    weakest, losses = _of_resolved(found, elements, baseline)
    state = BridgeResult(
        **elements,  # type: ignore[arg-type]
        between_crossing_std=between.mean,
        between_crossing_std_q025=0.0 if found.between_may_be_zero else between.q025,
        between_crossing_std_q975=between.q975,
        verdict="suspect" if reasons else "good",
        reasons=reasons,
        weakest_element=weakest,
        probability_of_loss=losses,
        level=_level(found, 0.0, 1.0),
        thirds=_thirds(found),
        tracks=found.tracks,
        crossings_used=found.used,
        crossings_left_out=_named(left_out),
        crossings_left_out_count=counted.number - len(found.used),
        element_edges_m=element_edges_m(found.element_lengths_m),
        nominal_ei_nm2=tuple(found.nominal_nm2.tolist()),
    )
    return state.model_copy(update={"finding": _finding(found, state, baseline)})


def _reasons(
    found: FusedBridge, between: ElementState, crossings: Sequence[FusableCrossing]
) -> tuple[BridgeReason, ...]:
    """Return why a state is doubtful; nothing for a good one.

    `between` is the variability between crossings; `crossings` are in the order of their entries.
    """
    reasons = []
    if found.is_contradictory or between.q025 > _LARGEST_BETWEEN:
        reasons.append(BridgeReason.CROSSINGS_DISAGREE)
    if len(found.excluded) >= _MANY:
        newest = {one.crossing_id for one in crossings[-_MANY:]}
        reasons.append(
            BridgeReason.NEWEST_DISAGREE
            if newest <= set(found.excluded)
            else BridgeReason.MANY_LEFT_OUT
        )
    if any(one.verdict != "good" and one.crossing_id in found.used for one in crossings):
        reasons.append(BridgeReason.USES_SUSPECT)
    return tuple(reasons)


def _thirds(found: FusedBridge) -> ThirdsState:
    return ThirdsState(
        left=_level(found, 0.0, 1 / 3),
        middle=_level(found, 1 / 3, 2 / 3),
        right=_level(found, 2 / 3, 1.0),
    )


class BridgeStateCache:
    """States of bridges, recomputed only after new crossings: one takes up to a second."""

    def __init__(self, fusing: FusionSettings) -> None:
        self.fusing = fusing
        self._made: dict[Hashable, tuple[RecentCrossings, BridgeResult | None]] = {}

    def of(self, counted: RecentCrossings, bridge: str, key: Hashable) -> BridgeResult | None:
        """Return the state as `state_of` does; `key` distinguishes bridges of one name."""
        made = self._made.get(key)
        if made is None or made[0] is not counted:
            made = self._made[key] = (counted, state_of(counted, bridge, self.fusing))
        return made[1]


def with_common_shares(
    crossings: Iterable[CrossingResult], bridges: Mapping[str, BridgeResult]
) -> list[CrossingResult]:
    """Return crossings with the share of the mismatch common to their wheel-path group."""
    return [_with_common_share(crossing, bridges.get(crossing.bridge)) for crossing in crossings]


def _with_common_share(crossing: CrossingResult, bridge: BridgeResult | None) -> CrossingResult:
    road = crossing.road
    if bridge is None or road is None or road.mismatch is None:
        return crossing
    for track in bridge.tracks:
        if (track.vehicle, track.direction) == (crossing.vehicle, crossing.direction):
            mismatch = road.mismatch.model_copy(update={"common_share": track.common_share})
            return crossing.model_copy(
                update={"road": road.model_copy(update={"mismatch": mismatch})}
            )
    return crossing


def compared(
    state: BridgeResult,
    nominal_nm2: Floats,
    element_lengths_m: Floats,
    baseline: BridgeResult | None = None,
) -> Comparison | None:
    """Return the comparison of a fused state's elements, as for its `finding`; see `compare`."""
    edges = np.concatenate([[0.0], np.cumsum(element_lengths_m)])
    stored = None if baseline is None else estimate_of_state(baseline)
    now = estimate_of_state(state, element_lengths_m.tolist())
    return compare(now, nominal_nm2, edges, stored)


def _latest(counted: RecentCrossings) -> BridgeResult:
    *others, last = counted.newest
    return BridgeResult(
        **last.elements,  # type: ignore[arg-type]
        verdict="suspect",
        reasons=(BridgeReason.NOT_FUSED,),
        crossings_used=(last.crossing_id,),
        crossings_left_out=_named(
            dict.fromkeys((one.crossing_id for one in others), LeftOutReason.NOT_FUSED)
        ),
        crossings_left_out_count=counted.number - 1,
    )


def _named(left_out: Mapping[str, LeftOutReason]) -> tuple[LeftOut, ...]:
    return tuple(LeftOut(crossing_id=name, reason=why) for name, why in left_out.items())


def _reference(found: FusedBridge, baseline: BridgeResult | None) -> Floats:
    """Return EI (n,), or its draws (draws, n), with which elements are compared."""
    if baseline is None or len(baseline.elements) != found.nominal_nm2.size:
        return found.nominal_nm2
    # The baseline's errors count as log-normal and independent of the new ones.
    rng = np.random.default_rng(found.ei_nm2.shape[0])
    of = estimate_of_state(baseline)
    spread = np.log(of.high / of.low) / (2.0 * NORMAL_975)
    return np.asarray(of.mean * np.exp(spread * rng.standard_normal(found.ei_nm2.shape)))


def _of_resolved(
    found: FusedBridge, elements: Mapping[str, ElementState], baseline: BridgeResult | None
) -> tuple[str | None, dict[str, dict[str, float]] | None]:
    """Return the weakest element, and probabilities of loss if there is a baseline.

    Elements that the measurement or its baseline does not resolve are left out.
    """
    vague = unresolved_elements(elements.values())
    if baseline is not None:
        vague |= unresolved_elements(baseline.elements.values())
    ratio = found.ei_nm2 / _reference(found, baseline)
    resolved = {f"EI_{n}": one for n, one in enumerate(ratio.T, start=1) if n not in vague}
    weakest = min(resolved, key=lambda name: float(np.median(resolved[name])), default=None)
    if baseline is None:
        return weakest, None
    return weakest, {name: _losses(one) for name, one in resolved.items()}


def _losses(ratio: Floats) -> dict[str, float]:
    return {
        str(percent): float(np.mean(ratio < 1.0 - percent / 100.0)) for percent in LOSSES_PERCENT
    }


def _level(found: FusedBridge, begin: float, end: float) -> ElementState:
    share = element_shares(found.element_lengths_m, begin, end)
    return _summary(np.exp(np.log(found.ei_nm2 / found.nominal_nm2) @ share))


def _summary(draws: Floats) -> ElementState:
    low, high = np.quantile(draws, [0.025, 0.975])
    return ElementState(
        mean=float(draws.mean()), std=float(draws.std()), q025=float(low), q975=float(high)
    )


def _finding(found: FusedBridge, state: BridgeResult, baseline: BridgeResult | None) -> str:
    """Return the state in words: resolved and unresolved elements."""
    comparison = compared(state, found.nominal_nm2, found.element_lengths_m, baseline)
    doubts: list[str] = []
    if baseline is not None:
        used, before = (frozenset(one.crossings_used) for one in (state, baseline))
        doubts.extend(doubts_of_baseline(used, before, baseline.verdict))
    if _CONTRADICTIONS.intersection(state.reasons):
        # The excluded crossings may show what the others do not: no element is cleared.
        clear = [] if comparison is None else describe_clear_elements(comparison)
        return " ".join([*clear, ENGLISH.text("contradicted"), *doubts])
    unresolved = unresolved_elements(state.elements.values())
    wording = describe_comparison(comparison, unresolved, state.level)
    if baseline is not None and comparison is not None:
        edges = np.concatenate([[0.0], np.cumsum(found.element_lengths_m)])
        weak = weak_before(estimate_of_state(baseline), found.nominal_nm2, edges)
        wording += describe_weak_before(weak)
    return " ".join([*wording, *doubts])
