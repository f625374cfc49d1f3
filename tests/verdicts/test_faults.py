"""Every fault through method `pre`: its cause is named, or the answer is right all the same.

Not `good`, or every EI within three standard deviations. Dampers that are not linear are no fault:
they get an answer. studies/faults.md has the table (`python -m tests.verdicts.measure`).
"""

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pytest

from pre_core.crossing import optimum, sampling
from pre_core.crossing.fit import Optimum
from pre_core.crossing.sampling import PosteriorDraws
from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS
from services.identification import fit_reasons, pre_method
from tests.verdicts import faults
from tests.verdicts.faults import Case, Fault, Truth

S1, S2, U1, U2 = CHANNELS
PAPER = Truth(seed=21)
LOUD = PAPER._replace(noise_ug_per_rthz=100.0)
LONG = PAPER._replace(before_s=8.0)
VEHICLE = PAPER.site.vehicles[0]


class Row(NamedTuple):
    """A fault, and the reasons of which at least one must be named; none: any that is true."""

    fault: Fault
    named: frozenset[str] = frozenset()
    truth: Truth = PAPER
    is_on_bridge: bool = False
    """Whether the text says that the misfit is confined to the bridge."""


def believed(**factors: float) -> Fault:
    """A site file whose truck has values off by factors."""
    return Fault(
        site=faults.vehicle_believed(
            **{key: getattr(VEHICLE, key) * factor for key, factor in factors.items()}
        )
    )


def gone(begin_s: float, end_s: float) -> Fault:
    """Samples are lost between two times since the entry."""
    return Fault(kept=lambda t: (t < begin_s) | (t > end_s))


MISFIT = frozenset({"model_misfit", "residuals_coloured"})
OTHER_TRUCK = Fault(
    site=faults.vehicle_believed(
        suspension_stiffness_n_per_m=(1.4 * 456e3, 0.6 * 410e3),
        suspension_damping_ns_per_m=(0.6 * 24200.0, 1.4 * 29000.0),
        tyre_stiffness_n_per_m=(0.6 * 4.79e6, 1.4 * 4.31e6),
        unsprung_mass_kg=(1.4 * 469.0, 0.6 * 751.0),
    )
)
TABLE: dict[str, Row] = {
    "bilinear dampers 10 %": Row(Fault(car=lambda car: car._replace(bilinear_damping=0.1))),
    "bilinear dampers 10 %, 100 µg/√Hz": Row(
        Fault(car=lambda car: car._replace(bilinear_damping=0.1)), truth=LOUD
    ),
    "wheelbase +3 %": Row(believed(wheelbase_m=1.03), MISFIT | {"implausible_vehicle"}),
    "wheelbase -3 %": Row(believed(wheelbase_m=0.97), MISFIT | {"implausible_vehicle"}),
    **{
        f"{a} and {b} swapped": Row(faults.swapped(a, b), frozenset({"channel_swapped"}))
        for a, b in combinations(CHANNELS, 2)
    },
    **{f"{a} inverted": Row(faults.inverted(a), frozenset({"channel_inverted"})) for a in CHANNELS},
    **{
        f"{a} saturated at half": Row(faults.saturated(a), frozenset({"sensor_saturated"}))
        for a in CHANNELS
    },
    "400 ms gap on the bridge": Row(gone(1.5, 1.9), frozenset({"gap_on_bridge"})),
    "GPS outage of 5 s": Row(Fault(outage_s=(-1.0, 4.0)), frozenset({"position_outage"}), LONG),
    "GPS outage of 5 s at 4 m/s": Row(
        Fault(outage_s=(2.0, 7.0)),
        frozenset({"position_outage"}),
        LONG._replace(speed_m_per_s=(4.0, 4.0)),
    ),
    "second vehicle of 5 t": Row(Fault(second_vehicle_kg=5000.0), MISFIT, is_on_bridge=True),
    "second vehicle of 1 t": Row(Fault(second_vehicle_kg=1000.0)),
    "second vehicle of 5 t, 100 µg/√Hz": Row(Fault(second_vehicle_kg=5000.0), MISFIT, LOUD),
    "rear road 10 % rougher": Row(Fault(rear_road=1.1)),
    "rear road 10 % rougher, 100 µg/√Hz": Row(Fault(rear_road=1.1), truth=LOUD),
    "2 m/s": Row(Fault(), frozenset({"speed_too_low"}), PAPER._replace(speed_m_per_s=(2.0, 2.0))),
    "span +10 %": Row(Fault(site=faults.span_believed(1.1)), MISFIT, is_on_bridge=True),
    "span -10 %": Row(Fault(site=faults.span_believed(0.9)), MISFIT, is_on_bridge=True),
    "span +10 %, 100 µg/√Hz": Row(Fault(site=faults.span_believed(1.1)), truth=LOUD),
    "noise 3 times the declared": Row(Fault(noise=3.0), frozenset({"noise_above_declared"})),
    "noise 100 times the declared, 0.25 µg/√Hz": Row(
        Fault(noise=100.0),
        MISFIT | {"noise_above_declared"},
        PAPER._replace(noise_ug_per_rthz=0.25),
    ),
    "noise half the declared": Row(Fault(noise=0.5), frozenset({"noise_below_declared"})),
    "clock jitter of 50 µs": Row(Fault(jitter_s=5e-5)),
    "an axle's channel at 100 Hz": Row(Fault(slow=U1)),
    "a body's channel at 100 Hz": Row(Fault(slow=S1)),
    "a channel stuck": Row(faults.stuck(U2, 1.0), frozenset({"channel_stuck"})),
    "all channels alike": Row(Fault(channels=faults.alike), frozenset({"channels_alike"})),
    "spikes": Row(faults.spiked(U1, 20.0), frozenset({"signal_spikes"})),
    "a bias of 1 m/s²": Row(faults.biased(S1, 1.0)),
    "a truck 40 % different": Row(OTHER_TRUCK),
}


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", TABLE)
def test_a_fault_is_recognised_or_harmless(name: str) -> None:
    row = TABLE[name]
    case = faults.crossing(row.truth, row.fault)
    result = faults.identified(case)
    if "bilinear" in name:
        assert result.parameters is not None, result.reasons
    if result.verdict == "good":
        assert np.abs(faults.z_scores(case, result)).max() < 3.0, faults.z_scores(case, result)
    if row.named:
        assert row.named & set(result.reasons), result.reasons
    if row.is_on_bridge:
        assert any("only on the bridge" in text for text in result.reason_texts)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", [20, 21, 22, 23])
def test_a_sound_crossing_is_good(seed: int) -> None:
    """Negative control: without a fault there is nothing to recognise."""
    truth = PAPER._replace(seed=seed)
    case: Case = faults.crossing(truth, Fault(site=faults.believed_nearly(seed)))
    result = faults.identified(case)
    assert result.verdict == "good", result.reasons
    assert np.abs(faults.z_scores(case, result)).max() < 4.0


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_wrong_mass_is_carried_in_the_interval_and_nowhere_else() -> None:
    """No residual shows it: EI is proportional to the mass that the owner believes in."""
    result = faults.identified(faults.crossing(PAPER, believed(total_mass_kg=1.1)))
    sound = faults.identified(faults.crossing(PAPER))
    assert result.parameters is not None
    assert sound.parameters is not None
    for e in range(1, 8):
        ratio = result.parameters[f"EI_{e}"].mean / sound.parameters[f"EI_{e}"].mean
        assert ratio == pytest.approx(1.1, abs=0.03)


def test_a_fit_that_explains_nothing_is_given_up_before_the_chains(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Noise declared a hundred times too small: chi2 in the ten thousands, whatever its pattern."""

    def no_chains(*_: object) -> None:
        raise AssertionError("chains were begun")

    monkeypatch.setattr(pre_method, "sample", no_chains)
    truth = PAPER._replace(noise_ug_per_rthz=0.25)
    result = faults.identified(faults.crossing(truth, Fault(noise=100.0)))
    assert result.verdict == "rejected"
    assert "failed" not in result.reasons
    assert set(result.reasons) & (MISFIT | {"noise_above_declared"})
    assert result.parameters is None
    assert result.chi2_per_dof is not None
    assert result.chi2_per_dof > 1000.0
    # The coarse steps determine the noise: no place along the road is looked at.
    assert result.diagnostics["starts"] == 0.0
    assert result.diagnostics["iterations"] < 2000


RULED = IdentificationSettings(method="pre", seed=0, draws=300)


@pytest.fixture(scope="module")
def fit_of_loud() -> Optimum:
    """The fit of a sound crossing, of which no chains are begun."""
    found: list[Optimum] = []
    real = optimum.find_optimum

    def kept(*arguments: object) -> Optimum:
        found.append(real(*arguments))  # type: ignore[arg-type]
        return found[-1]._replace(chi2_per_dof=1000.0)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(optimum, "find_optimum", kept)
        patch.setattr(fit_reasons, "reasons_after_fit", lambda *_: [Reason.MODEL_MISFIT])
        faults.identified(faults.crossing(LOUD), RULED)
    (fit,) = found
    return fit


@pytest.mark.parametrize(
    ("chi2", "pattern", "verdict"),
    [
        (24.0, Reason.NOISE_ABOVE_DECLARED, "suspect"),
        (26.0, Reason.NOISE_ABOVE_DECLARED, "rejected"),
        (2.1, Reason.MODEL_MISFIT, "rejected"),
        (1.9, Reason.MODEL_MISFIT, "suspect"),
    ],
)
def test_how_large_chi2_may_be_depends_on_the_pattern_up_to_25(
    monkeypatch: pytest.MonkeyPatch,
    fit_of_loud: Optimum,
    chi2: float,
    pattern: Reason,
    verdict: str,
) -> None:
    """The very fit of a sound crossing, said to be as bad as that: only the rule is looked at.

    Draws are those of the sound noise: of 24 times as much they take chains, and 20 s.
    """
    fit = fit_of_loud._replace(chi2_per_dof=chi2)

    def sample_of_sound(*what: Any, inflation: float, **how: Any) -> PosteriorDraws:
        assert inflation == pytest.approx(np.sqrt(chi2))
        return sampling.sample(*what, **how)

    monkeypatch.setattr(optimum, "find_optimum", lambda *_: fit)
    monkeypatch.setattr(pre_method, "sample", sample_of_sound)
    monkeypatch.setattr(fit_reasons, "reasons_after_fit", lambda *_: [pattern])
    result = faults.identified(faults.crossing(LOUD), RULED)
    assert result.verdict == verdict
    assert pattern in result.reasons
    assert (result.parameters is None) == (verdict == "rejected")
