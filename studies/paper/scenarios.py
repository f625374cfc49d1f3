"""The paper's twelve scenarios, by its own search and by least squares.

Every scenario is simulated as in the paper (seven elements, 1 ms, truck at rest 10 m before the
bridge) and identified on the paper's residual with the paper's integrator and mesh: all
discretisation is shared on purpose, as in the paper that is being reproduced.
"""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import parameters
from pre_core.paper import experiment, least_squares, random_walk, residual
from pre_core.paper.crossing import paper_window
from pre_core.paper.window import PaperWindow
from pre_core.physics.bridge import Beam
from pre_core.physics.models import body_masses, from_models
from pre_core.physics.vehicle import HalfCar
from pre_core.search import loop
from schemas.site_file import load_site
from services.common.arrays import Floats
from services.common.errors import FailureError, InputError
from services.simulation.drive import beam_of, truck_of
from services.simulation.validation_options import ScenarioOptions
from studies.paper.tables import of_paper

DERIVED = ("m_s1", "m_s2")


class Cloud(NamedTuple):
    """Result of a search, as ratios to the undamaged values, with names of the paper's tables."""

    mean: dict[str, float]
    std: dict[str, float]
    accuracy: dict[str, float]
    """Accuracy S_A = 1 - |mean - true ratio| (paper eq. 24)."""
    samples: Floats  # (particles, names); one row if the search has one answer


class Scenario(NamedTuple):
    """Both searches on one scenario, with their terminations and durations."""

    number: int
    names: tuple[str, ...]
    truth: dict[str, float]
    prior: Floats
    """Start of the random walk: (particles, names)."""
    random_walk: Cloud
    least_squares: Cloud
    endings: dict[str, loop.Termination]
    seconds: dict[str, float]


def _names(free: NDArray[np.int64]) -> tuple[str, ...]:
    """Return names of the columns of `table_columns`: d_1 appears as two body masses."""
    return (
        *DERIVED,
        *(parameters.names(experiment.ELEMENTS)[i] for i in free if i != parameters.D_1),
    )


NAMES = _names(parameters.paper_subset(experiment.ELEMENTS))
"""The twenty rows of the paper's Tables 7 and 8."""


def run_scenario(
    number: int,
    car: HalfCar,
    undamaged: Beam,
    asked: ScenarioOptions,
    progress: Callable[[str, int], None] = lambda text, steps: None,
) -> Scenario:
    """Simulate one scenario and search for its parameters in both ways.

    `progress` is called with the present activity and the number of further random-walk steps.
    """

    def advance(text: str, by: int) -> None:
        progress(f"scenario {number}: {text}", by)

    ratios = experiment.scenario_ratios(number)
    damaged = undamaged._replace(flexural_rigidity_nm2=undamaged.flexural_rigidity_nm2 * ratios)
    try:
        window = paper_window(car, damaged, asked.noise, asked.seed)
    except ArithmeticError as error:
        raise FailureError(f"{error}: are the site's values possible?") from error
    nominal = from_models(car, undamaged)
    free = parameters.paper_subset(experiment.ELEMENTS)
    free = free[nominal[free] > 0.0]  # a site may declare a damping of exactly zero
    names = _names(free)
    true_ratio = dict.fromkeys(names, 1.0)
    true_ratio |= {f"EI_{e + 1}": float(ratio) for e, ratio in enumerate(ratios)}

    began = time.perf_counter()
    walk = random_walk.problem(window, nominal, free, asked.seed)
    first = random_walk.init(walk, asked.particles)
    last, _, walk_ending = loop.run_search(
        lambda: first,
        partial(random_walk.step, walk),
        asked.steps,
        at_limit=loop.Termination.STEPS_DONE,
        progress=lambda count, info: advance("random walk", 1),
    )
    walked = time.perf_counter()
    advance("least squares", 0)
    start = np.random.default_rng(np.random.SeedSequence([asked.seed, number])).uniform(
        random_walk.PRIOR_LOW, random_walk.PRIOR_HIGH, free.size
    )
    theta, fit_ending = _least_squares(window, nominal, free, nominal[free] * start)
    fitted = time.perf_counter()
    advance("least squares", 1)
    columns = partial(table_columns, nominal=nominal, free=free, window=window)
    return Scenario(
        number,
        names,
        true_ratio,
        columns(first.ratios),
        cloud_of(columns(last.ratios), names, true_ratio),
        cloud_of(columns(theta[None, :] / nominal[free]), names, true_ratio),
        {"random_walk": walk_ending, "least_squares": fit_ending},
        {"random_walk": walked - began, "least_squares": fitted - walked},
    )


def _least_squares(
    window: PaperWindow, nominal: Floats, free: NDArray[np.int64], start: Floats
) -> tuple[Floats, loop.Termination]:
    """Return the estimate of the free parameters (f,) from a start (f,), and how it ended."""
    problem = least_squares.LeastSquaresProblem(window, nominal, free)
    work = residual.workspace(window)
    best, _, ending = loop.run_search(
        partial(least_squares.init, problem, work, start),
        partial(least_squares.step, problem, work),
        least_squares.MAX_STEPS,
    )
    return least_squares.untransform(problem, best.y), ending


def models(site: Path | None) -> tuple[HalfCar, Beam]:
    """Return truck and undamaged bridge of a site file, or those of the paper."""
    if site is None:
        return experiment.TRUCK, experiment.beam(np.ones(experiment.ELEMENTS))
    known = load_site(site)
    bridge = known.bridges[0]
    if bridge.elements != experiment.ELEMENTS:
        raise InputError(
            f"{site}: bridge {bridge.id} has {bridge.elements} elements, the paper's scenarios are "
            f"of {experiment.ELEMENTS}"
        )
    if bridge.interior_supports_m:
        raise InputError(
            f"{site}: bridge {bridge.id} has interior_supports_m, the paper's methods are for a "
            "single span"
        )
    return truck_of(known.vehicles[0]), beam_of(bridge, np.ones(bridge.elements))


def table_columns(
    ratios: Floats, *, nominal: Floats, free: NDArray[np.int64], window: PaperWindow
) -> Floats:
    """Return ratios (k, f) of the parameters as ratios (k, names) of the paper's tables."""
    theta = np.repeat(nominal[None, :], ratios.shape[0], axis=0)
    theta[:, free] *= ratios
    masses = partial(
        body_masses,
        total_mass_kg=window.total_mass_kg,
        wheelbase_m=window.wheelbase_m,
    )
    derived = (masses(theta) / masses(nominal))[:, 1:]
    return np.column_stack([derived, ratios[:, free != parameters.D_1]])


def cloud_of(columns: Floats, names: tuple[str, ...], truth: dict[str, float]) -> Cloud:
    """Return mean, standard deviation and S_A of columns (k, names)."""
    mean = dict(zip(names, columns.mean(axis=0).tolist(), strict=True))
    std = dict(zip(names, columns.std(axis=0).tolist(), strict=True))
    return Cloud(mean, std, {name: 1.0 - abs(mean[name] - truth[name]) for name in names}, columns)


def compare_with_paper(clouds: dict[int, Cloud]) -> dict[str, int]:
    """Return how many cells of Table 7 these clouds meet, without m_s1 and m_s2."""
    cells = [(n, c, name) for n, c in clouds.items() for name in NAMES if name not in DERIVED]
    means = sum(abs(c.mean[name] - of_paper(n, name)[0]) <= 0.08 for n, c, name in cells)
    stds = sum(abs(c.std[name] - of_paper(n, name)[1]) <= 0.06 for n, c, name in cells)
    return {"cells": len(cells), "mean": means, "std": stds}
