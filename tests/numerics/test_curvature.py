"""Likelihoods with curvature terms: normal again about a point, and true to the residuals."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.fit import normal_approximation
from pre_core.fusion.curvature import CurvatureTerms, curvature_terms, linearise_with_curvature
from tests.numerics.single_tyres import at_its_truth

Indices = NDArray[np.int64]

BRIDGE, OTHERS, ROWS = 3, 2, 12
ABOUT = np.array([0.2, 1.0, 0.7])
DIRECTIONS = np.array(
    [[0.5, 0.0, 0.1, 0.0], [0.0, 0.3, 0.0, 0.1], [0.1, 0.2, 0.2, 0.0], [0.0, 0.1, 0.0, 0.4]]
)
PAIRS = np.triu_indices(BRIDGE + 1)


def terms(rng: np.random.Generator) -> CurvatureTerms:
    return CurvatureTerms(ABOUT, DIRECTIONS, rng.standard_normal((2, PAIRS[0].size)))


def rows(
    root: FloatArray, of: CurvatureTerms, bridge: FloatArray, others: FloatArray, place: float
) -> FloatArray:
    """What such a likelihood compares with its target, computed pair by pair."""
    move = np.linalg.solve(of.directions, np.append(bridge - of.about, place))
    bend = [
        sum(factor * move[i] * move[j] for factor, i, j in zip(shape, *PAIRS, strict=True))
        for shape in of.shapes
    ]
    return root @ np.concatenate([bridge, others, [place], bend])


def drawn(seed: int) -> tuple[FloatArray, CurvatureTerms, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((ROWS, BRIDGE + OTHERS + 1 + 2))
    bridge = ABOUT + (DIRECTIONS @ rng.uniform(-0.4, 0.4, BRIDGE + 1))[:BRIDGE]
    return root, terms(rng), bridge, rng.normal(size=2)


def test_about_the_truth_it_goes_through_the_truth() -> None:
    for seed in range(5):
        root, of, bridge, others = drawn(seed)
        target = rows(root, of, bridge, others, 0.05)
        straight, at = linearise_with_curvature(root, target, of, bridge, 1e-9 * np.eye(OTHERS))
        assert np.allclose(straight @ np.concatenate([bridge, others]), at, atol=1e-9)


def test_beside_it_the_slope_is_that_of_the_curved_rows() -> None:
    root, of, bridge, others = drawn(7)
    target = rows(root, of, bridge, others, 0.05)
    straight, at = linearise_with_curvature(root, target, of, bridge, 1e-9 * np.eye(OTHERS))
    here = straight @ np.concatenate([bridge, others]) - at

    def apart(step: FloatArray, place: float) -> FloatArray:
        return rows(root, of, bridge + step, others, place) - target

    along = (apart(np.zeros(3), 0.05 + 1e-6) - apart(np.zeros(3), 0.05 - 1e-6)) / 2e-6
    along /= np.linalg.norm(along)
    for i in range(BRIDGE):
        step = np.zeros(3)
        step[i] = 1e-6
        slope = (apart(step, 0.05) - apart(-step, 0.05)) / 2e-6
        slope -= along * (along @ slope)  # what the place takes
        moved = straight @ np.concatenate([bridge + step, others]) - at
        assert np.allclose((moved - here) / 1e-6, slope, atol=1e-4)


def test_far_away_it_is_no_further_than_the_terms_apply() -> None:
    root, of, _, others = drawn(2)
    size = np.array([0.5, 0.3, 0.2, 0.4])
    of = of._replace(directions=np.diag(size))
    target = rows(root, of, ABOUT, others, 0.0)
    far, at_most = (
        linearise_with_curvature(root, target, of, ABOUT + moved, np.eye(OTHERS))
        for moved in (50.0, 0.7 * size[:BRIDGE])
    )
    assert np.allclose(far[0], at_most[0], atol=1e-12)


def drawn_given(
    covariance: FloatArray,
    places: Indices,
    given: Indices,
    values: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Draw the coordinates `places` of a centred normal with the coordinates `given` known."""
    inner = covariance[np.ix_(places, places)]
    follow = np.linalg.solve(covariance[np.ix_(given, given)], covariance[np.ix_(given, places)])
    inner = inner - follow.T @ covariance[np.ix_(given, places)]
    return np.asarray(rng.multivariate_normal(follow.T @ values, inner))


def test_terms_describe_the_residuals_where_the_posterior_is() -> None:
    """Bridge and offset as the posterior draws them: the terms are most of the curvature.

    Terms of single coordinates, of which each moves by its own standard deviation, would leave
    more than there is without any.
    """
    optimum = at_its_truth()
    problem, state = optimum.problem, optimum.state
    where = posterior.layout(problem)
    place = (where.trajectory.start + where.trajectory.stop) // 2
    data = np.arange(problem.noise.reciprocal.size)
    found, effect = curvature_terms(optimum, problem, data, place)
    _, covariance = normal_approximation(optimum)
    kept = np.append(where.bridge, place)
    ends = np.intersect1d(where.bridge, where.half_normal)
    others = np.setdiff1d(kept, ends)
    draw = partial(drawn_given, covariance, rng=np.random.default_rng(5))
    follow = covariance[:, kept] @ np.linalg.inv(covariance[np.ix_(kept, kept)])
    sigma = posterior.rigidity_spread(problem.priors)
    whole, left = [], []
    for _ in range(20):
        step = np.zeros(state.y.size)
        step[ends] = np.abs(draw(ends, ends[:0], step[ends[:0]]))
        step[others] = draw(others, ends, step[ends])
        step = follow @ step[kept]
        y = state.y + step
        moved = posterior.data_rows(problem, y[None, :])[0]
        # Terms and linear part are those of c, in which the elements are measured.
        compliance = np.exp(-sigma * y[where.elements])
        before = np.exp(-sigma * state.y[where.elements])
        step[where.elements] = (compliance - before) / (-sigma * before)
        straight = (state.residual + state.jacobian @ step)[data]
        at = step[kept]
        at[-1 - sigma.size : -1] = compliance - before
        size = np.linalg.solve(found.directions, at)
        first, second = np.triu_indices(size.size)
        curved = effect @ (found.shapes @ (size[first] * size[second]))
        whole.append(np.linalg.norm(moved - straight))
        left.append(np.linalg.norm(moved - straight - curved))
    assert np.median(left) < 0.5 * np.median(whole)
