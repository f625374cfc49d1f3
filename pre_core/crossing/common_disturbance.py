"""Detection of a disturbance common to all sensors that is not vertical motion.

Sensors mounted off the vertical by an angle all measure the sine of this angle times the
longitudinal or lateral acceleration. The spring strokes do not contain this disturbance, but the
inertia term of the body does: it appears in both body equations at the same time. Residuals of
friction and dampers are specific to each axle.
"""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.posterior import PosteriorProblem, filtered_rows, points
from pre_core.physics.simulate import rear_position_m

_BAND_HZ = (3.0, 12.0)
"""Band: below it, errors of the truck's parameters move both ends equally; above it there is noise.
"""
_PART_S = 2.0
"""Length of the half-overlapping segments of the mean coherence."""
_FEWEST_PARTS = 3


def coherence(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the real part of the coherence of both body equations' residuals, at the same time.

    The residuals are those of the fit y (f,), as accelerations from 3 to 12 Hz. The result is zero
    for a record that is too short.
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
    # The front equation of a residual is taken when the front axle was at the rear one's place.
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
