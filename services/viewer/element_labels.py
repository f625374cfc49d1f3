"""Intervals of elements, and the labels next to them, which lie on no line and on no marker."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.markers import CARETUP

from pre_core.constants import NORMAL_975
from schemas.results import RESOLVED
from services.common.arrays import Floats
from services.common.language import ENGLISH, Language
from services.identification.comparison import Comparison, Estimate
from services.viewer.drawing import BASELINE_COLOUR, INK, MUTED, BarPlaces

_PLATE: dict[str, Any] = {
    "boxstyle": "round,pad=0.15",
    "facecolor": "white",
    "alpha": 0.85,
    "linewidth": 0,
}
"""Box behind a label, which hides the lines that it would stand on."""
_LABEL_PT = 16.0
"""Height of a label with its box, in points."""
_VALUE_PT, _LOSS_PT, _LOSS_ABOVE_VALUE_PT = 5.0, 6.0, 21.0
"""Distances of labels from the top of an interval, in points."""
_NAME_PT, _NAMES_PT = 3.0, 18.0
"""Distance of an element's name from the top of its panel, and height of all names, in points."""
BEFORE, AFTER = (0.02, 0.42), (0.42, 1.0)
"""Parts of an element that the bars of baseline and present estimate take."""
_WIDE, _ASIDE = 0.12, 0.15
"""Part of the panel's width from which a bar has room for a label to the right of its dots, and
the distance that the label moves, relative to the bar."""
_MANY = 11
"""Number of elements beyond which labels are smaller."""
_LONG = 2.5
"""Length of an interval from which it is cut, relative to the highest resolved value."""
_CUT = 1.6
"""Length of a cut interval, relative to the highest resolved value."""


def columns_gnm2(estimate: Estimate) -> tuple[Floats, Floats, Floats]:
    """Return mean and limits in GN·m²."""
    return estimate.mean / 1e9, estimate.low / 1e9, estimate.high / 1e9


def cut_height(
    highest: float, *intervals: tuple[Floats, Floats, Floats], farthest: float = 0.0
) -> float:
    """Return the height at which intervals of unresolved elements are cut; infinite if none is.

    An interval that is much longer than all others, and than `highest`, would leave them no height;
    so would a marker at `farthest`. The `intervals` are means and limits, all (n,).
    """
    for mean, low, high in intervals:
        is_resolved = high - low <= 2.0 * NORMAL_975 * RESOLVED * mean
        highest = max(highest, *high[is_resolved], 0.0)
    longest = max(farthest, *(float(high.max()) for _, _, high in intervals))
    return _CUT * highest if longest > _LONG * highest else np.inf


def draw_intervals(
    axes: Axes,
    places: BarPlaces,
    limits: tuple[Floats, Floats],
    *,
    colour: str,
    label: str,
    cut: float = np.inf,
) -> None:
    """Draw the interval of each element with its ends; an arrow stands where one is cut."""
    draw_lines(axes, places, limits, colour=colour, cut=cut, width=2.2, label=label)
    for end in limits:
        is_drawn = end <= cut
        centres, half = places.centres_m[is_drawn], 0.09 * places.lengths_m[is_drawn]
        axes.hlines(end[is_drawn], centres - half, centres + half, color=colour, zorder=5)


def draw_lines(
    axes: Axes,
    places: BarPlaces,
    limits: tuple[Floats, Floats],
    *,
    colour: str,
    cut: float,
    width: float,
    label: str = "",
) -> None:
    """Draw the line of each interval; an arrow stands where it goes on beyond `cut`."""
    low, high = (np.minimum(end, cut) for end in limits)
    centres, is_cut = places.centres_m, limits[1] > cut
    axes.vlines(centres, low, high, color=colour, linewidth=width, zorder=5, label=label)
    if is_cut.any():
        axes.plot(
            centres[is_cut],
            high[is_cut],
            linestyle="none",
            marker=CARETUP,  # its tip is at the cut
            markersize=8.0,
            color=colour,
            zorder=6,
        )


def arrow_names(axes: Axes, language: Language = ENGLISH) -> list[Line2D]:
    """Return the legend's entry for arrows of values beyond the axis; a support has none."""
    carets = (line for line in axes.lines if line.get_marker() == CARETUP)
    if all(line.get_transform() != axes.transData for line in carets):
        return []
    look: dict[str, Any] = {"linestyle": "none", "marker": CARETUP, "color": INK}
    return [Line2D([], [], label=language.text("figure.beyond"), **look)]


def draw_baseline(
    axes: Axes,
    places: BarPlaces,
    columns: tuple[Floats, Floats, Floats],
    cut: float,
    language: Language = ENGLISH,
) -> None:
    """Draw a baseline as empty bars with their intervals."""
    mean, low, high = columns
    axes.bar(
        places.centres_m,
        mean,
        width=0.86 * places.lengths_m,
        facecolor="white",
        edgecolor=BASELINE_COLOUR,
        linewidth=1.3,
        zorder=2,
        label=language.text("figure.before"),
    )
    draw_intervals(axes, places, (low, high), colour=BASELINE_COLOUR, label="", cut=cut)


def change_texts(found: Comparison, language: Language = ENGLISH) -> list[str]:
    """Return the change of each element, empty where none can be stated."""
    return [language.change(one.ratio) if one.is_comparable else "" for one in found.elements]


def label_elements(
    axes: Axes,
    edges_m: Floats,
    anchors: Anchors,
    texts: Sequence[str],
    losses: Mapping[int, str],
    highest: float,
) -> float:
    """Write number, loss and name of each element; return the axis' end, above `highest`, too.

    `texts` (n,) are the numbers, empty for none; `losses` are by element, from 1.
    """
    places, floor, tops = anchors
    _label_values(axes, places, floor, tops, texts)
    _label_losses(axes, places, floor, tops, losses)
    name_elements(axes, edges_m)
    return max(1.1 * highest, _top_above_labels(axes, floor, tops, losses))


def _label_losses(
    axes: Axes,
    places: BarPlaces,
    low: Floats,
    high: Floats,
    losses: Mapping[int, str],
) -> None:
    """Label the losses of elements, by their numbers, above their intervals and their values."""
    above = _are_low(low, high)
    for number, text in losses.items():
        axes.annotate(
            text,
            (places.centres_m[number - 1], high[number - 1]),
            xytext=(0, _LOSS_ABOVE_VALUE_PT if above[number - 1] else _LOSS_PT),
            textcoords="offset points",
            ha="center",
            fontsize=8 if high.size > _MANY else 9.5,
            fontweight="bold",
            zorder=8,
            bbox=_PLATE,
        )


def _label_values(
    axes: Axes, places: BarPlaces, low: Floats, high: Floats, texts: Sequence[str]
) -> None:
    """Write a number below each interval, or above where the bar is too low; none if empty."""
    above = _are_low(low, high)
    for number, (centre, text) in enumerate(zip(places.centres_m, texts, strict=True)):
        if not text:
            continue
        axes.annotate(
            text,
            (centre, high[number] if above[number] else low[number]),
            xytext=(0, _VALUE_PT if above[number] else -10),
            textcoords="offset points",
            ha="center",
            va="bottom" if above[number] else "top",
            fontsize=8.5 if len(texts) > _MANY else 10.5,
            fontweight="bold",
            zorder=7,
            bbox=_PLATE,
        )


def name_elements(axes: Axes, edges_m: Floats) -> None:
    """Write the name of each element at the top of a panel; the edges are (n + 1,)."""
    for number, centre in enumerate((edges_m[:-1] + edges_m[1:]) / 2.0, start=1):
        axes.annotate(
            f"$EI_{{{number}}}$",
            (centre, 1.0),
            xycoords=axes.get_xaxis_transform(),
            xytext=(0, -_NAME_PT),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=8.0 if edges_m.size - 1 > _MANY else 10.0,
            color=MUTED,
            zorder=7,
            bbox=_PLATE,
        )


def end_with_names(axes: Axes, highest: float) -> float:
    """Return the end of a vertical axis from 0 whose names are above the highest drawn value."""
    return highest / (1.0 - _NAMES_PT / _height_pt(axes))


def _top_above_labels(axes: Axes, low: Floats, high: Floats, labelled: Iterable[int] = ()) -> float:
    """Return the height of a vertical axis from 0 below which all labels above intervals stay.

    `labelled` are the numbers of the elements with a loss above their interval.
    """
    above = np.array(_are_low(low, high))
    needed_pt = np.where(above, _VALUE_PT + _LABEL_PT, 0.0)
    for number in labelled:
        start_pt = _LOSS_ABOVE_VALUE_PT if above[number - 1] else _LOSS_PT
        needed_pt[number - 1] = start_pt + _LABEL_PT
    return float(np.max(high / (1.0 - needed_pt / (_height_pt(axes) - _NAMES_PT))))


class Anchors(NamedTuple):
    """Places of the labels of intervals, all (n,)."""

    places: BarPlaces
    floor: Floats
    """Lower ends of intervals; 0 where a value must not stand below."""
    tops: Floats


def anchors_clear_of(
    axes: Axes, places: BarPlaces, limits: tuple[Floats, Floats], dots: Floats, highest: float
) -> Anchors:
    """Return where labels stand that cover no dot (k, n) to the left of their interval.

    A label that would cover one goes below the interval, or to the right in a wide bar; only
    elsewhere it goes above the dot. `highest` is the highest drawn value.
    """
    low, high = limits
    if not len(dots):
        return Anchors(places, low, high)
    per_pt = highest / (_height_pt(axes) - _NAMES_PT)
    near, reach = 3.0 * per_pt, (_LOSS_ABOVE_VALUE_PT + _LABEL_PT + 4.0) * per_pt
    tops = np.maximum(high, np.where(np.abs(dots - high) <= near, dots, 0.0).max(axis=0))
    is_covered = np.any((dots > tops) & (dots < tops + reach), axis=0)
    is_free_below = ~np.any((dots < low) & (dots > low - reach), axis=0)
    goes_below = is_covered & is_free_below & ~np.array(_are_low(low, high))
    floor = np.where(goes_below, low, 0.0)
    is_covered &= ~goes_below
    if np.all(places.lengths_m >= _WIDE * np.ptp(axes.get_xlim())):
        shift = np.where(is_covered, _ASIDE, 0.0) * places.lengths_m
        return Anchors(places._replace(centres_m=places.centres_m + shift), floor, tops)
    for heights in np.sort(dots, axis=0):
        is_in_the_way = is_covered & (heights > tops) & (heights < tops + reach)
        tops = np.where(is_in_the_way, heights, tops)
    return Anchors(places, floor, tops)


def _height_pt(axes: Axes) -> float:
    return float(axes.get_window_extent().height * 72.0 / axes.figure.dpi)


def _are_low(low: Floats, high: Floats) -> Sequence[bool]:
    """Return for each bar whether a number and a name do not fit below its interval."""
    return [bool(one) for one in low < 0.36 * high.max()]
