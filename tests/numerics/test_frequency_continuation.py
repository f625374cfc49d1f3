"""Bridges by low frequencies first: coordinates, starts, and a bridge that slips by periods."""

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.crossing import surface_posterior
from pre_core.crossing.fit import Optimum
from pre_core.crossing.frequency_continuation import (
    _RIVAL,
    _STAGES_HZ,
    OtherBridge,
    _ContinuedFit,
    _coordinates,
    _starts,
    other_bridges,
)
from pre_core.crossing.optimum import WITH_MISMATCH
from pre_core.crossing.posterior import layout
from pre_core.crossing.weighted_draws import WeightedDraws
from pre_core.parameters import RHO_A
from pre_core.search.importance import pareto_smooth
from tests.numerics.single_tyres import at_its_truth

# They share a crossing at its truth, which takes seconds.
pytestmark = pytest.mark.xdist_group("at its truth")
STRATEGY = WITH_MISMATCH[0]


@pytest.fixture(scope="module")
def truth() -> Optimum:
    return at_its_truth()


def at_nominal_bridge(truth: Optimum) -> Optimum:
    """Return the truth with a bridge of nominal values on free, rigid bearings."""
    y = truth.state.y.copy()
    y[layout(truth.problem).bridge] = 0.0
    return truth._replace(state=truth.state._replace(y=y))


Better = tuple[list[OtherBridge], int]


@pytest.fixture(scope="module")
def better(truth: Optimum) -> Better:
    """Return the bridges better than the nominal one, and the number of evaluations."""
    return other_bridges(at_nominal_bridge(truth), STRATEGY, is_even=True)


def test_coordinates_are_undone(truth: Optimum) -> None:
    at = _coordinates(truth.problem)
    y = np.append(truth.state.y[at.indices], 0.3)
    y[at.restraints], y[at.compliant] = (0.4, 2.0), (0.0, 1.5)
    np.testing.assert_allclose(at.to_y(at.from_y(y)), y, rtol=1e-12)
    assert at.elements.size == 5
    # Half the rigidity is twice the compliance.
    y[at.elements] = -np.log(2.0) / at.spread
    np.testing.assert_allclose(at.from_y(y)[at.elements], 2.0)


def test_starts_are_all_pairs_of_alike_or_of_unlike_ends(truth: Optimum) -> None:
    at = _coordinates(truth.problem)
    starts = [*_starts(at, is_even=True), *_starts(at, is_even=False)]
    ends = {tuple(one[np.append(at.restraints, at.compliant)]) for one in starts}
    assert len(ends) == len(starts) == 8
    assert all(sum(one) % 2.0 == 0.0 for one in ends)


def test_site_with_free_rigid_bearings_has_one_start(truth: Optimum) -> None:
    none = np.zeros(0, dtype=np.int64)
    at = _coordinates(truth.problem)._replace(restraints=none, compliant=none)
    assert len(list(_starts(at, is_even=True))) == 1


def test_low_frequencies_first_reach_a_bridge_that_all_at_once_miss(truth: Optimum) -> None:
    far = at_nominal_bridge(truth)
    at = _coordinates(far.problem)
    fit = _ContinuedFit(far.problem, far.state.y, STRATEGY, at)
    best, _ = fit.run(np.append(truth.state.y[at.indices], 0.0), ())
    start = np.zeros(at.indices.size + 1)
    start[np.flatnonzero(np.flatnonzero(far.problem.priors.estimated)[at.indices] == RHO_A)] = 2.0
    (at_once, _), (by_stages, _) = fit.run(start, ()), fit.run(start, _STAGES_HZ)
    assert at_once > best + 10.0
    assert by_stages < best + 1.0


def test_other_bridges_are_distinct_and_sorted(truth: Optimum, better: Better) -> None:
    others, evaluations = better
    assert others
    assert evaluations > 100
    gains = [one.gain for one in others]
    assert gains == sorted(gains, reverse=True)
    assert gains[-1] > -_RIVAL
    where = layout(truth.problem)
    inner = where.elements[1:-1]
    assert np.abs(others[0].y - truth.state.y)[inner].max() < 0.5


def test_best_bridge_has_rivals_only(truth: Optimum, better: Better) -> None:
    others, _ = better
    best = truth._replace(state=truth.state._replace(y=others[0].y))
    again, _ = other_bridges(best, STRATEGY, is_even=True)
    assert all(-_RIVAL < one.gain < 5.0 for one in again)


def test_draws_begin_about_likely_rivals_only(
    truth: Optimum, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, y = layout(truth.problem), truth.state.y
    near, far = y.copy(), y.copy()
    near[where.elements[2]] += 0.02
    far[where.elements] -= 2.0
    begun: list[FloatArray] = []

    def noted(_: object, first: FloatArray, *__: object) -> WeightedDraws:
        begun.append(first)
        return WeightedDraws(first, pareto_smooth(np.zeros(len(first))))

    monkeypatch.setattr(surface_posterior, "residual_draws", noted)

    def drawn(*rivals: FloatArray) -> surface_posterior.ResidualDraws:
        found = truth._replace(rivals=rivals)
        return surface_posterior.drawn_by_residuals(found, 300, 7, 1.0, lambda *_: None)

    alone, with_far, with_near = drawn(), drawn(far), drawn(near)
    np.testing.assert_array_equal(begun[0], begun[1])
    assert begun[2].shape[0] >= begun[0].shape[0]
    assert not np.array_equal(begun[2], begun[0])
    assert with_near.evaluations > with_far.evaluations > alone.evaluations
