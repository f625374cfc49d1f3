"""Quantisation step of the analogue-to-digital converter that recorded a signal."""

import numpy as np

from pre_core.arrays import FloatArray

_OFF_GRID = 0.01
"""Tolerance of a grid, relative to its step."""
_ROUNDING = 1e-9
"""Floating-point tolerance, relative to the largest value."""


def converter_step(values: FloatArray) -> float:
    """Return the step between the values of a signal (n,) if all lie on a grid, else zero."""
    distinct = np.unique(values)
    apart = np.diff(distinct)
    apart = apart[apart > _ROUNDING * np.abs(values).max(initial=0.0)]
    if apart.size < 2:
        return 0.0
    step = float(apart.min())
    off_grid = np.abs(apart / step - np.round(apart / step))
    return step if float(off_grid.max()) < _OFF_GRID else 0.0
