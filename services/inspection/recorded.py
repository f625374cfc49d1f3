"""Runs of trucks to check, from recordings and folders of CSV files."""

from collections.abc import Collection, Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from schemas.signals import NS_PER_S, AccelBatch, GnssFix
from schemas.site import Site
from schemas.topics import Message
from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.progress import Offset, no_progress
from services.drives.importing import normalised_runs, vehicle_of
from services.drives.runs import run_to_messages
from services.finding.drive import DriveMessages, drives_of
from services.finding.streams import Boot, Fixes, Samples, boot_of
from services.recordings.recording import read_messages

_REALM: Final = "import-check"
_LONGEST_S: Final = 1800.0
"""Duration in s from the start of a run over which accelerations are checked."""
_LONGEST_END_S: Final = 1.0


class ClockSeries(NamedTuple):
    """The two clocks in a stream's messages, in order: (n,) each."""

    device_s: Floats
    wall_less_device_s: Floats
    """Wall time less device time, relative to the first acceleration."""


class InspectedRun(NamedTuple):
    """One run of one truck; times in s on the truck's own clock."""

    source: str
    vehicle: str
    fixes: Fixes
    accuracy_m: Floats
    """Standard deviation (m,) that the receiver states; NaN without a statement."""
    samples: Samples | None
    rates_hz: dict[str, float]
    """Rate of each channel, measured by the truck's clock."""
    missing_batches: int
    clocks: dict[str, ClockSeries]
    """Clocks of "accel" and "gnss"."""
    is_cut: bool
    """Whether the run has more accelerations than are checked."""

    def of_channels(self, names: Collection[str]) -> "InspectedRun":
        """Return the run with these channels only."""
        if self.samples is None:
            return self
        there = {name: v for name, v in self.samples.channels.items() if name in names}
        return self._replace(samples=self.samples._replace(channels=there))


def recorded_runs(
    path: Path, site: Site, site_name: str, progress: Offset = no_progress
) -> list[InspectedRun]:
    """Return all runs of all trucks in a recording or a folder; InputError if it is neither.

    `progress` is called with the number of bytes read.
    """
    is_folder = path.is_dir()
    messages = _of_folder(path, site, site_name) if is_folder else read_messages(path, progress)
    # A replay in the same file is the same drive.
    of_one_realm = (m._replace(key=m.key._replace(realm=_REALM)) for m in messages)
    drives = [one for one in drives_of(of_one_realm) if one.accelerations or one.fixes]
    if not drives:
        raise InputError(f"{path}: holds neither accelerations nor positions of a truck")
    return [_recorded(str(path), drive) for drive in drives]


def _with_way(error: str, folder: Path) -> str:
    """Return an error of reading a folder; where it names options of an import, with the way."""
    if not any(option in error for option in ("--zone", "--map", "--start", "--yes")):
        return error
    return (
        f"{error}; driveby check has none of these options: driveby import {folder} "
        "--site SITE.toml -o DRIVE.mcap with them, then driveby check DRIVE.mcap"
    )


def _of_folder(folder: Path, site: Site, site_name: str) -> Iterator[Message]:
    """Yield the messages as `driveby import` would read them; the check judges the rates."""
    vehicle_id = vehicle_of(site, site_name, None)
    try:
        runs = normalised_runs([folder], site, site_name, vehicle_id, checks_rate=False)
    except InputError as error:
        raise InputError(_with_way(str(error), folder)) from error
    return run_to_messages(runs, site, _REALM, vehicle_id)


def _recorded(source: str, drive: DriveMessages) -> InspectedRun:
    batches, fixes = drive.batches(), drive.fixes_in_order()
    first_s = batches[0].device_time_ns / NS_PER_S if batches else 0.0
    boot = boot_of(drive.fixes)
    inspected = [b for b in batches if b.device_time_ns / NS_PER_S < first_s + _LONGEST_S]
    for batch in inspected:
        boot.add_accel(batch)
    zero_ns = _offset_ns(batches[0]) if batches else (_offset_ns(fixes[0]) if fixes else 0)
    accuracy = [f.horizontal_accuracy_m for f in fixes]
    return InspectedRun(
        source,
        drive.vehicle,
        boot.fixes(),
        np.array([np.nan if value is None else value for value in accuracy]),
        _samples(boot, inspected),
        _rates(inspected),
        sum(after - before - 1 for before, after in pairwise(sorted(drive.accelerations))),
        {
            "accel": _clock(batches, zero_ns),
            "gnss": _clock(fixes, zero_ns),
        },
        len(inspected) < len(batches),
    )


def _samples(boot: Boot, batches: list[AccelBatch]) -> Samples | None:
    if not batches:
        return None
    begin_s = batches[0].device_time_ns / NS_PER_S
    samples = boot.samples(begin_s - 1.0, boot.latest_accel_s() + 1.0)
    return None if samples is None else _without_ends(samples)


def _without_ends(samples: Samples) -> Samples:
    """Remove the ends of an interpolated slow channel, which are not gaps."""
    if not samples.channels:
        return samples
    holes = np.flatnonzero(~np.isfinite(np.stack(list(samples.channels.values()))).all(axis=0))
    count = max(values.size for values in samples.channels.values())
    longest = round(_LONGEST_END_S * samples.rate_hz)
    first = int(holes[holes < longest].max(initial=-1)) + 1
    stop = int(holes[holes >= max(first, count - longest)].min(initial=count))
    return samples._replace(
        start_s=samples.start_s + first / samples.rate_hz,
        channels={name: values[first:stop] for name, values in samples.channels.items()},
    )


def _rates(batches: list[AccelBatch]) -> dict[str, float]:
    """Return the number of samples of each channel over their duration, without gaps."""
    found: dict[str, float] = {}
    names = dict.fromkeys(name for batch in batches for name in batch.channels)
    for name in names:
        counts, seconds = 0, 0.0
        for before, after in pairwise(batches):
            took_s = (after.device_time_ns - before.device_time_ns) / NS_PER_S
            channel = before.channels.get(name)
            if channel is None or after.sequence != before.sequence + 1:
                continue
            # Twice as long as the samples take by the declared rate: there is a gap between them.
            if 0.0 < took_s < 2.0 * channel.samples.size / channel.rate_hz:
                counts, seconds = counts + channel.samples.size, seconds + took_s
        if seconds > 0.0:
            found[name] = counts / seconds
    return found


def _clock(stamped: Iterable[AccelBatch | GnssFix], zero_ns: int) -> ClockSeries:
    rows = [(m.device_time_ns / NS_PER_S, (_offset_ns(m) - zero_ns) / NS_PER_S) for m in stamped]
    table = np.array(rows, dtype=np.float64).reshape(-1, 2).T
    return ClockSeries(*table)


def _offset_ns(message: AccelBatch | GnssFix) -> int:
    return message.wall_time_ns - message.device_time_ns
