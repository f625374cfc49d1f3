"""The command `driveby fuse`: one estimate of each bridge from stored results."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from schemas.results import Results, load_results, results_json
from schemas.site_file import load_site
from services.cli.bridge_table import print_bridge
from services.cli.identify import print_validation, warn_of_baselines
from services.cli.settings import FuseOptions
from services.common.errors import InputError
from services.common.files import check_writable, write_atomically
from services.common.naming import count_of
from services.common.options import validations_folder
from services.common.progress import Steps, parts_bar, steps_bar
from services.execution.fuse_results import crossings_to_fuse, fuse_crossings
from services.history.validation_files import (
    check_validations,
    pairs_with_intervals,
    pairs_without_validation,
)
from services.ledger.baselines import Baselines, baselines_of, realms_of_bridges
from services.ledger.site_of_results import site_of_results

if TYPE_CHECKING:
    from rich.console import Console


def fuse_command(asked: FuseOptions, console: "Console") -> int:
    """Fuse all crossings of the results, each once; print every bridge and write it if asked.

    Of a crossing in several files the newest result counts. InputError: a file that is no results
    file, results without a crossing that can be fused, or of several realms.
    """
    paths, json_path, baseline = asked.results, asked.json, asked.baseline
    check_validations(asked.validations)
    if json_path is not None:
        check_writable(json_path)
    with steps_bar("reading", console) as progress:
        files = list(_loaded(paths, progress))
    found = crossings_to_fuse(str(paths[0]), files)
    again = found.repeated
    if again:
        console.print(
            f"{count_of(again, 'result')} of crossings that are also in another file; the newest "
            "result of a crossing counts"
        )
    stored = _baselines(baseline, asked.site)
    with parts_bar("fusing bridge", len(found.by_bridge), console) as report:
        fused = fuse_crossings(
            str(paths[0]),
            found,
            None if stored is None else (stored.name, stored.baselines.states),
            report,
            fuse_suspect=asked.fuse_suspect,
        )
    for name, number in fused.unfused.items():
        console.print(f"{name}: none of its {count_of(number, 'crossing')} can be fused")
    for number, (name, elements) in enumerate(fused.bridges.items()):
        if number > 0:
            console.print()
        print_bridge(console, elements, fused.results.bridges[name], fused.results.crossings)
    newest, _ = max(zip(paths, files, strict=True), key=lambda one: one[1].created)
    _print_validations(console, newest, fused.results, asked)
    if stored is not None:
        now = realms_of_bridges(found.crossings)
        warn_of_baselines(fused.results.bridges, now, stored.baselines)
    if json_path is not None:
        write_atomically(json_path, results_json(fused.results))
    return 0


class _NamedBaselines(NamedTuple):
    """Baselines and the name of their file."""

    name: str
    baselines: Baselines


def _baselines(given: Path | None, site: Path | None) -> _NamedBaselines | None:
    """Return the states to compare with: as given, else as the site file names."""
    if given is not None:
        before = load_results(given)
        realms = realms_of_bridges(before.crossings)
        return _NamedBaselines(str(given), Baselines(before.bridges, realms))
    if site is None:
        return None
    known = load_site(site)
    named = baselines_of(known, site.parent)
    return _NamedBaselines(str(site), named) if named.states else None


def _print_validations(
    console: "Console", newest: Path, fused: Results, asked: FuseOptions
) -> None:
    """Print which site validations cover the intervals, as far as a site file is known."""
    if not pairs_with_intervals(fused.crossings):
        return
    try:
        site = site_of_results(newest, fused, asked.site)
    except InputError:
        if asked.site is not None:
            raise
        for pair in pairs_without_validation(fused.crossings):
            console.print(
                f"{pair}: the results name no passed site validation; "
                "give --site SITE.toml to search for its record",
                soft_wrap=True,
            )
    else:
        print_validation(console, fused, site, validations_folder(asked.validations))


def _loaded(paths: Sequence[Path], progress: Steps) -> Iterator[Results]:
    """Yield the files, with progress by their sizes."""
    sizes = [path.stat().st_size if path.is_file() else 0 for path in paths]
    for number, path in enumerate(paths):
        progress(sum(sizes[:number]), sum(sizes))
        yield load_results(path)
