"""The command `driveby report`: results as a page to hand over."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.parser import Subcommand
from services.common.kinds import HTML, PDF
from services.common.language import LANGUAGES
from services.common.options import (
    CERTIFICATES,
    file_option,
    flag,
    opt,
    output_option,
    positional,
    site_option,
    validations_folder,
    validations_option,
)

if TYPE_CHECKING:
    from services.history.periods import Unit


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """Options of `driveby report`: results, and the page."""

    results: tuple[Path, ...] = positional(
        "results files of identify or a worker", Path, nargs="+", metavar="RESULTS.json"
    )
    output: Path = output_option(
        "HTML file to write (default: report.html)",
        "OUT.html",
        HTML,
        flags=("-o", "--output"),
        default=Path("report.html"),
    )
    pdf: bool = flag("also print the report to OUT.pdf with an installed browser")
    site: Path | None = site_option(
        "site file of the bridges (default: that of a recording in the results' folder)"
    )
    baseline: Path | None = file_option(
        "earlier results to compare these with (default: those that the site file names)",
        "OLD.json",
    )
    validations: Path | None = validations_option(
        f"folder of validation records (default: {CERTIFICATES})"
    )
    language: str = opt("report language (default: en)", default="en", choices=tuple(LANGUAGES))
    history: Path | None = file_option(
        "folder of a history; adds a page on each bridge over time", "DIR"
    )
    period: "Unit" = opt(
        "length of the periods whose crossings are fused (default: month)",
        default="month",
        choices=("day", "week", "month"),
    )


def _report(asked: ReportOptions) -> int:
    from schemas.results import load_results
    from services.common.errors import InputError
    from services.common.files import check_writable, write_atomically
    from services.common.language import language_of
    from services.common.progress import steps_bar
    from services.history.validation_files import check_validations
    from services.ledger.site_of_results import site_of_results
    from services.report.bridge import bridge_reports
    from services.report.histories import with_histories
    from services.report.page import page
    from services.report.pdf import find_browser, write_pdf

    output = asked.output
    if output.suffix not in (".html", ".htm"):
        also = f"; --pdf prints it to {output}, too" if output.suffix == ".pdf" else ""
        raise InputError(f"{output}: the name of an HTML file (.html) is expected{also}")
    pdf = output.with_suffix(".pdf")
    check_validations(asked.validations)
    records = validations_folder(asked.validations)
    check_writable(output)
    if asked.pdf:
        check_writable(pdf, kinds=(PDF,))
    files = []
    for path in asked.results:
        results = load_results(path)
        files.append((path, results, site_of_results(path, results, asked.site)))
    language = language_of(asked.language)
    reports = bridge_reports(files, asked.baseline, asked.site, language, records)
    if asked.history is not None:
        reports = with_histories(reports, asked.history, asked.period, print, language)
    with steps_bar(f"drawing {output}") as progress:
        text = page(reports, progress, language)
    write_atomically(output, text)
    for report in reports:
        finding = " ".join((report.finding.headline, *report.finding.sentences))
        for line in (finding, *report.cautions):
            print(f"{report.bridge.id}: {line}")
    if not reports:
        print("no crossing of a known bridge")
    if asked.baseline is None and len(files) > 1:
        given = "" if asked.site is None else f" --site {asked.site}"
        print(
            "the crossings of all files are fused; to see what has changed between surveys: "
            f"driveby report LATER.json --baseline EARLIER.json{given}"
        )
    print(output)
    if asked.pdf:
        browser = find_browser()
        with steps_bar(f"printing {pdf}") as progress:
            write_pdf(output, pdf, browser, progress)
        print(pdf)
    return 0


COMMAND: Final = Subcommand(
    ReportOptions,
    "driveby report drive.json --site site.toml -o report.html",
    _report,
)
