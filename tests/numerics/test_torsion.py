"""A deck that twists under a lane beside its axis: simulation, model, what leaving it out costs.

Closed forms are those of St. Venant torsion between ends held against twist; the truth of crossings
is simulated with forty sines of the span on 70 elements and steps of 0.1 ms, the model marches
eight and takes the rest at once. What is left at the truth is measured in units of the noise of
5 µg/√Hz (`crossings.in_noise`).
"""

import itertools

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.crossing.arguments import GriddedCrossing, allocate_buffers
from pre_core.crossing.residuals import roads_and_deflections
from pre_core.crossing.rows import row_filter
from pre_core.paper import experiment
from pre_core.parameters import TORSION
from pre_core.physics.beam_basis import beam_basis
from pre_core.physics.bridge import Beam, refine, uniform_beam
from pre_core.physics.models import from_models
from pre_core.physics.road import Profile, under_wheels
from pre_core.physics.simulate import Discretisation, constant_speed, simulate
from pre_core.physics.torsion import NO_TORSION, TorsionBasis, mean_receptance, torsion_basis
from pre_core.physics.vehicle import static_axle_loads_n, total_mass_kg
from tests.numerics.bars import bar_receptance
from tests.numerics.crossings import (
    STEP_S,
    bare_crossing,
    crossing,
    in_noise,
    point,
    residual,
    simulated,
    uncorrected,
)

TRUCK = experiment.TRUCK
WAVE_M_PER_S = 400.0
FLEXIBILITY_PER_N = 6e-10
"""A tenth of the bending deflection at midspan: 1.5 m aside at twice the first frequency."""
BEAM = experiment.beam(experiment.scenario_ratios(6))
TWISTING = BEAM._replace(
    torsional_flexibility_per_n=FLEXIBILITY_PER_N, torsional_wave_speed_m_per_s=WAVE_M_PER_S
)
MAX_LEFT = 5.0
"""Measured: 3.5 to 4.4, a sixth of the noise of 25 µg/√Hz; 33 to 64 with four marched sines."""
RIGID = uniform_beam(30.0, np.full(7, 1e14), 9360.0, 0.5, 0.0)
"""So stiff in bending that all of a wheel's deflection is twist."""


def greens(x: FloatArray, to: FloatArray, span: float) -> FloatArray:
    """Deflection per e²/(GJ) at x of a unit load at `to`."""
    return np.minimum(x, to) * (span - np.maximum(x, to)) / span


def torsion_of(beam: Beam, parts: int = 2) -> TorsionBasis:
    return torsion_basis(
        np.repeat(beam.element_lengths_m / parts, parts),
        tuple(parts * node for node in beam.interior_supports),
        beam.torsional_wave_speed_m_per_s,
    )


def standing(beam: Beam, speed_m_per_s: float = 0.02) -> tuple[FloatArray, FloatArray]:
    """Return the chainage (n,) of a crawling truck and the model's deflection (2, n)."""
    step_s = 0.01 / speed_m_per_s
    front = np.arange(-3.0, beam.element_lengths_m.sum() + 8.0, 0.01)
    basis = beam_basis(beam.element_lengths_m, 2, interior_supports=beam.interior_supports)
    data: GriddedCrossing = bare_crossing(
        step_s,
        np.zeros((4, 6, front.size)),
        basis,
        float(beam.element_lengths_m.sum()),
        total_mass_kg(TRUCK),
        is_inertial=True,
    )._replace(torsion=torsion_of(beam))
    at = uncorrected(from_models(TRUCK, beam), TRUCK.wheelbase_m, front)
    work = allocate_buffers(data, at.theta.shape[1], row_filter(step_s))
    _, deflection = roads_and_deflections(data, work, at, 0)
    return front, deflection


@pytest.mark.parametrize("supports", [(), (3,)])
def test_crawling_truck_twists_the_deck_as_the_closed_form(supports: tuple[int, ...]) -> None:
    beam = RIGID._replace(
        interior_supports=supports,
        torsional_flexibility_per_n=FLEXIBILITY_PER_N,
        torsional_wave_speed_m_per_s=WAVE_M_PER_S,
    )
    front, deflection = standing(beam)
    loads = np.array(static_axle_loads_n(TRUCK, 9.80665))
    edges = np.concatenate([[0.0], np.cumsum(beam.element_lengths_m)])[[0, *supports, 7]]
    wheels = np.stack([front, front - TRUCK.wheelbase_m])
    expected = np.zeros_like(wheels)
    for begin, end in itertools.pairwise(edges):
        on = (wheels >= begin) & (wheels <= end)
        for w in range(2):
            for other in range(2):
                both = on[w] & on[other]
                expected[w, both] -= loads[other] * greens(
                    wheels[w, both] - begin, wheels[other, both] - begin, end - begin
                )
    expected *= FLEXIBILITY_PER_N
    largest = np.abs(expected).max()
    # Wheels that have just come on or leave are softened over a step of 1 cm.
    assert np.abs(deflection - expected).max() < 5e-3 * largest
    assert np.sqrt(np.mean((deflection - expected) ** 2)) < 1e-3 * largest


def test_simulated_twist_is_that_of_a_moving_force() -> None:
    """Against the series of a constant force that moves over a span (Fryba), all modes undamped.

    The truck's forces are nearly constant on a smooth road; both wheels' deflections are those of
    two such forces.
    """
    speed, step_s = 10.0, 2e-4
    beam = refine(
        RIGID._replace(
            rayleigh_alpha_per_s=0.0,
            torsional_flexibility_per_n=FLEXIBILITY_PER_N,
            torsional_wave_speed_m_per_s=WAVE_M_PER_S,
        ),
        10,
    )
    steps = round(4.2 / step_s)
    motion = constant_speed(-2.0, speed, steps, step_s)
    flat = Profile(np.array([-20.0, 60.0]), np.zeros(2))
    soft = TRUCK._replace(
        tyre_stiffness_n_per_m=(3e4, 3e4), suspension_stiffness_n_per_m=(1e4, 1e4)
    )
    run = simulate(
        soft, beam, motion, under_wheels(flat, motion, soft.wheelbase_m, 1), Discretisation(step_s)
    )
    loads = np.array(static_axle_loads_n(soft, 9.80665))
    t = step_s * np.arange(steps)
    span = 30.0
    j = np.arange(1, 61)
    omega = j * np.pi * WAVE_M_PER_S / span
    drive = j * np.pi * speed / span

    def at(x: FloatArray, load: float, since: FloatArray) -> FloatArray:
        """Deflection at x of a force that came on at time `since` ago, while it is on."""
        forced = np.sin(np.outer(since, drive)) - drive / omega * np.sin(np.outer(since, omega))
        size = 2.0 * FLEXIBILITY_PER_N * WAVE_M_PER_S**2 / span / (omega**2 - drive**2)
        return -load * (np.sin(np.outer(x, j) * np.pi / span) * (size * forced)).sum(axis=1)

    front = motion.position_m
    rear = front - soft.wheelbase_m
    both = (front < span) & (rear > 0.0)
    expected = sum(
        at(front[both], load, (where[both]) / speed)
        for load, where in zip(loads, (front, rear), strict=True)
    )
    largest = np.abs(expected).max()
    assert np.abs(run.wheel_deflection_m[both, 0] - expected).max() < 0.02 * largest
    assert t.size == steps


@pytest.mark.parametrize("forward", [True, False], ids=["forward", "backward"])
def test_residual_vanishes_at_the_truth_of_a_deck_that_twists(forward: bool) -> None:
    driven = simulated(TRUCK, TWISTING, forward=forward)
    data = crossing(driven.case)._replace(torsion=torsion_of(TWISTING))
    left = in_noise(driven.case, residual(driven.case, point(driven.case), data=data))
    assert left.sum() < MAX_LEFT, left
    for factor in (0.0, 0.9):
        at = point(driven.case)
        at.theta[0, TORSION] *= factor
        wrong = in_noise(driven.case, residual(driven.case, at, data=data))
        assert wrong.sum() > 10.0 * MAX_LEFT, (factor, wrong)


def test_torsion_of_nothing_changes_nothing() -> None:
    """A deck that may twist and does not is the deck that may not, to the last bit."""
    driven = simulated(TRUCK, BEAM)
    data = crossing(driven.case)
    assert data.torsion is NO_TORSION
    may = data._replace(torsion=torsion_of(TWISTING))
    at = point(driven.case)
    without, stiff = (residual(driven.case, at, data=one) for one in (data, may))
    assert np.array_equal(without, stiff)


def test_residual_vanishes_for_slow_and_quick_torsion() -> None:
    for wave in (250.0, 800.0):
        beam = TWISTING._replace(torsional_wave_speed_m_per_s=wave)
        driven = simulated(TRUCK, beam)
        data = crossing(driven.case)._replace(torsion=torsion_of(beam))
        left = in_noise(driven.case, residual(driven.case, point(driven.case), data=data))
        assert left.sum() < MAX_LEFT, (wave, left)


def test_simulation_of_a_twisting_deck_needs_a_wave_speed() -> None:
    beam = BEAM._replace(torsional_flexibility_per_n=1e-12)
    motion = constant_speed(-2.0, 10.0, 10, STEP_S)
    flat = Profile(np.array([-20.0, 60.0]), np.zeros(2))
    road = under_wheels(flat, motion, TRUCK.wheelbase_m, 1)
    with pytest.raises(ValueError, match="wave speed"):
        simulate(TRUCK, beam, motion, road, Discretisation(STEP_S))


@pytest.mark.parametrize("supports", [(), (3,)])
def test_mean_receptance_is_that_of_waves_in_a_bar(supports: tuple[int, ...]) -> None:
    # Damped little, because the model's remainder beyond eight sines is not damped.
    beam = TWISTING._replace(interior_supports=supports, rayleigh_beta_s=1e-4)
    edges = np.concatenate([[0.0], np.cumsum(beam.element_lengths_m)])[[0, *supports, 7]]
    damping = beam.rayleigh_alpha_per_s, beam.rayleigh_beta_s
    omega = 2.0 * np.pi * np.array([0.01, 3.0, 9.0, 20.0, 40.0])
    theta = from_models(TRUCK, beam)
    found = theta[TORSION] * mean_receptance(torsion_of(beam), theta, omega)
    expected = FLEXIBILITY_PER_N * bar_receptance(np.diff(edges), WAVE_M_PER_S, damping, omega)
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()
