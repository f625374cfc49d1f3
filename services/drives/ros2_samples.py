"""Conversion of single stamped samples to evenly sampled batches.

An accelerometer samples by its crystal; the jitter is that of the driver's stamps. So samples are
numbered by their stamps and keep their values; the time of a batch is that of a line through the
stamps, which follows the crystal slowly. Gaps stay: a batch ends before a gap and the next one
begins behind it.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import MAX_ACCELERATION_M_PER_S2, MAX_RATE_HZ, NS_PER_S
from services.common.errors import InputError
from services.drives.ros2_anomalies import AnomalyCounts
from services.drives.runs import grid_index, sampling_rate_hz

LARGEST_RATE_ERROR: Final = 0.05
"""Largest relative error of a rate; wrong site files exceed it by far."""
_BATCH_S: Final = 0.1
_MEASURED_S: Final = 2.0
"""Duration in s at the beginning over which the rate is measured."""
_FEWEST: Final = 10
"""Fewest samples for the measurement of a rate."""
_FOLLOWS: Final = 1 / 64
"""Share of a stamp's error by which the line moves: noise of stamps is reduced to a tenth."""
_IRREGULAR: Final = 0.1
"""Deviation of a stamp, in sampling intervals, that counts as irregular."""
_LONG_GAP_S: Final = 1.0
"""Gap in s after which the line starts again, as after as long a time of past stamps."""


class RateError(InputError):
    """The stamps of a topic give another rate than the site file declares."""

    def __init__(self, topic: str, samples: int, line: str) -> None:
        super().__init__(line)
        self.topic = topic
        self.samples = samples
        """Number of samples that were measured, and are left out."""


class SampleBlock(NamedTuple):
    """Samples without a gap; the time is that of the first."""

    wall_time_ns: int
    rate_hz: float
    samples: NDArray[np.float64]


class Resampler:
    """Converter of one topic's samples, in order of arrival, to batches."""

    def __init__(
        self, topic: str, declared_hz: float, site_name: str, anomalies: AnomalyCounts
    ) -> None:
        self._topic = topic
        self._declared_hz = declared_hz
        self._site_name = site_name
        self._anomalies = anomalies
        self._early: list[tuple[int, float]] = []
        """Samples before the rate is known."""
        self._rate_hz = 0.0
        self._zero_ns = 0
        self._off_ns = 0.0
        """Present delay of the line after `_zero_ns`."""
        self._number = 0
        """Number of the next sample, from the line's beginning."""
        self._samples: list[float] = []
        self._first_ns = 0
        self._behind = 0

    def add(self, stamp_ns: int, value: float) -> list[SampleBlock]:
        """Add a sample in m/s²; return complete blocks, for most samples none.

        Raise RateError once the rate is known and differs from the declared one; the samples up to
        then are dropped.
        """
        if self._rate_hz:
            return self._place(stamp_ns, value)
        if self._early and stamp_ns <= self._early[-1][0]:
            self._anomalies.add(self._topic, "stamps repeated or in the past, left out")
            self._behind += 1
            if self._behind > self._declared_hz * _LONG_GAP_S:
                self._anomalies.add(self._topic, "steps back of the clock")
                self._early, self._behind = [(stamp_ns, value)], 0
            return []
        self._behind = 0
        self._early.append((stamp_ns, value))
        measured = stamp_ns - self._early[0][0] >= _MEASURED_S * NS_PER_S
        # A wrong declared rate is detected in half the time at twice that rate, and memory is
        # bounded.
        most = 2 * _MEASURED_S * self._declared_hz + _FEWEST
        if len(self._early) < _FEWEST or not (measured or len(self._early) > most):
            return []
        return self._begin()

    def finish(self) -> list[SampleBlock]:
        """Return the remaining samples at the end of the input; RateError as for `add`."""
        if not self._rate_hz and len(self._early) >= _FEWEST:
            return self._begin() + self._flush()
        self._anomalies.add(self._topic, "samples, too few to measure their rate", len(self._early))
        self._early.clear()
        return self._flush()

    def restart(self) -> list[SampleBlock]:
        """Measure the rate again for another sensor; RateError as for `add`, of the first one."""
        try:
            return self.finish()
        finally:
            self._rate_hz, self._behind = 0.0, 0

    def _begin(self) -> list[SampleBlock]:
        """Measure the rate, and convert the samples up to now."""
        first_ns = self._early[0][0]
        relative_s = np.array([stamp_ns - first_ns for stamp_ns, _ in self._early]) / NS_PER_S
        rate_hz = sampling_rate_hz(relative_s)
        if not abs(rate_hz / self._declared_hz - 1) <= LARGEST_RATE_ERROR or rate_hz > MAX_RATE_HZ:
            samples = len(self._early)
            self._early.clear()
            raise RateError(
                self._topic,
                samples,
                f"{self._topic}: its stamps give a rate of {rate_hz:.4g} Hz, but sensor.rate_hz of "
                f"{self._site_name} is {self._declared_hz:g} Hz, correct one of them",
            )
        self._rate_hz = rate_hz
        offset_s = float(np.mean(relative_s - grid_index(relative_s) / rate_hz))
        self._anchor(first_ns + round(offset_s * NS_PER_S))
        early, self._early = self._early, []
        return [block for sample in early for block in self._place(*sample)]

    def _anchor(self, zero_ns: int) -> None:
        self._zero_ns, self._off_ns, self._number, self._behind = zero_ns, 0.0, 0, 0

    def _expected_ns(self) -> int:
        return self._zero_ns + round(self._number * NS_PER_S / self._rate_hz + self._off_ns)

    def _place(self, stamp_ns: int, value: float) -> list[SampleBlock]:
        found: list[SampleBlock] = []
        ahead = (stamp_ns - self._expected_ns()) * self._rate_hz / NS_PER_S
        if ahead < -0.5:
            self._anomalies.add(self._topic, "stamps repeated or in the past, left out")
            self._behind += 1
            if self._behind <= self._rate_hz * _LONG_GAP_S:
                return []
            self._anomalies.add(self._topic, "steps back of the clock")
            found = self._flush()
            self._anchor(stamp_ns)
            ahead = 0.0
        self._behind = 0
        if ahead >= 0.5:
            missing = round(ahead)
            self._anomalies.add(self._topic, "samples missing, left as gaps", missing)
            found = self._flush()
            if missing > self._rate_hz * _LONG_GAP_S:
                self._anchor(stamp_ns)
                ahead = 0.0
            else:
                self._number += missing
                ahead -= missing
        if abs(ahead) > _IRREGULAR:
            self._anomalies.add(self._topic, "stamps off by over a tenth of the interval")
        self._off_ns += _FOLLOWS * ahead * NS_PER_S / self._rate_hz
        if abs(value) <= MAX_ACCELERATION_M_PER_S2:  # it is false for NaN
            if not self._samples:
                self._first_ns = self._expected_ns()
            self._samples.append(value)
        else:
            self._anomalies.add(self._topic, "samples not finite or too large, left as gaps")
            found += self._flush()
        self._number += 1
        if len(self._samples) >= max(1, round(_BATCH_S * self._rate_hz)):
            found += self._flush()
        return found

    def _flush(self) -> list[SampleBlock]:
        if not self._samples:
            return []
        block = SampleBlock(self._first_ns, self._rate_hz, np.array(self._samples))
        self._samples = []
        return [block]
