"""Reports for owners of bridges from a notebook, as by `driveby report`."""

from os import PathLike
from pathlib import Path
from typing import Final

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
from services.report.page import page

_BASELINE: Final = "the name of a results file"


@known_arguments()
def report(
    *sources: Name | Identification | Fusion,
    output: Name = "report.html",
    site: Name | Site | None = None,
    baseline: Name | None = None,
    language: str = "en",
) -> Path:
    """Write results (files, or what `identify` or `fuse` returned) as one printable HTML file.

    `baseline` is an earlier results file, whose numbers stand next to these; `language` is `en` or
    `de`. `site` is needed where the folder of a results file has no recording. Return the path.
    Raise InputError, in one line, for results that cannot be reported, or crossings in memory that
    differ and have one identifier.
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
    beside = Path(site).parent if isinstance(site, str | PathLike) else None
    before = None if baseline is None else path_of("baseline", baseline, _BASELINE)
    words = language_of(language)
    reports = bridge_reports(files, before, beside, words)
    write_atomically(path, page(reports, language=words))
    return path


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
