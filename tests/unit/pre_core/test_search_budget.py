"""A search ends: the walk along the road has a reach, and the whole has a budget."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pre_core.crossing import optimum, walk
from pre_core.crossing.fit import Optimum
from pre_core.crossing.truck_alone import OffBridgeFit
from pre_core.physics.tandem import NO_LEAD
from pre_core.search.loop import Termination


def found(chi2: float, evaluations: int, ending: Termination = Termination.CONVERGED) -> Any:
    """A stand-in for an optimum, as the choice among them sees it."""
    on_two_axles = SimpleNamespace(lead=NO_LEAD)
    unknown: Any = SimpleNamespace(
        y=np.zeros(1), lines_hz=(), crossing=on_two_axles, density=np.ones(4)
    )
    unknown._replace = lambda **_: unknown
    return Optimum(unknown, unknown, ending, chi2, evaluations, 1)


def test_the_walk_has_a_reach_however_little_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The further away, the better it fits: only the reach ends this walk."""
    seen: list[float] = []

    def look(shift: float, start: Any) -> Any:
        seen.append(shift)
        assert len(seen) < 1000
        return walk.Placement(-abs(shift), shift, start, np.zeros(0, np.int64)), 1

    bridge = SimpleNamespace(bridge=np.arange(3))
    monkeypatch.setattr(walk, "_local_fit", lambda problem, y, way: look)
    monkeypatch.setattr(walk, "layout", lambda problem: bridge)
    problem: Any = SimpleNamespace(receiver_rows=np.array([[1e-9]]))
    _, evaluations = walk.scan_offsets(problem, np.zeros(4), optimum._SIMPLEST)
    assert max(map(abs, seen)) < 40.0
    assert evaluations < 200


NOT_JUDGED: Any = OffBridgeFit(np.nan, False, None, np.zeros(1), 0)  # type: ignore[arg-type]


def stand_in(monkeypatch: pytest.MonkeyPatch, chi2: float, each: int) -> list[int]:
    """Every way ends at `chi2` after `each` evaluations; return the budgets that they get."""
    budgets: list[int] = []

    def from_places(problem: Any, y: Any, way: Any, report: Any, most: int) -> Any:
        budgets.append(most)
        return found(chi2, each)

    monkeypatch.setattr(optimum, "_refine_candidates", from_places)
    monkeypatch.setattr(optimum, "build_problem", lambda inputs: (found(0.0, 0).problem, None))
    monkeypatch.setattr(optimum, "levels_at", lambda problem, y: np.zeros(1))
    monkeypatch.setattr(optimum, "strongest_line_at_hz", lambda problem, y: 0.0)
    monkeypatch.setattr(optimum, "is_accepted", lambda problem, chi2: chi2 < 1.5)
    monkeypatch.setattr(optimum, "fit_off_bridge", lambda problem, y, **_: NOT_JUDGED)
    return budgets


@pytest.mark.parametrize(
    ("chi2", "most"),
    [(2.5, optimum._MAX_EVALUATIONS), (5.0, optimum._MAX_EVALUATIONS_OF_MISFIT)],
)
@pytest.mark.parametrize("each", [9_000, 20_000, 200_000])
def test_a_search_that_finds_no_fit_ends_within_its_budget(
    each: int, chi2: float, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    budgets = stand_in(monkeypatch, chi2, each)
    inputs: Any = None
    best = optimum.find_optimum(inputs)
    assert min(budgets) > 0
    assert best.evaluations == each * len(budgets)
    assert best.evaluations < most + each
    is_lost = best.evaluations > optimum._MAX_EVALUATIONS
    assert best.ending is (Termination.STEPS_EXHAUSTED if is_lost else Termination.CONVERGED)


@pytest.mark.parametrize("chi2", [2.5, 5.0])
def test_after_a_truck_that_fits_off_the_bridge_only_one_way_follows(
    chi2: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    budgets = stand_in(monkeypatch, chi2, 1000)
    fits = NOT_JUDGED._replace(chi2_per_dof=1.0, is_accepted=True)
    monkeypatch.setattr(optimum, "fit_off_bridge", lambda problem, y, **_: fits)
    monkeypatch.setattr(optimum, "_find_truck", lambda *_: (None, None, 10))
    monkeypatch.setattr(optimum, "refine_from_truck", lambda *_: (found(chi2 + 1.0, 100), None))
    inputs: Any = None
    best = optimum.find_optimum(inputs)
    assert (len(budgets), best.evaluations) == (1, 1110)
    assert best.chi2_per_dof == chi2
    assert best.fits_off_bridge


def test_a_fit_from_the_truck_off_the_bridge_is_no_misfit(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, 5.0, 1000)
    fits = NOT_JUDGED._replace(chi2_per_dof=1.0, is_accepted=True)
    monkeypatch.setattr(optimum, "fit_off_bridge", lambda problem, y, **_: fits)
    monkeypatch.setattr(optimum, "_find_truck", lambda *_: (None, None, 10))
    monkeypatch.setattr(optimum, "refine_from_truck", lambda *_: (found(1.0, 100), None))
    inputs: Any = None
    best = optimum.find_optimum(inputs)
    assert best.chi2_per_dof == 1.0
    assert best.fits_off_bridge is None


def test_a_fit_that_took_long_is_a_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimum, "_refine_candidates", lambda *_: found(1.0, 300_000))
    monkeypatch.setattr(optimum, "build_problem", lambda inputs: (found(0.0, 0).problem, None))
    monkeypatch.setattr(optimum, "is_accepted", lambda problem, chi2: chi2 < 1.5)
    inputs: Any = None
    assert optimum.find_optimum(inputs).ending is Termination.CONVERGED
