"""The picture of the rigidity along the span, with its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Set

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import NORMAL_975
from services.viewer.crossing_view import CrossingView
from services.viewer.element_labels import cut_height

STRIP_WIDTH, STRIP_HEIGHT = 1200, 600
"""Size in pixels: along the span, and for the rigidity."""
STRIP_PAPER, STRIP_INK, STRIP_DOUBT = (17, 21, 26), (86, 180, 233), (150, 150, 150)
"""Red, green and blue; the last is the ink of doubtful values."""
STRIP_WEAK = (230, 159, 0)
"""Ink of a clearly weak element."""


def strip_top(crossing: CrossingView) -> float:
    """Return the relative EI at the upper edge: 1.5, or up to 4 for high intervals.

    The interval of an unresolved element that is much longer than the others is cut, as in figures.
    """
    if crossing.rigidity_nm2 is None:
        return 1.5
    ratio = crossing.rigidity_nm2 / crossing.nominal_nm2
    needed = float(ratio.max())
    if crossing.interval_nm2 is not None:
        low, high = crossing.interval_nm2.T / crossing.nominal_nm2
        needed = min(float(high.max()), cut_height(1.0, (ratio, low, high)))
    return min(4.0, max(1.5, math.ceil(2.0 * needed) / 2.0))


def strip_row(ratio: NDArray[np.float64], top: float) -> NDArray[np.float64]:
    """Return the rows of relative EI (n,), in pixels from the top, within the strip."""
    return np.asarray(STRIP_HEIGHT * (1.0 - np.clip(ratio, 0.0, top) / top))


def rigidity_strip(
    crossing: CrossingView, *, doubtful: bool = False, weak: Set[int] = frozenset()
) -> NDArray[np.uint8]:
    """Return a picture of the rigidity along the span; (height, width, 3).

    A column belongs to a chainage, a row to a relative EI, from `strip_top` at the top to 0 at the
    bottom. Brightness is the probability density relative to its peak, as two halves of normal
    distributions that end where the interval does; below the estimate the element is filled
    faintly. The elements whose numbers are in `weak` have an ink of their own; doubtful values are
    grey.
    """
    estimate = crossing.rigidity_nm2
    if estimate is None:
        raise ValueError("a rejected crossing has no rigidity to draw")
    ratio = estimate / crossing.nominal_nm2
    top = strip_top(crossing)
    thinnest = 1.5 * top / STRIP_HEIGHT  # a line that is still visible
    below = above = np.full_like(ratio, thinnest)
    if crossing.interval_nm2 is not None:
        low, high = crossing.interval_nm2.T / crossing.nominal_nm2
        below = np.maximum((ratio - low) / NORMAL_975, thinnest)
        above = np.maximum((high - ratio) / NORMAL_975, thinnest)
    rows = top * (1.0 - (np.arange(STRIP_HEIGHT) + 0.5) / STRIP_HEIGHT)
    chainage = crossing.span_m * (np.arange(STRIP_WIDTH) + 0.5) / STRIP_WIDTH
    element = np.searchsorted(crossing.element_edges_m, chainage) - 1
    spread = np.where(rows[:, None] < ratio, below, above)
    density = np.exp(-0.5 * ((rows[:, None] - ratio) / spread) ** 2)
    shade = np.maximum(density, np.where(rows[:, None] < ratio, 0.3, 0.0))[:, element]
    boundary = np.diff(element, prepend=element[0]) != 0
    shade[:, boundary] = 0.0
    paper = np.array(STRIP_PAPER)
    inks = np.full((ratio.size, 3), STRIP_DOUBT if doubtful else STRIP_INK)
    if not doubtful:
        inks[[number - 1 for number in weak]] = STRIP_WEAK
    coloured = paper + shade[:, :, None] * (inks[element] - paper)
    picture: NDArray[np.uint8] = np.rint(coloured).astype(np.uint8)
    return picture
