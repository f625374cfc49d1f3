"""Reports for owners of bridges from a notebook, as by `driveby report`."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from schemas.results import Results, load_results
from schemas.site import Site
from services.common.errors import InputError
from services.common.files import check_writable, write_atomically
from services.common.kinds import HTML
from services.common.language import LANGUAGES, language_of
from services.ledger.site_of_results import site_of_results
from services.notebook.arguments import known_arguments, path_of
from services.notebook.fuse import RESULTS_EXPECTED, Fusion, check_identifiers
from services.notebook.read import Name, given_site
from services.notebook.solution import Identification
from services.report.bridge import bridge_reports
from services.report.earlier import NamedResults
from services.report.page import page


@known_arguments()
def report(
    *sources: Name | Identification | Fusion,
    output: Name = "report.html",
    site: Name | Site | None = None,
    baseline: Name | Identification | Fusion | None = None,
    language: str = "en",
) -> Path:
    """Write results (files, or what `identify` or `fuse` returned) as one printable HTML file.

    `baseline` is earlier results, whose numbers stand next to these; by default those with which
    one `fuse` compared its sources, or the site file's. `language` is `en` or `de`. `site` is
    needed where the folder of a results file has no recording. Return the path. Raise InputError,
    in one line, for results that cannot be reported, or crossings in memory that differ and have
    one identifier.
    """
    path = path_of("output", output, "the name of an HTML file (.html)")
    if path.suffix not in (".html", ".htm"):
        raise InputError(f"{path}: the name of an HTML file (.html) is expected")
    if not sources:
        raise InputError("no results given, results.json or the value of identify() expected")
    if language not in LANGUAGES:
        raise InputError(f'language: is "{language}", it must be one of {", ".join(LANGUAGES)}')
    check_writable(path, kinds=(HTML,))
    given = None if site is None else given_site(site)
    files = [_file(source, given) for source in sources]
    check_identifiers(
        [source.results for source in sources if isinstance(source, Identification | Fusion)]
    )
    site_file = Path(site) if isinstance(site, str | PathLike) else None
    before = _baseline(sources, baseline)
    words = language_of(language)
    reports = bridge_reports(files, before, site_file, words)
    write_atomically(path, page(reports, language=words))
    return path


def _baseline(sources: Sequence[object], given: object) -> Path | NamedResults | None:
    """Return the results to compare with."""
    if isinstance(given, Identification | Fusion):
        return NamedResults(Path(type(given).__name__.lower()), given.results)
    if given is not None:
        return path_of("baseline", given, RESULTS_EXPECTED)
    (first, *more) = sources
    if more or not isinstance(first, Fusion) or first.baseline is None:
        return None
    return NamedResults(Path("given to fuse"), first.baseline)


def _file(source: object, given: Site | None) -> tuple[Path, Results, Site]:
    """Return the name of results, the results and their site."""
    if isinstance(source, Identification):
        return Path("identification"), source.results, source.site
    if isinstance(source, Fusion):
        bridges = {crossing.bridge for crossing in source.results.crossings}
        return Path("fusion"), source.results, given or source.site_with(bridges)
    path = path_of("source", source, RESULTS_EXPECTED)
    results = load_results(path)
    return path, results, site_of_results(path, results, given)
