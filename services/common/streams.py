"""From single messages to arrays: one boot of one truck, ordered, without duplicates, on one clock.

Batches and fixes may come late, twice or not at all. Within a boot they are ordered by sequence and
placed by the truck's monotonic clock, which no step of the wall clock can disturb; the median
difference of the two clocks gives the wall time.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import CHANNELS, AccelBatch, GnssFix

Floats = NDArray[np.float64]

_NS_PER_S = 1_000_000_000
_LARGEST_RATE_ERROR = 0.02
"""A crystal is good to 1e-4; beyond this the declared rate is another sensor's."""


class Fixes(NamedTuple):
    """Fixes in order of time: all arrays (m,)."""

    time_s: Floats
    latitude_deg: Floats
    longitude_deg: Floats
    speed_m_per_s: Floats


class Samples(NamedTuple):
    """Samples of a truck on one even grid.

    `channels` maps each channel that the truck has to (n,) accelerations in m/s², NaN where samples
    are missing. Sample k is at `start_s` + k/`rate_hz`, on the clock of `Boot`.
    """

    start_s: float
    rate_hz: float
    channels: dict[str, Floats]


class Boot:
    """All messages of one boot of a truck that are still of interest.

    Times are seconds on the truck's own clock since `epoch_ns`, the device time of the first
    message that came.
    """

    def __init__(self) -> None:
        self._batches: dict[int, AccelBatch] = {}
        self._fixes: dict[int, GnssFix] = {}
        self.epoch_ns: int | None = None

    def add_accel(self, batch: AccelBatch) -> None:
        """Take a batch in; one that is here already is ignored."""
        self._batches.setdefault(batch.sequence, batch)
        self._note(batch)

    def add_fix(self, fix: GnssFix) -> None:
        """Take a fix in; one that is here already is ignored."""
        self._fixes.setdefault(fix.sequence, fix)
        self._note(fix)

    def forget_before(self, time_s: float) -> None:
        """Drop what is older, so that the memory stays bounded on a long drive."""
        epoch_ns = self.epoch_ns or 0
        limit_ns = epoch_ns + round(time_s * _NS_PER_S)
        for sequence in [s for s, b in self._batches.items() if b.device_time_ns < limit_ns]:
            del self._batches[sequence]
        for sequence in [s for s, f in self._fixes.items() if f.device_time_ns < limit_ns]:
            del self._fixes[sequence]

    def latest_accel_s(self) -> float:
        """Time of the last sample that has come; -inf without any."""
        if not self._batches:
            return -np.inf
        last = max(self._batches.values(), key=lambda batch: batch.device_time_ns)
        longest = max(channel.samples.size / channel.rate_hz for channel in last.channels.values())
        return self._seconds(last.device_time_ns) + longest

    def wall_time_ns(self, time_s: float) -> int:
        """Wall time (ns since 1970 UTC) of a time on this clock."""
        offsets = [
            message.wall_time_ns - message.device_time_ns
            for group in (self._batches, self._fixes)
            for message in group.values()
        ]
        middle = sorted(offsets)[len(offsets) // 2]
        return (self.epoch_ns or 0) + round(time_s * _NS_PER_S) + middle

    def fixes(self) -> Fixes:
        """All fixes in order of time."""
        ordered = sorted(self._fixes.values(), key=lambda fix: fix.device_time_ns)
        rows = [
            (
                self._seconds(fix.device_time_ns),
                fix.latitude_deg,
                fix.longitude_deg,
                fix.speed_m_per_s,
            )
            for fix in ordered
        ]
        columns = np.array(rows, dtype=np.float64).reshape(-1, 4).T
        kept = np.concatenate([[True], np.diff(columns[0]) > 0.0])[: columns.shape[1]]
        return Fixes(*(np.ascontiguousarray(column[kept]) for column in columns))

    def samples(self, start_s: float, stop_s: float) -> Samples | None:
        """Samples from `start` to `stop`, on the grid of the fastest channel; None without any.

        A slower channel is interpolated by cubic splines.
        """
        chosen = [
            batch
            for _, batch in sorted(self._batches.items())
            if self._seconds(batch.device_time_ns) < stop_s
            and self._seconds(batch.device_time_ns) + 1.0 > start_s
        ]
        grids = {
            name: grid
            for name in CHANNELS
            if (grid := self._grid(name, chosen, start_s, stop_s)) is not None
        }
        if not grids:
            return None
        fastest = max(grids.values(), key=lambda grid: grid.rate_hz)
        time = fastest.start_s + np.arange(fastest.values.size) / fastest.rate_hz
        channels = {
            name: grid.values if grid is fastest else _resampled(grid, time)
            for name, grid in grids.items()
        }
        return Samples(fastest.start_s, fastest.rate_hz, channels)

    def _grid(
        self, name: str, batches: list[AccelBatch], start_s: float, stop_s: float
    ) -> "_Grid | None":
        parts = [
            (self._seconds(batch.device_time_ns), batch.channels[name])
            for batch in batches
            if name in batch.channels
        ]
        if not parts:
            return None
        declared = float(np.median([channel.rate_hz for _, channel in parts]))
        # Number the samples: a batch that follows on the one before has the next numbers, whatever
        # jitter its time has; a jump of at least half a sample is missing samples.
        first_s = parts[0][0]
        numbers = [0]
        for (before_s, channel), (time_s, _) in itertools.pairwise(parts):
            jump = (time_s - before_s) * declared - channel.samples.size
            missing = round(jump) if abs(jump) >= 0.5 else 0
            numbers.append(numbers[-1] + max(channel.samples.size + missing, 0))
        rate, offset_s = _fit_clock(np.array(numbers), np.array([t for t, _ in parts]), declared)
        size = numbers[-1] + parts[-1][1].samples.size
        values = np.full(size, np.nan)
        for number, (_, channel) in zip(numbers, parts, strict=True):
            values[number : number + channel.samples.size] = channel.samples
        begin = max(0, int(np.ceil((start_s - first_s - offset_s) * rate)))
        stop = min(size, int(np.floor((stop_s - first_s - offset_s) * rate)) + 1)
        if stop <= begin:
            return None
        return _Grid(first_s + offset_s + begin / rate, rate, values[begin:stop])

    def _note(self, message: AccelBatch | GnssFix) -> None:
        if self.epoch_ns is None:
            self.epoch_ns = message.device_time_ns

    def _seconds(self, device_time_ns: int) -> float:
        return (device_time_ns - (self.epoch_ns or 0)) / _NS_PER_S


class _Grid(NamedTuple):
    start_s: float
    rate_hz: float
    values: Floats


def _fit_clock(
    numbers: NDArray[np.int64], times_s: Floats, declared_hz: float
) -> tuple[float, float]:
    """True rate and time of sample 0 after `times_s[0]`, from the times of the batches.

    The times of an honest sampler lie on a line to rounding; then the declared rate stands.
    """
    relative = times_s - times_s[0]
    if numbers.size < 3 or np.all(np.abs(relative - numbers / declared_hz) < 1e-3 / declared_hz):
        return declared_hz, 0.0
    slope, offset = np.polyfit(numbers.astype(np.float64), relative, 1)
    if not abs(slope * declared_hz - 1.0) < _LARGEST_RATE_ERROR:
        return declared_hz, 0.0
    return float(1.0 / slope), float(offset)


def _resampled(grid: _Grid, time_s: Floats) -> Floats:
    from scipy.interpolate import CubicSpline  # slow to import, seldom needed

    own = grid.start_s + np.arange(grid.values.size) / grid.rate_hz
    known = np.isfinite(grid.values)
    if known.sum() < 4:
        return np.full(time_s.size, np.nan)
    values = np.asarray(CubicSpline(own[known], grid.values[known])(time_s))
    # No value may be made up in a gap or beyond the ends.
    nearest = np.clip(np.searchsorted(own, time_s), 1, own.size - 1)
    missing = ~(known[nearest] & known[nearest - 1])
    missing |= (time_s < own[0] - 1e-9) | (time_s > own[-1] + 1e-9)
    return np.where(missing, np.nan, values)
