"""What the accelerations alone show before any fit: every broken channel is named, no sound one is.

The thresholds are in services/identification/checks.py; how far sound and broken signals lie from
them was measured over more drives than these (studies/faults.md, tests/verdicts/measure.py).
"""

from functools import cache
from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from pre_core.diagnostics import quality
from pre_core.diagnostics.converter import converter_step
from pre_core.physics.simulate import Motion
from schemas.reasons import Reason, texts
from schemas.signals import CHANNELS
from services.common.arrays import Floats
from services.identification.signal_checks import reasons_before_fit
from tests.verdicts import faults
from tests.verdicts.faults import Case, Fault, Truth

S1, S2, U1, U2 = CHANNELS


@cache
def sound(seed: int | None) -> tuple[Truth, Case]:
    """The paper's truck at 10 m/s, or a drawn one whose site file knows it to 12 %."""
    if seed is None:
        return Truth(), faults.crossing(Truth())
    truth = faults.drawn(seed)
    return truth, faults.crossing(truth, Fault(site=faults.believed_nearly(seed)))


def reasons(seed: int | None, fault: Fault = faults.NOTHING) -> list[Reason]:
    """Why the channels cannot be used."""
    return list(accused(seed, fault))


def accused(seed: int | None, fault: Fault = faults.NOTHING) -> dict[Reason, str]:
    """As `identification.identify` asks for them, with the true motion."""
    truth, case = sound(seed)
    time_s = case.run.accel_time_s
    channels = fault.channels(case.run.channels, time_s - case.entry_s)
    near = (time_s > case.entry_s - 1.0) & (time_s < case.exit_s + 1.0)
    begin, end = truth.speed_m_per_s
    t = time_s[near] - time_s[near][0]
    rate = (end - begin) / (time_s[-1] - time_s[0])
    direction = 1 if truth.forward else -1
    travelled = begin * t + 0.5 * rate * t**2
    motion = Motion(direction * travelled, direction * (begin + rate * t), np.full(t.size, rate))
    acceleration = np.stack([channels[name][near] for name in CHANNELS])
    return reasons_before_fit(
        case.site.vehicles[0], acceleration, 1.0 / truth.rate_hz, motion, direction
    )


def axles_swapped(channels: dict[str, Floats], _: Floats) -> faults.Channels:
    """The truck's front is called its rear."""
    return {S1: channels[S2], S2: channels[S1], U1: channels[U2], U2: channels[U1]}


def front_inverted(channels: dict[str, Floats], _: Floats) -> faults.Channels:
    """Both sensors of one axle: its body equation still holds."""
    return channels | {S1: -channels[S1], U1: -channels[U1]}


BROKEN: dict[str, tuple[Fault, Reason]] = {
    **{
        f"{a} for {b}": (faults.swapped(a, b), Reason.CHANNEL_SWAPPED)
        for a, b in combinations(CHANNELS, 2)
    },
    "axles swapped": (Fault(channels=axles_swapped), Reason.CHANNEL_SWAPPED),
    **{f"{a} inverted": (faults.inverted(a), Reason.CHANNEL_INVERTED) for a in CHANNELS},
    "front axle inverted": (Fault(channels=front_inverted), Reason.CHANNEL_INVERTED),
    **{f"{a} saturated": (faults.saturated(a), Reason.SENSOR_SATURATED) for a in CHANNELS},
    **{f"{a} stuck": (faults.stuck(a), Reason.CHANNEL_STUCK) for a in CHANNELS},
    "stuck on the bridge": (faults.stuck(U1, 1.0), Reason.CHANNEL_STUCK),
    "all alike": (Fault(channels=faults.alike), Reason.CHANNELS_ALIKE),
    "gravity": (faults.biased(S1, 9.80665), Reason.CHANNEL_BIASED),
    "spikes on an axle": (faults.spiked(U1, 40.0), Reason.SIGNAL_SPIKES),
    "spikes on the body": (faults.spiked(S2, 5.0), Reason.SIGNAL_SPIKES),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_channel_is_named(name: str) -> None:
    fault, reason = BROKEN[name]
    assert reasons(None, fault) == [reason]


@pytest.mark.parametrize("name", BROKEN)
def test_the_reason_names_the_channels(name: str) -> None:
    fault, reason = BROKEN[name]
    (words,) = accused(None, fault).values()
    (sentence,) = texts([reason], {reason: words})
    assert sentence.endswith(f": {words}.")
    concerned = set(CHANNELS) & set(name.split())
    match reason:
        case Reason.CHANNEL_SWAPPED if concerned:
            a, b = sorted(concerned, key=CHANNELS.index)
            assert f"{a} and {b}" in words.split(", or ")
        case Reason.CHANNEL_SWAPPED:
            assert words == "front and rear, of body and axle alike"
        case Reason.CHANNEL_INVERTED:
            assert words == "both of one axle" if not concerned else concerned < set(words.split())
        case Reason.CHANNELS_ALIKE:
            assert f"{S1} and {S2}" in words
        case _:
            assert words in CHANNELS
            assert concerned in (set(), {words})


OTHER = [1, 3, 6]  # 15 t at 500 Hz, 10 t at 1 kHz and 21 m/s, 9 t with a soft front at 2 kHz


@pytest.mark.parametrize("seed", OTHER)
@pytest.mark.parametrize(
    "name", [f"{S1} for {S2}", "axles swapped", f"{U2} inverted", f"{U1} saturated"]
)
def test_a_broken_channel_of_another_truck_is_named(name: str, seed: int) -> None:
    fault, reason = BROKEN[name]
    assert reasons(seed, fault) == [reason]


@pytest.mark.parametrize("seed", range(8))
def test_sound_channels_have_no_reason(seed: int) -> None:
    """Trucks of 6 to 26 t, spans of 12 to 40 m, 5 to 25 m/s, 100 to 2000 Hz, roads A to C."""
    assert reasons(seed) == []


@pytest.mark.parametrize("step_m_per_s2", [0.06, 0.077, 0.15])
@pytest.mark.parametrize("seed", [None, 1, 2, 3])
def test_quantised_channel_is_not_saturated(seed: int | None, step_m_per_s2: float) -> None:
    """16 bits over ±200 g, 12 bits over ±16 g, and twice that."""
    coarse = Fault(channels=lambda channels, _: faults.quantised(channels, step_m_per_s2))
    assert reasons(seed, coarse) == []


@pytest.mark.parametrize("name", [U1, U2])
def test_quantised_channel_that_is_saturated_is_named(name: str) -> None:
    def both(channels: faults.Channels, time_s: Floats) -> faults.Channels:
        return faults.quantised(faults.saturated(name).channels(channels, time_s), 9.6e-3)

    assert accused(None, Fault(channels=both)) == {Reason.SENSOR_SATURATED: name}


def test_converter_step_is_that_of_the_grid() -> None:
    rng = np.random.default_rng(0)
    fine = rng.standard_normal(10_000)
    assert converter_step(fine) == 0.0
    assert converter_step(0.077 * np.round(fine / 0.077)) == pytest.approx(0.077)
    assert converter_step(np.zeros(10)) == 0.0


@pytest.mark.parametrize("range_g", [2.0, 8.0])
def test_a_coarse_converter_is_not_broken(range_g: float) -> None:
    """12 bits: the body's channels hold one value for up to 30 samples."""
    step = 2.0 * range_g * 9.80665 / 2.0**12

    def coarse(channels: faults.Channels, _: Floats) -> faults.Channels:
        return {name: step * np.round(values / step) for name, values in channels.items()}

    _, case = sound(None)
    assert quality.longest_hold(coarse(case.run.channels, case.run.accel_time_s)[S1]) > 1
    assert reasons(None, Fault(channels=coarse)) == []


def test_noise_alone_has_no_order() -> None:
    """Where nothing is felt, nothing is accused."""
    rng = np.random.default_rng(0)
    noise = Fault(channels=lambda c, _: {k: rng.standard_normal(v.size) for k, v in c.items()})
    assert reasons(None, noise) == []


def test_a_pothole_is_no_spike() -> None:
    """A short, hard impact is felt by an axle for milliseconds, not for one sample."""

    def impact(channels: faults.Channels, time_s: Floats) -> faults.Channels:
        ringing = np.exp(-time_s / 0.05) * np.sin(2.0 * np.pi * 13.0 * time_s)
        return channels | {U1: channels[U1] + 60.0 * np.where(time_s > 0.0, ringing, 0.0)}

    assert reasons(None, Fault(channels=impact)) == []


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (faults.swapped(U1, U2), "channel_swapped"),
        (faults.inverted(S2), "channel_inverted"),
        (faults.saturated(U1), "sensor_saturated"),
        (Fault(kept=lambda t: (t < 1.5) | (t > 1.9)), "gap_on_bridge"),
    ],
)
def test_the_crossing_is_rejected_without_a_number(fault: Fault, reason: str) -> None:
    result = faults.identified(faults.crossing(Truth(), fault))
    assert (result.verdict, result.reasons, result.parameters) == ("rejected", (reason,), None)


def test_pile_up_knows_a_smooth_peak_from_a_rail() -> None:
    """The top of a sine is its commonest value, and still no rail."""
    t = np.linspace(0.0, 20.0, 20_001)
    sine = np.sin(2.0 * np.pi * 1.3 * t)
    assert quality.pile_up(sine).ratio < 5.0
    clipped = np.clip(sine, -0.7, 0.7)
    assert quality.pile_up(clipped).ratio > 15.0
    assert quality.pile_up(clipped).visits > 20
    noisy = clipped + 0.001 * np.random.default_rng(0).standard_normal(t.size)
    assert quality.pile_up(noisy).ratio > 8.0


def test_repeats_count_only_where_values_are_fine() -> None:
    rng = np.random.default_rng(0)
    fine = rng.standard_normal(10_000)
    assert quality.repeated_extremes(fine) == 1
    assert quality.repeated_extremes(np.minimum(fine, 2.0)) == np.count_nonzero(fine >= 2.0)
    assert quality.repeated_extremes(np.round(fine, 1)) == 0


def test_spikes_are_counted() -> None:
    rng = np.random.default_rng(0)
    values = np.cumsum(rng.standard_normal(5000)) * 0.1 + rng.standard_normal(5000)
    assert quality.spikes(values) == 0
    values[[700, 2500, 4990]] += [60.0, -60.0, 60.0]
    assert quality.spikes(values) == 3


def test_body_equation_is_exact_for_a_linear_truck() -> None:
    """Without noise what it leaves unexplained is the window's: well below a hundredth."""
    case = faults.crossing(Truth(noise_ug_per_rthz=0.0, before_s=8.0))
    vehicle = case.site.vehicles[0]
    share = np.array([vehicle.cg_to_rear_axle_m, vehicle.front_axle_to_cg_m]) / vehicle.wheelbase_m
    body = vehicle.sprung_mass_kg * share
    found = quality.assign_channels(
        np.stack([case.run.channels[name] for name in CHANNELS]),
        1e-3,
        np.array(vehicle.suspension_stiffness_n_per_m) / body,
        np.array(vehicle.suspension_damping_ns_per_m) / body,
    )
    assert found.recorded < 0.01
    assert min(found.reversed_) > 0.3
    assert found.best > 0.3


@pytest.mark.parametrize("seed", range(20))
def test_least_squares_in_a_box_are_scipys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((40, 3)) @ rng.standard_normal((3, 3))
    right = matrix @ rng.uniform(-2.0, 2.0, 3) + 0.3 * rng.standard_normal(40)
    low, high = np.array([0.25, 0.0, -0.6]), np.array([1.0, 1.0, 0.6])
    x, least = quality.bounded_least_squares(matrix, right, low, high)
    theirs = lsq_linear(matrix, right, (low, high), method="bvls")
    np.testing.assert_allclose(x, theirs.x, atol=1e-9)
    assert least == pytest.approx(2.0 * theirs.cost, rel=1e-9)


@pytest.mark.parametrize("step_m_per_s2", [0.06, pytest.param(0.077, marks=pytest.mark.slow)])
def test_coarse_converter_is_noise_above_the_declared(step_m_per_s2: float) -> None:
    """Not saturated: 16 bits over ±200 g, whose steps are noise three times the declared."""
    coarse = Fault(channels=lambda channels, _: faults.quantised(channels, step_m_per_s2))
    result = faults.identified(faults.crossing(Truth(), coarse))
    assert result.verdict != "good"
    assert Reason.NOISE_ABOVE_DECLARED in result.reasons
    sentence = result.reason_texts[result.reasons.index(Reason.NOISE_ABOVE_DECLARED)]
    assert f"{U1} in steps of {step_m_per_s2:.2g} m/s²" in sentence
