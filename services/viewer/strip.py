"""The picture of what is known of the rigidity along the span."""

from __future__ import annotations

import math
from collections.abc import Set

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import NORMAL_975
from services.viewer.crossing_view import CrossingView

STRIP_WIDTH, STRIP_HEIGHT = 1200, 600
"""Pixels along the span, and for the rigidity."""
STRIP_PAPER, STRIP_INK, STRIP_DOUBT = (17, 21, 26), (86, 180, 233), (150, 150, 150)
"""Red, green and blue; the last is the ink of what is doubtful."""
STRIP_WEAK = (230, 159, 0)
"""The ink of an element that is clearly weak."""


def strip_top(crossing: CrossingView) -> float:
    """The ratio to the nominal rigidity at the upper edge: 1.5, or up to 4 where intervals go."""
    highest = crossing.rigidity_nm2 if crossing.interval_nm2 is None else crossing.interval_nm2
    if highest is None:
        return 1.5
    needed = float((highest.T / crossing.nominal_nm2).max())
    return min(4.0, max(1.5, math.ceil(2.0 * needed) / 2.0))


def strip_row(ratio: NDArray[np.float64], top: float) -> NDArray[np.float64]:
    """How far down a ratio to the nominal rigidity is, in pixels; never outside the strip."""
    return np.asarray(STRIP_HEIGHT * (1.0 - np.clip(ratio, 0.0, top) / top))


def rigidity_strip(
    crossing: CrossingView, *, doubtful: bool = False, weak: Set[int] = frozenset()
) -> NDArray[np.uint8]:
    """Picture of what is known of the rigidity along the span; (height, width, 3).

    A column belongs to a chainage, a row to a ratio to the nominal rigidity, from `strip_top` at
    the top to 0 at the bottom. Brightness is the probability density relative to its peak, as two
    halves of normal distributions that end where the interval does; below the estimate the element
    is filled faintly. The elements whose numbers are in `weak` have an ink of their own; what is
    doubtful is grey.
    """
    estimate = crossing.rigidity_nm2
    if estimate is None:
        raise ValueError("a rejected crossing has no rigidity to draw")
    ratio = estimate / crossing.nominal_nm2
    top = strip_top(crossing)
    thinnest = 1.5 * top / STRIP_HEIGHT  # a line that can still be seen
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
