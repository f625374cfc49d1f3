"""Has the kernels compiled (or their compiled form loaded) before the first truck comes."""

from functools import partial

import numpy as np

from pre_core import least_squares, paper, parameters, residual, search
from pre_core.integrate import spline_integrate
from pre_core.simulate import constant_speed


def warm_up() -> None:
    """Run every kernel of an identification once, on a crossing of noise."""
    step_s = 0.01
    motion = constant_speed(-5.0, paper.SPEED_M_PER_S, 450, step_s)
    acceleration = np.random.default_rng(0).standard_normal((4, motion.position_m.size))
    window = residual.build_window(
        acceleration,
        step_s,
        motion.position_m,
        1,
        element_lengths_m=np.full(paper.ELEMENTS, paper.SPAN_M / paper.ELEMENTS),
        total_mass_kg=9530.0,
        wheelbase_m=paper.TRUCK.wheelbase_m,
        integrate=spline_integrate,
        initial_state_known=False,
        bias_known=False,
    )
    theta = parameters.from_models(paper.TRUCK, paper.beam(np.ones(paper.ELEMENTS)))
    free = parameters.paper_subset(paper.ELEMENTS)
    problem = least_squares.Problem(window, theta, free)
    work = residual.workspace(window)
    search.run(
        partial(least_squares.init, problem, work, theta[free]),
        partial(least_squares.step, problem, work),
        1,
    )
    residual.objective(window, work, theta)
