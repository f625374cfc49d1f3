"""One evaluation of the paper's J as one would first write it: NumPy, matrices, a loop over time.

A peer to be compared with, in answer and in time. Everything that does not depend on the unknowns
is prepared beforehand, as ours does. It knows only the paper's case: equal elements, constant speed
from start to end, a wheelbase that is a whole number of samples, free supports, kappa = 1.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.signal import lfilter

from pre_core.paper.window import PaperWindow
from pre_core.parameters import ALPHA, BETA, C_S1, D_1, EI_1, K_S1, K_U1, M_U1, RHO_A
from services.common.arrays import Floats


class Prepared(NamedTuple):
    """One crossing of n samples, of which m with the rear axle on the bridge."""

    step_s: float
    total_mass_kg: float
    wheelbase_m: float
    gravity_m_per_s2: float
    acceleration: Floats  # (4, n)
    signals: Floats  # (2, 4, n): z_u, z''_u, z'_u - z'_s, z_u - z_s
    mass: Floats  # (d, d) of 1 kg/m
    stiffness: Floats  # (elements, d, d) of 1 N m^2
    shapes: Floats  # (2, n, d): Hermite weights of the nodes under each wheel
    first_row: int
    rows: int
    delay: int  # samples from front to rear axle
    dx_m: float


def prepare(window: PaperWindow, elements: int, span_m: float) -> Prepared:
    """The same samples as `window`, and a finite-element model of our own."""
    s = span_m / elements
    dx = float(np.mean(np.diff(window.x_m)))
    m = (s / 420.0) * np.array(
        [
            [156.0, 22.0 * s, 54.0, -13.0 * s],
            [22.0 * s, 4.0 * s**2, 13.0 * s, -3.0 * s**2],
            [54.0, 13.0 * s, 156.0, -22.0 * s],
            [-13.0 * s, -3.0 * s**2, -22.0 * s, 4.0 * s**2],
        ]
    )
    k = np.array(
        [
            [12.0, 6.0 * s, -12.0, 6.0 * s],
            [6.0 * s, 4.0 * s**2, -6.0 * s, 2.0 * s**2],
            [-12.0, -6.0 * s, 12.0, -6.0 * s],
            [6.0 * s, 2.0 * s**2, -6.0 * s, 4.0 * s**2],
        ]
    ) / (s**3)
    size = 2 * (elements + 1)
    mass = np.zeros((size, size))
    stiffness = np.zeros((elements, size, size))
    for e in range(elements):
        dofs = slice(2 * e, 2 * e + 4)
        mass[dofs, dofs] += m
        stiffness[e, dofs, dofs] = k
    held = [0, size - 2]
    n = window.signals.shape[2]
    front = window.x_m[0] + window.wheelbase_m + dx * (np.arange(n) - window.first_row)
    shapes = np.stack([_hermite(x, elements, s) for x in (front, front - window.wheelbase_m)])
    return Prepared(
        window.step_s,
        window.total_mass_kg,
        window.wheelbase_m,
        window.gravity_m_per_s2,
        window.acceleration,
        window.signals,
        np.delete(np.delete(mass, held, 0), held, 1),
        np.delete(np.delete(stiffness, held, 1), held, 2),
        np.delete(shapes, held, 2),
        window.first_row,
        window.x_m.size,
        round(window.wheelbase_m / dx),
        dx,
    )


def _hermite(x: Floats, elements: int, s: float) -> Floats:
    weights = np.zeros((x.size, 2 * (elements + 1)))
    for i in np.flatnonzero((x >= 0.0) & (x <= s * elements)):
        e = min(int(x[i] / s), elements - 1)
        t = x[i] / s - e
        weights[i, 2 * e : 2 * e + 4] = [
            1.0 - 3.0 * t**2 + 2.0 * t**3,
            s * (t - 2.0 * t**2 + t**3),
            3.0 * t**2 - 2.0 * t**3,
            s * (t**3 - t**2),
        ]
    return weights


def objective(p: Prepared, theta: Floats) -> float:
    """J with Newmark's method on the nodal coordinates, step by step (paper section 2)."""
    inputs, forces, mass, damping, stiffness = _parts(p, theta)
    half, quarter = 0.5 * p.step_s, 0.25 * p.step_s**2
    inverse = np.linalg.inv(mass + half * damping + quarter * stiffness)
    load = forces[0][:, None] * p.shapes[0] + forces[1][:, None] * p.shapes[1]
    u, v = np.zeros(mass.shape[0]), np.zeros(mass.shape[0])
    a = np.linalg.solve(mass, load[0])
    nodal = np.zeros_like(load)
    for n in range(1, load.shape[0]):
        u = u + p.step_s * v + quarter * a
        v = v + half * a
        a = inverse @ (load[n] - damping @ v - stiffness @ u)
        u = u + quarter * a
        v = v + half * a
        nodal[n] = u
    return _compare(p, inputs - np.einsum("wnd,nd->wn", p.shapes, nodal))


def objective_with_filters(p: Prepared, theta: Floats) -> float:
    """J with one scipy.signal.lfilter a mode: the same scheme, no loop over time in Python."""
    inputs, forces, mass, damping, stiffness = _parts(p, theta)
    eigenvalues, modes = eigh(stiffness, mass)
    modal_damping = np.einsum("ik,ij,jk->k", modes, damping, modes)
    wheels = p.shapes @ modes
    load = forces[0][:, None] * wheels[0] + forces[1][:, None] * wheels[1]
    c = 2.0 / p.step_s
    q = np.empty_like(load)
    for k, (eigenvalue, damped) in enumerate(zip(eigenvalues, modal_damping, strict=True)):
        b = [
            c**2 + c * damped + eigenvalue,
            2.0 * (eigenvalue - c**2),
            c**2 - c * damped + eigenvalue,
        ]
        q[:, k] = lfilter([1.0, 2.0, 1.0], b, load[:, k])
    return _compare(p, inputs - np.einsum("wnk,nk->wn", wheels, q))


def _parts(p: Prepared, theta: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Input profiles (2, n), contact forces (2, n); mass, damping and stiffness matrix."""
    k_u, m_u = theta[K_U1 : K_U1 + 2], theta[M_U1 : M_U1 + 2]
    c_s, k_s = theta[C_S1 : C_S1 + 2], theta[K_S1 : K_S1 + 2]
    factors = np.stack([np.ones(2), m_u / k_u, c_s / k_u, k_s / k_u], axis=1)
    inputs = np.einsum("wj,wjn->wn", factors, p.signals)
    body = p.total_mass_kg - m_u.sum()
    rear_share = theta[D_1] / p.wheelbase_m
    m_s = body * np.array([1.0 - rear_share, rear_share])
    forces = -(
        m_s[:, None] * p.acceleration[:2]
        + m_u[:, None] * p.acceleration[2:]
        + p.gravity_m_per_s2 * (m_s + m_u)[:, None]
    )
    elements = p.stiffness.shape[0]
    rho, alpha, beta = theta[[RHO_A, ALPHA, BETA]]
    stiffness = np.tensordot(theta[EI_1 : EI_1 + elements], p.stiffness, axes=1)
    mass = rho * p.mass
    return inputs, forces, mass, alpha * mass + beta * stiffness, stiffness


def _compare(p: Prepared, road: Floats) -> float:
    rows = np.arange(p.first_row, p.first_row + p.rows)
    difference = road[1, rows] - road[0, rows - p.delay]
    return float(p.dx_m * difference @ difference)
