"""Hum of the mains or of an engine in the accelerometers is taken out, and named."""

import numpy as np
import pytest

from schemas.signals import CHANNELS
from services.common.arrays import Floats
from tests.verdicts.faults import Channels, Fault, Truth, crossing, identified, z_scores


def humming(hz: float, amplitude_m_per_s2: float, which: tuple[str, ...] = CHANNELS) -> Fault:
    """A line of the same frequency in some channels, each with a phase of its own."""

    def channels(values: Channels, time_s: Floats) -> Channels:
        return {
            name: values[name]
            + (name in which) * amplitude_m_per_s2 * np.sin(2.0 * np.pi * hz * time_s + 0.3 * k)
            for k, name in enumerate(values)
        }

    return Fault(channels=channels)


@pytest.mark.parametrize(
    ("hz", "amplitude_m_per_s2"),
    [
        (50.0, 0.003),
        pytest.param(33.0, 0.003, marks=pytest.mark.slow),
        pytest.param(25.0, 0.003, marks=pytest.mark.slow),
        pytest.param(16.7, 0.003, marks=pytest.mark.slow),
        pytest.param(50.0, 0.03, marks=pytest.mark.slow),
        pytest.param(14.0, 0.01, marks=pytest.mark.slow),
    ],
)
def test_hum_in_all_channels_costs_nothing(hz: float, amplitude_m_per_s2: float) -> None:
    case = crossing(Truth(), humming(hz, amplitude_m_per_s2))
    found = identified(case)
    assert (found.verdict, found.reasons) == ("good", ())
    assert found.hum_hz() == (pytest.approx(hz, abs=0.1),)
    assert np.abs(z_scores(case, found)).max() < 3.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_hum_beside_another_road_truck_and_speed(seed: int) -> None:
    truth = Truth(seed=seed, speed_m_per_s=(12.0, 13.0), forward=seed % 2 == 0, rate_hz=500.0)
    case = crossing(truth, humming(24.0 + seed, 0.005))
    found = identified(case)
    assert found.verdict == "good"
    assert np.abs(z_scores(case, found)).max() < 3.5


def test_a_sound_crossing_has_no_hum() -> None:
    assert identified(crossing(Truth())).hum_hz() == ()


@pytest.mark.slow
def test_hum_hides_nothing_else() -> None:
    """A second vehicle on the bridge is still one."""
    found = identified(crossing(Truth(), humming(50.0, 0.003)._replace(second_vehicle_kg=10_000.0)))
    assert found.verdict == "rejected"
