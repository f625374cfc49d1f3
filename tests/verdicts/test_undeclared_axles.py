"""Trailers and tandems declared with two axles, by the rear body equation alone."""

import numpy as np
import pytest

from schemas.reasons import Reason
from schemas.signals import CHANNELS
from services.identification.checks import undeclared_axles
from services.simulation.wide_crossings import WideCase, drive_case, site_of
from studies.simulation.wide_cases import draw_wide, more_axles


def named(case: WideCase, *, has_reasons: bool) -> dict[Reason, str]:
    run = drive_case(case, 0).run
    signals = np.stack([run.channels[name] for name in CHANNELS])
    vehicle = site_of(case).vehicles[0]
    return undeclared_axles(vehicle, signals, 1.0 / run.rate_hz, has_reasons=has_reasons)


@pytest.mark.parametrize("number", [1, 2, 3, 9])
def test_force_of_an_undeclared_axle_is_named(number: int) -> None:
    found = named(more_axles(number), has_reasons=False)
    assert "% of the rear's motion is unexplained" in found[Reason.MORE_AXLES_THAN_DECLARED]


@pytest.mark.parametrize("number", [5, 15])
def test_weaker_sign_counts_where_something_else_is_wrong(number: int) -> None:
    assert not named(more_axles(number), has_reasons=False)
    assert named(more_axles(number), has_reasons=True)


@pytest.mark.parametrize("seed", range(6))
def test_truck_with_its_declared_axles_is_not_accused(seed: int) -> None:
    assert not named(draw_wide(seed), has_reasons=True)
