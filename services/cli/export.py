"""The command `driveby export`: measurements and results for other programs."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.cli.parsing import add_output_folder, add_site, command
from services.common.errors import InputError

if TYPE_CHECKING:
    from schemas.results import Results
    from schemas.site import Site
    from services.export.tables import Format, NamedTable


def add_export(commands: Any) -> None:
    """Add `driveby export`: write recordings and results as tables and maps."""
    p = command(
        commands,
        "export",
        _export,
        "write recordings and results as CSV or Parquet tables and GeoJSON",
        "driveby export drive.mcap drive.json --to tables --format parquet",
    )
    p.add_argument(
        "sources",
        type=Path,
        nargs="+",
        metavar="REC.mcap|RESULTS.json|DIR",
        help="recordings, folders with recordings below, and at most one results file",
    )
    add_output_folder(p, "--to", "folder for the files", required=True)
    p.add_argument(
        "--format",
        choices=("csv", "parquet"),
        default="csv",
        help="format of the tables (default: csv)",
    )
    p.add_argument(
        "--sensorthings",
        action="store_true",
        help="also export results as entities of OGC SensorThings API 1.1",
    )
    add_site(p, "site file of the bridges (default: that of the recordings)")


def _export(options: argparse.Namespace) -> int:
    from services.catalogue.contents import summarise_recording
    from services.common.files import (
        check_folder_writable,
        check_site_kept,
        make_folder,
        write_atomically,
    )
    from services.common.progress import reading_bar, steps_bar
    from services.drives.signals import signals_of_recording
    from services.export.geojson import crossings_geojson, elements_geojson
    from services.export.result_tables import tables_of_results
    from services.export.sensorthings import sensorthings
    from services.export.signal_tables import as_measured, tables_of_run, tables_of_runs
    from services.export.tables import write_table
    from services.recordings.merge import recordings_in

    form: Format = options.format
    folder: Path = options.to
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, give the name of a folder")
    check_folder_writable(folder)
    recordings = recordings_in(path for path in options.sources if path.suffix != ".json")
    results, results_path = _results(options.sources)
    site = _site(options.site, recordings, results, results_path)
    if options.sensorthings and (results is None or site is None):
        raise InputError("--sensorthings: wants a results file, and the site file of its bridges")
    with reading_bar("reading", recordings) as next_file:
        runs = [run for path in recordings for run in signals_of_recording(path, next_file())]
    passings = []
    if results is None and site is not None:
        with reading_bar("looking for crossings", recordings) as next_file:
            every = (summarise_recording(one, site, progress=next_file()) for one in recordings)
            passings = [passing for summary in every for passing in summary.passings]
    if form == "csv" and runs and site is not None:
        check_site_kept(folder / "site.toml", as_measured(site))
    tables: list[NamedTable] = []
    if form == "parquet":
        tables += tables_of_runs(runs) if runs else []
    else:
        tables += [table for n, run in enumerate(runs) for table in tables_of_run(run, n)]
    if results is not None:
        tables += tables_of_results(results, site)
    make_folder(folder)
    _check_no_others(folder, {f"{table.name}.csv" for table in tables if form == "csv" and runs})
    with steps_bar(f"writing into {folder}") as progress:
        for number, table in enumerate(tables):
            progress(number, len(tables))
            path = write_table(folder, table, form)
            print(f"{path}: {len(next(iter(table.columns.values())))} rows")
    if site is None:
        print("no site file: places of bridges are not known, so there is no GeoJSON")
        return 0
    crossings = () if results is None else results.crossings
    texts = {
        "elements.geojson": elements_geojson(site, results),
        "crossings.geojson": crossings_geojson(site, crossings, passings),
    }
    if options.sensorthings and results is not None:
        texts["sensorthings.json"] = sensorthings(site, results)
    if form == "csv" and runs:
        texts["site.toml"] = as_measured(site)
    for name, text in texts.items():
        write_atomically(folder / name, text)
        print(folder / name)
    return 0


def _check_no_others(folder: Path, names: set[str]) -> None:
    """Raise InputError for runs of an earlier export, which would be imported with these."""
    others = {path.name for kind in ("accel_", "gps_") for path in folder.glob(f"{kind}*.csv")}
    if names and others - names:
        raise InputError(
            f"{folder}: holds {min(others - names)} of another drive; give another folder"
        )


def _results(sources: list[Path]) -> "tuple[Results | None, Path]":
    from schemas.results import load_results

    paths = [path for path in sources if path.suffix == ".json"]
    if len(paths) > 1:
        raise InputError(f"{paths[1]}: is a second results file, export one at a time")
    return (load_results(paths[0]), paths[0]) if paths else (None, Path())


def _site(
    given: Path | None, recordings: list[Path], results: "Results | None", results_path: Path
) -> "Site | None":
    """Return the site file given, of the recordings, or beside the results; None without any."""
    from schemas.site_file import load_site
    from services.ledger.site_of_results import site_of_results, site_within, wanted_bridges

    if results is not None and (given is not None or not recordings):
        try:
            return site_of_results(results_path, results, given)
        except InputError:
            if given is not None:
                raise
            return None
    if given is not None:
        return load_site(given)
    found = (site_within(path) for path in recordings)
    site = next((site for site in found if site is not None), None)
    if site is not None and results is not None:
        unknown = wanted_bridges(results) - {bridge.id for bridge in site.bridges}
        if unknown:
            raise InputError(
                f"{results_path}: has results of {min(unknown)}, which the site file of "
                f"{recordings[0]} does not know"
            )
    return site
