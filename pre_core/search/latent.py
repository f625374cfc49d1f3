"""Normal coordinates of values that must not be negative and may be exactly zero."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray


class LatentCoordinates(NamedTuple):
    """Normal coordinates v of values y, some of which must not be negative and may be zero.

    A value that may be zero is zero for any v below zero; one that is never zero is |v|. All values
    follow those: v is what they do not explain. So a value that becomes zero takes its correlated
    ones along, and no further: without this, moves of v hardly ever reach zero and return.
    """

    places: NDArray[np.int64]
    """Indices (p,) of the values that must not be negative; each follows those before it."""
    log_odds: FloatArray  # (p,) of zero, against the density per unit
    scale: FloatArray
    """Spreads (p,) of v below zero, where its density is normal: about those of the values above,
    because moves of one length explore both."""
    follow: FloatArray  # (b, p) slopes of all values along those of `places`

    def values(self, v: FloatArray) -> FloatArray:
        """Return the values (k, b) of coordinates v (k, b)."""
        y = v.copy()
        for number, place in enumerate(self.places):
            y[:, place] = _not_negative(y[:, place], self.log_odds[number])
            y += np.outer(y[:, place], self.follow[:, number])
        return y

    def log_share(self, v: FloatArray) -> FloatArray:
        """Return the log density (k,) of v (k, b) relative to that of the values."""
        y, share = v.copy(), np.zeros(v.shape[0])
        for number, place in enumerate(self.places):
            odds, scale = self.log_odds[number], self.scale[number]
            relative = y[:, place] / scale
            if np.isfinite(odds):
                mass = odds + 0.5 * np.log(2.0 / np.pi) - np.log(scale)
                share += np.where(relative <= 0.0, mass - 0.5 * relative**2, 0.0)
            elif odds > 0.0:  # always zero: v has a density of its own
                share -= 0.5 * relative**2
            y[:, place] = _not_negative(y[:, place], odds)
            y += np.outer(y[:, place], self.follow[:, number])
        return share

    def unexplained(self, values: FloatArray) -> FloatArray:
        """Return the coordinates (b, n) of changes (b, n) of positive values: v is linear there."""
        return np.asarray(values - self.follow @ values[self.places])


def latent_coordinates(
    places: NDArray[np.int64], log_odds: FloatArray, mean: FloatArray, covariance: FloatArray
) -> LatentCoordinates:
    """Return coordinates for values with about this mean (b,) and covariance (b, b).

    `places` (p,) must not be negative; `log_odds` (b,) are those of zero, against the density per
    unit: minus infinity where a value is never zero, infinity where it always is.
    """
    spread = np.sqrt(np.diag(covariance)[places])
    order = places[np.argsort(mean[places] / spread, kind="stable")]
    follow = np.zeros((mean.size, order.size))
    left = covariance.copy()
    for number, place in enumerate(order):
        slope = left[:, place] / left[place, place]
        left -= np.outer(slope, left[place])
        # Those before it, and itself, have nothing left to follow.
        slope[order[: number + 1]] = 0.0
        # What a value itself follows, its followers no longer follow directly.
        follow[:, :number] -= np.outer(slope, follow[place, :number])
        follow[:, number] = slope
    return LatentCoordinates(order, log_odds[order], np.sqrt(np.diag(covariance)[order]), follow)


def _not_negative(v: FloatArray, log_odds: float) -> FloatArray:
    if np.isneginf(log_odds):
        return np.asarray(np.abs(v))
    return np.zeros_like(v) if np.isposinf(log_odds) else np.maximum(v, 0.0)
