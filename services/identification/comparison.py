"""Detection of weak elements: against a baseline, or otherwise against the other elements.

The nominal value of a site file is often a guess, and one that is 14 % too high makes every
undamaged element look 14 % weak. So no element is judged by it; only its pattern along the bridge
is used, to make elements of different design comparable.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence, Set
from typing import Literal, NamedTuple

import numpy as np

from pre_core.constants import NORMAL_95, NORMAL_975
from schemas.results import RESOLVED, BridgeResult, ElementState, Parameter
from services.common.arrays import Floats
from services.common.language import ENGLISH, Language

CLEAR_LOSS = 0.1
"""Smallest stiffness loss that the whole 95 % interval of a weak element must exceed."""
IMPLAUSIBLE_GAIN = 0.2
"""Gain above which no whole 95 % interval of an element is plausible: from summer to winter,
30 K, the stiffness of concrete and asphalt rises by some 12 %."""
Stated = Literal["unresolved", "detectable"]
"""A sentence that may be left out: on unresolved elements, on the smallest detectable loss."""
_FEWEST_ELEMENTS = 3
"""Fewest comparable elements: of two, the undamaged one cannot be identified."""


class Estimate(NamedTuple):
    """EI of each element with its 95 % interval, N·m², all arrays (n,)."""

    mean: Floats
    low: Floats
    high: Floats
    scale_error: float = 0.0
    """Relative standard deviation common to all elements (mass, gain)."""
    unresolved: frozenset[int] = frozenset()
    """Numbers of elements too uncertain to resolve a loss of half their EI."""


class Element(NamedTuple):
    """Ratio of one element to its reference, with 95 % limits."""

    number: int
    from_m: float
    to_m: float
    ratio: float
    low: float
    high: float
    is_comparable: bool = True
    """Whether neither it nor its baseline is unresolved; otherwise no change is stated."""

    @property
    def is_weak(self) -> bool:
        """Whether it has clearly lost stiffness."""
        return self.is_comparable and self.high < 1.0 - CLEAR_LOSS

    @property
    def is_stiff(self) -> bool:
        """Whether it is clearly stiffer."""
        return self.is_comparable and self.low > 1.0 + CLEAR_LOSS

    @property
    def is_lower(self) -> bool:
        """Whether its interval excludes zero loss, but includes losses below `CLEAR_LOSS`."""
        return self.is_comparable and self.high < 1.0 and not self.is_weak

    @property
    def is_higher(self) -> bool:
        """Whether its interval excludes zero gain, and its stiffness is still plausible."""
        return self.is_comparable and self.low > 1.0 and not self.is_implausible

    @property
    def is_implausible(self) -> bool:
        """Whether it is stiffer than damage, weather and chance explain."""
        return self.is_comparable and self.low > 1.0 + IMPLAUSIBLE_GAIN

    @property
    def detectable_loss(self) -> float:
        """Smallest loss of this element that is clear with the probability `DETECTION_PROBABILITY`.

        See `clear_loss_detectable`.
        """
        return float(clear_loss_detectable(np.log([self.high / self.ratio]))[0])


def clear_loss_detectable(half_width: Floats) -> Floats:
    """Return the losses (n,) that are clear with the probability `DETECTION_PROBABILITY`.

    `half_width` (n,) is 1.96 σ, with the standard deviation σ of ln EI relative to the reference.
    The upper end of the interval of a loss L is distributed about ln(1 - L) + 1.96 σ with the same
    σ. It lies below that of a clear loss in 95 of 100 measurements if the middle is 1.64 σ below.
    """
    return 1.0 - (1.0 - CLEAR_LOSS) * np.exp(-half_width * (1.0 + NORMAL_95 / NORMAL_975))


class Comparison(NamedTuple):
    """Comparison of a bridge's elements with one reference."""

    reference: Literal["baseline", "others"]
    median_ratio: float
    """Median of EI over its nominal value, meaningful only with a meaningful nominal value."""
    elements: tuple[Element, ...]
    unresolved_before: frozenset[int] = frozenset()
    """Numbers of elements that the baseline does not resolve."""

    @property
    def weak(self) -> tuple[Element, ...]:
        """Elements that have clearly lost stiffness, the weakest first."""
        return tuple(sorted((e for e in self.elements if e.is_weak), key=lambda e: e.ratio))

    @property
    def stiff(self) -> tuple[Element, ...]:
        """Clearly stiffer elements."""
        return tuple(element for element in self.elements if element.is_stiff)

    @property
    def lower(self) -> tuple[Element, ...]:
        """Elements that have lost stiffness, but not clearly."""
        return tuple(element for element in self.elements if element.is_lower)

    @property
    def risen(self) -> tuple[Element, ...]:
        """Elements stiffer than a baseline; without one they may simply be built so."""
        if self.reference == "others":
            return ()
        return tuple(element for element in self.elements if element.is_higher)

    @property
    def implausible(self) -> tuple[Element, ...]:
        """Elements that are stiffer than damage, weather and chance explain."""
        return tuple(element for element in self.elements if element.is_implausible)

    @property
    def rest(self) -> tuple[Element, ...]:
        """All other elements."""
        return tuple(e for e in self.elements if not e.is_weak and not e.is_stiff)


def compare(
    estimate: Estimate, nominal: Floats, edges_m: Floats, baseline: Estimate | None = None
) -> Comparison | None:
    """Compare elements with a baseline, or each with the median of all others.

    `nominal` (n,) in N·m², `edges_m` (n + 1,). Errors count as log-normal. Against a baseline those
    of both add up, and an element that either does not resolve is not comparable. Among elements
    of one measurement the common error cancels, and the error of the
    median is added: that of a median of n - 1 is 1.25 times a mean's. Return None without a
    reference: fewer than three elements and no baseline, or an impossible value.
    """
    values = np.concatenate((*estimate[:3], nominal, *(baseline[:3] if baseline else ())))
    if not np.all(values > 0.0) or not np.all(np.isfinite(values)):
        return None
    count = estimate.mean.size
    below = np.log(estimate.mean / estimate.low)
    above = np.log(estimate.high / estimate.mean)
    relative = estimate.mean / nominal
    if baseline is not None:
        if baseline.mean.size != count:
            return None
        ratio = estimate.mean / baseline.mean
        more = np.maximum(
            np.log(baseline.mean / baseline.low), np.log(baseline.high / baseline.mean)
        )
    elif count < _FEWEST_ELEMENTS:
        return None
    else:
        others = np.array([np.delete(relative, n) for n in range(count)])
        ratio = relative / np.median(others, axis=1)
        common = NORMAL_975 * estimate.scale_error
        below, above = _without(below, common), _without(above, common)
        widths = np.array([np.delete(np.maximum(below, above), n) for n in range(count)])
        more = 1.25 * np.median(widths, axis=1) / np.sqrt(count - 1)
    low = ratio * np.exp(-np.hypot(below, more))
    high = ratio * np.exp(np.hypot(above, more))
    before = frozenset[int]() if baseline is None else baseline.unresolved
    vague = frozenset[int]() if baseline is None else estimate.unresolved | before
    rows = np.column_stack((edges_m[:-1], edges_m[1:], ratio, low, high)).tolist()
    elements = tuple(
        Element(n, begin, end, of, low_end, high_end, n not in vague)
        for n, (begin, end, of, low_end, high_end) in enumerate(rows, start=1)
    )
    reference: Literal["baseline", "others"] = "others" if baseline is None else "baseline"
    return Comparison(reference, float(np.median(relative)), elements, before)


def estimate_of_state(state: BridgeResult, lengths_m: Sequence[float] | None = None) -> Estimate:
    """Return the stiffness of a bridge's elements in its latest state, with the common error.

    `lengths_m` are the elements' (default: all alike).
    """
    table = np.array([(e.mean, e.q025, e.q975) for e in state.elements.values()]).reshape(-1, 3)
    mean, low, high = table.T
    unresolved = unresolved_elements(state.elements.values())
    return Estimate(mean, low, high, _common_error(state, lengths_m), unresolved)


def _common_error(state: BridgeResult, lengths_m: Sequence[float] | None) -> float:
    """Return the relative standard deviation common to all elements, from that of their level.

    The level is the mean of ln EI, weighted by lengths w that sum to one. With errors of standard
    deviation s_i, of which c is common, its variance is c² (1 - Σ w_i²) + Σ w_i² s_i². So only the
    excess over the second part is common: independent errors of elements move their mean too.
    """
    of = [e for e in state.elements.values() if e.mean > 0.0]
    if state.level is None or not state.level.mean > 0.0 or len(of) < _FEWEST_ELEMENTS:
        return 0.0
    share = np.ones(len(of)) if lengths_m is None else np.asarray(lengths_m, dtype=np.float64)
    if share.size != len(of):
        return 0.0
    squares = (share / share.sum()) ** 2
    own = float(squares @ np.array([(e.std / e.mean) ** 2 for e in of]))
    level = (state.level.std / state.level.mean) ** 2
    return float(np.sqrt(max(0.0, level - own) / (1.0 - squares.sum())))


def unresolved_elements(elements: Iterable[Parameter | ElementState]) -> frozenset[int]:
    """Return the numbers of elements too uncertain to resolve a loss of half their EI."""
    counted = enumerate(elements, start=1)
    return frozenset(n for n, one in counted if one.std > RESOLVED * abs(one.mean))


def ambiguous_neighbours(found: Comparison | None, unresolved: Set[int]) -> tuple[int, ...]:
    """Return the unresolved neighbours of weak elements, where the loss may be instead.

    The deflection under an axle is the sum over adjacent elements, whose rigidities compensate each
    other.
    """
    weak = set() if found is None else {one.number for one in found.weak}
    beside = {n + side for n in weak for side in (-1, 1)} - weak
    return tuple(sorted(beside & unresolved))


def origin_of_state(state: BridgeResult) -> str:
    """Return in a sentence from which crossings the values of a state are.

    The intervals of a single crossing are narrower than those of the state: they do not include the
    variability between crossings.
    """
    used = len(state.crossings_used)
    if used > 1:
        return f"Values from {used} fused crossings."
    if state.between_crossing_std is not None:
        return "Values from one crossing; its own figure excludes between-crossing variability."
    return "Values from one crossing."


def describe_comparison(
    found: Comparison | None,
    unresolved: Set[int] = frozenset(),
    level: ElementState | None = None,
    language: Language = ENGLISH,
    without: Collection[Stated] = (),
) -> list[str]:
    """Return sentences on the comparison; unresolved elements are named without a change.

    `unresolved` are their numbers; with them, or with some that the baseline does not resolve, the
    `level` of the bridge is stated. The sentences `without` are left to the caller.
    """
    every = unresolved if found is None else unresolved | found.unresolved_before
    if found is None or not every:
        return sentences(found, language, without)
    wordings = describe_clear_elements(found, language)
    others = ambiguous_neighbours(found, every)
    if others:
        either = f" {language.text('or')} ".join(map(str, others))
        wordings.append(language.choice("may_be_beside", len(others), numbers=either))
    if unresolved and "unresolved" not in without:
        wordings.append(_not_resolved("unresolved", len(found.elements), unresolved, language))
    if found.unresolved_before:
        before, count = found.unresolved_before, len(found.elements)
        wordings.append(_not_resolved("unresolved_before", count, before, language))
    resolved = tuple(e for e in found.rest if e.number not in every)
    if resolved and "detectable" not in without:
        wordings.append(smallest_detectable("rest.resolved", resolved, language))
    if level is not None:
        wordings.append(describe_level(level, language))
    return wordings


def describe_level(level: ElementState, language: Language = ENGLISH) -> str:
    """Return the sentence on the overall stiffness."""
    return language.text("level", mean=level.mean, std=100.0 * level.std / level.mean)


def weak_before(baseline: Estimate, nominal: Floats, edges_m: Floats) -> tuple[Element, ...]:
    """Return the elements that were clearly less stiff than the others in a baseline."""
    alone = compare(baseline, nominal, edges_m)
    return () if alone is None else alone.weak


def describe_weak_before(weak: Sequence[Element], language: Language = ENGLISH) -> Iterator[str]:
    """Yield that elements were weak in the baseline already; nothing without any."""
    if weak:
        listed = [
            language.text(
                "caution.loss",
                number=one.number,
                loss=100.0 * (1.0 - one.ratio),
                low=100.0 * (1.0 - one.high),
                high=100.0 * (1.0 - one.low),
            )
            for one in weak
        ]
        yield language.choice("caution.earlier", len(weak), elements=language.listed(listed))


def possibly_weak(found: Comparison | None, unresolved: Set[int]) -> tuple[Element, ...]:
    """Return the resolved elements whose interval excludes zero, but includes a small loss."""
    lower = () if found is None else found.lower
    return tuple(element for element in lower if element.number not in unresolved)


def describe_possibly_weak(
    elements: Sequence[Element], language: Language = ENGLISH
) -> Iterator[str]:
    """Yield a sentence on the elements that are possibly weak; nothing if none is."""
    if elements:
        yield language.choice(
            "caution.lower",
            len(elements),
            elements=changes_in_words(elements, language),
            limit=100.0 * CLEAR_LOSS,
        )


def changes_in_words(elements: Sequence[Element], language: Language) -> str:
    """Return a list of elements with their changes and intervals."""
    return language.listed(
        [
            language.text(
                "caution.change",
                number=one.number,
                **{end: language.change(getattr(one, end)) for end in ("ratio", "low", "high")},
            )
            for one in elements
        ]
    )


def describe_clear_elements(found: Comparison, language: Language = ENGLISH) -> list[str]:
    """Return sentences on elements that differ clearly, and none on the others."""
    clear = tuple(one for one in found.elements if one.is_weak or one.is_stiff)
    return sentences(found._replace(elements=clear), language) if clear else []


def _not_resolved(key: str, count: int, unresolved: Set[int], language: Language) -> str:
    *others, last = sorted(unresolved)
    values = {"limit": 100.0 * RESOLVED, "last": last, "others": ", ".join(map(str, others))}
    if len(unresolved) == count:
        return language.text(f"{key}.all", **values)
    return language.choice(key, len(unresolved), **values)


def sentences(
    found: Comparison | None, language: Language = ENGLISH, without: Collection[Stated] = ()
) -> list[str]:
    """Return sentences on the comparison for readers who know the bridge and not the method."""
    if found is None:
        return [language.text("not_comparable")]
    wordings = [_change("weaker", found, e, language) for e in found.weak]
    wordings += [_change("stiffer", found, e, language) for e in found.stiff]
    if found.rest:
        farthest = max(abs(1.0 - e.ratio) for e in found.rest)
        within = max(1, per_cent_up(farthest))
        which = "rest" if wordings else "all"
        wordings.append(language.text(f"{which}.{found.reference}", within=within))
        if "detectable" not in without:
            wordings.append(smallest_detectable("rest.detectable", found.rest, language))
    return wordings


def smallest_detectable(key: str, elements: Sequence[Element], language: Language) -> str:
    """Return the sentence on the loss that is detectable in each of the elements.

    Ends are often known far worse than the rest: where losses differ, the smallest and the largest
    are stated.
    """
    worst = max(elements, key=lambda element: element.detectable_loss)
    best = min(elements, key=lambda element: element.detectable_loss)
    low, high = per_cent_up(best.detectable_loss), per_cent_up(worst.detectable_loss)
    if low == high:
        return language.text(key, loss=high)
    return language.text("rest.range", low=low, best=best.number, high=high, worst=worst.number)


def per_cent_up(share: float) -> int:
    """Return a share in per cent, rounded up, so that no smaller loss is stated as detectable."""
    return int(np.ceil(100.0 * share - 1e-6))


def _change(how: str, found: Comparison, element: Element, language: Language) -> str:
    """Return the sentence on one clear element; losses and gains are stated without a sign."""
    place = language.text("element", **element._asdict())
    change = sorted(100.0 * abs(1.0 - end) for end in (element.low, element.high))
    return language.text(
        f"{how}.{found.reference}",
        element=place,
        ratio=100.0 * abs(1.0 - element.ratio),
        low=change[0],
        high=change[1],
    )


def _without(width: Floats, common: float) -> Floats:
    """Return a half width in logarithms without the common part; at least a tenth of it."""
    return np.sqrt(np.maximum(width**2 - common**2, (0.1 * width) ** 2))
