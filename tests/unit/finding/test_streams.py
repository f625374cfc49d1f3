"""Messages to arrays: every sample at its place and its time, whatever way the messages came."""

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.signals import CHANNELS, AccelBatch, AccelChannel, GnssFix, encode_accel, encode_gnss
from services.common.arrays import Floats
from services.finding.streams import PATIENCE_S, Boot, Samples, device_time_ns

NS = 1_000_000_000
START_NS = 7 * 3600 * NS  # the truck has been on for seven hours
WALL_NS = 1_800_000_000 * NS
SIZE = 50


def batch(
    sequence: int,
    time_s: float,
    channels: dict[str, tuple[float, Sequence[float]]],
    wall_shift_s: float = 0.0,
) -> AccelBatch:
    device_ns = START_NS + round(time_s * NS)
    return AccelBatch(
        1,
        sequence,
        device_ns,
        WALL_NS + device_ns + round(wall_shift_s * NS),
        {
            name: AccelChannel(rate, np.asarray(values, float))
            for name, (rate, values) in channels.items()
        },
    )


def batches_of(
    signal: Floats, rate_hz: float = 1000.0, true_rate_hz: float | None = None, size: int = SIZE
) -> list[AccelBatch]:
    """All four channels, channel i being the signal plus i."""
    true = true_rate_hz or rate_hz
    return [
        batch(
            k,
            k * size / true,
            {
                name: (rate_hz, signal[k * size : (k + 1) * size] + i)
                for i, name in enumerate(CHANNELS)
            },
        )
        for k in range(signal.size // size)
    ]


def fix(sequence: int, time_s: float, speed: float = 10.0, wall_shift_s: float = 0.0) -> GnssFix:
    device_ns = START_NS + round(time_s * NS)
    wall_ns = WALL_NS + device_ns + round(wall_shift_s * NS)
    return GnssFix(1, sequence, device_ns, wall_ns, 36.0 + 1e-5 * sequence, 140.0, 5.0, speed)


def boot_with(batches: Sequence[AccelBatch]) -> Boot:
    boot = Boot()
    for one in batches:
        boot.add_accel(one)
    return boot


def samples(boot: Boot, start_s: float, stop_s: float) -> Samples:
    found = boot.samples(START_NS / NS + start_s, START_NS / NS + stop_s)
    assert found is not None
    return found


def relative_times(found: Samples) -> Floats:
    size = found.channels["sprung_front"].size
    return np.asarray(found.start_s - START_NS / NS + np.arange(size) / found.rate_hz)


def test_batches_in_any_order_and_twice_are_one_signal() -> None:
    signal = np.sin(np.arange(2000) * 0.1)
    boot = boot_with([*reversed(batches_of(signal)), *batches_of(signal)])
    found = samples(boot, -1.0, 10.0)
    assert found.rate_hz == 1000.0
    for i, name in enumerate(CHANNELS):
        np.testing.assert_array_equal(found.channels[name], signal + i)
    np.testing.assert_allclose(relative_times(found), np.arange(2000) / 1000.0, rtol=0, atol=1e-9)


def test_named_channels_come_behind_the_four_and_only_those_asked_for() -> None:
    """A channel that nobody asked for must not make the grid of the others."""
    rates = {"unsprung_front": 1000.0, "b": 500.0, "a": 1000.0, "cabin": 2000.0}

    def one(k: int) -> dict[str, tuple[float, Floats]]:
        return {name: (rate, np.full(round(0.05 * rate), 1.0 * k)) for name, rate in rates.items()}

    boot = boot_with([batch(k, 0.05 * k, one(k)) for k in range(40)])
    every = boot.samples(START_NS / NS, START_NS / NS + 2.0)
    assert every is not None
    assert (list(every.channels), every.rate_hz) == (["unsprung_front", "a", "b", "cabin"], 2000.0)
    some = boot.samples(START_NS / NS, START_NS / NS + 2.0, ("a", "b", "absent"))
    assert some is not None
    assert (list(some.channels), some.rate_hz, some.slowest_rate_hz) == (["a", "b"], 1000.0, 500.0)
    assert boot.samples(START_NS / NS, START_NS / NS + 2.0, ("absent",)) is None


def test_names_of_channels_do_not_fill_the_memory() -> None:
    boot = Boot()
    for k in range(1000):
        names = {f"c{k}_{n}": (1000.0, np.zeros(1)) for n in range(32)}
        boot.add_accel(batch(k, 0.05 * k, names))
    assert len(boot._channels) < 400


def test_a_part_has_exactly_the_samples_between_its_ends() -> None:
    boot = boot_with(batches_of(np.arange(2000.0)))
    found = samples(boot, 0.4, 0.9)
    np.testing.assert_array_equal(found.channels["sprung_front"], np.arange(400.0, 901.0))
    assert found.start_s - START_NS / NS == pytest.approx(0.4, abs=1e-9)
    found = samples(boot, 0.4003, 0.8997)
    np.testing.assert_array_equal(found.channels["sprung_front"], np.arange(401.0, 900.0))


def test_what_a_copy_of_a_batch_says_later_is_ignored() -> None:
    first, second = batches_of(np.arange(100.0))
    changed = second._replace(channels={"sprung_front": AccelChannel(1000.0, np.full(SIZE, 9.0))})
    found = samples(boot_with([first, second, changed]), -1.0, 1.0)
    np.testing.assert_array_equal(found.channels["sprung_front"], np.arange(100.0))


@pytest.mark.parametrize("rate_hz", [1000.0, 1000.5, 999.5])
def test_missing_batches_are_missing_samples_at_their_place(rate_hz: float) -> None:
    """Also where the sampler's clock is off by 0.05 %, and over a long gap."""
    signal = np.arange(20_000.0)
    lost = {7, 8, 30, *range(100, 340)}
    kept = [b for b in batches_of(signal, true_rate_hz=rate_hz) if b.sequence not in lost]
    found = samples(boot_with(kept), -1.0, 30.0)
    expected = signal.copy()
    for sequence in lost:
        expected[sequence * SIZE : (sequence + 1) * SIZE] = np.nan
    for i, name in enumerate(CHANNELS):
        np.testing.assert_array_equal(found.channels[name], expected + i)


def test_missing_samples_within_a_sequence_are_seen_by_the_time() -> None:
    """A driver that lost samples goes on numbering its batches: the time shows it."""
    channels = {"sprung_front": (1000.0, np.arange(50.0))}
    boot = boot_with([batch(0, 0.0, channels), batch(1, 0.05, channels), batch(2, 0.137, channels)])
    values = samples(boot, -1.0, 1.0).channels["sprung_front"]
    ramp = np.arange(50.0)
    np.testing.assert_array_equal(values, np.concatenate([ramp, ramp, np.full(37, np.nan), ramp]))


@pytest.mark.parametrize("frequency_hz", [3.0, 170.0])
def test_channels_of_different_rates_come_on_the_fastest_grid(frequency_hz: float) -> None:
    def slow(t: Floats) -> Floats:
        return np.asarray(np.sin(2 * np.pi * frequency_hz * t))

    fast_t, slow_t = np.arange(2000) / 1000.0, np.arange(1000) / 500.0
    batches = [
        batch(
            k,
            0.05 * k,
            {
                "sprung_front": (500.0, slow(slow_t[25 * k : 25 * k + 25])),
                "unsprung_front": (1000.0, fast_t[50 * k : 50 * k + 50]),
            },
        )
        for k in range(40)
        if k != 20
    ]
    found = samples(boot_with(batches), -1.0, 10.0)
    assert found.rate_hz == 1000.0
    lost = (fast_t > 0.9995) & (fast_t < 1.0495)
    np.testing.assert_array_equal(found.channels["unsprung_front"], np.where(lost, np.nan, fast_t))
    slower = found.channels["sprung_front"]
    # Its own samples are there; between them a value takes 32 unbroken samples on either side.
    own = np.arange(fast_t.size) % 2 == 0
    np.testing.assert_array_equal(np.isnan(slower[own]), lost[own])
    aside = 32 / 500.0
    seen = (fast_t > aside - 0.0025) & (fast_t < 0.998 - aside + 0.0025)
    seen |= (fast_t > 1.05 + aside - 0.0025) & (fast_t < 1.998 - aside + 0.0025)
    np.testing.assert_array_equal(np.isfinite(slower[~own]), seen[~own])
    known = np.isfinite(slower)
    # A cubic spline would be 0.1 off at 170 Hz, a third of the slower channel's rate.
    np.testing.assert_allclose(slower[known], slow(fast_t[known]), atol=1e-4)
    np.testing.assert_allclose(slower[own & known], slow(fast_t[own & known]), rtol=0, atol=1e-15)


def test_one_channel_only() -> None:
    boot = boot_with([batch(0, 0.0, {"unsprung_rear": (200.0, np.arange(10.0))})])
    found = samples(boot, -1.0, 1.0)
    assert found.rate_hz == 200.0
    assert list(found.channels) == ["unsprung_rear"]
    np.testing.assert_array_equal(found.channels["unsprung_rear"], np.arange(10.0))


def test_a_channel_that_falls_out_is_missing_there_and_no_channel_less() -> None:
    both = {"sprung_front": (1000.0, np.ones(50)), "sprung_rear": (1000.0, np.ones(50))}
    one = {"sprung_front": (1000.0, np.ones(50))}
    boot = boot_with([batch(k, 0.05 * k, both if k < 20 else one) for k in range(80)])
    found = samples(boot, 0.5, 2.0)
    assert np.isnan(found.channels["sprung_rear"]).sum() == found.channels["sprung_rear"].size - 500
    # Far from where it was, it is still known that the truck has it.
    found = samples(boot, 3.0, 4.0)
    assert np.all(np.isnan(found.channels["sprung_rear"]))
    assert np.all(np.isfinite(found.channels["sprung_front"]))


def test_no_samples_ever_differs_from_none_now() -> None:
    assert Boot().samples(0.0, 1.0) is None
    found = boot_with(batches_of(np.arange(100.0))).samples(1.0, 2.0)
    assert found is not None
    assert {name: values.size for name, values in found.channels.items()} == dict.fromkeys(
        CHANNELS, 0
    )


@pytest.mark.parametrize("true_rate_hz", [1000.5, 999.5])
def test_a_clock_off_by_half_a_thousandth_is_measured(true_rate_hz: float) -> None:
    signal = np.arange(10_000.0)
    found = samples(boot_with(batches_of(signal, true_rate_hz=true_rate_hz)), -1.0, 20.0)
    np.testing.assert_array_equal(found.channels["sprung_front"], signal)
    # The times of batches are whole nanoseconds.
    expected = np.arange(10_000) / true_rate_hz
    np.testing.assert_allclose(relative_times(found), expected, rtol=0, atol=5e-9)


@pytest.mark.parametrize("jitter_s", [1e-7, 1e-4, 2e-3])
def test_jitter_of_the_times_neither_moves_nor_loses_samples(jitter_s: float) -> None:
    """0.1 µs as of any timer; 2 ms is more than the sampling interval: USB."""
    rng = np.random.default_rng(4)
    signal = np.arange(10_000.0)
    exact = batches_of(signal, true_rate_hz=1000.5)
    moved = [
        one._replace(device_time_ns=one.device_time_ns + round(rng.normal(0.0, jitter_s) * NS))
        for one in exact
        if one.sequence not in (60, 61)
    ]
    found = samples(boot_with(moved), -1.0, 20.0)
    signal[60 * SIZE : 62 * SIZE] = np.nan
    np.testing.assert_array_equal(found.channels["sprung_front"], signal)
    error = np.abs(relative_times(found) - np.arange(10_000) / 1000.5).max()
    # A straight line through 200 times: its standard error is at most 2/√200 of theirs.
    assert error < 4.0 * 2.0 / np.sqrt(200) * jitter_s


def test_a_step_of_the_wall_clock_moves_no_sample() -> None:
    signal = np.arange(2000.0)
    plain = batches_of(signal)
    stepped = [
        one._replace(wall_time_ns=one.wall_time_ns - 3600 * NS * (one.sequence >= 20))
        for one in plain
    ]
    one, other = samples(boot_with(plain), -1, 9), samples(boot_with(stepped), -1, 9)
    assert (one.start_s, one.rate_hz) == (other.start_s, other.rate_hz)
    for name in CHANNELS:
        np.testing.assert_array_equal(one.channels[name], other.channels[name])


def test_wall_time_is_that_of_the_moment() -> None:
    boot = Boot()
    for k in range(600):
        boot.add_fix(fix(k, 0.1 * k, wall_shift_s=-3600.0 * (k >= 300)))
    assert len(list(boot.release_fixes())) == 600
    before, after = (round((START_NS / NS + t) * NS) for t in (20.0, 50.0))
    assert boot.wall_time_ns(before / NS) == WALL_NS + before
    assert boot.wall_time_ns(after / NS) == WALL_NS + after - 3600 * NS
    # Before the first fix: that of the first.
    assert boot.wall_time_ns(START_NS / NS - 5.0) == WALL_NS + START_NS - 5 * NS


def test_fixes_are_in_order_and_single() -> None:
    boot = Boot()
    for k in (3, 1, 0, 1, 2, 3, 0):
        boot.add_fix(fix(k, 0.1 * k, speed=float(k)))
    assert [one.sequence for one in boot.release_fixes()] == [0, 1, 2, 3]
    assert list(boot.release_fixes()) == []
    found = boot.fixes()
    np.testing.assert_array_equal(found.speed_m_per_s, [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_array_equal(found.latitude_deg, 36.0 + 1e-5 * np.arange(4))
    np.testing.assert_allclose(found.time_s, START_NS / NS + 0.1 * np.arange(4), atol=1e-9)


def test_a_fix_waits_for_the_one_before_until_that_is_lost() -> None:
    boot = Boot()
    boot.add_fix(fix(0, 0.0))
    assert [one.sequence for one in boot.release_fixes()] == [0]
    last = round(PATIENCE_S * 10) + 2
    for k in range(2, last):
        boot.add_fix(fix(k, 0.1 * k))
        assert list(boot.release_fixes()) == []
    assert boot.fixes().time_s.size == 1
    boot.add_fix(fix(last, 0.1 * last))
    assert [one.sequence for one in boot.release_fixes()] == list(range(2, last + 1))
    # The lost one comes after all: it is known, and not reported.
    boot.add_fix(fix(1, 0.1))
    assert list(boot.release_fixes()) == []
    assert boot.fixes().time_s.size == last + 1
    assert np.all(np.diff(boot.fixes().time_s) > 0.0)


def test_all_there_is_settles_at_once() -> None:
    boot = Boot()
    for k in (4, 2, 7):
        boot.add_fix(fix(k, 0.1 * k))
    assert list(boot.release_fixes()) == []
    assert [one.sequence for one in boot.release_fixes(all_there_is=True)] == [2, 4, 7]


def test_two_fixes_at_one_time_are_one() -> None:
    boot = Boot()
    for k, time_s in enumerate((0.0, 0.1, 0.1, 0.2)):
        boot.add_fix(fix(k, time_s))
    list(boot.release_fixes())
    assert np.all(np.diff(boot.fixes().time_s) > 0.0)
    assert boot.fixes().time_s.size == 3


@pytest.mark.parametrize(
    ("start_s", "stop_s", "absent", "lacks"),
    [
        (1.0, 2.0, (), False),
        (1.0, 2.0, (30,), True),
        (1.0, 2.0, (19, 41), False),  # just outside
        (1.0, 2.0, (20,), True),
        (1.0, 2.0, (39,), True),
        (-1.0, 2.0, (), False),  # begins with sequence 0: nothing can have been before
        (-1.0, 2.0, (0,), True),
        (3.0, 5.0, (), True),  # not there yet
    ],
)
def test_what_may_still_come_is_known_by_the_sequence(
    start_s: float, stop_s: float, absent: tuple[int, ...], *, lacks: bool
) -> None:
    present = [b for b in batches_of(np.arange(4000.0)) if b.sequence not in absent]
    assert boot_with(present).lacks_accel(7 * 3600 + start_s, 7 * 3600 + stop_s) is lacks


def test_forgotten_batches_are_not_missing_behind_a_pause() -> None:
    """A window may begin in the pause between two runs, before the first batch that is kept."""
    boot = boot_with(batches_of(np.arange(1000.0)))
    boot.forget_before(START_NS / NS + 300.0)
    for k in range(20, 40):
        boot.add_accel(batch(k, 600.0 + 0.05 * (k - 20), {"sprung_front": (1000.0, np.zeros(50))}))
    begin_s = START_NS / NS + 599.0
    assert not boot.lacks_accel(begin_s, begin_s + 1.5)
    boot.add_accel(batch(42, 601.1, {"sprung_front": (1000.0, np.zeros(50))}))
    assert boot.lacks_accel(begin_s, begin_s + 2.12)


def test_the_latest_sample() -> None:
    assert Boot().latest_accel_s() == -np.inf
    ordered = batches_of(np.arange(500.0))
    assert boot_with([ordered[9], ordered[3]]).latest_accel_s() == pytest.approx(7 * 3600 + 0.5)


def test_forgetting_bounds_the_memory() -> None:
    boot = Boot()
    held = []
    for k in range(2000):
        boot.add_accel(batch(k, 0.05 * k, {"sprung_front": (1000.0, np.zeros(50))}))
        boot.add_fix(fix(k, 0.05 * k))
        list(boot.release_fixes())
        if k % 100 == 99:
            boot.forget_before(START_NS / NS + 0.05 * k - 10.0)
            held.append(len(boot._batches) + len(boot._fixes) + len(boot._waiting))
    assert max(held) <= 2 * 201
    # What has been forgotten does not come back with a copy that is late.
    boot.add_accel(batch(3, 0.15, {"sprung_front": (1000.0, np.zeros(50))}))
    boot.add_fix(fix(3, 0.15))
    assert len(boot._batches) + len(boot._fixes) == held[-1]
    found = samples(boot, 0.0, 200.0)
    assert found.start_s == pytest.approx(START_NS / NS + 90.0, abs=0.06)


def test_device_time_of_a_message() -> None:
    one = batches_of(np.arange(100.0))[1]
    assert device_time_ns("accel", encode_accel(one)) == START_NS + 50_000_000
    assert device_time_ns("gnss", encode_gnss(fix(2, 0.2))) == START_NS + 200_000_000
    with pytest.raises(ValueError, match=r"not a driveby\.v1\.GnssFix"):
        device_time_ns("gnss", b"\xff\xff")


def test_lost_batches_of_varying_size_leave_the_later_ones_in_place() -> None:
    """The usual size, 125, times six lost batches is one sample more than the time says."""
    signal = np.cos(np.arange(1000) * 0.3)
    kept = [(0, 0, 14), (7, 763, 1000)]
    boot = boot_with(
        [batch(k, a / 1000.0, dict.fromkeys(CHANNELS, (1000.0, signal[a:b]))) for k, a, b in kept]
    )
    expected = signal.copy()
    expected[14:763] = np.nan
    np.testing.assert_array_equal(samples(boot, -1.0, 2.0).channels[CHANNELS[0]], expected)


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_way_to_cut_and_shuffle_gives_the_same_arrays(data: st.DataObject) -> None:
    signal = np.cos(np.arange(1000) * 0.3)
    cuts = sorted(data.draw(st.sets(st.integers(1, 999), max_size=25), label="cuts"))
    edges = [0, *cuts, 1000]
    whole = [
        batch(k, a / 1000.0, dict.fromkeys(CHANNELS, (1000.0, signal[a:b])))
        for k, (a, b) in enumerate(itertools.pairwise(edges))
    ]
    lost = data.draw(st.sets(st.sampled_from(range(1, max(2, len(whole) - 1)))), label="lost")
    kept = [one for one in whole if one.sequence not in lost]
    twice = data.draw(st.lists(st.sampled_from(kept), max_size=5), label="twice")
    expected = signal.copy()
    for sequence in lost:
        if sequence < len(whole):
            expected[edges[sequence] : edges[sequence + 1]] = np.nan
    if kept[-1].sequence != len(whole) - 1:
        expected = expected[: edges[kept[-1].sequence + 1]]
    order = data.draw(st.permutations(kept + twice), label="order")
    found = samples(boot_with(order), -1.0, 2.0)
    for name in CHANNELS:
        np.testing.assert_array_equal(found.channels[name], expected)
    np.testing.assert_allclose(
        relative_times(found), np.arange(expected.size) / 1000.0, rtol=0, atol=1e-9
    )
