"""Search for other bridges by low frequencies first.

A bridge that vibrates at a wrong frequency is a local minimum: its oscillation slips by a period
against the measured one, and each small change fits worse. Equal tyres on both axles leave so
little noise that a quarter of the searches without this method end there and are accepted, although
the log posterior is up to 350 below that of the true bridge. Below the first frequency the
deflection is nearly static: linear in the compliances of elements and bearings. So bridges are
fitted to the residuals below a frequency that is doubled stage by stage, each of which brings the
next oscillation within half a period (frequency continuation, as in seismic inversion: Bunks,
Saleck, Zaleski and Chavent 1995). Truck and trajectory follow to first order, except for the
offset.
"""

from collections.abc import Iterator
from itertools import product
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct

from pre_core.arrays import FloatArray
from pre_core.crossing.fit import (
    Optimum,
    SearchStrategy,
    evaluations_of,
    resting_mode_indices,
    tempered_residuals,
)
from pre_core.crossing.nuisances import index_of_offset
from pre_core.crossing.pavement import known_pavement
from pre_core.crossing.posterior import PosteriorProblem, layout
from pre_core.crossing.preparation import update_noise
from pre_core.crossing.rows import RESIDUALS
from pre_core.crossing.walk import others_effects
from pre_core.parameters import K_ROT, F
from pre_core.search.levenberg_marquardt import minimise

_STAGES_HZ = (1.5, 3.0, 6.0, 12.0, 24.0)
_STEPS, _LAST_STEPS = 10, 20
"""Largest numbers of steps: of one stage, and of the fit to all frequencies after the stages."""
ENOUGH = 0.5
"""Improvement of the sum of squares that ends a stage, and that another bridge must promise."""
_RIVAL = 20.0
"""Sum of squares above the optimum's up to which a bridge is kept: a probability of e^-10."""
_FEWEST_WAVES = 8
_SMALLEST_COMPLIANCE = 0.1
"""Smallest compliance of an element in a fit, relative to the nominal one."""
_LARGEST_SHARE = 0.99
"""Largest share y/(1 + y) of a rotational restraint in a fit."""
_SAME_BRIDGE = 0.3
"""Distance below which two bridges count as one, in standard deviations of the priors and in m of
the offset."""


class OtherBridge(NamedTuple):
    """A bridge fitted from another start."""

    gain: float
    """Sum of squares at the optimum minus that here."""
    y: FloatArray
    """The point (f,) with this bridge and its offset, all else as at the optimum."""


class _Coordinates(NamedTuple):
    """Coordinates u (…, n + 1) of bridge and offset in which a static deflection is nearly linear.

    Elements are compliances relative to the nominal ones, rotational restraints y are y/(1 + y).
    """

    indices: NDArray[np.int64]  # (n,) indices in y
    elements: NDArray[np.int64]  # indices in u, as the next
    restraints: NDArray[np.int64]
    compliant: NDArray[np.int64]
    lower: FloatArray  # (n + 1,)
    spread: FloatArray  # of the elements

    def to_y(self, u: FloatArray) -> FloatArray:
        """Return the coordinates (…, n + 1) in y of u (…, n + 1), with the offset in m."""
        y = u.copy()
        c = np.maximum(u[..., self.elements], 0.5 * _SMALLEST_COMPLIANCE)
        y[..., self.elements] = -np.log(c) / self.spread
        share = np.minimum(u[..., self.restraints], _LARGEST_SHARE)
        y[..., self.restraints] = share / (1.0 - share)
        return y

    def from_y(self, y: FloatArray) -> FloatArray:
        """Return u (n + 1,) of the coordinates (n + 1,) in y."""
        u = y.copy()
        u[self.elements] = np.exp(-y[self.elements] * self.spread)
        u[self.restraints] = y[self.restraints] / (1.0 + y[self.restraints])
        return np.maximum(u, self.lower)


def other_bridges(
    found: Optimum, strategy: SearchStrategy, *, is_even: bool
) -> tuple[list[OtherBridge], int]:
    """Return bridges that fit about as well as an optimum, best first, and the evaluations used.

    They are fitted from elements of nominal rigidity on bearings that are free or restrained, rigid
    or compliant: both ends alike if `is_even`, else one end at a time. The noise is that of a deck
    as rough as the road: a wrong bridge passes for a rough deck, whose noise would hide a better
    one. Those more than `_RIVAL` worse are left out.
    """
    y = found.state.y
    problem = update_noise(
        found.problem, y, found.problem.force, mismatch=found.problem.mismatch.level_m3,
        pavement=known_pavement(found.problem, y, 1.0),
    )  # fmt: skip
    at = _coordinates(problem)
    fit = _ContinuedFit(problem, y, strategy, at)
    level = fit.objective(np.append(y[at.indices], 0.0))
    # With this noise the optimum's own bridge may lead to a better one, too.
    starts = [
        (np.append(y[at.indices], 0.0), ()),
        *((one, _STAGES_HZ) for one in _starts(at, is_even=is_even)),
    ]
    tried = [fit.run(start, stages) for start, stages in starts]
    others = [OtherBridge(level - objective, moved) for objective, moved in tried]
    near = [one for one in others if one.gain > -_RIVAL]
    return distinct_bridges(found, near), fit.evaluations


def distinct_bridges(found: Optimum, others: list[OtherBridge]) -> list[OtherBridge]:
    """Return the bridges that differ from an optimum's and from better ones, best first."""
    indices = [*layout(found.problem).bridge, index_of_offset(found.problem)]
    known = [found.state.y[indices]]
    distinct = []
    for other in sorted(others, key=attrgetter("gain"), reverse=True):
        bridge = other.y[indices]
        if min(np.abs(bridge - one).max() for one in known) > _SAME_BRIDGE:
            known.append(bridge)
            distinct.append(other)
    return distinct


def _coordinates(problem: PosteriorProblem) -> _Coordinates:
    where = layout(problem)
    kept = np.flatnonzero(problem.priors.estimated)
    indices = where.bridge
    names = kept[indices]
    lower = np.full(indices.size + 1, -np.inf)
    lower[np.flatnonzero(np.isin(indices, where.half_normal))] = 0.0
    elements = np.flatnonzero(np.isin(indices, where.elements))
    lower[elements] = _SMALLEST_COMPLIANCE
    return _Coordinates(
        indices,
        elements,
        np.flatnonzero(np.isin(names, (K_ROT, K_ROT + 1))),
        np.flatnonzero(np.isin(names, (F, F + 1))),
        lower,
        problem.priors.spread[names[elements]],
    )


def _starts(at: _Coordinates, *, is_even: bool) -> Iterator[FloatArray]:
    """Yield coordinates (n + 1,) in y to start from."""
    ends = ((0.0, 0.0), (1.0, 1.0)) if is_even else ((1.0, 0.0), (0.0, 1.0))
    given = set()
    for restraints, compliances in product(ends, ends):
        start = np.zeros(at.indices.size + 1)
        start[at.restraints] = restraints[: at.restraints.size]
        start[at.compliant] = compliances[: at.compliant.size]
        if start.tobytes() not in given:
            given.add(start.tobytes())
            yield start


class _ContinuedFit:
    """Fits of bridge and offset about a point y (f,), everything else to first order."""

    def __init__(
        self,
        problem: PosteriorProblem,
        y: FloatArray,
        strategy: SearchStrategy,
        at: _Coordinates,
    ) -> None:
        where = layout(problem)
        self.evaluations = y.size + 1
        self._at, self._y, self._where = at, y, where
        # The offset moves the whole trajectory, whose other coordinates are relative to one.
        offset = index_of_offset(problem)
        held = np.concatenate([at.indices, resting_mode_indices(problem, strategy), [offset]])
        self._others = others_effects(problem, y, held, 1.0)
        directions = np.zeros((y.size, at.indices.size + 1))
        directions[at.indices, np.arange(at.indices.size)] = 1.0
        directions[where.trajectory, -1] = 1.0
        without_bridge = y.copy()
        without_bridge[at.indices] = 0.0
        self._rows = tempered_residuals(problem, without_bridge, directions, 1.0)
        self._data = problem.noise.reciprocal.size
        duration_s = self._data // RESIDUALS * problem.rows.every * problem.rows.step_s
        self._waves_per_hz = 2.0 * duration_s

    def objective(self, start: FloatArray) -> float:
        """Return the sum of squares at coordinates (n + 1,) in y."""
        self.evaluations += 1
        return float(np.sum(self._residuals(start[None, :]) ** 2))

    def run(self, start: FloatArray, stages_hz: tuple[float, ...]) -> tuple[float, FloatArray]:
        """Return sum of squares and y (f,) of a bridge fitted in stages, last to all residuals."""
        u = self._at.from_y(start)
        for up_to_hz in stages_hz:
            u, _ = self._stage(u, up_to_hz, _STEPS)
        u, objective = self._stage(u, np.inf, _LAST_STEPS)
        y, moved = self._y.copy(), self._at.to_y(u)
        y[self._at.indices] = moved[:-1]
        y[self._where.trajectory] += moved[-1]
        return objective, y

    def _residuals(self, moved: FloatArray) -> FloatArray:
        """Return residuals (k, rows) at (k, n + 1) without the part that others explain."""
        rows = self._rows(moved)
        return np.asarray(rows - (rows @ self._others) @ self._others.T)

    def _stage(self, u: FloatArray, up_to_hz: float, steps: int) -> tuple[FloatArray, float]:
        """Return u fitted to the mismatch residuals below a frequency, and the sum of squares."""

        def residuals(points: FloatArray) -> FloatArray:
            rows = self._residuals(self._at.to_y(points))
            if np.isinf(up_to_hz):
                return rows
            waves = max(_FEWEST_WAVES, int(self._waves_per_hz * up_to_hz))
            low = dct(rows[:, : self._data : RESIDUALS], axis=1, norm="ortho")[:, :waves]
            return np.hstack([low, rows[:, self._data :]])

        found = minimise(residuals, u, steps, ENOUGH, self._at.lower, uses_broyden=True)
        self.evaluations += evaluations_of(found)
        return found.state.y, found.state.objective
