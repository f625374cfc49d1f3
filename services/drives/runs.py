"""One drive as arrays, from any source, and the messages that a truck would have sent."""

from collections.abc import Iterable, Iterator
from heapq import merge
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from schemas.signals import (
    CHANNELS,
    NS_PER_S,
    AccelBatch,
    AccelChannel,
    GnssFix,
    VehicleInfo,
    encode_accel,
    encode_gnss,
    encode_info,
    encode_location,
)
from schemas.site import Sensor, Site
from schemas.site_file import vehicle_toml
from schemas.topics import Key, Message
from services.common.arrays import Floats
from services.common.extras import check_installed

BATCH_S = 0.05
"""Length of a truck's batches in s: few messages with a low delay."""

# In sampling intervals: below it the jitter of time stamps is taken for rounding.
_LARGEST_JITTER = 0.1
# In sampling intervals: samples further apart have a gap between them.
_GAP = 1.5


class GnssTrack(NamedTuple):
    """Fixes of a receiver, all arrays (m,)."""

    time_s: Floats  # since 1970 UTC, increasing
    latitude_deg: Floats
    longitude_deg: Floats
    altitude_m: Floats
    speed_m_per_s: Floats
    heading_deg: Floats | None  # clockwise from north


class Run(NamedTuple):
    """One run; accelerations in m/s², (n,) each, at common times; channels may be absent."""

    source: str
    accel_time_s: Floats  # since 1970 UTC, increasing; a jump is a gap
    rate_hz: float
    channels: dict[str, Floats]
    gnss: GnssTrack


class _EvenGrid(NamedTuple):
    """Samples of a run on an even grid."""

    first_ns: int
    """Time of grid point 0 in ns since 1970 UTC."""
    points: NDArray[np.int64]  # numbers of the grid points that have a sample (n,)
    channels: dict[str, Floats]  # (n,) each


def sampling_rate_hz(time_s: Floats) -> float:
    """Return the rate of samples (n,) that are even but for gaps and jitter of the time stamps.

    A rate that cannot be distinguished from a whole number of Hz is that number.
    """
    index = grid_index(time_s)
    slope = _slope(index, time_s - time_s[0])
    rate = 1 / slope
    whole = max(round(rate), 1)
    drift_samples = abs(whole / rate - 1) * index[-1]
    return float(whole) if drift_samples < 0.1 else rate


def normalised(run: Run, sensor: Sensor) -> Run:
    """Return the run with accelerations upward and without gravity; `sensor` declares the input.

    Other channels than the four point up. An accelerometer at rest whose axis points up reads +g.
    """
    gravity = STANDARD_GRAVITY_M_PER_S2 if sensor.gravity_included else 0.0
    signs = dict(zip(CHANNELS, sensor.up, strict=True))
    return run._replace(
        channels={
            name: signs.get(name, 1) * values - gravity for name, values in run.channels.items()
        }
    )


def run_to_messages(
    runs: Iterable[Run], site: Site, realm: str, vehicle_id: str
) -> Iterator[Message]:
    """Yield the messages of the runs as the truck would have sent them, by time within a run.

    The site's vehicle describes itself at the start of every run. Each run is a boot of its own,
    numbered by its first time in ns, so that the same files always give the same messages.
    Accelerations must be upward and without gravity (`normalised`).
    """
    toml = vehicle_toml(site, vehicle_id)
    for run in runs:
        grid = _on_even_grid(run)
        # A rounded first stamp may be later than its sample on the grid.
        start_ns = min(
            _nanoseconds(min(run.accel_time_s[0], run.gnss.time_s[0])),
            _time_ns(grid, 0, run.rate_hz),
        )
        info = VehicleInfo(start_ns, 0, 0, start_ns, vehicle_id, toml)
        key = Key(realm, "vehicle", vehicle_id, "info")
        yield Message(key, encode_info(info), start_ns, 0, start_ns, start_ns)
        yield from merge(
            _accel_messages(run.rate_hz, grid, realm, vehicle_id, start_ns),
            _gnss_messages(run, realm, vehicle_id, start_ns),
            key=lambda message: message.log_time_ns,
        )


def _accel_messages(
    rate_hz: float, grid: _EvenGrid, realm: str, vehicle_id: str, start_ns: int
) -> Iterator[Message]:
    key = Key(realm, "vehicle", vehicle_id, "accel")
    index = grid.points
    size = max(1, round(BATCH_S * rate_hz))
    edges = [0, *(np.flatnonzero(np.diff(index) != 1) + 1), len(index)]
    starts = [s for a, b in pairwise(edges) for s in range(a, b, size)]
    for sequence, (a, b) in enumerate(pairwise([*starts, len(index)])):
        time_ns = _time_ns(grid, a, rate_hz)
        batch = AccelBatch(
            start_ns,
            sequence,
            time_ns - start_ns,
            time_ns,
            {name: AccelChannel(rate_hz, values[a:b]) for name, values in grid.channels.items()},
        )
        sent_ns = time_ns + round((b - a) * NS_PER_S / rate_hz)
        yield Message(key, encode_accel(batch), start_ns, sequence, time_ns, sent_ns)


def _time_ns(grid: _EvenGrid, sample: int, rate_hz: float) -> int:
    return grid.first_ns + round(int(grid.points[sample]) * NS_PER_S / rate_hz)


def _gnss_messages(run: Run, realm: str, vehicle_id: str, start_ns: int) -> Iterator[Message]:
    gnss = run.gnss
    for sequence, time_s in enumerate(gnss.time_s):
        time_ns = _nanoseconds(time_s)
        fix = GnssFix(
            start_ns,
            sequence,
            time_ns - start_ns,
            time_ns,
            float(gnss.latitude_deg[sequence]),
            float(gnss.longitude_deg[sequence]),
            float(gnss.altitude_m[sequence]),
            float(gnss.speed_m_per_s[sequence]),
            None if gnss.heading_deg is None else float(gnss.heading_deg[sequence]),
        )
        for stream, encode in (("gnss", encode_gnss), ("location", encode_location)):
            key = Key(realm, "vehicle", vehicle_id, stream)
            yield Message(key, encode(fix), start_ns, sequence, time_ns, time_ns)


def _on_even_grid(run: Run) -> _EvenGrid:
    """Return the samples on the grid.

    Time stamps that deviate little from the grid were rounded, and the samples count as even. With
    larger deviations the clock is a real one that wanders, and the samples are interpolated.
    """
    index = grid_index(run.accel_time_s)
    relative = run.accel_time_s - run.accel_time_s[0]
    offset = float(np.mean(relative - index / run.rate_hz))
    jitter = (relative - offset) * run.rate_hz - index
    first_ns = _nanoseconds(run.accel_time_s[0] + offset)
    if np.abs(jitter).max() <= _LARGEST_JITTER:
        return _EvenGrid(first_ns, index, run.channels)
    pieces: list[NDArray[np.int64]] = []
    values: dict[str, list[Floats]] = {name: [] for name in run.channels}
    position = index + jitter
    for piece in np.split(np.arange(len(index)), np.flatnonzero(np.diff(index) != 1) + 1):
        grid, resampled = resample(
            position[piece], {name: v[piece] for name, v in run.channels.items()}
        )
        pieces.append(grid)
        for name, v in resampled.items():
            values[name].append(v)
    joined = {name: np.concatenate(parts) for name, parts in values.items()}
    return _EvenGrid(first_ns, np.concatenate(pieces), joined)


def resample(
    position: Floats, channels: dict[str, Floats]
) -> tuple[NDArray[np.int64], dict[str, Floats]]:
    """Interpolate samples at increasing positions (n,), in grid steps, onto the whole numbers.

    Cubic splines: for jitter of a few per cent of the step they follow a signal up to half the
    Nyquist frequency to better than the jitter's own effect.
    """
    grid = np.arange(np.ceil(position[0]), np.floor(position[-1]) + 1).astype(np.int64)
    if len(position) < 4:
        return grid, {name: np.interp(grid, position, v) for name, v in channels.items()}
    check_installed("samples whose time stamps wander", "scipy", extra="identify")
    from scipy.interpolate import CubicSpline  # slow to import, seldom needed

    return grid, {name: CubicSpline(position, v)(grid) for name, v in channels.items()}


def grid_index(time_s: Floats) -> NDArray[np.int64]:
    """Return numbers of samples (n,) at increasing times, which jump at missing samples."""
    steps = np.diff(time_s)
    usual = float(np.median(steps))
    # The mean of the steps outside gaps: the median of stamps rounded to ms is rounded.
    usual = float(np.mean(steps[steps < _GAP * usual]))
    missing = np.where(steps < _GAP * usual, 1, np.maximum(np.rint(steps / usual), 2))
    return np.concatenate([[0], np.cumsum(missing)]).astype(np.int64)


def _slope(x: NDArray[np.int64], y: Floats) -> float:
    centred = x - x.mean()
    return float(centred @ (y - y.mean()) / (centred @ centred))


def _nanoseconds(time_s: float) -> int:
    # Seconds since 1970 resolve a quarter of a microsecond: whole microseconds are certain.
    return round(time_s * 1e6) * 1000
