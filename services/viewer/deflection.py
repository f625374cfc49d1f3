"""Deflection of the bridge under the truck, by the estimate, for each position of the truck.

It is static: the weight of each axle on the estimated beam. The method includes vibrations of the
suspension and of the bridge; this picture does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.physics.bridge import Beam, interpolation_matrix, refine, stiffness_matrix
from services.viewer.crossing_view import CrossingView, FloatArray

_NEEDED = ("d_1", "m_s", "m_s1", "m_s2", "m_u1", "m_u2")
_PARTS = 6
"""Number of straight lines per element."""
_FRAMES = 160
_BESIDE_S = 1.0
"""Time in s shown before and after the stay, as for the accelerations."""


class DeflectionFrames(NamedTuple):
    """The deflected bridge at f positions of the truck, drawn with k + 1 points."""

    front_m: FloatArray  # (f,) chainage of the front axle
    rear_m: FloatArray  # (f,)
    x_m: FloatArray  # (k + 1,) along the bridge
    deflection_m: FloatArray  # (f, k + 1), up positive
    under_axles_m: FloatArray  # (f, 2), zero off the bridge
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
    beside = _BESIDE_S * crossing.speed_m_per_s
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
