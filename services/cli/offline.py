"""Commands on files: import, identify, fuse, recover."""

import argparse
from pathlib import Path
from typing import Any

from services.cli.cluster import add_scheduler, check_scheduler, execution_of
from services.cli.parsing import (
    CERTIFICATES,
    OutputFile,
    a_console,
    add_certificates,
    add_file,
    add_force,
    add_method,
    add_output,
    add_output_file,
    add_output_folder,
    add_seed,
    add_site,
    command,
    folder_here,
    source,
)
from services.common.kinds import ARRAYS, IMPORT_MAP, MCAP, NETCDF, PNG, RERUN, RESULTS


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


def add_identify(commands: Any) -> None:
    """Add `driveby identify`: estimate the rigidity of each element from recordings."""
    p = command(
        commands,
        "identify",
        _identify,
        "estimate the flexural rigidity of each element from recordings",
        "driveby identify run.mcap --json result.json --rrd result.rrd",
    )
    p.add_argument(
        "recordings",
        type=source,
        nargs="+",
        metavar="REC.mcap",
        help="recordings, also as s3://…; with --into also folders of them",
    )
    add_site(p, "site file (default: the site stored in the recording)")
    add_method(p)
    add_output_file(p, "--json", "OUT.json", "JSON file of the results", RESULTS)
    add_output_file(p, "--rrd", "OUT.rrd", "Rerun file of the results", RERUN)
    text = "file of the posterior draws of method pre, for ArviZ"
    add_output_file(p, "--draws", "OUT.npz|OUT.nc", text, ARRAYS, NETCDF)
    add_output_folder(
        p, "--figures", "folder for figures of every crossing and bridge, as PNG and SVG"
    )
    _add_fusing(p)
    add_certificates(
        p, f"folder of the certificates that results refer to (default: {CERTIFICATES})"
    )
    add_seed(p)
    group = p.add_argument_group("many crossings")
    group.add_argument(
        "--into",
        type=folder_here,
        metavar="DIR",
        help="store each result here as it is computed; run again to resume. Unreadable input is "
        "listed and skipped (exit code 3)",
    )
    add_scheduler(group)


def _add_fusing(p: argparse.ArgumentParser) -> None:
    add_file(
        p,
        "--baseline",
        "OLD.json",
        "results that the bridge is compared with (default: those that the site file names)",
    )
    p.add_argument(
        "--fuse-suspect",
        action="store_true",
        help="fuse suspect crossings too; the bridge's estimate is suspect then",
    )


def add_fuse(commands: Any) -> None:
    """Add `driveby fuse`: one estimate of each bridge from stored results."""
    p = command(
        commands,
        "fuse",
        _fuse,
        "fuse the results of many crossings into one estimate of each bridge",
        "driveby fuse monday.json tuesday.json --json week.json",
    )
    p.add_argument("results", type=Path, nargs="+", metavar="RESULTS.json", help="results")
    text = "JSON file of all crossings and the fused estimates"
    add_output_file(p, "--json", "OUT.json", text, RESULTS)
    _add_fusing(p)


def _fuse(options: argparse.Namespace) -> int:
    from services.cli.fuse import fuse_command

    return fuse_command(
        paths=options.results,
        json_path=options.json,
        baseline=options.baseline,
        fuse_suspect=options.fuse_suspect,
        console=a_console(),
    )


def _identify(options: argparse.Namespace) -> int:
    from services.cli.identify import identify_command
    from services.cli.identify_archive import archive_command

    check_scheduler(options)
    if options.into is not None:
        return archive_command(
            sources=options.recordings,
            into=options.into,
            site=options.site,
            method=options.method.replace("-", "_"),
            json_path=options.json,
            certificates=options.validations,
            seed=options.seed,
            baseline=options.baseline,
            fuse_suspect=options.fuse_suspect,
            of_single={name: getattr(options, name) for name in ("rrd", "draws", "figures")},
            executing=execution_of(options),
            console=a_console(),
        )
    return identify_command(
        recordings=options.recordings,
        site=options.site,
        method=options.method.replace("-", "_"),
        json_path=options.json,
        rrd_path=options.rrd,
        draws_path=options.draws,
        figures=options.figures,
        certificates=options.validations,
        seed=options.seed,
        baseline=options.baseline,
        fuse_suspect=options.fuse_suspect,
        executing=None if options.scheduler is None else execution_of(options),
        console=a_console(),
    )


def add_recover(commands: Any) -> None:
    """Add `driveby recover`: rewrite a damaged or truncated recording."""
    p = command(
        commands,
        "recover",
        _recover,
        "rewrite a damaged or truncated recording",
        "driveby recover run.mcap -o whole.mcap",
    )
    p.add_argument(
        "recording", type=Path, metavar="REC.mcap", help="recording to rewrite; left as it is"
    )
    p.add_argument(
        "-o",
        "--output",
        type=OutputFile((MCAP,)),
        metavar="OUT.mcap",
        help="recording to write (default: REC.recovered.mcap beside it)",
    )
    p.add_argument(
        "--set-aside",
        action="store_true",
        help="rename the damaged recording to REC.mcap.crashed afterwards",
    )
    add_force(p)
    p.add_argument("--json", action="store_true", help="print the counts as JSON")


def _recover(options: argparse.Namespace) -> int:
    from services.cli.recover import recover_command

    code, line = recover_command(
        source=options.recording,
        output=options.output,
        set_aside=options.set_aside,
        force=options.force,
        as_json=options.json,
    )
    print(line)
    return code
