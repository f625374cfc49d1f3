"""Measurements of studies/reproduction.md that `driveby validate` does not print.

    OPENBLAS_NUM_THREADS=1 .venv/bin/python -m studies.scripts.reproduction step

Other names are road, length, starts, mesh and frequencies. `--scenarios 1,6,12` selects scenarios.
Each takes up to ten minutes on two cores.
"""

import argparse
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from pre_core import parameters
from pre_core.paper import experiment, least_squares, random_walk, residual
from pre_core.paper.crossing import ROAD_CLASS, ROAD_SEED, paper_window
from pre_core.paper.integrate import newmark_integrate, spline_integrate
from pre_core.paper.window import MeasuredCrossing, PaperWindow, build_window
from pre_core.physics.bridge import natural_frequencies_hz
from pre_core.physics.models import from_models
from pre_core.physics.vehicle import natural_frequencies_hz as vehicle_frequencies_hz
from pre_core.search import loop
from services.common.arrays import Floats
from services.simulation.drive import DrivenRoad, Measurement, paper_site, simulate_drive
from studies.paper.scenarios import (
    NAMES,
    Cloud,
    cloud_of,
    compare_with_paper,
    table_columns,
)
from studies.paper.tables import tables_of_paper

Proposal = Callable[[np.random.Generator, Floats], Floats]

CONSOLE = Console(highlight=False, width=150)
NOMINAL = from_models(experiment.TRUCK, experiment.beam(np.ones(experiment.ELEMENTS)))
FREE = parameters.paper_subset(experiment.ELEMENTS)


class Walk(NamedTuple):
    """One random walk: its stops and its steps."""

    label: str
    scenario: int
    propose: Proposal
    stops: tuple[int, ...]
    road: tuple[str, int]
    seed: int


class Stop(NamedTuple):
    """Particles at one stop, and the acceptance rate of the last 50 steps' proposals."""

    cloud: Cloud
    acceptance: float


def gaussian(std: float) -> Proposal:
    """Return a proposal of all coordinates at once, normally distributed."""
    return lambda rng, x: x + std * rng.standard_normal(x.shape)


def uniform(half_width: float) -> Proposal:
    """Return a proposal of all coordinates at once, uniformly distributed."""
    return lambda rng, x: x + rng.uniform(-half_width, half_width, x.shape)


def one_at_a_time(std: float) -> Proposal:
    """Return a proposal of one random coordinate per particle, normally distributed."""

    def propose(rng: np.random.Generator, x: Floats) -> Floats:
        chosen = rng.integers(0, x.shape[1], x.shape[0])
        moved = x.copy()
        moved[np.arange(x.shape[0]), chosen] += std * rng.standard_normal(x.shape[0])
        return moved

    return propose


def window_of(scenario: int, road: tuple[str, int] = (ROAD_CLASS, ROAD_SEED)) -> PaperWindow:
    """Return the paper's experiment without noise."""
    beam = experiment.beam(experiment.scenario_ratios(scenario))
    return paper_window(experiment.TRUCK, beam, 0.0, 0, road=road)


def truth_of(scenario: int) -> dict[str, float]:
    """Return true ratios by name."""
    ratios = experiment.scenario_ratios(scenario)
    return dict.fromkeys(NAMES, 1.0) | {f"EI_{e + 1}": float(r) for e, r in enumerate(ratios)}


def objective(
    window: PaperWindow, work: residual.Workspace, ratios: Floats, limit: Floats
) -> Floats:
    """Return J of particles, infinite for an impossible parameter or d_1."""
    theta = np.repeat(NOMINAL[None, :], ratios.shape[0], axis=0)
    theta[:, FREE] *= ratios
    total = np.full(ratios.shape[0], np.inf)
    physical = np.all(ratios > 0.0, axis=1) & (theta[:, parameters.D_1] < window.wheelbase_m)
    out = np.empty(int(physical.sum()))
    residual.objective_batch(window, work, theta[physical], limit[physical], out)
    total[physical] = out
    return total


def walk(task: Walk) -> list[Stop]:
    """Return the particles of the paper's search with any step, at each stop."""
    window = window_of(task.scenario, task.road)
    work = residual.workspace(window)
    rng = np.random.default_rng(task.seed)
    x = rng.uniform(
        random_walk.PRIOR_LOW, random_walk.PRIOR_HIGH, (random_walk.PARTICLES, FREE.size)
    )
    kept = objective(window, work, x, np.full(x.shape[0], np.inf))
    found: list[Stop] = []
    accepted: list[float] = []
    for count in range(1, max(task.stops) + 1):
        trial = task.propose(rng, x)
        value = objective(window, work, trial, kept)
        better = value <= kept
        x = np.where(better[:, None], trial, x)
        kept = np.where(better, value, kept)
        accepted.append(float(better.mean()))
        if count in task.stops:
            columns = table_columns(x, nominal=NOMINAL, free=FREE, window=window)
            cloud = cloud_of(columns, NAMES, truth_of(task.scenario))
            found.append(Stop(cloud, float(np.mean(accepted[-50:]))))
    return found


def compare(tasks: list[Walk], title: str) -> None:
    """Run the walks, two at a time, and print one line for each label and stop."""
    with ThreadPoolExecutor(2) as pool, CONSOLE.status("") as status:
        found = []
        for task, stops in zip(tasks, pool.map(walk, tasks), strict=True):
            found.append((task, stops))
            status.update(f"{len(found)} of {len(tasks)} walks done")
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in (
        title,
        "steps",
        "stds within 0.06",
        "means within 0.08",
        "std of EI",
        "std of k_s1",
        "EI_4 of 6",
        "EI_3, EI_5 of 6",
        "EI_7 of 12",
        "m_s2 of 6",
        "accepted",
    ):
        table.add_column(column, justify="left" if column == title else "right")
    for label in dict.fromkeys(task.label for task in tasks):
        chosen = [(task, stops) for task, stops in found if task.label == label]
        for place, stop in enumerate(chosen[0][0].stops):
            clouds = {task.scenario: stops[place].cloud for task, stops in chosen}
            acceptance = float(np.mean([stops[place].acceptance for _, stops in chosen]))
            table.add_row(label, str(stop), *_figures(clouds), f"{100 * acceptance:.2f} %")
    CONSOLE.print(table)


def _figures(clouds: dict[int, Cloud]) -> list[str]:
    close = compare_with_paper(clouds)
    rigidities = [f"EI_{e + 1}" for e in range(experiment.ELEMENTS)]

    def mean(scenario: int, *names: str) -> str:
        if scenario not in clouds:
            return "-"
        return ", ".join(f"{clouds[scenario].mean[name]:.2f}" for name in names)

    return [
        f"{close['std']} of {close['cells']}",
        f"{close['mean']} of {close['cells']}",
        f"{np.mean([cloud.std[name] for cloud in clouds.values() for name in rigidities]):.2f}",
        f"{np.mean([cloud.std['k_s1'] for cloud in clouds.values()]):.2f}",
        mean(6, "EI_4"),
        mean(6, "EI_3", "EI_5"),
        mean(12, "EI_7"),
        f"{clouds[6].mean['m_s2']:.2f} ± {clouds[6].std['m_s2']:.2f}" if 6 in clouds else "-",
    ]


def step(scenarios: tuple[int, ...]) -> None:
    """Compare distributions of the step."""
    kinds = {f"Gaussian {100 * std:g} %": gaussian(std) for std in (0.03, 0.05, 0.07, 0.10, 0.15)}
    kinds |= {f"uniform ±{100 * w:g} %": uniform(w) for w in (0.07, 0.12, 0.20)}
    kinds |= {
        f"Gaussian {100 * std:g} %, one at a time": one_at_a_time(std) for std in (0.07, 0.20)
    }
    stops = (random_walk.STEPS,)
    compare(
        [
            Walk(label, scenario, propose, stops, (ROAD_CLASS, ROAD_SEED), 0)
            for label, propose in kinds.items()
            for scenario in scenarios
        ],
        "step",
    )


def road(scenarios: tuple[int, ...]) -> None:
    """Compare roads, and seeds of the search."""
    roads = [("A", 1, 0), ("A", 2, 0), ("B", 1, 0), ("B", 2, 0), ("B", 3, 0), ("C", 1, 0)]
    roads += [("C", 2, 0), ("B", 1, 1)]
    compare(
        [
            Walk(
                f"class {name}, road {number}, search seed {seed}",
                scenario,
                gaussian(random_walk.STEP_RATIO),
                (random_walk.STEPS,),
                (name, number),
                seed,
            )
            for name, number, seed in roads
            for scenario in scenarios
        ],
        "road",
    )


def length(scenarios: tuple[int, ...]) -> None:
    """Compare the spread of the particles for several numbers of steps."""
    compare(
        [
            Walk(
                "Gaussian 7 %",
                scenario,
                gaussian(random_walk.STEP_RATIO),
                (150, 300, 600, 1200),
                (ROAD_CLASS, ROAD_SEED),
                0,
            )
            for scenario in scenarios
        ],
        "step",
    )


def fit(window: PaperWindow, start: Floats) -> tuple[Floats, int, loop.Termination]:
    """Return ratios, steps and termination of least squares from `start` (ratios)."""
    problem = least_squares.LeastSquaresProblem(window, NOMINAL, FREE)
    work = residual.workspace(window)
    state, infos, ending = loop.run_search(
        partial(least_squares.init, problem, work, NOMINAL[FREE] * start),
        partial(least_squares.step, problem, work),
        least_squares.MAX_STEPS,
    )
    return least_squares.untransform(problem, state.y) / NOMINAL[FREE], len(infos), ending


def starts(scenarios: tuple[int, ...], count: int = 20) -> None:
    """Run least squares from many random starts in the paper's prior."""
    for scenario in scenarios:
        window = window_of(scenario)
        rng = np.random.default_rng(scenario)
        accuracy, steps = [], []
        for _ in range(count):
            start = rng.uniform(random_walk.PRIOR_LOW, random_walk.PRIOR_HIGH, FREE.size)
            found, taken, ending = fit(window, start)
            columns = table_columns(found[None, :], nominal=NOMINAL, free=FREE, window=window)
            cloud = cloud_of(columns, NAMES, truth_of(scenario))
            accuracy.append(min(cloud.accuracy.values()))
            steps.append(taken)
            if ending is not loop.Termination.CONVERGED:
                CONSOLE.print(f"scenario {scenario}: {ending.value}")
        CONSOLE.print(
            f"scenario {scenario:2d}: {count} starts, 1 - S_A at worst {1 - min(accuracy):.1e}, "
            f"{np.mean(steps):.1f} steps on average, {max(steps)} at most"
        )


def mesh(scenarios: tuple[int, ...]) -> None:
    """Measure the effect of a shared mesh and integrator: data of a finer model, without noise."""
    site = paper_site()
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("scenario", "rate", "integration", "parts"):
        table.add_column(column, justify="right")
    for e in range(experiment.ELEMENTS):
        table.add_column(f"EI_{e + 1}", justify="right")
    table.add_column("worst of the truck", justify="right")
    for scenario in scenarios:
        for rate in (1000.0, 200.0):
            ratios = experiment.scenario_ratios(scenario)
            drive = simulate_drive(site, ratios, DrivenRoad("B", 1), Measurement(rate_hz=rate)).run
            time_s = drive.accel_time_s - drive.accel_time_s[0]
            position = experiment.SPEED_M_PER_S * (time_s - 3.0)
            # The span and a second on either side: integration over more only adds drift.
            part = np.flatnonzero((position > -10.0) & (position < experiment.SPAN_M + 15.0))
            for integrate, name in (
                (newmark_integrate, "trapezoid"),
                (spline_integrate, "spline"),
            ):
                for parts in (1, 2, 4):
                    window = build_window(
                        MeasuredCrossing(
                            np.stack([channel[part] for channel in drive.channels.values()]),
                            1.0 / rate,
                            position[part],
                            1,
                            element_lengths_m=np.full(
                                experiment.ELEMENTS, experiment.SPAN_M / experiment.ELEMENTS
                            ),
                            total_mass_kg=site.vehicles[0].total_mass_kg,
                            wheelbase_m=experiment.TRUCK.wheelbase_m,
                            integrate=integrate,
                            initial_state_known=False,
                            parts=parts,
                        )
                    )
                    found, _, _ = fit(window, np.ones(FREE.size))
                    errors = found / np.concatenate([np.ones(9), ratios, np.ones(3)]) - 1.0
                    table.add_row(
                        str(scenario),
                        f"{rate:g} Hz",
                        name,
                        str(parts),
                        *(f"{100 * error:+.2f} %" for error in errors[9:16]),
                        f"{100 * np.abs(errors[:9]).max():.2f} %",
                    )
    CONSOLE.print(table)


def frequencies(scenarios: tuple[int, ...]) -> None:
    """Print the paper's Table 5 next to the consistent mass matrix, right and with a wrong sign."""
    printed = tables_of_paper()["table5_natural_frequencies_hz"]
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("scenario", "Table 5", "right matrix", "13l/420 flipped", "difference"):
        table.add_column(column, justify="right")

    def add(label: str, theirs: Floats, ratios: Floats) -> None:
        right = natural_frequencies_hz(experiment.beam(ratios), 4)
        flipped = natural_frequencies_hz(experiment.beam(ratios), 4, coupling_sign=-1.0)
        table.add_row(
            label,
            *(" ".join(f"{f:.2f}" for f in row) for row in (theirs, right, flipped)),
            " ".join(f"{f:+.2f}" for f in theirs - flipped),
        )

    for scenario in scenarios:
        theirs = np.array(printed["bridge_by_scenario"][str(scenario)])
        add(str(scenario), theirs, experiment.scenario_ratios(scenario))
        if scenario == 12:
            add("12 with 0.2", theirs, np.array([1, 1, 1, 1, 1, 1, 0.2]))
    CONSOLE.print(table)
    truck = " ".join(f"{f:.2f}" for f in vehicle_frequencies_hz(experiment.TRUCK))
    listed = " ".join(f"{f:.2f}" for f in printed["vehicle"])
    CONSOLE.print(f"vehicle: {listed} in Table 5, {truck} of Table 1's truck")


COMMANDS = {
    "step": (step, "1,6,12"),
    "road": (road, "1,6,12"),
    "length": (length, "1,6,12"),
    "starts": (starts, "1,2,3,4,5,6,7,8,9,10,11,12"),
    "mesh": (mesh, "1,6"),
    "frequencies": (frequencies, "1,2,3,4,5,6,7,8,9,10,11,12"),
}


def main() -> None:
    """Parse the arguments and run one measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=COMMANDS)
    parser.add_argument("--scenarios", default=None)
    options = parser.parse_args()
    command, usual = COMMANDS[options.what]
    command(tuple(int(part) for part in (options.scenarios or usual).split(",")))


if __name__ == "__main__":
    main()
