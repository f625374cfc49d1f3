"""Eigenvalues and eigenvectors of small symmetric matrices, one or four at once.

A LAPACK call for one 14 x 14 matrix costs more than the time integration that it serves. Cyclic
Jacobi rotations (Golub and Van Loan, Matrix Computations, section 8.5) are branch-free, so four
matrices share the vector registers. They are fast here because the matrices are nearly diagonal.
"""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import LANES, Lanes, fma, inner, kernel, load, mul, store

MAX_SWEEPS = 30
"""Bound for matrices with values that are not finite; others need a few sweeps."""
_NEGLIGIBLE = 1e-16
"""Largest a_pq^2/(a_pp a_qq) before the last sweep: convergence is quadratic, so that the remainder
is far below rounding."""


@inner
def _rotation(a: FloatArray, p: int, q: int, cosine: FloatArray, sine: FloatArray) -> float:
    """Compute cosine and sine (4,) that annul a_pq; return a_pq² minus its largest negligible size.

    Of the four lanes the largest difference is returned.
    """
    excess = -1.0
    for lane in range(LANES):
        off = a[p, q, lane]
        app = a[p, p, lane]
        aqq = a[q, q, lane]
        half = 0.5 * (aqq - app)
        root = np.sqrt(half * half + off * off) + 1e-300  # avoid 0/0 where a_pq is zero
        t = off / (half + (root if half >= 0.0 else -root))
        c = 1.0 / np.sqrt(1.0 + t * t)
        cosine[lane] = c
        sine[lane] = t * c
        excess = max(excess, off * off - _NEGLIGIBLE * np.abs(app * aqq))
    return excess


@inner
def _rotate(x: FloatArray, i: int, y: FloatArray, j: int, c: Lanes, s: Lanes, n: Lanes) -> None:
    """Replace rows i of x and j of y by c x - s y and s x + c y; n is -s."""
    xi = load(x, i)
    yj = load(y, j)
    store(x, i, fma(c, xi, mul(n, yj)))
    store(y, j, fma(s, xi, mul(c, yj)))


@kernel
def diagonalise(a: FloatArray, v: FloatArray) -> bool:
    """Rotate `a` (m, m, 4) to diagonal form, four matrices at once; both are modified in place.

    Only the upper triangle of `a` is read and kept. On return its diagonal holds the eigenvalues,
    unsorted, and the *rows* of `v` (m, m, 4) the orthonormal eigenvectors. Return False if a matrix
    does not converge in MAX_SWEEPS, which happens only with values that are not finite.
    """
    m = a.shape[0]
    v[:] = 0.0
    for k in range(m):
        for lane in range(LANES):
            v[k, k, lane] = 1.0
    cosine = np.empty(LANES)
    sine = np.empty(LANES)
    for _ in range(MAX_SWEEPS):
        excess = -1.0
        for p in range(m - 1):
            row_p = a[p]
            for q in range(p + 1, m):
                row_q = a[q]
                excess = max(excess, _rotation(a, p, q, cosine, sine))
                c = (cosine[0], cosine[1], cosine[2], cosine[3])
                s = (sine[0], sine[1], sine[2], sine[3])
                n = (-s[0], -s[1], -s[2], -s[3])
                # The 2 x 2 block itself: a_pp - t a_pq, a_qq + t a_pq, 0.
                for lane in range(LANES):
                    change = sine[lane] / cosine[lane] * row_p[q, lane]
                    row_p[p, lane] -= change
                    row_q[q, lane] += change
                    row_p[q, lane] = 0.0
                for k in range(p):
                    _rotate(a[k], p, a[k], q, c, s, n)
                for k in range(p + 1, q):
                    _rotate(row_p, k, a[k], q, c, s, n)
                for k in range(q + 1, m):
                    _rotate(row_p, k, row_q, k, c, s, n)
                v_p, v_q = v[p], v[q]
                for k in range(m):
                    _rotate(v_p, k, v_q, k, c, s, n)
        if excess <= 0.0:
            return True
    return False


@kernel
def diagonalise_one(a: FloatArray, v: FloatArray) -> bool:
    """Rotate one matrix `a` (m, m) to diagonal form, reading both triangles; `v` is (m, m).

    Results are as those of `diagonalise`. Unlike it, this function skips rotations without effect,
    which are seldom the same for four matrices. It also reverses the order of the matrix: its
    diagonal rises by powers of ten, and such a matrix needs half as many sweeps from its large end.
    """
    _reverse(a)
    v[:] = 0.0
    for k in range(a.shape[0]):
        v[k, k] = 1.0
    is_done = _sweep(a, v)
    _reverse(a)
    _reverse(v)
    return is_done


@inner
def _reverse(x: FloatArray) -> None:
    """Reverse the order of rows and columns in place."""
    flat = x.reshape(x.size)
    last = x.size - 1
    for i in range(x.size // 2):
        flat[i], flat[last - i] = flat[last - i], flat[i]


@inner
def _sweep(a: FloatArray, v: FloatArray) -> bool:
    """Sweep over the upper triangle of `a` (m, m) until it converges; rotate rows of `v` too.

    Indices are unsigned: with signed ones, every access would test for counting from the end.
    """
    one = np.uintp(1)
    m = np.uintp(a.shape[0])
    for _ in range(MAX_SWEEPS):
        has_excess = False
        for p in range(m - one):
            for q in range(p + one, m):
                off, app, aqq = a[p, q], a[p, p], a[q, q]
                size = off * off
                if size <= _NEGLIGIBLE**2 * np.abs(app * aqq):
                    continue
                # Written so that a NaN counts as not converged.
                has_excess = has_excess or not size <= _NEGLIGIBLE * np.abs(app * aqq)
                half = 0.5 * (aqq - app)
                root = np.sqrt(half * half + size)
                t = off / (half + (root if half >= 0.0 else -root))
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = t * c
                for k in range(p):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(p + one, q):
                    x, y = a[p, k], a[k, q]
                    a[p, k], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(q + one, m):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                a[p, p], a[q, q], a[p, q] = app - t * off, aqq + t * off, 0.0
                for k in range(m):
                    x, y = v[p, k], v[q, k]
                    v[p, k], v[q, k] = c * x - s * y, s * x + c * y
        if not has_excess:
            return True
    return False
