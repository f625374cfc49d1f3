"""A channel that freezes for a twentieth of a second, or is bridged by a line, is named at once."""

import numpy as np
import pytest

from schemas.reasons import Reason
from schemas.signals import CHANNELS
from services.identification import identify
from services.identification.signal_checks import unmeasured
from tests.verdicts import faults
from tests.verdicts.faults import Fault, Truth
from tests.verdicts.test_signals import sound


def outcome(seed: int | None, fault: Fault, step_m_per_s2: float = 0.0) -> dict[Reason, str]:
    truth, case = sound(seed)
    channels = case.run.channels
    if step_m_per_s2:
        channels = faults.quantised(channels, step_m_per_s2)
    channels = fault.channels(channels, case.run.accel_time_s - case.entry_s)
    acceleration = np.stack([channels[name] for name in CHANNELS])
    return unmeasured(CHANNELS, acceleration, 1.0 / truth.rate_hz)


@pytest.mark.parametrize("seconds", [0.05, 0.2])
@pytest.mark.parametrize("from_s", [-2.0, 0.5])
@pytest.mark.parametrize("name", CHANNELS)
def test_frozen_channel_is_named(name: str, from_s: float, seconds: float) -> None:
    for seed in (None, 2, 1, 6):  # 1 kHz, 200 Hz, 500 Hz, 2 kHz
        found = outcome(seed, faults.frozen(name, from_s, seconds))
        assert list(found) == [Reason.CHANNEL_STUCK]
        named, _, length = found[Reason.CHANNEL_STUCK].partition(" for ")
        assert named == name
        assert float(length.removesuffix(" ms")) == pytest.approx(1e3 * seconds, abs=5.0)


@pytest.mark.parametrize("name", CHANNELS)
def test_bridged_channel_is_named(name: str) -> None:
    for seed in (None, 2, 1, 6):
        found = outcome(seed, faults.frozen(name, 0.5, 0.05, bridged=True))
        assert list(found) == [Reason.CHANNEL_BRIDGED]
        assert name in found[Reason.CHANNEL_BRIDGED]


@pytest.mark.parametrize("step_m_per_s2", [0.0, 6e-4, 2.4e-3, 9.6e-3, 0.038, 0.077])
def test_sound_channel_is_neither_frozen_nor_bridged(step_m_per_s2: float) -> None:
    """Fine and coarse converters: 16 bits over ±2 g to 12 bits over ±16 g."""
    for seed in (None, *range(8)):
        assert outcome(seed, faults.NOTHING, step_m_per_s2) == {}


def test_saturated_channel_is_not_frozen() -> None:
    assert outcome(None, faults.saturated(CHANNELS[2])) == {}


def test_frozen_channel_is_rejected_before_any_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_fit(*_: object) -> None:
        raise AssertionError("a fit was begun")

    monkeypatch.setattr(identify, "identify_pre", no_fit)
    result = faults.identified(faults.crossing(Truth(), faults.frozen(CHANNELS[3], 1.0, 0.05)))
    assert (result.verdict, result.reasons) == ("rejected", (Reason.CHANNEL_STUCK,))
    assert result.reason_texts[0].startswith("A channel repeats one value: unsprung_rear for 5")
