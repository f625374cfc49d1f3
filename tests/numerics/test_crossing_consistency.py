"""Which crossings cannot be of the same bridge as the others."""

import numpy as np

from pre_core.fusion.crossing_consistency import ConsistencyResult
from pre_core.fusion.crossing_consistency import select_consistent as judge_joined
from pre_core.fusion.information import BridgePriors
from pre_core.fusion.joint import build_joint
from pre_core.fusion.path_groups import FusionInput
from tests.numerics.test_fusion import PRIORS, crossing_of, root


def judge(parts: list[FusionInput], priors: BridgePriors) -> ConsistencyResult:
    return judge_joined(parts, build_joint(parts, priors), priors)


def survey(count: int, tau: float, seed: int, std: float = 0.03) -> list[FusionInput]:
    rng = np.random.default_rng(seed)
    parts = []
    for i in range(count):
        c = np.exp(tau * rng.standard_normal(3))
        parts.append(crossing_of(i, np.concatenate([[0.0, 0.4], c, [0.0]]), root(std), rng))
    return parts


def foreign(number: int, change: float) -> FusionInput:
    """A crossing of a bridge of which one element is another one's."""
    rng = np.random.default_rng(100 + number)
    return crossing_of(number, np.array([0.0, 0.4, 1.0, 1.0 + change, 1.0, 0.0]), root(), rng)


def test_one_foreign_crossing_among_ten_is_left_out() -> None:
    parts = [*survey(9, 0.0, 1), foreign(9, 0.6)]
    found = judge(parts, PRIORS)
    assert found.excluded == ("crossing-009",)
    assert len(found.consistent) == 9
    assert not found.is_contradictory


def test_two_foreign_ones_too() -> None:
    parts = [foreign(0, -0.4), *survey(10, 0.0, 2)[1:], foreign(10, 0.5)]
    assert judge(parts, PRIORS).excluded == ("crossing-000", "crossing-010")


def test_sound_crossings_stay_also_of_a_bridge_that_changes() -> None:
    left_out = [
        len(judge(survey(12, tau, seed), PRIORS).excluded)
        for tau in (0.0, 0.05)
        for seed in range(25)
    ]
    assert sum(left_out) <= 2  # of 600


def test_sound_crossings_of_little_information_stay() -> None:
    left_out = [judge(survey(16, 0.06, seed, 0.005), PRIORS).excluded for seed in range(20)]
    assert not any(left_out)


def test_one_foreign_crossing_beside_a_bridge_that_changes() -> None:
    parts = [*survey(15, 0.06, 5, 0.005), foreign(15, 0.8)]
    assert judge(parts, PRIORS).excluded == ("crossing-015",)


def test_of_two_that_disagree_none_is_left_out() -> None:
    found = judge([*survey(1, 0.0, 3), foreign(1, 0.8)], PRIORS)
    assert found.excluded == ()
    assert found.is_contradictory
    assert not judge(survey(2, 0.0, 4), PRIORS).is_contradictory
    assert judge(survey(1, 0.0, 4), PRIORS).consistent == ("crossing-000",)
