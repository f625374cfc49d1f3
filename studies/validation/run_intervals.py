"""Validation of method `pre`: run all parts, print their tables, write page and figure."""

import json
from typing import TYPE_CHECKING

from schemas.settings import IdentificationSettings
from schemas.site_file import load_site
from services.common.files import check_writable, make_folder, write_atomically
from services.common.progress import steps_bar
from services.finding.placed import middle_site
from services.simulation.validation_options import IntervalOptions
from studies.simulation.truths import default_site
from studies.validation.calibration import StudyTarget, by_condition, ranks_of, scores
from studies.validation.misspecification import (
    HEADINGS,
    cells,
    crossings_start,
    lines_of,
    read_records,
    run_effects,
)
from studies.validation.uncertainty import (
    ValidationOutcome,
    as_json,
    largest_z,
    noises,
    number,
    percent,
    reasons_of,
    run_parts,
    scenario_rows,
    targets,
)

if TYPE_CHECKING:
    from rich.console import Console

_FIGURE = "calibration.png"


def run(asked: IntervalOptions, console: "Console") -> int:
    """Run all parts, print their tables, write the requested files; 1 if a target was missed."""
    for path in (asked.json, asked.page):
        if path is not None:
            check_writable(path)
    if asked.out_of_model:
        read_records(asked.records)
        make_folder(asked.records.parent)
    if asked.figures is not None:
        make_folder(asked.figures)
        check_writable(asked.figures / _FIGURE)
    outcome = _outcome(asked, console)
    if asked.json is not None:
        write_atomically(asked.json, json.dumps(as_json(outcome), indent=1) + "\n")
    if asked.figures is not None and len(outcome.drawn) > 1:
        from studies.validation.figure import calibration_figure

        calibration_figure(
            asked.figures / _FIGURE,
            scores(outcome.drawn),
            ranks_of(outcome.drawn),
            f"{len(outcome.drawn)} simulated crossings whose truth was drawn from the priors",
        )
    if asked.page is not None:
        from studies.validation.page import validation_page

        write_atomically(asked.page, validation_page(outcome))
    all_checks = targets(outcome)
    print_outcome(console, outcome, all_checks)
    return 0 if all(check.is_met for check in all_checks) else 1


def _outcome(asked: IntervalOptions, console: "Console") -> ValidationOutcome:
    known = default_site() if asked.site is None else middle_site(load_site(asked.site))
    start = crossings_start(asked.processes)
    with steps_bar("crossings", console, start) as progress:
        outcome = run_parts(
            known,
            crossings=asked.crossings,
            control=asked.control,
            scenarios=asked.scenarios,
            folder=asked.truth,
            processes=asked.processes,
            progress=progress,
        )
    if not asked.out_of_model:
        return outcome
    with steps_bar("crossings with more physics", console, start) as progress:
        out_of_model = run_effects(
            known,
            asked.effects,
            asked.out_of_model,
            asked.records,
            IdentificationSettings(method="pre", threads=1),
            asked.processes,
            progress,
        )
    return outcome._replace(out_of_model=out_of_model)


def print_outcome(
    console: "Console", outcome: ValidationOutcome, all_checks: list[StudyTarget]
) -> None:
    """Print the tables of all parts, at most 80 characters wide, and the targets."""
    from rich.table import Table

    def table(*columns: str) -> Table:
        made = Table(box=None, pad_edge=False, header_style="bold")
        for k, column in enumerate(columns):
            made.add_column(column, justify="left" if k == 0 else "right", no_wrap=True)
        return made

    if len(outcome.drawn) > 1:
        console.print("[bold]crossings drawn from the priors[/]", highlight=False)
        shown = table("", "crossings", "good", "coverage", "rms z")
        for name, count, good, covered, rms in by_condition(outcome.drawn):
            shown.add_row(name, str(count), f"{good:.0%}", percent(covered), number(rms))
        console.print(shown)
        for text in reasons_of(outcome.drawn):
            console.print(f"  {text}", highlight=False)
    if outcome.scenarios:
        console.print("[bold]the paper's scenarios, EI / undamaged EI[/]", highlight=False)
        shown = table(
            "scenario", "element", "truth", "paper", *(f"{n:g} µg" for n in noises(outcome))
        )
        for row in scenario_rows(outcome):
            shown.add_row(*row)
        console.print(shown)
    if outcome.out_of_model:
        console.print("[bold]more physics than the method has[/]", highlight=False)
        shown = table(*HEADINGS[:-2])
        for effect in lines_of(outcome.out_of_model):
            shown.add_row(*(cell.replace(" %", "%") for cell in cells(effect)[:-2]))
        console.print(shown)
    for line in outcome.judged:
        worst = largest_z(line)
        console.print(
            f"{line['folder']} run {line['run']}: {line['verdict']}, chi2 "
            f"{number(line['chi2_per_dof'])}, largest |z| {number(worst)}",
            highlight=False,
        )
    if outcome.judged_from is None:
        console.print("no crossings of an independent simulator here: that part is left out")
    shown = table("target", "measured", "from", "to", "")
    for check in all_checks:
        measured = "none" if check.measured is None else f"{check.measured:.3f}"
        style = None if check.is_met else "bold red"
        shown.add_row(
            check.name,
            f"{measured} {check.note}".strip(),
            f"{check.low:g}",
            f"{check.high:g}",
            "met" if check.is_met else "MISSED",
            style=style,
        )
    console.print(shown)
