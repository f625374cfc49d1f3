"""Tyres that have damping, bearings that give, and a bridge that swings before the truck comes.

The truth is simulated with 70 elements, all their modes and steps of 0.1 ms; what is left of the
residual at the truth is measured in units of the noise of 5 µg/√Hz (`crossings.in_noise`).
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pre_core.arrays import FloatArray
from pre_core.crossing.arguments import EvaluationPoints, GriddedCrossing, allocate_buffers
from pre_core.crossing.channels import A, channel_signals
from pre_core.crossing.deflection import SWING_MODES
from pre_core.crossing.residuals import roads_and_deflections
from pre_core.crossing.rows import row_filter
from pre_core.kernels.lanes import LANES
from pre_core.paper import experiment
from pre_core.parameters import C_U1, F
from pre_core.physics import modal_response
from pre_core.physics.beam_basis import (
    LEAST_COMPLIANCE_M_PER_N,
    ModalFilters,
    beam_basis,
    change_basis,
)
from pre_core.physics.bridge import Beam, interpolation_matrix, modes, refine
from pre_core.physics.models import beam_from, from_models
from pre_core.physics.vehicle import body_masses_kg, total_mass_kg
from tests.numerics.crossings import (
    STEP_S,
    Driven,
    bare_crossing,
    crossing,
    in_noise,
    little,
    part,
    point,
    residual,
    simulated,
    uncorrected,
)

TRUCK = experiment.TRUCK
BEAM = experiment.beam(experiment.scenario_ratios(6))
RHO_A_KG_PER_M = float(BEAM.mass_per_length_kg_per_m[0])
DAMPED = TRUCK._replace(tyre_damping_ns_per_m=(1100.0, 900.0))


def left_at_truth(driven: Driven) -> FloatArray:
    return in_noise(driven.case, residual(driven.case, point(driven.case)))


# Tyre damping


@pytest.fixture(scope="module")
def damped() -> Driven:
    return simulated(DAMPED, BEAM)


def test_tyres_with_damping(damped: Driven) -> None:
    """At its truth as little is left as without damping at that truth: 0.034 and 0.038 in all."""
    left, without = left_at_truth(damped), left_at_truth(simulated(TRUCK, BEAM))
    assert little(left), left
    assert left.sum() < 1.1 * without.sum(), (left, without)


@pytest.mark.parametrize("wheel", [0, 1])
def test_damping_of_either_tyre_stands_out(damped: Driven, wheel: int) -> None:
    """Left out, and half of it."""
    for share in (0.0, 0.5):
        at = point(damped.case)
        at.theta[0, C_U1 + wheel] *= share
        assert in_noise(damped.case, residual(damped.case, at)).sum() > 100.0


def sine_crossing(step_s: float, hz: float) -> tuple[GriddedCrossing, EvaluationPoints, FloatArray]:
    """Off the bridge, only the body above the front axle moves: data, truth, times (n,)."""
    n = 400
    omega = 2.0 * np.pi * hz
    t = step_s * np.arange(n)
    signals = np.zeros((4, 6, n))
    for order in range(3):
        signals[0, A + order] = omega**order * np.sin(omega * t + 0.5 * np.pi * order)
    basis = beam_basis(BEAM.element_lengths_m, 1)
    data = bare_crossing(step_s, signals, basis, 30.0, total_mass_kg(TRUCK), is_inertial=True)
    at = uncorrected(from_models(TRUCK, BEAM), TRUCK.wheelbase_m, 10.0 * t - 50.0)
    return data, at, t


_INTERPOLATED = 6
"""Samples at the end of a record between which the force is linear."""


def error_of_tyre(step_s: float, hz: float, tau_s: float) -> float:
    """Of the front tyre's stroke d under a sine, k_u d + c_u d' = F: relative to F/k_u."""
    data, at, t = sine_crossing(step_s, hz)
    m_11, _, _ = body_masses_kg(TRUCK)
    k_u = TRUCK.tyre_stiffness_n_per_m[0]
    at.theta[0, C_U1] = tau_s * k_u
    work = allocate_buffers(data, at.theta.shape[1], row_filter(step_s))
    heights, _ = roads_and_deflections(data, work, at, 0)
    turn = 2j * np.pi * hz
    exact = m_11 * (np.exp(turn * t) / (k_u + turn * tau_s * k_u)).imag
    # Its deflection at the beginning is forgotten after some tau.
    settled = slice(t.size // 2, -_INTERPOLATED)
    return float(np.abs(heights[0] - exact)[settled].max() * k_u / m_11)


@pytest.mark.parametrize("tau_s", [1e-5, 3e-4, 1.4e-3, 1.6e-3, 6e-3, 3e-2])
def test_tyre_damping_is_exact_at_the_models_rate(tau_s: float) -> None:
    """At 42 Hz, where rows end, and 1/333 s, whatever the damping: what interpolation leaves."""
    assert error_of_tyre(3e-3, 42.0, tau_s) < 2e-5


def test_negative_damping_continues_positive_one() -> None:
    """A search passes zero: there the effect of damping is odd, and has one slope."""
    step, hz = 3e-3, 20.0
    data, at, _ = sine_crossing(step, hz)
    work = allocate_buffers(data, at.theta.shape[1], row_filter(step))

    def heights(tau_s: float) -> FloatArray:
        at.theta[0, C_U1] = tau_s * TRUCK.tyre_stiffness_n_per_m[0]
        found, _ = roads_and_deflections(data, work, at, 0)
        return found[0].copy()

    undamped = heights(0.0)
    for tau_s in (1e-6, 1e-3):
        effect = heights(tau_s) - undamped
        assert np.abs(effect).max() > 0.0
        np.testing.assert_allclose(heights(-tau_s) - undamped, -effect, atol=1e-12)


def test_tyre_damping_converges_as_the_interpolation_of_the_force() -> None:
    """Ten samples: the error of F between two of them goes with the tenth power of the step."""
    steps = 5e-3 * np.array([1.0, 0.8, 0.64])
    errors = [error_of_tyre(float(step), 42.0, 3e-3) for step in steps]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 8.5 < order < 10.5, (order, errors)


# Bearings that give

COMPLIANCES = [(1e-10, 1e-10), (3e-10, 1.5e-10), (1e-9, 1e-9), (1e-9, 2e-9)]


@pytest.mark.parametrize("forward", [True, False], ids=["forward", "backward"])
@pytest.mark.parametrize("compliance", COMPLIANCES)
def test_bearings_that_give(compliance: tuple[float, float], forward: bool) -> None:
    """As little is left as over rigid ones, wherever between two samples the wheels come on.

    Measured: 0.05 to 0.06 of the noise power of 5 µg/√Hz, 0.05 over rigid ones.
    """
    beam = BEAM._replace(support_compliance_m_per_n=compliance)
    driven = simulated(TRUCK, beam, forward=forward)
    samples = driven.case.acceleration.shape[1]
    for first in (0, 1, 2):  # thirds of the model's step
        here = driven._replace(case=part(driven.case, first, samples))
        left = left_at_truth(here)
        if max(compliance) <= 1e-9:  # softer ones are out of use
            assert left.sum() < 0.06, (first, left)
        assert little(left), (first, left)
    for end in range(2):
        at = point(driven.case)
        at.theta[0, F + end] -= 1e-10
        assert in_noise(driven.case, residual(driven.case, at)).sum() > 1.0, end


@pytest.mark.parametrize(("speed_m_per_s", "most"), [(5.0, 0.015), (25.0, 1.0)])
def test_bearings_that_give_at_other_speeds(speed_m_per_s: float, most: float) -> None:
    """At 25 m/s rigid ones leave as much: a kink at the bearing, sampled."""
    beam = BEAM._replace(support_compliance_m_per_n=(1e-9, 1e-9))
    rigid, gives = (
        left_at_truth(simulated(TRUCK, one, speed_m_per_s=speed_m_per_s)).sum()
        for one in (BEAM, beam)
    )
    assert gives < most
    assert gives < 1.3 * rigid, (gives, rigid)


def test_damped_tyres_on_bearings_that_give() -> None:
    """The damper feels the step from a bridge that gives to the road that does not.

    A simulation whose damper does not leaves 1.5 instead of 0.04.
    """
    left = left_at_truth(simulated(DAMPED, BEAM._replace(support_compliance_m_per_n=(1e-9, 1e-9))))
    assert little(left), left


# The bridge swings before the truck comes

LEAD_S = 1.3
SWING_M = np.array([2e-4, -4e-4, 1e-4])


@pytest.fixture(scope="module")
def swinging() -> Driven:
    """Some 0.2 mm of the first mode, and two more, a tenth of a second before the front axle."""
    shapes = modes(refine(BEAM, 10))
    q, v = np.zeros(shapes.eigenvalues_per_s2.size), np.zeros(shapes.eigenvalues_per_s2.size)
    grown = np.exp(0.5 * shapes.damping_per_s[:3] * (LEAD_S - 0.1))
    q[:3] = SWING_M * grown * np.sqrt(0.5 * RHO_A_KG_PER_M * 30.0)
    v[:3] = -0.7 * q[:3] * np.sqrt(shapes.eigenvalues_per_s2[:3])
    return simulated(TRUCK, BEAM, settle_s=0.0, before_s=LEAD_S, swing=np.stack([q, v]))


def swing_of(driven: Driven, data: GriddedCrossing, sample: int) -> FloatArray:
    """What `Points.swing` is at a sample of the model: (6,), from the simulation's own modes."""
    model = channel_signals(driven.case.acceleration, 1e-3, 1e3)
    time = driven.case.start_s + model.start_s + model.step_s * sample - driven.start_s
    steps = STEP_S * np.arange(driven.run.modal_displacement.shape[0])
    near = np.abs(steps - time) < 20.0 * STEP_S
    x = np.array([0.13, 0.41]) * 30.0
    theirs = interpolation_matrix(refine(BEAM, 10), x) @ driven.run.modes.shapes[:, :SWING_MODES]
    edges = data.edges_m
    e = np.searchsorted(edges, x) - 1
    powers = ((x - edges[e]) / np.diff(edges)[e])[:, None] ** np.arange(4)
    ours = np.einsum("xp,xpk->xk", powers, data.basis.cubics[e])[:, :SWING_MODES]
    sign = np.sign(np.sum(ours * theirs, axis=0))
    size = sign / np.sqrt(0.5 * RHO_A_KG_PER_M * 30.0)
    out = np.empty((SWING_MODES, 2))
    for k in range(SWING_MODES):
        q = CubicSpline(steps[near], driven.run.modal_displacement[near, k])
        v = CubicSpline(steps[near], driven.run.modal_velocity[near, k])
        out[k] = q(time), v(time) / np.sqrt(driven.run.modes.eigenvalues_per_s2[k])
    return np.asarray((size[:, None] * out).ravel())


def test_a_bridge_that_swings_when_the_truck_comes(swinging: Driven) -> None:
    """With its state at a sample before the entry as little is left as of a bridge at rest."""
    case = swinging.case
    at = point(case)
    data = crossing(case)
    entry = int(np.searchsorted(at.position_m[0], 0.0))
    basis = change_basis(data.basis, case.theta)
    seen = []
    for before in (12, 33, 60):
        here = data._replace(basis=basis, swing_sample=entry - before)
        at.swing[0] = swing_of(swinging, here, entry - before)
        left = in_noise(case, residual(case, at, data=here))
        assert little(left), (before, left)
        seen.append(at.swing[0].copy())
    assert np.abs(np.diff(seen, axis=0)).max() > 1e-4  # it does swing
    for i in range(4):  # of the third mode next to nothing is left when the axles are on
        right = at.swing[0, i]
        at.swing[0, i] = 0.0
        assert in_noise(case, residual(case, at, data=here)).sum() > 0.5, i
        at.swing[0, i] = right
    at.swing[:] = 0.0
    assert in_noise(case, residual(case, at, data=here)).sum() > 100.0


# Modes of beams on springs and interior supports


class Filters(NamedTuple):
    cubics: FloatArray
    feedback: FloatArray
    modes: FloatArray
    edges_m: FloatArray


def filters(theta: FloatArray, lengths: FloatArray, interior: tuple[int, ...]) -> Filters:
    basis = beam_basis(lengths, 2, interior_supports=interior, has_compliant_bearings=True)
    basis = change_basis(basis, theta)
    parts, _, m = basis.cubics.shape
    groups = -(-m // LANES)
    cubics, feedback = np.zeros((parts, groups, 4, LANES)), np.zeros((groups, 5, LANES))
    found = np.zeros((m, 3))
    assert modal_response.modal_filters(
        basis,
        theta,
        3e-3,
        np.zeros((m, m)),
        np.zeros((m, m)),
        ModalFilters(cubics, feedback, np.zeros((groups, 2, LANES))),
        found,
    )
    return Filters(cubics, feedback, found, np.concatenate([[0.0], np.cumsum(basis.lengths_m)]))


LENGTHS = np.array([4.0, 5.0, 3.0, 6.0, 4.0, 8.0])


@pytest.mark.parametrize("interior", [(), (2,), (2, 4)])
@pytest.mark.parametrize("compliance", [(0.0, 0.0), (4e-10, 0.0), (1e-9, 2e-9)])
def test_modes_of_beams_on_springs(
    interior: tuple[int, ...], compliance: tuple[float, float]
) -> None:
    """Frequencies, damping and shapes of the filters against the beam's own eigenproblem."""
    beam = Beam(
        LENGTHS,
        1e10 * np.linspace(0.7, 1.3, 6),
        np.full(6, RHO_A_KG_PER_M),
        0.4,
        1e-3,
        (3e8, 1e8),
        compliance,
        interior,
    )
    theta = from_models(TRUCK, beam)
    np.testing.assert_array_equal(
        np.concatenate(beam_from(theta, LENGTHS, interior)[:3]), np.concatenate(beam[:3])
    )
    ours = filters(theta, LENGTHS, interior)
    total = (compliance[0] + LEAST_COMPLIANCE_M_PER_N, compliance[1] + LEAST_COMPLIANCE_M_PER_N)
    fine = refine(beam._replace(support_compliance_m_per_n=total), 2)
    exact = modes(fine)
    order = np.argsort(ours.modes[:, 0])[:10]
    np.testing.assert_allclose(ours.modes[order, 0], exact.eigenvalues_per_s2[:10], rtol=1e-5)
    np.testing.assert_allclose(ours.modes[order, 1], exact.damping_per_s[:10], rtol=1e-5)
    x = np.linspace(0.0, 30.0, 61)
    e = np.clip(np.searchsorted(ours.edges_m, x, side="right") - 1, 0, 11)
    powers = ((x - ours.edges_m[e]) / np.diff(ours.edges_m)[e])[:, None] ** np.arange(4)
    theirs = interpolation_matrix(fine, x) @ exact.shapes[:, :10]
    for i, k in enumerate(order):
        cubic = ours.cubics[e, k // LANES, :, k % LANES]
        shape = np.sum(powers * cubic, axis=1) / abs(ours.modes[k, 2])
        shape *= np.sign(shape @ theirs[:, i])
        np.testing.assert_allclose(shape, theirs[:, i], atol=1e-5 * np.abs(theirs).max())
        for node in interior:
            there = np.abs(x - LENGTHS[:node].sum()) < 1e-9
            assert np.abs(shape[there]).max() < 1e-12


@pytest.mark.parametrize("k", [0, 1, 2])
@pytest.mark.parametrize("alpha_per_s", [0.3, 10.0])
def test_free_decay_of_a_mode(k: int, alpha_per_s: float) -> None:
    """q(t) = exp(-s t) (q cos wt + (v + s q)/w sin wt) under a wheel that weighs nothing."""
    beam = BEAM._replace(rayleigh_alpha_per_s=alpha_per_s)
    ours = filters(from_models(TRUCK, beam), BEAM.element_lengths_m, ())
    steps, q, v = 100, 3e-3, -0.4
    state = np.zeros((ours.feedback.shape[0], 2, LANES))
    modal_response.add_free_vibration(ours.feedback, state, ours.modes[k], k, q, v)
    lanes = np.zeros((2, steps, LANES))
    modal_response.advance(
        ModalFilters(ours.cubics, ours.feedback, state),
        modal_response.LoadedStretch(
            4, -1, np.full((2, steps), 0.3), np.zeros((2, steps, LANES)), lanes
        ),
    )
    cubic = ours.cubics[4, k // LANES, :, k % LANES]
    shape = np.sum(cubic * 0.3 ** np.arange(4)) / ours.modes[k, 2]
    half = 0.5 * ours.modes[k, 1]
    root = np.sqrt(ours.modes[k, 0] - half**2)
    assert root.imag == 0.0
    t = 3e-3 * np.arange(steps)
    decay = np.exp(-half * t)
    expected = decay * (q * np.cos(root * t) + (v + half * q) / root * np.sin(root * t))
    np.testing.assert_allclose(
        lanes[0].sum(axis=1), shape * expected, atol=1e-9 * np.abs(shape) * np.abs(expected).max()
    )
