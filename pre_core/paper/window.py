"""A crossing, prepared for many evaluations of the paper's residual (`residual`)."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray, IntArray
from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.paper.iep import iep_signals
from pre_core.paper.integrate import IntegratedMotion
from pre_core.physics.beam_basis import BeamBasis, beam_basis
from pre_core.physics.bridge import locate_element
from pre_core.physics.simulate import rear_position_m

LONGEST_STRETCH = 128
"""Steps of a stretch: four vectors' work arrays of one stretch stay in the L1 cache."""
_STENCIL = 2  # samples to either side that the cubic interpolation needs


class MeasuredCrossing(NamedTuple):
    """Signals of one crossing, and the known data of truck, bridge and start.

    There are N samples, `step_s` apart.
    """

    acceleration_m_per_s2: FloatArray  # (4, N)
    step_s: float
    front_position_m: FloatArray  # (N,)
    direction: int
    """1 driving from start to end, else -1."""
    element_lengths_m: FloatArray
    total_mass_kg: float
    wheelbase_m: float
    integrate: Callable[[FloatArray, float], IntegratedMotion]
    initial_state_known: bool
    """Whether the truck was at rest at the first sample, as in the paper.

    Otherwise the effect of unknown initial displacement and velocity (and, unless `bias_known`,
    constant bias) is projected out of the residual.
    """
    bias_known: bool = True
    speed_change_m_per_s2: FloatArray | None = None  # (N,)
    cg_height_m: float = 0.0
    gravity_m_per_s2: float = STANDARD_GRAVITY_M_PER_S2
    parts: int = 1
    """This and `coordinates` refine the beam (see `beam_basis`); defaults: the paper's."""
    coordinates: int | None = None


class PaperWindow(NamedTuple):
    """One crossing, prepared for many evaluations.

    There are n samples, from shortly before the first axle enters until the last has left, and m
    residuals, one for each sample with the rear axle on the bridge.
    """

    step_s: float
    total_mass_kg: float
    wheelbase_m: float
    gravity_m_per_s2: float
    acceleration: FloatArray  # (4, n)
    load_transfer_n: FloatArray  # (n,): taken off the front axle's load, put on the rear's
    signals: FloatArray  # (2, 4, n): see iep.py
    stretches: IntArray  # (s, 4): first sample, last + 1, part under front, under rear (-1 none)
    place: FloatArray  # (2, n): local coordinate 0..1 of the part
    first_row: int  # sample of row 0
    front_sample: IntArray  # (m,): first of the four samples at which the front passed the same x
    front_weight: FloatArray  # (m, 4)
    row_weight: FloatArray  # (m,): square root of dx
    nuisance: FloatArray  # (m, q): orthonormal weighted columns projected out of the residuals
    x_m: FloatArray  # (m,) chainage of the rows
    basis: BeamBasis


class WindowError(ValueError):
    """An error of samples that do not cover the crossing; the message names the missing part."""


def _stretches(element: IntArray) -> IntArray:
    changes = np.flatnonzero(np.any(np.diff(element, axis=1) != 0, axis=0)) + 1
    bounds = np.concatenate([[0], changes, [element.shape[1]]])
    rows = [
        (begin, min(begin + LONGEST_STRETCH, stop), element[0, begin], element[1, begin])
        for start, stop in itertools.pairwise(bounds)
        for begin in range(start, stop, LONGEST_STRETCH)
    ]
    return np.array(rows, dtype=np.int64)


def _cubic_weights(travel: FloatArray, wanted: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return four-point Lagrange weights of a function of the increasing `travel` at `wanted`.

    The variable is the sample number, in which the points are evenly spaced: the number belonging
    to `wanted` is found by cubic interpolation too, so that a changing speed costs no accuracy.
    """
    sample = np.interp(wanted, travel, np.arange(travel.size))
    base = np.clip(np.floor(sample).astype(np.int64) - 1, 0, travel.size - 4)
    fraction = sample - base

    def weights(f: FloatArray) -> FloatArray:
        return np.stack(
            [
                -(f - 1.0) * (f - 2.0) * (f - 3.0) / 6.0,
                f * (f - 2.0) * (f - 3.0) / 2.0,
                -f * (f - 1.0) * (f - 3.0) / 2.0,
                f * (f - 1.0) * (f - 2.0) / 6.0,
            ],
            axis=1,
        )

    points = travel[base[:, None] + np.arange(4)]
    for _ in range(3):  # secant steps: travel is almost linear in the sample number
        error = wanted - np.einsum("mj,mj->m", weights(fraction), points)
        fraction = fraction + error / (points[:, 2] - points[:, 1])
    return base, weights(fraction)


def build_window(crossing: MeasuredCrossing) -> PaperWindow:
    """Prepare one crossing; raise WindowError if the samples do not reach from entry to exit."""
    span = float(crossing.element_lengths_m.sum())
    front = np.asarray(crossing.front_position_m, dtype=np.float64)
    rear = rear_position_m(front, crossing.wheelbase_m, crossing.direction)
    travel_front = front if crossing.direction > 0 else span - front
    travel_rear = travel_front - crossing.wheelbase_m
    part = _crossing_samples(travel_front, travel_rear, span)
    basis = beam_basis(crossing.element_lengths_m, crossing.parts, crossing.coordinates)
    element, place = locate_element(basis.lengths_m, np.stack([front[part], rear[part]]))
    first_row = int(np.argmax(travel_rear >= 0.0)) - part.start
    rows = slice(first_row + part.start, part.stop - 1)
    base, weight = _cubic_weights(travel_front[part], travel_rear[rows])
    if np.any(base + 3 >= np.arange(rows.start, rows.stop) - part.start):
        raise WindowError("the samples are too far apart for this wheelbase and speed")
    row_weight = np.sqrt(np.gradient(travel_rear)[rows])
    columns: list[FloatArray] = []
    if not crossing.initial_state_known:
        t = crossing.step_s * np.arange(part.stop - part.start, dtype=np.float64)
        t_front = np.einsum("mj,mj->m", weight, t[base[:, None] + np.arange(4)])
        columns = _drift_columns(t_front, t[first_row:-1], bias_known=crossing.bias_known)
    return PaperWindow(
        crossing.step_s,
        crossing.total_mass_kg,
        crossing.wheelbase_m,
        crossing.gravity_m_per_s2,
        np.ascontiguousarray(crossing.acceleration_m_per_s2[:, part]),
        _load_transfer_n(crossing, part),
        np.ascontiguousarray(_signals(crossing, part)),
        _stretches(element),
        np.ascontiguousarray(place),
        first_row,
        base,
        weight,
        row_weight,
        _orthonormal(columns, row_weight),
        np.ascontiguousarray(rear[rows]),
        basis,
    )


def _crossing_samples(travel_front: FloatArray, travel_rear: FloatArray, span_m: float) -> slice:
    """Return the samples of the first crossing; the motion before and after it is arbitrary."""
    entry = int(np.argmax(travel_front >= 0.0))
    leave = int(np.argmax(travel_rear > span_m))
    if entry < _STENCIL:
        raise WindowError("the samples begin after the front axle has entered the bridge")
    if travel_rear[leave] <= span_m:
        raise WindowError("the samples end before the rear axle has left the bridge")
    part = slice(entry - _STENCIL, leave + 1)
    if np.any(np.diff(travel_front[part]) <= 0.0):
        raise WindowError("the truck stops or turns round during the crossing")
    return part


def _signals(crossing: MeasuredCrossing, part: slice) -> FloatArray:
    """Return the signals of a part, integrated from the start where its state is known."""
    acceleration = crossing.acceleration_m_per_s2
    if crossing.initial_state_known:
        return iep_signals(acceleration, crossing.step_s, crossing.integrate)[:, :, part]
    return iep_signals(acceleration[:, part], crossing.step_s, crossing.integrate)


def _load_transfer_n(crossing: MeasuredCrossing, part: slice) -> FloatArray:
    if crossing.speed_change_m_per_s2 is None:
        return np.zeros(part.stop - part.start)
    mass_height = crossing.total_mass_kg * crossing.cg_height_m
    return mass_height / crossing.wheelbase_m * crossing.speed_change_m_per_s2[part]


def _drift_columns(
    t_front: FloatArray, t_rear: FloatArray, *, bias_known: bool
) -> list[FloatArray]:
    """Return the effects of an unknown initial state on the residual, at both axles' times."""
    columns = [np.ones_like(t_rear), t_front, t_rear]
    return columns if bias_known else [*columns, t_front**2, t_rear**2]


def _orthonormal(columns: list[FloatArray], row_weight: FloatArray) -> FloatArray:
    if not columns:
        return np.zeros((row_weight.size, 0))
    matrix = np.stack(columns, axis=1) * row_weight[:, None]
    matrix /= np.linalg.norm(matrix, axis=0)
    u, s, _ = np.linalg.svd(matrix, full_matrices=False)
    # At constant speed the columns are dependent to rounding; below 1e-9 a direction is noise.
    return np.ascontiguousarray(u[:, s > 1e-9 * s[0]])
