"""Eigenvalues and eigenvectors of four small symmetric matrices at once.

A LAPACK call on one 14 x 14 matrix costs more than the time integration it serves. Cyclic Jacobi
rotations (Golub and Van Loan, Matrix Computations, section 8.5) are branch-free, so that four
matrices share the vector registers, and they are quick here because the caller hands over matrices
that are already nearly diagonal.
"""

import numpy as np
from numpy.typing import NDArray

from pre_core.lanes import LANES, fma, kernel, load, mul, store

FloatArray = NDArray[np.float64]

MAX_SWEEPS = 30


@kernel
def diagonalise(a: FloatArray, v: FloatArray) -> bool:
    """Rotate `a` (m, m, 4) to diagonal form, four matrices at once; both are modified in place.

    On return the diagonal of `a` holds the eigenvalues, unsorted, and the columns of `v` (m, m, 4)
    the orthonormal eigenvectors. False if some matrix is not diagonal to rounding after MAX_SWEEPS
    (which happens only where it holds a value that is not finite).
    """
    m = a.shape[0]
    v[:] = 0.0
    for k in range(m):
        for lane in range(LANES):
            v[k, k, lane] = 1.0
    cosine = np.empty((1, LANES))
    sine = np.empty((1, LANES))
    for _ in range(MAX_SWEEPS):
        largest = 0.0  # of a_pq^2/(a_pp a_qq), which also bounds the error of small eigenvalues
        for p in range(m - 1):
            for q in range(p + 1, m):
                for lane in range(LANES):
                    off = a[p, q, lane]
                    ratio = off * off / np.abs(a[p, p, lane] * a[q, q, lane])
                    if not ratio <= largest:
                        largest = ratio
                    difference = 0.5 * (a[q, q, lane] - a[p, p, lane])
                    root = np.sqrt(difference * difference + off * off)
                    divisor = difference + (root if difference >= 0.0 else -root)
                    t = off / divisor if off != 0.0 else 0.0
                    c = 1.0 / np.sqrt(1.0 + t * t)
                    cosine[0, lane] = c
                    sine[0, lane] = t * c
                c4 = load(cosine, 0)
                s4 = load(sine, 0)
                n4 = (-s4[0], -s4[1], -s4[2], -s4[3])
                for k in range(m):
                    kp = load(a[k], p)
                    kq = load(a[k], q)
                    store(a[k], p, fma(c4, kp, mul(n4, kq)))
                    store(a[k], q, fma(s4, kp, mul(c4, kq)))
                row_p = a[p]
                row_q = a[q]
                for k in range(m):
                    pk = load(row_p, k)
                    qk = load(row_q, k)
                    store(row_p, k, fma(c4, pk, mul(n4, qk)))
                    store(row_q, k, fma(s4, pk, mul(c4, qk)))
                for k in range(m):
                    kp = load(v[k], p)
                    kq = load(v[k], q)
                    store(v[k], p, fma(c4, kp, mul(n4, kq)))
                    store(v[k], q, fma(s4, kp, mul(c4, kq)))
        if largest < 1e-28:
            return True
    return False
