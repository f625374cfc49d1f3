"""Which element is weak: each against a baseline, or where there is none, against the others.

The nominal value of a site file is often a guess, and one that is 14 % too high makes every sound
element look 14 % weak. So it is never what an element is judged by; only its pattern along the
bridge is used, to make elements comparable that are not built alike.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import NORMAL_975
from schemas.results import BridgeResult

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


def estimate_of_state(state: BridgeResult, scale_error: float = 0.0) -> Estimate:
    """The stiffness of a bridge's elements by its latest state."""
    table = np.array([(e.mean, e.q025, e.q975) for e in state.elements.values()]).reshape(-1, 3)
    return Estimate(table[:, 0], table[:, 1], table[:, 2], scale_error)


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
