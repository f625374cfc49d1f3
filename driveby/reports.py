"""Reports for owners of bridges from a notebook, as by `driveby report`."""

from pathlib import Path

from schemas.results import load_results
from services.common.errors import InputError
from services.common.files import check_writable, write_atomically
from services.common.kinds import HTML
from services.common.language import LANGUAGES, language_of
from services.ledger.site_of_results import site_of_results
from services.notebook.read import Name
from services.notebook.solution import Identification
from services.report.bridge import bridge_reports
from services.report.page import page


def report(
    *sources: Name | Identification,
    output: Name = "report.html",
    site: Name | None = None,
    baseline: Name | None = None,
    language: str = "en",
) -> Path:
    """Write results (files, or what `identify` returned) as one printable HTML file.

    `baseline` is an earlier results file, whose numbers stand next to these; `language` is `en` or
    `de`. `site` is needed where the folder of a results file has no recording. Return the path.
    Raise InputError, in one line, for results that cannot be reported.
    """
    path = Path(output)
    if path.suffix not in (".html", ".htm"):
        raise InputError(f"{path}: the name of an HTML file (.html) is expected")
    if not sources:
        raise InputError("no results given, results.json or the value of identify() expected")
    if language not in LANGUAGES:
        raise InputError(f'language: is "{language}", it must be one of {", ".join(LANGUAGES)}')
    check_writable(path, kinds=(HTML,))
    given = None if site is None else Path(site)
    files = []
    for source in sources:
        if isinstance(source, Identification):
            files.append((Path("identification"), source.results, source.site))
        else:
            results = load_results(Path(source))
            files.append((Path(source), results, site_of_results(Path(source), results, given)))
    beside = None if given is None else given.parent
    before, words = None if baseline is None else Path(baseline), language_of(language)
    reports = bridge_reports(files, before, beside, words)
    write_atomically(path, page(reports, language=words))
    return path
