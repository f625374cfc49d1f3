"""A drive as arrays becomes messages that say the same, gaps and jitter included."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.signals import CHANNELS, decode_accel, decode_gnss, decode_info
from schemas.site import Site
from schemas.site_file import load_site, parse_site
from schemas.topics import Message
from services.drives.csv_import import read_folder
from services.drives.runs import GnssTrack, Run, normalised, run_to_messages, sampling_rate_hz

EXAMPLE = Path(__file__).parents[2] / "data" / "csv_example"
START_S = 1_790_000_000.0


def a_site(sensor: str = "") -> Site:
    return parse_site((EXAMPLE / "site.toml").read_text() + sensor, "site.toml")


def a_run(time_s: np.ndarray, *values: np.ndarray, rate_hz: float | None = None) -> Run:
    gnss = np.arange(time_s[0], time_s[-1] + 0.1, 0.1)
    flat = np.zeros_like(gnss)
    return Run(
        source="a test",
        accel_time_s=time_s,
        rate_hz=sampling_rate_hz(time_s) if rate_hz is None else rate_hz,
        channels=dict(zip(CHANNELS, values, strict=False)),
        gnss=GnssTrack(gnss, flat, flat, flat, flat, None),
    )


def messages(*runs: Run) -> list[Message]:
    return list(run_to_messages(runs, a_site(), "import-test", "truck-x"))


def samples(found: Iterable[Message], channel: str) -> tuple[np.ndarray, np.ndarray]:
    """Times in ns and values of a channel."""
    times, values = [], []
    for message in found:
        if message.key.stream == "accel":
            batch = decode_accel(message.payload)
            rate_hz, part = batch.channels[channel]
            times.append(batch.wall_time_ns + np.arange(len(part)) * 1e9 / rate_hz)
            values.append(part)
    return np.concatenate(times), np.concatenate(values)


def test_messages_say_what_the_files_say() -> None:
    (run,) = read_folder(EXAMPLE)
    found = messages(run)
    for channel in CHANNELS:
        times, values = samples(found, channel)
        assert np.array_equal(values, run.channels[channel])
        assert times == pytest.approx(run.accel_time_s * 1e9, abs=1000)
    fixes = [decode_gnss(m.payload) for m in found if m.key.stream == "gnss"]
    assert [fix.longitude_deg for fix in fixes] == run.gnss.longitude_deg.tolist()
    assert [fix.wall_time_ns for fix in fixes] == [round(t * 1e6) * 1000 for t in run.gnss.time_s]
    (info,) = (decode_info(m.payload) for m in found if m.key.stream == "info")
    site = load_site(EXAMPLE / "site.toml")
    assert (
        parse_site(info.site_toml + (EXAMPLE / "site.toml").read_text().split("\n\n")[1], "info")
        == site
    )


def test_messages_are_whole_ordered_and_always_the_same() -> None:
    (run,) = read_folder(EXAMPLE)
    found = messages(run)
    assert found == messages(run)
    assert [m.log_time_ns for m in found] == sorted(m.log_time_ns for m in found)
    assert found[0].key.stream == "info"
    for stream, count in (("accel", 120), ("gnss", 60), ("location", 60), ("info", 1)):
        of_stream = [m for m in found if m.key.stream == stream]
        assert [m.sequence for m in of_stream] == list(range(count))
        assert {m.boot_id for m in of_stream} == {int(START_S * 1e9)}


def test_each_run_is_a_boot_of_its_own() -> None:
    (run,) = read_folder(EXAMPLE)
    later = run._replace(
        accel_time_s=run.accel_time_s + 3600,
        gnss=run.gnss._replace(time_s=run.gnss.time_s + 3600),
    )
    found = messages(run, later)
    assert sorted({m.boot_id for m in found}) == [1790000000_000000000, 1790003600_000000000]
    assert len({(m.key.stream, m.boot_id, m.sequence) for m in found}) == len(found)


@given(
    st.lists(st.integers(1, 60), min_size=2, max_size=6), st.lists(st.integers(2, 50), min_size=6)
)
def test_missing_time_is_a_gap_between_batches_and_nothing_else_moves(
    lengths: list[int], gaps: list[int]
) -> None:
    steps = [1] * (lengths[0] + 2)
    for length, gap in zip(lengths[1:], gaps, strict=False):
        steps += [gap] + [1] * length
    index = np.cumsum([0, *steps])
    run = a_run(START_S + index / 200, np.sin(index), rate_hz=200.0)
    times, values = samples(messages(run), "sprung_front")
    assert np.array_equal(values, np.sin(index))
    assert times == pytest.approx((START_S + index / 200) * 1e9, abs=1500)


def test_rates_are_rounded_where_indistinguishable() -> None:
    index = np.arange(5000)
    for rate in (100.0, 200.0, 1000.0, 1600.0):
        stamps = np.round(START_S + index / rate, 3 if rate < 1000 else 6)
        assert sampling_rate_hz(stamps) == rate
    assert sampling_rate_hz(START_S + index / 104.264) == pytest.approx(104.264, rel=1e-6)
    with_gap = np.delete(index, slice(1000, 2500))
    assert sampling_rate_hz(START_S + with_gap / 250) == 250


def test_a_wandering_clock_is_put_on_an_even_grid() -> None:
    rng = np.random.default_rng(1)
    n, rate = 2000, 100.0
    true = (
        np.arange(n) / rate + 0.3 / rate * np.sin(np.arange(n) / 40) + rng.uniform(-1e-4, 1e-4, n)
    )
    signal = np.sin(2 * np.pi * 8 * true)
    run = a_run(START_S + true, signal)
    times, values = samples(messages(run), "sprung_front")
    expected = np.sin(2 * np.pi * 8 * (times / 1e9 - START_S))
    inside = slice(5, -5)
    as_if_even = np.sin(2 * np.pi * 8 * np.arange(n) / rate) - signal
    assert np.abs(values - expected)[inside].max() < 0.01
    assert np.abs(as_if_even).max() > 0.1  # what taking the stamps for even would have cost
    assert np.abs(np.diff(times) - 1e9 / run.rate_hz).max() < 600


def test_time_stamps_that_were_rounded_are_taken_for_even() -> None:
    n, rate = 3000, 104.0
    true = np.arange(n) / rate
    signal = np.sin(2 * np.pi * 20 * true)
    run = a_run(np.round(START_S + true, 3), signal)
    times, values = samples(messages(run), "sprung_front")
    assert np.array_equal(values, signal)
    assert times == pytest.approx((START_S + true) * 1e9, abs=2e5)


def test_first_stamp_may_be_later_than_its_even_sample() -> None:
    true = START_S + np.arange(256) / 256.0
    cut = np.floor(true * 1e4) / 1e4  # the first is exact, the others are early
    found = messages(a_run(cut, np.zeros(256)))
    first = decode_accel(next(m.payload for m in found if m.key.stream == "accel"))
    assert first.device_time_ns == 0
    assert first.wall_time_ns < START_S * 1e9
    assert found[0].log_time_ns == first.wall_time_ns


def test_gravity_and_downward_axes_are_taken_out() -> None:
    sensor = a_site("gravity_included = true\nup = [1, 1, -1, -1]\n").sensor
    still = np.full(3, 9.80665)
    moving = a_run(START_S + np.arange(3) / 100, still + 1, still, -still, -still - 2)
    out = normalised(moving, sensor).channels
    assert [out[name][0] for name in CHANNELS] == pytest.approx([1, 0, 0, 2])
    plain = normalised(moving, a_site().sensor).channels
    assert all(np.array_equal(plain[name], moving.channels[name]) for name in CHANNELS)
