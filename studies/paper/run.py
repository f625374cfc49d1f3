"""Validation by the paper's scenarios with both searches: table, JSON and figures."""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from pre_core.search import loop
from services.common.files import check_writable, make_folder, write_atomically
from services.common.naming import count_of
from services.common.progress import progress_bar, start_line
from services.simulation.validation_options import ScenarioOptions
from studies.paper.scenarios import Scenario, compare_with_paper, models, run_scenario
from studies.paper.tables import accuracy_of_paper, of_paper, tables_of_paper

if TYPE_CHECKING:
    from rich.console import Console

_OVERVIEW = "scenarios.png"
"""Name of the figure of all scenarios, next to one for each."""


def run(asked: ScenarioOptions, console: "Console") -> int:
    """Run scenarios, print the table, write the requested files; 0 also for a missed target."""
    if asked.json is not None:
        check_writable(asked.json)
    if asked.figures is not None:
        make_folder(asked.figures)
        check_writable(asked.figures / _OVERVIEW)
    found = _run_scenarios(asked, console)
    published = asked.site is None
    print_table(console, found, published=published)
    _print_summary(console, found, published=published, noise=asked.noise)
    if asked.json is not None:
        write_atomically(asked.json, json.dumps(_as_json(found), indent=1) + "\n")
    if asked.figures is not None:
        from studies.paper.figures import overview_figure, posterior_figure

        for scenario in found:
            path = asked.figures / f"scenario-{scenario.number:02d}.png"
            posterior_figure(path, scenario, scenario.names)
        overview_figure(asked.figures / _OVERVIEW, found, tables_of_paper() if published else None)
        console.print(f"figures in {asked.figures}/", highlight=False)
    return 0


def _run_scenarios(asked: ScenarioOptions, console: "Console") -> list[Scenario]:
    car, undamaged = models(asked.site)
    number, steps = len(asked.scenarios), asked.steps
    start_line(console, f"searching in {count_of(number, 'scenario')}, {steps} steps each")
    with progress_bar(console) as progress:
        task = progress.add_task("starting", total=len(asked.scenarios) * (asked.steps + 1))
        return [
            run_scenario(
                number,
                car,
                undamaged,
                asked,
                lambda text, steps: progress.update(task, description=text, advance=steps),
            )
            for number in asked.scenarios
        ]


def print_table(console: "Console", found: list[Scenario], *, published: bool) -> None:
    """Print one row per scenario and parameter, at most 80 characters wide; weak ones in bold."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    columns = ["truth", *(["paper", "S_A"] if published else []), "random walk", "S_A"]
    for column in ("scenario", "parameter", *columns, "ours", "S_A"):
        left = column == "parameter"
        table.add_column(column, justify="left" if left else "right", no_wrap=True)
    for scenario in found:
        if scenario is not found[0]:
            table.add_row()
        walk, ours = scenario.random_walk, scenario.least_squares
        for name in scenario.names:
            row = [str(scenario.number), name, f"{scenario.truth[name]:.2f}"]
            if published:
                row.append("{:.2f} ± {:.2f}".format(*of_paper(scenario.number, name)))
                row.append(f"{accuracy_of_paper(scenario.number, name):.2f}")
            row.append(f"{walk.mean[name]:.2f} ± {walk.std[name]:.2f}")
            accuracy = walk.accuracy[name]
            row.append(f"{accuracy:.2f}" if accuracy >= 0.0 else f"{accuracy:.1f}")
            row.append(_ratio(ours.mean[name]))
            row.append(_ratio(ours.accuracy[name]))
            table.add_row(*row, style="bold" if scenario.truth[name] != 1.0 else None)
    console.print(table)


def _ratio(value: float) -> str:
    """Return at most six characters: four decimals near one, fewer for distant values."""
    if 0.0 <= value < 10.0:
        return f"{value:.4f}"
    return f"{value:.2f}" if abs(value) < 100.0 else f"{value:.0e}"


def _print_summary(
    console: "Console", found: list[Scenario], *, published: bool, noise: float
) -> None:
    error, name, number = max(
        (abs(s.least_squares.mean[name] - s.truth[name]), name, s.number)
        for s in found
        for name in s.names
    )
    accuracies = [a for s in found for a in s.least_squares.accuracy.values()]
    exact = sum(accuracy >= 0.999 for accuracy in accuracies)
    least = f"largest error {error:.1e} ({name}, scenario {number})"
    lines = [f"ours: S_A ≥ 0.999 in {exact} of {len(accuracies)}; {least}"]
    labels = {"random_walk": "random walk", "least_squares": "ours"}
    lines += [
        f"scenario {scenario.number}, {labels[method]}: {ending.value}"
        for scenario in found
        for method, ending in scenario.endings.items()
        if ending not in (loop.Termination.CONVERGED, loop.Termination.STEPS_DONE)
    ]
    if published:
        close = compare_with_paper({s.number: s.random_walk for s in found})
        of, without = f"of {close['cells']}", "m_s1 and m_s2 left out"
        lines.append(f"random walk: {close['std']} {of} stds within 0.06 of Table 7's,")
        lines.append(f"             {close['mean']} {of} means within 0.08; {without}")
    walk, fit = (
        float(np.median([scenario.seconds[method] for scenario in found]))
        for method in ("random_walk", "least_squares")
    )
    lines.append(f"median time of a scenario: random walk {walk:.1f} s, ours {fit:.2f} s")
    if noise > 0.0:
        lines.append(f"accelerometer noise {noise:g} µg/√Hz")
    for line in lines:
        console.print(line, highlight=False)


def _as_json(found: list[Scenario]) -> dict[str, Any]:
    return {
        "scenarios": {
            str(scenario.number): {
                "truth": scenario.truth,
                "least_squares": {
                    "S_A": scenario.least_squares.accuracy,
                    "mean": scenario.least_squares.mean,
                    "ending": scenario.endings["least_squares"].name.lower(),
                    "seconds": scenario.seconds["least_squares"],
                },
                "random_walk": {
                    "S_A": scenario.random_walk.accuracy,
                    "mean": scenario.random_walk.mean,
                    "std": scenario.random_walk.std,
                    "ending": scenario.endings["random_walk"].name.lower(),
                    "seconds": scenario.seconds["random_walk"],
                },
            }
            for scenario in found
        }
    }
