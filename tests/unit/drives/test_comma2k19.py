"""A real drive: one body sensor with gravity and a clock of its own, a receiver with another."""

from pathlib import Path

import numpy as np
import pytest

from services.common.errors import InputError
from services.drives.comma2k19 import is_comma2k19, read_comma2k19


@pytest.fixture
def drive(shared: Path) -> Path:
    return shared / "real" / "comma2k19"


@pytest.fixture
def copy(drive: Path, tmp_path: Path) -> Path:
    """The drive's own two sensors in a folder that may be damaged."""
    for path in (*drive.glob("*_IMU_accelerometer_*"), *drive.glob("*_GNSS_*")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def test_accelerations_are_upward_without_gravity(drive: Path) -> None:
    run = read_comma2k19(drive)
    assert list(run.channels) == ["sprung_front"]
    up = run.channels["sprung_front"]
    assert abs(up.mean()) < 0.2  # a road that climbs little; with the wrong sign it is −19.4
    assert 0.3 < up.std() < 1.0
    down = np.load(drive / "processed_log_IMU_accelerometer_value.npy")[:, 2]
    assert np.corrcoef(up[:6000], -down[:6000])[0, 1] > 0.99


def test_the_even_grid_keeps_the_clock(drive: Path) -> None:
    run = read_comma2k19(drive)
    assert run.rate_hz == pytest.approx(104.26, abs=0.01)
    assert np.diff(run.accel_time_s) == pytest.approx(1 / run.rate_hz, abs=1e-6)
    logged = np.load(drive / "processed_log_IMU_accelerometer_t.npy")
    assert len(run.accel_time_s) >= len(logged) - 2
    assert run.accel_time_s[-1] - run.accel_time_s[0] == pytest.approx(
        logged[-1] - logged[0], abs=0.02
    )


def test_the_receivers_utc_and_the_computers_clock_agree(drive: Path) -> None:
    """The wheels show it: their speed is on the computer's clock, the receiver's on UTC."""
    run = read_comma2k19(drive)
    offset = run.accel_time_s[0] - np.load(drive / "processed_log_IMU_accelerometer_t.npy")[0]
    wheels_s = np.load(drive / "processed_log_CAN_speed_t.npy") + offset
    wheels = np.load(drive / "processed_log_CAN_speed_value.npy")[:, 0]
    inside = (run.gnss.time_s > wheels_s[0] + 1) & (run.gnss.time_s < wheels_s[-1] - 1)
    shifts = np.arange(-0.5, 0.5, 0.01)
    mismatch = [
        np.std((np.interp(run.gnss.time_s + s, wheels_s, wheels) - run.gnss.speed_m_per_s)[inside])
        for s in shifts
    ]
    assert abs(shifts[np.argmin(mismatch)]) < 0.06


def test_positions_are_those_of_the_drive(drive: Path) -> None:
    gnss = read_comma2k19(drive).gnss
    assert int(gnss.time_s[0] // (365.25 * 86400)) == 2018 - 1970
    assert np.all(np.diff(gnss.time_s) > 0.05)
    metres = np.hypot(
        np.diff(gnss.latitude_deg) * 111_000,
        np.diff(gnss.longitude_deg) * 111_320 * np.cos(np.radians(37.72)),
    )
    by_speed = gnss.speed_m_per_s[:-1] * np.diff(gnss.time_s)
    assert metres.sum() == pytest.approx(by_speed.sum(), rel=0.02)
    assert gnss.heading_deg is not None
    assert np.all((gnss.heading_deg >= 0) & (gnss.heading_deg < 360))


def test_without_pairs_of_clocks_the_least_delayed_fix_sets_the_clock(copy: Path) -> None:
    fixes = np.load(copy / "processed_log_GNSS_live_gnss_ublox_value.npy")
    logged = np.load(copy / "processed_log_GNSS_live_gnss_ublox_t.npy")
    run = read_comma2k19(copy)
    first = np.load(copy / "processed_log_IMU_accelerometer_t.npy")[0]
    offset = (run.accel_time_s[0] - first).round(3)
    assert np.max(fixes[:, 3] / 1000 - logged) == pytest.approx(offset, abs=0.02)


def test_damaged_arrays_are_named(copy: Path) -> None:
    assert is_comma2k19(copy)
    values = copy / "processed_log_IMU_accelerometer_value.npy"
    times = copy / "processed_log_IMU_accelerometer_t.npy"
    good_values, good_times = np.load(values), np.load(times)

    def complaint() -> str:
        with pytest.raises(InputError) as caught:
            read_comma2k19(copy)
        assert len(str(caught.value).splitlines()) == 1
        return str(caught.value)

    np.save(times, good_times[::-1])
    assert complaint() == f"{times}: row 1: is not later than the row before"
    np.save(times, good_times[:-1])
    assert complaint().startswith(f"{times}: has 6255 times, 6256 expected")
    np.save(times, good_times)
    np.save(values, np.where(np.arange(6256)[:, None] == 5, np.nan, good_values))
    assert complaint() == f"{values}: row 5: is not finite, a finite number expected"
    np.save(values, good_values[:, :2])
    assert complaint().startswith(f"{values}: has shape (6256, 2)")
    np.save(values, np.array(3.0))
    assert complaint().startswith(f"{values}: has shape ()")
    values.write_bytes(b"no array")
    assert complaint() == f"{values}: is not an array that numpy can read"
    values.unlink()
    assert not is_comma2k19(copy)
    assert complaint().startswith(f"{values}: no such file")
