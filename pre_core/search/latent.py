"""Normal coordinates of values that must not be negative and may be exactly zero."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray


class LatentCoordinates(NamedTuple):
    """Normal coordinates v of values y, some of which must not be negative and may be zero.

    A value that may be zero is zero for any v below zero; one that is never zero is |v|.
    """

    places: NDArray[np.int64]
    """Indices of the values that must not be negative."""
    log_odds: FloatArray  # (b,) of zero, against the density per unit

    def values(self, v: FloatArray) -> FloatArray:
        """Return the values (k, b) of coordinates v (k, b)."""
        y, some = v.copy(), v[:, self.places]
        odds = self.log_odds[self.places]
        y[:, self.places] = np.where(
            np.isneginf(odds), np.abs(some), np.where(np.isposinf(odds), 0.0, np.maximum(some, 0.0))
        )
        return y

    def log_share(self, v: FloatArray) -> FloatArray:
        """Return the log density (k,) of v (k, b) relative to that of the values."""
        some, odds = v[:, self.places], self.log_odds[self.places]
        # Without any chance of another value, v has a density of its own.
        mass = np.where(np.isfinite(odds), odds + 0.5 * np.log(2.0 / np.pi), 0.0)
        is_zero = np.isposinf(odds) | ((some <= 0.0) & ~np.isneginf(odds))
        return np.asarray(np.sum(np.where(is_zero, mass - 0.5 * some**2, 0.0), axis=1))
