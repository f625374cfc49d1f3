"""`driveby import`: files of a drive become a recording."""

import logging
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from pathlib import Path

from schemas.site import Site
from schemas.site_file import parse_site, read_site_text
from services.common.errors import InputError
from services.common.files import check_writable
from services.common.naming import checked_identifier, identifier_from
from services.common.progress import Steps, unwatched_steps
from services.drives.comma2k19 import is_comma2k19, read_comma2k19
from services.drives.csv_import import read_folder, read_pair
from services.drives.plausible import check_plausible
from services.drives.ros2_recording import is_ros2, messages_of_ros2
from services.drives.runs import Run, normalised, run_to_messages
from services.identification.placed import middle_sensor, rates_hz
from services.recordings.recording import Message
from services.recordings.writer import write_recording

_log = logging.getLogger(__name__)
_LARGEST_RATE_ERROR = 0.05
"""Clocks of sensors are right to far less; wrong units and wrong site files are off by far more."""


def import_command(
    *,
    sources: list[Path],
    site: Path,
    output: Path,
    vehicle: str | None,
    name: str | None,
    force: bool = False,
    reading: Steps = unwatched_steps,
    writing: Steps = unwatched_steps,
) -> str:
    """Write the recording of a folder, a pair of CSV files, or of ROS 2; return what was written.

    Nothing is written if anything is wrong (InputError). `reading` is told of the files that have
    been read, `writing` of the seconds of the drive that have been written.
    """
    check_writable(output, force=force)
    text = read_site_text(site)
    parsed = parse_site(text, str(site))
    vehicle_id = vehicle_of(parsed, str(site), vehicle)
    realm = _realm(sources, name)
    if len(sources) == 1 and is_ros2(sources[0]):
        return _import_ros2(sources[0], text, parsed, str(site), output, realm, vehicle_id, force)
    runs = normalised_runs(sources, parsed, str(site), vehicle_id, reading)
    messages = write_recording(
        output,
        _watched(run_to_messages(runs, parsed, realm, vehicle_id), runs, writing),
        site_toml=text,
        reason="import complete",
        force=force,
    )
    drives = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
    seconds = sum(float(run.accel_time_s[-1] - run.accel_time_s[0]) for run in runs)
    return (
        f"{output}: {drives} of {vehicle_id}, {seconds:.1f} s, {messages} messages, realm {realm}"
    )


def _import_ros2(
    source: Path,
    site_text: str,
    site: Site,
    site_name: str,
    output: Path,
    realm: str,
    vehicle_id: str,
    force: bool,
) -> str:
    if output.resolve() in (source.resolve(), *(path.resolve() for path in source.glob("*"))):
        raise InputError(f"{output}: is what is to be imported, give another file to write")
    truck, messages = messages_of_ros2(source, site, site_name, realm, vehicle_id)
    written = write_recording(
        output, messages, site_toml=site_text, reason="import complete", force=force
    )
    for line in truck.complaints.news():
        _log.warning("%s: %s", source, line)
    return f"{output}: a drive of {vehicle_id} with ROS 2, {written} messages, realm {realm}"


def messages_of(folder: Path, site: Path, vehicle: str | None) -> Iterator[Message]:
    """Return what `import_command` would write of a folder of CSV files or of comma2k19."""
    return messages_of_folder(
        folder, parse_site(read_site_text(site), str(site)), str(site), vehicle
    )


def messages_of_folder(
    folder: Path, site: Site, site_name: str, vehicle: str | None
) -> Iterator[Message]:
    """The same of a site that was read already; errors call it `site_name`."""
    vehicle_id = vehicle_of(site, site_name, vehicle)
    runs = normalised_runs([folder], site, site_name, vehicle_id)
    return run_to_messages(runs, site, _realm([folder], None), vehicle_id)


def _watched(messages: Iterable[Message], runs: list[Run], writing: Steps) -> Iterator[Message]:
    """The messages; of each whole second of the drive it is told how many there have been."""
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
    sources: list[Path],
    site: Site | None,
    site_name: str,
    vehicle_id: str,
    reading: Steps = unwatched_steps,
) -> list[Run]:
    """The runs of a folder or of a pair of CSV files, upward and without gravity.

    Without a site nobody knows how a CSV file was measured: then it is as in the file.
    """
    vehicle = None if site is None else site.vehicle(vehicle_id)
    channels = None if vehicle is None else vehicle.channels
    if len(sources) == 1 and sources[0].suffix == ".csv":
        raise InputError(f"{sources[0]}: the positions are missing, give accel.csv and gps.csv")
    if len(sources) == 1 and is_comma2k19(sources[0]):
        return [read_comma2k19(sources[0])]  # knows its axes and its rate itself
    if len(sources) == 1:
        runs = read_folder(sources[0], reading, channels)
    elif len(sources) == 2:
        runs = [read_pair(sources[0], sources[1], channels)]
    else:
        raise InputError(f"{len(sources)} files given, a folder or accel.csv gps.csv expected")
    if site is None or vehicle is None:
        return runs
    declared = tuple(rates_hz(site.sensor, vehicle).values())
    for run in runs:
        _check_rate(run, declared, site_name)
        check_plausible(run, site)
    return [normalised(run, middle_sensor(site.sensor, vehicle)) for run in runs]


def _check_rate(run: Run, declared: tuple[float, ...], site_name: str) -> None:
    """Times in the wrong unit and the wrong site file show in the rate."""
    if not any(abs(run.rate_hz / rate - 1) <= _LARGEST_RATE_ERROR for rate in declared):
        raise InputError(
            f"{run.source}: time_s gives a rate of {run.rate_hz:g} Hz, but sensor.rate_hz of "
            f"{site_name} is {declared[0]:g} Hz, one of them must be mended"
        )


def vehicle_of(site: Site, site_name: str, wanted: str | None) -> str:
    """The identifier of the truck meant; InputError if the site leaves it open or lacks it."""
    known = [vehicle.id for vehicle in site.vehicles]
    if wanted is None and len(known) == 1:
        return known[0]
    if wanted in known:
        return wanted
    problem = "holds several vehicles" if wanted is None else f"holds no vehicle {wanted}"
    raise InputError(f"{site_name}: {problem}, choose with --vehicle one of {', '.join(known)}")


def _realm(sources: list[Path], name: str | None) -> str:
    if name is not None:
        return f"import-{checked_identifier(name, '--name')}"
    first = sources[0].resolve()
    if first.suffix in (".mcap", ".db3"):
        return f"import-{identifier_from(first.stem)}"
    return f"import-{identifier_from((first.parent if first.suffix == '.csv' else first).name)}"
