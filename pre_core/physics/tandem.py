"""Contact forces of a truck with a tandem behind one or several front axles.

An equaliser makes the two axles of the tandem share one spring force F_b in the ratio rho : 1 -
rho, so this force acts on the body at o_b = rho o_2 + (1 - rho) o_3. All axles ahead of the tandem
are taken together: F_1 is the sum of their spring forces, at the place that their static shares
give it, from which places are measured to the rear. Heave and pitch then determine F_1 and F_b
without the springs' parameters,

    F_1 + F_b = m_s z'',    d_1 F_1 + (d_1 - o_b) F_b = I theta'' - T,    T = M a h,

whatever the friction; T is the moment of the total mass M with its centre at the height h under the
truck's acceleration a. With the readings a_1 and a_2 of the body above F_1 and at the distance D_0
behind it, z'' = (1 - d_1/D_0) a_1 + d_1/D_0 a_2 and theta'' = (a_1 - a_2)/D_0; the
pitch inertia is I = kappa m_s d_1 (D_0 - d_1). The forces are proportional to 1/o_b; o_b = D_0
gives the half-car's m_11, m_22 and m_12 (`vehicle.masses_above_axles`).

Where the forces E_i of several front axles differ from their shares of F_1, which leaves their sum
unchanged, they turn the body by a moment M = sum o_i E_i, so that F_b is less by M/o_b and F_1
greater.

Where each axle of a tandem has springs of its own, inertia determines only the moment of both
forces about F_1, o_2 F_2 + o_3 F_3 = o_b F_b. Each force is that of its spring and damper, S_i =
k_i (z_ui - z_s(o_i)) + c_i (z_ui' - z_s'(o_i)), with the smallest correction that restores the
moment,

    F_i = S_i + w_i (o_b F_b - o_2 S_2 - o_3 S_3),    w_i = o_i/(o_2² + o_3²).

Friction f_i, which S_i does not contain, then appears in the moment as o_2 f_2 + o_3 f_3, and
leaves errors q of F_2 and -q o_2/o_3 of F_3, q = o_3 (o_3 f_2 - o_2 f_3)/(o_2² + o_3²). If the
friction of both axles is independent and equally strong, q and the moment are uncorrelated.
(`TandemTruck.is_equalised` selects the case.)
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import ComplexArray, FloatArray
from pre_core.kernels.lanes import kernel
from pre_core.parameters import C_S1, C_U1, D_1, K_S1, K_U1, KAPPA, M_U1, SHARE

_DAMPED = 0.4
"""Value of e at an axle's resonance and above it (`axle_response`)."""


class FrontAxles(NamedTuple):
    """The k axles ahead of a tandem; their motion is not measured. Arrays have the shape (k,)."""

    ahead_m: FloatArray
    """Distances from the tandem's first axle."""
    unsprung_mass_kg: FloatArray
    tyre_stiffness_n_per_m: FloatArray
    tyre_damping_ns_per_m: FloatArray
    suspension_stiffness_n_per_m: FloatArray
    """Nominal stiffness of the springs; theta has others."""
    suspension_damping_ns_per_m: FloatArray
    share: FloatArray
    """Shares of the front spring force."""


class TandemTruck(NamedTuple):
    """A truck with a tandem, without the parameters of its compared axles."""

    ahead_m: float
    """Distance from the tandem's first axle to the front spring force; 0 without a tandem."""
    readings_apart_m: float
    """Distance D_0 between the body's two readings; the first is above the front spring force."""
    front: FrontAxles
    is_equalised: bool = True
    """Whether the axles of the tandem share one spring force; otherwise each has its own spring,
    and the springs in theta are those of the tandem's axles."""


_NONE: FloatArray = np.zeros(0)
NO_TANDEM = TandemTruck(0.0, 0.0, FrontAxles(_NONE, _NONE, _NONE, _NONE, _NONE, _NONE, _NONE))


class SharedLoad(NamedTuple):
    """Masses by which the body's readings give the spring forces, and masses on the springs."""

    front_1: float
    """Mass that multiplies the first reading in the front spring force; the next three likewise."""
    front_2: float
    bogie_1: float
    bogie_2: float
    front_kg: float
    """Mass that the front springs carry at rest."""
    bogie_kg: float
    lever_m: float
    """Distance o_b of the bogie's force behind the front force."""


@kernel
def shared_load(
    tandem: TandemTruck, theta: FloatArray, total_mass: float, gap: float
) -> SharedLoad:
    """Return masses for theta (p,), a total mass in kg and a tandem's axle spacing `gap` in m."""
    body = total_mass
    for one in tandem.front.unsprung_mass_kg:
        body -= one
    body = body - theta[M_U1] - theta[M_U1 + 1]
    d_1, base = theta[D_1], tandem.readings_apart_m
    lever = tandem.ahead_m + (1.0 - theta[SHARE]) * gap
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
    """Distance o_2 of the tandem's first axle behind the front force."""
    lever_2_m: float
    weight_1: float
    """Factor w_1 in 1/m from the missing moment o_b F_b - o_2 S_2 - o_3 S_3 to F_2."""
    weight_2: float


@kernel
def own_springs(tandem: TandemTruck, gap: float) -> OwnSprings:
    """Return the levers for a distance `gap` between the tandem's axles."""
    first, second = tandem.ahead_m, tandem.ahead_m + gap
    both = first * first + second * second
    return OwnSprings(first, second, first / both, second / both)


def friction_transfer(
    tandem: TandemTruck, theta: FloatArray, gap: float, lag_s: float, omega: FloatArray
) -> FloatArray:
    """Return the factor (f,) from friction's power in F_b to that in R_1 - R_2, in m²/N².

    `theta` is (p,), `omega` (f,). The first axle reaches a place `lag_s` earlier. The factor is
    zero for an equalised tandem.
    """
    if tandem.is_equalised:
        return np.zeros(omega.size)
    on = own_springs(tandem, gap)
    both = on.lever_1_m**2 + on.lever_2_m**2
    lever = tandem.ahead_m + (1.0 - theta[SHARE]) * gap
    each = (lever**2 / both) * (on.lever_2_m**2 / both)
    s = 1j * omega
    first, second = (theta[K_U1 + w] + theta[C_U1 + w] * s for w in range(2))
    seen = np.exp(-s * lag_s) / first + on.lever_1_m / on.lever_2_m / second
    return np.asarray(each * np.abs(seen) ** 2)


def profile_equations(
    tandem: TandemTruck, theta: FloatArray, total_mass: float, gap: float, omega: FloatArray
) -> ComplexArray:
    """Return the truck's equations as factors (4, 4, f) of its displacements, at `omega` (f,).

    Rows are the input profiles of both tandem axles, then two equations of the body in N. Columns
    are the displacements at the body's two sensors and at both axles. Applied to accelerations, the
    rows are s² times these. `theta` is (p,).
    """
    if tandem.is_equalised:
        return _shared_equations(tandem, theta, total_mass, gap, omega)
    return _own_equations(tandem, theta, total_mass, gap, omega)


def _own_equations(
    tandem: TandemTruck, theta: FloatArray, total_mass: float, gap: float, omega: FloatArray
) -> ComplexArray:
    """Return the equations of a tandem whose axles have their own springs, as `profile_equations`.

    The last row, the moment about the front spring force, is a residual; the third, that force on a
    flat road, is not.
    """
    load, on = shared_load(tandem, theta, total_mass, gap), own_springs(tandem, gap)
    s = 1j * omega
    square = s**2
    levers, weights = (on.lever_1_m, on.lever_2_m), (on.weight_1, on.weight_2)
    springs = np.zeros((2, 4, s.size), dtype=np.complex128)
    for w, lever in enumerate(levers):
        law = theta[K_S1 + w] + theta[C_S1 + w] * s
        place = lever / tandem.readings_apart_m
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
    out[2, 0] += (load.front_1 + load.bogie_1) * square + _front_law(tandem, s)
    out[2, 1] += (load.front_2 + load.bogie_2) * square
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


def _front_law(tandem: TandemTruck, s: NDArray[np.complexfloating]) -> ComplexArray:
    """Return the dynamic stiffness (f,) in N/m of front axles with their nominal springs.

    The road is flat.
    """
    front = tandem.front
    stiffness, damping = (
        float(np.sum(values))
        for values in (front.suspension_stiffness_n_per_m, front.suspension_damping_ns_per_m)
    )
    return _on_axles(front, stiffness + damping * s, s)


def _on_axles(
    front: FrontAxles, spring: NDArray[np.complexfloating], s: NDArray[np.complexfloating]
) -> ComplexArray:
    """Return the dynamic stiffness (f,) of a spring (f,) on the front axles, which share its force.

    The road is flat.
    """
    soft = np.zeros(s.size, dtype=np.complex128)
    for j, share in enumerate(front.share):
        ground = front.tyre_stiffness_n_per_m[j] + front.tyre_damping_ns_per_m[j] * s
        soft += share**2 / (ground + front.unsprung_mass_kg[j] * s**2)
    return np.asarray(spring / (1.0 + spring * soft))


def _shared_equations(
    tandem: TandemTruck, theta: FloatArray, total_mass: float, gap: float, omega: FloatArray
) -> ComplexArray:
    """Return the equations of an equalised tandem, as `profile_equations`.

    The last two rows are the body's equations at the front force, with a flat road under the front
    axles, and at the tandem. They contain the springs' law: they describe the truck's response to
    its profiles, and are not residuals.
    """
    load = shared_load(tandem, theta, total_mass, gap)
    shares = (theta[SHARE], 1.0 - theta[SHARE])
    s = 1j * omega
    square = s**2
    out = np.zeros((4, 4, s.size), dtype=np.complex128)
    for w, share in enumerate(shares):
        tyre = theta[K_U1 + w] + theta[C_U1 + w] * s
        out[w, 0] = share * load.bogie_1 * square / tyre
        out[w, 1] = share * load.bogie_2 * square / tyre
        out[w, 2 + w] = 1.0 + theta[M_U1 + w] * square / tyre
    front = _on_axles(tandem.front, theta[K_S1] + theta[C_S1] * s, s)
    out[2, 0] = load.front_1 * square + front
    out[2, 1] = load.front_2 * square
    bogie = theta[K_S1 + 1] + theta[C_S1 + 1] * s
    # The body's displacement at the bogie's force, between or beyond its two readings.
    place = load.lever_m / tandem.readings_apart_m
    out[3, 0] = load.bogie_1 * square + (1.0 - place) * bogie
    out[3, 1] = load.bogie_2 * square + place * bogie
    for w, share in enumerate(shares):
        out[3, 2 + w] = -share * bogie
    return out


def axle_response(front: FrontAxles, j: int, omega: FloatArray) -> ComplexArray:
    """Return the factor (f,) from the ground to the displacement of axle j, at `omega` (f,).

    The ground is the profile minus the spring's force divided by the tyre's stiffness k. The factor
    is the inverse of G = 1 + m_u s²/k, damped near the resonance: conj(G)/(|G|² + e²), where e is
    `_DAMPED` times min(|m_u s²/k|, 1).
    """
    stiffness = front.tyre_stiffness_n_per_m[j] + 1j * omega * front.tyre_damping_ns_per_m[j]
    turned = -front.unsprung_mass_kg[j] * omega**2 / stiffness
    inverted = 1.0 + turned
    damped = (_DAMPED * np.minimum(np.abs(turned), 1.0)) ** 2
    return np.asarray(inverted.conj() / (np.abs(inverted) ** 2 + damped))
