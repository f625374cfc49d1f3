"""Deflection of the bridge under the truck, by the estimate, for each position of the truck.

It is static: the weight of each axle on the estimated beam. The method includes vibrations of the
suspension and of the bridge; this picture does not.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.physics.bridge import Beam, interpolation_matrix, refine, stiffness_matrix
from services.common.arrays import Floats
from services.viewer.crossing_scene import CrossingScene, Panel
from services.viewer.crossing_view import BESIDE_S, CrossingView
from services.viewer.rerun_parts import (
    MUTED,
    RerunStream,
    columns_of,
    flat_view,
    log_labels,
    log_strips,
    ratio_colours,
    rgb,
)

_NEEDED = ("d_1", "m_s", "m_s1", "m_s2", "m_u1", "m_u2")
_PARTS = 6
"""Number of straight lines per element."""
_FRAMES = 160
_BENT_SHARE = 0.06
"""Height of the largest deflection in the drawing, as a share of the span."""


class DeflectionFrames(NamedTuple):
    """The deflected bridge at f positions of the truck, drawn with k + 1 points."""

    front_m: Floats  # (f,) chainage of the front axle
    rear_m: Floats  # (f,)
    x_m: Floats  # (k + 1,) along the bridge
    deflection_m: Floats  # (f, k + 1), up positive
    under_axles_m: Floats  # (f, 2), zero off the bridge
    element: NDArray[np.int64]  # (k,) number of the element, from 0, that each piece belongs to

    @property
    def largest_m(self) -> float:
        """Largest deflection, downwards and positive, m."""
        return float(-self.deflection_m.min())


def deflection_frames(crossing: CrossingView) -> DeflectionFrames | None:
    """Return the deflection during the crossing; None where a required value is missing.

    The wheelbase follows from the shares of the body's mass: m_s2/m_s = d_1/D.
    """
    value = {row.name: row.mean for row in crossing.parameters}
    if crossing.rigidity_nm2 is None or not all(value.get(name, 0.0) > 0.0 for name in _NEEDED):
        return None
    beam = _beam(crossing, value)
    if beam is None:
        return None
    wheelbase = value["d_1"] * value["m_s"] / value["m_s2"]
    loads = -STANDARD_GRAVITY_M_PER_S2 * np.array(
        [value["m_s1"] + value["m_u1"], value["m_s2"] + value["m_u2"]]
    )
    span, sign = crossing.span_m, 1.0 if crossing.forward else -1.0
    beside = BESIDE_S * crossing.speed_m_per_s
    way = np.linspace(-beside, span + wheelbase + beside, _FRAMES)
    front = way if crossing.forward else span - way
    rear = front - sign * wheelbase
    fine = refine(beam, _PARTS)
    # Rounding must not push the last point off the bridge, where the deflection is zero.
    end = float(np.cumsum(beam.element_lengths_m)[-1])
    x = np.minimum(np.concatenate(([0.0], np.cumsum(fine.element_lengths_m))), end)
    x[-1] = end
    under = [interpolation_matrix(beam, axle) for axle in (front, rear)]  # (f, d) each
    force = loads[0] * under[0] + loads[1] * under[1]
    nodal = np.linalg.solve(stiffness_matrix(beam), force.T)  # (d, f): all positions at once
    bent = (interpolation_matrix(beam, x) @ nodal).T
    below = np.column_stack([np.einsum("fd,df->f", one, nodal) for one in under])
    element = np.repeat(np.arange(crossing.nominal_nm2.size), _PARTS)
    return DeflectionFrames(front, rear, x, bent, below, element)


def _beam(crossing: CrossingView, value: dict[str, float]) -> Beam | None:
    assert crossing.rigidity_nm2 is not None  # noqa: S101 - checked before
    edges = crossing.element_edges_m
    nodes = []
    for support in crossing.interior_supports_m:
        (at,) = np.nonzero(np.isclose(edges, support, atol=1e-6))
        if at.size != 1:
            return None
        nodes.append(int(at[0]))
    count = edges.size - 1
    return Beam(
        np.diff(edges),
        crossing.rigidity_nm2,
        np.full(count, value.get("rhoA", 1.0)),  # a static load does not need it
        0.0,
        0.0,
        (value.get("k_rot_start", 0.0), value.get("k_rot_end", 0.0)),
        (value.get("f_start", 0.0), value.get("f_end", 0.0)),
        tuple(nodes),
    )


def _layout(scene: CrossingScene, _: DeflectionFrames) -> rrb.View:
    doubt, span = "DOUBTFUL: " if scene.crossing.is_doubtful else "", scene.crossing.span_m
    return flat_view(
        f"{scene.root}/passage",
        f"{doubt}The bridge under the truck",
        (-0.15 * span, 1.15 * span),
        (-0.25 * span, 0.15 * span),
    )


def _log(recording: RerunStream, scene: CrossingScene, passage: DeflectionFrames) -> None:
    """Draw the truck on the deflected bridge, a picture for each position of the front axle."""
    crossing, entity = scene.crossing, f"{scene.root}/passage"
    span = crossing.span_m
    enlarged = _BENT_SHARE * span / max(passage.largest_m, 1e-9)
    chainage = passage.front_m
    travelled = chainage if crossing.forward else span - chainage
    time_s = crossing.entry_time_s + travelled / crossing.speed_m_per_s
    columns = columns_of(np.rint(time_s * 1e9).astype(np.int64), chainage)
    _log_scene(recording, entity, crossing, passage, enlarged)
    count = crossing.nominal_nm2.size
    colours = ratio_colours(crossing.resolved_ratio, count, doubtful=crossing.is_doubtful)
    ends = [int(np.flatnonzero(passage.element == n)[0]) for n in range(count)]
    ends.append(passage.x_m.size - 1)
    for n, colour in enumerate(colours):
        piece = slice(ends[n], ends[n + 1] + 1)
        x = passage.x_m[piece]
        strips = [[np.column_stack((x, -enlarged * bent[piece]))] for bent in passage.deflection_m]
        element = f"{entity}/bridge/EI_{n + 1}"
        style = rr.LineStrips2D.from_fields(colors=[colour], radii=rr.Radius.ui_points(3.0))
        recording.log(element, style, static=True)
        recording.send_columns(
            element, columns, rr.LineStrips2D.columns(strips=[s[0] for s in strips])
        )
    wheel = 0.012 * span
    axles = np.column_stack((passage.front_m, passage.rear_m))
    hubs = np.stack((axles, -enlarged * passage.under_axles_m - wheel), axis=2)  # (f, 2, 2)
    recording.log(
        f"{entity}/wheels",
        rr.Points2D.from_fields(colors=[rgb("#E8EAED")], radii=wheel),
        static=True,
    )
    recording.send_columns(
        f"{entity}/wheels",
        columns,
        rr.Points2D.columns(positions=hubs.reshape(-1, 2)).partition(np.full(len(hubs), 2)),
    )
    body = [_body(front, rear, wheel) for front, rear in hubs]
    recording.log(
        f"{entity}/truck",
        rr.LineStrips2D.from_fields(colors=[rgb("#E8EAED")], radii=rr.Radius.ui_points(1.5)),
        static=True,
    )
    recording.send_columns(f"{entity}/truck", columns, rr.LineStrips2D.columns(strips=body))


def _body(front: Floats, rear: Floats, wheel: float) -> Floats:
    """Return the outline of a two-axle truck, closed, with the cab over the front axle."""
    along = front - rear
    up = np.array([0.0, -wheel])

    def at(share: float, high: float) -> Floats:
        return np.asarray(rear + share * along + high * up)

    outline = (-0.25, 1.5), (-0.25, 4.0), (0.72, 4.0), (0.72, 5.5), (1.1, 5.5), (1.2, 3.5)
    return np.array([at(*corner) for corner in (*outline, (1.2, 1.5), outline[0])])


def _log_scene(
    recording: RerunStream,
    entity: str,
    crossing: CrossingView,
    passage: DeflectionFrames,
    enlarged: float,
) -> None:
    """Draw the static parts: undeflected line, road on both sides, bearings, scale."""
    span = crossing.span_m
    supports = (0.0, *crossing.interior_supports_m, span)
    side = 0.025 * span
    still = [
        [(-0.1 * span, 0.0), (0.0, 0.0)],
        [(span, 0.0), (1.1 * span, 0.0)],
        *([(x, 0.0), (x - side, 2 * side), (x + side, 2 * side), (x, 0.0)] for x in supports),
    ]
    log_strips(recording, f"{entity}/still", still, [rgb(MUTED)], 1.0)
    log_strips(recording, f"{entity}/unbent", [[(0.0, 0.0), (span, 0.0)]], [rgb("#4a525a")], 0.5)
    text = f"at most {1e3 * passage.largest_m:.2g} mm, drawn {enlarged:.0f} times larger"
    log_labels(recording, f"{entity}/scale", [text], np.array([span / 2]), np.array([0.085 * span]))


PANEL: Final = Panel(lambda scene: deflection_frames(scene.crossing), _layout, _log)
