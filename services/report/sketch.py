"""A sketch of a bridge from above: its elements, its direction, and how trucks crossed it."""

from __future__ import annotations

import math
from itertools import pairwise

from services.common.geodesy import bridge_frame, heading_deg
from services.common.language import Language
from services.report.bridge import BridgeReport
from services.report.html import Html, tag
from services.report.place import ends_of

_SIZE = 172.0
"""Width and height of the sketch in its own units."""
_HALF_LENGTH, _HALF_WIDTH, _TRACK = 42.0, 5.5, 13.0
_COLOURS = {"weak": "#E69F00", "other": "#cfe3f1", "doubtful": "#f1f1f1"}


def sketch(report: BridgeReport, language: Language) -> Html:
    """Return an SVG with north at the top, without a network: no map is behind it."""
    bridge, view = report.bridge, report.view
    angle = math.radians(heading_deg(bridge_frame(bridge)))
    comparison = view.comparison
    weak = set() if comparison is None else {element.number for element in comparison.weak}
    ends = [-_HALF_LENGTH]
    for length in bridge.lengths_m:
        ends.append(ends[-1] + 2.0 * _HALF_LENGTH * length / bridge.span_m)
    parts = []
    for number, (begin, end) in enumerate(pairwise(ends), start=1):
        corners = (
            (begin, -_HALF_WIDTH), (end, -_HALF_WIDTH), (end, _HALF_WIDTH), (begin, _HALF_WIDTH),
        )  # fmt: skip
        kind = "doubtful" if view.is_doubtful else "weak" if number in weak else "other"
        points = " ".join(_point(angle, *corner) for corner in corners)
        parts.append(tag("polygon", points=points, fill=_COLOURS[kind], stroke="#0072B2"))
        if number in weak and not view.is_doubtful:
            parts.append(_label(angle, (begin + end) / 2.0, -_HALF_WIDTH - 9.0, str(number)))
    directions = dict.fromkeys(crossing.direction for crossing in report.crossings)
    for direction in directions:
        forward = 1.0 if direction == "start_to_end" else -1.0
        parts.append(_arrow(angle, forward, _TRACK * (1.0 if forward > 0.0 else 1.6)))
    parts.append(_label(angle, -_HALF_LENGTH - 18.0, 0.0, "0 m"))
    far = language.text("bridge.length", span_m=bridge.span_m)
    parts.append(_label(angle, _HALF_LENGTH + 23.0, 0.0, far))
    parts.append(_north(language))
    sides = ends_of(bridge, language)
    ways = [
        language.text("crossings.way_cell", start=a, end=b)
        for a, b in ((sides if d == "start_to_end" else reversed(sides)) for d in directions)
    ]
    label = language.text("map.label", elements=bridge.elements, directions=language.listed(ways))
    box = f"0 0 {_SIZE:g} {_SIZE:g}"
    svg = tag("svg", *parts, viewBox=box, role="img", aria_label=label)
    return tag("figure", svg, class_="sketch")


def _point(angle: float, along: float, right: float) -> str:
    """Return a point by its distances along the bridge and to the right of it, north at the top."""
    east = along * math.sin(angle) + right * math.cos(angle)
    north = along * math.cos(angle) - right * math.sin(angle)
    return f"{_SIZE / 2.0 + east:.1f},{_SIZE / 2.0 - north:.1f}"


def _label(angle: float, along: float, right: float, text: str) -> Html:
    x, y = _point(angle, along, right).split(",")
    return tag("text", text, x=x, y=y, text_anchor="middle", dominant_baseline="central")


def _arrow(angle: float, forward: float, right: float) -> Html:
    """Return an arrow next to the bridge in a truck's direction."""
    line = [(-0.7, 0.0), (0.7, 0.0), (0.58, -0.05), (0.7, 0.0), (0.58, 0.05)]
    points = " ".join(
        _point(angle, forward * along * _HALF_LENGTH, right + across * _HALF_LENGTH)
        for along, across in line
    )
    return tag("polyline", points=points, fill="none", stroke="#1b1f24", stroke_width="1.3")


def _north(language: Language) -> Html:
    x, top = _SIZE - 10.0, 8.0
    needle = f"{x:g},{top + 30:g} {x:g},{top + 10:g} {x - 3:g},{top + 16:g} {x:g},{top + 10:g} "
    needle += f"{x + 3:g},{top + 16:g}"
    return tag(
        "g",
        tag("polyline", points=needle, fill="none", stroke="#5b6570"),
        tag("text", language.text("map.north"), x=f"{x:g}", y=f"{top + 4:g}", text_anchor="middle"),
    )
