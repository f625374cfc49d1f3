"""Lanes off the axis of decks that twist, and more axles than the site file declares.

The simulator shares nothing with the program. `DRIVEBY_WIDTH=8` drives fewer crossings of each;
coverage is judged from 64 on, of which it says something.
"""

import os

import numpy as np
import pytest

from studies.simulation.wide_cases import draw_wide, more_axles
from tests.verdicts.width import Judged, judged

WIDE, MORE_AXLES = 64, 16
LARGEST_Z = 4.0
COVERAGE = (0.93, 0.98)
NAMED_SHARE = 14 / 16
"""Of the crossings with more axles, those that must have a reason that names something."""
NAMELESS = {"not_converged", "failed"}

pytestmark = [pytest.mark.slow, pytest.mark.timeout(4 * 3600)]


def at_most(count: int) -> int:
    return min(count, int(os.environ.get("DRIVEBY_WIDTH", count)))


def outcome(found: list[Judged]) -> str:
    return "\n".join(f"{one.name}: {one.verdict} {one.reasons} z {one.z.round(1)}" for one in found)


def test_lanes_off_the_axis_give_no_wrong_good() -> None:
    found = [judged(draw_wide(seed)) for seed in range(at_most(WIDE))]
    wrong = [
        one
        for one in found
        if one.verdict == "good" and one.z.size and np.abs(one.z).max() > LARGEST_Z
    ]
    assert not wrong, outcome(wrong)
    if len(found) >= WIDE:
        coverage = np.concatenate([one.is_covered for one in found]).mean()
        assert COVERAGE[0] <= coverage <= COVERAGE[1], outcome(found)


def test_more_axles_than_declared_are_named() -> None:
    found = [judged(more_axles(number)) for number in range(at_most(MORE_AXLES))]
    assert not [one for one in found if one.verdict == "good"], outcome(found)
    named = [one for one in found if set(one.reasons) - NAMELESS]
    assert len(named) >= np.ceil(NAMED_SHARE * len(found)), outcome(found)
