"""Which element is weak: each against a baseline, or where there is none, against the others.

The nominal value of a site file is often a guess, and one that is 14 % too high makes every sound
element look 14 % weak. So it is never what an element is judged by; only its pattern along the
bridge is used, to make elements comparable that are not built alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import NORMAL_975
from schemas.results import RESOLVED, BridgeResult, ElementState, Parameter

Floats = NDArray[np.float64]

CLEAR_LOSS = 0.1
"""An element is called weak if its whole interval lies below 1 less this."""
_FEWEST_ELEMENTS = 3
"""With two elements nobody can say which one is the sound one."""


class Estimate(NamedTuple):
    """EI of each element with its 95 % interval, N·m², all arrays (n,)."""

    mean: Floats
    low: Floats
    high: Floats
    scale_error: float = 0.0
    """Relative standard deviation that all elements have in common (mass, gain)."""


class Element(NamedTuple):
    """One element as a ratio to what it is compared with; the limits are those of 95 %."""

    number: int
    from_m: float
    to_m: float
    ratio: float
    low: float
    high: float

    @property
    def is_weak(self) -> bool:
        """Whether it has clearly lost stiffness."""
        return self.high < 1.0 - CLEAR_LOSS

    @property
    def is_stiff(self) -> bool:
        """Whether it is clearly stiffer."""
        return self.low > 1.0 + CLEAR_LOSS

    @property
    def visible_loss(self) -> float:
        """The smallest loss of this element that would have been called clear."""
        return 1.0 - (1.0 - CLEAR_LOSS) * self.ratio / self.high


class Comparison(NamedTuple):
    """All elements of a bridge against one reference."""

    reference: Literal["baseline", "others"]
    level: float
    """Middle of EI over its nominal value: says something only where the nominal value does."""
    elements: tuple[Element, ...]

    @property
    def weak(self) -> tuple[Element, ...]:
        """The elements that have clearly lost stiffness, the weakest first."""
        return tuple(sorted((e for e in self.elements if e.is_weak), key=lambda e: e.ratio))

    @property
    def stiff(self) -> tuple[Element, ...]:
        """Those that are clearly stiffer."""
        return tuple(element for element in self.elements if element.is_stiff)

    @property
    def rest(self) -> tuple[Element, ...]:
        """All others."""
        return tuple(e for e in self.elements if not e.is_weak and not e.is_stiff)


def compare(
    estimate: Estimate, nominal: Floats, edges_m: Floats, baseline: Estimate | None = None
) -> Comparison | None:
    """Compare elements with a baseline, or each with the middle (median) of all others.

    `nominal` (n,) in N·m², `edges_m` (n + 1,). Errors are taken as log-normal. Against a baseline
    those of both add up. Among elements of one measurement what they have in common drops out, and
    the error of the middle comes in: that of a median of n - 1 is 1.25 times a mean's. None where
    there is nothing to compare: fewer than three elements and no baseline, or a value that no
    stiffness has.
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
    rows = zip(edges_m, edges_m[1:], ratio, low, high, strict=False)
    elements = tuple(Element(n, *map(float, row)) for n, row in enumerate(rows, start=1))
    reference: Literal["baseline", "others"] = "others" if baseline is None else "baseline"
    return Comparison(reference, float(np.median(relative)), elements)


def estimate_of_state(state: BridgeResult, lengths_m: Sequence[float] | None = None) -> Estimate:
    """The stiffness of a bridge's elements by its latest state, with what they have in common.

    `lengths_m` are the elements' (default: all alike).
    """
    table = np.array([(e.mean, e.q025, e.q975) for e in state.elements.values()]).reshape(-1, 3)
    mean, low, high = table.T
    return Estimate(mean, low, high, _common_error(state, lengths_m))


def _common_error(state: BridgeResult, lengths_m: Sequence[float] | None) -> float:
    """Relative standard deviation that all elements have in common, by how sure their level is.

    The level is the mean of ln EI, weighted by lengths w that sum to one. With errors of standard
    deviation s_i, of which c is common, its variance is c² (1 - Σ w_i²) + Σ w_i² s_i². So only what
    is above the second part is common; the whole of it is not, for elements that err each on their
    own move their mean too.
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
    """Numbers of those whose standard deviation is too large to tell a loss of half of them."""
    counted = enumerate(elements, start=1)
    return frozenset(n for n, one in counted if one.std > RESOLVED * abs(one.mean))


def elsewhere(found: Comparison | None, unresolved: Set[int]) -> tuple[int, ...]:
    """Numbers of the unresolved neighbours of weak elements: the loss may be theirs.

    What bends under an axle is the sum of what elements that lie side by side do, and between them
    rigidity is traded.
    """
    weak = set() if found is None else {one.number for one in found.weak}
    beside = {n + side for n in weak for side in (-1, 1)} - weak
    return tuple(sorted(beside & unresolved))


def told(
    found: Comparison | None, unresolved: Set[int] = frozenset(), level: ElementState | None = None
) -> list[str]:
    """What was found, in words: only of elements that are resolved is said that they agree.

    `unresolved` are the numbers of the others; with them the `level` of the bridge is told.
    """
    if found is None or not unresolved:
        return sentences(found)
    said = of_clear_elements(found)
    others = elsewhere(found, unresolved)
    if others:
        either = " or ".join(map(str, others))
        said.append(f"The loss may as well be in element {either}, beside it and not resolved.")
    which = _not_resolved(len(found.elements), unresolved)
    said.append(f"{which} (standard deviation above {100.0 * RESOLVED:.0f} %).")
    if level is not None:
        said.append(
            f"As a whole the bridge is at {level.mean:.2f} of nominal "
            f"± {100.0 * level.std / level.mean:.0f} %."
        )
    return said


def of_clear_elements(found: Comparison) -> list[str]:
    """What is said of elements that differ clearly, and nothing of the others."""
    clear = tuple(one for one in found.elements if one.is_weak or one.is_stiff)
    return sentences(found._replace(elements=clear)) if clear else []


def _not_resolved(count: int, unresolved: Set[int]) -> str:
    if len(unresolved) == count:
        return "No single element is resolved"
    *others, last = sorted(unresolved)
    if not others:
        return f"Element {last} is not resolved"
    return f"Elements {', '.join(map(str, others))} and {last} are not resolved"


def sentences(found: Comparison | None) -> list[str]:
    """What was found, in words for who knows the bridge and not the method."""
    if found is None:
        return ["The elements cannot be compared with each other, and there is no baseline."]
    than = "than the baseline" if found.reference == "baseline" else "than the other elements"
    said = [
        f"{_place(e)}: {_percent(1.0 - e.ratio)} less stiff {than}, "
        f"interval {_range(1.0 - e.high, 1.0 - e.low)}."
        for e in found.weak
    ]
    said += [
        f"{_place(e)}: {_percent(e.ratio - 1.0)} stiffer {than}, "
        f"interval {_range(e.low - 1.0, e.high - 1.0)}."
        for e in found.stiff
    ]
    rest = found.rest
    if not rest:
        return said
    within = max(1, int(np.ceil(100.0 * max(abs(1.0 - e.ratio) for e in rest) - 1e-6)))
    if found.reference == "baseline":
        which = "All others are" if said else "No element has clearly changed: all are"
        said.append(f"{which} unchanged within {within} %.")
    else:
        which = "All others agree" if said else "No element stands out: all agree"
        said.append(f"{which} within {within} %.")
    return said


def _without(width: Floats, common: float) -> Floats:
    """A half width in logarithms without the part that all have in common; never below a tenth."""
    return np.sqrt(np.maximum(width**2 - common**2, (0.1 * width) ** 2))


def _place(element: Element) -> str:
    return f"Element {element.number}, {element.from_m:.1f} to {element.to_m:.1f} m"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _range(low: float, high: float) -> str:
    return f"{100.0 * low:.0f} to {100.0 * high:.0f} %"
