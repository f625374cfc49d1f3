"""A quantity that a site file implies, with its usual range."""

import math
from typing import Final, NamedTuple

MAX_BRIDGES: Final = 50
"""Largest number of bridges with findings: a fleet's site file has thousands."""
_FAR: Final = 2.0
"""Factor beyond a range at which a value is taken to be wrong, not only unusual."""


class ImpliedQuantity(NamedTuple):
    """A quantity that a site file implies, and its usual range."""

    name: str
    text: str
    value: float
    low: float
    high: float
    unit: str
    meant: str
    """Probable intention; empty where there is none to suggest or the value is usual."""
    is_certain: bool = True
    """Whether a value far out of its range cannot be right."""
    wrong_beyond: tuple[float, float] | None = None
    """Limits beyond which it is far out of its range; None: a factor of 2 beyond the range."""

    @property
    def is_unusual(self) -> bool:
        """Whether it is out of its range."""
        return not self.low <= self.value <= self.high

    @property
    def is_far(self) -> bool:
        """Whether it is far out of its range."""
        low, high = self.wrong_beyond or (self.low / _FAR, self.high * _FAR)
        return self.is_certain and not low <= self.value <= high

    @property
    def advice(self) -> str:
        """Sentence that names the usual range, and what was probably meant."""
        most = f" to {self.high:.3g}" if self.high < math.inf else " at least"
        usual = f"typical is {self.low:.3g}{most} {self.unit}".rstrip()
        return f"{usual}: {self.meant}" if self.meant else f"{usual}: check units and values"
