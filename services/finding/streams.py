"""Messages of one boot of one truck as arrays: ordered, unique, on one clock.

Batches and fixes may arrive late, twice or not at all. Within a boot they are ordered by sequence
and placed by the truck's monotonic clock, which no step of the wall clock disturbs. Results for a
stretch of time depend on the messages of that stretch alone, not on their order of arrival or on
later ones.
"""

from bisect import insort
from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple, TypeVar

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from schemas.proto import driveby_pb2 as pb
from schemas.signals import MAX_BATCH_S, MAX_CHANNELS, NS_PER_S, AccelBatch, GnssFix, in_order
from services.common.arrays import Floats

TruckMessage = TypeVar("TruckMessage", bound=pb.AccelBatch | pb.GnssFix | pb.VehicleInfo)

PATIENCE_S = 10.0
"""Time in s to wait for a missing message after newer data arrived; then it counts as lost."""
_LARGEST_RATE_ERROR = 0.02
"""Largest relative error of a rate: a crystal has 1e-4, more is another sensor's rate."""
_CLOCK_ERROR = 1e-3
"""Relative error of the declared rate that does not yet indicate missing samples."""
_WALL_CLOCK_S = 10.0
"""Duration in s of the fixes before a time from which the wall clock is read."""
_MAX_NAMES = 10 * MAX_CHANNELS
"""Maximum number of channel names remembered of a boot."""
_JITTER = 8.0
"""Multiple of the usual deviation of batch times that is not jitter."""


class Fixes(NamedTuple):
    """Fixes in order of time: all arrays (m,)."""

    time_s: Floats
    latitude_deg: Floats
    longitude_deg: Floats
    speed_m_per_s: Floats
    altitude_m: Floats

    def since(self, time_s: float) -> "Fixes":
        """Return the fixes from `time_s` on."""
        first = int(np.searchsorted(self.time_s, time_s))
        return Fixes(*(column[first:] for column in self))


class Samples(NamedTuple):
    """Samples of a truck on one even grid.

    `channels` maps each channel that the truck has to (n,) accelerations in m/s², NaN where samples
    are missing. Sample k is at `start_s` + k/`rate_hz`, on the clock of `Boot`.
    """

    start_s: float
    rate_hz: float
    channels: dict[str, Floats]
    slowest_rate_hz: float = np.inf
    """Rate of the slowest channel, where that is slower than the grid."""


class Boot:
    """All messages of one boot of a truck that are still needed.

    Times are seconds on the truck's own clock, not relative to the first message: which one came
    first is chance, and would change the last digits of all results.
    """

    def __init__(self) -> None:
        self._batches: dict[int, AccelBatch] = {}
        self._fixes: list[tuple[int, GnssFix]] = []
        """Fixes by sequence, up to the first missing one, and late ones."""
        self._waiting: dict[int, GnssFix] = {}
        """Fixes that arrived before a missing one."""
        self._next_fix = 0
        self._fresh: list[GnssFix] = []
        self._columns: Floats = np.empty((len(Fixes._fields), 0))
        """Known fixes as `fixes` returns them, without fresh ones: thousands, requested often."""
        self._ahead_ns: dict[int, int] = {}
        """Lead of the wall clock by the known fixes, cached as messages repeat the same times."""
        self._forgotten_ns = -1
        self._kept_from = 0
        """Sequence of the first batch that is not older than that, as far as known."""
        self._first_accel = self._first_fix = (1 << 64, 0)
        """Sequence and time of the earliest message received."""
        self._channels: set[str] = set()

    def add_accel(self, batch: AccelBatch) -> None:
        """Add a batch; ignore a duplicate."""
        self._first_accel = min(self._first_accel, (batch.sequence, batch.device_time_ns))
        if batch.device_time_ns >= self._forgotten_ns:
            self._batches.setdefault(batch.sequence, batch)
            # A truck that names other channels in every batch must not fill the memory.
            if len(self._channels) <= _MAX_NAMES:
                self._channels.update(batch.channels)
        else:
            self._kept_from = max(self._kept_from, batch.sequence + 1)

    def add_fix(self, fix: GnssFix) -> bool:
        """Add a fix, known after `release_fixes`; ignore a duplicate.

        Return whether it had been given up as lost, and is known at once.
        """
        self._first_fix = min(self._first_fix, (fix.sequence, fix.device_time_ns))
        if fix.sequence >= self._next_fix:
            self._waiting.setdefault(fix.sequence, fix)
        elif fix.device_time_ns >= self._forgotten_ns and fix.sequence not in dict(self._fixes):
            insort(self._fixes, (fix.sequence, fix))
            self._fresh.append(fix)
            self._ahead_ns.clear()
            return True
        return False

    def release_fixes(self, *, all_there_is: bool = False) -> Iterator[GnssFix]:
        """Yield waiting fixes in their order and make each known to `fixes`.

        A fix waits for those before it, until they count as lost or `all_there_is` is set.
        """
        while self._waiting:
            sequence = min(self._waiting)
            if sequence != self._next_fix and not all_there_is:
                latest_ns = max(fix.device_time_ns for fix in self._waiting.values())
                waited_ns = latest_ns - self._waiting[sequence].device_time_ns
                if waited_ns < PATIENCE_S * NS_PER_S:
                    return
            fix = self._waiting.pop(sequence)
            self._next_fix = sequence + 1
            self._fixes.append((sequence, fix))
            self._fresh.append(fix)
            self._ahead_ns.clear()
            yield fix

    def is_cut_off_at(self, time_s: float) -> bool:
        """Return whether messages after `time_s` and before the first received may be missing.

        A history that reaches back to the first message of a boot is complete.
        """
        return any(
            sequence > 0 and first_ns > time_s * NS_PER_S
            for sequence, first_ns in (self._first_accel, self._first_fix)
        )

    def lacks_fixes(self) -> bool:
        """Return whether received fixes wait for an earlier one."""
        return bool(self._waiting)

    def forget_before(self, time_s: float) -> None:
        """Drop older data, so that the memory stays bounded on a long drive."""
        limit_ns = max(self._forgotten_ns, round(time_s * NS_PER_S))
        self._forgotten_ns = limit_ns
        for sequence in [s for s, b in self._batches.items() if b.device_time_ns < limit_ns]:
            del self._batches[sequence]
            self._kept_from = max(self._kept_from, sequence + 1)
        self._fixes = [(s, f) for s, f in self._fixes if f.device_time_ns >= limit_ns]
        self._ahead_ns.clear()
        known_s = self.fixes().time_s
        self._columns = np.ascontiguousarray(self._columns[:, known_s >= limit_ns / NS_PER_S])

    def latest_accel_s(self) -> float:
        """Return the time after the last sample received; -inf without any."""
        return max((_end_ns(batch) / NS_PER_S for batch in self._batches.values()), default=-np.inf)

    def lacks_accel(self, start_s: float, stop_s: float) -> bool:
        """Return whether batches between two times are missing that may still arrive."""
        start_ns, stop_ns = round(start_s * NS_PER_S), round(stop_s * NS_PER_S)
        ordered = sorted(self._batches)
        begin = stop = -1
        for sequence in ordered:
            batch = self._batches[sequence]
            if batch.device_time_ns <= start_ns:
                begin = sequence
            is_late = batch.device_time_ns + 1.01 * MAX_BATCH_S * NS_PER_S >= stop_ns
            if is_late and _end_ns(batch) >= stop_ns:  # rarely evaluated: it takes time
                stop = sequence
                break
        if stop < 0:
            return True
        begin = max(begin, self._kept_from)
        return sum(begin <= sequence <= stop for sequence in ordered) != stop - begin + 1

    def wall_time_ns(self, time_s: float) -> int:
        """Return the wall time (ns since 1970 UTC) of a time on this clock, by the fixes so far.

        It is the median of their offsets, as single stamps jitter. At least one fix is required.
        """
        time_ns = round(time_s * NS_PER_S)
        if time_ns not in self._ahead_ns:
            self._ahead_ns[time_ns] = self._wall_clock_ahead_ns(time_ns)
        return time_ns + self._ahead_ns[time_ns]

    def _wall_clock_ahead_ns(self, time_ns: int) -> int:
        first_ns = time_ns - _WALL_CLOCK_S * NS_PER_S
        before = [
            fix.wall_time_ns - fix.device_time_ns
            for _, fix in self._fixes
            if first_ns < fix.device_time_ns <= time_ns
        ]
        if not before:
            nearest = min(self._fixes, key=lambda item: abs(item[1].device_time_ns - time_ns))[1]
            before = [nearest.wall_time_ns - nearest.device_time_ns]
        return sorted(before)[len(before) // 2]

    def fixes(self) -> Fixes:
        """Return all released fixes in order of time."""
        if self._fresh:
            rows = [
                (
                    f.device_time_ns / NS_PER_S,
                    f.latitude_deg,
                    f.longitude_deg,
                    f.speed_m_per_s,
                    f.altitude_m,
                )
                for f in self._fresh
            ]
            self._fresh.clear()
            columns = np.concatenate([self._columns, np.array(rows).T], axis=1)
            if np.any(np.diff(columns[0]) <= 0.0):
                columns = columns[:, np.lexsort(columns[::-1])]
                columns = columns[:, np.concatenate([[True], np.diff(columns[0]) > 0.0])]
            self._columns = np.ascontiguousarray(columns)
        return Fixes(*self._columns)

    def samples(
        self, start_s: float, stop_s: float, names: Collection[str] | None = None
    ) -> Samples | None:
        """Return samples from `start` to `stop`, on the grid of the fastest channel.

        Only the received channels in `names`, if given, are used. A slower channel is interpolated
        band-limited. A channel of this truck without a sample in this stretch is NaN throughout.
        Return None for a truck without any channel.
        """
        sequences = [
            sequence
            for sequence, batch in self._batches.items()
            if start_s - MAX_BATCH_S < _seconds(batch.device_time_ns) <= stop_s
        ]
        chosen = [self._batches[sequence] for sequence in sorted(sequences)]
        known = in_order(self._channels if names is None else self._channels & set(names))
        grids = {
            name: grid
            for name in known
            if (grid := _grid(name, chosen, start_s, stop_s)) is not None
        }
        if not grids:
            if not known:
                return None
            return Samples(start_s, 1.0, {name: np.empty(0) for name in sorted(known)})
        fastest = max(grids.values(), key=lambda grid: grid.rate_hz)
        time = fastest.start_s + np.arange(fastest.values.size) / fastest.rate_hz
        channels = {
            name: _resampled(grids[name], time)
            if name in grids
            else np.full(fastest.values.size, np.nan)
            for name in known
        }
        slowest_hz = min(grid.rate_hz for grid in grids.values())
        return Samples(fastest.start_s, fastest.rate_hz, channels, slowest_hz)


def device_time_ns(stream: str, payload: bytes) -> int:
    """Return the time of an `accel`, `gnss` or `info` message on the truck's clock.

    Raise ValueError if it is malformed.
    """
    kinds: dict[str, type[pb.AccelBatch | pb.GnssFix | pb.VehicleInfo]] = {
        "accel": pb.AccelBatch,
        "gnss": pb.GnssFix,
        "info": pb.VehicleInfo,
    }
    return _parsed(kinds[stream](), payload).device_time_ns


class BatchExtent(NamedTuple):
    """Time, rate and number of samples of a batch's fastest channel."""

    device_time_ns: int
    rate_hz: float
    samples: int


def batch_extent(payload: bytes) -> BatchExtent:
    """Return the extent of an `accel` message; ValueError if it is malformed or has no samples."""
    message = _parsed(pb.AccelBatch(), payload)
    channels = [(one.rate_hz, len(one.acceleration_m_per_s2)) for one in message.channels]
    rate_hz, samples = max(channels, default=(0.0, 0))
    if not (0.0 < rate_hz < np.inf and samples):
        raise ValueError("an AccelBatch without samples")
    return BatchExtent(message.device_time_ns, rate_hz, samples)


def _parsed(message: TruckMessage, payload: bytes) -> TruckMessage:
    try:
        message.ParseFromString(payload)
    except DecodeError as error:
        raise ValueError(f"not a {message.DESCRIPTOR.full_name}: {error}") from None
    return message


def missing_samples(
    sequences: NDArray[np.int64],
    times_ns: NDArray[np.int64],
    sizes: NDArray[np.int64],
    rate_hz: float,
) -> NDArray[np.int64]:
    """Return the number of samples missing after each batch but the last, as identification does.

    `sequences`, `times_ns` and `sizes` (b,), b ≥ 1, are in order of `sequences`.
    """
    at = (times_ns - times_ns[0]) * (rate_hz / NS_PER_S)
    numbers = _numbers(at, sizes.tolist(), sequences.tolist())
    return np.maximum(np.diff(numbers) - sizes[:-1], 0)


class _Grid(NamedTuple):
    start_s: float
    rate_hz: float
    values: Floats


def _grid(name: str, batches: list[AccelBatch], start_s: float, stop_s: float) -> _Grid | None:
    parts = [batch for batch in batches if name in batch.channels]
    if not parts:
        return None
    declared = float(np.median([batch.channels[name].rate_hz for batch in parts]))
    first_ns = parts[0].device_time_ns
    times = np.array([batch.device_time_ns - first_ns for batch in parts]) / NS_PER_S
    sizes = [batch.channels[name].samples.size for batch in parts]
    numbers = _numbers(times * declared, sizes, [batch.sequence for batch in parts])
    rate, offset_s = _fit_clock(numbers, times, declared)
    values = np.full(int(numbers[-1]) + sizes[-1], np.nan)
    for number, batch in zip(numbers.tolist(), parts, strict=True):
        samples = batch.channels[name].samples
        values[number : number + samples.size] = samples
    # The times of the ends relative to the first sample are exact to far less than a sample.
    zero_s = first_ns / NS_PER_S + offset_s
    begin = max(0, int(np.ceil((start_s - zero_s) * rate - 1e-6)))
    stop = min(values.size, int(np.floor((stop_s - zero_s) * rate + 1e-6)) + 1)
    if stop <= begin:
        return None
    return _Grid(zero_s + begin / rate, rate, values[begin:stop])


def _numbers(at: Floats, sizes: list[int], sequences: list[int]) -> NDArray[np.int64]:
    """Return numbers (b,) of the batches' first samples, from times `at` in sampling intervals.

    A batch that follows its predecessor has the next numbers, whatever the jitter of its time.
    Where batches are missing, as many samples are missing as those would have had, unless the time
    indicates otherwise or sizes vary; so also where a batch starts later than its predecessor ends.
    """
    usual = int(np.median(sizes))
    before = np.array(sizes[:-1], dtype=np.int64)
    jumps = np.diff(at) - before
    skipped = np.diff(sequences) - 1
    # A deviation of more than half a batch is no jitter, however common.
    followed = np.abs(jumps[skipped == 0])
    jitter = np.quantile(followed, 0.5, method="lower") if followed.size else 0.0
    lost = skipped * usual
    tolerance = max(0.5, min(_JITTER * jitter, 0.5 * usual)) + _CLOCK_ERROR * lost
    is_expected = (np.abs(jumps - lost) < tolerance) & ((skipped == 0) | (before == usual))
    missing = np.where(is_expected, lost, np.rint(jumps)).astype(np.int64)
    return np.concatenate([[0], np.cumsum(np.maximum(before + missing, 0))])


def _fit_clock(
    numbers: NDArray[np.int64], times_s: Floats, declared_hz: float
) -> tuple[float, float]:
    """Return the true rate and the time of sample 0 after `times_s[0]`, from batch times (b,).

    The times of a regular sampler are on a line but for rounding; then the declared rate is used.
    """
    if numbers.size < 3 or np.all(np.abs(times_s - numbers / declared_hz) < 1e-3 / declared_hz):
        return declared_hz, 0.0
    centred = numbers - numbers.mean()
    slope = float(centred @ times_s / max(centred @ centred, 1.0))
    if not abs(slope * declared_hz - 1.0) < _LARGEST_RATE_ERROR:
        return declared_hz, 0.0
    return 1.0 / slope, float(times_s.mean() - slope * numbers.mean())


def _resampled(grid: _Grid, time_s: Floats) -> Floats:
    """Return the values of a grid at other times (n,); NaN in and near its gaps and ends.

    At times of its own samples (of most channels all) a value is itself. Between them it needs
    `INTERPOLATION_REACH` unbroken samples on both sides: a spline through fewer would lose high
    frequencies.
    """
    place = (time_s - grid.start_s) * grid.rate_hz
    nearest = np.rint(place).astype(np.int64)
    inside = (nearest >= 0) & (nearest < grid.values.size)
    own = inside & (np.abs(place - nearest) < 1e-3)
    values = np.full(time_s.size, np.nan)
    values[own] = grid.values[nearest[own]]
    between = inside & ~own
    if np.any(between):
        from pre_core.crossing.channels import interpolate_at  # slow to import, seldom needed

        # A NaN among the samples used for a time makes that value NaN.
        values[between] = interpolate_at(grid.values, place[between])
    return values


def boot_of(fixes: Mapping[int, GnssFix]) -> Boot:
    """Return a boot with all fixes given, by their sequence, of a finished stream."""
    boot = Boot()
    for sequence in sorted(fixes):
        boot.add_fix(fixes[sequence])
        for _ in boot.release_fixes(all_there_is=True):
            pass
    return boot


def _end_ns(batch: AccelBatch) -> int:
    longest = max(channel.samples.size / channel.rate_hz for channel in batch.channels.values())
    return batch.device_time_ns + round(longest * NS_PER_S)


def _seconds(device_time_ns: int) -> float:
    return device_time_ns / NS_PER_S
