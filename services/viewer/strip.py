"""The picture of what is known of the rigidity along the span."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import NORMAL_975
from services.viewer.crossing_view import CrossingView

STRIP_WIDTH, STRIP_HEIGHT = 1200, 600
"""Pixels along the span, and for the rigidity."""
STRIP_TOP_RATIO = 1.5
"""The upper edge is at this ratio to the nominal rigidity."""
STRIP_PAPER, STRIP_INK, STRIP_DOUBT = (17, 21, 26), (86, 180, 233), (150, 150, 150)
"""Red, green and blue; the last is the ink of what is doubtful."""


def rigidity_strip(crossing: CrossingView, *, doubtful: bool = False) -> NDArray[np.uint8]:
    """Picture of what is known of the rigidity along the span; (height, width, 3).

    A column belongs to a chainage, a row to a ratio to the nominal rigidity, from 1.5 at the top to
    0 at the bottom. Brightness is the probability density, as a normal distribution with the width
    of the interval, relative to its peak; below the estimate the element is filled faintly. What is
    doubtful is grey.
    """
    estimate = crossing.rigidity_nm2
    if estimate is None:
        raise ValueError("a rejected crossing has no rigidity to draw")
    ratio = estimate / crossing.nominal_nm2
    thinnest = 1.5 * STRIP_TOP_RATIO / STRIP_HEIGHT  # a line that can still be seen
    if crossing.interval_nm2 is None:
        spread = np.full_like(ratio, thinnest)
    else:
        width = np.diff(crossing.interval_nm2, axis=1)[:, 0] / crossing.nominal_nm2
        spread = np.maximum(width / (2.0 * NORMAL_975), thinnest)
    rows = STRIP_TOP_RATIO * (1.0 - (np.arange(STRIP_HEIGHT) + 0.5) / STRIP_HEIGHT)
    chainage = crossing.span_m * (np.arange(STRIP_WIDTH) + 0.5) / STRIP_WIDTH
    element = np.searchsorted(crossing.element_edges_m, chainage) - 1
    density = np.exp(-0.5 * ((rows[:, None] - ratio) / spread) ** 2)
    shade = np.maximum(density, np.where(rows[:, None] < ratio, 0.3, 0.0))[:, element]
    boundary = np.diff(element, prepend=element[0]) != 0
    shade[:, boundary] = 0.0
    paper, ink = np.array(STRIP_PAPER), np.array(STRIP_DOUBT if doubtful else STRIP_INK)
    picture: NDArray[np.uint8] = np.rint(paper + shade[:, :, None] * (ink - paper)).astype(np.uint8)
    return picture
