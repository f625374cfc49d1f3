"""The half-car: a rigid body on two axles (paper section 2.1, Table 1), with any pitch inertia.

Coordinates are the vertical displacements of the body above the axles and of the axles themselves,
from the equilibrium on a flat road, up positive: z = [z_s1, z_s2, z_u1, z_u2].
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import kernel

Pair = tuple[float, float]

_LEAST_HEIGHT = 0.05
"""Smallest height of an air spring relative to rest; real ones have a bump stop earlier."""


class HalfCar(NamedTuple):
    """Mechanical parameters of a truck; pairs are (front, rear)."""

    body_mass_kg: float
    front_axle_to_cg_m: float
    wheelbase_m: float
    suspension_damping_ns_per_m: Pair
    suspension_stiffness_n_per_m: Pair
    unsprung_mass_kg: Pair
    tyre_stiffness_n_per_m: Pair
    pitch_inertia_ratio: float = 1.0
    """Ratio kappa in I = kappa m_s d_1 d_2; 1 decouples front and rear, as the paper assumes."""
    tyre_damping_ns_per_m: Pair = (0.0, 0.0)
    bilinear_damping: float = 0.0
    """Asymmetry b: dampers act with c (1 + b) in rebound and c (1 - b) in compression."""
    cg_height_m: float = 0.0
    dry_friction_n: Pair = (0.0, 0.0)
    """Limit F_c of the suspension friction F of each axle, see `dahl_friction_n`."""
    friction_length_m: float = 0.002
    friction_load_growth: float = 0.0
    """Growth g: F_c is multiplied by 1 + g (load/static load - 1) of the spring; 1 makes it
    proportional to the load that the spring carries."""
    air_spring_exponent: float = 0.0
    """Exponent n of air springs, 0 for steel ones. Air under the static load L obeys L (1 - k c/(n
    L))^-n at the compression c: stiffness k at rest, increasing with compression."""


def total_mass_kg(car: HalfCar) -> float:
    """Return M = m_s + m_u1 + m_u2."""
    return car.body_mass_kg + car.unsprung_mass_kg[0] + car.unsprung_mass_kg[1]


@kernel
def dahl_friction_n(friction: float, stroke: float, level: float, length: float) -> float:
    """Return the friction after the spring has lengthened by `stroke` (m) from `friction` (N).

    Dahl's law dF/du = (F_c/length) (1 - sign(du) F/F_c), F_c being `level`, exact for a stroke in
    one direction. A positive F resists extension. A cycle between -a and a dissipates 4 F_c (a -
    length tanh(a/length)).
    """
    towards = level if stroke >= 0.0 else -level
    return towards + (friction - towards) * np.exp(-abs(stroke) / length)


@kernel
def air_spring_excess_n(
    compression: float, stiffness: float, load: float, exponent: float
) -> float:
    """Return the force of an air spring under static `load` beyond load + stiffness * compression.

    L ((1 - k c/(n L))^-n - 1) - k c; below the smallest height it stays constant.
    """
    height = max(1.0 - stiffness * compression / (exponent * load), _LEAST_HEIGHT)
    return load * (height**-exponent - 1.0) - stiffness * compression


@kernel
def masses_above_axles(
    body_mass: float, d_1: float, wheelbase: float, kappa: float
) -> tuple[float, float, float]:
    """Return (m_11, m_22, m_12) of the body in the coordinates above the axles.

    m_11 = (m_s d_2^2 + I)/D^2, m_22 = (m_s d_1^2 + I)/D^2, m_12 = (m_s d_1 d_2 - I)/D^2 with I =
    kappa m_s d_1 d_2.
    """
    d_2 = wheelbase - d_1
    inertia = kappa * body_mass * d_1 * d_2
    square = wheelbase * wheelbase
    return (
        (body_mass * d_2 * d_2 + inertia) / square,
        (body_mass * d_1 * d_1 + inertia) / square,
        (body_mass * d_1 * d_2 - inertia) / square,
    )


@kernel
def masses_on_axles(
    body_mass: float, d_1: float, wheelbase: float, unsprung_1: float, unsprung_2: float
) -> tuple[float, float]:
    """Return the masses on front and rear axle of the standing truck, unsprung ones included."""
    return (
        body_mass * (wheelbase - d_1) / wheelbase + unsprung_1,
        body_mass * d_1 / wheelbase + unsprung_2,
    )


def body_masses_kg(car: HalfCar) -> tuple[float, float, float]:
    """Return (m_11, m_22, m_12), see `masses_above_axles`."""
    m_11, m_22, m_12 = masses_above_axles(
        car.body_mass_kg, car.front_axle_to_cg_m, car.wheelbase_m, car.pitch_inertia_ratio
    )
    return m_11, m_22, m_12


def static_axle_loads_n(car: HalfCar, gravity_m_per_s2: float) -> Pair:
    """Return the weight on the front and on the rear axle of the standing truck."""
    front, rear = masses_on_axles(
        car.body_mass_kg, car.front_axle_to_cg_m, car.wheelbase_m, *car.unsprung_mass_kg
    )
    return front * gravity_m_per_s2, rear * gravity_m_per_s2


def matrices(car: HalfCar) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mass, damping and stiffness matrices (4, 4) in z = [z_s1, z_s2, z_u1, z_u2].

    Nonlinear parts enter the simulation as forces instead: bilinear damping, friction, and the
    excess of air springs.
    """
    m_11, m_22, m_12 = body_masses_kg(car)
    mass = np.diag([m_11, m_22, *car.unsprung_mass_kg])
    mass[0, 1] = mass[1, 0] = m_12

    def assemble(suspension: Pair, tyre: Pair) -> FloatArray:
        return np.array(
            [
                [suspension[0], 0.0, -suspension[0], 0.0],
                [0.0, suspension[1], 0.0, -suspension[1]],
                [-suspension[0], 0.0, suspension[0] + tyre[0], 0.0],
                [0.0, -suspension[1], 0.0, suspension[1] + tyre[1]],
            ]
        )

    damping = assemble(car.suspension_damping_ns_per_m, car.tyre_damping_ns_per_m)
    stiffness = assemble(car.suspension_stiffness_n_per_m, car.tyre_stiffness_n_per_m)
    return mass, damping, stiffness


def natural_frequencies_hz(car: HalfCar) -> FloatArray:
    """Return the undamped natural frequencies (4,), ascending."""
    mass, _, stiffness = matrices(car)
    return np.asarray(np.sqrt(eigh(stiffness, mass, eigvals_only=True)) / (2.0 * np.pi))
