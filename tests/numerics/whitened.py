"""Whitened residuals, many at once."""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.rows import RESIDUALS, RowFilter, row_count
from pre_core.crossing.whitening import Whitener, whiten_into


def white_rows(rows: RowFilter, noise: Whitener, residuals: FloatArray) -> FloatArray:
    """Return whitened residuals (…, 3 m) of residuals (…, 3, n): filtered and interleaved.

    Their variance is one.
    """
    *many, _, n = residuals.shape
    flat = np.ascontiguousarray(residuals).reshape(-1, RESIDUALS, n)
    row = np.empty(row_count(rows, n))
    out = np.empty((flat.shape[0], RESIDUALS * row.size))
    for k in range(flat.shape[0]):
        whiten_into(rows, noise, flat[k], row, out[k])
    return out.reshape(*many, RESIDUALS * row.size)
