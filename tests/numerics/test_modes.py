"""A likelihood with two maxima: a restrained end and a weak element, or neither."""

import numpy as np
import pytest

from pre_core.crossing.posterior import log_odds
from pre_core.fusion.curvature import CurvatureTerms
from pre_core.fusion.information import BridgePriors
from pre_core.fusion.joint import build_joint
from pre_core.fusion.likelihood import Coordinates, CrossingLikelihood
from pre_core.fusion.modes import bridge_modes, sample_modes
from pre_core.fusion.path_groups import FusionInput
from pre_core.physics.surface import TYPICAL_FOOTPRINTS

KNOTS = 8
SHARP = 0.02
SPREAD = 0.5
RESTRAINED, SOFT, STIFF = 2.0, 1.25, 0.75


def two_bridges() -> tuple[FusionInput, BridgePriors]:
    """Either k = 0 and c = SOFT, or k = RESTRAINED and c = STIFF, within SHARP.

    The rows are (c - SOFT + (SOFT - STIFF) k/RESTRAINED)/SHARP and k (k - RESTRAINED)/SHARP, and
    the offset alone.
    """
    # x: k, c; the gain; the waves; the offset; the term k².
    root = np.zeros((3, 2 + 1 + KNOTS + 1 + 1))
    root[0, :2] = (SOFT - STIFF) / RESTRAINED / SHARP, 1.0 / SHARP
    root[1, [0, -1]] = -RESTRAINED / SHARP, 1.0 / SHARP
    root[2, -2] = 1.0
    target = np.array([SOFT / SHARP, 0.0, 0.0])
    shapes = np.zeros((1, 6))
    shapes[0, 0] = 1.0
    bridge = Coordinates(
        ("k_rot_start", "EI_1"),
        np.array([0.0, 1e10]),
        np.array([1e9, SPREAD]),
        np.array([False, True]),
    )
    gain = Coordinates(("common_gain",), np.ones(1), np.array([0.01]), np.array([True]))
    terms = CurvatureTerms(np.array([0.0, SOFT]), np.eye(3), shapes)
    knots = 1.25 * np.arange(KNOTS, dtype=np.float64)
    level = np.array([1e-9, 0.0])
    one = CrossingLikelihood(root, target, bridge, gain, knots, level, None, terms)
    part = FusionInput("run", one, "truck", 1, TYPICAL_FOOTPRINTS, 0.0)
    return part, BridgePriors(bridge, np.array([0.0, 1.0]), log_odds(np.array([0.5, 0.0])), 1)


def test_both_bridges_are_found_and_weighted_by_their_posterior() -> None:
    part, priors = two_bridges()
    modes = bridge_modes([part], priors, build_joint([part], priors))
    centres = np.array([mode.information.centre for mode in modes])
    assert np.allclose(centres, [[0.0, SOFT], [RESTRAINED, STIFF]], atol=0.05)
    # Alike in likelihood, so that the weights are those of the priors.
    prior = [-0.5 * k**2 - 0.5 * (np.log(c) / SPREAD) ** 2 for k, c in centres]
    assert np.log(modes[1].weight / modes[0].weight) == pytest.approx(prior[1] - prior[0], abs=0.3)


def test_draws_are_of_both() -> None:
    part, priors = two_bridges()
    modes = bridge_modes([part], priors, build_joint([part], priors))
    draws = sample_modes(modes, priors, 200, 1).draws
    is_restrained = draws[:, :, 0] > 0.5 * RESTRAINED
    assert is_restrained.mean() == pytest.approx(modes[1].weight, abs=0.02)
    compliance = np.exp(-SPREAD * draws[:, :, 1])
    assert np.median(compliance[is_restrained]) == pytest.approx(STIFF, abs=0.05)
    assert np.median(compliance[~is_restrained]) == pytest.approx(SOFT, abs=0.05)
