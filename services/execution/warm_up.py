"""Compile the numerical kernels ahead of time: `python -m services.execution.warm_up`.

numba stores the compiled form next to the sources, for every later start of any command. It notices
a change of a kernel's own file, but not of another kernel that it has inlined: so everything is
compiled again when any source is newer than its compiled form.

`make install` ends with this. An installation must not fail for lack of a cache (a read-only
folder, a processor that the compiler does not know): the first command then compiles for itself.
The image of the containers is built with `--strict`.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from pre_core import parameters
from pre_core.crossing import posterior
from pre_core.crossing.compliances import draws, from_normal
from pre_core.crossing.preparation import CrossingInputs, build_problem
from pre_core.crossing.whitening import solve_transposed
from pre_core.paper import experiment, least_squares, random_walk, residual
from pre_core.paper.integrate import spline_integrate
from pre_core.paper.window import MeasuredCrossing, build_window
from pre_core.physics.models import from_models
from pre_core.physics.simulate import constant_speed
from pre_core.physics.vehicle import total_mass_kg
from pre_core.search import loop

PACKAGE = Path(parameters.__file__).parent
_SOUND = experiment.beam(np.ones(experiment.ELEMENTS))


def main(*, strict: bool = False) -> int:
    """Compile missing kernels of identifications, and print begin and end.

    Return 0, or 1 on failure if `strict`. An image is built with `strict`: otherwise every start of
    a container would compile again.
    """

    def compile_all() -> None:
        _remove_stale(PACKAGE)
        if not any(PACKAGE.rglob("__pycache__/*.nbi")):
            sys.stdout.write("compiling kernels, about a minute, once\n")
            sys.stdout.flush()
        warm_up()

    return report_on(compile_all, "kernels", strict=strict)


def report_on(compile_all: Callable[[], None], what: str, *, strict: bool = False) -> int:
    """Compile kernels and print how long it took; return 0, or 1 on failure if `strict`."""
    began = time.perf_counter()
    try:
        compile_all()
    except Exception as error:  # noqa: BLE001, RUF100 - see the module's docstring
        why = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        sys.stdout.write(f"{what} not compiled, the first command will do it ({why})\n")
        return int(strict)
    sys.stdout.write(f"{what} compiled ({time.perf_counter() - began:.0f} s)\n")
    return 0


def warm_up() -> None:
    """Run every kernel of an identification once, for all methods, on crossings of noise.

    It is for processes that must not wait for a compiler when the first truck arrives.
    """
    _warm_up_pre()
    _warm_up_fusing()
    _warm_up_paper()


def _warm_up_fusing() -> None:
    """Run the kernels of a fusion.

    The sampler's bridge has one element, and no supports that might be absent.
    """
    one, nowhere = np.ones(1), np.zeros(0, dtype=np.int64)
    density = from_normal(
        np.eye(2), np.ones(2), np.ones(1, dtype=np.int64), nowhere, one, np.zeros(2), one
    )
    draws(density, 1, 0, 0)
    solve_transposed(np.ones((1, 1)), one, one.copy())


def _warm_up_pre() -> None:
    """Run the kernels of method `pre`, on four seconds of noise at 10 m/s."""
    nominal = from_models(experiment.TRUCK, _SOUND)
    step_s, count = 0.002, 2700
    time_s = step_s * np.arange(0, count, 50, dtype=np.float64)
    fixes = posterior.ChainageFixes(
        time_s, experiment.SPEED_M_PER_S * time_s - 10.0, np.full(time_s.size, 10.0), 0.4, 0.07, 1.5
    )
    inputs = CrossingInputs(
        np.random.default_rng(0).standard_normal((4, count)),
        0.0,
        step_s,
        1,
        experiment.SPAN_M,
        np.full(experiment.ELEMENTS, experiment.SPAN_M / experiment.ELEMENTS),
        (),
        total_mass_kg(experiment.TRUCK),
        1.0,
        np.full(4, 1e-3),
        500.0,
        fixes,
        posterior.Priors(
            nominal,
            np.full(nominal.size, 0.1),
            nominal == 0.0,
            np.full(nominal.size, True),
            np.zeros(nominal.size),
            experiment.TRUCK.wheelbase_m,
            0.002,
            0.01,
            0.01,
            0.0005,
        ),
        2,
        1,
        torsional_wave_speed_m_per_s=400.0,
    )
    problem, y = build_problem(inputs)
    posterior.all_rows(problem, y[None, :])
    posterior.filtered_rows(problem, y)
    posterior.wheel_profiles(problem, y)


def _warm_up_paper() -> None:
    """Run the kernels of the paper's residual and searches, on noise from five metres before."""
    step_s = 0.01
    motion = constant_speed(-5.0, experiment.SPEED_M_PER_S, 450, step_s)
    window = build_window(
        MeasuredCrossing(
            np.random.default_rng(0).standard_normal((4, motion.position_m.size)),
            step_s,
            motion.position_m,
            1,
            element_lengths_m=np.full(experiment.ELEMENTS, experiment.SPAN_M / experiment.ELEMENTS),
            total_mass_kg=total_mass_kg(experiment.TRUCK),
            wheelbase_m=experiment.TRUCK.wheelbase_m,
            integrate=spline_integrate,
            initial_state_known=False,
            bias_known=False,
        )
    )
    theta = from_models(experiment.TRUCK, _SOUND)
    free = parameters.paper_subset(experiment.ELEMENTS)
    problem = least_squares.LeastSquaresProblem(window, theta, free)
    work = residual.workspace(window)
    loop.run_search(
        partial(least_squares.init, problem, work, theta[free]),
        partial(least_squares.step, problem, work),
        1,
    )
    residual.objective(window, work, theta)
    walk = random_walk.problem(window, theta, free, 0, threads=1)
    random_walk.step(walk, random_walk.init(walk, particles=1))


def _remove_stale(package: Path) -> None:
    newest = max(source.stat().st_mtime for source in package.rglob("*.py"))
    compiled = [*package.rglob("__pycache__/*.nbi"), *package.rglob("__pycache__/*.nbc")]
    if any(file.stat().st_mtime < newest for file in compiled):
        for file in compiled:
            file.unlink(missing_ok=True)


if __name__ == "__main__":
    sys.exit(main(strict="--strict" in sys.argv[1:]))
