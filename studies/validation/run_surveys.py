"""Validation of method `pre` by whole simulated surveys, fused and compared with the truth."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from schemas.site_file import load_site
from services.common.files import make_folder
from services.common.progress import steps_bar
from services.finding.placed import middle_site
from services.simulation.validation_options import SurveyOptions
from studies.simulation.truths import default_site
from studies.validation import detection
from studies.validation.forecasts import forecasts_of
from studies.validation.misspecification import crossings_start, read_records
from studies.validation.surveys import HEADINGS, fused_surveys, rows, run_surveys, survey_checks

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def run(asked: SurveyOptions, console: "Console") -> int:
    """Simulate missing crossings, fuse, print a line for each kind; 1 if a target was missed.

    The forecast of `driveby survey` is printed next to the results; for kinds with a weak element a
    second table has the number of crossings needed to detect it.
    """
    read_records(asked.records)
    make_folder(asked.records.parent)
    known = default_site() if asked.site is None else middle_site(load_site(asked.site))
    with steps_bar("crossings", console, crossings_start(asked.processes)) as progress:
        found = run_surveys(
            known, asked.kinds, asked.surveys, asked.records, asked.processes, progress
        )
    with steps_bar("fusing", console) as progress:
        fused = fused_surveys(found, progress=progress)
    with console.status("forecasts", spinner="dots"):
        forecasts = forecasts_of(known, fused)
    console.print(_table(HEADINGS, rows(fused, forecasts)))
    with steps_bar("fusing groups of crossings", console) as progress:
        groups = detection.groups_of(found, known.bridges[0], progress=progress)
    detected = detection.detection(groups)
    if detected:
        console.print()
        console.print(_table(detection.HEADINGS, map(detection.cells, detected)))
    checks = survey_checks(fused)
    for check in checks:
        if not check.is_met:
            measured = "none" if check.measured is None else f"{check.measured:.2f}"
            console.print(
                f"missed: {check.name} {measured}, {check.low:g} to {check.high:g} was the target",
                highlight=False,
            )
    return 0 if all(check.is_met for check in checks) else 1


def _table(headings: Sequence[str], lines: Iterable[Sequence[str]]) -> "Table":
    from rich.table import Table

    # One space between columns: all of them fit into 80 characters.
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for k, heading in enumerate(headings):
        table.add_column(heading, justify="left" if k == 0 else "right", no_wrap=True)
    for line in lines:
        table.add_row(*line)
    return table
