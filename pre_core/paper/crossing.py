"""One simulated crossing of the paper's experiment, prepared for its residual."""

import numpy as np

from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.paper import experiment
from pre_core.paper.integrate import newmark_integrate
from pre_core.paper.window import MeasuredCrossing, PaperWindow, build_window
from pre_core.physics.bridge import Beam
from pre_core.physics.road import iso_8608_profile, under_wheels
from pre_core.physics.simulate import Discretisation, constant_speed, simulate
from pre_core.physics.vehicle import HalfCar, total_mass_kg

ROAD_CLASS = "B"
ROAD_SEED = 1
"""Seed of the road. The paper's is not published; studies/reproduction.md shows the effect of
another one."""


def paper_window(
    car: HalfCar,
    beam: Beam,
    noise_ug_per_rthz: float,
    seed: int,
    *,
    road: tuple[str, int] = (ROAD_CLASS, ROAD_SEED),
) -> PaperWindow:
    """Simulate the paper's experiment (Table 4), optionally with white sensor noise.

    `noise_ug_per_rthz` is one-sided; `road` is an ISO 8608 class and the seed of its phases. Raise
    ArithmeticError if the forces do not converge.
    """
    span = float(beam.element_lengths_m.sum())
    travel = span + car.wheelbase_m - experiment.FRONT_AXLE_START_M
    steps = round(travel / experiment.SPEED_M_PER_S / experiment.STEP_S) + 10
    motion = constant_speed(
        experiment.FRONT_AXLE_START_M, experiment.SPEED_M_PER_S, steps, experiment.STEP_S
    )
    reach = np.ceil(car.wheelbase_m) + 1.0
    begin, end = experiment.FRONT_AXLE_START_M - reach, np.ceil(span + reach)
    profile = iso_8608_profile(begin, end, 0.01, *road)
    ground = under_wheels(profile, motion, car.wheelbase_m, 1)
    run = simulate(car, beam, motion, ground, Discretisation(experiment.STEP_S))
    if not run.converged:
        raise ArithmeticError("the simulation did not converge")
    acceleration = np.ascontiguousarray(run.acceleration_m_per_s2.T)
    if noise_ug_per_rthz > 0.0:
        sigma = noise_ug_per_rthz * MICRO_G_M_PER_S2 * np.sqrt(0.5 / experiment.STEP_S)
        rng = np.random.default_rng(np.random.SeedSequence([seed, 0x6E]))
        acceleration = acceleration + sigma * rng.standard_normal(acceleration.shape)
    return build_window(
        MeasuredCrossing(
            acceleration,
            experiment.STEP_S,
            motion.position_m,
            1,
            element_lengths_m=beam.element_lengths_m,
            total_mass_kg=total_mass_kg(car),
            wheelbase_m=car.wheelbase_m,
            integrate=newmark_integrate,
            initial_state_known=True,
        )
    )
