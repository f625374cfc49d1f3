"""Stamped samples as even batches: rate, gaps, repeats, jitter, drift, clocks that step."""

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.errors import InputError
from services.drives.ros2_anomalies import AnomalyCounts
from services.drives.ros2_samples import Resampler, SampleBlock

TOPIC = "/imu"
FIRST_NS = 1_700_000_000_000_000_000
MISSING = "samples missing, left as gaps"
PAST = "stamps repeated or in the past, left out"
OFF = "stamps off by over a tenth of the interval"
BACK = "steps back of the clock"


def taken(
    stamps_ns: NDArray[np.int64], values: NDArray[np.float64] | None = None, declared: float = 200.0
) -> tuple[list[SampleBlock], AnomalyCounts]:
    anomalies = AnomalyCounts()
    even = Resampler(TOPIC, declared, "site.toml", anomalies)
    values = np.arange(stamps_ns.size) % 9000.0 if values is None else values
    pieces: list[SampleBlock] = []
    for stamp, value in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        pieces += even.add(stamp, value)
    return pieces + even.finish(), anomalies


def stamps(count: int, rate_hz: float = 200.0) -> NDArray[np.int64]:
    return FIRST_NS + np.rint(np.arange(count) * 1e9 / rate_hz).astype(np.int64)


def times_ns(pieces: list[SampleBlock]) -> NDArray[np.int64]:
    return np.concatenate(
        [
            p.wall_time_ns + np.rint(np.arange(p.samples.size) * 1e9 / p.rate_hz).astype(np.int64)
            for p in pieces
        ]
    )


def values(pieces: list[SampleBlock]) -> list[float]:
    return np.concatenate([piece.samples for piece in pieces]).tolist()  # type: ignore[no-any-return]


def test_even_samples_are_untouched_and_batches_are_a_tenth_of_a_second() -> None:
    at = stamps(1005)
    pieces, anomalies = taken(at)
    assert [piece.samples.size for piece in pieces] == [20] * 50 + [5]
    assert {piece.rate_hz for piece in pieces} == {200.0}
    np.testing.assert_array_equal(times_ns(pieces), at)
    assert values(pieces) == list(range(1005))
    assert anomalies.news() == []


def test_a_rate_that_is_no_whole_number_is_measured_and_followed() -> None:
    at = stamps(20_000, 200.8)
    pieces, anomalies = taken(at)
    assert pieces[0].rate_hz == pytest.approx(200.8, rel=1e-9)
    np.testing.assert_allclose(times_ns(pieces), at, atol=1000, rtol=0)
    assert anomalies.news() == []


def test_a_crystal_that_drifts_is_followed() -> None:
    """By 100 ppm over 200 s, a hundred times what a crystal does."""
    number = np.arange(40_000)
    at = FIRST_NS + np.rint((number + 0.5e-4 * number**2 / number[-1]) * 5e6).astype(np.int64)
    pieces, anomalies = taken(at)
    # It is behind by 64 intervals' worth of the error of the rate.
    assert np.abs(times_ns(pieces) - at).max() < 64 * 1e-4 * 5e6 * 1.5
    assert anomalies.news() == []


def test_gaps_are_gaps() -> None:
    lost = {500, 501, 502, 800}
    kept = np.array([number for number in range(1000) if number not in lost])
    pieces, anomalies = taken(stamps(1000)[kept], kept.astype(float))
    np.testing.assert_array_equal(times_ns(pieces), stamps(1000)[kept])
    assert values(pieces) == kept.tolist()
    assert anomalies.count(TOPIC, MISSING) == len(lost)
    for piece in pieces:  # none reaches over a gap
        assert np.all(np.diff(piece.samples) == 1.0)


def test_a_long_silence_begins_the_line_anew() -> None:
    before, after = stamps(600), stamps(600) + 3_600_001_700_000
    pieces, _ = taken(np.concatenate([before, after]))
    np.testing.assert_array_equal(times_ns(pieces), np.concatenate([before, after]))


def test_what_comes_twice_or_late_is_left_out() -> None:
    at = np.insert(stamps(1000), [600, 700], [stamps(1000)[599], stamps(1000)[650]])
    number = np.insert(np.arange(1000.0), [600, 700], [599.0, 650.0])
    pieces, anomalies = taken(at, number)
    assert values(pieces) == list(range(1000))
    assert anomalies.count(TOPIC, PAST) == 2


def test_values_that_no_sensor_can_have_are_gaps() -> None:
    measured = np.arange(1000.0)
    measured[[450, 700]] = math.nan, 1e5
    pieces, anomalies = taken(stamps(1000), measured)
    kept = np.delete(np.arange(1000), [450, 700])
    np.testing.assert_array_equal(times_ns(pieces), stamps(1000)[kept])
    assert values(pieces) == kept.tolist()
    assert anomalies.count(TOPIC, "samples not finite or too large, left as gaps") == 2


def test_jittering_stamps_are_reported_and_smoothed() -> None:
    noise = np.random.default_rng(1).normal(0, 0.08 * 5e6, 4000)
    at = stamps(4000) + np.rint(noise).astype(np.int64)
    pieces, anomalies = taken(at)
    assert values(pieces) == list(range(4000))
    error = times_ns(pieces) - stamps(4000)
    assert error.std() < 0.02 * 5e6
    # Two of ten lie beyond 1.25 standard deviations.
    assert anomalies.count(TOPIC, OFF) == pytest.approx(0.21 * 4000, rel=0.15)
    assert anomalies.count(TOPIC, MISSING) == 0


def test_clock_that_goes_back_is_reported_and_followed() -> None:
    at = np.concatenate([stamps(1000), stamps(1000) - 7_000_000_000])
    pieces, anomalies = taken(at)
    assert anomalies.count(TOPIC, BACK) == 1
    assert anomalies.count(TOPIC, PAST) == 201  # a second of it
    np.testing.assert_array_equal(times_ns(pieces)[-799:], at[-799:])


@pytest.mark.parametrize("rate_hz", [100.0, 400.0, 1000.0, 5000.0, 150.0])
def test_another_rate_than_the_declared_one_is_refused(rate_hz: float) -> None:
    with pytest.raises(InputError, match=r"/imu: its stamps give a rate of .* site.toml is 200 Hz"):
        taken(stamps(6000, rate_hz))


def test_too_few_samples_have_no_rate() -> None:
    pieces, anomalies = taken(stamps(9))
    assert pieces == []
    assert anomalies.news() == ["/imu: 9 samples, too few to measure their rate"]
    pieces, _ = taken(stamps(10))
    assert values(pieces) == list(range(10))


def test_complaints_are_logged_once_with_their_first_example() -> None:
    anomalies = AnomalyCounts()
    anomalies.add("/a", "x", 2, example="the first")
    anomalies.add("/a", "x", example="the second")
    anomalies.add("/b", "y", 0)
    assert anomalies.news() == ["/a: 3 x (the first)"]
    assert anomalies.news() == []
    anomalies.add("/a", "x")
    assert anomalies.news() == ["/a: 4 x (the first)"]


def test_batches_never_overlap() -> None:
    rng = np.random.default_rng(2)
    at = FIRST_NS + np.cumsum(rng.choice([5_000_000, 5_400_000, 4_600_000, 10_000_000], 3000))
    pieces, _ = taken(at)
    for before, after in pairwise(pieces):
        end_ns = before.wall_time_ns + before.samples.size * 1e9 / before.rate_hz
        assert after.wall_time_ns > end_ns - 0.5 * 5e6
