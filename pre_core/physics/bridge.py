"""The bridge: a simply supported Euler-Bernoulli beam of Hermite elements (paper section 2.1).

Degrees of freedom are deflection and rotation at every node, less the deflection at the two ends:
with n elements there are 2n, ordered rotation at the start, then (deflection, rotation) of each
inner node, then rotation at the end.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

FloatArray = NDArray[np.float64]


class Beam(NamedTuple):
    """A single span with Rayleigh damping C = alpha M + beta K; one entry per element."""

    element_lengths_m: FloatArray
    flexural_rigidity_nm2: FloatArray
    mass_per_length_kg_per_m: FloatArray
    rayleigh_alpha_per_s: float
    rayleigh_beta_s: float
    support_rotational_stiffness_nm_per_rad: tuple[float, float] = (0.0, 0.0)


class Modes(NamedTuple):
    """Mass-normalised modes, ascending: shapes (2n, k), eigenvalues omega^2 (k,), damping (k,)."""

    shapes: FloatArray
    eigenvalues_per_s2: FloatArray
    damping_per_s: FloatArray


def uniform_beam(
    span_m: float,
    flexural_rigidity_nm2: FloatArray | list[float],
    mass_per_length_kg_per_m: float,
    rayleigh_alpha_per_s: float,
    rayleigh_beta_s: float,
    support_rotational_stiffness_nm_per_rad: tuple[float, float] = (0.0, 0.0),
) -> Beam:
    """A beam of equal elements, as many as rigidities are given."""
    rigidity = np.asarray(flexural_rigidity_nm2, dtype=np.float64)
    n = rigidity.size
    return Beam(
        np.full(n, span_m / n),
        rigidity,
        np.full(n, mass_per_length_kg_per_m),
        rayleigh_alpha_per_s,
        rayleigh_beta_s,
        support_rotational_stiffness_nm_per_rad,
    )


def refine(beam: Beam, parts: int) -> Beam:
    """The same beam with every element cut into `parts` equal ones."""
    return beam._replace(
        element_lengths_m=np.repeat(beam.element_lengths_m / parts, parts),
        flexural_rigidity_nm2=np.repeat(beam.flexural_rigidity_nm2, parts),
        mass_per_length_kg_per_m=np.repeat(beam.mass_per_length_kg_per_m, parts),
    )


def span_m(beam: Beam) -> float:
    """Distance between the bearings."""
    return float(beam.element_lengths_m.sum())


def element_mass(length_m: float, coupling_sign: float = 1.0) -> FloatArray:
    """Consistent mass matrix (4, 4) of a Hermite element of 1 kg/m.

    `coupling_sign` = -1 flips the terms of 13 l/420. It is wrong; it is here because the bridge
    frequencies of the paper's Table 5 appear with it (docs/reproduction.md).
    """
    s = length_m
    t = coupling_sign * 13.0 * s
    return (s / 420.0) * np.array(
        [
            [156.0, 22.0 * s, 54.0, -t],
            [22.0 * s, 4.0 * s**2, t, -3.0 * s**2],
            [54.0, t, 156.0, -22.0 * s],
            [-t, -3.0 * s**2, -22.0 * s, 4.0 * s**2],
        ]
    )


def element_stiffness(length_m: float) -> FloatArray:
    """Stiffness matrix (4, 4) of a Hermite element of 1 N m^2."""
    s = length_m
    return np.array(
        [
            [12.0, 6.0 * s, -12.0, 6.0 * s],
            [6.0 * s, 4.0 * s**2, -6.0 * s, 2.0 * s**2],
            [-12.0, -6.0 * s, 12.0, -6.0 * s],
            [6.0 * s, 2.0 * s**2, -6.0 * s, 4.0 * s**2],
        ]
    ) / (s**3)


def element_dofs(elements: int) -> NDArray[np.int64]:
    """Degrees of freedom (n, 4) of each element, node by node: deflection, rotation; -1 is held."""
    free = np.full(2 * (elements + 1), -1, dtype=np.int64)
    held = {0, 2 * elements}
    count = 0
    for i in range(free.size):
        if i not in held:
            free[i] = count
            count += 1
    return np.array([free[2 * e : 2 * e + 4] for e in range(elements)])


def _assemble(blocks: list[FloatArray]) -> FloatArray:
    dofs = element_dofs(len(blocks))
    total = np.zeros((2 * len(blocks), 2 * len(blocks)))
    for block, dof in zip(blocks, dofs, strict=True):
        kept = dof >= 0
        total[np.ix_(dof[kept], dof[kept])] += block[np.ix_(kept, kept)]
    return total


def mass_matrix(beam: Beam, coupling_sign: float = 1.0) -> FloatArray:
    """Consistent mass matrix (2n, 2n), kg."""
    return _assemble(
        [
            rho * element_mass(length, coupling_sign)
            for rho, length in zip(
                beam.mass_per_length_kg_per_m, beam.element_lengths_m, strict=True
            )
        ]
    )


def unit_stiffness_matrices(element_lengths_m: FloatArray) -> FloatArray:
    """dK/ds_j (n + 2, 2n, 2n) for s = the n flexural rigidities and the two support springs.

    K = sum over j of s_j times these, exactly.
    """
    n = element_lengths_m.size
    units = np.zeros((n + 2, 2 * n, 2 * n))
    for e in range(n):
        blocks = [np.zeros((4, 4)) for _ in range(n)]
        blocks[e] = element_stiffness(element_lengths_m[e])
        units[e] = _assemble(blocks)
    units[n, 0, 0] = 1.0
    units[n + 1, -1, -1] = 1.0
    return units


def stiffness_matrix(beam: Beam) -> FloatArray:
    """Stiffness matrix (2n, 2n) with the support springs."""
    factors = np.concatenate(
        [beam.flexural_rigidity_nm2, beam.support_rotational_stiffness_nm_per_rad]
    )
    return np.tensordot(factors, unit_stiffness_matrices(beam.element_lengths_m), axes=1)


def modes(beam: Beam, count: int | None = None, coupling_sign: float = 1.0) -> Modes:
    """The lowest `count` modes (all 2n by default)."""
    last = 2 * beam.element_lengths_m.size - 1 if count is None else count - 1
    eigenvalues, shapes = eigh(
        stiffness_matrix(beam), mass_matrix(beam, coupling_sign), subset_by_index=(0, last)
    )
    damping = beam.rayleigh_alpha_per_s + beam.rayleigh_beta_s * eigenvalues
    return Modes(shapes, eigenvalues, damping)


def natural_frequencies_hz(
    beam: Beam, count: int | None = None, coupling_sign: float = 1.0
) -> FloatArray:
    """Undamped natural frequencies, ascending."""
    return np.asarray(np.sqrt(modes(beam, count, coupling_sign).eigenvalues_per_s2) / (2.0 * np.pi))


def locate(element_lengths_m: FloatArray, x_m: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Element number (-1 off the bridge) and place 0..1 within it for chainages of any shape."""
    edges = np.concatenate([[0.0], np.cumsum(element_lengths_m)])
    element = np.clip(np.searchsorted(edges, x_m, side="right") - 1, 0, element_lengths_m.size - 1)
    place = (x_m - edges[element]) / element_lengths_m[element]
    on_bridge = (x_m >= 0.0) & (x_m <= edges[-1])
    return np.where(on_bridge, element, -1), np.where(on_bridge, place, 0.0)


def cubic_from_nodes(length_m: float) -> FloatArray:
    """Coefficients (4, 4) of 1, xi, xi^2, xi^3 (rows) from w_1, theta_1, w_2, theta_2."""
    s = length_m
    return np.array(
        [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, s, 0.0, 0.0],
            [-3.0, -2.0 * s, 3.0, -s],
            [2.0, s, -2.0, s],
        ]
    )


def element_cubics(element_lengths_m: FloatArray, nodal: FloatArray) -> FloatArray:
    """Cubics (n, 4, k) in the element's place 0..1 of k nodal vectors (2n, k)."""
    dofs = element_dofs(element_lengths_m.size)
    padded = np.vstack([nodal, np.zeros((1, nodal.shape[1]))])  # row -1: the held ends
    return np.stack(
        [
            cubic_from_nodes(length) @ padded[dof]
            for length, dof in zip(element_lengths_m, dofs, strict=True)
        ]
    )


def interpolation_matrix(beam: Beam, x_m: FloatArray) -> FloatArray:
    """N (m, 2n): deflection at m chainages is N @ nodal; rows of zeros off the bridge."""
    element, place = locate(beam.element_lengths_m, np.asarray(x_m, dtype=np.float64))
    cubics = element_cubics(beam.element_lengths_m, np.eye(2 * beam.element_lengths_m.size))
    powers = place[:, None] ** np.arange(4)
    rows = np.einsum("mp,mpk->mk", powers, cubics[np.maximum(element, 0)])
    rows[element < 0] = 0.0
    return np.asarray(rows)


def static_deflection_m(
    beam: Beam, load_x_m: FloatArray, load_n: FloatArray, x_m: FloatArray
) -> FloatArray:
    """Deflection at `x_m` under standing point loads, up positive for loads up positive."""
    force = interpolation_matrix(beam, load_x_m).T @ np.asarray(load_n, dtype=np.float64)
    return np.asarray(
        interpolation_matrix(beam, x_m) @ np.linalg.solve(stiffness_matrix(beam), force)
    )
