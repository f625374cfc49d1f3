"""Road profiles: their class, the golden car, the tyre's contact patch."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.signal import periodogram, welch

from pre_core.arrays import FloatArray
from pre_core.physics import road
from pre_core.physics.road import (
    GEOMETRIC_MEAN_M3,
    Profile,
    contact_patch_average,
    golden_car_matrices,
    iri_m_per_km,
    iso_8608_class,
    iso_8608_profile,
    roughness_coefficient_m3,
    under_wheels,
)
from pre_core.physics.simulate import constant_speed
from services.common.language import ENGLISH

Agree = Callable[[str, float, float, float], None]


def test_golden_car_matrices(known_answers: dict[str, Any], measured: Agree) -> None:
    """World Bank Technical Paper 46 prints seven digits, computed in single precision."""
    known = known_answers["iri_golden_car_world_bank_dx_0.25_m_80_km_h"]
    transition, gain = golden_car_matrices(0.25)
    published = np.column_stack([known["state_transition"], known["input"]])
    difference = np.abs(np.column_stack([transition, gain]) - published)
    measured(
        "golden car: largest error of a published matrix entry, relative to the largest of its row",
        0.0,
        float((difference / np.abs(published).max(axis=1, keepdims=True)).max()),
        1e-6,
    )
    # On a constant slope of 1 the car ends up following it.
    np.testing.assert_allclose(transition @ [1.0, 0.0, 1.0, 0.0] + gain, [1, 0, 1, 0], atol=1e-12)


def measured_profile(folder: Path) -> Profile:
    """The published profile from its third sample on: there the published figures begin."""
    data = np.loadtxt(folder / "iri" / "profile_1.txt")[2:]
    return Profile(data[:, 0], data[:, 1])


@pytest.mark.parametrize(("name", "most"), [("A", 3.0), ("B", 6.0)])
def test_iri_at_the_limit_of_a_class_is_that_of_the_glossary(name: str, most: float) -> None:
    """The limit is twice the geometric mean; the mean of two equal paths has half of one's."""
    profile = iso_8608_profile(0.0, 2000.0, 0.05, name, 1)
    at_limit = Profile(profile.x_m, np.sqrt(2.0) * profile.height_m)
    assert iri_m_per_km(at_limit)[0] == pytest.approx(most, rel=0.05)


def test_class_and_iri_may_disagree_near_a_limit_as_the_glossary_says() -> None:
    """Class A with 3.2 m/km is no error: the two weight the waves of one profile differently."""
    both = []
    for seed in range(20):
        profile = iso_8608_profile(0.0, 30.0, 0.1, "A", seed)
        at_limit = Profile(profile.x_m, np.sqrt(2.0) * profile.height_m)
        roughness = roughness_coefficient_m3(at_limit)
        both.append((iso_8608_class(roughness), iri_m_per_km(at_limit)[0]))
    assert any(name == "A" and iri > 3.1 for name, iri in both)
    (meaning,) = (one.meaning for one in ENGLISH.glossary if one.word.startswith("IRI"))
    assert "Near a limit the two may disagree" in meaning


def test_iri_of_a_measured_profile(
    known_answers: dict[str, Any], reference_folder: Path, agree: Agree
) -> None:
    """The published figures come out to their last digit when the filter starts on the mean slope
    of the first 0.5 s (11.11 m), not of 11 m, and the segments begin 0.5 m into the profile."""
    expect = known_answers["iri_measured_profile"]["expect"]
    profile = measured_profile(reference_folder)
    segments = iri_m_per_km(profile, 20.0)
    assert segments.size == 27
    agree(
        "IRI: mean of 27 segments of 20 m, m/km",
        expect["mean_of_27_segments_of_20_m_m_per_km"],
        float(segments.mean()),
        2e-6,
    )
    hundreds = iri_m_per_km(profile, 100.0)
    assert hundreds.size == 5
    for i, known in enumerate(expect["segments_100_m"]):
        agree(f"IRI: segment {i + 1} of 100 m, m/km", known, float(hundreds[i]), 2e-5)


def test_iri_does_not_depend_on_the_sampling() -> None:
    """The same road, band-limited, sampled at 0.25 m and at 0.05 m: 2 %, since the filter takes the
    slope for constant over a sample."""
    fine = iso_8608_profile(0.0, 200.0, 0.05, "B", 2, shortest_wave_m=2.0)
    coarse = Profile(fine.x_m[::5], fine.height_m[::5])
    assert iri_m_per_km(fine)[0] == pytest.approx(iri_m_per_km(coarse)[0], rel=0.02)


def test_iri_of_a_sine_against_the_differential_equation() -> None:
    """The golden car driven at 80 km/h over a sine in continuous time, without matrices or slopes
    (0.05 m; the moving average of 0.25 m is applied to the sine analytically)."""
    wave, amplitude, v = 8.0, 0.002, 80.0 / 3.6
    x = np.arange(0.0, 400.0, 0.05)
    profile = Profile(x, amplitude * np.sin(2.0 * np.pi * x / wave))
    k = 2.0 * np.pi / wave * v

    def rates(t: float, z: FloatArray) -> list[float]:
        height = amplitude * np.sinc(0.25 / wave) * np.sin(k * t)
        spring = 63.3 * (z[2] - z[0]) + 6.0 * (z[3] - z[1])
        return [z[1], spring, z[3], (653.0 * (height - z[2]) - spring) / 0.15]

    t = x[(x > 200.0) & (x < 392.0)] / v
    run = solve_ivp(rates, (0.0, 400.0 / v), np.zeros(4), t_eval=t, rtol=1e-8, atol=1e-10)
    expected = 1000.0 * np.abs(run.y[1] - run.y[3]).mean() / v
    ours = iri_m_per_km(profile, 8.0)
    assert ours[30:45].mean() == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize("name", list("ABCDE"))
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_class_of_a_generated_profile_is_recovered(name: str, seed: int) -> None:
    """A profile of 250 m every 0.1 m: the level within a quarter (its scatter is 7 %)."""
    profile = iso_8608_profile(-20.0, 230.0, 0.1, name, seed)
    coefficient = roughness_coefficient_m3(profile)
    assert iso_8608_class(coefficient) == name
    assert coefficient == pytest.approx(GEOMETRIC_MEAN_M3[name], rel=0.25)


@pytest.mark.parametrize("length_m", [40.0, 60.0, 100.0])
def test_class_of_a_short_profile_is_recovered_without_bias(length_m: float) -> None:
    """As short as the compared stretch of a bridge: the geometric mean over 20 seeds within 20 %,
    and at most one of them a class off (limits are a factor of 2 away)."""
    levels = [
        roughness_coefficient_m3(iso_8608_profile(0.0, length_m, 0.05, "B", seed)) / 64e-6
        for seed in range(20)
    ]
    assert np.exp(np.mean(np.log(levels))) == pytest.approx(1.0, rel=0.2)
    assert sum(iso_8608_class(level * 64e-6) != "B" for level in levels) <= 1


def test_classes_match_the_standard(known_answers: dict[str, Any], agree: Agree) -> None:
    table = known_answers["iso_8608"]
    for name, known in table["geometric_mean_Gd_n0_m3"].items():
        assert iso_8608_class(known) == name
        agree(f"ISO 8608, G_d(n_0): class {name}, m^3", known, GEOMETRIC_MEAN_M3[name], 1e-12)
    limit = table["upper_limit_of_A_m3"]
    assert iso_8608_class(0.999 * limit) == "A"
    assert iso_8608_class(1.001 * limit) == "B"


def test_spectrum_of_generated_profiles_follows_the_standard(measured: Agree) -> None:
    """Raw periodograms (no window, no class fit) of 40 profiles of class C, averaged by octave:
    within 10 % of G_d(n_0)(n/n_0)^-2, and the slope of a free fit -2."""
    total = np.zeros(0)
    for seed in range(40):
        profile = iso_8608_profile(0.0, 100.0, 0.1, "C", seed)
        n, density = periodogram(profile.height_m, fs=10.0, window="hann", detrend=False)
        total = density if total.size == 0 else total + density
    mean = total / 40.0
    centres, levels = [], []
    for k in range(6):
        octave = (n >= 0.05 * 2.0**k) & (n < 0.1 * 2.0**k)
        ratio = mean[octave] / (256e-6 * (n[octave] / 0.1) ** -2.0)
        assert ratio.mean() == pytest.approx(1.0, rel=0.15)
        centres.append(np.log(0.07 * 2.0**k))
        levels.append(np.log(ratio.mean()))
    slope = -2.0 + np.polyfit(centres, levels, 1)[0]
    measured("ISO 8608: slope of generated spectra", -2.0, float(slope), 0.05)


def test_variance_is_the_integral_of_the_density() -> None:
    """Mean square over many seeds against G_0 n_0^2 (1/n_low - 1/n_high)."""
    squares = [
        np.mean(iso_8608_profile(0.0, 100.0, 0.25, "A", seed, longest_wave_m=10.0).height_m ** 2)
        for seed in range(30)
    ]
    expected = 16e-6 * 0.1**2 * (1.0 / 0.1 - 1.0 / 2.0)
    assert np.mean(squares) == pytest.approx(expected, rel=0.05)


def test_no_wave_is_shorter_than_two_samples() -> None:
    """Coarsely sampled, short waves would fold back and raise the spectrum near the limit; they are
    left out, so that the level there is that of the standard."""
    total = 0.0
    for seed in range(30):
        profile = iso_8608_profile(0.0, 200.0, 0.5, "A", seed)
        n, density = periodogram(profile.height_m, fs=2.0, window="hann", detrend=False)
        band = (n > 0.85) & (n < 0.95)
        total += float(np.mean(density[band] / (16e-6 * (n[band] / 0.1) ** -2.0))) / 30.0
    assert total == pytest.approx(1.0, rel=0.1)


def test_profile_is_the_sum_of_its_waves() -> None:
    """The transform against the sum written out, for a stretch longer and one shorter than the
    longest wave."""
    for stop in (80.0, 10.0):
        profile = iso_8608_profile(-5.0, stop, 0.5, "D", 9)
        samples = profile.x_m.size
        period = max(4 * (samples - 1), 200) * 0.5
        n = np.arange(0.01, 1.0, 1.0 / period)
        phase = np.random.default_rng(9).uniform(0.0, 2.0 * np.pi, n.size)
        amplitude = np.sqrt(2.0 * 1024e-6 * (n / 0.1) ** -2.0 / period)
        waves = amplitude * np.cos(2.0 * np.pi * np.outer(profile.x_m, n) + phase)
        np.testing.assert_allclose(profile.height_m, waves.sum(axis=1), atol=1e-12)


def test_same_seed_same_road() -> None:
    one, again, other = (iso_8608_profile(0.0, 50.0, 0.1, "A", s) for s in (1, 1, 2))
    np.testing.assert_array_equal(one.height_m, again.height_m)
    assert not np.allclose(one.height_m, other.height_m)


@given(wave=st.floats(0.3, 5.0), patch=st.floats(0.03, 0.5), phase=st.floats(0.0, 6.3))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_contact_patch_multiplies_a_wave_by_its_sinc(
    wave: float, patch: float, phase: float
) -> None:
    """Any length of patch, whether or not it is a whole number of samples (0.02 m)."""
    x = np.arange(0.0, 20.0, 0.02)
    height = np.sin(2.0 * np.pi * x / wave + phase)
    felt = contact_patch_average(Profile(x, height), patch).height_m
    inner = slice(50, -50)
    np.testing.assert_allclose(felt[inner], np.sinc(patch / wave) * height[inner], atol=2e-4)


def test_contact_patch_keeps_level_and_grade_and_a_length_of_zero_keeps_all() -> None:
    x = np.arange(0.0, 10.0, 0.05)
    grade = Profile(x, 0.3 + 0.02 * x)
    felt = contact_patch_average(grade, 0.25)
    np.testing.assert_allclose(felt.height_m[5:-5], grade.height_m[5:-5], atol=1e-12)
    np.testing.assert_array_equal(contact_patch_average(grade, 0.0).height_m, grade.height_m)


@pytest.mark.parametrize("direction", [1, -1])
def test_road_under_the_wheels(direction: int) -> None:
    """Height and its rate of change in time for a wave known in closed form, both ways."""
    x = np.arange(-20.0, 60.0, 0.02)
    profile = Profile(x, 0.01 * np.sin(x))
    motion = constant_speed(10.0, direction * 12.0, 500, 0.001)
    road = under_wheels(profile, motion, 4.4, direction)
    front = 10.0 + direction * 12.0 * 0.001 * np.arange(500)
    for w, at in enumerate((front, front - direction * 4.4)):
        np.testing.assert_allclose(road.height_m[:, w], 0.01 * np.sin(at), atol=1e-9)
        rate = 0.01 * np.cos(at) * direction * 12.0
        np.testing.assert_allclose(road.rate_m_per_s[:, w], rate, atol=1e-6)


def test_a_road_that_is_too_short_is_refused() -> None:
    profile = iso_8608_profile(0.0, 10.0, 0.1, "A", 1)
    with pytest.raises(ValueError, match="does not reach under"):
        under_wheels(profile, constant_speed(5.0, 10.0, 1000, 0.001), 4.4, 1)


@pytest.mark.parametrize(("count", "length"), [(300, 300), (301, 301), (1000, 300), (1003, 301)])
def test_spectrum_of_a_profile_is_welchs(count: int, length: int) -> None:
    """Against scipy's: one segment and several, of an even and of an odd number of values."""
    height = np.cumsum(np.random.default_rng(0).standard_normal(count))
    frequency, density = road._welch(height, 0.1, length)
    expected = welch(height, fs=10.0, nperseg=length, detrend="linear")
    np.testing.assert_allclose(frequency, expected[0], rtol=1e-12)
    np.testing.assert_allclose(density, expected[1], rtol=1e-9)
