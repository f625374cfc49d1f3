"""Whether all sensors measure something in common that is no vertical motion of their places.

Sensors mounted off the vertical by an angle measure the sine of it times the acceleration along or
across the road, all alike. The strokes of the springs do not contain it, the inertia of the body
does: both body equations leave it over at the same time. What friction and dampers leave over
belongs to each axle by itself.
"""

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.posterior import Problem, filtered_rows, points
from pre_core.physics.simulate import rear_position_m

FloatArray = NDArray[np.float64]

_BAND_HZ = (3.0, 12.0)
"""Below it, what the truck's values are off by moves both ends alike; above it there is noise."""
_PART_S = 2.0
"""Length of the half-overlapping parts of which the coherence is a mean."""
_FEWEST_PARTS = 3


def coherence(problem: Problem, y: FloatArray) -> float:
    """Return the real part of the coherence of both body equations' residuals, at the same time.

    Of the fit y (size,), from 3 to 12 Hz, each frequency as an acceleration. Zero of a record too
    short for it.
    """
    crossing, rows = problem.crossing, problem.rows
    body = filtered_rows(problem, y)[1:]
    at = points(problem, y[None, :])
    front_m = at.position_m[0]
    rear_m = rear_position_m(front_m, float(at.wheelbase_m[0]), crossing.direction)
    time_s = crossing.step_s * np.arange(front_m.size)
    rear_s = crossing.step_s * (
        crossing.first_row + rows.taps.size // 2 + rows.every * np.arange(body.shape[1])
    )
    # The front equation of a row is taken when the front axle was where the rear one is.
    sign = crossing.direction
    place_m = np.interp(rear_s, time_s, rear_m)
    front_s = np.interp(sign * place_m, sign * front_m, time_s)
    apart_s = rows.every * rows.step_s
    grid = np.arange(max(front_s[0], rear_s[0]), min(front_s[-1], rear_s[-1]), apart_s)
    both = np.stack([np.interp(grid, front_s, body[0]), np.interp(grid, rear_s, body[1])])
    size = round(_PART_S / apart_s)
    starts = range(0, grid.size - size + 1, size // 2)
    if len(starts) < _FEWEST_PARTS:
        return 0.0
    frequency = np.fft.rfftfreq(size, apart_s)
    inside = (frequency >= _BAND_HZ[0]) & (frequency <= _BAND_HZ[1])
    parts = np.stack([both[:, begin : begin + size] for begin in starts])
    parts = (parts - parts.mean(axis=2, keepdims=True)) * np.hanning(size)
    spectrum = np.fft.rfft(parts, axis=2)[:, :, inside] / frequency[inside] ** 2
    front, rear = spectrum[:, 0], spectrum[:, 1]
    power = np.sqrt(np.sum(np.abs(front) ** 2) * np.sum(np.abs(rear) ** 2))
    return float(np.sum(front * rear.conj()).real / power) if power > 0.0 else 0.0
