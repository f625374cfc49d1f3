"""Times of the kernels and searches, with a plain implementation beside them."""

import itertools
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from pre_core.paper import experiment, least_squares, random_walk, residual
from pre_core.physics.simulate import simulate
from pre_core.search import loop
from tests.benchmarks import cases, plain_numpy

BATCH = 500


def test_one_evaluation_alone(benchmark: BenchmarkFixture) -> None:
    window = cases.paper_window(cases.SCENARIO)
    work = residual.workspace(window)
    vectors = itertools.cycle(cases.particles(BATCH))
    benchmark.pedantic(
        lambda theta: residual.objective(window, work, theta),
        setup=lambda: ((next(vectors),), {}),
        rounds=2000,
        warmup_rounds=50,
    )


def test_one_evaluation_of_500(benchmark: BenchmarkFixture) -> None:
    window = cases.paper_window(cases.SCENARIO)
    work = residual.workspace(window)
    vectors = cases.particles(BATCH)
    limit, total = np.full(BATCH, np.inf), np.empty(BATCH)
    benchmark.pedantic(
        residual.objective_batch,
        args=(window, work, vectors, limit, total),
        rounds=30,
        warmup_rounds=2,
    )
    benchmark.extra_info["evaluations"] = BATCH


@pytest.mark.parametrize(
    "plain", [plain_numpy.objective, plain_numpy.objective_with_filters], ids=["nodal", "filters"]
)
def test_plain_numpy(
    benchmark: BenchmarkFixture, plain: Callable[[plain_numpy.Prepared, cases.Floats], float]
) -> None:
    window = cases.paper_window(cases.SCENARIO)
    prepared = plain_numpy.prepare(window, experiment.ELEMENTS, experiment.SPAN_M)
    vectors = itertools.cycle(cases.particles(20))
    benchmark.pedantic(
        lambda theta: plain(prepared, theta),
        setup=lambda: ((next(vectors),), {}),
        rounds=20,
        warmup_rounds=1,
    )


def test_paper_search(benchmark: BenchmarkFixture) -> None:
    window = cases.paper_window(cases.SCENARIO)
    walk = random_walk.problem(window, cases.NOMINAL, cases.FREE, seed=1)
    random_walk.init(walk, 8)  # compiled, or loaded

    def whole_search() -> random_walk.RandomWalkState:
        state, _, _ = loop.run_search(
            partial(random_walk.init, walk),
            partial(random_walk.step, walk),
            random_walk.STEPS,
            at_limit=loop.Termination.STEPS_DONE,
        )
        return state

    state = benchmark.pedantic(whole_search, rounds=3)
    benchmark.extra_info["evaluations"] = random_walk.PARTICLES * (random_walk.STEPS + 1)
    mean = cases.accuracy(state.ratios.mean(axis=0), cases.SCENARIO)
    benchmark.extra_info["worst_accuracy"] = float(mean.min())


def test_least_squares(benchmark: BenchmarkFixture) -> None:
    window = cases.paper_window(cases.SCENARIO)
    problem = least_squares.LeastSquaresProblem(window, cases.NOMINAL, cases.FREE)
    work = residual.workspace(window)
    nominal = cases.NOMINAL[cases.FREE]
    starts = iter(cases.start_ratios(21, seed=2))
    worst, steps, evaluations = [], [], []

    def from_start(start: cases.Floats) -> None:
        state, infos, _ = loop.run_search(
            partial(least_squares.init, problem, work, nominal * start),
            partial(least_squares.step, problem, work),
            least_squares.MAX_STEPS,
        )
        found = least_squares.untransform(problem, state.y) / nominal
        worst.append(float(cases.accuracy(found, cases.SCENARIO).min()))
        steps.append(len(infos))
        evaluations.append(cases.FREE.size + 1 + sum(info.evaluations for info in infos))

    benchmark.pedantic(from_start, setup=lambda: ((next(starts),), {}), rounds=20, warmup_rounds=1)
    benchmark.extra_info |= {
        "worst_accuracy": min(worst[1:]),
        "steps": float(np.median(steps[1:])),
        "evaluations": float(np.median(evaluations[1:])),
    }


def test_simulation(benchmark: BenchmarkFixture) -> None:
    drive = cases.paper_drive()
    run = benchmark.pedantic(
        simulate,
        args=(experiment.TRUCK, drive.beam, drive.motion, drive.road, experiment.STEP_S),
        rounds=30,
        warmup_rounds=1,
    )
    benchmark.extra_info["steps"] = run.displacement_m.shape[0]
    benchmark.extra_info["iterations"] = run.iterations
