"""Modes under forces that are linear between samples, and wheels that come on between them.

Modes are compared with the matrix exponential, crossings with the closed form of a constant load
that moves evenly over a simply supported beam: for q'' + c q' + lambda q = P phi(v t)/m with
phi = sin(k pi x/L), the response to exp(i W t) and the free vibration that makes it begin at rest.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

from pre_core.arrays import FloatArray
from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.crossing.arguments import allocate_buffers
from pre_core.crossing.residuals import roads_and_deflections
from pre_core.crossing.rows import row_filter
from pre_core.parameters import ALPHA, C_S1, D_1, EI_1, K_S1, K_U1, KAPPA, M_U1, RHO_A
from pre_core.physics import modal_response as piecewise_exact
from pre_core.physics.beam_basis import beam_basis
from tests.numerics.crossings import bare_crossing, uncorrected

STEP_S = 3e-3


def marched(eigenvalue: float, damping: float, step_s: float, force: FloatArray) -> FloatArray:
    """The recursion as `advance` runs it, for one mode at rest before the first sample."""
    out = np.empty(piecewise_exact.COEFFICIENTS)
    total = piecewise_exact.mode_coefficients(eigenvalue, damping, step_s, out)
    q = np.empty(force.size)
    w_1 = w_2 = 0.0
    for n in range(force.size):
        w = force[n] + out[0] * w_1 + out[1] * w_2
        q[n] = total * (out[2] * w + out[3] * w_1 + out[4] * w_2)
        w_1, w_2 = w, w_1
    return q


def exponential(eigenvalue: float, damping: float, step_s: float, force: FloatArray) -> FloatArray:
    """Exact: (q, q', p, p') under the matrix exponential, from the sample before the first."""
    system = np.zeros((4, 4))
    system[0, 1] = system[2, 3] = system[1, 2] = 1.0
    system[1, :2] = -eigenvalue, -damping
    over = expm(step_s * system)
    q = np.empty(force.size)
    state, before = np.zeros(2), 0.0
    for n, now in enumerate(force):
        state = (over @ [*state, before, (now - before) / step_s])[:2]
        before = now
        q[n] = state[0]
    return q


@pytest.mark.parametrize("ratio", [0.0, 0.02, 0.9, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 1.001, 1.5, 20.0])
@pytest.mark.parametrize("angle", [0.05, 0.8, 3.0, 20.0])
def test_piecewise_linear_forces_are_exact(ratio: float, angle: float) -> None:
    """Damping ratios on both sides of the critical one; omega times the step from slow to fast."""
    omega = angle / STEP_S
    damping = 2.0 * ratio * omega
    force = np.random.default_rng(4).standard_normal(80)
    expected = exponential(omega**2, damping, STEP_S, force)
    ours = marched(omega**2, damping, STEP_S, force)
    # The ramp's response is a difference of terms 6/angle^2 times as large, twice over.
    allowed = 1e-13 * (10.0 + (6.0 / angle**2) ** 2)
    assert np.abs(ours - expected).max() < max(allowed, 1e-9) * np.abs(expected).max()


def pulse(t: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-(((t - 0.5) / 0.08) ** 2)) * np.sin(2.0 * np.pi * 6.0 * t))


@pytest.mark.parametrize(("is_sharpened", "low", "high"), [(False, 1.9, 2.1), (True, 3.8, 4.3)])
def test_order_for_smooth_forces(is_sharpened: bool, low: float, high: float) -> None:
    """Straight lines between samples lose (omega h)^2/12; `sharpened` gives that back."""
    eigenvalue, damping = (2.0 * np.pi * 9.0) ** 2, 2.0
    steps = np.array([8e-3, 4e-3, 2e-3])
    fine = pulse(np.arange(0.0, 1.2, 1e-4))
    sharp_fine = np.empty_like(fine)
    piecewise_exact.precompensate_force(fine, sharp_fine)
    truth = marched(eigenvalue, damping, 1e-4, sharp_fine)
    errors = []
    for step_s in steps:
        every = round(step_s / 1e-4)
        force = np.ascontiguousarray(fine[::every])
        used = force.copy()
        if is_sharpened:
            piecewise_exact.precompensate_force(force, used)
        ours = marched(eigenvalue, damping, float(step_s), used)
        errors.append(np.abs(ours - truth[::every]).max() / np.abs(truth).max())
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert low < order < high, (order, errors)
    if is_sharpened:
        assert errors[1] < 2e-4


class Beam(NamedTuple):
    span_m: float
    rigidity_nm2: float
    rho_a_kg_per_m: float
    alpha_per_s: float


LONG = Beam(30.0, 1.56e10, 9360.0, 0.5)
SHORT = Beam(3.0, 2.5e6, 1000.0, 0.5)  # f_1 of 8.7 Hz
WHEELBASE_M, SPEED_M_PER_S, TOTAL_KG = 4.4, 10.0, 18000.0
BEFORE_S = 0.2
MODES = 6


def theta_of(beam: Beam) -> FloatArray:
    theta = np.zeros(EI_1 + 7)
    theta[D_1] = 1.8
    theta[K_S1 : K_S1 + 2] = 4e5
    theta[M_U1 : M_U1 + 2] = 500.0, 800.0
    theta[C_S1 : C_S1 + 2] = 1.0
    theta[K_U1 : K_U1 + 2] = 2e6
    theta[KAPPA] = 1.0
    theta[EI_1 : EI_1 + 7] = beam.rigidity_nm2
    theta[RHO_A], theta[ALPHA] = beam.rho_a_kg_per_m, beam.alpha_per_s
    return theta


def wheel_loads_n() -> FloatArray:
    body = TOTAL_KG - 1300.0
    share = np.array([WHEELBASE_M - 1.8, 1.8]) / WHEELBASE_M
    return STANDARD_GRAVITY_M_PER_S2 * (body * share + np.array([500.0, 800.0]))


def silent_crossing(beam: Beam, offset_m: float) -> tuple[FloatArray, FloatArray]:
    """Deflections (2, n) under the wheels of a truck whose sensors read zero; front place (n,)."""
    n = round((BEFORE_S + (beam.span_m + WHEELBASE_M) / SPEED_M_PER_S + 0.2) / STEP_S)
    front = offset_m + SPEED_M_PER_S * (STEP_S * np.arange(n) - BEFORE_S)
    basis = beam_basis(np.full(7, beam.span_m / 7.0), 2)
    crossing = bare_crossing(
        STEP_S, np.zeros((4, 6, n)), basis, beam.span_m, TOTAL_KG, is_inertial=False
    )
    theta = theta_of(beam)
    at = uncorrected(theta, WHEELBASE_M, front)
    work = allocate_buffers(crossing, theta.size, row_filter(STEP_S))
    return roads_and_deflections(crossing, work, at, 0)[1], front


def modal_response(beam: Beam, k: int, t: FloatArray) -> FloatArray:
    """Mode k (sin of unit size) under a unit load that enters at t = 0 at SPEED and leaves."""
    eigenvalue = beam.rigidity_nm2 / beam.rho_a_kg_per_m * (k * np.pi / beam.span_m) ** 4
    decay = 0.5 * beam.alpha_per_s
    pole = -decay + 1j * np.sqrt(eigenvalue - decay**2)
    drive = k * np.pi * SPEED_M_PER_S / beam.span_m
    size = 2.0 / (beam.rho_a_kg_per_m * beam.span_m)
    forced = 1.0 / (eigenvalue - drive**2 + 2j * decay * drive)

    def free(q: float, rate: float, time: FloatArray) -> FloatArray:
        a = (rate - pole.conjugate() * q) / (pole - pole.conjugate())
        return np.asarray(2.0 * (a * np.exp(pole * time)).real)

    def on(time: FloatArray) -> FloatArray:
        wave = (forced * np.exp(1j * drive * time)).imag
        return np.asarray(wave + free(-forced.imag, -(1j * drive * forced).imag, time))

    leaves = beam.span_m / SPEED_M_PER_S
    tiny = 1e-6
    at_end = on(np.array([leaves - tiny, leaves, leaves + tiny]))
    after = free(float(at_end[1]), float(at_end[2] - at_end[0]) / (2.0 * tiny), t - leaves)
    return size * np.where(t < 0.0, 0.0, np.where(t <= leaves, on(t), after))


def exact_deflection(beam: Beam, front: FloatArray) -> FloatArray:
    """Under both wheels (2, n), zero where a wheel is not on the bridge."""
    loads = wheel_loads_n()
    places = np.stack([front, front - WHEELBASE_M])
    out = np.zeros_like(places)
    for k in range(1, MODES + 1):
        q = sum(-loads[w] * modal_response(beam, k, places[w] / SPEED_M_PER_S) for w in range(2))
        out += np.sin(k * np.pi * places / beam.span_m) * q
    out[(places < 0.0) | (places > beam.span_m)] = 0.0
    return out


OFFSETS_M = SPEED_M_PER_S * STEP_S * np.array([0.0, 0.01, 0.27, 0.5, 0.73, 0.99])
"""Where between two samples the front axle comes on; the rear axle elsewhere again."""


@pytest.mark.parametrize("beam", [LONG, SHORT], ids=["long", "short"])
def test_wheels_on_and_off_between_samples(beam: Beam) -> None:
    """The largest error is below a thousandth wherever they come on: six modes, 14 elements."""
    for offset_m in OFFSETS_M:
        ours, front = silent_crossing(beam, float(offset_m))
        expected = exact_deflection(beam, front)
        error = np.abs(ours - expected).max() / np.abs(expected).max()
        assert error < 1.1e-3, (offset_m, error)


def test_a_span_shorter_than_the_wheelbase_swings_on_between_the_axles() -> None:
    """Negative control: what the rear axle finds depends on what the front axle left behind."""
    ours, front = silent_crossing(SHORT, 0.01)
    rear = front - WHEELBASE_M
    on = (rear >= 0.0) & (rear <= SHORT.span_m)
    assert not np.any(on & (front <= SHORT.span_m))
    loads = wheel_loads_n()
    alone = np.zeros_like(front)
    for k in range(1, MODES + 1):
        q = -loads[1] * modal_response(SHORT, k, rear / SPEED_M_PER_S)
        alone += np.sin(k * np.pi * rear / SHORT.span_m) * q
    assert np.abs(ours[1] - alone)[on].max() > 0.02 * np.abs(alone[on]).max()


def test_the_free_vibration_does_not_depend_on_where_between_two_samples_they_come_on() -> None:
    """Truck and time shifted together by a part of a step: the same curve, read elsewhere.

    Measured: the error changes by 3e-5 of the largest deflection. Without the weights of the first
    and the last sample it changes by 16e-5, and the largest error above is 1.4e-3.
    """
    errors = []
    for share in np.linspace(0.0, 1.0, 11):
        ours, front = silent_crossing(SHORT, float(share) * SPEED_M_PER_S * STEP_S)
        expected = exact_deflection(SHORT, front)
        rear = front - WHEELBASE_M
        on = (rear >= 0.1 * SHORT.span_m) & (rear <= 0.9 * SHORT.span_m)
        errors.append(np.sqrt(np.mean((ours[1] - expected[1])[on] ** 2)))
    assert np.ptp(errors) < 6e-5 * np.abs(expected[1]).max()
