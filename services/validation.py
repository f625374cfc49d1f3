"""`driveby validate`: the paper's twelve scenarios, by its own search and by least squares.

Every scenario is simulated as in the paper (seven elements, 1 ms, truck at rest 10 m before the
bridge) and identified on the paper's residual with the paper's integrator and mesh: this shares all
discretisation on purpose, as the paper does, because it is the paper that is being reproduced.
"""

import json
import time
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import least_squares, paper, parameters, random_walk, residual, search
from pre_core.bridge import Beam
from pre_core.integrate import newmark_integrate
from pre_core.residual import Window
from pre_core.road import iso_8608_profile, under_wheels
from pre_core.simulate import constant_speed, simulate
from pre_core.vehicle import HalfCar, total_mass_kg
from schemas.site import load_site
from services.common.errors import FailureError, InputError
from services.common.files import check_writable, write_atomically
from services.simulation import beam_of, truck_of

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

Floats = NDArray[np.float64]

ROAD_CLASS = "B"
ROAD_SEED = 1
"""The paper's road is not published; docs/reproduction.md says what another one changes."""
_MICRO_G = 9.80665e-6
DERIVED = ("m_s1", "m_s2")


class Cloud(NamedTuple):
    """What a search found, as ratios to the sound values, names as in the paper's tables."""

    mean: dict[str, float]
    std: dict[str, float]
    accuracy: dict[str, float]
    """S_A = 1 - |mean - true ratio| (paper eq. 24)."""
    samples: Floats  # (particles, names); one row if the search has one answer


class Scenario(NamedTuple):
    """Both searches on one scenario; how each ended and how long it took."""

    number: int
    names: tuple[str, ...]
    truth: dict[str, float]
    prior: Floats
    """Where the random walk began: (particles, names)."""
    random_walk: Cloud
    least_squares: Cloud
    endings: dict[str, search.Ending]
    seconds: dict[str, float]


def validate_command(
    *,
    scenarios: tuple[int, ...],
    noise: float,
    json_path: Path | None,
    figures: Path | None,
    seed: int,
    site: Path | None,
    particles: int,
    steps: int,
    console: "Console",
) -> int:
    """Run scenarios, print the table, write what was asked for; 0 also where an aim is missed."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    if json_path is not None:
        check_writable(json_path)
    if figures is not None:
        make_folder(figures)
    car, sound = _models(site)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar as progress:
        task = progress.add_task("starting", total=len(scenarios) * (steps + 1))
        found = [
            run_scenario(
                number,
                car,
                sound,
                noise_ug_per_rthz=noise,
                seed=seed,
                particles=particles,
                steps=steps,
                progress=(progress, task),
            )
            for number in scenarios
        ]
    published = site is None
    print_table(console, found, published=published)
    _print_summary(console, found, published=published, noise=noise)
    if json_path is not None:
        write_atomically(json_path, json.dumps(_as_json(found), indent=1) + "\n")
    if figures is not None:
        from services.viewer.validation_figure import overview_figure, posterior_figure

        for scenario in found:
            path = figures / f"scenario-{scenario.number:02d}.png"
            posterior_figure(path, scenario, scenario.names)
        overview_figure(figures / "scenarios.png", found, tables_of_paper() if published else None)
        console.print(f"figures in {figures}/", highlight=False)
    return 0


def make_folder(path: Path) -> None:
    """Make the folder of the figures; InputError if nothing can be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be made a folder: {error.strerror}") from error
    check_writable(path / "scenarios.png")


def _names(free: NDArray[np.int64]) -> tuple[str, ...]:
    """Names of the columns of `table_columns`: d_1 shows as the two body masses it implies."""
    return (*DERIVED, *(parameters.names(paper.ELEMENTS)[i] for i in free if i != parameters.D_1))


NAMES = _names(parameters.paper_subset(paper.ELEMENTS))
"""The twenty rows of the paper's Tables 7 and 8."""


def run_scenario(
    number: int,
    car: HalfCar,
    sound: Beam,
    *,
    noise_ug_per_rthz: float,
    seed: int,
    particles: int,
    steps: int,
    progress: "tuple[Progress, TaskID] | None" = None,
) -> Scenario:
    """Simulate one scenario and search for its parameters in both ways."""

    def advance(text: str, by: int) -> None:
        if progress is not None:
            bar, task = progress
            bar.update(task, description=f"scenario {number}: {text}", advance=by)

    ratios = paper.scenario_ratios(number)
    damaged = sound._replace(flexural_rigidity_nm2=sound.flexural_rigidity_nm2 * ratios)
    window = paper_window(car, damaged, noise_ug_per_rthz, seed)
    nominal = parameters.from_models(car, sound)
    free = parameters.paper_subset(paper.ELEMENTS)
    free = free[nominal[free] > 0.0]  # a site may say that a damping is exactly zero
    names = _names(free)
    true_ratio = dict.fromkeys(names, 1.0)
    true_ratio |= {f"EI_{e + 1}": float(ratio) for e, ratio in enumerate(ratios)}

    began = time.perf_counter()
    walk = random_walk.problem(window, nominal, free, seed)
    first = random_walk.init(walk, particles)
    last, _, walk_ending = search.run(
        lambda: first,
        partial(random_walk.step, walk),
        steps,
        at_the_end=search.Ending.STEPS_DONE,
        progress=lambda count, info: advance("random walk", 1),
    )
    walked = time.perf_counter()
    advance("least squares", 0)
    problem = least_squares.Problem(window, nominal, free)
    start = np.random.default_rng(np.random.SeedSequence([seed, number])).uniform(
        random_walk.PRIOR_LOW, random_walk.PRIOR_HIGH, free.size
    )
    work = residual.workspace(window)
    best, _, fit_ending = search.run(
        partial(least_squares.init, problem, work, nominal[free] * start),
        partial(least_squares.step, problem, work),
        least_squares.MAX_STEPS,
    )
    fitted = time.perf_counter()
    advance("least squares", 1)
    columns = partial(table_columns, nominal=nominal, free=free, window=window)
    return Scenario(
        number,
        names,
        true_ratio,
        columns(first.ratios),
        cloud_of(columns(last.ratios), names, true_ratio),
        cloud_of(
            columns(least_squares.untransform(problem, best.y)[None, :] / nominal[free]),
            names,
            true_ratio,
        ),
        {"random_walk": walk_ending, "least_squares": fit_ending},
        {"random_walk": walked - began, "least_squares": fitted - walked},
    )


def paper_window(
    car: HalfCar,
    beam: Beam,
    noise_ug_per_rthz: float,
    seed: int,
    *,
    road: tuple[str, int] = (ROAD_CLASS, ROAD_SEED),
) -> Window:
    """One crossing of the paper's experiment (Table 4), with white sensor noise if asked for.

    `road` is an ISO 8608 class and the seed of its phases.
    """
    span = float(beam.element_lengths_m.sum())
    travel = span + car.wheelbase_m - paper.FRONT_AXLE_START_M
    steps = round(travel / paper.SPEED_M_PER_S / paper.STEP_S) + 10
    motion = constant_speed(paper.FRONT_AXLE_START_M, paper.SPEED_M_PER_S, steps, paper.STEP_S)
    reach = np.ceil(car.wheelbase_m) + 1.0
    begin, end = paper.FRONT_AXLE_START_M - reach, np.ceil(span + reach)
    profile = iso_8608_profile(begin, end, 0.01, *road)
    felt = under_wheels(profile, motion, car.wheelbase_m, 1)
    run = simulate(car, beam, motion, felt, paper.STEP_S)
    if not run.converged:
        raise FailureError("the simulation did not converge: are the site's values possible?")
    acceleration = np.ascontiguousarray(run.acceleration_m_per_s2.T)
    if noise_ug_per_rthz > 0.0:
        sigma = noise_ug_per_rthz * _MICRO_G * np.sqrt(0.5 / paper.STEP_S)
        rng = np.random.default_rng(np.random.SeedSequence([seed, 0x6E]))
        acceleration = acceleration + sigma * rng.standard_normal(acceleration.shape)
    return residual.build_window(
        acceleration,
        paper.STEP_S,
        motion.position_m,
        1,
        element_lengths_m=beam.element_lengths_m,
        total_mass_kg=total_mass_kg(car),
        wheelbase_m=car.wheelbase_m,
        integrate=newmark_integrate,
        initial_state_known=True,
    )


def _models(site: Path | None) -> tuple[HalfCar, Beam]:
    if site is None:
        return paper.TRUCK, paper.beam(np.ones(paper.ELEMENTS))
    known = load_site(site)
    bridge = known.bridges[0]
    if bridge.elements != paper.ELEMENTS:
        raise InputError(
            f"{site}: bridge {bridge.id} has {bridge.elements} elements, the paper's scenarios are "
            f"of {paper.ELEMENTS}"
        )
    return truck_of(known.vehicles[0]), beam_of(bridge, np.ones(bridge.elements))


def table_columns(
    ratios: Floats, *, nominal: Floats, free: NDArray[np.int64], window: Window
) -> Floats:
    """Ratios (k, f) of the unknowns as ratios (k, names) of the paper's tables, see `_names`."""
    theta = np.repeat(nominal[None, :], ratios.shape[0], axis=0)
    theta[:, free] *= ratios
    masses = partial(
        parameters.body_masses,
        total_mass_kg=window.total_mass_kg,
        wheelbase_m=window.wheelbase_m,
    )
    derived = (masses(theta) / masses(nominal))[:, 1:]
    return np.column_stack([derived, ratios[:, free != parameters.D_1]])


def cloud_of(columns: Floats, names: tuple[str, ...], truth: dict[str, float]) -> Cloud:
    """Mean, standard deviation and S_A of columns (k, names)."""
    mean = dict(zip(names, columns.mean(axis=0).tolist(), strict=True))
    std = dict(zip(names, columns.std(axis=0).tolist(), strict=True))
    return Cloud(mean, std, {name: 1.0 - abs(mean[name] - truth[name]) for name in names}, columns)


@cache
def tables_of_paper() -> dict[str, Any]:
    """The paper's tables as data; CC BY 4.0, see services/data/README.md."""
    text = resources.files("services").joinpath("data/paper_tables.json").read_text("utf-8")
    tables: dict[str, Any] = json.loads(text)
    return tables


def of_paper(scenario: int, name: str) -> tuple[float, float]:
    """Mean and standard deviation of Table 7."""
    row = tables_of_paper()["table7_normalised_estimates"][name]
    return row["mean"][scenario - 1], row["std"][scenario - 1]


def _accuracy_of_paper(scenario: int, name: str) -> float:
    """S_A of Table 8."""
    return float(tables_of_paper()["table8_accuracy_S_A"][name][scenario - 1])


def print_table(console: "Console", found: list[Scenario], *, published: bool) -> None:
    """One row for every scenario and parameter, at most 80 characters wide; weak ones in bold."""
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
                row.append(f"{_accuracy_of_paper(scenario.number, name):.2f}")
            row.append(f"{walk.mean[name]:.2f} ± {walk.std[name]:.2f}")
            accuracy = walk.accuracy[name]
            row.append(f"{accuracy:.2f}" if accuracy >= 0.0 else f"{accuracy:.1f}")
            row.append(_ratio(ours.mean[name]))
            row.append(_ratio(ours.accuracy[name]))
            table.add_row(*row, style="bold" if scenario.truth[name] != 1.0 else None)
    console.print(table)


def _ratio(value: float) -> str:
    """At most six characters: four decimals of what is near one, less of what went astray."""
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
        if ending not in (search.Ending.CONVERGED, search.Ending.STEPS_DONE)
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


def compare_with_paper(clouds: dict[int, Cloud]) -> dict[str, int]:
    """How many cells of Table 7 the clouds of these scenarios meet, m_s1 and m_s2 left out."""
    cells = [(n, c, name) for n, c in clouds.items() for name in NAMES if name not in DERIVED]
    means = sum(abs(c.mean[name] - of_paper(n, name)[0]) <= 0.08 for n, c, name in cells)
    stds = sum(abs(c.std[name] - of_paper(n, name)[1]) <= 0.06 for n, c, name in cells)
    return {"cells": len(cells), "mean": means, "std": stds}


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
