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
    samples: Floats | None  # (particles, 20), for the figure


class Scenario(NamedTuple):
    """Both searches on one scenario."""

    number: int
    truth: dict[str, float]
    random_walk: Cloud
    least_squares: Cloud
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
    """Run the scenarios, print the table and write what was asked for; 0 also if aims are missed."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    if json_path is not None:
        check_writable(json_path)
    car, sound = _models(site)
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn(), console=console
    )
    found = []
    with bar as progress:
        task = progress.add_task("starting", total=len(scenarios) * (steps + 1))
        for number in scenarios:
            found.append(
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
            )
    published = site is None
    _print(console, found, published=published)
    _print_summary(console, found, published=published, noise=noise)
    if json_path is not None:
        write_atomically(json_path, json.dumps(_as_json(found), indent=1) + "\n")
    if figures is not None:
        from services.viewer.validation_figure import overview_figure, posterior_figure

        figures.mkdir(parents=True, exist_ok=True)
        for scenario in found:
            posterior_figure(figures / f"scenario-{scenario.number:02d}.png", scenario, NAMES)
        overview_figure(figures / "scenarios.png", found, _published() if published else None)
        console.print(f"figures in {figures}/", highlight=False)
    return 0


NAMES = (
    *DERIVED,
    *(
        parameters.names(paper.ELEMENTS)[i]
        for i in parameters.paper_subset(paper.ELEMENTS)
        if parameters.names(paper.ELEMENTS)[i] != "d_1"
    ),
)
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
    true_ratio = dict.fromkeys(NAMES, 1.0)
    true_ratio |= {f"EI_{e + 1}": float(ratio) for e, ratio in enumerate(ratios)}

    began = time.perf_counter()
    walk = random_walk.problem(window, nominal, free, seed)
    state, _, _ = search.run(
        partial(random_walk.init, walk, particles),
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
    best, _, _ = search.run(
        partial(least_squares.init, problem, work, nominal[free] * start),
        partial(least_squares.step, problem, work),
        least_squares.MAX_STEPS,
    )
    fitted = time.perf_counter()
    advance("least squares", 1)
    estimate = least_squares.untransform(problem, best.y) / nominal[free]
    slope = least_squares.derivative_of_values(problem, best.y) / nominal[free]
    formal = np.sqrt(np.diag(least_squares.covariance(best))) * slope
    ours = _cloud(estimate[None, :], nominal, free, window, true_ratio)
    spread = {
        name: float(formal[k])
        for k, i in enumerate(free)
        if (name := parameters.names(paper.ELEMENTS)[i]) in ours.std
    }
    return Scenario(
        number,
        true_ratio,
        _cloud(state.ratios, nominal, free, window, true_ratio),
        ours._replace(std=spread, samples=None),
        {"random_walk": walked - began, "least_squares": fitted - walked},
    )


def paper_window(car: HalfCar, beam: Beam, noise_ug_per_rthz: float, seed: int) -> Window:
    """One crossing of the paper's experiment (Table 4), with white sensor noise if asked for."""
    span = float(beam.element_lengths_m.sum())
    travel = span + car.wheelbase_m - paper.FRONT_AXLE_START_M
    steps = round(travel / paper.SPEED_M_PER_S / paper.STEP_S) + 10
    motion = constant_speed(paper.FRONT_AXLE_START_M, paper.SPEED_M_PER_S, steps, paper.STEP_S)
    reach = np.ceil(car.wheelbase_m) + 1.0
    road = iso_8608_profile(
        paper.FRONT_AXLE_START_M - reach, np.ceil(span + reach), 0.01, ROAD_CLASS, ROAD_SEED
    )
    run = simulate(car, beam, motion, under_wheels(road, motion, car.wheelbase_m, 1), paper.STEP_S)
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


def _cloud(
    ratios: Floats, nominal: Floats, free: NDArray[np.int64], window: Window, truth: dict[str, float]
) -> Cloud:
    theta = np.repeat(nominal[None, :], ratios.shape[0], axis=0)
    theta[:, free] *= ratios
    masses = partial(
        parameters.body_masses,
        total_mass_kg=window.total_mass_kg,
        wheelbase_m=window.wheelbase_m,
    )
    columns = dict(zip(DERIVED, (masses(theta) / masses(nominal))[:, 1:].T, strict=True))
    names = parameters.names(paper.ELEMENTS)
    columns |= {names[i]: ratios[:, k] for k, i in enumerate(free)}
    mean = {name: float(columns[name].mean()) for name in NAMES}
    return Cloud(
        mean,
        {name: float(columns[name].std()) for name in NAMES},
        {name: 1.0 - abs(mean[name] - truth[name]) for name in NAMES},
        np.stack([columns[name] for name in NAMES], axis=1),
    )


@cache
def _published() -> dict[str, Any]:
    """The paper's tables as data; CC BY 4.0, see services/data/README.md."""
    text = resources.files("services").joinpath("data/paper_tables.json").read_text("utf-8")
    tables: dict[str, Any] = json.loads(text)
    return tables


def _of_paper(scenario: int, name: str) -> tuple[float, float]:
    """Mean and standard deviation of Table 7."""
    row = _published()["table7_normalised_estimates"][name]
    return row["mean"][scenario - 1], row["std"][scenario - 1]


def _print(console: "Console", found: list[Scenario], *, published: bool) -> None:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    columns = ["scenario", "parameter", "truth", "paper", "random walk", "ours", "S_A of ours"]
    if not published:
        columns.remove("paper")
    for column in columns:
        table.add_column(column, justify="left" if column == "parameter" else "right")
    for scenario in found:
        for row, name in enumerate(NAMES):
            walk, ours = scenario.random_walk, scenario.least_squares
            paper_value = ["{:.2f} ± {:.2f}".format(*_of_paper(scenario.number, name))]
            table.add_row(
                str(scenario.number) if row == 0 else "",
                name,
                f"{scenario.truth[name]:.2f}",
                *(paper_value if published else []),
                f"{walk.mean[name]:.2f} ± {walk.std[name]:.2f}",
                f"{ours.mean[name]:.4f}",
                f"{ours.accuracy[name]:.4f}",
                end_section=row == len(NAMES) - 1,
            )
    console.print(table)


def _print_summary(
    console: "Console", found: list[Scenario], *, published: bool, noise: float
) -> None:
    worst = min(
        (accuracy, name, scenario.number)
        for scenario in found
        for name, accuracy in scenario.least_squares.accuracy.items()
    )
    count = len(found) * len(NAMES)
    exact = sum(
        accuracy >= 0.999
        for scenario in found
        for accuracy in scenario.least_squares.accuracy.values()
    )
    lines = [
        f"least squares: S_A ≥ 0.999 in {exact} of {count}; the least is {worst[0]:.6f} "
        f"({worst[1]}, scenario {worst[2]})"
    ]
    if published:
        close = compare_with_paper(found)
        lines.append(
            f"random walk: of {close['cells']} cells (m_s1 and m_s2 follow the road and are left "
            f"out) {close['std']} standard deviations within 0.06 of Table 7 and {close['mean']} "
            "means within 0.08"
        )
    seconds = {
        method: [scenario.seconds[method] for scenario in found] for method in found[0].seconds
    }
    lines.append(
        f"median seconds a scenario: random walk {np.median(seconds['random_walk']):.1f}, "
        f"least squares {np.median(seconds['least_squares']):.2f}"
    )
    if noise > 0.0:
        lines.append(f"accelerometer noise {noise:g} µg/√Hz")
    for line in lines:
        console.print(line, highlight=False)


def compare_with_paper(found: list[Scenario]) -> dict[str, int]:
    """How many cells of Table 7 the random walk meets, m_s1 and m_s2 left out."""
    cells = [(s, name) for s in found for name in NAMES if name not in DERIVED]
    means = sum(
        abs(s.random_walk.mean[name] - _of_paper(s.number, name)[0]) <= 0.08 for s, name in cells
    )
    stds = sum(
        abs(s.random_walk.std[name] - _of_paper(s.number, name)[1]) <= 0.06 for s, name in cells
    )
    return {"cells": len(cells), "mean": means, "std": stds}


def _as_json(found: list[Scenario]) -> dict[str, Any]:
    return {
        "scenarios": {
            str(scenario.number): {
                "truth": scenario.truth,
                "least_squares": {
                    "S_A": scenario.least_squares.accuracy,
                    "mean": scenario.least_squares.mean,
                    "seconds": scenario.seconds["least_squares"],
                },
                "random_walk": {
                    "S_A": scenario.random_walk.accuracy,
                    "mean": scenario.random_walk.mean,
                    "std": scenario.random_walk.std,
                    "seconds": scenario.seconds["random_walk"],
                },
            }
            for scenario in found
        }
    }
