"""A channel whose delay or gain changes within the record is named, wherever and in any channel.

How far sound crossings lie from the thresholds stands in studies/faults.md.
"""

from typing import NamedTuple

import numpy as np
import pytest

import driveby
from pre_core.crossing import slip
from pre_core.crossing.channels import A_1, A, V, Z
from schemas.reasons import Reason
from schemas.signals import CHANNELS
from services.common.arrays import Floats
from services.identification import checks, fit_reasons
from services.identification.checks import FitDiagnostics
from tests.verdicts import faults
from tests.verdicts.faults import Fault, Truth

S1, S2, U1, U2 = CHANNELS


class Slip(NamedTuple):
    """Samples lost by a channel at a time since the entry, at a rate."""

    name: str
    samples: int = 1
    at_s: float = 1.7
    rate_hz: float = 1000.0


def check(one: Slip) -> None:
    truth = Truth(rate_hz=one.rate_hz)
    fault = faults.slipped(one.name, one.samples, one.at_s)
    result = faults.identified(faults.crossing(truth, fault))
    assert result.verdict == "rejected"
    assert Reason.CHANNEL_SLIPPED in result.reasons
    assert result.reason_texts[result.reasons.index(Reason.CHANNEL_SLIPPED)].count("_") == 1


def test_one_lost_sample_of_2_khz_is_named() -> None:
    check(Slip(S1, rate_hz=2000.0))


MANY = [
    *(Slip(name, at_s=at_s) for name in CHANNELS for at_s in (-1.5, 0.0, 1.7, 4.5)),
    *(Slip(name, rate_hz=rate_hz) for name in CHANNELS for rate_hz in (200.0, 500.0, 2000.0)),
    *(Slip(name, samples) for name in CHANNELS for samples in (2, 10, 50)),
]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("one", MANY)
def test_lost_samples_are_named_anywhere(one: Slip) -> None:
    check(one)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_changed_gain_is_named(factor: float) -> None:
    result = faults.identified(faults.crossing(Truth(), faults.louder(U1, factor, 1.7)))
    assert result.verdict == "rejected"
    assert Reason.GAIN_CHANGED in result.reasons
    assert U1 in result.reason_texts[result.reasons.index(Reason.GAIN_CHANGED)]


def test_missing_excitation_is_stated_next_to_a_step() -> None:
    """A flat road excites the truck no more than the sensors' noise is: 5.5 mm/s² at 1 kHz."""
    noise = np.random.default_rng(1).standard_normal((4, 5000))
    densities, step_s = (25.0,) * 4, 1e-3
    output = checks.weak_excitation(densities, 1.7 * 5.48e-3 * noise, step_s)
    assert output.startswith(
        "but the RMS of all accelerations is at most 1.7 times the sensors' noise"
    )
    louder = 5.48e-3 * noise * np.array([[1.0], [1.0], [1.0], [4.0]])
    assert checks.weak_excitation(densities, louder, step_s) == ""
    assert checks.weak_excitation((0.0,) * 4, louder, step_s) == ""


@pytest.mark.slow
def test_flat_road_is_rejected_for_missing_excitation() -> None:
    flat = driveby.simulate(
        scenario=6, noise=25.0, gps_noise=True, seed=2, road=([-200.0, 300.0], [0.0, 0.0])
    )
    (solution,) = driveby.identify(flat).solutions
    assert solution.verdict == "rejected"
    assert "the road hardly excites the truck" in " ".join(solution.crossing.reason_texts)


@pytest.mark.parametrize("rate_hz", [pytest.param(200.0, marks=pytest.mark.slow), 1000.0])
def test_sound_channels_show_no_step(rate_hz: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Below the threshold by a factor of 1.5 and more."""
    seen: list[FitDiagnostics] = []

    def kept(names: tuple[str, ...], fit: FitDiagnostics) -> dict[Reason, str]:
        seen.append(fit)
        return real(names, fit)

    real = checks.steps_of_channels
    monkeypatch.setattr(fit_reasons, "steps_of_channels", kept)
    truth = Truth(rate_hz=rate_hz, seed=int(rate_hz))
    fault = Fault(site=faults.believed_nearly(int(rate_hz)))
    result = faults.identified(faults.crossing(truth, fault))
    assert result.verdict == "good", result.reasons
    (fit,) = seen
    assert fit.step is not None
    assert abs(fit.step.z) < 4.0


@pytest.mark.parametrize(("size_s", "is_named"), [(9e-5, False), (1.1e-4, True), (-1e-3, True)])
def test_delay_that_changes_by_less_than_a_sample_is_no_slip(size_s: float, is_named: bool) -> None:
    nothing = np.zeros(1)
    step = slip.Step(slip.DELAY, 0, 1.0, size_s, float(np.sign(size_s)) * 20.0)
    fit = FitDiagnostics(
        np.zeros((1, 3)), 0.01, nothing, 1.6, {}, 0.0, nothing, False, 0.0, step=step
    )
    assert bool(checks.steps_of_channels(CHANNELS, fit)) == is_named


def test_unit_step_is_what_a_late_channel_adds() -> None:
    """A sine that comes early by h from a sample on, integrated as the program does."""
    step_s, moment, h = 1e-3, 300, 1e-6
    time_s = np.linspace(0.0, 0.999, 1000, dtype=np.float64)
    w = 2.0 * np.pi * 3.0

    def sine(at_s: Floats) -> Floats:
        orders = [-np.sin(w * at_s) / w**2, -np.cos(w * at_s) / w, np.sin(w * at_s)]
        orders += [w * np.cos(w * at_s), -(w**2) * np.sin(w * at_s), -(w**3) * np.cos(w * at_s)]
        return np.asarray(np.stack(orders), dtype=np.float64)

    added = h * slip.unit_step(sine(time_s), slip.DELAY, moment, step_s)
    early = sine(np.asarray(time_s + h))
    since_s = time_s[moment:] - time_s[moment]
    change = np.asarray(early - sine(time_s))[:, moment:]
    change[Z] -= change[Z, 0] + change[V, 0] * since_s
    change[V] -= change[V, 0]
    assert not added[:, :moment].any()
    for order, scale in ((Z, w**-2), (V, 1.0 / w), (A, 1.0), (A_1, w)):
        np.testing.assert_allclose(added[order, moment:], change[order], atol=5e-9 * scale)
