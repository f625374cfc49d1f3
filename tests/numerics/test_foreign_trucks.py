"""Which of a truck's crossings are by another truck."""

import numpy as np
import pytest

from pre_core.fusion.path_groups import FusionInput
from pre_core.fusion.vehicle_consistency import VehicleConsistency, find_misattributed
from tests.numerics.test_fusion import PRIORS, crossing_of, root

SURE = 1e-3
"""Precision of the truck's unknown in a crossing, in standard deviations of its prior."""


def by_truck(
    number: int, unknown: float, std: float = SURE, truck: str = "truck", c: float = 1.0
) -> FusionInput:
    """A crossing by a truck whose one unknown is so, over a bridge of compliance `c`."""
    information_root = root()
    information_root[5, 5] = 1.0 / std
    # What is found of the bridge depends on the truck.
    information_root[2:5, 5] = 3.0
    rng = np.random.default_rng(40 + number)
    return crossing_of(number, np.array([0.0, 0.4, c, c, c, unknown]), information_root, rng, truck)


def named(*numbers: int) -> VehicleConsistency:
    return VehicleConsistency(tuple(f"crossing-{number:03d}" for number in numbers), False)


@pytest.mark.parametrize("sound", [2, 9])
@pytest.mark.parametrize("std", [SURE, 0.01 * SURE])
def test_one_by_another_truck_is_named_however_sure_it_is(sound: int, std: float) -> None:
    """Nor does the surest crossing outvote the others."""
    parts = [by_truck(n, 0.2) for n in range(sound)]
    foreign = by_truck(sound, 0.6, std)
    assert find_misattributed([*parts, foreign], PRIORS) == named(sound)


def test_two_by_another_truck_among_six_are_named() -> None:
    parts = [by_truck(n, 0.9 if n in (1, 4) else 0.2) for n in range(6)]
    assert find_misattributed(parts, PRIORS) == named(1, 4)


def test_none_of_one_truck_is_named() -> None:
    """Whatever it is, how differently sure they are, what it and the bridge do between them."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        of_truck = rng.standard_normal() + 0.03 * rng.standard_normal(12)
        parts = [
            by_truck(
                100 * seed + n, of_truck[n], 10.0 ** rng.uniform(-4.0, 0.0), c=rng.uniform(0.8, 1.2)
            )
            for n in range(12)
        ]
        assert find_misattributed(parts, PRIORS) == named()


def test_of_two_that_disagree_none_is_named() -> None:
    parts = [by_truck(0, 0.2), by_truck(1, 0.6)]
    assert find_misattributed(parts, PRIORS) == VehicleConsistency((), True)
    half = [by_truck(n, 0.2 if n % 2 else 0.6) for n in range(6)]
    assert find_misattributed(half, PRIORS).is_contradictory


def test_trucks_of_two_names_are_two_trucks() -> None:
    parts = [by_truck(n, 0.2 if n % 2 else 0.6, truck=f"truck-{n % 2}") for n in range(6)]
    assert find_misattributed(parts, PRIORS) == named()
    assert find_misattributed(parts[:1], PRIORS) == named()
