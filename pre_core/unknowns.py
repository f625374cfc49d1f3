"""The vector of unknowns and its names (docs/contract.md, "Parameter names").

One order everywhere: d_1, c_s1, c_s2, k_s1, k_s2, m_u1, m_u2, k_u1, k_u2, kappa, EI_1 … EI_n, rhoA,
alpha, beta, k_rot_start, k_rot_end. A search may leave some of them fixed.
"""

import numpy as np
from numpy.typing import NDArray

from pre_core.physics.bridge import Beam
from pre_core.physics.vehicle import HalfCar

FloatArray = NDArray[np.float64]

D_1, C_S1, C_S2, K_S1, K_S2, M_U1, M_U2, K_U1, K_U2, KAPPA = range(10)
EI_1 = 10
VEHICLE_NAMES = ("d_1", "c_s1", "c_s2", "k_s1", "k_s2", "m_u1", "m_u2", "k_u1", "k_u2", "kappa")
BRIDGE_NAMES = ("rhoA", "alpha", "beta", "k_rot_start", "k_rot_end")
UNITS = {
    "d_1": "m",
    "c_s1": "N·s/m",
    "c_s2": "N·s/m",
    "k_s1": "N/m",
    "k_s2": "N/m",
    "m_u1": "kg",
    "m_u2": "kg",
    "k_u1": "N/m",
    "k_u2": "N/m",
    "kappa": "1",
    "rhoA": "kg/m",
    "alpha": "1/s",
    "beta": "s",
    "k_rot_start": "N·m/rad",
    "k_rot_end": "N·m/rad",
    "m_s": "kg",
    "m_s1": "kg",
    "m_s2": "kg",
}


def names(elements: int) -> tuple[str, ...]:
    """Names of the elements + 15 entries of the vector."""
    rigidities = tuple(f"EI_{e + 1}" for e in range(elements))
    return VEHICLE_NAMES + rigidities + BRIDGE_NAMES


def unit(name: str) -> str:
    """SI unit of a parameter."""
    return "N·m²" if name.startswith("EI_") else UNITS[name]


def paper_subset(elements: int) -> NDArray[np.int64]:
    """Places of the paper's n + 12 unknowns: all but kappa and the support springs."""
    left_out = {"kappa", "k_rot_start", "k_rot_end"}
    return np.array([i for i, name in enumerate(names(elements)) if name not in left_out])


def from_models(car: HalfCar, beam: Beam) -> FloatArray:
    """The vector that describes this truck and this bridge (of one mass per length throughout)."""
    if np.ptp(beam.mass_per_length_kg_per_m) > 0.0:
        raise ValueError("the unknown rhoA is one number: the beam must be of one mass per length")
    return np.array(
        [
            car.front_axle_to_cg_m,
            *car.suspension_damping_ns_per_m,
            *car.suspension_stiffness_n_per_m,
            *car.unsprung_mass_kg,
            *car.tyre_stiffness_n_per_m,
            car.pitch_inertia_ratio,
            *beam.flexural_rigidity_nm2,
            beam.mass_per_length_kg_per_m[0],
            beam.rayleigh_alpha_per_s,
            beam.rayleigh_beta_s,
            *beam.support_rotational_stiffness_nm_per_rad,
        ]
    )


def body_masses(theta: FloatArray, total_mass_kg: float, wheelbase_m: float) -> FloatArray:
    """Derived m_s, m_s1 = m_s d_2/D, m_s2 = m_s d_1/D: (..., 3) for vectors (..., p)."""
    m_s = total_mass_kg - theta[..., M_U1] - theta[..., M_U2]
    rear_share = theta[..., D_1] / wheelbase_m
    return np.stack([m_s, m_s * (1.0 - rear_share), m_s * rear_share], axis=-1)
