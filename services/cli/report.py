"""The command `driveby report`: results as a page to hand over."""

import argparse
from pathlib import Path
from typing import Any

from services.cli.parsing import add_file, add_site, command
from services.common.kinds import HTML, PDF
from services.common.language import LANGUAGES
from services.common.options import OutputFile


def add_report(commands: Any) -> None:
    """Add `driveby report`: write results as one printable HTML file."""
    p = command(
        commands,
        "report",
        _report,
        "write results as one printable HTML file, and PDF",
        "driveby report drive.json --site site.toml -o report.html",
    )
    p.add_argument(
        "results",
        type=Path,
        nargs="+",
        metavar="RESULTS.json",
        help="results of identify or of a worker",
    )
    p.add_argument(
        "-o",
        "--output",
        type=OutputFile((HTML,)),
        default=Path("report.html"),
        metavar="OUT.html",
        help="HTML file to write (default: report.html)",
    )
    p.add_argument(
        "--pdf", action="store_true", help="also print it to OUT.pdf with an installed browser"
    )
    add_site(p, "site file of the bridges (default: that of a recording in the results' folder)")
    add_file(
        p,
        "--baseline",
        "BEFORE.json",
        "earlier results, shown beside these with the change (default: the site file's)",
    )
    p.add_argument(
        "--language", choices=tuple(LANGUAGES), default="en", help="language (default: en)"
    )
    add_file(p, "--history", "DIR", "add a page with each bridge over time, from this history")
    p.add_argument(
        "--period",
        choices=("day", "week", "month"),
        default="month",
        help="period of fusion (default: month)",
    )


def _report(options: argparse.Namespace) -> int:
    from schemas.results import load_results
    from services.common.errors import InputError
    from services.common.files import check_writable, write_atomically
    from services.common.language import language_of
    from services.common.progress import steps_bar
    from services.ledger.site_of_results import site_of_results
    from services.report.bridge import bridge_reports, with_histories
    from services.report.page import page
    from services.report.pdf import find_browser, write_pdf

    output: Path = options.output
    if output.suffix not in (".html", ".htm"):
        raise InputError(f"{output}: the name of an HTML file (.html) is expected")
    pdf = output.with_suffix(".pdf")
    check_writable(output)
    if options.pdf:
        check_writable(pdf, kinds=(PDF,))
        browser = find_browser()
    files = []
    for path in options.results:
        results = load_results(path)
        files.append((path, results, site_of_results(path, results, options.site)))
    beside = None if options.site is None else options.site.parent
    language = language_of(options.language)
    reports = bridge_reports(files, options.baseline, beside, language)
    if options.history is not None:
        reports = with_histories(reports, options.history, options.period, print)
    with steps_bar(f"drawing {output}") as progress:
        text = page(reports, progress, language)
    write_atomically(output, text)
    for report in reports:
        print(f"{report.bridge.id}: {report.finding.headline} {' '.join(report.finding.sentences)}")
    if not reports:
        print("no crossing of a known bridge")
    print(output)
    if options.pdf:
        with steps_bar(f"printing {pdf}") as progress:
            write_pdf(output, pdf, browser, progress)
        print(pdf)
    return 0
