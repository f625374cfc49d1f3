"""Dynamic response simulation (DRS): deflection of the bridge under wheels of known forces.

For one time step Newmark's average acceleration on a mode of unit mass, q'' + c q' + lambda q = p,
is the bilinear transform of its transfer function,

    b_0 q[n] + b_1 q[n-1] + b_2 q[n-2] = p[n] + 2 p[n-1] + p[n-2],
    b_0 = a^2 + a c + lambda,  b_1 = 2 (lambda - a^2),  b_2 = a^2 - a c + lambda,  a = 2/step,

so a mode costs a few multiplications per step. The recursion here is the direct form II, w[n] =
p[n] - (b_1 w[n-1] + b_2 w[n-2])/b_0, q[n] = (w[n] + 2 w[n-1] + w[n-2])/b_0. The mode shape carries
1/sqrt(b_0), under the force and under the wheel. The mode is at rest before the first wheel
arrives.

The march keeps w and its change d[n] = w[n] - w[n-1],

    d[n] = p[n] + (a^2 - a c - 3 lambda)/b_0 d[n-1] - 4 lambda/b_0 w[n-2].

In the form above the factors of a slow mode are nearly 2 and -1. Their rounding errors, and that of
their sum, are amplified by a^2/lambda, to hundreds of units in the last place. These differ between
processors, and difference quotients divide them by their step. With w[n-2] instead of w[n-1], a
step need not wait for the sum of the previous one.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from pre_core.arrays import FloatArray
from pre_core.kernels.jacobi import diagonalise, diagonalise_one
from pre_core.kernels.lanes import LANES, add, fma, fma_scalar, inner, kernel, load, mul, store, sub
from pre_core.parameters import ALPHA, BETA, EI_1, K_ROT, RHO_A, F
from pre_core.physics.bridge import (
    element_cubics,
    mass_matrix,
    supported_nodes,
    uniform_beam,
    unit_stiffness_matrices,
)

LEAST_COMPLIANCE_M_PER_N = 2e-12
"""Compliance added to every bearing, 0.2 µm under an axle of 10 t: without any compliance the
spring would be infinitely stiff."""


class BeamBasis(NamedTuple):
    """A beam in m modal coordinates of a reference beam, shared by all evaluations.

    `stiffness` (n + 2 or n + 4, m, m) has dK/ds for the EI of the n elements, then for the two
    rotational springs at the ends, then for the two vertical ones if bearings are compliant. The
    mass matrix of 1 kg/m is the identity. `cubics` (n * parts, 4, m) has the deflection in each
    part for a unit of each coordinate, as powers of the local coordinate 0..1 of the part.
    `lengths_m` is (n * parts,).
    """

    stiffness: FloatArray
    cubics: FloatArray
    lengths_m: FloatArray


class ModalFilters(NamedTuple):
    """The recursions of g modes or groups of modes; the last axis is parameter vectors or modes."""

    cubics: FloatArray  # (parts, g, 4, 4): see `modal_filters`
    feedback: FloatArray  # (g, factors, 4)
    state: FloatArray  # (g, 2, 4): w[n] and d[n] here, w[n] and w[n-1] in `modal_response`


class WheelStretch(NamedTuple):
    """Input and output of `advance`: samples during which each wheel stays in one part."""

    front: int
    """Part under the front wheel; -1 off the bridge."""
    rear: int
    front_place: FloatArray  # (steps,): 0..1 within the part
    rear_place: FloatArray  # (steps,)
    force: FloatArray  # (2, steps or more, 4)
    front_deflection: FloatArray  # (steps, 4)
    rear_deflection: FloatArray  # (steps, 4)


def beam_basis(
    element_lengths_m: FloatArray,
    parts: int = 1,
    coordinates: int | None = None,
    *,
    interior_supports: tuple[int, ...] = (),
    has_compliant_bearings: bool = False,
) -> BeamBasis:
    """Return a beam in the lowest modes of the uniform beam, its n elements cut into `parts`.

    Without `coordinates` all modes are used, which is the finite-element model itself. Fewer are
    faster, but inaccurate for a beam that is not uniform or has springs at its supports: smooth
    modes do not span its kinked curvature. With 14 of 28 modes, f_1 of the paper's scenario 6 is
    1 % off. `element_lengths_m` is (n,); `interior_supports` are nodes between elements. With
    `has_compliant_bearings` each end has a vertical spring.
    """
    n = element_lengths_m.size
    lengths = np.repeat(element_lengths_m / parts, parts)
    compliances = (1.0, 1.0) if has_compliant_bearings else (0.0, 0.0)
    unit = uniform_beam(1.0, np.ones(n * parts), 1.0, 0.0, 0.0)._replace(
        element_lengths_m=lengths,
        support_compliance_m_per_n=compliances,
        interior_supports=tuple(node * parts for node in interior_supports),
    )
    held = supported_nodes(unit)
    fine = unit_stiffness_matrices(lengths, held)
    count = fine.shape[1] if coordinates is None else min(coordinates, fine.shape[1])
    units = np.concatenate(
        [fine[: n * parts].reshape(n, parts, *fine.shape[1:]).sum(axis=1), fine[n * parts :]]
    )[: n + 4 if has_compliant_bearings else n + 2]
    # The springs, as stiff as an element of this length, only suppress rigid-body motion.
    reference = units[:n].sum(axis=0) + units[n + 2 :].sum(axis=0) * 12.0 / lengths[0] ** 3
    _, shapes = eigh(reference, mass_matrix(unit), subset_by_index=(0, count - 1))
    return BeamBasis(
        np.ascontiguousarray(shapes.T @ units @ shapes),
        np.ascontiguousarray(element_cubics(lengths, held, shapes)),
        lengths,
    )


def change_basis(basis: BeamBasis, theta: FloatArray) -> BeamBasis:
    """Return the same beam in coordinates that diagonalise the bridge `theta` (p,).

    Stiffness matrices of similar bridges are then nearly diagonal, and their modes are quick to
    compute. Every mode has a positive slope at the bridge's start: the sign of an eigenvector is
    arbitrary, but the parameters of initial vibration depend on it.
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
    """Return the undamped first natural frequencies (k,) in Hz of bridges `theta` (k, p)."""
    factors = stiffness_factors(theta, basis.stiffness.shape[0])
    stiffness = np.tensordot(factors, basis.stiffness, axes=1)
    lowest = np.linalg.eigvalsh(stiffness)[:, 0]
    return np.asarray(np.sqrt(lowest / theta[:, RHO_A]) / (2.0 * np.pi))


def stiffness_factors(theta: FloatArray, count: int) -> FloatArray:
    """Return the factors (…, count) of the matrices `BeamBasis.stiffness` for theta (…, p)."""
    vertical = 1.0 / (theta[..., F : F + 2] + LEAST_COMPLIANCE_M_PER_N)
    factors = [theta[..., EI_1:], theta[..., K_ROT : K_ROT + 2], vertical]
    return np.concatenate(factors, axis=-1)[..., :count]


@inner
def stiffness_factor(theta: FloatArray, i: int) -> float:
    """Return factor i of `stiffness_factors` for one vector (p,), in kernels."""
    spring = i - (theta.size - EI_1)
    if spring < 0:
        return theta[EI_1 + i]
    if spring < 2:
        return theta[K_ROT + spring]
    return 1.0 / (theta[F + spring - 2] + LEAST_COMPLIANCE_M_PER_N)


@inner
def modal_damping(theta: FloatArray, eigenvalue: float) -> float:
    """Return the Rayleigh damping alpha + beta omega^2 of a unit-mass mode for theta (p,)."""
    return theta[ALPHA] + theta[BETA] * eigenvalue


@kernel
def modal_filters(
    basis: BeamBasis,
    theta: FloatArray,
    step_s: float,
    matrix: FloatArray,
    vectors: FloatArray,
    cubics: FloatArray,
    feedback: FloatArray,
) -> bool:
    """Compute the recursions of the modes of four bridges; return False if a value is not finite.

    `theta` is (4, p); `matrix` and `vectors` (m, m, 4) are buffers. Outputs: `cubics` (parts, m, 4,
    4) [part, mode, power, vector], mode shapes over sqrt(rho A b_0), and `feedback` (m, 2, 4), the
    factors of w[n-2] and d[n-1].
    """
    basis_stiffness, basis_cubics = basis.stiffness, basis.cubics
    factors, m = basis_stiffness.shape[0], basis_stiffness.shape[1]
    by_lane = np.empty((factors, LANES))
    for e in range(factors):
        for lane in range(LANES):
            by_lane[e, lane] = stiffness_factor(theta[lane], e)
    for i in range(m):
        for j in range(i, m):  # only the upper triangle is read
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
            scale = load(matrix[k], k)
            for power in range(4):
                total = (0.0, 0.0, 0.0, 0.0)
                for i in range(m):
                    total = fma_scalar(load(vectors[k], i), basis_cubics[e, power, i], total)
                store(cubics[e, k], power, mul(total, scale))
    return True


@inner
def diagonalise_bridge(
    basis_stiffness: FloatArray, theta: FloatArray, matrix: FloatArray, vectors: FloatArray
) -> bool:
    """Diagonalise one bridge `theta` (p,); return False if a value is not finite.

    On return `matrix` (m, m) has the eigenvalues times rho A on its diagonal and `vectors` (m, m)
    the mode shapes in its rows.
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


@inner
def shape_cubics(
    basis_cubics: FloatArray, vectors: FloatArray, scale: FloatArray, out: FloatArray
) -> None:
    """Compute cubics of all modes in every part: `out` (parts, g, 4, 4) [part, group, power, mode].

    `vectors` (m, m) has the modes in its rows, each of which is multiplied by its `scale` (m,).
    """
    m = np.uintp(scale.size)
    turned = np.empty((scale.size, scale.size))
    for k in range(m):
        for i in range(m):
            turned[i, k] = scale[k] * vectors[k, i]
    row = np.empty(scale.size)
    for e in range(basis_cubics.shape[0]):
        for power in range(4):
            # Adjacent modes share the vector registers.
            row[:] = 0.0
            for i in range(m):
                one = basis_cubics[e, power, i]
                for k in range(m):
                    row[k] += one * turned[i, k]
            for k in range(scale.size):
                out[e, k // LANES, power, k % LANES] = row[k]


@inner
def modal_filters_one(
    basis: BeamBasis,
    theta: FloatArray,
    step_s: float,
    matrix: FloatArray,
    vectors: FloatArray,
    cubics: FloatArray,
    feedback: FloatArray,
) -> bool:
    """Compute the recursions of one bridge `theta` (p,), its modes in the lanes: g groups of four.

    `matrix` and `vectors` are (m, m). Outputs: `cubics` (parts, g, 4, 4) [part, group, power, mode]
    and `feedback` (g, 2, 4); lanes beyond the last mode stay zero. Return False if a value is not
    finite.
    """
    if not diagonalise_bridge(basis.stiffness, theta, matrix, vectors):
        return False
    a = 2.0 / step_s
    cubics[:] = 0.0
    feedback[:] = 0.0
    scale = np.empty(basis.stiffness.shape[1])
    for k in range(scale.size):
        group, lane = k // LANES, k % LANES
        eigenvalue = matrix[k, k] / theta[RHO_A]
        damping = modal_damping(theta, eigenvalue)
        b_0 = a * a + a * damping + eigenvalue
        feedback[group, 0, lane] = -4.0 * eigenvalue / b_0
        feedback[group, 1, lane] = (a * a - a * damping - 3.0 * eigenvalue) / b_0
        scale[k] = 1.0 / np.sqrt(theta[RHO_A] * b_0)
    shape_cubics(basis.cubics, vectors, scale, cubics)
    return True


@inner
def _one_mode_two_wheels(
    front: FloatArray,
    rear: FloatArray,
    feedback: FloatArray,
    state: FloatArray,
    wheels: WheelStretch,
) -> None:
    front_place, rear_place = wheels.front_place, wheels.rear_place
    deflection_front, deflection_rear = wheels.front_deflection, wheels.rear_deflection
    a0, a1, a2, a3 = load(front, 0), load(front, 1), load(front, 2), load(front, 3)
    b0, b1, b2, b3 = load(rear, 0), load(rear, 1), load(rear, 2), load(rear, 3)
    f1, f2 = load(feedback, 0), load(feedback, 1)
    w1, d = load(state, 0), load(state, 1)
    w2 = sub(w1, d)
    before = add(w1, w2)
    force_front, force_rear = wheels.force[0], wheels.force[1]
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


@inner
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


@inner
def advance(filters: ModalFilters, wheels: WheelStretch) -> None:
    """Advance all modes over a stretch: update `filters.state`, and *add* to the deflections.

    A stretch without a wheel on the bridge changes nothing: the modes do not vibrate freely.
    """
    front = filters.cubics[max(wheels.front, 0)]
    rear = filters.cubics[max(wheels.rear, 0)]
    feedback, state, force = filters.feedback, filters.state, wheels.force
    for k in range(feedback.shape[0]):
        if wheels.front >= 0 and wheels.rear >= 0:
            _one_mode_two_wheels(front[k], rear[k], feedback[k], state[k], wheels)
        elif wheels.front >= 0:
            place, deflection = wheels.front_place, wheels.front_deflection
            _one_mode_one_wheel(front[k], feedback[k], state[k], place, force[0], deflection)
        elif wheels.rear >= 0:
            place, deflection = wheels.rear_place, wheels.rear_deflection
            _one_mode_one_wheel(rear[k], feedback[k], state[k], place, force[1], deflection)
