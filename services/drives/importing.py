"""Conversion of a drive's files to a recording: `driveby import`."""

import logging
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from schemas.site import Site
from schemas.site_file import load_site, parse_site, read_site_text
from schemas.topics import Message
from services.common.errors import InputError
from services.common.files import check_writable
from services.common.naming import checked_identifier, count_of
from services.common.progress import Steps, no_step_progress
from services.drives.comma2k19 import is_comma2k19, read_comma2k19
from services.drives.csv_runs import (
    AS_WRITTEN,
    ReadOptions,
    csv_runs,
    exact_runs,
    interpreted_runs,
)
from services.drives.ros2_recording import is_ros2, messages_of_ros2
from services.drives.runs import Run, normalised, run_to_messages
from services.drives.settings import ImportOptions
from services.drives.tables.mapping import load_map
from services.drives.tables.reading import InterpretedRuns
from services.finding.placed import middle_sensor, rates_hz
from services.recordings.writer import write_recording

_log = logging.getLogger(__name__)
_REALM = "import-"
_SHARED = "drives"
"""Name of the realm of drives for which neither command nor site file names one."""
_LARGEST_RATE_ERROR = 0.05
"""Largest relative error of a rate; wrong units and wrong site files exceed it by far."""


class _Drive(NamedTuple):
    """The drive to import: its site file, truck and realm."""

    site_text: str
    site: Site
    site_name: str
    vehicle_id: str
    realm: str


def import_command(
    asked: ImportOptions,
    output: Path,
    *,
    reading: Steps = no_step_progress,
    writing: Steps = no_step_progress,
) -> str:
    """Write the recording of a folder, a pair of CSV files, or of ROS 2; return a summary.

    Nothing is written if anything is wrong (InputError). `reading` is called with the number of
    files read, `writing` with the seconds of the drive that have been written.
    """
    how = _how_to_read(asked, reading)
    check_writable(output, force=asked.force)
    text, name = read_site_text(asked.site), str(asked.site)
    site = parse_site(text, name)
    vehicle_id = vehicle_of(site, name, asked.vehicle)
    drive = _Drive(text, site, name, vehicle_id, _realm(site, asked.realm))
    if len(asked.sources) == 1 and is_ros2(asked.sources[0]):
        return _import_ros2(asked.sources[0], drive, output, force=asked.force)
    runs = normalised_runs(asked.sources, site, name, vehicle_id, how)
    messages = _write(
        output,
        _with_progress(run_to_messages(runs, site, drive.realm, vehicle_id), runs, writing),
        drive,
        force=asked.force,
    )
    seconds = sum(float(run.accel_time_s[-1] - run.accel_time_s[0]) for run in runs)
    return (
        f"{output}: {count_of(len(runs), 'run')} of {vehicle_id}, {seconds:.1f} s, "
        f"{messages} messages, realm {drive.realm}"
    )


def interpreted_drive(asked: ImportOptions) -> InterpretedRuns:
    """Return a drive of CSV files as it is read, with all guesses; nothing is written."""
    how = _how_to_read(asked, no_step_progress)._replace(is_draft=True)
    site = load_site(asked.site)
    vehicle_id = vehicle_of(site, str(asked.site), asked.vehicle)
    return interpreted_runs(asked.sources, site, vehicle_id, how)


def _how_to_read(asked: ImportOptions, reading: Steps) -> ReadOptions:
    mapping = None if asked.map is None else load_map(asked.map)
    return ReadOptions(mapping, asked.zone, asked.start, asked.yes, reading=reading)


def _import_ros2(source: Path, drive: _Drive, output: Path, *, force: bool) -> str:
    if output.resolve() in (source.resolve(), *(path.resolve() for path in source.glob("*"))):
        raise InputError(f"{output}: is the file to import; give another file to write")
    truck, messages = messages_of_ros2(
        source, drive.site, drive.site_name, drive.realm, drive.vehicle_id
    )
    written = _write(output, messages, drive, force=force)
    for line in truck.anomalies.news():
        _log.warning("%s: %s", source, line)
    return (
        f"{output}: a drive of {drive.vehicle_id} with ROS 2, {written} messages, "
        f"realm {drive.realm}"
    )


def _write(output: Path, messages: Iterable[Message], drive: _Drive, *, force: bool) -> int:
    """Write the recording; return the number of messages."""
    return write_recording(
        output, messages, site_toml=drive.site_text, reason="import complete", force=force
    )


def messages_of(folder: Path, site: Path, vehicle: str | None) -> Iterator[Message]:
    """Return the messages that `import_command` would write for a folder of CSV or comma2k19."""
    return messages_of_folder(
        folder, parse_site(read_site_text(site), str(site)), str(site), vehicle
    )


def messages_of_folder(
    folder: Path, site: Site, site_name: str, vehicle: str | None
) -> Iterator[Message]:
    """Return the same for a site that was read already; errors name it `site_name`."""
    vehicle_id = vehicle_of(site, site_name, vehicle)
    runs = normalised_runs([folder], site, site_name, vehicle_id)
    return run_to_messages(runs, site, _realm(site, None), vehicle_id)


def _with_progress(
    messages: Iterable[Message], runs: list[Run], writing: Steps
) -> Iterator[Message]:
    """Yield the messages; report each whole second of the drive."""
    lengths = [float(run.accel_time_s[-1] - run.accel_time_s[0]) for run in runs]
    begins = [float(run.accel_time_s[0]) for run in runs]
    total, last = int(sum(lengths)), -1
    for message in messages:
        number = max(0, bisect_right(begins, message.log_time_ns / 1e9) - 1)
        into = min(message.log_time_ns / 1e9 - begins[number], lengths[number])
        done = int(sum(lengths[:number]) + into)
        if done > last:
            writing(done, total)
            last = done
        yield message


def normalised_runs(
    sources: Sequence[Path],
    site: Site | None,
    site_name: str,
    vehicle_id: str,
    how: ReadOptions = AS_WRITTEN,
    *,
    checks_rate: bool = True,
) -> list[Run]:
    """Return the runs of a folder or of a pair of CSV files, upward and without gravity.

    Without a site the form of the measurements is unknown, and they stay as in the file. A rate
    other than the declared one raises InputError if `checks_rate`.
    """
    if len(sources) == 1 and is_comma2k19(sources[0]):
        return [read_comma2k19(sources[0])]  # its axes and its rate are known
    if site is None:
        return exact_runs(sources, None)
    vehicle = site.vehicle(vehicle_id)
    runs = csv_runs(sources, site, vehicle_id, how)
    declared = tuple(rates_hz(site.sensor, vehicle).values())
    for run in runs if checks_rate else ():
        _check_rate(run, declared, site_name)
    return [normalised(run, middle_sensor(site.sensor, vehicle)) for run in runs]


def _check_rate(run: Run, declared: tuple[float, ...], site_name: str) -> None:
    """Check the rate, which shows times in the wrong unit and the wrong site file."""
    if not any(abs(run.rate_hz / rate - 1) <= _LARGEST_RATE_ERROR for rate in declared):
        raise InputError(
            f"{run.source}: time_s gives a rate of {run.rate_hz:g} Hz, but sensor.rate_hz of "
            f"{site_name} is {declared[0]:g} Hz, correct one of them"
        )


def vehicle_of(site: Site, site_name: str, wanted: str | None) -> str:
    """Return the truck's identifier; InputError if the site has several or lacks it."""
    known = [vehicle.id for vehicle in site.vehicles]
    if wanted is None and len(known) == 1:
        return known[0]
    if wanted in known:
        return wanted
    problem = "holds several vehicles" if wanted is None else f"holds no vehicle {wanted}"
    raise InputError(f"{site_name}: {problem}, choose with --vehicle one of {', '.join(known)}")


def _realm(site: Site, name: str | None) -> str:
    """Return the realm of a drive: as named, else that of the site file, else one for all drives.

    Folders are those of one campaign more often than not, and only drives of one realm are fused.
    """
    if name is not None:
        return f"{_REALM}{checked_identifier(name.removeprefix(_REALM), '--realm')}"
    return f"{_REALM}{_SHARED if site.imports is None else site.imports.name}"
