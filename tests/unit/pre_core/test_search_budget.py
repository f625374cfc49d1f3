"""A search ends: the walk along the road has a reach, and the whole has a budget."""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from pre_core.crossing import (
    fit,
    frequency_continuation,
    misfit,
    optimum,
    posterior,
    refinement,
    walk,
)
from pre_core.crossing.fit import Optimum
from pre_core.crossing.misfit import OffBridgeFit
from pre_core.physics.tandem import NO_TANDEM
from pre_core.search.loop import Termination

BUDGET = optimum._Budget(evaluations=1000, chi2=fit.WORTH_COMPLETING_CHI2)
STRATEGY = fit.SearchStrategy(0, False, 4, False)


@pytest.fixture(autouse=True)
def compared_by_chi2(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins have no posterior density."""
    for module in (optimum, refinement):
        monkeypatch.setattr(
            module, "is_better", lambda one, other: one.chi2_per_dof < other.chi2_per_dof
        )


def found(chi2: float, evaluations: int, ending: Termination = Termination.CONVERGED) -> Any:
    """A stand-in for an optimum, as the choice among them sees it."""
    unknown: Any = SimpleNamespace(
        y=np.zeros(1),
        lines_hz=(),
        force=np.zeros(1),
        crossing=SimpleNamespace(tandem=NO_TANDEM),
        mismatch=SimpleNamespace(level_m3=np.zeros(1)),
    )
    return Optimum(unknown, unknown, ending, chi2, evaluations, 1)


def scanned(
    objective: Callable[[float], float],
    per_m: float,
    monkeypatch: pytest.MonkeyPatch,
    *,
    is_tandem: bool = False,
) -> tuple[list[walk.Placement], int]:
    """Scan with this objective of a shift; `per_m` is one over the offset's spread."""

    def look(shift: float, start: Any) -> Any:
        return walk.Placement(objective(shift), shift, start, np.zeros(0, np.int64)), 1

    bridge = SimpleNamespace(bridge=np.arange(3))
    monkeypatch.setattr(walk, "_local_fit", lambda problem, y, way: look)
    monkeypatch.setattr(walk, "layout", lambda problem: bridge)
    monkeypatch.setattr(walk, "has_tandem", lambda problem: is_tandem)
    problem: Any = SimpleNamespace(receiver_rows=np.array([[per_m]]))
    return walk.scan_offsets(problem, np.zeros(4), optimum._SIMPLEST)


def test_the_walk_has_a_reach_however_little_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The further away, the better it fits: only the reach ends this walk."""
    seen: list[float] = []

    def objective(shift: float) -> float:
        seen.append(shift)
        assert len(seen) < 1000
        return -abs(shift)

    _, evaluations = scanned(objective, 1e-9, monkeypatch)
    assert max(map(abs, seen)) < 40.0
    assert evaluations < 200


@pytest.mark.parametrize(("is_tandem", "chosen_m"), [(False, 0.75), (True, -3.0)])
def test_the_scan_passes_other_minima_of_a_tandem(
    is_tandem: bool, chosen_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objectives of a crossing whose receiver was three metres off, and of a minimum beside it."""

    def objective(shift: float) -> float:
        return min(438.0 + 5.0 * (shift - 0.75) ** 2, 422.0 + 40.0 * (shift + 3.0) ** 2)

    places, _ = scanned(objective, 0.55, monkeypatch, is_tandem=is_tandem)
    assert places[0].shift_m == pytest.approx(chosen_m, abs=1e-9)


@pytest.mark.parametrize(("is_tandem", "chosen_m"), [(False, -4.8), (True, 0.3)])
def test_neighbours_of_an_optimum_reach_as_far_as_the_receiver_errs(
    is_tandem: bool, chosen_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objectives like those of a crossing that ended five metres off; a tandem was scanned."""
    seen: list[float] = []

    def look(shift: float, start: Any) -> Any:
        seen.append(shift)
        value = min(466.0 + 10.0 * (shift - 0.3) ** 2, 449.0 + 20.0 * (shift + 5.0) ** 2)
        return walk.Placement(value, shift, start, np.zeros(0, np.int64)), 1

    bridge = SimpleNamespace(bridge=np.arange(3))
    monkeypatch.setattr(walk, "_local_fit", lambda problem, y, way: look)
    monkeypatch.setattr(walk, "layout", lambda problem: bridge)
    monkeypatch.setattr(walk, "has_tandem", lambda problem: is_tandem)
    here: Any = SimpleNamespace(
        problem=SimpleNamespace(receiver_rows=np.array([[1.0 / 1.5]])),
        state=SimpleNamespace(y=np.zeros(4)),
    )
    place, evaluations = walk.better_neighbour(here, STRATEGY)
    assert place is not None
    assert place.shift_m == pytest.approx(chosen_m, abs=1e-9)
    assert max(map(abs, seen)) < 3.0 * 1.5 + 0.6
    assert evaluations == len(seen) + 5


@pytest.mark.parametrize("each", [30_000, 60_000, 200_000])
def test_a_search_that_finds_no_fit_ends_within_its_budget(
    each: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    budgets: list[int] = []

    def from_places(problem: Any, y: Any, way: Any, report: Any, left: optimum._Budget) -> Any:
        budgets.append(left.evaluations)
        return found(5.0, each)

    monkeypatch.setattr(optimum, "_refine_candidates", from_places)
    monkeypatch.setattr(optimum, "build_problem", lambda inputs: (found(0.0, 0).problem, None))
    off_bridge = OffBridgeFit(np.zeros(1), 30.0, 10)
    monkeypatch.setattr(optimum, "fit_off_bridge", lambda one: off_bridge)
    monkeypatch.setattr(optimum, "strongest_line_at_hz", lambda problem, y: 0.0)
    monkeypatch.setattr(optimum, "is_accepted", lambda problem, chi2: chi2 < 1.5)
    inputs: Any = None
    best = optimum.find_optimum(inputs)
    assert min(budgets) > 0
    assert best.evaluations == each * len(budgets) + off_bridge.evaluations
    assert best.evaluations < optimum._MAX_EVALUATIONS + each
    assert best.ending is Termination.STEPS_EXHAUSTED


def test_a_fit_that_took_long_is_a_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimum, "_refine_candidates", lambda *_: found(1.0, 300_000))
    monkeypatch.setattr(optimum, "build_problem", lambda inputs: (found(0.0, 0).problem, None))
    monkeypatch.setattr(optimum, "is_accepted", lambda problem, chi2: chi2 < 1.5)
    inputs: Any = None
    assert optimum.find_optimum(inputs).ending is Termination.CONVERGED


@pytest.mark.parametrize(
    ("chi2", "rounds"),
    [
        ((26.0, 1.0), 1),
        ((24.0, 26.0, 1.0), 2),
        ((24.0, 22.0, 15.0, 10.0, 5.0, 2.0), 6),
        ((24.0, 23.0, 1.0), 2),
        ((2.2, 2.1, 1.0), 2),
        ((2.2, 1.99, 1.98, 1.98, 1.97, 1.97), 6),
        ((1.9, 1.9, 1.9, 1.9, 1.9, 1.9), 6),
    ],
)
def test_noise_rounds_end_at_a_misfit_that_stays(
    chi2: tuple[float, ...], rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = iter(chi2)
    monkeypatch.setattr(fit, "_descend", lambda _, y, *__, **___: (y, None, None, 1))
    monkeypatch.setattr(fit, "chi2_per_dof", lambda problem, y: next(left))

    def with_force(level: float) -> Any:
        mismatch = SimpleNamespace(level_m3=np.zeros(1))
        return SimpleNamespace(mismatch=mismatch, force=np.array([level]))

    *_, used = fit._fit_in_noise_rounds(
        with_force(1.0), np.zeros(1), np.eye(1), 6, lambda one, y: with_force(2.0 * one.force[0])
    )
    assert used == rounds


def test_a_hopeless_fit_is_not_repeated_with_free_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    where = SimpleNamespace(half_normal=np.arange(2), bridge=np.arange(2))
    monkeypatch.setattr(refinement, "layout", lambda _: where)
    monkeypatch.setattr(refinement, "_needs_other_bridges", lambda _: False)
    monkeypatch.setattr(refinement, "fit_all", lambda *_: (found(1.0, 7), 7))
    for chi2, used in ((24.0, 7), (26.0, 0)):
        restrained = found(chi2, 1)._replace(state=SimpleNamespace(y=np.ones(2)))
        better, evaluations = refinement.with_free_ends(restrained, STRATEGY)
        assert (better.chi2_per_dof, evaluations) == (1.0 if used else chi2, used)


def test_other_bridges_are_tried_until_two_sets_of_starts_fail(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sets: list[bool] = []
    chi2 = iter((4.0, 3.0, 3.5, 3.6, 3.7, 3.8))

    def others(_: Any, __: Any, *, is_even: bool) -> tuple[list[Any], int]:
        sets.append(is_even)
        gains = (3.0, 2.0, 1.0, -1.0)
        return [SimpleNamespace(y=np.full(1, one), gain=one) for one in gains], 10

    where = SimpleNamespace(bridge=np.arange(1), trajectory=slice(0, 1))
    monkeypatch.setattr(frequency_continuation, "layout", lambda _: where)
    monkeypatch.setattr(posterior, "layout", lambda _: where)
    monkeypatch.setattr(refinement, "other_bridges", others)
    monkeypatch.setattr(refinement, "_needs_other_bridges", lambda _: True)
    monkeypatch.setattr(refinement, "complete_fit", lambda one: one)
    monkeypatch.setattr(refinement, "fit_all", lambda *_: (found(next(chi2), 1), 1))
    best, evaluations = refinement.refined(found(3.9, 1), STRATEGY, 1000)
    # The second bridge of the first set is better; then two of each of the two sets are not.
    assert best.chi2_per_dof == 3.0
    assert sets == [True, False, True]
    assert evaluations == 3 * 10 + 6
    # Rivals of the last optimum are those of the two sets that failed, each once.
    assert [one[0] for one in best.rivals] == [3.0, 2.0, 1.0, -1.0]


@pytest.mark.parametrize(
    ("twin_m", "tandem", "level", "chi2", "is_tried"),
    [
        (0.0, False, 1.0, 1.0, True),
        (0.33, False, 1.0, 1.0, False),
        (0.0, True, 1.0, 1.0, False),
        (0.0, False, 0.0, 1.0, False),
        (0.0, False, 1.0, 26.0, False),
    ],
)
def test_other_bridges_are_tried_under_equal_tyres_only(
    twin_m: float,
    tandem: bool,
    level: float,
    chi2: float,
    is_tried: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    footprints = (SimpleNamespace(twin_distance_m=0.0), SimpleNamespace(twin_distance_m=twin_m))
    mismatch = SimpleNamespace(
        level_m3=np.array([level]), shapes=SimpleNamespace(footprints=footprints)
    )
    monkeypatch.setattr(refinement, "has_tandem", lambda _: tandem)
    one = found(chi2, 1)._replace(problem=SimpleNamespace(mismatch=mismatch))
    assert refinement._needs_other_bridges(one) is is_tried


@pytest.mark.parametrize(
    ("chi2", "force", "starts"),
    [
        ((201.0, 1.0), 1.0, 1),
        ((199.0, 26.0, 1.0), 1.0, 2),
        ((8.0, 7.7, 1.0), 1.0, 2),
        ((8.0, 9.0, 1.0), 1.0, 2),
        ((8.0, 7.7, 1.0), 0.0, 3),
        ((8.0, 7.5, 7.2, 1.0), 1.0, 3),
        ((1.9, 1.9, 1.9, 1.9), 1.0, 4),
    ],
)
def test_offsets_end_where_another_one_fits_no_better(
    chi2: tuple[float, ...], force: float, starts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    best = refined(iter(found(value, 1) for value in chi2), force, monkeypatch)
    assert (best.starts, best.chi2_per_dof) == (starts, min(chi2[:starts]))


@pytest.mark.parametrize(
    ("chi2", "starts", "reached", "evaluations"),
    [
        ((4.0, 3.9), 2, 1.0, 102),
        ((4.0, 3.0, 3.0), 3, 1.0, 103),
        ((6.0, 5.9), 2, 5.9, 2),
        ((4.0, 1.2), 2, 1.2, 2),
    ],
)
def test_the_best_of_poor_starts_is_completed_after_all_offsets(
    chi2: tuple[float, ...],
    starts: int,
    reached: float,
    evaluations: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(optimum, "complete_fit", completed)
    poor = (
        found(value, 1)._replace(unfinished=STRATEGY if value > 1.7 else None) for value in chi2
    )
    best = refined(poor, 0.0, monkeypatch)
    assert (best.starts, best.chi2_per_dof) == (starts, reached)
    assert best.evaluations == evaluations


@pytest.mark.parametrize(
    ("reached", "completes_below"), [((), 5.0), ((4.0,), 3.8), ((8.0, 2.0), 1.9), ((9.0,), 5.0)]
)
def test_a_poor_start_is_completed_only_if_it_may_fit_better(
    reached: tuple[float, ...], completes_below: float
) -> None:
    poor = found(1.8, 10)._replace(unfinished=STRATEGY)
    left = optimum._budget_left(1000, [poor, *(found(chi2, 100) for chi2 in reached)])
    assert left.chi2 == pytest.approx(completes_below)
    assert left.evaluations == 990 - 100 * len(reached)


@pytest.mark.parametrize(
    ("off_bridge", "level", "tried"),
    [(1.4, 0.0, "full weight"), (1.6, 0.0, "all"), (1.4, 1.0, "all"), (30.0, 1.0, "all")],
)
def test_other_trucks_are_tried_only_where_the_first_fails_off_the_bridge(
    off_bridge: float, level: float, tried: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = OffBridgeFit(np.zeros(1), off_bridge, 10)
    monkeypatch.setattr(optimum, "fit_off_bridge", lambda one: alone)
    monkeypatch.setattr(misfit, "levels_at", lambda problem, y: np.array([level]))
    strategies, fitted = optimum._other_strategies(found(5.0, 1))
    assert fitted is alone
    full_weight, reduced_weight = optimum._WITHOUT_MISMATCH
    everything = (reduced_weight, *optimum.WITH_MISMATCH, full_weight)
    assert strategies == ((full_weight,) if tried == "full weight" else everything)


@pytest.mark.parametrize("clear", ["stopped_by_mismatch", "stopped_by_friction"])
def test_clear_friction_and_mismatch_need_no_fit_off_the_bridge(
    clear: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_fit(one: Optimum) -> OffBridgeFit:
        raise AssertionError("the residuals off the bridge were fitted")

    monkeypatch.setattr(optimum, "fit_off_bridge", no_fit)
    strategies, alone = optimum._other_strategies(found(5.0, 1)._replace(**{clear: True}))
    assert (len(strategies), alone.evaluations) == (4, 0)
    assert not np.isfinite(alone.chi2)


@pytest.mark.parametrize(
    ("chi2", "lines", "tried"),
    [
        # Mismatch explains the line that a search without it ends with.
        ((4.0, 1.0), (True,), 2),
        # It does not: hum.
        ((4.0, 4.0), (True,), 2),
        ((4.0, 4.0), (False, True), 2),
        ((4.0, 4.0, 4.0, 4.0), (False, False, False, False), 4),
    ],
)
def test_a_line_ends_the_strategies_only_after_mismatch_was_tried(
    chi2: tuple[float, ...],
    lines: tuple[bool, ...],
    tried: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reached, shown = iter(chi2), iter(lines)
    full_weight, reduced_weight = optimum._WITHOUT_MISMATCH
    monkeypatch.setattr(optimum, "is_accepted", lambda _, value: value < 1.5)
    monkeypatch.setattr(optimum, "strongest_line_at_hz", lambda *_: 25.0 * next(shown))
    monkeypatch.setattr(optimum, "_refine_candidates", lambda *_: found(next(reached), 1))
    ended = optimum._try_strategies(
        SimpleNamespace(),  # type: ignore[arg-type]
        np.zeros(1),
        (reduced_weight, *optimum.WITH_MISMATCH, full_weight),
        found(5.0, 1),
        lambda *_: None,
        1000,
    )
    assert len(ended) == tried
    assert not list(shown)


@pytest.mark.parametrize(("chi2", "ends_at"), [((9.0, 8.0), 1.0), ((11.0, 12.0), 11.0)])
def test_without_a_fit_the_best_poor_start_is_completed(
    chi2: tuple[float, float], ends_at: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optimum, "complete_fit", completed)
    monkeypatch.setattr(optimum, "is_accepted", lambda _, value: value < 1.5)
    monkeypatch.setattr(optimum, "strongest_line_at_hz", lambda *_: 0.0)
    first, second = (found(value, 1)._replace(unfinished=STRATEGY) for value in chi2)
    monkeypatch.setattr(optimum, "_refine_candidates", lambda *_: first)
    monkeypatch.setattr(
        optimum, "_other_strategies", lambda _: ((), OffBridgeFit(np.zeros(1), np.inf, 0))
    )
    monkeypatch.setattr(optimum, "_try_strategies", lambda *_: [second])
    problem: Any = SimpleNamespace(crossing=SimpleNamespace(tandem=NO_TANDEM))
    ended = optimum._run_strategies(problem, np.zeros(1), lambda *_: None, 1000)
    assert len(ended) == 2
    assert min(one.chi2_per_dof for one in ended) == ends_at
    assert sum(one.evaluations for one in ended) == (102 if ends_at == 1.0 else 2)


@pytest.mark.parametrize(
    ("chi2", "best", "sets"),
    [
        # The first bridge about the truck is accepted, and no other is better.
        ((1.0, 3.0, 3.0, 3.0, 3.0), 1.0, 3),
        # From the third offset one is accepted.
        ((6.0, 3.0, 1.0, 2.0, 2.0, 2.0, 2.0), 1.0, 5),
        # An accepted bridge leads to a better one.
        ((1.2, 1.0, 1.1, 1.1), 1.0, 4),
        # None is accepted, and others are tried about the best.
        ((6.0, 5.0, 4.0, 5.0, 6.0, 7.0, 4.0, 3.0, 3.0, 3.0, 3.0, 3.0), 3.0, 9),
        # Fits that are not worth completing, and one that is hopeless.
        ((61.0, 70.0, 20.0, 30.0, 40.0, 50.0), None, 6),
        ((101.0,), None, 1),
        # A second start leads to the misfit that earlier fits reached, 9.
        ((11.0, 8.9), 8.9, 2),
        ((11.0, 8.7, 1.0, 3.0, 3.0, 3.0, 3.0), 1.0, 5),
        # Not where another start leads to less.
        ((4.0, 9.0, 1.0, 3.0, 3.0, 3.0, 3.0), 1.0, 5),
    ],
)
def test_other_bridges_about_a_truck_are_tried_as_long_as_they_fit_better(
    chi2: tuple[float, ...], best: float | None, sets: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    fits = iter(chi2)
    about = tried_bridges(fits, monkeypatch)
    first = found(5.0, 1)._replace(state=SimpleNamespace(y=np.zeros(1), _replace=moved))
    other, used = refinement.about_truck(first, np.full(1, 7.0), STRATEGY, 1000, 9.0)
    assert (other.chi2_per_dof if other else None) == best
    offsets = [(7.0, True), (5.8, True), (8.2, True), (7.0, False), (5.8, False), (8.2, False)]
    scanned = [one for one in about if one[0] > 1.0]
    assert scanned == offsets[: len(scanned)]
    assert [is_even for at, is_even in about if at <= 1.0] == [False, True, False, True][
        : sets - len(scanned)
    ]
    assert len(about) == sets
    assert used == 10 * sets + len(chi2)
    assert not list(fits)


def test_bridges_are_tried_until_all_evaluations_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    about = tried_bridges(iter((6.0, 5.0)), monkeypatch)
    first = found(5.0, 1)._replace(state=SimpleNamespace(y=np.zeros(1), _replace=moved))
    other, used = refinement.about_truck(first, np.full(1, 7.0), STRATEGY, 21, 9.0)
    assert other is not None
    assert (other.chi2_per_dof, used, len(about)) == (5.0, 22, 2)


def tried_bridges(
    reached: Iterator[float], monkeypatch: pytest.MonkeyPatch
) -> list[tuple[float, bool]]:
    """Replace fits by ones that reach these chi2; return the list of where bridges are tried."""
    about = []

    def others(one: Any, _: Any, *, is_even: bool) -> tuple[list[Any], int]:
        about.append((float(one.state.y[0]), is_even))
        return [SimpleNamespace(y=np.ones(1), gain=gain) for gain in (9.0, 8.0, 7.0, -1.0)], 10

    def fitted(*_: Any) -> tuple[Optimum, int]:
        chi2 = next(reached)
        return found(chi2, 1)._replace(unfinished=STRATEGY if chi2 > 12.0 else None), 1

    monkeypatch.setattr(refinement, "other_bridges", others)
    monkeypatch.setattr(refinement, "is_accepted", lambda _, value: value < 1.5)
    monkeypatch.setattr(
        refinement, "is_better", lambda one, other: one.chi2_per_dof < other.chi2_per_dof
    )
    monkeypatch.setattr(refinement, "_at_full_weight", lambda one, y: one._replace(state=moved(y)))
    monkeypatch.setattr(refinement, "complete_fit", lambda one: one)
    monkeypatch.setattr(refinement, "layout", lambda _: SimpleNamespace(trajectory=slice(0, 1)))
    monkeypatch.setattr(refinement, "fit_all", fitted)
    return about


def test_bridge_whose_fit_took_all_steps_is_fitted_on(monkeypatch: pytest.MonkeyPatch) -> None:
    tried_bridges(iter(()), monkeypatch)
    ends = iter((Termination.STEPS_EXHAUSTED, Termination.CONVERGED))
    bridge = [SimpleNamespace(y=np.ones(1), gain=9.0)]
    sets = iter((bridge, [], []))
    monkeypatch.setattr(refinement, "other_bridges", lambda *_, **__: (next(sets), 10))
    monkeypatch.setattr(refinement, "fit_all", lambda *_: (found(1.0, 1, next(ends)), 1))
    first = found(5.0, 1)._replace(state=SimpleNamespace(y=np.zeros(1), _replace=moved))
    other, used = refinement.about_truck(first, np.zeros(1), STRATEGY, 1000, 9.0)
    assert other is not None
    assert other.ending is Termination.CONVERGED
    assert used == 32


def moved(y: NDArray[np.float64]) -> Any:
    """Return a stand-in for a state at y (size,)."""
    return SimpleNamespace(y=y)


@pytest.mark.parametrize(
    ("chi2", "off_bridge", "reached", "ends_at"),
    [
        (5.0, 1.0, 1.0, [1.0]),
        # Hopeless, or the truck does not explain what is off the bridge, or nothing is better.
        (51.0, 1.0, 1.0, []),
        (5.0, 1.6, 1.0, []),
        (5.0, 1.0, 5.0, []),
        # The misfit is not on the bridge.
        (1.49, 1.495, 1.0, []),
    ],
)
def test_other_bridges_are_tried_where_only_the_bridge_is_not_explained(
    chi2: float,
    off_bridge: float,
    reached: float,
    ends_at: list[float],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(optimum, "is_accepted", lambda _, value: value < 1.4)
    monkeypatch.setattr(optimum, "strongest_line_at_hz", lambda *_: 0.0)
    monkeypatch.setattr(optimum, "complete_fit", lambda one: one)
    monkeypatch.setattr(misfit, "levels_at", lambda problem, y: np.zeros(1))
    monkeypatch.setattr(optimum, "about_truck", lambda *_: (found(reached, 1), 30))
    one = found(chi2, 4)
    alone = OffBridgeFit(np.zeros(1), off_bridge, 10)
    monkeypatch.setattr(optimum, "_refine_candidates", lambda *_: one)
    monkeypatch.setattr(optimum, "_other_strategies", lambda _: ((), alone))
    monkeypatch.setattr(optimum, "_try_strategies", lambda *_: [])
    problem: Any = SimpleNamespace(crossing=SimpleNamespace(tandem=NO_TANDEM))
    ended = optimum._run_strategies(problem, np.zeros(1), lambda *_: None, 1000)
    assert [other.chi2_per_dof for other in ended] == [chi2, *ends_at]
    is_tried = off_bridge < min(chi2, 1.49) and chi2 < 50.0
    assert sum(other.evaluations for other in ended) == 4 + 10 + 30 * is_tried


@pytest.mark.parametrize(
    ("force", "off_bridge", "reached", "ends_at", "evaluations"),
    [
        (1.0, 1.0, 1.01, 1.01, 46),
        # No bridge about the truck is likelier.
        (1.0, 1.0, 1.3, 1.2, 46),
        # The weight is full, or reduced off the bridge, too.
        (0.0, 1.0, 1.01, 1.2, 4),
        (1.0, 1.6, 1.01, 1.2, 16),
        (1.0, 1.21, 1.01, 1.2, 16),
    ],
)
def test_bridge_that_is_accepted_at_reduced_weight_alone_is_doubted(
    force: float,
    off_bridge: float,
    reached: float,
    ends_at: float,
    evaluations: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    alone = OffBridgeFit(np.zeros(1), off_bridge, 12)
    monkeypatch.setattr(misfit, "levels_at", lambda problem, y: np.zeros(1))
    monkeypatch.setattr(refinement, "is_accepted", lambda _, value: value < 1.4)
    monkeypatch.setattr(
        refinement, "is_better", lambda one, other: one.chi2_per_dof < other.chi2_per_dof
    )
    monkeypatch.setattr(refinement, "fit_off_bridge", lambda _: alone)
    monkeypatch.setattr(refinement, "about_truck", lambda *_: (found(reached, 1), 30))
    one = found(1.2, 4)
    one.problem.force = np.array([force])
    best = refinement.with_full_weight(one, STRATEGY, 1000)
    assert (best.chi2_per_dof, best.evaluations) == (ends_at, evaluations)


def completed(one: Optimum) -> Optimum:
    """Complete a stand-in: it reaches a chi2 of one after a hundred evaluations."""
    there: Optimum = found(1.0, one.evaluations + 100)._replace(problem=one.problem)
    return there


def refined(
    candidates: Iterator[Optimum], force: float, monkeypatch: pytest.MonkeyPatch
) -> Optimum:
    """Refine four offsets whose fits are these candidates."""
    problem: Any = SimpleNamespace(
        mismatch=SimpleNamespace(level_m3=np.zeros(1)), force=np.array([force]), front_axles=()
    )
    problem._replace = lambda **_: problem
    places = [walk.Placement(0.0, float(n), np.zeros(1), np.zeros(1, int)) for n in range(4)]
    monkeypatch.setattr(optimum, "_find_truck", lambda *_: (problem, np.zeros(1), 0))
    monkeypatch.setattr(optimum, "noise_power_ratio", lambda *_: 1.0)
    monkeypatch.setattr(optimum, "_has_clear_mismatch", lambda *_: False)
    monkeypatch.setattr(optimum, "scan_offsets", lambda *_: (places, 0))
    monkeypatch.setattr(optimum, "shifted_to", lambda _, y, place: y)
    monkeypatch.setattr(optimum, "is_accepted", lambda _, value: value < 1.5)
    monkeypatch.setattr(optimum, "with_free_ends", lambda best, _: (best, 0))
    monkeypatch.setattr(
        optimum, "fit_all", lambda *_: (next(candidates)._replace(problem=problem), 1)
    )
    return optimum._refine_likeliest(problem, np.zeros(1), STRATEGY, lambda *_: None, BUDGET)


class _Problem(NamedTuple):
    front_axles: object
    force: NDArray[np.float64]


def test_offsets_are_scanned_as_if_the_front_axle_were_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem: Any = _Problem("its spectra", np.zeros(1))
    seen: list[object] = []

    def find_truck(problem: Any, y: Any, *_: Any) -> tuple[Any, Any, int]:
        seen.append(problem.front_axles)
        return problem, y, 0

    def scan(problem: Any, y: Any, *_: Any) -> tuple[list[walk.Placement], int]:
        seen.append(problem.front_axles)
        return [walk.Placement(0.0, 0.0, np.zeros(1), np.zeros(1, int))], 0

    def fit_there(problem: Any, *_: Any) -> tuple[None, int]:
        seen.append(problem.front_axles)
        return None, 0

    monkeypatch.setattr(optimum, "_find_truck", find_truck)
    monkeypatch.setattr(optimum, "noise_power_ratio", lambda *_: 1.0)
    monkeypatch.setattr(optimum, "_has_clear_mismatch", lambda *_: False)
    monkeypatch.setattr(optimum, "scan_offsets", scan)
    monkeypatch.setattr(optimum, "shifted_to", lambda _, y, place: y)
    monkeypatch.setattr(optimum, "fit_all", fit_there)
    monkeypatch.setattr(optimum, "_no_optimum", lambda *_, **__: found(0.0, 1))
    optimum._refine_likeliest(problem, np.zeros(1), STRATEGY, lambda *_: None, BUDGET)
    assert seen == [(), (), "its spectra"]


@pytest.mark.parametrize(
    ("accepted", "free", "limits"),
    [
        (True, False, [fit._MAX_STEPS, fit._MORE_STEPS]),
        (False, False, [fit._MAX_STEPS]),
        (True, True, [fit._EARLY_STEPS]),
    ],
)
def test_fit_continues_where_its_steps_end_near_a_minimum(
    accepted: bool, free: bool, limits: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem: Any = SimpleNamespace(mismatch=SimpleNamespace(level_m3=np.ones(1)))
    taken: list[int] = []

    def steps(_: Any, y: Any, __: Any, ___: float, most: int, *____: Any, **_____: Any) -> Any:
        taken.append(most)
        ending = Termination.CONVERGED if len(taken) == 2 else Termination.STEPS_EXHAUSTED
        return problem, y, ending, 10 * most

    monkeypatch.setattr(fit, "_fit_in_noise_steps", steps)
    monkeypatch.setattr(fit, "chi2_per_dof", lambda *_: 1.0)
    monkeypatch.setattr(fit, "is_accepted", lambda *_: accepted)
    *_, ending, used = fit._fit_in_noise_rounds(
        problem, np.zeros(1), np.eye(1), 6, lambda one, y: one, is_free=free
    )
    assert taken == limits
    assert used == 10 * sum(limits)
    assert (ending is Termination.CONVERGED) == (len(limits) == 2)
