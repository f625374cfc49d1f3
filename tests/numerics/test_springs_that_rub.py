"""Dry friction, air springs: laws in closed form, and the truck that has them."""

import numpy as np
import pytest
from scipy.integrate import quad

from pre_core.arrays import FloatArray
from pre_core.paper import experiment
from pre_core.physics.simulate import (
    CoupledResponse,
    Discretisation,
    WheelRoad,
    constant_speed,
    simulate,
)
from pre_core.physics.vehicle import (
    HalfCar,
    air_spring_excess_n,
    dahl_friction_n,
    static_axle_loads_n,
)

LEVEL_N = (3000.0, 4500.0)
LENGTH_M = 0.002
RUBBING = experiment.TRUCK._replace(dry_friction_n=LEVEL_N, friction_length_m=LENGTH_M)


def dahl_along(stroke: FloatArray, level: float, length: float) -> FloatArray:
    force = [0.0]
    for change in np.diff(stroke):
        force.append(dahl_friction_n(force[-1], float(change), level, length))
    return np.array(force)


def area(stroke: FloatArray, force: FloatArray) -> float:
    return float(np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(stroke)))


@pytest.mark.parametrize("amplitude", [0.0005, 0.003, 0.02])
def test_hysteresis_loop_encloses_what_the_law_says(amplitude: float) -> None:
    """4 F_c (a - b tanh(a/b)), with F_c tanh(a/b) at the ends; the 30th cycle, 4000 steps."""
    phase = np.linspace(0.0, 60.0 * np.pi, 30 * 4000 + 1)
    stroke = amplitude * np.sin(phase)
    force = dahl_along(stroke, LEVEL_N[0], LENGTH_M)
    last = slice(-4001, None)
    ratio = np.tanh(amplitude / LENGTH_M)
    enclosed = 4.0 * LEVEL_N[0] * (amplitude - LENGTH_M * ratio)
    assert area(stroke[last], force[last]) == pytest.approx(enclosed, rel=2e-5)
    assert force[last].max() == pytest.approx(LEVEL_N[0] * ratio, rel=1e-9)
    assert force[last].min() == pytest.approx(-LEVEL_N[0] * ratio, rel=1e-9)


def test_friction_depends_on_the_way_and_not_on_the_steps() -> None:
    """One stroke in 1 or in 1000 steps: the same force, by the law's solution from F_0."""
    start, way = -1800.0, 0.0031
    exact = 3000.0 + (start - 3000.0) * np.exp(-way / LENGTH_M)
    force = start
    for _ in range(1000):
        force = dahl_friction_n(force, way / 1000.0, 3000.0, LENGTH_M)
    assert force == pytest.approx(exact, rel=1e-12)
    assert dahl_friction_n(start, way, 3000.0, LENGTH_M) == pytest.approx(exact, rel=1e-12)


def driven(car: HalfCar, step_s: float, seconds: float, amplitude: float = 0.01) -> CoupledResponse:
    """Over waves of 8 m at 12 m/s (1.5 Hz), which grow from nothing, far from the bridge."""
    steps = round(seconds / step_s) + 1
    motion = constant_speed(-1000.0, 12.0, steps, step_s)
    x = np.stack([motion.position_m, motion.position_m - car.wheelbase_m], axis=1)
    t = step_s * np.arange(steps)[:, None]
    grown = 1.0 - np.exp(-(t**2))
    k = 2.0 * np.pi / 8.0
    height = amplitude * grown * np.sin(k * x)
    rate = amplitude * (
        grown * 12.0 * k * np.cos(k * x) + 2.0 * t * np.exp(-(t**2)) * np.sin(k * x)
    )
    beam = experiment.beam(np.ones(7))
    run = simulate(car, beam, motion, WheelRoad(height, rate), Discretisation(step_s))
    assert run.converged
    return run


def test_the_trucks_springs_follow_the_law() -> None:
    """The loop of each axle in the last wave, of the strokes that the truck did; and the springs
    carry it: m z'' of a body that moves above its axles alone (kappa = 1)."""
    step_s = 0.0005
    run = driven(RUBBING, step_s, 8.0, 0.04)
    stroke = run.displacement_m[:, :2] - run.displacement_m[:, 2:]
    rate = run.velocity_m_per_s[:, :2] - run.velocity_m_per_s[:, 2:]
    period = round(8.0 / 12.0 / step_s)
    for w in range(2):
        last = slice(-period - 1, None)
        a = 0.5 * float(np.ptp(stroke[last, w]))
        assert a > LENGTH_M  # it slides
        enclosed = 4.0 * LEVEL_N[w] * (a - LENGTH_M * np.tanh(a / LENGTH_M))
        assert area(stroke[last, w], run.friction_n[last, w]) == pytest.approx(enclosed, rel=0.003)
        share = (1.0, -1.0)[w]
        d = RUBBING.wheelbase_m - RUBBING.front_axle_to_cg_m
        mass = RUBBING.body_mass_kg * (d if share > 0 else RUBBING.front_axle_to_cg_m)
        inertial = mass / RUBBING.wheelbase_m * run.acceleration_m_per_s2[:, w]
        spring = (
            RUBBING.suspension_stiffness_n_per_m[w] * stroke[:, w]
            + RUBBING.suspension_damping_ns_per_m[w] * rate[:, w]
        )
        np.testing.assert_allclose(inertial + spring, -run.friction_n[:, w], atol=1e-5)


def test_friction_grows_with_the_load_of_the_spring() -> None:
    """g = 1: the force never exceeds F_c times the load over the static one; with g = 0 it does
    where the spring is relieved."""
    car = RUBBING._replace(dry_friction_n=(6000.0, 6000.0))
    loads = np.array(static_axle_loads_n(car, 9.80665)) - 9.80665 * np.array(car.unsprung_mass_kg)
    excess = []
    for growth in (0.0, 1.0):
        run = driven(car._replace(friction_load_growth=growth), 0.001, 6.0, 0.03)
        stroke = run.displacement_m[:, :2] - run.displacement_m[:, 2:]
        spring = -np.array(car.suspension_stiffness_n_per_m) * stroke
        level = 6000.0 * (1.0 + spring / loads)
        assert level.min() < 4500.0
        excess.append(float((np.abs(run.friction_n) - level).max()))
    assert excess[0] > 1000.0
    # Where the level falls quickly, friction follows within the length of the law.
    assert excess[1] < 300.0


def test_what_is_linear_is_left_alone() -> None:
    """No friction, no air springs: not a bit changes."""
    plain = driven(experiment.TRUCK, 0.001, 2.0)
    other = driven(experiment.TRUCK._replace(friction_load_growth=1.0), 0.001, 2.0)
    np.testing.assert_array_equal(plain.displacement_m, other.displacement_m)
    np.testing.assert_array_equal(plain.friction_n, 0.0)


def test_air_springs_are_polytropic() -> None:
    """Pressure times height^n is constant, the height at rest being n L/k; k at rest."""
    load, stiffness, exponent = 40e3, 4e5, 1.3
    height = exponent * load / stiffness
    for c in (-0.05, -0.001, 0.0, 0.02, 0.06):
        force = load + stiffness * c + air_spring_excess_n(c, stiffness, load, exponent)
        assert force * (height - c) ** exponent == pytest.approx(load * height**exponent)
    work, _ = quad(lambda c: air_spring_excess_n(c, stiffness, load, exponent), 0.0, 0.05)
    assert work > 0.0  # stiffer in compression
    rate = air_spring_excess_n(1e-6, stiffness, load, exponent) / 1e-6
    assert abs(rate) < 1e-4 * stiffness


def test_an_air_sprung_truck_stands_on_its_polytropic_force() -> None:
    """Slow and large waves: inertia, dampers and springs balance with the law of the test above."""
    car = experiment.TRUCK._replace(air_spring_exponent=1.38)
    loads = np.array(static_axle_loads_n(car, 9.80665)) - 9.80665 * np.array(car.unsprung_mass_kg)
    run = driven(car, 0.001, 5.0, 0.03)
    for w in range(2):
        stroke = run.displacement_m[:, w] - run.displacement_m[:, 2 + w]
        rate = run.velocity_m_per_s[:, w] - run.velocity_m_per_s[:, 2 + w]
        height = 1.38 * loads[w] / car.suspension_stiffness_n_per_m[w]
        force = loads[w] * ((1.0 + stroke / height) ** -1.38 - 1.0)
        force -= car.suspension_damping_ns_per_m[w] * rate
        mass = loads[w] / 9.80665
        np.testing.assert_allclose(mass * run.acceleration_m_per_s2[:, w], force, atol=1e-5)
        linear = -car.suspension_stiffness_n_per_m[w] * stroke
        assert np.abs(force + car.suspension_damping_ns_per_m[w] * rate - linear).max() > 500.0
