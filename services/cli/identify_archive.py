"""The command `driveby identify --into DIR`: an archive of recordings, stored as computed."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.results import CrossingResult, ResultHeader, results, results_json
from schemas.settings import IdentificationSettings
from schemas.site import Site
from schemas.site_file import load_site, parse_site
from services.catalogue.index import update_catalog
from services.catalogue.positions import crossings_of
from services.cli.bridge_table import print_bridge
from services.cli.identify import (
    check_no_tables,
    warn_of_baselines,
    warn_of_no_noise,
)
from services.cli.parsing import EXIT_SOMETHING_LOST
from services.cli.settings import IdentifyOptions
from services.common.errors import InputError
from services.common.files import check_writable, make_folder, write_atomically
from services.common.naming import count_of
from services.common.options import validations_folder
from services.common.progress import progress_bar
from services.common.stores import Folder, files_below, folder_at
from services.execution.archive import ArchiveJob, ArchiveResult, identify_archive
from services.execution.dispatch import CrossingExecutor
from services.execution.inline import InlineExecutor
from services.execution.result_store import BRIDGES, ResultStore
from services.history.validation_files import (
    ValidatedPairs,
    check_validations,
    passed_validations,
)
from services.identification.bridge_state import FusionSettings, with_common_shares
from services.ledger.baselines import baselines_of, realms_of_bridges
from services.recordings.remote import (
    Recording,
    RemoteRecording,
    Source,
    is_folder_of_recordings,
    recording_at,
    stored_site,
)

if TYPE_CHECKING:
    from rich.console import Console

_MAX_BRIDGES = 20
"""Maximum number of printed bridges; the file has all."""


def archive_command(
    options: IdentifyOptions,
    into: Path,
    executing: AbstractContextManager[CrossingExecutor | None],
    console: "Console",
) -> int:
    """Identify crossings without a result in a folder, print a summary; 3 if input was lost.

    Raise InputError for an output of single crossings, a file or folder that cannot be written, no
    site file, or a catalogue that cannot be created.
    """
    site, json_path = options.site, options.json
    folder = validations_folder(options.validations)
    _check(options, into)
    problems: list[str] = []
    known = _site_of(options.recordings, site)
    beside = None if site is None else site.parent
    recordings = _recordings(options.recordings, known, problems)
    settings = IdentificationSettings.model_validate(
        {"method": options.search_method, "seed": options.seed}
    )
    warn_of_no_noise(known, options.search_method)
    baselines = baselines_of(known, beside, options.baseline)
    fusing = FusionSettings(baselines.states, options.fuse_suspect)
    validated = passed_validations(folder, known, settings)
    asked = ArchiveJob(tuple(recordings), known, settings, fusing, validated)
    crossings: list[CrossingResult] = []
    pairs = ValidatedPairs()
    realms: dict[str, set[str]] = {}

    def take(crossing: CrossingResult) -> None:
        pairs.add(crossing)
        for bridge, of_bridge in realms_of_bridges([crossing]).items():
            realms.setdefault(bridge, set()).update(of_bridge)
        if json_path is not None:
            crossings.append(crossing)

    with executing as execution, progress_bar(console) as bar:
        task = bar.add_task("crossings", total=None)
        found = identify_archive(
            asked,
            InlineExecutor() if execution is None else execution,
            ResultStore(into),
            on_result=take,
            report=lambda number: bar.update(task, description=count_of(number, "crossing")),
        )
    warn_of_baselines(found.bridges, realms, baselines)
    header = asked.header
    _write(into / BRIDGES, header, [], found)
    if json_path is not None:
        crossings.sort(key=lambda one: (one.entry_time, one.crossing_id))
        _write(json_path, header, with_common_shares(crossings, found.bridges), found)
    notes_of = partial(pairs.notes, folder, known)
    return _print_summary(found, notes_of, [*problems, *found.problems], known, into, console)


def _check(options: IdentifyOptions, into: Path) -> None:
    """Raise InputError for outputs that cannot be used; make the folder of results."""
    single = {"rrd": options.rrd, "draws": options.draws, "figures": options.figures}
    for name, path in single.items():
        if path is not None:
            raise InputError(
                f"--{name}: cannot be combined with --into; leave --into out for single recordings"
            )
    check_validations(options.validations)
    for source in options.recordings:
        check_no_tables(source)
    if options.json is not None:
        check_writable(options.json)
    make_folder(into)
    check_writable(into / BRIDGES)


def _site_of(sources: Sequence[Source], site: Path | None) -> Site:
    """Return the site file given, or the first of a recording; a damaged recording has none."""
    if site is not None:
        return load_site(site)
    for recording in chain.from_iterable(map(_all_of, sources)):
        try:
            text = stored_site(recording)
        except InputError:  # reported where it is read
            continue
        if text is not None:
            return parse_site(text, f"{recording}: site.toml")
    raise InputError(f"{sources[0]}: no recording contains a site file; give one with --site")


def _all_of(source: Source) -> Iterator[Recording]:
    """Yield the named recording, or all of a folder."""
    if not is_folder_of_recordings(source):
        yield recording_at(source)
        return
    folder = folder_at(str(source))
    for entry in files_below(folder, ".mcap"):
        yield _in_folder(source, folder, entry.name)


def _in_folder(source: Source, folder: Folder, name: str) -> Recording:
    return source / name if isinstance(source, Path) else RemoteRecording(folder, name)


def _recordings(sources: Sequence[Source], site: Site, problems: list[str]) -> list[Recording]:
    """Return named recordings, and of folders those with a crossing by their positions.

    A folder's catalogue is updated first; each contradiction in it is a problem, one line each. It
    is stored there if the folder is writable.
    """
    found: list[Recording] = []
    for source in sources:
        if not is_folder_of_recordings(source):
            found.append(recording_at(source))
            continue
        folder = folder_at(str(source))
        mended = update_catalog(folder, must_write=False)
        scan = crossings_of(folder, mended.rows.values(), site)
        problems += (*mended.problems, *scan.problems)
        with_crossings = {path for one in scan.crossings for path in one.recordings}
        found += (_in_folder(source, folder, path) for path in sorted(with_crossings))
    return found


def _write(
    path: Path, header: ResultHeader, crossings: list[CrossingResult], found: ArchiveResult
) -> None:
    write_atomically(path, results_json(results(header, crossings, found.bridges)))


def _print_summary(
    found: ArchiveResult,
    notes_of: Callable[[str], Iterable[str]],
    problems: Sequence[str],
    site: Site,
    into: Path,
    console: "Console",
) -> int:
    def write(line: str) -> None:
        console.print(line, markup=False, soft_wrap=True)

    for number, (name, state) in enumerate(found.bridges.items()):
        if number == _MAX_BRIDGES:
            write(f"… and {count_of(len(found.bridges) - number, 'more bridge')}")
            break
        print_bridge(console, site.bridge(name), state)
        for note in notes_of(name):
            write(note)
        console.print()
    for problem in problems:
        write(problem)
    for crossing_id in found.failed:
        write(f"{crossing_id}: identification failed, see the log; the next run tries it again")
    verdicts = ", ".join(
        f"{number} {verdict}" for verdict, number in sorted(found.verdicts.items())
    )
    number = found.verdicts.total()
    write(
        f"{number} crossing{'s' if number != 1 else ''}, {found.there} from earlier runs"
        f"{verdicts and f': {verdicts}'}; results in {into}, bridges in {into / BRIDGES}"
    )
    return EXIT_SOMETHING_LOST if problems or found.failed else 0
