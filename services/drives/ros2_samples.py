"""Single samples with stamps of their own become evenly sampled batches.

An accelerometer samples by its crystal; what jitters is when a driver gets to stamp a sample. So
samples are numbered by their stamps and keep their values; the time of a batch is that of a line
through the stamps, which follows the crystal slowly. What is missing is missing: a batch ends
before a gap and the next one begins behind it.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import MAX_ACCELERATION_M_PER_S2, MAX_RATE_HZ, NS_PER_S
from services.common.errors import InputError
from services.drives.ros2_complaints import Complaints
from services.drives.runs import grid_index, sampling_rate_hz

LARGEST_RATE_ERROR: Final = 0.05
"""Clocks of sensors are right to far less; wrong site files are off by far more."""
_BATCH_S: Final = 0.1
_MEASURED_S: Final = 2.0
"""The rate is measured over so long, at the begin."""
_FEWEST: Final = 10
"""Samples of which a rate can be told."""
_FOLLOWS: Final = 1 / 64
"""The share of a stamp's error by which the line moves: noise of stamps becomes a tenth."""
_IRREGULAR: Final = 0.1
"""In sampling intervals: a stamp that is off by more is told."""
_LONG_GAP_S: Final = 1.0
"""After a longer one the line begins anew, as it does when stamps are in the past for so long."""


class RateError(InputError):
    """The stamps of a topic give another rate than the site file declares."""

    def __init__(self, topic: str, samples: int, line: str) -> None:
        super().__init__(line)
        self.topic = topic
        self.samples = samples
        """Number of samples that were measured, and are left out."""


class Piece(NamedTuple):
    """Samples without a gap; the time is of the first."""

    wall_time_ns: int
    rate_hz: float
    samples: NDArray[np.float64]


class EvenSamples:
    """Takes samples of one topic in the order they came; gives batches."""

    def __init__(
        self, topic: str, declared_hz: float, site_name: str, complaints: Complaints
    ) -> None:
        self._topic = topic
        self._declared_hz = declared_hz
        self._site_name = site_name
        self._complaints = complaints
        self._early: list[tuple[int, float]] = []
        """Until the rate is known."""
        self._rate_hz = 0.0
        self._zero_ns = 0
        self._off_ns = 0.0
        """How far the line is behind `_zero_ns` by now."""
        self._number = 0
        """Of the next sample, from the line's beginning."""
        self._samples: list[float] = []
        self._first_ns = 0
        self._behind = 0

    def add(self, stamp_ns: int, value: float) -> list[Piece]:
        """Take a sample in m/s²; return what is complete, which is nothing for most samples.

        RateError once the rate is known and is not the one that the site file declares; what has
        come is forgotten then.
        """
        if self._rate_hz:
            return self._place(stamp_ns, value)
        if self._early and stamp_ns <= self._early[-1][0]:
            self._complaints.add(self._topic, "stamps repeated or in the past, left out")
            self._behind += 1
            if self._behind > self._declared_hz * _LONG_GAP_S:
                self._complaints.add(self._topic, "times that the clock went back")
                self._early, self._behind = [(stamp_ns, value)], 0
            return []
        self._behind = 0
        self._early.append((stamp_ns, value))
        measured = stamp_ns - self._early[0][0] >= _MEASURED_S * NS_PER_S
        # Twice a rate that is declared and wrong is seen in half the time, and memory is bounded.
        if len(self._early) < _FEWEST or not (measured or len(self._early) > self._most_early()):
            return []
        return self._begin()

    def finish(self) -> list[Piece]:
        """Return what is left when no more samples come; RateError as `add`."""
        if not self._rate_hz and len(self._early) >= _FEWEST:
            return self._begin() + self._flush()
        self._complaints.add(self._topic, "samples, too few to tell their rate", len(self._early))
        self._early.clear()
        return self._flush()

    def restart(self) -> list[Piece]:
        """Measure the rate again, as another sensor goes on; RateError as `add`, of the first."""
        try:
            return self.finish()
        finally:
            self._rate_hz, self._behind = 0.0, 0

    def _most_early(self) -> float:
        return 2 * _MEASURED_S * self._declared_hz + _FEWEST

    def _begin(self) -> list[Piece]:
        """Measure the rate, and go through what has come."""
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
                f"{self._site_name} is {self._declared_hz:g} Hz, one of them must be mended",
            )
        self._rate_hz = rate_hz
        offset_s = float(np.mean(relative_s - grid_index(relative_s) / rate_hz))
        self._anchor(first_ns + round(offset_s * NS_PER_S))
        early, self._early = self._early, []
        return [piece for sample in early for piece in self._place(*sample)]

    def _anchor(self, zero_ns: int) -> None:
        self._zero_ns, self._off_ns, self._number, self._behind = zero_ns, 0.0, 0, 0

    def _expected_ns(self) -> int:
        return self._zero_ns + round(self._number * NS_PER_S / self._rate_hz + self._off_ns)

    def _place(self, stamp_ns: int, value: float) -> list[Piece]:
        found: list[Piece] = []
        ahead = (stamp_ns - self._expected_ns()) * self._rate_hz / NS_PER_S
        if ahead < -0.5:
            self._complaints.add(self._topic, "stamps repeated or in the past, left out")
            self._behind += 1
            if self._behind <= self._rate_hz * _LONG_GAP_S:
                return []
            self._complaints.add(self._topic, "times that the clock went back")
            found = self._flush()
            self._anchor(stamp_ns)
            ahead = 0.0
        self._behind = 0
        if ahead >= 0.5:
            missing = round(ahead)
            self._complaints.add(self._topic, "samples missing, left as gaps", missing)
            found = self._flush()
            if missing > self._rate_hz * _LONG_GAP_S:
                self._anchor(stamp_ns)
                ahead = 0.0
            else:
                self._number += missing
                ahead -= missing
        if abs(ahead) > _IRREGULAR:
            self._complaints.add(self._topic, "stamps off by over a tenth of the interval")
        self._off_ns += _FOLLOWS * ahead * NS_PER_S / self._rate_hz
        if abs(value) <= MAX_ACCELERATION_M_PER_S2:  # of a NaN it is false, too
            if not self._samples:
                self._first_ns = self._expected_ns()
            self._samples.append(value)
        else:
            self._complaints.add(self._topic, "samples not finite or too large, left as gaps")
            found += self._flush()
        self._number += 1
        if len(self._samples) >= max(1, round(_BATCH_S * self._rate_hz)):
            found += self._flush()
        return found

    def _flush(self) -> list[Piece]:
        if not self._samples:
            return []
        piece = Piece(self._first_ns, self._rate_hz, np.array(self._samples))
        self._samples = []
        return [piece]
