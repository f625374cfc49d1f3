"""Every way to search keeps one contract, and least squares finds the truth of the paper's data.

The data are the paper's own set-up: simulated with the mesh and the step that the search uses.
"""

import pickle
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.optimize import least_squares as least_squares_of_scipy

from pre_core import parameters
from pre_core.paper import experiment, least_squares, random_walk, residual
from pre_core.paper.crossing import paper_window
from pre_core.paper.window import PaperWindow
from pre_core.physics.models import from_models
from pre_core.search import levenberg_marquardt, loop
from pre_core.search.loop import Termination
from studies.paper.scenarios import DERIVED, NAMES, table_columns

NOMINAL = from_models(experiment.TRUCK, experiment.beam(np.ones(experiment.ELEMENTS)))
FREE = parameters.paper_subset(experiment.ELEMENTS)
PARTICLES = 12

State = Any
Step = Callable[[State], tuple[State, Any]]


class Method(NamedTuple):
    """A search bound to data: `bind(window, seed, threads)` gives its init and step."""

    bind: Callable[[PaperWindow, int, int], tuple[Callable[[], State], Step]]
    steps: int  # enough to see it move
    endings: frozenset[Termination]  # how it may end on sound data


def bind_random_walk(
    window: PaperWindow, seed: int, threads: int
) -> tuple[Callable[[], State], Step]:
    bound = random_walk.problem(window, NOMINAL, FREE, seed, threads=threads)
    return partial(random_walk.init, bound, PARTICLES), partial(random_walk.step, bound)


def bind_least_squares(
    window: PaperWindow, seed: int, threads: int
) -> tuple[Callable[[], State], Step]:
    bound = least_squares.LeastSquaresProblem(window, NOMINAL, FREE)
    work = residual.workspace(window)
    start = NOMINAL[FREE] * np.random.default_rng(seed).uniform(0.8, 1.2, FREE.size)
    return (
        partial(least_squares.init, bound, work, start),
        partial(least_squares.step, bound, work),
    )


def small_rows(window: PaperWindow) -> levenberg_marquardt.Rows:
    """Rows (k, 4) of three unknowns, not linear; not finite where the window's data are not."""
    sound = 1.0 + 0.0 * float(np.mean(window.acceleration))

    def rows(y: np.ndarray) -> np.ndarray:
        columns = [np.exp(y[:, 0]) - 2.0, y[:, 0] * y[:, 1] - 0.5, 3.0 * (y[:, 2] + 0.4), y[:, 1]]
        return sound * np.stack(columns, axis=1)

    return rows


LOWER = np.array([-np.inf, -np.inf, 0.0])  # of small_rows: the third is held by its bound


def bind_bounded(window: PaperWindow, seed: int, threads: int) -> tuple[Callable[[], State], Step]:
    """Levenberg and Marquardt's steps of any problem, with bounds."""
    rows = small_rows(window)
    start = np.random.default_rng(seed).uniform(0.5, 1.5, 3)
    return (
        partial(levenberg_marquardt.initial_state, rows, start),
        partial(levenberg_marquardt.descend, rows, lower=LOWER),
    )


METHODS = {
    "random_walk": Method(bind_random_walk, 30, frozenset({Termination.STEPS_EXHAUSTED})),
    "least_squares": Method(bind_least_squares, 30, frozenset({Termination.CONVERGED})),
    "levenberg_marquardt": Method(bind_bounded, 30, frozenset({Termination.CONVERGED})),
}


@pytest.fixture(params=METHODS)
def method(request: pytest.FixtureRequest) -> Method:
    return METHODS[request.param]


def data_of(scenario: int) -> PaperWindow:
    return paper_window(
        experiment.TRUCK, experiment.beam(experiment.scenario_ratios(scenario)), 0.0, 0
    )


@pytest.fixture(scope="module")
def window() -> PaperWindow:
    return data_of(6)


def frozen(state: State) -> tuple[object, ...]:
    """Bit for bit what a state holds."""
    return tuple(
        (part.shape, part.tobytes()) if isinstance(part, np.ndarray) else part for part in state
    )


def stored(state: State) -> State:
    """A state as it comes back from a file."""
    return pickle.loads(pickle.dumps(state))  # noqa: S301 - written a moment ago


def check_pure(init: Callable[[], State], step: Step) -> None:
    """The same state gives the same next state and the same info, and is itself left alone."""
    first = init()
    assert frozen(init()) == frozen(first)
    for _ in range(3):
        before = frozen(first)
        following, info = step(first)
        assert frozen(first) == before
        again, info_again = step(stored(first))
        assert frozen(again) == frozen(following)
        assert info_again == info
        first = following


def test_a_step_follows_from_the_state_alone(method: Method, window: PaperWindow) -> None:
    check_pure(*method.bind(window, 3, 2))


def test_a_step_with_a_memory_is_caught(window: PaperWindow) -> None:
    init, step = bind_random_walk(window, 3, 2)
    generator = np.random.default_rng(0)

    def remembers(
        state: random_walk.RandomWalkState,
    ) -> tuple[random_walk.RandomWalkState, random_walk.RandomWalkInfo]:
        following, info = step(state)
        return following._replace(ratios=following.ratios * generator.uniform()), info

    with pytest.raises(AssertionError):
        check_pure(init, remembers)


def test_a_step_that_changes_its_argument_is_caught(window: PaperWindow) -> None:
    init, step = bind_random_walk(window, 3, 2)

    def scribbles(
        state: random_walk.RandomWalkState,
    ) -> tuple[random_walk.RandomWalkState, random_walk.RandomWalkInfo]:
        state.ratios[0] = 1.0
        return step(state)

    with pytest.raises(AssertionError):
        check_pure(init, scribbles)


def test_the_seed_decides(method: Method, window: PaperWindow) -> None:
    ends = [
        frozen(loop.run_search(*method.bind(window, seed, 2), method.steps)[0])
        for seed in (5, 5, 6)
    ]
    assert ends[0] == ends[1]
    assert ends[0] != ends[2]


def test_the_number_of_threads_changes_nothing(method: Method, window: PaperWindow) -> None:
    ends = {
        frozen(loop.run_search(*method.bind(window, 5, threads), method.steps)[0])
        for threads in (1, 2, 3)
    }
    assert len(ends) == 1


def test_a_stopped_and_resumed_search_is_the_uninterrupted_one(
    method: Method, window: PaperWindow
) -> None:
    init, step = method.bind(window, 2, 2)
    whole, infos, _ = loop.run_search(init, step, 6)
    half, first_infos, _ = loop.run_search(init, step, 2)
    _, other_step = method.bind(window, 2, 2)  # as a new process would
    resumed, last_infos, _ = loop.run_search(lambda: stored(half), other_step, 4)
    assert frozen(resumed) == frozen(whole)
    assert first_infos + last_infos == infos


@pytest.mark.parametrize("name", METHODS)
def test_the_objective_never_grows(name: str, window: PaperWindow) -> None:
    method = METHODS[name]
    init, step = method.bind(window, 7, 2)
    state = init()
    objective = [float(np.min(state.objective))]
    for _ in range(method.steps):
        state, info = step(state)
        objective.append(info.objective)
        if info.ending is not None:
            break
    assert np.all(np.diff(objective) <= 0.0)
    assert objective[-1] < objective[0]


def test_sound_data_end_as_announced(method: Method, window: PaperWindow) -> None:
    _, infos, ending = loop.run_search(*method.bind(window, 1, 2), method.steps)
    assert ending in method.endings
    assert len(infos) <= method.steps
    assert all(info.ending is None for info in infos[:-1])


def test_too_few_steps_are_an_ending_of_their_own(method: Method, window: PaperWindow) -> None:
    init, step = method.bind(window, 1, 2)
    assert loop.run_search(init, step, 1)[2] is Termination.STEPS_EXHAUSTED
    assert (
        loop.run_search(init, step, 1, at_limit=Termination.STEPS_DONE)[2] is Termination.STEPS_DONE
    )


@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_an_objective_that_is_not_finite_is_an_ending_not_an_exception(
    method: Method, window: PaperWindow, poison: float
) -> None:
    broken = window._replace(acceleration=np.full_like(window.acceleration, poison))
    _, infos, ending = loop.run_search(*method.bind(broken, 1, 2), method.steps)
    assert ending is Termination.NOT_FINITE
    assert len(infos) == 1


def test_progress_is_reported_once_a_step(method: Method, window: PaperWindow) -> None:
    outcome = []
    _, infos, _ = loop.run_search(
        *method.bind(window, 1, 2), 3, progress=lambda count, info: outcome.append((count, info))
    )
    assert outcome == list(enumerate(infos, start=1))


def test_every_ending_is_a_sentence() -> None:
    assert all(ending.value.endswith(".") and ending.value[0].isupper() for ending in Termination)
    assert len({ending.value for ending in Termination}) == len(Termination)


@pytest.mark.parametrize("differences", [levenberg_marquardt.FORWARD, levenberg_marquardt.CENTRAL])
def test_every_evaluation_of_a_step_is_counted(
    differences: levenberg_marquardt.DifferenceScheme,
) -> None:
    evaluated = []

    def rows(y: np.ndarray) -> np.ndarray:
        evaluated.append(len(y))
        return np.column_stack([np.exp(y) - 2.0, y[:, :1] * y[:, 1:2], np.ones(len(y))])

    state = levenberg_marquardt.initial_state(rows, np.zeros(3), differences)
    evaluated.clear()
    _, info = levenberg_marquardt.descend(rows, state)
    assert info.accepted
    assert info.evaluations == sum(evaluated)


def test_least_squares_ends_with_central_differences(window: PaperWindow) -> None:
    """The reference estimate shows what for: tests/process_replay/test_reference.py."""
    init, step = bind_least_squares(window, 3, 1)
    assert init().differences == levenberg_marquardt.FORWARD
    state, infos, ending = loop.run_search(init, step, least_squares.MAX_STEPS)
    assert ending is Termination.CONVERGED
    assert state.differences == levenberg_marquardt.CENTRAL
    assert state.objective <= min(info.objective for info in infos) * (1.0 + 1e-8)


def test_slopes_are_of_sixth_order() -> None:
    """A quicker function stands for a longer step; a polynomial of sixth degree is met exactly."""
    at = np.array([0.3, -0.2])

    def error(speed: float) -> float:
        slopes = levenberg_marquardt.sixth_order_jacobian(lambda y: np.sin(speed * y), at)
        return float(np.abs(slopes - np.diag(speed * np.cos(speed * at))).max() / speed)

    assert error(1.0) < 1e-13
    speeds = np.array([50.0, 100.0, 200.0])
    errors = [error(speed) for speed in speeds]
    order = np.polyfit(np.log(speeds), np.log(errors), 1)[0]
    assert order == pytest.approx(6.0, abs=0.2)
    scale = 300.0
    sixth = levenberg_marquardt.sixth_order_jacobian(lambda y: (scale * y) ** 6, at)
    expected = np.diag(6.0 * scale**6 * at**5)
    np.testing.assert_allclose(sixth, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


def test_the_covariance_of_linear_rows_is_that_of_the_textbook() -> None:
    rng = np.random.default_rng(5)
    matrix = rng.standard_normal((30, 4)) * np.array([1.0, 1e-3, 10.0, 0.1])
    data = rng.standard_normal(30)
    bottom, squares, _, _ = np.linalg.lstsq(matrix, data, rcond=None)
    found = levenberg_marquardt.gauss_newton_covariance(lambda y: y @ matrix.T - data, bottom)
    expected = np.linalg.inv(matrix.T @ matrix) * squares[0] / 26.0
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=0.0)


def test_a_kink_leaves_least_squares_stuck() -> None:
    state = levenberg_marquardt.initial_state(lambda y: 1.0 + np.abs(y), np.zeros(1))
    assert (
        levenberg_marquardt.descend(lambda y: 1.0 + np.abs(y), state)[1].ending is Termination.STUCK
    )


# Bounds


def scipys(rows: levenberg_marquardt.Rows, start: np.ndarray, lower: np.ndarray) -> np.ndarray:
    found = least_squares_of_scipy(
        lambda y: rows(y[None, :])[0],
        start,
        bounds=(lower, np.inf),
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    return np.asarray(found.x)


@pytest.mark.parametrize("seed", range(12))
def test_bounds_against_scipy(seed: int) -> None:
    """Exponentials of sums, half of the unknowns bounded at zero: some end there, some do not."""
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((14, 6))
    wanted = rng.standard_normal(6)
    data = np.exp(0.3 * matrix @ wanted) + 0.1 * rng.standard_normal(14)

    def rows(y: np.ndarray) -> np.ndarray:
        return np.exp(0.3 * y @ matrix.T) - data

    lower = np.array([0.0, 0.0, 0.0, -np.inf, -np.inf, -np.inf])
    start = np.array([0.5, 0.0, 0.5, 0.0, 0.0, 0.0])

    def within(y: np.ndarray) -> np.ndarray:
        assert np.all(y >= lower)
        return rows(y)

    near = levenberg_marquardt.minimise(within, start, 200, 1e-12, lower)
    assert near.ending is Termination.CONVERGED
    # Forward differences leave a slope; central ones, which reach beyond a bound, next to none.
    found = loop.run_search(
        lambda: levenberg_marquardt.initial_state(rows, near.state.y, levenberg_marquardt.CENTRAL),
        lambda state: levenberg_marquardt.descend(rows, state, lower),
        200,
    )
    assert found.ending is Termination.CONVERGED
    expected = scipys(rows, np.maximum(start, 1e-3), lower)
    np.testing.assert_allclose(found.state.y, expected, atol=1e-5)
    np.testing.assert_allclose(near.state.y, expected, atol=1e-3)
    ours = found.state.objective
    assert ours <= float(np.sum(rows(expected[None, :]) ** 2)) * (1.0 + 1e-10)
    at_bound = found.state.y[:3] == 0.0
    free = np.sum(rows(scipys(rows, start, np.full(6, -np.inf))[None, :]) ** 2)
    assert at_bound.any() == bool(ours > free * (1.0 + 1e-6))


@pytest.mark.parametrize("seed", range(4))
def test_slopes_that_are_led_on_end_at_the_same_bottom_for_less(seed: int) -> None:
    """Rows that bend, twelve unknowns, two of them at a bound; the count is of evaluations."""
    rng = np.random.default_rng(seed)
    matrix, bent = rng.standard_normal((60, 12)), 0.1 * rng.standard_normal((60, 12))
    aim = matrix @ rng.standard_normal(12)
    lower = np.where(np.arange(12) < 2, 0.5, -np.inf)
    asked = 0

    def rows(y: np.ndarray) -> np.ndarray:
        nonlocal asked
        asked += y.shape[0]
        return y @ matrix.T + (y**2) @ bent.T - aim

    start = np.where(np.arange(12) < 2, 0.5, 2.0)
    exact = levenberg_marquardt.minimise(rows, start, 100, 1e-9, lower)
    counted, asked = asked, 0
    found = levenberg_marquardt.minimise(rows, start, 100, 1e-9, lower, uses_broyden=True)
    assert found.ending is Termination.CONVERGED
    assert asked == 13 + sum(info.evaluations for info in found.infos)
    assert asked < 0.85 * counted
    # Forward differences leave this much.
    assert found.state.objective == pytest.approx(exact.state.objective, rel=1e-6)
    np.testing.assert_allclose(found.state.y, exact.state.y, atol=1e-3)
    assert np.all(found.state.y >= lower)


@pytest.mark.parametrize("uses_broyden", [False, True])
def test_a_point_far_off_is_turned_back_from_without_a_word(uses_broyden: bool) -> None:
    """Rows so large that their squares are infinite; warnings are errors here."""

    def rows(y: np.ndarray) -> np.ndarray:
        return np.where(np.abs(y) > 0.7, 1e200, np.tanh(y) - 0.5)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        start = np.array([0.69, -0.69])
        found = levenberg_marquardt.minimise(rows, start, 50, 1e-9, uses_broyden=uses_broyden)
    np.testing.assert_allclose(found.state.y, np.arctanh(0.5), atol=1e-4)


def test_at_its_bounds_a_search_ends_at_once() -> None:
    """Held coordinates promise nothing: at the bottom beside them no step is tried."""
    matrix = np.array([[1.0, 0.5], [0.0, 1.0], [1.0, 0.0]])

    def rows(y: np.ndarray) -> np.ndarray:
        return y @ matrix.T + np.array([1.0, 1.0, 1.0])

    lower = np.zeros(2)
    state = levenberg_marquardt.initial_state(rows, np.zeros(2))
    _, info = levenberg_marquardt.descend(rows, state, lower)
    assert info.ending is Termination.CONVERGED
    assert info.evaluations == 0
    assert levenberg_marquardt.descend(rows, state)[1].accepted


# The random walk


def test_no_particle_of_the_random_walk_ever_climbs(window: PaperWindow) -> None:
    init, step = bind_random_walk(window, 9, 2)
    state = init()
    moved = np.zeros(PARTICLES, dtype=bool)
    for count in range(1, 41):
        following, info = step(state)
        assert np.all(following.objective <= state.objective)
        stayed = np.all(following.ratios == state.ratios, axis=1)
        assert info.acceptance == pytest.approx(np.mean(~stayed))
        assert np.all(following.objective[stayed] == state.objective[stayed])
        moved |= ~stayed
        assert following.steps == count
        state = following
    assert moved.all()


def test_a_descent_ends_with_the_first_step_that_gains_too_little() -> None:
    """Where the bottom lies far above zero, too: gain is what is left over, less."""

    def rows(y: np.ndarray) -> np.ndarray:
        return np.column_stack([np.sinh(y[:, 0]), np.full(y.shape[0], 100.0)])

    found = levenberg_marquardt.minimise(rows, np.array([3.0]), 200, 1.0)
    assert found.ending is Termination.CONVERGED
    objectives = [info.objective for info in found.infos]
    gains = -np.diff([np.sinh(3.0) ** 2 + 1e4, *objectives])
    assert np.all(gains[:-1] >= 1.0)
    assert gains[-1] < 1.0


@pytest.mark.parametrize("uses_broyden", [False, True])
def test_a_descent_to_a_misfit_ends_where_a_thousandth_is_gained(uses_broyden: bool) -> None:
    def rows(y: np.ndarray) -> np.ndarray:
        return np.column_stack([np.sinh(y[:, 0]), np.full(y.shape[0], 100.0)])

    def steps(misfit: float) -> int:
        found = levenberg_marquardt.minimise(
            rows, np.array([3.0]), 200, 1e-9, uses_broyden=uses_broyden, misfit=misfit
        )
        assert found.ending is Termination.CONVERGED
        return len(found.infos)

    exact, rough = steps(np.inf), steps(4999.0)
    assert steps(6000.0) == exact
    assert rough < exact


def test_the_random_walk_begins_in_the_papers_prior(window: PaperWindow) -> None:
    bound = random_walk.problem(window, NOMINAL, FREE, 0)
    ratios = random_walk.init(bound, 2000).ratios
    assert ratios.shape == (2000, 19)
    assert 0.8 <= ratios.min() < 0.801
    assert 1.199 < ratios.max() <= 1.2
    # The mean of 2000 uniform numbers of this width spreads by 0.0026.
    assert np.abs(ratios.mean(axis=0) - 1.0).max() < 5 * 0.4 / np.sqrt(12 * 2000)


def test_the_particles_objective_is_their_own(window: PaperWindow) -> None:
    """Early stopping of an evaluation must not leave a wrong J with an accepted particle."""
    init, step = bind_random_walk(window, 4, 2)
    state, _, _ = loop.run_search(init, step, 25)
    theta = np.repeat(NOMINAL[None, :], PARTICLES, axis=0)
    theta[:, FREE] *= state.ratios
    rows = residual.residual_batch(window, residual.workspace(window), theta)
    assert np.sum(rows**2, axis=1) == pytest.approx(state.objective, rel=1e-9)


def test_impossible_particles_are_never_kept(window: PaperWindow) -> None:
    """A step as large as the values themselves proposes negative masses all the time."""
    bound = random_walk.problem(window, NOMINAL, FREE, 0, step_ratio=0.5)
    first = random_walk.init(bound, 60)
    anything_is_better = first._replace(objective=np.full(60, 1e30))
    state, info = random_walk.step(bound, anything_is_better)
    assert 0.1 < info.acceptance < 0.9
    assert np.all(state.ratios > 0.0)
    assert np.all(state.ratios[:, 0] * NOMINAL[parameters.D_1] < window.wheelbase_m)


# Least squares


def worst_accuracy(window: PaperWindow, truth: np.ndarray, seed: int) -> float:
    """The smallest S_A of all twenty parameters from a random start in the paper's prior."""
    init, step = bind_least_squares(window, seed, 1)
    state, _, ending = loop.run_search(init, step, least_squares.MAX_STEPS)
    if ending is not Termination.CONVERGED:
        return -np.inf
    bound = least_squares.LeastSquaresProblem(window, NOMINAL, FREE)
    ratios = least_squares.untransform(bound, state.y)[None, :] / NOMINAL[FREE]
    found = table_columns(ratios, nominal=NOMINAL, free=FREE, window=window)[0]
    return float(1.0 - np.abs(found - truth).max())


def truth_of(scenario: int) -> np.ndarray:
    truth = np.ones(len(NAMES))
    first = NAMES.index("EI_1")
    truth[first : first + experiment.ELEMENTS] = experiment.scenario_ratios(scenario)
    return truth


@pytest.mark.parametrize(("scenario", "starts"), [(9, 20), (12, 5)])
def test_least_squares_finds_everything_from_anywhere_in_the_prior(
    scenario: int, starts: int
) -> None:
    window = data_of(scenario)
    accuracy = [worst_accuracy(window, truth_of(scenario), seed) for seed in range(starts)]
    assert min(accuracy) >= 0.999


def test_wrong_data_and_wrong_truths_are_not_called_found(window: PaperWindow) -> None:
    """The check above must be able to fail."""
    truth = truth_of(6)
    assert worst_accuracy(window, truth, 0) >= 0.999
    wrong = truth.copy()
    wrong[NAMES.index("EI_4")] = 0.41
    assert worst_accuracy(window, wrong, 0) < 0.999
    inverted = window._replace(
        acceleration=window.acceleration * np.array([[1.0], [1.0], [-1.0], [1.0]])
    )
    assert worst_accuracy(inverted, truth, 0) < 0.999
    heavier = window._replace(total_mass_kg=1.02 * window.total_mass_kg)
    assert worst_accuracy(heavier, truth, 0) < 0.999


def test_derived_masses_follow_from_d_1_and_the_axles(window: PaperWindow) -> None:
    ratios = np.ones((1, FREE.size))
    ratios[0, list(FREE).index(parameters.D_1)] = 1.2
    columns = table_columns(ratios, nominal=NOMINAL, free=FREE, window=window)[0]
    found = dict(zip(NAMES, columns, strict=True))
    d_1, wheelbase = 1.215, 4.4  # Table 1
    assert found["m_s1"] == pytest.approx((wheelbase - 1.2 * d_1) / (wheelbase - d_1))
    assert found["m_s2"] == pytest.approx(1.2)
    assert {found[name] for name in NAMES if name not in DERIVED} == {1.0}
