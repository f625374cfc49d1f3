"""The paper's twelve scenarios, by its own search and by least squares.

Every scenario is simulated as in the paper (seven elements, 1 ms, truck at rest 10 m before the
bridge) and identified on the paper's residual with the paper's integrator and mesh: this shares all
discretisation on purpose, as the paper does, because it is the paper that is being reproduced.
"""

import json
import time
from collections.abc import Callable
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import unknowns
from pre_core.paper import experiment, least_squares, random_walk, residual
from pre_core.paper.crossing import paper_window
from pre_core.paper.residual import Window
from pre_core.physics.bridge import Beam
from pre_core.physics.models import body_masses, from_models
from pre_core.physics.vehicle import HalfCar
from pre_core.search import loop
from schemas.site_file import load_site
from services.common.errors import FailureError, InputError
from services.simulation.drive import beam_of, truck_of

Floats = NDArray[np.float64]

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
    endings: dict[str, loop.Ending]
    seconds: dict[str, float]


def _names(free: NDArray[np.int64]) -> tuple[str, ...]:
    """Names of the columns of `table_columns`: d_1 shows as the two body masses it implies."""
    return (*DERIVED, *(unknowns.names(experiment.ELEMENTS)[i] for i in free if i != unknowns.D_1))


NAMES = _names(unknowns.paper_subset(experiment.ELEMENTS))
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
    progress: Callable[[str, int], None] = lambda text, steps: None,
) -> Scenario:
    """Simulate one scenario and search for its parameters in both ways.

    `progress` is told what is being done and how many steps of the random walk are done more.
    """

    def advance(text: str, by: int) -> None:
        progress(f"scenario {number}: {text}", by)

    ratios = experiment.scenario_ratios(number)
    damaged = sound._replace(flexural_rigidity_nm2=sound.flexural_rigidity_nm2 * ratios)
    try:
        window = paper_window(car, damaged, noise_ug_per_rthz, seed)
    except ArithmeticError as error:
        raise FailureError(f"{error}: are the site's values possible?") from error
    nominal = from_models(car, sound)
    free = unknowns.paper_subset(experiment.ELEMENTS)
    free = free[nominal[free] > 0.0]  # a site may say that a damping is exactly zero
    names = _names(free)
    true_ratio = dict.fromkeys(names, 1.0)
    true_ratio |= {f"EI_{e + 1}": float(ratio) for e, ratio in enumerate(ratios)}

    began = time.perf_counter()
    walk = random_walk.problem(window, nominal, free, seed)
    first = random_walk.init(walk, particles)
    last, _, walk_ending = loop.run(
        lambda: first,
        partial(random_walk.step, walk),
        steps,
        at_the_end=loop.Ending.STEPS_DONE,
        progress=lambda count, info: advance("random walk", 1),
    )
    walked = time.perf_counter()
    advance("least squares", 0)
    problem = least_squares.Problem(window, nominal, free)
    start = np.random.default_rng(np.random.SeedSequence([seed, number])).uniform(
        random_walk.PRIOR_LOW, random_walk.PRIOR_HIGH, free.size
    )
    work = residual.workspace(window)
    best, _, fit_ending = loop.run(
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


def models(site: Path | None) -> tuple[HalfCar, Beam]:
    """Truck and sound bridge of a site file (of the paper's elements), or those of the paper."""
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
    ratios: Floats, *, nominal: Floats, free: NDArray[np.int64], window: Window
) -> Floats:
    """Ratios (k, f) of the unknowns as ratios (k, names) of the paper's tables, see `_names`."""
    theta = np.repeat(nominal[None, :], ratios.shape[0], axis=0)
    theta[:, free] *= ratios
    masses = partial(
        body_masses,
        total_mass_kg=window.total_mass_kg,
        wheelbase_m=window.wheelbase_m,
    )
    derived = (masses(theta) / masses(nominal))[:, 1:]
    return np.column_stack([derived, ratios[:, free != unknowns.D_1]])


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


def accuracy_of_paper(scenario: int, name: str) -> float:
    """S_A of Table 8."""
    return float(tables_of_paper()["table8_accuracy_S_A"][name][scenario - 1])


def compare_with_paper(clouds: dict[int, Cloud]) -> dict[str, int]:
    """How many cells of Table 7 the clouds of these scenarios meet, m_s1 and m_s2 left out."""
    cells = [(n, c, name) for n, c in clouds.items() for name in NAMES if name not in DERIVED]
    means = sum(abs(c.mean[name] - of_paper(n, name)[0]) <= 0.08 for n, c, name in cells)
    stds = sum(abs(c.std[name] - of_paper(n, name)[1]) <= 0.06 for n, c, name in cells)
    return {"cells": len(cells), "mean": means, "std": stds}
