"""Conversion of a truck and a bridge to a parameter vector, and of a vector to its bridge."""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.parameters import (
    ALPHA,
    BETA,
    BRIDGE,
    D_1,
    EI_1,
    K_ROT,
    M_U1,
    RHO_A,
    TORSION,
    TRUCK,
    F,
    table,
)
from pre_core.physics.bridge import Beam
from pre_core.physics.vehicle import HalfCar


def from_models(car: HalfCar, beam: Beam) -> FloatArray:
    """Return the vector theta (p,) of a truck and a bridge of constant mass per length.

    A half-car has no tandem: its parameter `share` is zero. Raise ValueError for a beam of varying
    mass per length: the parameter rhoA is one number.
    """
    if np.ptp(beam.mass_per_length_kg_per_m) > 0.0:
        raise ValueError("the unknown rhoA is one number: the beam must be of one mass per length")
    of = {TRUCK: car, BRIDGE: beam}
    rows = table(beam.flexural_rigidity_nm2.size)
    return np.array([np.ravel(getattr(of[row.part], row.key, 0.0))[row.pair_index] for row in rows])


def beam_from(
    theta: FloatArray, element_lengths_m: FloatArray, interior_supports: tuple[int, ...] = ()
) -> Beam:
    """Return the bridge of theta (p,) over supports at its ends and at the given nodes.

    The torsional wave speed, which is no parameter of theta, is zero.
    """
    rigidities = theta[EI_1:]
    return Beam(
        element_lengths_m,
        rigidities,
        np.full(rigidities.size, theta[RHO_A]),
        float(theta[ALPHA]),
        float(theta[BETA]),
        (float(theta[K_ROT]), float(theta[K_ROT + 1])),
        (float(theta[F]), float(theta[F + 1])),
        interior_supports,
        float(theta[TORSION]),
    )


def body_masses(theta: FloatArray, total_mass_kg: float, wheelbase_m: float) -> FloatArray:
    """Return m_s, m_s1 = m_s d_2/D and m_s2 = m_s d_1/D in kg, shape (…, 3), for theta (…, p)."""
    m_s = total_mass_kg - theta[..., M_U1] - theta[..., M_U1 + 1]
    rear = m_s * theta[..., D_1] / wheelbase_m
    return np.stack([m_s, m_s - rear, rear], axis=-1)
