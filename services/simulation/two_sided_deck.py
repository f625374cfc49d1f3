"""The bridge of `two_sided`: bending and torsion, and the exact steps of their modes.

Euler-Bernoulli bending of a beam whose rigidity differs between elements, in modes of its
own finite elements, and uniform St. Venant torsion between ends fixed against twist: psi_j = sin(j
pi x/L), omega_j = j omega_1, modal mass rho A r^2 L/2. Both are damped by alpha + beta omega^2. A
wheel at the distance e to the left of the axis follows w(x) + e theta(x), and its force drives
both.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import eigh, expm

from services.common.arrays import Floats

_CELLS: Final = 70
"""Fewest finite elements of the bridge."""
_BENDING_MODES: Final = 36
_TORSION_MODES: Final = 60
"""Number of torsional modes: twist under a wheel converges as its inverse, and 60 leave 0.7 %."""


class Torsion(NamedTuple):
    """Torsional properties of the deck."""

    frequency_hz: float
    """Frequency of the first mode."""
    gyration_m: float
    """Radius of gyration of the cross-section."""


class Deck(NamedTuple):
    """A simply supported bridge of equal elements."""

    span_m: float
    flexural_rigidity_nm2: tuple[float, ...]
    mass_per_length_kg_per_m: float
    rayleigh_alpha_per_s: float
    rayleigh_beta_s: float
    torsion: Torsion | None = None
    support_rotational_stiffness_nm_per_rad: tuple[float, float] = (0.0, 0.0)


class ExactModes(NamedTuple):
    """Mass-normalised modes of the bridge, bending before torsion, and their exact steps."""

    cell_m: float
    bending: Floats  # (nodes, bending modes): displacement at the nodes
    slope: Floats  # (nodes, bending modes)
    torsion: Floats  # (torsion modes,): factor of sin(j pi x/L)
    half: Floats  # (modes, 2, 2): free motion of (q, q') in half a step
    full: Floats
    half_drive: Floats  # (modes, 2): h/2 phi_1 of half a step, by the modal force
    weights: Floats  # (modes, 3, 2): of the modal forces at begin, middle (each), end


def bending_frequencies_hz(deck: Deck, count: int) -> Floats:
    """Return the lowest undamped bending frequencies."""
    return np.asarray(np.sqrt(_bending(deck, count)[0]) / (2.0 * np.pi))


def exact_modes(deck: Deck, step_s: float) -> ExactModes:
    """Return the modes of a bridge and their exact motion in steps of `step_s`."""
    eigenvalues, shapes = _bending(deck, _BENDING_MODES)
    torsion = np.zeros(0)
    if deck.torsion is not None:
        j = np.arange(1, _TORSION_MODES + 1)
        eigenvalues = np.concatenate(
            [eigenvalues, (2.0 * np.pi * deck.torsion.frequency_hz * j) ** 2]
        )
        inertia = deck.mass_per_length_kg_per_m * deck.torsion.gyration_m**2 * deck.span_m / 2.0
        torsion = np.full(j.size, 1.0 / np.sqrt(inertia))
    half, full, half_drive, weights = [], [], [], []
    for value in eigenvalues:
        damping = deck.rayleigh_alpha_per_s + deck.rayleigh_beta_s * value
        generator = np.array([[0.0, 1.0], [-value, -damping]])
        exact, phi = _phi_functions(0.5 * step_s * generator)
        half.append(exact)
        half_drive.append(0.5 * step_s * phi[0])
        exact, phi = _phi_functions(step_s * generator)
        full.append(exact)
        weights.append(
            step_s
            * np.stack(
                [
                    phi[0] - 3.0 * phi[1] + 4.0 * phi[2],
                    2.0 * phi[1] - 4.0 * phi[2],
                    4.0 * phi[2] - phi[1],
                ]
            )
        )
    return ExactModes(
        deck.span_m / (shapes.shape[0] // 2 - 1),
        np.ascontiguousarray(shapes[::2]),
        np.ascontiguousarray(shapes[1::2]),
        torsion,
        np.stack(half),
        np.stack(full),
        np.stack(half_drive),
        np.stack(weights),
    )


def _phi_functions(scaled: Floats) -> tuple[Floats, Floats]:
    """Return exp(A) and the second columns (3, 2) of phi_1, phi_2, phi_3 of A.

    They are in the exponential of A augmented with a chain of integrators.
    """
    joined = np.zeros((5, 5))
    joined[:2, :2] = scaled
    joined[1, 2] = 1.0
    joined[2, 3] = joined[3, 4] = 1.0
    whole = expm(joined)
    return whole[:2, :2], np.ascontiguousarray(whole[:2, 2:].T)


def _bending(deck: Deck, count: int) -> tuple[Floats, Floats]:
    """Return eigenvalues (count,) in 1/s² and mass-normalised shapes (2 nodes, count): w, w'."""
    parts = -(-_CELLS // len(deck.flexural_rigidity_nm2))
    rigidity = np.repeat(np.array(deck.flexural_rigidity_nm2), parts)
    cells = rigidity.size
    a = deck.span_m / cells
    bend = np.array(
        [
            [12.0, 6.0 * a, -12.0, 6.0 * a],
            [6.0 * a, 4.0 * a * a, -6.0 * a, 2.0 * a * a],
            [-12.0, -6.0 * a, 12.0, -6.0 * a],
            [6.0 * a, 2.0 * a * a, -6.0 * a, 4.0 * a * a],
        ]
    ) / (a**3)
    weigh = np.array(
        [
            [156.0, 22.0 * a, 54.0, -13.0 * a],
            [22.0 * a, 4.0 * a * a, 13.0 * a, -3.0 * a * a],
            [54.0, 13.0 * a, 156.0, -22.0 * a],
            [-13.0 * a, -3.0 * a * a, -22.0 * a, 4.0 * a * a],
        ]
    ) * (deck.mass_per_length_kg_per_m * a / 420.0)
    size = 2 * (cells + 1)
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for e in range(cells):
        stiffness[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += rigidity[e] * bend
        mass[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += weigh
    start, end = deck.support_rotational_stiffness_nm_per_rad
    stiffness[1, 1] += start
    stiffness[-1, -1] += end
    free = np.delete(np.arange(size), [0, size - 2])
    values, vectors = eigh(
        stiffness[np.ix_(free, free)], mass[np.ix_(free, free)], subset_by_index=(0, count - 1)
    )
    shapes = np.zeros((size, count))
    shapes[free] = vectors
    return np.asarray(values), shapes
