"""Contact forces of a truck with a tandem behind its front axle.

An equaliser makes the two axles of the tandem share one spring force F_b in the ratio rho : 1 -
rho, so this force acts on the body at o_b = rho o_2 + (1 - rho) o_3. Heave and pitch then determine
both spring forces without the springs' parameters,

    F_1 + F_b = m_s z'',    d_1 F_1 + (d_1 - o_b) F_b = I theta'' - T,    T = M a h,

whatever the friction; T is the moment of the total mass M with its centre at the height h under the
truck's acceleration a. With the readings a_1 and a_2 of the body above the front axle and at
the distance D_0 behind it, z'' = (1 - d_1/D_0) a_1 + d_1/D_0 a_2 and theta'' = (a_1 - a_2)/D_0; the
pitch inertia is I = kappa m_s d_1 (D_0 - d_1). The forces are proportional to 1/o_b; o_b = D_0
gives the half-car's m_11, m_22 and m_12 (`vehicle.masses_above_axles`).

Where each axle has springs of its own, inertia determines only the moment of both forces about the
front axle, o_2 F_2 + o_3 F_3 = o_b F_b. Each force is that of its spring and damper, S_i = k_i
(z_ui - z_s(o_i)) + c_i (z_ui' - z_s'(o_i)), with the smallest correction that restores the moment,

    F_i = S_i + w_i (o_b F_b - o_2 S_2 - o_3 S_3),    w_i = o_i/(o_2² + o_3²).

Friction f_i, which S_i does not contain, then appears in the moment as o_2 f_2 + o_3 f_3, and
leaves errors q of F_2 and -q o_2/o_3 of F_3, q = o_3 (o_3 f_2 - o_2 f_3)/(o_2² + o_3²). If the
friction of both axles is independent and equally strong, q and the moment are uncorrelated.
(`Lead.is_equalised` selects the case.)
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import ComplexArray, FloatArray
from pre_core.kernels.lanes import kernel
from pre_core.parameters import C_S1, C_U1, D_1, K_S1, K_U1, KAPPA, M_U1, SHARE

_DAMPED = 0.4
"""Value of e at the front axle's resonance and above it (`lead_response`)."""


class Lead(NamedTuple):
    """The front axle ahead of a tandem; its motion is not measured."""

    ahead_m: float
    """Distance from the tandem's first axle; 0 for a truck without a tandem."""
    readings_apart_m: float
    """Distance D_0 between the body's two accelerometers; the first is above this axle."""
    unsprung_mass_kg: float
    tyre_stiffness_n_per_m: float
    tyre_damping_ns_per_m: float
    suspension_stiffness_n_per_m: float = 0.0
    """Nominal stiffness of its spring, used, as the damping, where `is_equalised` is False."""
    suspension_damping_ns_per_m: float = 0.0
    is_equalised: bool = True
    """Whether the axles of the tandem share one spring force; otherwise each has its own spring,
    and the springs in theta are those of the tandem's axles."""


NO_LEAD = Lead(0.0, 0.0, 0.0, 0.0, 0.0)


class SharedLoad(NamedTuple):
    """Masses by which the body's readings give the spring forces, and masses on the springs.

    The bogie is the tandem as a whole.
    """

    lead_1: float
    """Mass that multiplies the first reading in the front spring's force; the next three
    likewise."""
    lead_2: float
    bogie_1: float
    bogie_2: float
    lead_kg: float
    """Mass that the front springs carry at rest."""
    bogie_kg: float
    lever_m: float
    """Distance o_b of the tandem's force behind the front axle."""


@kernel
def shared_load(lead: Lead, theta: FloatArray, total_mass: float, gap: float) -> SharedLoad:
    """Return masses for theta (p,), a total mass in kg and a tandem's axle spacing `gap` in m."""
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


class OwnSprings(NamedTuple):
    """Levers of the forces of a tandem whose axles have springs of their own."""

    lever_1_m: float
    """Distance o_2 of the tandem's first axle behind the front axle."""
    lever_2_m: float
    weight_1: float
    """Factor w_1 in 1/m from the missing moment o_b F_b - o_2 S_2 - o_3 S_3 to F_2."""
    weight_2: float


@kernel
def own_springs(lead: Lead, gap: float) -> OwnSprings:
    """Return the levers for a distance `gap` between the tandem's axles."""
    first, second = lead.ahead_m, lead.ahead_m + gap
    both = first * first + second * second
    return OwnSprings(first, second, first / both, second / both)


def friction_transfer(
    lead: Lead, theta: FloatArray, gap: float, lag_s: float, omega: FloatArray
) -> FloatArray:
    """Return the factor (f,) from friction's power in F_b to that in R_1 - R_2, in m²/N².

    `theta` is (p,), `omega` (f,). The first axle reaches a place `lag_s` earlier. The factor is
    zero for an equalised tandem.
    """
    if lead.is_equalised:
        return np.zeros(omega.size)
    on = own_springs(lead, gap)
    both = on.lever_1_m**2 + on.lever_2_m**2
    lever = lead.ahead_m + (1.0 - theta[SHARE]) * gap
    each = (lever**2 / both) * (on.lever_2_m**2 / both)
    s = 1j * omega
    first, second = (theta[K_U1 + w] + theta[C_U1 + w] * s for w in range(2))
    seen = np.exp(-s * lag_s) / first + on.lever_1_m / on.lever_2_m / second
    return np.asarray(each * np.abs(seen) ** 2)


def profile_equations(
    lead: Lead, theta: FloatArray, total_mass: float, gap: float, omega: FloatArray
) -> ComplexArray:
    """Return the truck's equations as factors (4, 4, f) of its displacements, at `omega` (f,).

    Rows are the input profiles of both tandem axles, then two equations of the body in N. Columns
    are the displacements at the body's two sensors and at both axles. Applied to accelerations, the
    rows are s² times these. `theta` is (p,).
    """
    if lead.is_equalised:
        return _shared_equations(lead, theta, total_mass, gap, omega)
    return _own_equations(lead, theta, total_mass, gap, omega)


def _own_equations(
    lead: Lead, theta: FloatArray, total_mass: float, gap: float, omega: FloatArray
) -> ComplexArray:
    """Return the equations of a tandem whose axles have their own springs, as `profile_equations`.

    The last row, the moment about the front axle, is a residual; the third, the front axle's force
    on a flat road, is not.
    """
    load, on = shared_load(lead, theta, total_mass, gap), own_springs(lead, gap)
    s = 1j * omega
    square = s**2
    levers, weights = (on.lever_1_m, on.lever_2_m), (on.weight_1, on.weight_2)
    springs = np.zeros((2, 4, s.size), dtype=np.complex128)
    for w, lever in enumerate(levers):
        law = theta[K_S1 + w] + theta[C_S1 + w] * s
        place = lever / lead.readings_apart_m
        springs[w, 0], springs[w, 1] = -(1.0 - place) * law, -place * law
        springs[w, 2 + w] = law
    left = -(levers[0] * springs[0] + levers[1] * springs[1])
    left[0] += load.lever_m * load.bogie_1 * square
    left[1] += load.lever_m * load.bogie_2 * square
    force = np.stack([springs[w] + weights[w] * left for w in range(2)])
    out = np.zeros((4, 4, s.size), dtype=np.complex128)
    for w in range(2):
        tyre = theta[K_U1 + w] + theta[C_U1 + w] * s
        out[w] = force[w] / tyre
        out[w, 2 + w] += 1.0 + theta[M_U1 + w] * square / tyre
    out[2] = -force[0] - force[1]
    out[2, 0] += (load.lead_1 + load.bogie_1) * square + _front_law(lead, s)
    out[2, 1] += (load.lead_2 + load.bogie_2) * square
    out[3] = left / load.lever_m
    return out


def sensor_responses(equations: ComplexArray) -> ComplexArray:
    """Return the response (3, 8, f) of residuals to sensor noise of a tandem with own springs.

    `equations` (4, 4, f) are those of `profile_equations`. Sources are the sensors at the times of
    their own axles, then the same four sensors at the time of the other axle.
    """
    out = np.zeros((3, 8, equations.shape[2]), dtype=np.complex128)
    for w, sign in ((0, 1.0), (1, -1.0)):
        for source, channel in ((w, w), (2 + w, 2 + w), (4 + w, 1 - w), (6 + w, 3 - w)):
            out[0, source] = sign * equations[w, channel]
            if w == 1:
                out[2, source] = equations[3, channel]
    return out


def _front_law(lead: Lead, s: NDArray[np.complexfloating]) -> ComplexArray:
    """Return the dynamic stiffness (f,) in N/m of the front axle's spring, mass and tyre in series.

    The road is flat.
    """
    front = lead.suspension_stiffness_n_per_m + lead.suspension_damping_ns_per_m * s
    ground = lead.tyre_stiffness_n_per_m + lead.tyre_damping_ns_per_m * s
    ground = ground + lead.unsprung_mass_kg * s**2
    return np.asarray(front * ground / (front + ground))


def _shared_equations(
    lead: Lead, theta: FloatArray, total_mass: float, gap: float, omega: FloatArray
) -> ComplexArray:
    """Return the equations of an equalised tandem, as `profile_equations`.

    The last two rows are the body's equations at the front axle, on a flat road, and at the bogie.
    They contain the springs' law: they describe the truck's response to its profiles, and are not
    residuals.
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
    # The body's displacement at the bogie's force, between or beyond its two sensors.
    place = load.lever_m / lead.readings_apart_m
    out[3, 0] = load.bogie_1 * square + (1.0 - place) * bogie
    out[3, 1] = load.bogie_2 * square + place * bogie
    for w, share in enumerate(shares):
        out[3, 2 + w] = -share * bogie
    return out


def lead_response(lead: Lead, omega: FloatArray) -> ComplexArray:
    """Return the factor (f,) from the ground to the front axle's displacement at `omega` (f,).

    The ground is the profile minus the spring's force divided by the tyre's stiffness k. The factor
    is the inverse of G = 1 + m_u s²/k, damped near the resonance: conj(G)/(|G|² + e²), where e is
    `_DAMPED` times min(|m_u s²/k|, 1).
    """
    stiffness = lead.tyre_stiffness_n_per_m + 1j * omega * lead.tyre_damping_ns_per_m
    turned = -lead.unsprung_mass_kg * omega**2 / stiffness
    inverted = 1.0 + turned
    damped = (_DAMPED * np.minimum(np.abs(turned), 1.0)) ** 2
    return np.asarray(inverted.conj() / (np.abs(inverted) ** 2 + damped))
