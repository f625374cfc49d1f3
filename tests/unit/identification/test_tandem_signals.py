"""Channels of a truck with a tandem that are inverted or swapped are found before a fit."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from pre_core.physics.simulate import Motion
from schemas.reasons import Reason
from schemas.site import Vehicle
from services.common.arrays import Floats
from services.finding.placed import middle_names
from services.identification.signal_checks import reasons_before_fit
from services.simulation.drawn_tandem import TandemEffects, drawn_tandem
from services.simulation.survey_kinds import KINDS
from services.simulation.wide_crossings import drive_case, site_of
from studies.simulation.tandem_cases import draw_tandem
from studies.simulation.truths import default_site
from studies.validation.surveys import crossing_truth, site_of_truck


@cache
def recorded(seed: int) -> tuple[Vehicle, Floats, Motion]:
    case = draw_tandem(seed)
    found = drive_case(case, 0)
    signals = np.stack(list(found.run.channels.values()))
    motion = steady(signals.shape[1], case.runs[0].speed_m_per_s, case.rate_hz)
    return site_of(case).vehicles[0], signals, motion


def steady(count: int, speed_m_per_s: float, rate_hz: float) -> Motion:
    speed = np.full(count, speed_m_per_s)
    return Motion(np.cumsum(speed) / rate_hz, speed, np.zeros_like(speed))


def judged(seed: int, change: Callable[[Floats], Floats]) -> dict[Reason, str]:
    vehicle, signals, motion = recorded(seed)
    return dict(reasons_before_fit(vehicle, change(signals.copy()), 1.0 / 500.0, motion, 1))


def inverted(*rows: int) -> Callable[[Floats], Floats]:
    def change(signals: Floats) -> Floats:
        signals[list(rows)] *= -1.0
        return signals

    return change


@pytest.mark.parametrize("seed", [20, 23])
def test_sound_channels_of_a_tandem_are_not_accused(seed: int) -> None:
    assert judged(seed, lambda signals: signals) == {}


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_body_that_pitches_is_judged_by_the_road(sign: float) -> None:
    """Front and rear of this body move against each other: their correlation at a place is -0.6."""
    kind = KINDS["tandem"]
    site = site_of_truck(default_site(), kind, 0)
    truth, seed = crossing_truth(site, kind, 13, 0, 0)
    effects = TandemEffects(kind.friction_share, kind.offset_m, wander_m=kind.wander_m)
    run, _ = drawn_tandem(site, truth, seed, 13_000, effects).recorded
    signals = np.stack(list(run.channels.values()))
    signals[0] *= sign
    motion = steady(signals.shape[1], truth.conditions.speed_m_per_s, run.rate_hz)
    vehicle = site.vehicles[0]
    found = dict(reasons_before_fit(vehicle, signals, 1.0 / run.rate_hz, motion, 1))
    expected = {} if sign > 0.0 else {Reason.CHANNEL_INVERTED: middle_names(vehicle)[0]}
    assert found == expected


@pytest.mark.parametrize("row", range(4))
def test_inverted_channel_of_a_tandem_is_named(row: int) -> None:
    names = middle_names(recorded(20)[0])
    assert judged(20, inverted(row)) == {Reason.CHANNEL_INVERTED: names[row]}


@pytest.mark.parametrize(("i", "k"), [(0, 1), (2, 3), (1, 2)])
def test_swapped_channels_of_a_tandem_are_named(i: int, k: int) -> None:
    def exchange(signals: Floats) -> Floats:
        signals[[i, k]] = signals[[k, i]]
        return signals

    names = middle_names(recorded(20)[0])
    assert judged(20, exchange) == {Reason.CHANNEL_SWAPPED: f"{names[i]} and {names[k]}"}
