"""Measurements of trucks, as the viewer shows them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import AccelBatch, GnssFix
from schemas.topics import Message
from services.drives.signals import series_of_batches
from services.finding.drive import DriveMessages, drives_of

_Identity = tuple[int, int]


class VehicleSignals(NamedTuple):
    """Messages of one truck, in the order of their sequence numbers."""

    accel: Sequence[AccelBatch]
    gnss: Sequence[GnssFix]

    @property
    def channels(self) -> frozenset[str]:
        """Accelerometers of all batches."""
        return frozenset(name for batch in self.accel for name in batch.channels)


def signals_of(drives: Iterable[DriveMessages]) -> dict[str, VehicleSignals]:
    """Return the signals of each vehicle in order of time; a message counts once."""
    accel: dict[str, dict[_Identity, AccelBatch]] = {}
    gnss: dict[str, dict[_Identity, GnssFix]] = {}
    for drive in drives:
        boot, vehicle = drive.boot_id, drive.vehicle
        batches = {(boot, sequence): one for sequence, one in drive.accelerations.items()}
        fixes = {(boot, sequence): one for sequence, one in drive.fixes.items()}
        accel.setdefault(vehicle, {}).update(batches)
        gnss.setdefault(vehicle, {}).update(fixes)
    return {
        vehicle: VehicleSignals(
            sorted(accel[vehicle].values(), key=lambda one: one.wall_time_ns),
            sorted(gnss[vehicle].values(), key=lambda one: one.wall_time_ns),
        )
        for vehicle in sorted(accel)
        if accel[vehicle] or gnss[vehicle]
    }


def signals_of_messages(messages: Iterable[Message]) -> dict[str, VehicleSignals]:
    """Decode the sensor messages of a recording, by vehicle, in order of time."""
    return signals_of(drives_of(messages))


def acceleration_series(
    batches: Sequence[AccelBatch],
) -> dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Join batches into one series per channel: wall time (ns) and acceleration (m/s²), (n,).

    A NaN is inserted into every gap longer than one and a half samples: a plot then breaks its line
    there instead of drawing values that were not measured.
    """
    marked = {}
    for name, (times, samples) in series_of_batches(batches).items():
        rates = (batch.channels[name].rate_hz for batch in batches if name in batch.channels)
        period_ns = 1e9 / min(rates)
        gaps = np.flatnonzero(np.diff(times) > 1.5 * period_ns) + 1
        marked[name] = (
            np.insert(times, gaps, times[gaps - 1] + int(period_ns / 2)),
            np.insert(samples, gaps, np.nan),
        )
    return marked
