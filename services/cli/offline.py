"""The command `driveby import`."""

import argparse
from pathlib import Path
from typing import Any

from services.cli.parsing import (
    a_console,
    add_file,
    add_output,
    add_output_file,
    add_site,
    command,
)
from services.common.kinds import IMPORT_MAP, PNG


def add_import(commands: Any) -> None:
    """Add `driveby import`: convert CSV files or ROS 2 recordings of a drive to a recording."""
    p = command(
        commands,
        "import",
        _import,
        "convert CSV files or ROS 2 recordings of a drive to a recording",
        "driveby import crossings/d1 --site crossings/d1/site.toml -o d1.mcap",
    )
    p.add_argument(
        "sources",
        type=Path,
        nargs="+",
        metavar="DIR | ACCEL.csv GPS.csv | ROS",
        help="a folder with accel_NN.csv and gps_NN.csv, one such pair, a comma2k19 segment, "
        "or a recording of ROS 2 (a rosbag2 folder, .mcap, .db3)",
    )
    add_site(p, "site file of truck and bridges; stored in the recording", required=True)
    p.add_argument("--vehicle", metavar="ID", help="identifier of the site's vehicle that drove")
    p.add_argument(
        "--realm",
        metavar="NAME",
        help="name of the realm, import-NAME, which the drives of one campaign share (default: "
        "[import] name of the site file, else the name of the folder)",
    )
    _add_tables(p)
    add_output(p, required=False)


def _add_tables(p: argparse.ArgumentParser) -> None:
    """Add options for tables that are not in the form of the contract."""
    group = p.add_argument_group("tables of other loggers")
    group.add_argument(
        "--preview",
        action="store_true",
        help="print the guesses, the first rows and the curves as understood, and write nothing",
    )
    add_output_file(
        group,
        "--picture",
        "OUT.png",
        "picture of the first run as understood; writes no recording",
        PNG,
    )
    add_output_file(
        group, "--write-map", "MAP.toml", "file of all that was found, for --map", IMPORT_MAP
    )
    add_file(group, "--map", "MAP.toml", "map of files, columns, units and times to read by")
    group.add_argument("--yes", action="store_true", help="accept guesses that change numbers")
    group.add_argument("--zone", help="time zone of times without one: UTC, +01:00, Europe/Berlin")
    group.add_argument(
        "--start", metavar="TIME", help="start of times that count from 0, as ISO 8601 with a zone"
    )


def _preview(options: argparse.Namespace) -> int:
    """Print a drive as it is read; write its map if requested."""
    from services.common.files import write_atomically
    from services.common.progress import no_step_progress
    from services.drives.importing import understood_drive
    from services.drives.tables.mapping import map_text
    from services.drives.tables.preview import preview_lines

    how = _how(options, no_step_progress)
    found = understood_drive(options.sources, options.site, options.vehicle, how)
    if options.preview:
        print("\n".join(preview_lines(found, a_console().width)))
    if options.picture is not None:
        from services.viewer.drive_figure import run_picture

        write_atomically(options.picture, run_picture(found.runs[0]))
        print(options.picture)
    if options.write_map is not None:
        write_atomically(options.write_map, map_text(found.mapping))
        print(f"{options.write_map}: check it, then driveby import --map {options.write_map}")
    return 0


def _import(options: argparse.Namespace) -> int:
    from services.common.errors import InputError

    if options.preview or options.picture is not None or options.write_map is not None:
        return _preview(options)
    if options.output is None:
        raise InputError("the following arguments are required: -o/--output, or --preview")
    return _write_recording(options)


def _write_recording(options: argparse.Namespace) -> int:
    from rich.console import Console

    from services.catalogue.index import catalog_above, catalog_closed
    from services.common.progress import progress_bar
    from services.drives.importing import import_command

    with progress_bar(Console(stderr=True)) as bar:
        reading = bar.add_task("reading", total=None)
        writing = bar.add_task(f"writing {options.output}", total=None, visible=False)
        said = import_command(
            sources=options.sources,
            site=options.site,
            output=options.output,
            force=options.force,
            vehicle=options.vehicle,
            name=options.realm,
            how=_how(
                options, reading=lambda n, total: bar.update(reading, completed=n, total=total)
            ),
            writing=lambda done, steps: bar.update(
                writing, completed=done, total=steps, visible=True
            ),
        )
    print(said)
    folder = catalog_above(options.output)
    if folder is not None:
        catalog_closed(folder, options.output)
    return 0


def _how(options: argparse.Namespace, reading: Any) -> Any:
    """Return the options for reading the files."""
    from services.drives.csv_runs import HowToRead
    from services.drives.tables.mapping import load_map

    mapping = None if options.map is None else load_map(options.map)
    return HowToRead(mapping, options.zone, options.start, options.yes, reading)
