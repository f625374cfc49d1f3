"""A minute of the comma2k19 data set (MIT licence): a real car, one body sensor, one receiver.

The arrays share the clock of the logging computer, which counts from its start. Three steps convert
them to a truck's messages:

- the accelerometer's axes are forward, right, down, and include gravity: up = −down − g;
- its samples arrive at about 104 Hz and deviate from an even grid by a hundredth of a step (the
  sensor's clock against the computer's): cubic splines interpolate them onto the grid;
- the receiver gives the UTC time of each fix, a fifth of a second before the fix is logged.
  Fixes keep their own time. The computer's clock is set by the data set's own pairs of computer
  and GPS time where they exist, otherwise by the fix that was logged with the least delay.
"""

from pathlib import Path

import numpy as np

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.files import check_ordinary
from services.drives.runs import (
    GnssTrack,
    Run,
    resample,
    sampling_rate_hz,
)

_ACCELEROMETER = "processed_log_IMU_accelerometer"
_RECEIVER = "processed_log_GNSS_live_gnss_ublox"
_GPS_EPOCH_S = 315_964_800  # 1980-01-06 in seconds since 1970
_WEEK_S = 604_800
_LEAP_SECONDS = 18  # GPS ahead of UTC, since 2017


def is_comma2k19(folder: Path) -> bool:
    """Return whether the folder looks like a segment of the data set."""
    return (folder / f"{_ACCELEROMETER}_value.npy").is_file()


def read_comma2k19(folder: Path) -> Run:
    """Read a segment; its body sensor is the front one. InputError if an array is invalid."""
    clock_s = _array(folder, f"{_ACCELEROMETER}_t", 1)
    forward_right_down = _array(folder, f"{_ACCELEROMETER}_value", 3)
    logged_s = _array(folder, f"{_RECEIVER}_t", 1)
    fixes = _array(folder, f"{_RECEIVER}_value", 6)
    _check(folder, _ACCELEROMETER, clock_s, forward_right_down)
    _check(folder, _RECEIVER, logged_s, fixes)

    # The data set declares seconds and holds milliseconds.
    utc_s = fixes[:, 3] / 1000 if fixes[0, 3] > 1e11 else fixes[:, 3]
    if not np.all(np.diff(utc_s) > 0):
        raise InputError(f"{folder / _RECEIVER}_value.npy: column 3 (UTC) must increase")
    offset_s = _clock_offset_s(folder, logged_s, utc_s)

    rate_hz = sampling_rate_hz(clock_s)
    step, up = resample(
        (clock_s - clock_s[0]) * rate_hz,
        {"sprung_front": -forward_right_down[:, 2] - STANDARD_GRAVITY_M_PER_S2},
    )
    return Run(
        source=str(folder),
        accel_time_s=clock_s[0] + offset_s + step / rate_hz,
        rate_hz=rate_hz,
        channels=up,
        gnss=GnssTrack(
            time_s=utc_s,
            latitude_deg=fixes[:, 0],
            longitude_deg=fixes[:, 1],
            altitude_m=fixes[:, 4],
            speed_m_per_s=fixes[:, 2],
            heading_deg=fixes[:, 5] % 360,
        ),
    )


def _clock_offset_s(folder: Path, logged_s: Floats, utc_s: Floats) -> float:
    """Return UTC minus the computer's clock, s."""
    if (folder / "global_pose_frame_gps_times.npy").is_file():
        week, second_of_week = _array(folder, "global_pose_frame_gps_times", 2).T
        clock_s = _array(folder, "global_pose_frame_times", 1)
        if len(clock_s) == len(week):
            gps_s = _GPS_EPOCH_S + week * _WEEK_S + second_of_week
            return float(np.median(gps_s - _LEAP_SECONDS - clock_s))
    return float(np.max(utc_s - logged_s))


def _array(folder: Path, name: str, columns: int) -> Floats:
    path = folder / f"{name}.npy"
    check_ordinary(path)
    try:
        values = np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file, an array of comma2k19 expected") from error
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: is not an array that numpy can read") from error
    shape = values.shape[:1] if columns == 1 else (*values.shape[:1], columns)
    if values.dtype.kind != "f" or values.ndim == 0 or values.shape != shape:
        expected = "(n,)" if columns == 1 else f"(n, {columns})"
        raise InputError(f"{path}: has shape {values.shape}, numbers of shape {expected} expected")
    if not np.all(np.isfinite(values)):
        row = int(np.argwhere(~np.isfinite(values))[0][0])
        raise InputError(f"{path}: row {row}: is not finite, a finite number expected")
    return np.asarray(values, np.float64)


def _check(folder: Path, name: str, time_s: Floats, values: Floats) -> None:
    path = folder / f"{name}_t.npy"
    if len(time_s) != len(values):
        raise InputError(f"{path}: has {len(time_s)} times, {len(values)} expected, one a value")
    if len(time_s) < 10:
        raise InputError(f"{path}: has {len(time_s)} times, at least 10 expected")
    if not np.all(np.diff(time_s) > 0):
        row = int(np.argmax(np.diff(time_s) <= 0)) + 1
        raise InputError(f"{path}: row {row}: is not later than the row before")
