"""Method `pre`: from one crossing's signals to the optimum of its posterior.

The posterior has one deep minimum and many shallow ones: with every element free, a bridge that is
put half a metre too far can be explained almost as well by other rigidities. So the search first
lets the bridge change only as a whole, with the data taken for far noisier than they are, and frees
the elements once the trajectory is found; and it starts from several places along the road.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pre_core import least_squares
from pre_core.bridge import FloatArray
from pre_core.channels import channel_signals
from pre_core.drs import beam_basis
from pre_core.least_squares import Rows
from pre_core.parameters import D_1, EI_1, KAPPA, M_U1
from pre_core.posterior import (
    Fixes,
    Priors,
    Problem,
    all_rows,
    covariance,
    data_rows,
    layout,
    points,
    precision_root,
    start,
    trajectory_basis,
)
from pre_core.pre_model import Crossing, workspace
from pre_core.search import Ending
from pre_core.simulate import STANDARD_GRAVITY_M_PER_S2
from pre_core.whitening import RowFilter, Whitener, row_filter, whitener

HIGHEST_HZ = 80.0
"""Rows are used up to here: sensor noise in the rows grows with the square of the frequency and
drowns what lies above."""
_RATE_SHARE = 0.4  # of the sampling rate, where that is lower
_KNOT_S = 0.4
_MARGIN_M = 3.0  # of road before the first row, for the trajectory to move
_COARSE = ((300.0, 4), (100.0, 4), (30.0, 4))
_WHOLE = ((10.0, 8), (3.0, 8))
_FREE = ((5.0, 8), (1.0, 15))
"""Temperatures (noise is taken for this many times what it is) and the steps at each."""
_ACCEPTED_CHI2 = 1.2
_SHIFTS_M = (0.0, -0.6, 0.6, -1.2, 1.2, -1.8, 1.8, -2.4, 2.4, -3.0, 3.0, -3.6, 3.6)

Report = Callable[[str, float], None]


class Inputs(NamedTuple):
    """One crossing as method `pre` takes it; times in s on one clock, chainage in m."""

    acceleration_m_per_s2: FloatArray  # (4, n)
    start_s: float
    step_s: float
    direction: int
    span_m: float
    element_lengths_m: FloatArray
    total_mass_kg: float
    cg_height_m: float
    density_m_per_s2_per_rthz: FloatArray  # (4,) one-sided
    slowest_rate_hz: float
    fixes: Fixes
    priors: Priors
    parts: int
    threads: int


class Optimum(NamedTuple):
    """Where the search ended; `chi2_per_dof` is of the data against the declared noise."""

    problem: Problem
    state: least_squares.State
    ending: Ending
    chi2_per_dof: float
    evaluations: int
    shifts: int
    """How many starting places along the road were tried."""


def prepare(inputs: Inputs) -> tuple[Problem, FloatArray]:
    """The problem and the coordinates of its nominal start."""
    n = inputs.acceleration_m_per_s2.shape[1]
    basis = beam_basis(inputs.element_lengths_m, inputs.parts)
    position, speeding, rows, values, best = trajectory_basis(
        inputs.fixes, inputs.start_s, inputs.step_s, n, inputs.direction, _KNOT_S
    )
    front = position @ best[:-1]
    travel = front if inputs.direction > 0 else inputs.span_m - front
    wheelbase = inputs.priors.wheelbase_m
    first = int(np.searchsorted(travel - wheelbase, travel[0] + _MARGIN_M))
    crossing = Crossing(
        inputs.step_s,
        channel_signals(inputs.acceleration_m_per_s2, inputs.step_s),
        inputs.direction,
        inputs.span_m,
        inputs.total_mass_kg,
        inputs.cg_height_m,
        STANDARD_GRAVITY_M_PER_S2,
        basis,
        np.concatenate([[0.0], np.cumsum(basis.lengths_m)]),
        first,
        n - first,
    )
    highest = min(HIGHEST_HZ, _RATE_SHARE * inputs.slowest_rate_hz)
    row = row_filter(inputs.step_s, highest)
    theta = inputs.priors.theta
    problem = Problem(
        crossing,
        inputs.priors,
        row,
        _noise(row, crossing, theta, wheelbase, inputs.density_m_per_s2_per_rthz),
        inputs.density_m_per_s2_per_rthz,
        position,
        speeding,
        rows,
        values,
        (theta > 0.0) | (np.arange(theta.size) >= theta.size - 2),
        tuple(workspace(crossing, theta.size) for _ in range(inputs.threads)),
    )
    return problem, start(problem, best)


def _noise(
    rows: RowFilter, crossing: Crossing, theta: FloatArray, wheelbase: float, density: FloatArray
) -> Whitener:
    d_1 = theta[D_1]
    d_2 = wheelbase - d_1
    m_s = crossing.total_mass_kg - theta[M_U1] - theta[M_U1 + 1]
    inertia = theta[KAPPA] * m_s * d_1 * d_2
    masses = ((m_s * d_2**2 + inertia) / wheelbase**2, (m_s * d_1**2 + inertia) / wheelbase**2)
    count = (crossing.rows - rows.taps.size) // rows.every + 1
    return whitener(rows, count, theta, masses, density)


def with_noise_at(problem: Problem, y: FloatArray) -> Problem:
    """The problem with the noise as it is for the truck at y: its filter depends on the truck."""
    at = points(problem, y[None, :])
    noise = _noise(
        problem.rows, problem.crossing, at.theta[0], float(at.wheelbase_m[0]), problem.density
    )
    return problem._replace(noise=noise)


def chi2_per_dof(problem: Problem, y: FloatArray) -> float:
    """Mean square of the white rows; each of the trajectory's and truck's unknowns takes one."""
    rows = data_rows(problem, y[None, :])[0]
    return float(rows @ rows) / max(1, rows.size - y.size)


def _tempered(problem: Problem, y: FloatArray, directions: FloatArray, temperature: float) -> Rows:
    count = problem.noise.factor.shape[0]

    def rows(v: FloatArray) -> FloatArray:
        values = all_rows(problem, y + v @ directions.T)
        values[:, :count] /= temperature
        return values

    return rows


def _descend(
    problem: Problem,
    y: FloatArray,
    directions: FloatArray,
    temperature: float,
    steps: int,
    enough: float,
) -> tuple[FloatArray, least_squares.State, Ending, int]:
    """Least squares along `directions` (f, d) from y; `enough` is a gain not worth a step."""
    rows = _tempered(problem, y, directions, temperature)
    state = least_squares.begin(rows, np.zeros(directions.shape[1]))
    evaluations = directions.shape[1] + 1
    ending = Ending.STEPS_EXHAUSTED
    for _ in range(steps):
        before = state.objective
        state, info = least_squares.descend(rows, state)
        evaluations += info.evaluations
        if info.ending is not None:
            # Where no step helps any more, differences have reached their rounding: the bottom.
            ending = Ending.CONVERGED if info.ending is Ending.STUCK else info.ending
            break
        if before - state.objective < enough:
            ending = Ending.CONVERGED
            break
    return y + directions @ state.y, state, ending, evaluations


def _whole_bridge(problem: Problem) -> FloatArray:
    """Directions in which all elements change alike and the supports have no springs."""
    where = layout(problem)
    unit = np.eye(where.size)
    place = np.full(problem.estimated.size, -1)
    place[problem.estimated] = np.arange(where.theta.stop)
    elements = place[EI_1 : problem.estimated.size - 5]
    springs = place[-2:]
    single = [k for k in range(where.size) if k not in {*elements, *springs}]
    together = unit[:, elements].sum(axis=1) / np.sqrt(elements.size)
    return np.column_stack([unit[:, single], together])


def find_optimum(inputs: Inputs, report: Report = lambda stage, fraction: None) -> Optimum:
    """The optimum of the posterior, searched for from several places along the road."""
    problem, y = prepare(inputs)
    whole = _whole_bridge(problem)
    free = np.eye(y.size)
    evaluations = 0
    for temperature, steps in _COARSE:
        report("finding the truck", 0.05)
        y, _, _, used = _descend(problem, y, whole, temperature, steps, 0.5)
        evaluations += used
        problem = with_noise_at(problem, y)
    best: Optimum | None = None
    where = layout(problem)
    reach = 2.5 / problem.receiver_rows[-1, -1]  # of the offset's spread
    tried = 0
    for shift in _SHIFTS_M:
        if abs(shift) > max(reach, 0.6):
            continue
        tried += 1
        report(f"finding the bridge, start {tried}", 0.1 + 0.03 * tried)
        z = y.copy()
        z[where.trajectory] += shift
        bound = problem
        for directions, stages, enough in ((whole, _WHOLE, 0.1), (free, _FREE, 0.01)):
            for temperature, steps in stages:
                z, state, ending, used = _descend(
                    bound, z, directions, temperature, steps, max(enough, 0.2 * (temperature > 1))
                )
                evaluations += used
                bound = with_noise_at(bound, z)
        chi2 = chi2_per_dof(bound, z)
        if best is None or chi2 < best.chi2_per_dof:
            best = Optimum(bound, state._replace(y=z), ending, chi2, evaluations, tried)
        if best.chi2_per_dof < _ACCEPTED_CHI2:
            break
    assert best is not None  # noqa: S101 - the first shift is always tried
    return _polished(best, evaluations, tried)


def _polished(found: Optimum, evaluations: int, tried: int) -> Optimum:
    """Last steps with the noise of the truck that was found, and supports that do not push.

    Least squares may leave a support spring below zero, where no posterior is; it is then held at
    zero and the rest is brought to the optimum beside it. The slope that is left belongs to the
    normal approximation (`normal_approximation`).
    """
    where = layout(found.problem)
    y = found.state.y.copy()
    springs = np.arange(where.theta.stop - 2, where.theta.stop)
    held = springs[y[springs] < 0.0]
    y[held] = 0.0
    directions = np.delete(np.eye(y.size), held, axis=1)
    y, _, ending, used = _descend(found.problem, y, directions, 1.0, 15, 0.1)
    y[springs] = np.maximum(y[springs], 0.0)
    state = least_squares.begin(lambda at: all_rows(found.problem, at), y)
    return Optimum(
        found.problem,
        state,
        ending,
        chi2_per_dof(found.problem, y),
        evaluations + used + y.size + 1,
        tried,
    )


def normal_approximation(found: Optimum) -> tuple[FloatArray, FloatArray]:
    """Mean (f,) and covariance (f, f) of the Gauss-Newton approximation at the optimum."""
    spread = covariance(precision_root(found.state.jacobian))
    slope = found.state.jacobian.T @ found.state.residual
    return found.state.y - spread @ slope, spread
