"""Expected squares of a crossing's whitened noise for trucks away from the optimum.

Noise that is whitened for one truck has other expected squares for another (`posterior.all_rows`,
`errors_in_variables`), and so biases the search towards trucks that transmit less. A search
subtracts the tangent of these squares at its own truck. Draws go further: the loads on both axles
and the stiffness of their springs may together be a third off, where the squares are far from their
tangent. The extrapolated tangent makes some bridges e^90 times likelier, although their fit is
worse by 100 times the noise.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.channels import GainsAndDelays
from pre_core.crossing.errors_in_variables import ComparedStretch, channel_factors, mismatch_weights
from pre_core.crossing.layout import CHANNELS
from pre_core.crossing.noise import (
    AliasedBands,
    NoisePath,
    estimation_matrix,
    folded,
    folded_spectrum,
    noise_path,
)
from pre_core.crossing.pavement import parts_of
from pre_core.crossing.posterior import PosteriorProblem, layout, values_of
from pre_core.crossing.rows import row_count
from pre_core.crossing.suspension_noise import REDUCED_WEIGHT_FACTOR
from pre_core.parameters import FIRST_OF_BRIDGE

_FREQUENCIES = 48
"""Number of frequencies for sensor and suspension noise, whose spectra are smooth."""
_STEP = 1e-3
"""Step of the differences of the tangent."""


class ExpectedSquares(NamedTuple):
    """Half the expected squares of the noise of a problem's residuals, about an optimum.

    Gains and torsion change them only in proportion, so for these the tangent suffices.
    """

    problem: PosteriorProblem
    bands: AliasedBands
    weight: NDArray[np.complex128]
    """Weight (f, 3, 3) of the spectra of sensor and suspension noise."""
    omega: FloatArray  # (g,)
    mismatch_weight: NDArray[np.complex128]
    """Weight (4, 4, g) of a truck's equations at `omega` in the squares of the mismatch."""
    y: FloatArray  # (f,) the optimum
    value: float
    """Half the expected squares at the optimum, up to a constant."""
    tangent: FloatArray  # (f,)

    def beyond_tangent(self, y: FloatArray) -> FloatArray:
        """Return half the expected squares (k,) at points y (k, f), less their tangent."""
        return _half_squares(self, y) - self.value - (y - self.y) @ self.tangent


def expected_squares(problem: PosteriorProblem, y: FloatArray) -> ExpectedSquares:
    """Return the expected squares of a problem about its optimum y (f,)."""
    bands = folded(problem.rows, _FREQUENCIES)
    force = REDUCED_WEIGHT_FACTOR * problem.force
    (truck,), delays = _trucks(problem, y[None, :])
    channels = GainsAndDelays(np.zeros((1, CHANNELS)), delays)
    weight = np.zeros((_FREQUENCIES, 3, 3), dtype=np.complex128)
    omega, of_mismatch = np.zeros(0), np.zeros((CHANNELS, CHANNELS, 0), dtype=np.complex128)
    for part in parts_of(problem.mismatch, row_count(problem.rows, problem.crossing.rows)):
        road = part.mismatch if problem.mismatch.level_m3.any() else None
        whitened_for = folded_spectrum(bands, truck, problem.density, force, road)
        weight += 0.5 * part.residuals / _FREQUENCIES * np.linalg.inv(whitened_for)
        if road is not None:
            stretch = ComparedStretch(road, float(values_of(problem, y[None, :]).wheelbase_m[0]))
            weights = mismatch_weights(
                problem.rows, truck, channels, problem.density, force, stretch
            )
            more = part.residuals * weights.weight
            of_mismatch = of_mismatch + more if omega.size else more
            omega = weights.omega
    about = ExpectedSquares(problem, bands, weight, omega, of_mismatch, y, 0.0, np.zeros(y.size))
    truck_size = int(problem.priors.estimated[:FIRST_OF_BRIDGE].sum())
    where = layout(problem)
    delayed = range(where.delays.start, where.delays.stop)
    changing = [*range(truck_size), where.wheelbase, *delayed]
    aside = np.zeros((len(changing), y.size))
    aside[np.arange(len(changing)), changing] = _STEP
    tangent = np.zeros(y.size)
    tangent[changing] = _half_squares(about, y + aside) - _half_squares(about, y - aside)
    (value,) = _half_squares(about, y[None, :])
    return about._replace(value=float(value), tangent=tangent / (2.0 * _STEP))


def _trucks(problem: PosteriorProblem, y: FloatArray) -> tuple[list[NoisePath], FloatArray]:
    """Return the noise paths of points y (k, f), and the delays (k, 4) in s of their channels."""
    crossing, at = problem.crossing, values_of(problem, y)
    total, tandem, speed = crossing.total_mass_kg, crossing.tandem, problem.mismatch.speed_m_per_s
    is_inertial = bool(problem.force.any())
    return [
        noise_path(theta, total, float(wheelbase), is_inertial, tandem, speed)
        for theta, wheelbase in zip(at.theta, at.wheelbase_m, strict=True)
    ], problem.priors.delay_spread_s * y[:, layout(problem).delays]


def _half_squares(expected: ExpectedSquares, y: FloatArray) -> FloatArray:
    """Return half the expected squares (k,) at points y (k, f), up to a constant."""
    problem = expected.problem
    force = REDUCED_WEIGHT_FACTOR * problem.force
    found = np.zeros(y.shape[0])
    for k, (truck, delay_s) in enumerate(zip(*_trucks(problem, y), strict=True)):
        spectrum = folded_spectrum(expected.bands, truck, problem.density, force, None)
        found[k] = np.vdot(expected.weight.conj(), np.swapaxes(spectrum, 1, 2)).real
        if expected.omega.size:
            equations = estimation_matrix(truck, expected.omega)
            equations *= channel_factors(expected.omega, np.zeros(CHANNELS), delay_s)
            found[k] += np.vdot(expected.mismatch_weight.conj(), equations).real
    return found
