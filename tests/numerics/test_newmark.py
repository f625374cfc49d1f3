"""Newmark's method: order in time, and the two ways through the same scheme.

The third way, the recursion of the kernels, is compared with nodal Newmark in test_objective.py.
"""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid

from pre_core.arrays import FloatArray
from pre_core.paper import experiment
from pre_core.paper.integrate import newmark_integrate, spline_integrate
from pre_core.physics.bridge import interpolation_matrix, mass_matrix, modes, stiffness_matrix
from tests.numerics.newmark import newmark, newmark_modal

Agree = Callable[[str, float, float, float], None]


def slope(steps: FloatArray, errors: list[float]) -> float:
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def test_second_order_on_a_damped_free_vibration(measured: Agree) -> None:
    """One mass, 2 Hz, 5 % damping, released from 1 m at 3 m/s, against the exact decay."""
    omega, zeta = 2.0 * np.pi * 2.0, 0.05
    damped = omega * np.sqrt(1.0 - zeta**2)
    steps = np.array([0.02, 0.01, 0.005, 0.0025, 0.00125])
    errors = []
    for h in steps:
        t = h * np.arange(round(1.0 / h) + 1)
        exact = np.exp(-zeta * omega * t) * (
            np.cos(damped * t) + (3.0 + zeta * omega) / damped * np.sin(damped * t)
        )
        run = newmark(
            np.eye(1),
            np.array([[2.0 * zeta * omega]]),
            np.array([[omega**2]]),
            np.zeros((t.size, 1)),
            float(h),
            displacement=np.ones(1),
            velocity=np.full(1, 3.0),
        )
        errors.append(float(np.abs(run.displacement[:, 0] - exact).max()))
    measured("order in time, damped free vibration", 2.0, slope(steps, errors), 0.05)


def test_undamped_energy_is_kept_to_rounding() -> None:
    """Average acceleration neither adds nor takes energy, whatever the step."""
    beam = experiment.beam(np.ones(7))
    mass, stiffness = mass_matrix(beam), stiffness_matrix(beam)
    start = np.random.default_rng(5).standard_normal(14) * 1e-3
    run = newmark(
        mass, np.zeros_like(mass), stiffness, np.zeros((2000, 14)), 0.01, displacement=start
    )
    kinetic = 0.5 * np.einsum("ni,ij,nj->n", run.velocity, mass, run.velocity)
    strain = 0.5 * np.einsum("ni,ij,nj->n", run.displacement, stiffness, run.displacement)
    np.testing.assert_allclose(kinetic + strain, strain[0], rtol=1e-8)


def wheel_forces(step_s: float) -> tuple[FloatArray, FloatArray]:
    """Two wheels that cross the bridge at 10 m/s with rough forces: chainages and forces (n, 2)."""
    n = round(3.6 / step_s)
    rng = np.random.default_rng(11)
    front = -0.05 + 10.0 * step_s * np.arange(n)
    x = np.stack([front, front - 4.4], axis=1)
    return x, -np.array([6e4, 3e4]) * (1.0 + 0.3 * rng.standard_normal((n, 2)))


@pytest.mark.parametrize("springs", [(0.0, 0.0), (3e8, 1e8)])
def test_modal_equals_nodal_to_rounding(springs: tuple[float, float], measured: Agree) -> None:
    """7 elements, 1 ms, scenario 9, with and without rotational springs; all modes."""
    beam = experiment.beam(experiment.scenario_ratios(9))._replace(
        support_rotational_stiffness_nm_per_rad=springs
    )
    x, force = wheel_forces(0.001)
    shapes_at = [interpolation_matrix(beam, x[:, w]) for w in range(2)]
    nodal_force = force[:, [0]] * shapes_at[0] + force[:, [1]] * shapes_at[1]
    mass, stiffness = mass_matrix(beam), stiffness_matrix(beam)
    damping = beam.rayleigh_alpha_per_s * mass + beam.rayleigh_beta_s * stiffness
    nodal = newmark(mass, damping, stiffness, nodal_force, 0.001).displacement
    basis = modes(beam)
    modal = newmark_modal(
        basis.eigenvalues_per_s2, basis.damping_per_s, nodal_force @ basis.shapes, 0.001
    )
    difference = np.abs(modal @ basis.shapes.T - nodal).max(axis=0) / np.abs(nodal).max(axis=0)
    measured(
        f"modal less nodal Newmark, relative: springs {springs[0]:g} and {springs[1]:g}",
        0.0,
        float(difference.max()),
        1e-9,
    )


@given(st.integers(0, 2**31), st.sampled_from([1e-3, 2.5e-3, 1e-2]))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_newmark_integration_is_the_trapezoid_rule_twice(seed: int, step_s: float) -> None:
    acceleration = np.random.default_rng(seed).standard_normal((3, 200))
    found = newmark_integrate(acceleration, step_s)
    velocity = cumulative_trapezoid(acceleration, dx=step_s, axis=1, initial=0.0)
    displacement = cumulative_trapezoid(velocity, dx=step_s, axis=1, initial=0.0)
    np.testing.assert_allclose(found.velocity, velocity, atol=1e-12)
    np.testing.assert_allclose(found.displacement, displacement, atol=1e-12)


def test_orders_of_the_two_integrations(measured: Agree) -> None:
    """A 13 Hz oscillation, as of a hopping wheel, integrated twice over 1 s."""
    omega = 2.0 * np.pi * 13.0
    steps = np.array([0.004, 0.002, 0.001, 0.0005])
    errors: dict[str, list[float]] = {"trapezoid": [], "spline": []}
    for h in steps:
        t = h * np.arange(round(1.0 / h) + 1)
        acceleration = np.cos(omega * t)[None, :]
        exact = (1.0 - np.cos(omega * t)) / omega**2
        for name, integrate in (("trapezoid", newmark_integrate), ("spline", spline_integrate)):
            found = integrate(acceleration, float(h)).displacement[0]
            errors[name].append(float(np.abs(found - exact).max()))
    measured("order of Newmark's integration", 2.0, slope(steps, errors["trapezoid"]), 0.05)
    assert slope(steps, errors["spline"]) > 3.8
    assert errors["spline"][2] < 0.02 * errors["trapezoid"][2]
