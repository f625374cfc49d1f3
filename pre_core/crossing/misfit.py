"""The part of a crossing that the model does not explain: the bridge, or the truck and its road."""

import numpy as np

from pre_core.crossing.fit import Optimum, chi2_stride
from pre_core.crossing.off_bridge import off_bridge_residuals
from pre_core.crossing.posterior import all_rows, layout
from pre_core.crossing.rows import RESIDUALS
from pre_core.physics.bridge import FloatArray
from pre_core.search.levenberg_marquardt import minimise

_STEPS, _GAIN = 12, 10.0
"""Limit of steps, and the gain in the sum of squares that ends the fit, whose chi2 is judged
coarsely."""


def off_bridge_chi2(found: Optimum) -> float | None:
    """Return the mean square of the whitened residuals off the bridge, refitted to these alone.

    Residuals on the bridge are left out, so that neither a second vehicle there nor a wrong bridge
    matters; None without residuals off the bridge.
    """
    problem, y = found.problem, found.state.y
    count = problem.noise.reciprocal.size
    is_off = np.zeros(count // RESIDUALS, dtype=np.bool_)
    for one in off_bridge_residuals(problem, y):
        is_off[one] = True
    if not is_off.any():
        return None
    data = np.flatnonzero(np.repeat(is_off, RESIDUALS))
    free = np.delete(np.eye(y.size), layout(problem).bridge, axis=1)

    def rows(v: FloatArray) -> FloatArray:
        values = all_rows(problem, y + v @ free.T)
        return np.concatenate([values[:, data], values[:, count:]], axis=1)

    there = minimise(rows, np.zeros(free.shape[1]), _STEPS, _GAIN, is_followed=True).state
    white = there.residual[: data.size : chi2_stride(problem)]
    return float(white @ white) / white.size
