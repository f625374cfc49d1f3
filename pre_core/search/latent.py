"""Normal coordinates of values that must not be negative and may be exactly zero."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray


class LatentCoordinates(NamedTuple):
    """Normal coordinates v of values y, some of which must not be negative and may be zero.

    A value that may be zero is max(v, 0); one that is never zero is |v|. All values depend linearly
    on these, by `follow`, and their v is the remainder. So correlated values move with a value
    until it reaches zero, and then stay: without this, moves of v hardly ever reach zero and
    return.
    """

    indices: NDArray[np.int64]
    """Indices (p,) of the values that must not be negative; each depends on those before it."""
    log_odds: FloatArray
    """Logarithm (p,) of the probability of zero relative to the density per unit at zero."""
    scale: FloatArray
    """Standard deviations (p,) of v below zero, where its density is half-normal: about those of
    the positive values, so that moves of one length explore both sides."""
    follow: FloatArray  # (b, p) derivatives of all values with respect to those of `indices`

    def values(self, v: FloatArray) -> FloatArray:
        """Return the values (k, b) of coordinates v (k, b)."""
        y = v.copy()
        for number, place in enumerate(self.indices):
            y[:, place] = _not_negative(y[:, place], self.log_odds[number])
            y += np.outer(y[:, place], self.follow[:, number])
        return y

    def log_share(self, v: FloatArray) -> FloatArray:
        """Return the log (k,) of the density of v (k, b) over that of its values."""
        y, share = v.copy(), np.zeros(v.shape[0])
        for number, place in enumerate(self.indices):
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
        """Return the changes (b, n) of v for changes (b, n) of values that stay positive."""
        return np.asarray(values - self.follow @ values[self.indices])


def latent_coordinates(
    indices: NDArray[np.int64], log_odds: FloatArray, mean: FloatArray, covariance: FloatArray
) -> LatentCoordinates:
    """Return coordinates for values with about this mean (b,) and covariance (b, b).

    Values at the indices `indices` (p,) must not be negative; `log_odds` (b,) as in
    `LatentCoordinates`: minus infinity where a value is never zero, infinity where it always is.
    """
    spread = np.sqrt(np.diag(covariance)[indices])
    order = indices[np.argsort(mean[indices] / spread, kind="stable")]
    follow = np.zeros((mean.size, order.size))
    left = covariance.copy()
    for number, place in enumerate(order):
        slope = left[:, place] / left[place, place]
        left -= np.outer(slope, left[place])
        # Earlier values, and this one itself, do not depend on it.
        slope[order[: number + 1]] = 0.0
        # The indirect dependence on earlier values, through this one, is not counted twice.
        follow[:, :number] -= np.outer(slope, follow[place, :number])
        follow[:, number] = slope
    return LatentCoordinates(order, log_odds[order], np.sqrt(np.diag(covariance)[order]), follow)


def _not_negative(v: FloatArray, log_odds: float) -> FloatArray:
    if np.isneginf(log_odds):
        return np.asarray(np.abs(v))
    return np.zeros_like(v) if np.isposinf(log_odds) else np.maximum(v, 0.0)
