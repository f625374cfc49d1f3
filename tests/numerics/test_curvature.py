"""Likelihoods with curvature terms: normal again about a point, and true to the residuals."""

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.fusion.curvature import (
    _FARTHEST,
    _FARTHEST_OF_DIFFERENCES,
    CurvatureTerms,
    linearise_with_curvature,
)

BRIDGE, OTHERS, ROWS = 3, 2, 12
ABOUT = np.array([0.2, 1.0, 0.7])
DIRECTIONS = np.array(
    [[0.5, 0.0, 0.1, 0.0], [0.0, 0.3, 0.0, 0.1], [0.1, 0.2, 0.2, 0.0], [0.0, 0.1, 0.0, 0.4]]
)
PAIRS = np.triu_indices(BRIDGE + 1)


def terms(rng: np.random.Generator, logarithms: int) -> CurvatureTerms:
    shapes = rng.standard_normal((2, PAIRS[0].size))
    return CurvatureTerms(ABOUT, DIRECTIONS, shapes, logarithms)


def coordinates(of: CurvatureTerms, bridge: FloatArray) -> FloatArray:
    """Return the bridge with the logarithm of its last coordinates, where they enter so."""
    plain = bridge.size - of.logarithms
    return np.concatenate([bridge[:plain], np.log(bridge[plain:])])


def rows(
    root: FloatArray, of: CurvatureTerms, bridge: FloatArray, others: FloatArray, place: float
) -> FloatArray:
    """What such a likelihood compares with its target, computed pair by pair."""
    at = coordinates(of, bridge)
    move = np.linalg.solve(of.directions, np.append(at - coordinates(of, of.about), place))
    bend = [
        sum(factor * move[i] * move[j] for factor, i, j in zip(shape, *PAIRS, strict=True))
        for shape in of.shapes
    ]
    return root @ np.concatenate([at, others, [place], bend])


def drawn(
    seed: int, logarithms: int = 0
) -> tuple[FloatArray, CurvatureTerms, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((ROWS, BRIDGE + OTHERS + 1 + 2))
    bridge = ABOUT + (DIRECTIONS @ rng.uniform(-0.4, 0.4, BRIDGE + 1))[:BRIDGE]
    return root, terms(rng, logarithms), bridge, rng.normal(size=2)


@pytest.mark.parametrize("logarithms", [0, 2])
def test_about_the_truth_it_goes_through_the_truth(logarithms: int) -> None:
    for seed in range(5):
        root, of, bridge, others = drawn(seed, logarithms)
        target = rows(root, of, bridge, others, 0.05)
        straight, at = linearise_with_curvature(root, target, of, bridge, 1e-9 * np.eye(OTHERS))
        assert np.allclose(straight @ np.concatenate([bridge, others]), at, atol=1e-9)


@pytest.mark.parametrize("logarithms", [0, 2])
def test_beside_it_the_slope_is_that_of_the_curved_rows(logarithms: int) -> None:
    root, of, bridge, others = drawn(7, logarithms)
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


@pytest.mark.parametrize(
    ("logarithms", "farthest"), [(0, _FARTHEST_OF_DIFFERENCES), (2, _FARTHEST)]
)
def test_far_away_it_is_no_further_than_the_terms_apply(logarithms: int, farthest: float) -> None:
    root, of, _, others = drawn(2, logarithms)
    size = np.array([0.5, 0.3, 0.2, 0.4])
    of = of._replace(directions=np.diag(size))
    target = rows(root, of, ABOUT, others, 0.0)

    def bridge(moved: FloatArray) -> FloatArray:
        at = coordinates(of, ABOUT) + moved
        plain = BRIDGE - logarithms
        return np.concatenate([at[:plain], np.exp(at[plain:])])

    far, at_most = (
        linearise_with_curvature(root, target, of, bridge(moved), np.eye(OTHERS))
        for moved in (20.0 * size[:BRIDGE], farthest * size[:BRIDGE])
    )
    assert np.allclose(far[0], at_most[0], atol=1e-12)
