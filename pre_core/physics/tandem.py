"""Contact forces of a truck with a load-equalised tandem behind its front axle.

An equaliser makes the two axles of the tandem share one spring force F_b in the ratio rho : 1 -
rho, so that this force acts on the body at o_b = rho o_2 + (1 - rho) o_3. Heave and pitch then
determine both spring forces without any spring,

    F_1 + F_b = m_s z'',    d_1 F_1 + (d_1 - o_b) F_b = I theta'' - T,    T = M a h,

whatever friction there is. With the readings a_1 and a_2 of the body above the front axle and at
the distance D_0 behind it, z'' = (1 - d_1/D_0) a_1 + d_1/D_0 a_2 and theta'' = (a_1 - a_2)/D_0; the
pitch inertia is I = kappa m_s d_1 (D_0 - d_1). The forces are proportional to 1/o_b, so that o_b =
D_0 gives the half-car's m_11, m_22 and m_12 (`vehicle.masses_above_axles`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.kernels.lanes import kernel
from pre_core.parameters import C_S1, C_U1, D_1, K_S1, K_U1, KAPPA, M_U1, SHARE

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


_DAMPED = 0.4
"""Smallest size of G for which the front axle's answer counts in full (`lead_response`)."""


class Lead(NamedTuple):
    """The front axle of a truck with a tandem. Its own motion is not measured."""

    ahead_m: float
    """Distance from the tandem's first axle; 0 for a truck without a tandem."""
    readings_apart_m: float
    """Distance D_0 between the two readings of the body, of which the first is above this axle."""
    unsprung_mass_kg: float
    tyre_stiffness_n_per_m: float
    tyre_damping_ns_per_m: float


NO_LEAD = Lead(0.0, 0.0, 0.0, 0.0, 0.0)


class SharedLoad(NamedTuple):
    """Spring forces on the body for given readings, and the static loads on the springs."""

    lead_1: float
    """Mass that multiplies the first reading in the force at the front axle."""
    lead_2: float
    bogie_1: float
    bogie_2: float
    lead_kg: float
    """Mass that the front springs carry."""
    bogie_kg: float
    lever_m: float
    """Distance o_b of the bogie's force behind the front axle."""


@kernel
def shared_load(lead: Lead, theta: FloatArray, total_mass: float, gap: float) -> SharedLoad:
    """Return the body's masses for theta (p,) and a distance `gap` between the tandem's axles."""
    body = total_mass - lead.unsprung_mass_kg - theta[M_U1] - theta[M_U1 + 1]
    d_1, base = theta[D_1], lead.readings_apart_m
    lever = lead.ahead_m + (1.0 - theta[SHARE]) * gap
    inertia = theta[KAPPA] * body * d_1 * (base - d_1)
    bogie_1 = (body * d_1 * (base - d_1) - inertia) / (base * lever)
    bogie_2 = (body * d_1 * d_1 + inertia) / (base * lever)
    on_bogie = body * d_1 / lever
    return SharedLoad(
        body * (base - d_1) / base - bogie_1,
        body * d_1 / base - bogie_2,
        bogie_1,
        bogie_2,
        body - on_bogie,
        on_bogie,
        lever,
    )


def profile_equations(
    lead: Lead, theta: FloatArray, total_mass: float, gap: float, omega: FloatArray
) -> ComplexArray:
    """Return the truck's equations as factors of its accelerations: (4, 4, f), at `omega` (f,).

    Rows are s² times the input profiles of both tandem axles, and the body's equations at the front
    axle and at the bogie, in N per m; columns the two readings of the body and of both axles. The
    last two rows have springs: of the bogie, and of the front axle on a flat road. They describe
    how the truck answers to its profiles, and are no residuals.
    """
    load = shared_load(lead, theta, total_mass, gap)
    shares = (theta[SHARE], 1.0 - theta[SHARE])
    s = 1j * omega
    square = s**2
    out = np.zeros((4, 4, s.size), dtype=np.complex128)
    for w, share in enumerate(shares):
        tyre = theta[K_U1 + w] + theta[C_U1 + w] * s
        out[w, 0] = share * load.bogie_1 * square / tyre
        out[w, 1] = share * load.bogie_2 * square / tyre
        out[w, 2 + w] = 1.0 + theta[M_U1 + w] * square / tyre
    front = theta[K_S1] + theta[C_S1] * s
    ground = lead.tyre_stiffness_n_per_m + lead.tyre_damping_ns_per_m * s
    ground = ground + lead.unsprung_mass_kg * square
    bogie = theta[K_S1 + 1] + theta[C_S1 + 1] * s
    out[2, 0] = load.lead_1 * square + front * ground / (front + ground)
    out[2, 1] = load.lead_2 * square
    # The body at the bogie's force, between or beyond its two readings.
    place = load.lever_m / lead.readings_apart_m
    out[3, 0] = load.bogie_1 * square + (1.0 - place) * bogie
    out[3, 1] = load.bogie_2 * square + place * bogie
    for w, share in enumerate(shares):
        out[3, 2 + w] = -share * bogie
    return out


def lead_response(lead: Lead, omega: FloatArray) -> ComplexArray:
    """Return the factor (f,) from ground to the front axle's motion at `omega` (f,).

    Ground is the profile less the springs' force over the tyre's stiffness. The factor is the
    inverse of G = 1 + m_u s²/k_u, damped towards the resonance: conj(G)/(|G|² + e²).
    """
    stiffness = lead.tyre_stiffness_n_per_m + 1j * omega * lead.tyre_damping_ns_per_m
    turned = -lead.unsprung_mass_kg * omega**2 / stiffness
    inverted = 1.0 + turned
    damped = (_DAMPED * np.minimum(np.abs(turned), 1.0)) ** 2
    return np.asarray(inverted.conj() / (np.abs(inverted) ** 2 + damped))
