"""The half-car by itself."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh

from pre_core.arrays import FloatArray
from pre_core.paper import experiment
from pre_core.physics.simulate import (
    Discretisation,
    WheelRoad,
    constant_acceleration,
    constant_speed,
    simulate,
)
from pre_core.physics.vehicle import (
    HalfCar,
    body_masses_kg,
    matrices,
    natural_frequencies_hz,
    static_axle_loads_n,
    total_mass_kg,
)

Agree = Callable[[str, float, float, float], None]


def test_natural_frequencies_of_table_5(paper_tables: dict[str, Any], measured: Agree) -> None:
    """All but the printed 1.12 Hz, which no body mass gives. The rear body's 2.04 Hz is met to
    0.01 Hz, the wheels' to the last printed digit."""
    table = paper_tables["table5_natural_frequencies_hz"]["vehicle"]
    ours = natural_frequencies_hz(experiment.TRUCK)
    for i, tolerance in ((1, 0.01), (2, 0.005), (3, 0.005)):
        measured(f"half-car, Table 5: f_{i + 1}, Hz", table[i], float(ours[i]), tolerance)
    assert ours[0] == pytest.approx(1.33, abs=0.05)
    assert abs(ours[0] - table[0]) > 0.1


def lagrangian(car: HalfCar) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mass, damping, stiffness in q = (heave of the centre of gravity, pitch nose up, z_u1, z_u2),
    and T with z = T q. Energies: T = (m_s h'^2 + I p'^2 + sum m_u z_u'^2)/2 and the squares of the
    strokes of suspension and tyre, h +- d p - z_u and z_u."""
    d_1 = car.front_axle_to_cg_m
    d_2 = car.wheelbase_m - d_1
    inertia = car.pitch_inertia_ratio * car.body_mass_kg * d_1 * d_2
    strokes = np.array([[1.0, d_1, -1.0, 0.0], [1.0, -d_2, 0.0, -1.0]])
    tyres = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    mass = np.diag([car.body_mass_kg, inertia, *car.unsprung_mass_kg])

    def quadratic(suspension: tuple[float, float], tyre: tuple[float, float]) -> FloatArray:
        return np.asarray(
            strokes.T @ np.diag(suspension) @ strokes + tyres.T @ np.diag(tyre) @ tyres
        )

    damping = quadratic(car.suspension_damping_ns_per_m, car.tyre_damping_ns_per_m)
    stiffness = quadratic(car.suspension_stiffness_n_per_m, car.tyre_stiffness_n_per_m)
    to_axles = np.array(
        [[1.0, d_1, 0.0, 0.0], [1.0, -d_2, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )
    return mass, damping, stiffness, to_axles


@given(kappa=st.floats(0.3, 2.5), d_1=st.floats(0.5, 4.0), tyre=st.floats(0.0, 2e4))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_matrices_against_heave_and_pitch(kappa: float, d_1: float, tyre: float) -> None:
    car = experiment.TRUCK._replace(
        pitch_inertia_ratio=kappa, front_axle_to_cg_m=d_1, tyre_damping_ns_per_m=(tyre, 0.5 * tyre)
    )
    *expected, to_axles = lagrangian(car)
    for ours, theirs in zip(matrices(car), expected, strict=True):
        np.testing.assert_allclose(
            to_axles.T @ ours @ to_axles, theirs, rtol=1e-10, atol=1e-9 * np.abs(theirs).max()
        )
    lagrangian_hz = np.sqrt(eigh(expected[2], expected[0], eigvals_only=True)) / (2.0 * np.pi)
    np.testing.assert_allclose(natural_frequencies_hz(car), lagrangian_hz, rtol=1e-9)


def test_kappa_of_one_uncouples_front_and_rear() -> None:
    m_11, m_22, m_12 = body_masses_kg(experiment.TRUCK)
    assert m_12 == pytest.approx(0.0, abs=1e-9)
    assert m_11 == pytest.approx(8310.0 * 3.185 / 4.4, rel=1e-12)
    assert m_22 == pytest.approx(8310.0 * 1.215 / 4.4, rel=1e-12)
    assert body_masses_kg(experiment.TRUCK._replace(pitch_inertia_ratio=0.8))[2] > 0.0


@given(d_1=st.floats(0.3, 4.1), kappa=st.floats(0.5, 2.0))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_static_axle_loads_carry_the_weight_at_its_lever(d_1: float, kappa: float) -> None:
    car = experiment.TRUCK._replace(front_axle_to_cg_m=d_1, pitch_inertia_ratio=kappa)
    front, rear = static_axle_loads_n(car, 9.81)
    assert front + rear == pytest.approx(total_mass_kg(car) * 9.81, rel=1e-12)
    body = 9.81 * car.body_mass_kg
    about_front = rear - 9.81 * car.unsprung_mass_kg[1]
    assert about_front * car.wheelbase_m == pytest.approx(body * d_1, rel=1e-12)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("acceleration", [-1.0, 0.5])
def test_load_transfer(direction: float, acceleration: float, agree: Agree) -> None:
    """On a flat road, after 9 s of steady braking or accelerating, far from the bridge: 1 ms.
    Braking at 1 m/s^2 with the centre of gravity at 1.2 m loads the front by 4 % and relieves the
    rear by 9 %, whichever way along the chainage the truck drives."""
    car = experiment.TRUCK._replace(cg_height_m=1.2, pitch_inertia_ratio=1.3)
    steps = 9001
    start = -500.0 if direction > 0.0 else 500.0
    motion = constant_acceleration(start, 20.0 * direction, acceleration, steps, 0.001)
    flat = WheelRoad(np.zeros((steps, 2)), np.zeros((steps, 2)))
    run = simulate(car, experiment.beam(np.ones(7)), motion, flat, Discretisation(0.001))
    front, rear = static_axle_loads_n(car, 9.80665)
    transfer = total_mass_kg(car) * acceleration * 1.2 / car.wheelbase_m
    pressed = -run.contact_force_n[-1]
    np.testing.assert_allclose(pressed, [front - transfer, rear + transfer], rtol=1e-6)
    if acceleration == -1.0 and direction == 1.0:
        agree(
            "braking at 1 m/s^2: front load, ratio to static",
            1.04,
            float(pressed[0] / front),
            0.005,
        )
        agree(
            "braking at 1 m/s^2: rear load, ratio to static", 0.91, float(pressed[1] / rear), 0.005
        )
    # The nose dives when braking, and the body turns about its centre of gravity only.
    nose, tail = run.displacement_m[-1, :2]
    assert np.sign(nose) == np.sign(acceleration) == -np.sign(tail)


def test_contact_forces_are_the_weight_and_the_inertia_of_all_masses() -> None:
    """The sum of P is -(M g + m_s z''_cg + sum m_u z''_u) with coupled pitch, tyre and bilinear
    damping, on a rough road: Newton's second law of the whole truck. 14 elements, 1 ms."""
    rng = np.random.default_rng(1)
    steps = 3000
    car = experiment.TRUCK._replace(
        pitch_inertia_ratio=1.4, tyre_damping_ns_per_m=(2000.0, 3000.0), bilinear_damping=0.2
    )
    motion = constant_speed(-2.0, 15.0, steps, 0.001)
    height = np.cumsum(rng.standard_normal((steps, 2)), axis=0) * 1e-5
    road = WheelRoad(height, np.gradient(height, 0.001, axis=0))
    run = simulate(car, experiment.beam(np.ones(7)), motion, road, Discretisation(0.001))
    d_1 = car.front_axle_to_cg_m
    a = run.acceleration_m_per_s2
    heave = (a[:, 0] * (car.wheelbase_m - d_1) + a[:, 1] * d_1) / car.wheelbase_m
    force = total_mass_kg(car) * 9.80665 + car.body_mass_kg * heave
    force += a[:, 2:] @ np.array(car.unsprung_mass_kg)
    np.testing.assert_allclose(run.contact_force_n.sum(axis=1), -force, rtol=1e-9)
