"""Accelerations are the same for a heavier truck on a bridge that is as much stiffer."""

from collections import defaultdict

import numpy as np

from pre_core import parameters
from pre_core.arrays import FloatArray
from pre_core.paper import experiment
from pre_core.physics.models import beam_from, from_models
from pre_core.physics.road import Profile, under_wheels
from pre_core.physics.simulate import Discretisation, constant_speed, simulate
from pre_core.physics.vehicle import HalfCar, total_mass_kg

STEP_S = 0.005
CAR = experiment.TRUCK._replace(pitch_inertia_ratio=1.3, tyre_damping_ns_per_m=(700.0, 900.0))
BEAM = experiment.beam(experiment.scenario_ratios(6))._replace(
    support_rotational_stiffness_nm_per_rad=(2e8, 1e8),
    support_compliance_m_per_n=(3e-10, 2e-10),
    torsional_flexibility_per_n=4e-10,
    torsional_wave_speed_m_per_s=380.0,
)


def car_from(theta: FloatArray, total_kg: float) -> HalfCar:
    fields = defaultdict(list)
    for row, value in zip(parameters.table(BEAM.flexural_rigidity_nm2.size), theta, strict=True):
        if row.part == parameters.TRUCK and row.name != "share":  # of a tandem
            fields[row.key].append(float(value))
    car = CAR._replace(
        **{key: tuple(pair) if len(pair) == 2 else pair[0] for key, pair in fields.items()}
    )
    return car._replace(body_mass_kg=total_kg - sum(car.unsprung_mass_kg))


def test_accelerations_stay_where_everything_follows_its_power_of_the_mass() -> None:
    """The equations of motion, divided by the mass: the fit's scale of all stiffnesses."""
    theta = from_models(CAR, BEAM)
    assert np.all(np.delete(theta, parameters.SHARE) != 0.0)
    factor = 1.7
    heavier = theta * factor ** parameters.mass_powers(BEAM.flexural_rigidity_nm2.size)
    x = np.arange(-20.0, 60.0, 0.05)
    road = Profile(x, 0.004 * np.sin(2.0 * np.pi * x / 7.3) ** 2)
    motion = constant_speed(-5.0, experiment.SPEED_M_PER_S, 700, STEP_S)

    def accelerations(of: FloatArray, mass_kg: float) -> FloatArray:
        car = car_from(of, mass_kg)
        beam = beam_from(of, BEAM.element_lengths_m)._replace(
            torsional_wave_speed_m_per_s=BEAM.torsional_wave_speed_m_per_s
        )
        felt = under_wheels(road, motion, car.wheelbase_m, 1)
        return simulate(car, beam, motion, felt, Discretisation(STEP_S)).acceleration_m_per_s2

    mass_kg = total_mass_kg(CAR)
    expected = accelerations(theta, mass_kg)
    found = accelerations(heavier, factor * mass_kg)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())
