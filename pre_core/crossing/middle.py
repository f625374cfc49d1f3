"""Reduction of sensors anywhere on a truck to the four middle readings of the method.

Body and axles are rigid. A sensor on the body, a distance o behind the front axle and e to the left
of the middle, reads (1 - o/D) z_1 + o/D z_2 + e phi of the accelerations z_1 and z_2 above the
axles, D apart, and of the roll phi; a sensor on an axle reads z_u + e phi_u. The coordinates of
each part follow by least squares, weighted by the sensors' noise. z_1, z_2 and both z_u are the
middle readings. The method neglects the correlation that the noise of z_1 and z_2 has if sensors
are far from the axles.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray

BODY = 0
_ROUNDING = 1e-9


class SensorPlaces(NamedTuple):
    """Places of m sensors, all arrays (m,)."""

    axle: NDArray[np.int64]
    """Number of the axle from 1; `BODY` for a sensor on the body."""
    behind_m: FloatArray
    """Distance behind the front axle, for sensors on the body."""
    lateral_m: FloatArray
    """Distance to the left of the middle."""


class Reduction(NamedTuple):
    """Weights from m sensors to four middle readings: body front and rear, axle front and rear."""

    weights: FloatArray
    """Weights (4, m); NaN for a reading that the sensors do not determine."""
    density: FloatArray
    """Noise density (4,) of the readings, in the unit of the sensors' densities."""
    parities: tuple[FloatArray, ...]
    """Combinations (r, m) that cancel the motion of a part with redundant sensors, with noise
    density 1 unless the sensors' densities are zero."""


def centre_reduction(
    places: SensorPlaces, density: FloatArray, wheelbase_m: float, in_the_middle_m: float
) -> Reduction:
    """Return the reduction of sensors at `places` with one-sided noise `density` (m,).

    Sensors less than `in_the_middle_m` to the side are in the middle. A part with sensors on
    one side only, or whose geometry does not determine a reading, has NaN there.
    """
    count = places.axle.size
    weights = np.full((4, count), np.nan)
    parities = []
    # Sensors without noise, as in simulations, have equal weights.
    scale = float(density.max()) or 1.0
    noise = np.maximum(density / scale, 1e-3) if density.any() else np.ones(count)
    for part, rows in ((BODY, (0, 1)), (1, (2,)), (2, (3,))):
        own = np.flatnonzero(places.axle == part)
        if own.size == 0:
            continue
        lateral = places.lateral_m[own]
        if part == BODY:
            share = places.behind_m[own] / wheelbase_m
            columns = [1.0 - share, share]
        else:
            columns = [np.ones(own.size)]
        if np.abs(lateral).max() > in_the_middle_m:
            columns.append(lateral)
        geometry = np.stack(columns, axis=1) / noise[own, None]
        u, values, vt = np.linalg.svd(geometry)
        rank = int(np.count_nonzero(values > 1e-6 * values[0]))
        is_one_sided = lateral.min() > in_the_middle_m or lateral.max() < -in_the_middle_m
        inverse = vt[:rank].T @ (u[:, :rank] / values[:rank]).T / noise[own]
        seen = vt[:rank].T @ vt[:rank]
        for column, row in enumerate(rows):
            wanted = np.eye(len(columns))[column]
            if not is_one_sided and np.abs(seen @ wanted - wanted).max() < 1e-6:
                weights[row] = 0.0
                weights[row, own] = _exact(inverse[column])
        if own.size > rank:
            parity = np.zeros((own.size - rank, count))
            parity[:, own] = u[:, rank:].T / (noise[own] * scale)
            parities.append(parity)
    return Reduction(weights, np.sqrt((weights**2) @ density**2), tuple(parities))


def _exact(weights: FloatArray) -> FloatArray:
    """Return weights (m,) in which values within rounding of 0 and 1 are exact."""
    near = np.rint(weights)
    return np.where(np.abs(weights - near) < _ROUNDING, near, weights)


def centre_readings(reduced: Reduction, acceleration: FloatArray) -> FloatArray:
    """Return the middle readings (4, n) of accelerations (m, n) on one grid.

    A reading of a single sensor equals that sensor's bit for bit.
    """
    found = np.empty((4, acceleration.shape[1]))
    for row, weights in enumerate(reduced.weights):
        used = np.flatnonzero(weights)
        if used.size == 1 and weights[used[0]] == 1.0:
            found[row] = acceleration[used[0]]
        else:
            found[row] = weights[used] @ acceleration[used]
    return found
