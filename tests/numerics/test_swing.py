"""A bridge that still swings from what has left: closed forms, and the truck that comes upon it."""

import numpy as np
import pytest
from scipy.linalg import expm

from pre_core.arrays import FloatArray
from pre_core.paper import experiment
from pre_core.physics.bridge import (
    Beam,
    interpolation_matrix,
    modes,
    refine,
    uniform_beam,
)
from pre_core.physics.free_vibration import free_motion, free_vibration_after
from pre_core.physics.simulate import (
    Discretisation,
    InitialVibration,
    WheelRoad,
    constant_speed,
    deflection_m,
    simulate,
)
from tests.numerics.newmark import newmark_modal
from tests.numerics.statics import static_deflection_m


def unequal_beam() -> Beam:
    """Two spans, ends that give and turn against springs, unequal elements, damped."""
    return uniform_beam(40.0, [1.0e10, 0.7e10, 1.1e10, 1.0e10, 0.9e10], 4400.0, 0.4, 2e-4)._replace(
        element_lengths_m=np.array([6.0, 9.0, 7.0, 10.0, 8.0]),
        support_rotational_stiffness_nm_per_rad=(2e8, 0.0),
        support_compliance_m_per_n=(2e-10, 0.0),
        interior_supports=(3,),
    )


def test_moving_force_that_left_an_undamped_beam() -> None:
    """The free motion after the closed solution of a moving force: first sine mode, 24 elements.
    q(T) and q'(T) of q'' + w^2 q = -(2 W/(rho L)) sin(pi v t/L)."""
    span, rigidity, rho, weight, speed = 20.0, 4.2e9, 2000.0, 1e5, 31.0
    beam = uniform_beam(span, [rigidity] * 24, rho, 0.0, 0.0)
    basis = modes(beam, 1)
    omega = (np.pi / span) ** 2 * np.sqrt(rigidity / rho)
    drive = np.pi * speed / span
    amplitude = -2.0 * weight / (rho * span * (omega**2 - drive**2))
    t = span / speed
    after = 0.3
    at_exit = amplitude * (np.sin(drive * t) - drive / omega * np.sin(omega * t))
    rate = amplitude * drive * (np.cos(drive * t) - np.cos(omega * t))
    exact = at_exit * np.cos(omega * after) + rate / omega * np.sin(omega * after)
    middle = interpolation_matrix(beam, np.array([0.5 * span])) @ basis.shapes
    state = free_vibration_after(beam, basis, weight, speed, after)
    assert float((middle @ state[0])[0]) == pytest.approx(exact, rel=2e-4)


@pytest.mark.parametrize("speed", [23.0, -17.0])
def test_moving_force_that_left_against_steps(speed: float) -> None:
    """All modes of the unequal beam that a step of 20 us follows: Newmark, both directions."""
    beam, seconds = unequal_beam(), 0.07
    basis = modes(beam, 6)
    step_s = 2e-5
    crossing_s = 40.0 / abs(speed)
    t = step_s * np.arange(round((crossing_s + seconds) / step_s) + 1)
    x = speed * t if speed > 0.0 else 40.0 + speed * t
    force = -3e5 * interpolation_matrix(beam, x) @ basis.shapes
    q = newmark_modal(basis.eigenvalues_per_s2, basis.damping_per_s, force, step_s)
    state = free_vibration_after(beam, basis, 3e5, speed, float(t[-1]) - crossing_s)
    np.testing.assert_allclose(state[0], q[-1], atol=2e-4 * np.abs(q).max())


def test_a_force_that_crawls_leaves_nothing() -> None:
    """At 0.05 m/s the deflection under way is the static one, and the beam rests afterwards."""
    beam = uniform_beam(20.0, [4.2e9] * 6, 2000.0, 0.5, 1e-4)
    basis = modes(beam)
    state = free_vibration_after(beam, basis, 1e5, 0.05, 0.0)
    largest = -static_deflection_m(beam, np.array([10.0]), np.array([-1e5]), np.array([10.0]))[0]
    left = np.abs(interpolation_matrix(beam, np.linspace(0.0, 20.0, 41)) @ basis.shapes @ state[0])
    assert left.max() < 0.01 * largest


def test_free_motion_of_damped_modes() -> None:
    """q'' + c q' + w^2 q = 0 under- and overdamped, and no overflow after a minute."""
    basis = modes(uniform_beam(20.0, [4.2e9] * 6, 2000.0, 0.5, 5e-3))
    damping, eigenvalues = basis.damping_per_s, basis.eigenvalues_per_s2
    assert (damping**2 > 4.0 * eigenvalues).any()
    assert (damping**2 < 4.0 * eigenvalues).any()
    rng = np.random.default_rng(3)
    start = rng.standard_normal((2, eigenvalues.size))
    for seconds in (0.001, 0.01, 0.4):
        ours = free_motion(basis, start, seconds)
        for k, (c, square) in enumerate(zip(damping, eigenvalues, strict=True)):
            exact = expm(np.array([[0.0, 1.0], [-square, -c]]) * seconds) @ start[:, k]
            size = np.abs(start[:, k]) * np.array([1.0, np.sqrt(square)])
            np.testing.assert_allclose(ours[:, k], exact, rtol=1e-6, atol=1e-9 * size.max())
    np.testing.assert_allclose(free_motion(basis, start, 0.0), start, atol=1e-12)
    assert np.abs(free_motion(basis, start, 60.0)).max() < 1e-3


def test_simulation_takes_the_swing_on() -> None:
    """A truck of nearly no weight comes on at 10 m/s, after 0.2 s: the bridge moves as it would
    alone, and rests before; of second order in the step."""
    beam = refine(unequal_beam(), 2)
    basis = modes(beam, 5)
    state = free_vibration_after(beam, basis, 3e5, 20.0, 0.1)
    light = experiment.TRUCK._replace(
        body_mass_kg=1e-3,
        unsprung_mass_kg=(1e-3, 1e-3),
        suspension_stiffness_n_per_m=(1e-2, 1e-2),
        suspension_damping_ns_per_m=(1e-3, 1e-3),
        tyre_stiffness_n_per_m=(1.0, 1.0),
    )
    errors = []
    for step_s in (0.0004, 0.0002, 0.0001):
        steps = round(1.0 / step_s) + 1
        motion = constant_speed(-2.0, 10.0, steps, step_s)
        flat = WheelRoad(np.zeros((steps, 2)), np.zeros((steps, 2)))
        run = simulate(
            light, beam, motion, flat, Discretisation(step_s, 5), swing=InitialVibration(state)
        )
        entry = round(0.2 / step_s)
        np.testing.assert_array_equal(run.modal_displacement[: entry - 1], 0.0)
        assert motion.position_m[entry] == pytest.approx(0.0, abs=1e-9)
        first = int(np.flatnonzero(run.modal_displacement.any(axis=1))[0])
        np.testing.assert_allclose(run.modal_displacement[first], state[0])
        np.testing.assert_allclose(run.modal_velocity[first], state[1])
        ends = free_motion(basis, state, step_s * (steps - 1 - first))
        errors.append(np.abs(run.modal_displacement[-1] - ends[0]).max())
    assert errors[-1] < 1e-3 * np.abs(state[0]).max()
    assert 3.0 < errors[0] / errors[1] < 5.0
    assert 3.0 < errors[1] / errors[2] < 5.0


def test_the_truck_feels_the_swing() -> None:
    """What a swing adds to the deflection under the wheels is about the swing itself, and nothing
    is added where it is zero."""
    beam = refine(experiment.beam(np.ones(7)), 2)
    basis = modes(beam, 8)
    steps, step_s = 3000, 0.0005
    motion = constant_speed(-1.0, 10.0, steps, step_s)
    flat = WheelRoad(np.zeros((steps, 2)), np.zeros((steps, 2)))
    state = free_vibration_after(beam, basis, 3e5, 17.0, 0.1)
    middle = np.array([15.0])

    def drive(swing: FloatArray | None) -> FloatArray:
        scheme = Discretisation(step_s, 8)
        given = None if swing is None else InitialVibration(swing)
        run = simulate(experiment.TRUCK, beam, motion, flat, scheme, swing=given)
        return deflection_m(beam, run, middle)[:, 0]

    still = drive(None)
    np.testing.assert_array_equal(drive(np.zeros((2, 8))), still)
    added = drive(state) - still
    alone = [
        float(
            (interpolation_matrix(beam, middle) @ basis.shapes @ free_motion(basis, state, t)[0])[0]
        )
        for t in step_s * np.arange(400)
    ]
    shown = added[round(0.1 / step_s) :][:400]
    assert np.abs(shown - alone).max() < 0.1 * np.abs(alone).max()
    assert np.abs(alone).max() > 1e-4
