"""Likelihoods of which the rows are bent: normal again about a point."""

import numpy as np
from numpy.typing import NDArray

from pre_core.fusion.curvature import CurvatureTerms, linearise_with_curvature

FloatArray = NDArray[np.float64]

BRIDGE, OTHERS, ROWS = 3, 2, 12
ABOUT = np.array([0.2, 1.0, 0.7])
SIZE = np.array([0.5, 0.3, 0.2, 0.4])
PAIRS = np.triu_indices(BRIDGE + 1)


def bends(rng: np.random.Generator) -> CurvatureTerms:
    return CurvatureTerms(ABOUT, SIZE, rng.standard_normal((2, PAIRS[0].size)))


def rows(
    root: FloatArray, of: CurvatureTerms, bridge: FloatArray, others: FloatArray, place: float
) -> FloatArray:
    """What a bent likelihood compares with its target, computed pair by pair."""
    move = np.append(bridge - of.about, place) / of.size
    bend = [
        sum(factor * move[i] * move[j] for factor, i, j in zip(shape, *PAIRS, strict=True))
        for shape in of.shapes
    ]
    return root @ np.concatenate([bridge, others, [place], bend])


def drawn(seed: int) -> tuple[FloatArray, CurvatureTerms, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((ROWS, BRIDGE + OTHERS + 1 + 2))
    return root, bends(rng), ABOUT + 0.6 * SIZE[:3] * rng.standard_normal(3), rng.normal(size=2)


def test_about_the_truth_it_goes_through_the_truth() -> None:
    for seed in range(5):
        root, of, bridge, others = drawn(seed)
        target = rows(root, of, bridge, others, 0.15)
        straight, at = linearise_with_curvature(root, target, of, bridge, 1e-9 * np.eye(OTHERS))
        assert np.allclose(straight @ np.concatenate([bridge, others]), at, atol=1e-9)


def test_beside_it_the_slope_is_that_of_the_bent_rows() -> None:
    root, of, bridge, others = drawn(7)
    target = rows(root, of, bridge, others, 0.1)
    straight, at = linearise_with_curvature(root, target, of, bridge, 1e-9 * np.eye(OTHERS))
    here = straight @ np.concatenate([bridge, others]) - at

    def apart(step: FloatArray, place: float) -> FloatArray:
        return rows(root, of, bridge + step, others, place) - target

    along = (apart(np.zeros(3), 0.1 + 1e-6) - apart(np.zeros(3), 0.1 - 1e-6)) / 2e-6
    along /= np.linalg.norm(along)
    for i in range(BRIDGE):
        step = np.zeros(3)
        step[i] = 1e-6
        slope = (apart(step, 0.1) - apart(-step, 0.1)) / 2e-6
        slope -= along * (along @ slope)  # what the place takes
        moved = straight @ np.concatenate([bridge + step, others]) - at
        assert np.allclose((moved - here) / 1e-6, slope, atol=1e-4)


def test_far_away_it_is_no_further_than_it_is_believed() -> None:
    root, of, bridge, others = drawn(2)
    target = rows(root, of, bridge, others, 0.0)
    priors = np.eye(OTHERS)
    far = linearise_with_curvature(root, target, of, ABOUT + 50.0, priors)
    at_most = linearise_with_curvature(root, target, of, ABOUT + 3.0 * SIZE[:3], priors)
    assert np.array_equal(far[0], at_most[0])
