"""The bridge: an Euler-Bernoulli beam of Hermite elements (paper section 2.1) on its supports.

Degrees of freedom are deflection and rotation at every node in order, without the deflections that
are fixed: those of interior supports, and of the ends unless their bearings are compliant. With n
elements on two rigid bearings there are 2n.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from pre_core.arrays import FloatArray


class Beam(NamedTuple):
    """A beam of n elements with Rayleigh damping C = alpha M + beta K; arrays are (n,)."""

    element_lengths_m: FloatArray
    flexural_rigidity_nm2: FloatArray
    mass_per_length_kg_per_m: FloatArray
    rayleigh_alpha_per_s: float
    rayleigh_beta_s: float
    support_rotational_stiffness_nm_per_rad: tuple[float, float] = (0.0, 0.0)
    support_compliance_m_per_n: tuple[float, float] = (0.0, 0.0)
    """Vertical compliance of the end bearings; 0 is rigid."""
    interior_supports: tuple[int, ...] = ()
    """Nodes, 1 to n - 1, whose deflection is fixed; they rotate freely."""
    torsional_flexibility_per_n: float = 0.0
    """Ratio e²/(GJ) for axles whose centre is at the lateral distance e from the deck's axis
    (torsion.py); 0: the deck does not twist."""
    torsional_wave_speed_m_per_s: float = 0.0
    """Speed of torsional waves; must be positive if the deck twists."""


class Modes(NamedTuple):
    """Mass-normalised modes, ascending: shapes (d, k), eigenvalues omega^2 (k,), damping (k,)."""

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
    """Return a beam of equal elements, one for each of the rigidities (n,)."""
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
    """Return the same beam with every element cut into `parts` equal ones."""
    return beam._replace(
        element_lengths_m=np.repeat(beam.element_lengths_m / parts, parts),
        flexural_rigidity_nm2=np.repeat(beam.flexural_rigidity_nm2, parts),
        mass_per_length_kg_per_m=np.repeat(beam.mass_per_length_kg_per_m, parts),
        interior_supports=tuple(node * parts for node in beam.interior_supports),
    )


def supported_nodes(beam: Beam) -> tuple[int, ...]:
    """Return the nodes whose deflection is fixed."""
    ends = (0, beam.element_lengths_m.size)
    rigid = [
        node
        for node, compliance in zip(ends, beam.support_compliance_m_per_n, strict=True)
        if compliance == 0.0
    ]
    return tuple(sorted({*rigid, *beam.interior_supports}))


def span_m(beam: Beam) -> float:
    """Return the distance between the bearings at the ends."""
    return float(beam.element_lengths_m.sum())


def element_mass(length_m: float, coupling_sign: float = 1.0) -> FloatArray:
    """Return the consistent mass matrix (4, 4) of a Hermite element of 1 kg/m.

    `coupling_sign` = -1 flips the sign of the terms 13 l/420: an error that reproduces the bridge
    frequencies of the paper's Table 5 (studies/reproduction.md).
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
    """Return the stiffness matrix (4, 4) of a Hermite element of 1 N m^2."""
    s = length_m
    return np.array(
        [
            [12.0, 6.0 * s, -12.0, 6.0 * s],
            [6.0 * s, 4.0 * s**2, -6.0 * s, 2.0 * s**2],
            [-12.0, -6.0 * s, 12.0, -6.0 * s],
            [6.0 * s, 2.0 * s**2, -6.0 * s, 4.0 * s**2],
        ]
    ) / (s**3)


def node_dofs(elements: int, held: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the degrees of freedom (n + 1, 2) of every node: deflection (-1: fixed), rotation."""
    is_free = np.full((elements + 1, 2), True)
    is_free[list(held), 0] = False
    return np.where(is_free, np.cumsum(is_free).reshape(is_free.shape) - 1, -1)


def element_dofs(elements: int, held: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the degrees of freedom (n, 4) of each element, node by node; -1 is fixed."""
    nodes = node_dofs(elements, held)
    return np.concatenate([nodes[:-1], nodes[1:]], axis=1)


def _assemble(blocks: list[FloatArray], held: tuple[int, ...]) -> FloatArray:
    dofs = element_dofs(len(blocks), held)
    total = np.zeros((int(dofs.max()) + 1, int(dofs.max()) + 1))
    for block, dof in zip(blocks, dofs, strict=True):
        _add_block(total, block, dof)
    return total


def _add_block(total: FloatArray, block: FloatArray, dof: NDArray[np.int64]) -> None:
    """Add the block (4, 4) of an element to a matrix (d, d) at the free ones of `dof` (4,)."""
    kept = np.flatnonzero(dof >= 0)
    free = dof[kept]
    total[free[:, None], free] += block[kept[:, None], kept]


def mass_matrix(beam: Beam, coupling_sign: float = 1.0) -> FloatArray:
    """Return the consistent mass matrix (d, d); `coupling_sign` as in `element_mass`."""
    return _assemble(
        [
            rho * element_mass(length, coupling_sign)
            for rho, length in zip(
                beam.mass_per_length_kg_per_m, beam.element_lengths_m, strict=True
            )
        ],
        supported_nodes(beam),
    )


def unit_stiffness_matrices(element_lengths_m: FloatArray, held: tuple[int, ...]) -> FloatArray:
    """Return dK/ds_j (n + 4, d, d) for the n flexural rigidities, then for the four end springs.

    The two rotational springs precede the two vertical ones (zero where the end is fixed). K is
    exactly the sum over j of s_j times matrix j. `element_lengths_m` is (n,).
    """
    n = element_lengths_m.size
    nodes = node_dofs(n, held)
    size = int(nodes.max()) + 1
    units = np.zeros((n + 4, size, size))
    for unit, length_m, dof in zip(units, element_lengths_m, element_dofs(n, held), strict=False):
        _add_block(unit, element_stiffness(length_m), dof)
    for end, node in enumerate((0, n)):
        deflection, rotation = nodes[node]
        units[n + end, rotation, rotation] = 1.0
        if deflection >= 0:
            units[n + 2 + end, deflection, deflection] = 1.0
    return units


def stiffness_matrix(beam: Beam) -> FloatArray:
    """Return the stiffness matrix (d, d) with the support springs."""
    units = unit_stiffness_matrices(beam.element_lengths_m, supported_nodes(beam))
    return np.tensordot(_stiffness_factors(beam), units, axes=1)


def _stiffness_factors(beam: Beam) -> FloatArray:
    """Return the factors (n + 4,) of the matrices of `unit_stiffness_matrices`."""
    vertical = [1.0 / f if f > 0.0 else 0.0 for f in beam.support_compliance_m_per_n]
    return np.concatenate(
        [beam.flexural_rigidity_nm2, beam.support_rotational_stiffness_nm_per_rad, vertical]
    )


def modes(beam: Beam, count: int | None = None, coupling_sign: float = 1.0) -> Modes:
    """Return the lowest `count` modes (all by default)."""
    stiffness = stiffness_matrix(beam)
    last = (stiffness.shape[0] if count is None else count) - 1
    eigenvalues, shapes = eigh(
        stiffness, mass_matrix(beam, coupling_sign), subset_by_index=(0, last)
    )
    damping = beam.rayleigh_alpha_per_s + beam.rayleigh_beta_s * eigenvalues
    return Modes(shapes, eigenvalues, damping)


def natural_frequencies_hz(
    beam: Beam, count: int | None = None, coupling_sign: float = 1.0
) -> FloatArray:
    """Return the undamped natural frequencies (k,), ascending."""
    return np.asarray(np.sqrt(modes(beam, count, coupling_sign).eigenvalues_per_s2) / (2.0 * np.pi))


def strain_energy_shares(beam: Beam) -> FloatArray:
    """Return the shares (n + 4,) of elements and springs in the first mode's strain energy.

    They are the sensitivity of its frequency: Rayleigh's quotient is stationary at the mode, so
    that d ln f_1/d ln s_j is half of share j for each factor s_j of `unit_stiffness_matrices`, and
    d ln f_1/d ln rho A is -1/2.
    """
    shape = modes(beam, 1).shapes[:, 0]
    units = unit_stiffness_matrices(beam.element_lengths_m, supported_nodes(beam))
    energy = _stiffness_factors(beam) * np.einsum("i,jik,k->j", shape, units, shape)
    return np.asarray(energy / energy.sum())


def locate_element(
    element_lengths_m: FloatArray, x_m: FloatArray
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the element index (…), from 0, and the local coordinate (…) 0..1 for chainages (…).

    Off the bridge the index is -1 and the coordinate 0.
    """
    edges = np.concatenate([[0.0], np.cumsum(element_lengths_m)])
    element = np.clip(np.searchsorted(edges, x_m, side="right") - 1, 0, element_lengths_m.size - 1)
    place = (x_m - edges[element]) / element_lengths_m[element]
    on_bridge = (x_m >= 0.0) & (x_m <= edges[-1])
    return np.where(on_bridge, element, -1), np.where(on_bridge, place, 0.0)


def cubic_from_nodes(length_m: float) -> FloatArray:
    """Return the matrix (4, 4) from w_1, theta_1, w_2, theta_2 to factors of 1, xi, xi^2, xi^3."""
    s = length_m
    return np.array(
        [
            [1.0, 0.0, 0.0, 0.0],
            [0.0, s, 0.0, 0.0],
            [-3.0, -2.0 * s, 3.0, -s],
            [2.0, s, -2.0, s],
        ]
    )


def element_cubics(
    element_lengths_m: FloatArray, held: tuple[int, ...], nodal: FloatArray
) -> FloatArray:
    """Return the deflection in each element for k nodal vectors (d, k): (n, 4, k).

    These are the factors of the powers 0 to 3 of the local coordinate 0..1 of the element.
    """
    dofs = element_dofs(element_lengths_m.size, held)
    padded = np.vstack([nodal, np.zeros((1, nodal.shape[1]))])  # row -1: fixed deflections
    return np.stack(
        [
            cubic_from_nodes(length) @ padded[dof]
            for length, dof in zip(element_lengths_m, dofs, strict=True)
        ]
    )


def interpolation_matrix(beam: Beam, x_m: FloatArray) -> FloatArray:
    """Return N (m, d), so that N @ nodal is the deflection at m chainages; zero off the bridge."""
    element, place = locate_element(beam.element_lengths_m, np.asarray(x_m, dtype=np.float64))
    held = supported_nodes(beam)
    free = int(node_dofs(beam.element_lengths_m.size, held).max()) + 1
    cubics = element_cubics(beam.element_lengths_m, held, np.eye(free))
    powers = place[:, None] ** np.arange(4)
    rows = np.einsum("mp,mpk->mk", powers, cubics[np.maximum(element, 0)])
    rows[element < 0] = 0.0
    return np.asarray(rows)
