"""Runs of trucks as a check looks at them: from recordings, and from folders of CSV files."""

from collections.abc import Collection, Iterable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import NS_PER_S, AccelBatch, GnssFix, decode_accel, decode_gnss
from schemas.site import Site
from services.common.errors import InputError
from services.common.progress import Offset, unwatched
from services.drives.comma2k19 import is_comma2k19, read_comma2k19
from services.drives.csv_import import read_folder
from services.drives.importing import vehicle_of
from services.drives.runs import normalised, run_to_messages
from services.identification.placed import middle_sensor
from services.identification.streams import Boot, Fixes, Samples, boot_of
from services.recordings.recording import Message, read_messages

Floats = NDArray[np.float64]

_REALM: Final = "import-check"
_LONGEST_S: Final = 1800.0
"""Accelerations of so long from the start of a run are looked at: a check need not see all."""
_LONGEST_END_S: Final = 1.0


class Clock(NamedTuple):
    """What a stream's messages say of the two clocks, in order: (n,) each."""

    device_s: Floats
    wall_less_device_s: Floats
    """Wall time less device time, from the first one of the accelerations on."""


class Recorded(NamedTuple):
    """One run of one truck. Times are seconds on the truck's own clock."""

    source: str
    vehicle: str
    fixes: Fixes
    accuracy_m: Floats
    """(m,) one standard deviation as the receiver states it; NaN where it does not."""
    samples: Samples | None
    rates_hz: dict[str, float]
    """By channel, measured by the truck's clock."""
    declared_rates_hz: dict[str, float]
    """By channel, as the messages say."""
    missing_batches: int
    clocks: dict[str, Clock]
    """Of "accel" and "gnss"."""
    is_cut: bool
    """Whether the run has more accelerations than were looked at."""

    def of_channels(self, names: Collection[str]) -> "Recorded":
        """The run without channels other than these."""
        if self.samples is None:
            return self
        there = {name: v for name, v in self.samples.channels.items() if name in names}
        return self._replace(samples=self.samples._replace(channels=there))


def recorded_runs(
    path: Path, site: Site, site_name: str, progress: Offset = unwatched
) -> list[Recorded]:
    """All runs of all trucks in a recording or a folder; InputError if it is neither.

    `progress` is told how far a recording has been read.
    """
    is_folder = path.is_dir()
    messages = _of_folder(path, site, site_name) if is_folder else read_messages(path, progress)
    accel: dict[tuple[str, int], dict[int, AccelBatch]] = {}
    gnss: dict[tuple[str, int], dict[int, GnssFix]] = {}
    for message in messages:
        if message.key.owner != "vehicle":
            continue
        whose = (message.key.identifier, message.boot_id)
        try:
            if message.key.stream == "accel":
                accel.setdefault(whose, {})[message.sequence] = decode_accel(message.payload)
            elif message.key.stream == "gnss":
                gnss.setdefault(whose, {})[message.sequence] = decode_gnss(message.payload)
        except ValueError:
            continue  # the logger has counted what cannot be read
    if not accel and not gnss:
        raise InputError(f"{path}: holds neither accelerations nor positions of a truck")
    return [
        _recorded(str(path), whose[0], accel.get(whose, {}), gnss.get(whose, {}))
        for whose in dict.fromkeys(chain(accel, gnss))
    ]


def _of_folder(folder: Path, site: Site, site_name: str) -> Iterator[Message]:
    """As `driveby import` would read it, but that rates are judged by the check."""
    vehicle_id = vehicle_of(site, site_name, None)
    if is_comma2k19(folder):
        runs = [read_comma2k19(folder)]
    else:
        vehicle = site.vehicle(vehicle_id)
        sensor = middle_sensor(site.sensor, vehicle)
        runs = [normalised(run, sensor) for run in read_folder(folder, channels=vehicle.channels)]
    return run_to_messages(runs, site, _REALM, vehicle_id)


def _recorded(
    source: str, vehicle: str, accel: dict[int, AccelBatch], gnss: dict[int, GnssFix]
) -> Recorded:
    batches = [accel[sequence] for sequence in sorted(accel)]
    fixes = [gnss[sequence] for sequence in sorted(gnss)]
    first_s = batches[0].device_time_ns / NS_PER_S if batches else 0.0
    boot = boot_of(gnss)
    looked_at = [b for b in batches if b.device_time_ns / NS_PER_S < first_s + _LONGEST_S]
    for batch in looked_at:
        boot.add_accel(batch)
    zero_ns = _offset_ns(batches[0]) if batches else (_offset_ns(fixes[0]) if fixes else 0)
    accuracy = [f.horizontal_accuracy_m for f in fixes]
    return Recorded(
        source,
        vehicle,
        boot.fixes(),
        np.array([np.nan if value is None else value for value in accuracy]),
        _samples(boot, looked_at),
        _rates(looked_at),
        {name: c.rate_hz for batch in looked_at[:1] for name, c in batch.channels.items()},
        sum(after - before - 1 for before, after in pairwise(sorted(accel))),
        {
            "accel": _clock(batches, zero_ns),
            "gnss": _clock(fixes, zero_ns),
        },
        len(looked_at) < len(batches),
    )


def _samples(boot: Boot, batches: list[AccelBatch]) -> Samples | None:
    if not batches:
        return None
    begin_s = batches[0].device_time_ns / NS_PER_S
    samples = boot.samples(begin_s - 1.0, boot.latest_accel_s() + 1.0)
    return None if samples is None else _without_ends(samples)


def _without_ends(samples: Samples) -> Samples:
    """Less the ends of what is interpolated of a slow channel, which is no gap."""
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
    """Samples of each channel over the time that they took, gaps left out."""
    found: dict[str, float] = {}
    names = dict.fromkeys(name for batch in batches for name in batch.channels)
    for name in names:
        counts, seconds = 0, 0.0
        for before, after in pairwise(batches):
            took_s = (after.device_time_ns - before.device_time_ns) / NS_PER_S
            channel = before.channels.get(name)
            if channel is None or after.sequence != before.sequence + 1:
                continue
            # Twice as long as the samples take by the declared rate: there is a gap between.
            if 0.0 < took_s < 2.0 * channel.samples.size / channel.rate_hz:
                counts, seconds = counts + channel.samples.size, seconds + took_s
        if seconds > 0.0:
            found[name] = counts / seconds
    return found


def _clock(stamped: Iterable[AccelBatch | GnssFix], zero_ns: int) -> Clock:
    rows = [(m.device_time_ns / NS_PER_S, (_offset_ns(m) - zero_ns) / NS_PER_S) for m in stamped]
    table = np.array(rows, dtype=np.float64).reshape(-1, 2).T
    return Clock(*table)


def _offset_ns(message: AccelBatch | GnssFix) -> int:
    return message.wall_time_ns - message.device_time_ns
