"""Dynamic response simulation (DRS): the bridge's deflection under wheels whose forces are known.

For one time step Newmark's average acceleration on a mode of unit mass, q'' + c q' + lambda q = p,
is the bilinear transform of its transfer function,

    b_0 q[n] + b_1 q[n-1] + b_2 q[n-2] = p[n] + 2 p[n-1] + p[n-2],
    b_0 = a^2 + a c + lambda,  b_1 = 2 (lambda - a^2),  b_2 = a^2 - a c + lambda,  a = 2/step,

so that a mode costs a handful of multiplications a step. The recursion here is the direct form II,
w[n] = p[n] - (b_1 w[n-1] + b_2 w[n-2])/b_0, q[n] = (w[n] + 2 w[n-1] + w[n-2])/b_0, with 1/b_0 split
evenly into the mode shapes. It starts from rest before the first wheel arrives.

What is marched is w and its change d[n] = w[n] - w[n-1],

    d[n] = p[n] + (a^2 - a c - 3 lambda)/b_0 d[n-1] - 4 lambda/b_0 w[n-2].

In the form above the factors of a slow mode are all but 2 and -1, and what is rounded off them and
off their sum comes back (a^2/lambda) times: hundreds of roundings, other ones on every processor,
which slopes by differences then divide by their step. It is w[n-2] here and not w[n-1], so that a
step need not wait for the sum before it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from pre_core.kernels.jacobi import diagonalise, diagonalise_one
from pre_core.kernels.lanes import LANES, add, fma, fma_scalar, kernel, load, mul, store, sub
from pre_core.physics.bridge import (
    element_cubics,
    held_nodes,
    mass_matrix,
    uniform_beam,
    unit_stiffness_matrices,
)
from pre_core.unknowns import ALPHA, BETA, EI_1, K_ROT, RHO_A, F

FloatArray = NDArray[np.float64]


RIGID_M_PER_N = 2e-12
"""Compliance that every bearing has besides its own, a hundredth of a micrometre under a heavy
axle: a spring of no compliance at all would be infinitely stiff."""


class BeamBasis(NamedTuple):
    """What every evaluation shares: the beam in coordinates in which the sound one is diagonal.

    `stiffness` (n + 2 or n + 4, m, m): dK/ds of the n elements' EI, of the rotational and, where
    bearings may give, of the vertical springs at the ends, in coordinates that make the mass matrix
    of 1 kg/m the identity. `cubics` (n parts, 4, m): deflection in each part of an element for each
    coordinate. `lengths_m` (n parts,).
    """

    stiffness: FloatArray
    cubics: FloatArray
    lengths_m: FloatArray


def beam_basis(
    element_lengths_m: FloatArray,
    parts: int = 1,
    coordinates: int | None = None,
    *,
    interior_supports: tuple[int, ...] = (),
    bearings_give: bool = False,
) -> BeamBasis:
    """Coordinates: the lowest modes of the uniform beam whose elements are cut into `parts`.

    All of them by default, which is the finite-element model itself. Fewer are quicker but poor for
    a beam that is not uniform or has springs at its supports, whose kinked curvature smooth modes
    do not span: f_1 of the paper's scenario 6 is 1 % off with 14 of 28. `interior_supports` are
    nodes between elements. With `bearings_give` the ends have a vertical spring each.
    """
    n = element_lengths_m.size
    lengths = np.repeat(element_lengths_m / parts, parts)
    give = (1.0, 1.0) if bearings_give else (0.0, 0.0)
    unit = uniform_beam(1.0, np.ones(n * parts), 1.0, 0.0, 0.0)._replace(
        element_lengths_m=lengths,
        support_compliance_m_per_n=give,
        interior_supports=tuple(node * parts for node in interior_supports),
    )
    held = held_nodes(unit)
    fine = unit_stiffness_matrices(lengths, held)
    count = fine.shape[1] if coordinates is None else min(coordinates, fine.shape[1])
    units = np.concatenate(
        [fine[: n * parts].reshape(n, parts, *fine.shape[1:]).sum(axis=1), fine[n * parts :]]
    )[: n + 4 if bearings_give else n + 2]
    # The springs, as stiff as an element of this length, only keep the beam from floating away.
    reference = units[:n].sum(axis=0) + units[n + 2 :].sum(axis=0) * 12.0 / lengths[0] ** 3
    _, shapes = eigh(reference, mass_matrix(unit), subset_by_index=(0, count - 1))
    return BeamBasis(
        np.ascontiguousarray(shapes.T @ units @ shapes),
        np.ascontiguousarray(element_cubics(lengths, held, shapes)),
        lengths,
    )


def rebased(basis: BeamBasis, theta: FloatArray) -> BeamBasis:
    """The same beam in coordinates in which the bridge `theta` (p,) is diagonal.

    Bridges near it are then nearly diagonal, which makes their modes quick to find. All modes rise
    from the start: an eigenvector's sign is chance, and how a mode swings is told with it.
    """
    factors = stiffness_factors(theta, basis.stiffness.shape[0])
    _, shapes = eigh(np.tensordot(factors, basis.stiffness, axes=1))
    slopes = basis.cubics[0, 1] @ shapes
    shapes = np.where(slopes < 0.0, -shapes, shapes)
    return BeamBasis(
        np.ascontiguousarray(shapes.T @ basis.stiffness @ shapes),
        np.ascontiguousarray(basis.cubics @ shapes),
        basis.lengths_m,
    )


def first_frequencies_hz(basis: BeamBasis, theta: FloatArray) -> FloatArray:
    """First natural frequency (k,) in Hz, undamped, of the bridges `theta` (k, p)."""
    factors = stiffness_factors(theta, basis.stiffness.shape[0])
    stiffness = np.tensordot(factors, basis.stiffness, axes=1)
    lowest = np.linalg.eigvalsh(stiffness)[:, 0]
    return np.asarray(np.sqrt(lowest / theta[:, RHO_A]) / (2.0 * np.pi))


def stiffness_factors(theta: FloatArray, count: int) -> FloatArray:
    """What multiplies the `count` matrices of `BeamBasis.stiffness`: (…, count) for (…, p)."""
    vertical = 1.0 / (theta[..., F : F + 2] + RIGID_M_PER_N)
    factors = [theta[..., EI_1:], theta[..., K_ROT : K_ROT + 2], vertical]
    return np.concatenate(factors, axis=-1)[..., :count]


@kernel
def stiffness_factor(theta: FloatArray, i: int) -> float:
    """The same for one vector (p,) and matrix i, in kernels."""
    spring = i - (theta.size - EI_1)
    if spring < 0:
        return theta[EI_1 + i]
    if spring < 2:
        return theta[K_ROT + spring]
    return 1.0 / (theta[F + spring - 2] + RIGID_M_PER_N)


@kernel
def modal_damping(theta: FloatArray, eigenvalue: float) -> float:
    """Rayleigh damping of a mode of unit mass: alpha + beta omega^2."""
    return theta[ALPHA] + theta[BETA] * eigenvalue


@kernel
def modal_filters(
    basis_stiffness: FloatArray,
    basis_cubics: FloatArray,
    theta: FloatArray,
    step_s: float,
    matrix: FloatArray,
    vectors: FloatArray,
    cubics: FloatArray,
    feedback: FloatArray,
) -> bool:
    """Modes of four bridges as the coefficients of their recursions; False if not finite.

    `theta` is (4, p). Written: `cubics` (parts, m, 4, 4) [part, mode, power, particle], scaled
    by 1/sqrt(b_0), and `feedback` (m, 2, 4): what multiplies w[n-2] and d[n-1].
    """
    factors, m = basis_stiffness.shape[0], basis_stiffness.shape[1]
    by_lane = np.empty((factors, LANES))
    for e in range(factors):
        for lane in range(LANES):
            by_lane[e, lane] = stiffness_factor(theta[lane], e)
    for i in range(m):
        for j in range(i, m):  # the upper triangle is all that is read
            total = (0.0, 0.0, 0.0, 0.0)
            for e in range(factors):
                total = fma_scalar(load(by_lane, e), basis_stiffness[e, i, j], total)
            store(matrix[i], j, total)
    if not diagonalise(matrix, vectors):
        return False
    a = 2.0 / step_s
    for k in range(m):
        for lane in range(LANES):
            eigenvalue = matrix[k, k, lane] / theta[lane, RHO_A]
            damping = modal_damping(theta[lane], eigenvalue)
            b_0 = a * a + a * damping + eigenvalue
            feedback[k, 0, lane] = -4.0 * eigenvalue / b_0
            feedback[k, 1, lane] = (a * a - a * damping - 3.0 * eigenvalue) / b_0
            matrix[k, k, lane] = 1.0 / np.sqrt(theta[lane, RHO_A] * b_0)
    for e in range(basis_cubics.shape[0]):
        for k in range(m):
            size = load(matrix[k], k)
            for power in range(4):
                total = (0.0, 0.0, 0.0, 0.0)
                for i in range(m):
                    total = fma_scalar(load(vectors[k], i), basis_cubics[e, power, i], total)
                store(cubics[e, k], power, mul(total, size))
    return True


@kernel
def diagonalise_bridge(
    basis_stiffness: FloatArray, theta: FloatArray, matrix: FloatArray, vectors: FloatArray
) -> bool:
    """Eigenvalues times rho A on the diagonal of `matrix`, mode shapes in the rows of `vectors`.

    Both are (m, m), of one bridge `theta` (p,). False if not finite.
    """
    factors, m = basis_stiffness.shape[0], basis_stiffness.shape[1]
    matrix[:] = 0.0
    for e in range(factors):
        factor = stiffness_factor(theta, e)
        if factor != 0.0:
            for i in range(m):
                to, unit = matrix[i], basis_stiffness[e, i]
                for j in range(m):
                    to[j] += factor * unit[j]
    return diagonalise_one(matrix, vectors)


@kernel
def shape_cubics(
    basis_cubics: FloatArray, vectors: FloatArray, size: FloatArray, out: FloatArray
) -> None:
    """Cubics of all modes in every part into out (parts, g, 4, 4) [part, group, power, mode].

    `vectors` (m, m) has the modes in its rows, each of which is multiplied by its `size` (m,).
    """
    m = np.uintp(size.size)
    turned = np.empty((size.size, size.size))
    for k in range(m):
        for i in range(m):
            turned[i, k] = size[k] * vectors[k, i]
    row = np.empty(size.size)
    for e in range(basis_cubics.shape[0]):
        for power in range(4):
            # Mode beside mode, so that they share the vector registers.
            row[:] = 0.0
            for i in range(m):
                one = basis_cubics[e, power, i]
                for k in range(m):
                    row[k] += one * turned[i, k]
            for k in range(size.size):
                out[e, k // LANES, power, k % LANES] = row[k]


@kernel
def modal_filters_one(
    basis_stiffness: FloatArray,
    basis_cubics: FloatArray,
    theta: FloatArray,
    step_s: float,
    matrix: FloatArray,
    vectors: FloatArray,
    cubics: FloatArray,
    feedback: FloatArray,
) -> bool:
    """The same for one bridge `theta` (p,), its modes in the lanes: g groups of four.

    `matrix` and `vectors` are (m, m). Written: `cubics` (parts, g, 4, 4) [part, group, power, mode]
    and `feedback` (g, 2, 4); lanes beyond the last mode stay zero.
    """
    if not diagonalise_bridge(basis_stiffness, theta, matrix, vectors):
        return False
    a = 2.0 / step_s
    cubics[:] = 0.0
    feedback[:] = 0.0
    size = np.empty(basis_stiffness.shape[1])
    for k in range(size.size):
        group, lane = k // LANES, k % LANES
        eigenvalue = matrix[k, k] / theta[RHO_A]
        damping = modal_damping(theta, eigenvalue)
        b_0 = a * a + a * damping + eigenvalue
        feedback[group, 0, lane] = -4.0 * eigenvalue / b_0
        feedback[group, 1, lane] = (a * a - a * damping - 3.0 * eigenvalue) / b_0
        size[k] = 1.0 / np.sqrt(theta[RHO_A] * b_0)
    shape_cubics(basis_cubics, vectors, size, cubics)
    return True


@kernel
def _one_mode_two_wheels(
    front: FloatArray,
    rear: FloatArray,
    feedback: FloatArray,
    state: FloatArray,
    front_place: FloatArray,
    rear_place: FloatArray,
    force: FloatArray,
    deflection_front: FloatArray,
    deflection_rear: FloatArray,
) -> None:
    a0, a1, a2, a3 = load(front, 0), load(front, 1), load(front, 2), load(front, 3)
    b0, b1, b2, b3 = load(rear, 0), load(rear, 1), load(rear, 2), load(rear, 3)
    f1, f2 = load(feedback, 0), load(feedback, 1)
    w1, d = load(state, 0), load(state, 1)
    w2 = sub(w1, d)
    before = add(w1, w2)
    force_front, force_rear = force[0], force[1]
    for n in range(front_place.size):
        x = front_place[n]
        z = rear_place[n]
        a = fma_scalar(fma_scalar(fma_scalar(a3, x, a2), x, a1), x, a0)
        b = fma_scalar(fma_scalar(fma_scalar(b3, z, b2), z, b1), z, b0)
        p = fma(a, load(force_front, n), mul(b, load(force_rear, n)))
        d = fma(f2, d, fma(f1, w2, p))
        w = add(w1, d)
        after = add(w, w1)
        q = add(after, before)
        before = after
        w2 = w1
        w1 = w
        store(deflection_front, n, fma(a, q, load(deflection_front, n)))
        store(deflection_rear, n, fma(b, q, load(deflection_rear, n)))
    store(state, 0, w1)
    store(state, 1, d)


@kernel
def _one_mode_one_wheel(
    cubic: FloatArray,
    feedback: FloatArray,
    state: FloatArray,
    wheel_place: FloatArray,
    force: FloatArray,
    deflection: FloatArray,
) -> None:
    a0, a1, a2, a3 = load(cubic, 0), load(cubic, 1), load(cubic, 2), load(cubic, 3)
    f1, f2 = load(feedback, 0), load(feedback, 1)
    w1, d = load(state, 0), load(state, 1)
    w2 = sub(w1, d)
    before = add(w1, w2)
    for n in range(wheel_place.size):
        x = wheel_place[n]
        a = fma_scalar(fma_scalar(fma_scalar(a3, x, a2), x, a1), x, a0)
        d = fma(f2, d, fma(f1, w2, mul(a, load(force, n))))
        w = add(w1, d)
        after = add(w, w1)
        q = add(after, before)
        before = after
        w2 = w1
        w1 = w
        store(deflection, n, fma(a, q, load(deflection, n)))
    store(state, 0, w1)
    store(state, 1, d)


@kernel
def advance(
    front_cubics: FloatArray,
    rear_cubics: FloatArray,
    front_on: bool,
    rear_on: bool,
    feedback: FloatArray,
    state: FloatArray,
    front_place: FloatArray,
    rear_place: FloatArray,
    force: FloatArray,
    deflection_front: FloatArray,
    deflection_rear: FloatArray,
) -> None:
    """March all modes over a stretch in which each wheel stays in one element (or off the bridge).

    Cubics are (m, 4, 4) of the element under each wheel, `feedback` and `state` (m, 2, 4), places
    (steps,), `force` (2, steps, 4), deflections (steps, 4). `state` is updated and the deflections
    are *added* to. What the fourth axis is (particles, or groups of modes) does not matter here.
    """
    for k in range(feedback.shape[0]):
        if front_on and rear_on:
            _one_mode_two_wheels(
                front_cubics[k],
                rear_cubics[k],
                feedback[k],
                state[k],
                front_place,
                rear_place,
                force,
                deflection_front,
                deflection_rear,
            )
        elif front_on:
            _one_mode_one_wheel(
                front_cubics[k], feedback[k], state[k], front_place, force[0], deflection_front
            )
        elif rear_on:
            _one_mode_one_wheel(
                rear_cubics[k], feedback[k], state[k], rear_place, force[1], deflection_rear
            )
