"""The work that is timed, set up once for all benchmarks."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import parameters
from pre_core.paper import crossing, experiment, random_walk, residual
from pre_core.paper.integrate import newmark_integrate
from pre_core.paper.window import MeasuredCrossing, PaperWindow, build_window
from pre_core.physics.bridge import Beam
from pre_core.physics.models import body_masses, from_models
from pre_core.physics.road import iso_8608_profile, under_wheels
from pre_core.physics.simulate import Motion, WheelRoad, constant_speed
from pre_core.physics.vehicle import total_mass_kg

Floats = NDArray[np.float64]

SCENARIO = 6
FREE = parameters.paper_subset(experiment.ELEMENTS)
NOMINAL = from_models(experiment.TRUCK, experiment.beam(np.ones(experiment.ELEMENTS)))


@cache
def paper_window(scenario: int) -> PaperWindow:
    """One crossing of the paper: 14 degrees of freedom, 1 ms, no noise."""
    beam = experiment.beam(experiment.scenario_ratios(scenario))
    return crossing.paper_window(experiment.TRUCK, beam, 0.0, 1)


def particles(count: int, seed: int = 0) -> Floats:
    """Vectors of parameters (count, p) from the range in which the paper's search starts."""
    return full(start_ratios(count, seed))


def start_ratios(count: int, seed: int = 0) -> Floats:
    """Ratios (count, 19) to the undamaged values, uniform in 0.8 to 1.2."""
    rng = np.random.default_rng(seed)
    return rng.uniform(random_walk.PRIOR_LOW, random_walk.PRIOR_HIGH, (count, FREE.size))


def full(ratios: Floats) -> Floats:
    """All parameters (k, p) for ratios (k, 19)."""
    theta = np.repeat(NOMINAL[None, :], ratios.shape[0], axis=0)
    theta[:, FREE] *= ratios
    return theta


def accuracy(ratios: Floats, scenario: int) -> Floats:
    """S_A (20,) of one vector of ratios (19,): the paper's twenty rows, m_s1 and m_s2 derived."""
    window = paper_window(scenario)
    masses = [
        body_masses(theta, window.total_mass_kg, window.wheelbase_m)[1:]
        for theta in (full(ratios[None, :])[0], NOMINAL)
    ]
    truth = np.ones(FREE.size)
    rigidities = slice(parameters.EI_1, parameters.EI_1 + experiment.ELEMENTS)
    places = np.flatnonzero((rigidities.start <= FREE) & (rigidities.stop > FREE))
    truth[places] = experiment.scenario_ratios(scenario)
    off = np.abs(ratios - truth)[FREE != parameters.D_1]
    return np.asarray(1.0 - np.concatenate([np.abs(masses[0] / masses[1] - 1.0), off]))


class Drive(NamedTuple):
    """What `simulate` is given for one crossing of the paper."""

    beam: Beam
    motion: Motion
    road: WheelRoad


@cache
def paper_drive() -> Drive:
    """The paper's truck from 10 m before the bridge until its rear axle has left it."""
    beam = experiment.beam(experiment.scenario_ratios(SCENARIO))
    travel = experiment.SPAN_M + experiment.TRUCK.wheelbase_m - experiment.FRONT_AXLE_START_M
    steps = round(travel / experiment.SPEED_M_PER_S / experiment.STEP_S)
    motion = constant_speed(
        experiment.FRONT_AXLE_START_M, experiment.SPEED_M_PER_S, steps, experiment.STEP_S
    )
    road = iso_8608_profile(-16.0, 46.0, 0.01, "B", 1)
    return Drive(beam, motion, under_wheels(road, motion, experiment.TRUCK.wheelbase_m, 1))


def noise_window(
    *,
    elements: int = experiment.ELEMENTS,
    parts: int = 1,
    coordinates: int | None = None,
    speed_m_per_s: float = experiment.SPEED_M_PER_S,
) -> PaperWindow:
    """A crossing of the paper's span whose signals are noise: an evaluation takes as long."""
    travel = experiment.SPAN_M + experiment.TRUCK.wheelbase_m + 1.0
    steps = round(travel / speed_m_per_s / experiment.STEP_S)
    motion = constant_speed(-0.5, speed_m_per_s, steps, experiment.STEP_S)
    return build_window(
        MeasuredCrossing(
            np.random.default_rng(0).standard_normal((4, steps)),
            experiment.STEP_S,
            motion.position_m,
            1,
            element_lengths_m=np.full(elements, experiment.SPAN_M / elements),
            total_mass_kg=total_mass_kg(experiment.TRUCK),
            wheelbase_m=experiment.TRUCK.wheelbase_m,
            integrate=newmark_integrate,
            initial_state_known=True,
            parts=parts,
            coordinates=coordinates,
        )
    )


def noise_particles(count: int, elements: int) -> Floats:
    """Vectors of parameters (count, elements + 15) for `noise_window`."""
    beam = experiment.beam(np.ones(experiment.ELEMENTS))._replace(
        element_lengths_m=np.full(elements, experiment.SPAN_M / elements),
        flexural_rigidity_nm2=np.full(elements, experiment.FLEXURAL_RIGIDITY_NM2),
        mass_per_length_kg_per_m=np.full(elements, experiment.MASS_PER_LENGTH_KG_PER_M),
    )
    nominal = from_models(experiment.TRUCK, beam)
    return np.asarray(nominal * np.random.default_rng(0).uniform(0.8, 1.2, (count, nominal.size)))


class Objective:
    """J of ratios for any search, on all cores: counts evaluations, remembers the best."""

    def __init__(self, scenario: int, threads: int = 2) -> None:
        self.scenario = scenario
        self.evaluations = 0
        self.best = np.inf
        self.best_ratios = np.ones(FREE.size)
        self._window = paper_window(scenario)
        self._work = [residual.workspace(self._window) for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads)

    def __call__(self, ratios: Floats) -> Floats:
        """J (k,) of ratios (k, 19); infinite where a value is not physical."""
        theta = full(ratios)
        total = np.full(ratios.shape[0], np.inf)
        physical = np.all(ratios > 0.0, axis=1) & np.all(np.isfinite(ratios), axis=1)
        physical &= theta[:, parameters.D_1] < self._window.wheelbase_m
        chosen = np.flatnonzero(physical)
        total[chosen] = self._batch(theta[chosen])
        self.evaluations += ratios.shape[0]
        first = int(np.argmin(total))
        if total[first] < self.best:
            self.best = float(total[first])
            self.best_ratios = ratios[first].copy()
        return total

    def _batch(self, theta: Floats) -> Floats:
        count, threads = theta.shape[0], len(self._work)
        total = np.empty(count)
        limit = np.full(count, np.inf)
        blocks = -(-count // 4)
        cuts = (np.linspace(0, blocks, threads + 1).astype(int) * 4).tolist()

        def part(i: int) -> None:
            mine = slice(cuts[i], min(cuts[i + 1], count))
            if mine.start < mine.stop:
                residual.objective_batch(
                    self._window, self._work[i], theta[mine], limit[mine], total[mine]
                )

        list(self._pool.map(part, range(threads)))
        return total

    def worst_accuracy(self) -> float:
        """The least S_A of the best vector so far."""
        return float(accuracy(self.best_ratios, self.scenario).min())

    def close(self) -> None:
        """Let the threads go."""
        self._pool.shutdown()


def slope(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Exponent k of seconds ~ size^k, fitted on log axes."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
