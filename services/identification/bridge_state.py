"""What a bridge's crossings say of it together.

Only as much is kept as the state of a bridge is made of, so that the thousandth crossing costs what
the first did.
"""

from bisect import insort
from collections.abc import Hashable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from pre_core.constants import NORMAL_975
from pre_core.search.loop import Report
from schemas.reasons import BridgeReason, LeftOutReason
from schemas.results import (
    LOSSES_PERCENT,
    BridgeResult,
    Crossing,
    ElementState,
    LeftOut,
    Parameter,
    ThirdsState,
    Verdict,
)
from services.identification.comparison import (
    Comparison,
    compare,
    estimate_of_state,
    told,
    unresolved_elements,
)
from services.identification.crossing_data import part_of_elements
from services.identification.fusing import Floats, FusedBridge, Source, fused, source_of

LISTED_AT_MOST = 100
"""So many crossings are fused, the newest, and as many that are left out are named: the state stays
below 20 kB, while a message on the bus may have 1 MiB. The others are counted."""
_MANY = 1.0 / 3.0


class Usable(NamedTuple):
    """What a state needs to know of a crossing that gave parameters."""

    entry_time: float
    """Seconds since 1970 UTC, as `exit_time`."""
    exit_time: float
    crossing_id: str
    verdict: Verdict
    elements: dict[str, ElementState]
    source: Source | None


class Counted(NamedTuple):
    """The usable crossings of a bridge."""

    newest: tuple[Usable, ...] = ()
    """In order of their entries, `LISTED_AT_MOST` and one more at most."""
    number: int = 0
    """How many there are, with those that are no longer kept."""


class Fusing(NamedTuple):
    """What is fused and compared."""

    baselines: Mapping[str, BridgeResult] = {}
    """By bridge: a stored state, with which probabilities of loss are told."""
    with_suspect: bool = False
    """Whether suspect crossings are fused too."""
    threads: int = 1
    """The state does not depend on it."""


NOTHING_STORED = Fusing()
_SOUND = 0.9
"""Of the baseline; see `Derived.probability_below_90_percent_of_baseline`."""


def against(result: Crossing, baseline: BridgeResult | None) -> Crossing:
    """The result with what it says against a stored state of the bridge."""
    if baseline is None or result.derived is None or result.parameters is None:
        return result
    stored = baseline.elements
    below = {
        name: _probability_below(_SOUND, result.parameters[name], of)
        for name, of in stored.items()
        if name in result.parameters and of.mean > 0.0 and result.parameters[name].mean > 0.0
    }
    derived = result.derived.model_copy(
        update={"probability_below_90_percent_of_baseline": below or None}
    )
    return result.model_copy(update={"derived": derived})


def _probability_below(share: float, now: Parameter, before: ElementState) -> float:
    """Of two log-normals with independent errors."""
    spread = np.hypot(now.std / now.mean, before.std / before.mean)
    apart = np.log(share * before.mean / now.mean)
    return float(ndtr(apart / spread)) if spread > 0.0 else float(apart > 0.0)


def usable(result: Crossing) -> Usable | None:
    """What a state needs of a result; None if it gave no parameters."""
    if result.parameters is None:
        return None
    elements = {
        name: ElementState(mean=p.mean, std=p.std, q025=p.q025, q975=p.q975)
        for name, p in result.parameters.items()
        if name.startswith("EI_")
    }
    return Usable(
        result.entry_time,
        result.exit_time,
        result.crossing_id,
        result.verdict,
        elements,
        source_of(result),
    )


def count_in(counted: Counted, crossings: Iterable[Usable]) -> Counted:
    """The same with more crossings; who entered last counts as the latest, not who came last."""
    newest, number = list(counted.newest), counted.number
    for crossing in crossings:
        insort(newest, crossing, key=lambda one: (one.entry_time, one.crossing_id))
        del newest[: -LISTED_AT_MOST - 1]
        number += 1
    return Counted(tuple(newest), number)


def state_of(
    counted: Counted,
    bridge: str,
    fusing: Fusing = NOTHING_STORED,
    report: Report = lambda stage, fraction: None,
) -> BridgeResult | None:
    """The bridge by all its good crossings together; None without a crossing that gave numbers.

    Of a method that leaves nothing to fuse it is the latest crossing alone, and `suspect`. Suspect
    crossings by themselves are no state of a bridge: then it is `rejected`, without numbers.
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
    left_out |= dict.fromkeys(found.left_out, LeftOutReason.DISAGREES)
    left_out |= dict.fromkeys(found.other_model, LeftOutReason.OTHER_MODEL)
    reasons = []
    if found.disagree:
        reasons.append(BridgeReason.CROSSINGS_DISAGREE)
    if len(found.left_out) > _MANY * (len(found.left_out) + len(found.used)):
        reasons.append(BridgeReason.MANY_LEFT_OUT)
    if any(one.verdict != "good" and one.crossing_id in found.used for one in wanted):
        reasons.append(BridgeReason.USES_SUSPECT)
    between = _summary(found.between)
    baseline = fusing.baselines.get(bridge)
    elements = {f"EI_{n}": _summary(ei) for n, ei in enumerate(found.ei_nm2.T, start=1)}
    ratio = found.ei_nm2 / _reference(found, baseline)
    weakest = int(np.argmin(np.median(ratio, axis=0))) + 1
    state = BridgeResult(
        **elements,  # type: ignore[arg-type]
        between_crossing_std=between.mean,
        between_crossing_std_q025=0.0 if found.between_may_be_zero else between.q025,
        between_crossing_std_q975=between.q975,
        verdict="suspect" if reasons else "good",
        reasons=tuple(reasons),
        weakest_element=f"EI_{weakest}",
        probability_of_loss=None if baseline is None else _losses(ratio),
        level=_level(found, 0.0, 1.0),
        thirds=ThirdsState(
            left=_level(found, 0.0, 1 / 3),
            middle=_level(found, 1 / 3, 2 / 3),
            right=_level(found, 2 / 3, 1.0),
        ),
        tracks=found.tracks,
        crossings_used=found.used,
        crossings_left_out=_named(left_out),
        crossings_left_out_count=counted.number - len(found.used),
    )
    return state.model_copy(update={"finding": _finding(found, state, baseline)})


class States:
    """States of bridges, each made only when crossings have come since: it costs up to a second."""

    def __init__(self, fusing: Fusing) -> None:
        self.fusing = fusing
        self._made: dict[Hashable, tuple[Counted, BridgeResult | None]] = {}

    def of(self, counted: Counted, bridge: str, key: Hashable) -> BridgeResult | None:
        """As `state_of`; `key` tells apart bridges of one name."""
        made = self._made.get(key)
        if made is None or made[0] is not counted:
            made = self._made[key] = (counted, state_of(counted, bridge, self.fusing))
        return made[1]


def with_common_shares(
    crossings: Iterable[Crossing], bridges: Mapping[str, BridgeResult]
) -> list[Crossing]:
    """Crossings with the share of the mismatch that other runs in their track have too."""
    return [_with_common_share(crossing, bridges.get(crossing.bridge)) for crossing in crossings]


def _with_common_share(crossing: Crossing, bridge: BridgeResult | None) -> Crossing:
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
    """What a fused state says of each element, as its `finding` does; see `compare`."""
    edges = np.concatenate([[0.0], np.cumsum(element_lengths_m)])
    stored = None if baseline is None else estimate_of_state(baseline)
    now = estimate_of_state(state, element_lengths_m.tolist())
    return compare(now, nominal_nm2, edges, stored)


def _latest(counted: Counted) -> BridgeResult:
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
    """EI (n,), or draws of it (draws, n), with which elements are compared."""
    if baseline is None or len(baseline.elements) != found.nominal_nm2.size:
        return found.nominal_nm2
    # The baseline's errors, taken for log-normal and for independent of the new ones.
    rng = np.random.default_rng(found.ei_nm2.shape[0])
    of = estimate_of_state(baseline)
    spread = np.log(of.high / of.low) / (2.0 * NORMAL_975)
    return np.asarray(of.mean * np.exp(spread * rng.standard_normal(found.ei_nm2.shape)))


def _losses(ratio: Floats) -> dict[str, dict[str, float]]:
    return {
        f"EI_{n}": {
            str(percent): float(np.mean(one < 1.0 - percent / 100.0)) for percent in LOSSES_PERCENT
        }
        for n, one in enumerate(ratio.T, start=1)
    }


def _level(found: FusedBridge, begin: float, end: float) -> ElementState:
    share = part_of_elements(found.element_lengths_m, begin, end)
    return _summary(np.exp(np.log(found.ei_nm2 / found.nominal_nm2) @ share))


def _summary(draws: Floats) -> ElementState:
    low, high = np.quantile(draws, [0.025, 0.975])
    return ElementState(
        mean=float(draws.mean()), std=float(draws.std()), q025=float(low), q975=float(high)
    )


def _finding(found: FusedBridge, state: BridgeResult, baseline: BridgeResult | None) -> str:
    """The bridge in words: what is told of its elements, and what is not."""
    comparison = compared(state, found.nominal_nm2, found.element_lengths_m, baseline)
    return " ".join(told(comparison, unresolved_elements(state.elements.values()), state.level))
