"""Measurements of trucks as arrays, from recordings and folders of CSV files."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import AccelBatch, AccelChannel, GnssFix, in_order
from schemas.site import Site
from services.common.arrays import Floats
from services.common.extras import check_installed
from services.common.field_docs import with_field_docs
from services.common.progress import Offset, no_progress
from services.drives.importing import normalised_runs
from services.drives.runs import Run
from services.finding.drive import drives_of
from services.recordings.recording import read_messages

if TYPE_CHECKING:
    import pandas as pd

Nanoseconds = NDArray[np.int64]


class ChannelSeries(NamedTuple):
    """Samples of one accelerometer, both arrays (n,); a jump in the time is a gap."""

    time_ns: Nanoseconds  # since 1970 UTC
    acceleration_m_per_s2: Floats  # up positive, gravity removed


class FixSeries(NamedTuple):
    """Fixes of a receiver in order of time, all arrays (m,)."""

    time_ns: Nanoseconds  # since 1970 UTC
    latitude_deg: Floats
    longitude_deg: Floats
    altitude_m: Floats
    speed_m_per_s: Floats
    heading_deg: Floats  # clockwise from north, NaN where it is not known


@with_field_docs
class Signals(NamedTuple):
    """Measurements of one truck during one boot of its computer, or in one CSV run."""

    source: str
    """Path of the source."""
    vehicle: str
    """Identifier of the truck; empty for CSV files without a site file."""
    run: int
    """Number of the run in its file, from 0, by time."""
    channels: dict[str, ChannelSeries]
    """Series by name, `driveby.CHANNELS` first; a channel that the truck lacks is absent."""
    fixes: FixSeries
    """Fixes of the GNSS receiver."""

    def __repr__(self) -> str:
        """Return one line: the arrays have 100,000 values."""
        channels = ", ".join(self.channels) or "no channels"
        return (
            f"<Signals {self.source}, run {self.run} of {self.vehicle or 'an unnamed truck'}: "
            f"{channels}; {self.fixes.time_ns.size} fixes>"
        )

    def accelerations(self) -> "pd.DataFrame":
        """Return one column for each channel in m/s², over the UTC time; needs pandas.

        NaN marks a time at which only another channel has a sample.
        """
        check_installed("a table of accelerations", "pandas")
        import pandas as pd

        columns = {
            name: pd.Series(series.acceleration_m_per_s2, index=_utc(series.time_ns))
            for name, series in self.channels.items()
        }
        return pd.DataFrame(columns).rename_axis(index="time")

    def positions(self) -> "pd.DataFrame":
        """Return one row for each fix, over the UTC time: degrees, m and m/s; needs pandas."""
        check_installed("a table of positions", "pandas")
        import pandas as pd

        time_ns, *values = self.fixes
        columns = dict(zip(FixSeries._fields[1:], values, strict=True))
        return pd.DataFrame(columns, index=_utc(time_ns)).rename_axis(index="time")


def signals_of_recording(path: Path, progress: Offset = no_progress) -> list[Signals]:
    """Return all runs of all trucks in a recording; InputError if it is none.

    Duplicate messages count once, undecodable ones are skipped.
    """
    found = [
        Signals(
            str(path),
            drive.vehicle,
            0,
            series_of_batches(drive.batches()),
            _track_of_fixes(drive.fixes_in_order()),
        )
        for drive in drives_of(read_messages(path, progress))
        if drive.accelerations or drive.fixes
    ]
    return _numbered(found)


def signals_of_folder(
    folder: Path, site: Site | None, site_name: str, vehicle: str
) -> list[Signals]:
    """Return all runs in a folder of CSV files, upward and without gravity.

    comma2k19 counts as CSV. Without a site file the form of the measurements is unknown, and they
    stay as in the files.
    """
    runs = normalised_runs([folder], site, site_name, vehicle)
    return _numbered([signals_of_run(run, vehicle) for run in runs])


def signals_of_run(run: Run, vehicle: str) -> Signals:
    """Return one run as signals."""
    time_ns = _nanoseconds(run.accel_time_s)
    channels = {name: ChannelSeries(time_ns, values) for name, values in run.channels.items()}
    gnss = run.gnss
    heading = np.full(gnss.time_s.size, np.nan) if gnss.heading_deg is None else gnss.heading_deg
    track = FixSeries(
        _nanoseconds(gnss.time_s),
        gnss.latitude_deg,
        gnss.longitude_deg,
        gnss.altitude_m,
        gnss.speed_m_per_s,
        heading,
    )
    return Signals(run.source, vehicle, 0, channels, track)


def series_of_batches(batches: Sequence[AccelBatch]) -> dict[str, ChannelSeries]:
    """Join batches, in their order, into one series (n,) for each channel."""
    series = {}
    for name in in_order(name for batch in batches for name in batch.channels):
        parts = [(b.wall_time_ns, b.channels[name]) for b in batches if name in b.channels]
        series[name] = ChannelSeries(
            np.concatenate(list(_times_ns(parts))),
            np.concatenate([c.samples for _, c in parts]),
        )
    return series


def _times_ns(parts: Iterable[tuple[int, AccelChannel]]) -> Iterator[Nanoseconds]:
    """Yield the times of all samples, for batches of one size at a time: an hour has 72,000."""
    for (size, rate_hz), alike in groupby(parts, lambda p: (p[1].samples.size, p[1].rate_hz)):
        offsets = np.rint(np.arange(size) * (1e9 / rate_hz)).astype(np.int64)
        starts = np.array([start_ns for start_ns, _ in alike], dtype=np.int64)
        yield np.add.outer(starts, offsets).reshape(-1)


def _track_of_fixes(fixes: Sequence[GnssFix]) -> FixSeries:
    rows = [
        (f.latitude_deg, f.longitude_deg, f.altitude_m, f.speed_m_per_s, f.heading_deg)
        for f in fixes
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    return FixSeries(np.array([f.wall_time_ns for f in fixes], dtype=np.int64), *table)


def _numbered(found: Iterable[Signals]) -> list[Signals]:
    """Return the signals by time, numbered."""
    in_order = sorted(found, key=lambda signals: (min(_starts(signals)), signals.vehicle))
    return [signals._replace(run=number) for number, signals in enumerate(in_order)]


def _starts(signals: Signals) -> Iterator[int]:
    for time_ns in (*(s.time_ns for s in signals.channels.values()), signals.fixes.time_ns):
        if time_ns.size:
            yield int(time_ns[0])


def _nanoseconds(time_s: Floats) -> Nanoseconds:
    # Seconds since 1970 resolve a quarter of a microsecond: whole microseconds are certain.
    return np.rint(time_s * 1e6).astype(np.int64) * 1000


def _utc(time_ns: Nanoseconds) -> "pd.DatetimeIndex":
    import pandas as pd

    return pd.DatetimeIndex(pd.to_datetime(time_ns, unit="ns", utc=True))
