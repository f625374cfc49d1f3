"""The command `driveby export`: measurements and results for other programs."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from services.cli.parser import Subcommand
from services.common.errors import InputError
from services.common.naming import count_of
from services.common.options import flag, opt, output_folder_option, positional, site_option

if TYPE_CHECKING:
    from schemas.results import Results
    from schemas.site import Site
    from services.drives.signals import Signals
    from services.export.tables import Format, NamedTable
    from services.finding.bridges import DetectedCrossing


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of `driveby export`: recordings and results, and the folder for the files."""

    sources: tuple[Path, ...] = positional(
        "recordings, folders searched recursively for them, and at most one results file",
        Path,
        nargs="+",
        metavar="REC.mcap|RESULTS.json|DIR",
    )
    to: Path = output_folder_option("folder for the files", required=True)
    format: "Format" = opt(
        "format of the tables (default: csv)", default="csv", choices=("csv", "parquet")
    )
    sensorthings: bool = flag("also export results as entities of OGC SensorThings API 1.1")
    site: Path | None = site_option("site file of the bridges (default: that of the recordings)")


class _Found(NamedTuple):
    """Contents of the sources to export."""

    site: "Site | None"
    results: "Results | None"
    runs: "list[Signals]"
    passings: "list[DetectedCrossing]"


def _export(options: ExportOptions) -> int:
    from services.common.files import (
        check_folder_writable,
        check_site_kept,
        make_folder,
        write_atomically,
    )
    from services.common.progress import steps_bar
    from services.export.signal_tables import as_measured
    from services.export.tables import write_table

    form, folder = options.format, options.to
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, give the name of a folder")
    check_folder_writable(folder)
    found = _read(options)
    has_runs_as_csv = form == "csv" and bool(found.runs)
    if has_runs_as_csv and found.site is not None:
        check_site_kept(folder / "site.toml", as_measured(found.site))
    tables = _tables(found, form)
    make_folder(folder)
    _check_no_others(folder, {f"{table.name}.csv" for table in tables if has_runs_as_csv})
    with steps_bar(f"writing into {folder}") as progress:
        for number, table in enumerate(tables):
            progress(number, len(tables))
            path = write_table(folder, table, form)
            print(f"{path}: {count_of(len(next(iter(table.columns.values()))), 'row')}")
    if found.site is None:
        print("no site file: positions of bridges are unknown, so no GeoJSON is written")
        return 0
    texts = _maps(found, found.site, with_sensorthings=options.sensorthings)
    if has_runs_as_csv:
        texts["site.toml"] = as_measured(found.site)
    for name, text in texts.items():
        write_atomically(folder / name, text)
        print(folder / name)
    return 0


def _read(options: ExportOptions) -> _Found:
    from services.catalogue.contents import summarise_recording
    from services.common.progress import reading_bar
    from services.drives.signals import signals_of_recording
    from services.recordings.merge import recordings_in

    recordings = recordings_in(path for path in options.sources if path.suffix != ".json")
    results, results_path = _results(options.sources)
    site = _site(options.site, recordings, results, results_path)
    if options.sensorthings and (results is None or site is None):
        raise InputError("--sensorthings: needs a results file, and the site file of its bridges")
    with reading_bar("reading", recordings) as next_file:
        runs = [run for path in recordings for run in signals_of_recording(path, next_file())]
    passings = []
    if results is None and site is not None:
        with reading_bar("searching for crossings", recordings) as next_file:
            every = (summarise_recording(one, site, progress=next_file()) for one in recordings)
            passings = [passing for summary in every for passing in summary.passings]
    return _Found(site, results, runs, passings)


def _tables(found: _Found, form: "Format") -> "list[NamedTable]":
    from services.export.result_tables import tables_of_results
    from services.export.signal_tables import tables_of_run, tables_of_runs

    tables: list[NamedTable] = []
    if form == "parquet":
        tables += tables_of_runs(found.runs) if found.runs else []
    else:
        tables += [table for n, run in enumerate(found.runs) for table in tables_of_run(run, n)]
    if found.results is not None:
        tables += tables_of_results(found.results, found.site)
    return tables


def _maps(found: _Found, site: "Site", *, with_sensorthings: bool) -> dict[str, str]:
    """Return the texts of the maps by file."""
    from services.export.geojson import crossings_geojson, elements_geojson
    from services.export.sensorthings import sensorthings

    crossings = () if found.results is None else found.results.crossings
    texts = {
        "elements.geojson": elements_geojson(site, found.results),
        "crossings.geojson": crossings_geojson(site, crossings, found.passings),
    }
    if with_sensorthings and found.results is not None:
        texts["sensorthings.json"] = sensorthings(site, found.results)
    return texts


def _check_no_others(folder: Path, names: set[str]) -> None:
    """Raise InputError for runs of an earlier export, which would be imported with these."""
    others = {path.name for kind in ("accel_", "gps_") for path in folder.glob(f"{kind}*.csv")}
    if names and others - names:
        raise InputError(
            f"{folder}: holds {min(others - names)} of another drive; give another folder"
        )


def _results(sources: Sequence[Path]) -> "tuple[Results | None, Path]":
    from schemas.results import load_results

    paths = [path for path in sources if path.suffix == ".json"]
    if len(paths) > 1:
        both = shlex.join(map(str, paths[:2])) + (" …" if len(paths) > 2 else "")
        raise InputError(
            f"{paths[1]}: is a second results file; fuse them first (driveby fuse {both} --json "
            "all.json) and export that, or export each into a folder of its own"
        )
    return (load_results(paths[0]), paths[0]) if paths else (None, Path())


def _site(
    given: Path | None, recordings: list[Path], results: "Results | None", results_path: Path
) -> "Site | None":
    """Return the site file given, of the recordings, or next to the results; None without any."""
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


COMMAND: Final = Subcommand(
    ExportOptions,
    "driveby export drive.mcap drive.json --to tables --format parquet",
    _export,
)
