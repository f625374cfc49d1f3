"""`driveby validate --method pre --surveys N`: whole surveys driven, fused, beside the truth."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.site_file import load_site
from services.cli.survey_forecasts import forecasts_of
from services.common.files import make_folder
from services.common.progress import progress_bar, steps_bar
from services.identification.placed import middle_site
from services.simulation.drawn import default_site
from services.validation import detection
from services.validation.surveys import HEADINGS, fused_surveys, rows, run_surveys, survey_checks
from services.validation.worlds import read_records

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


def validate_surveys_command(
    *,
    surveys: int,
    kinds: tuple[str, ...],
    records: Path,
    site: Path | None,
    processes: int,
    console: "Console",
) -> int:
    """Drive what the records lack, fuse, print a line for each kind; 1 if an aim was missed.

    Beside what is achieved stands the forecast of `driveby survey`; for kinds with a weak element a
    second table says how many crossings it takes to see it.
    """
    read_records(records)
    make_folder(records.parent)
    known = default_site() if site is None else middle_site(load_site(site))
    with progress_bar(console) as bar:
        task = bar.add_task("crossings", total=None)
        found = run_surveys(
            known,
            kinds,
            surveys,
            records,
            processes,
            lambda done, jobs: bar.update(task, completed=done, total=jobs),
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
                f"missed: {check.name} {measured}, {check.low:g} to {check.high:g} was aimed at",
                highlight=False,
            )
    return 0 if all(check.is_met for check in checks) else 1


def _table(headings: Sequence[str], lines: Iterable[Sequence[str]]) -> "Table":
    from rich.table import Table

    # One space between columns: all of them stand within 80 characters.
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for k, heading in enumerate(headings):
        table.add_column(heading, justify="left" if k == 0 else "right", no_wrap=True)
    for line in lines:
        table.add_row(*line)
    return table
