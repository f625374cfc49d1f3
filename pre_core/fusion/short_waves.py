"""Errors from short waves of the profile mismatch that the runs of a wheel-path group share.

The likelihood of a crossing treats the mismatch in waves shorter than those of its coefficients as
noise of its own. Runs on one path share these waves too, as far as the lateral wander leaves them
alike. A wave affects an estimate mostly through the frequency f of a mode of the bridge, which it
excites at f/v cycles/m: runs at other speeds v are affected by other waves.

So each crossing keeps the response of its estimate to waves of the mismatch. Fusion adds the
covariance of a crossing's errors with those of the other runs to the crossing's own covariance. The
sum of all crossings then has the uncertainty that the shared errors cause.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.compliances import compliance_normal
from pre_core.crossing.fit import Optimum
from pre_core.crossing.rows import RESIDUALS, filter_adjoint
from pre_core.crossing.whitening import project_out_noise, solve_transposed

BESIDE_M = 7.5
"""Distance before and after the bridge over which the mismatch is correlated with that on it."""
_MAX_CYCLES_PER_M = 4.0
"""Highest spatial frequency: 40 Hz at 10 m/s, and the filter of the residuals passes little
more."""


class ShortWaveResponse(NamedTuple):
    """Change of an estimated bridge, b coordinates, by n waves of the mismatch of 1 m each."""

    step_cycles_per_m: float
    """Spacing of the spatial frequencies, which begin one step above zero."""
    cosine: FloatArray  # (b, n)
    sine: FloatArray  # (b, n)

    @property
    def cycles_per_m(self) -> FloatArray:
        """The spatial frequencies (n,) of the waves."""
        return self.step_cycles_per_m * np.arange(1, 1 + self.cosine.shape[1])


def short_wave_response(found: Optimum, rear_m: FloatArray) -> ShortWaveResponse:
    """Return the response of an optimum; `rear_m` (rows,) is the rear axle's chainage."""
    problem = found.problem
    where = posterior.layout(problem)
    _, jacobian, covariance = compliance_normal(found)
    data = problem.noise.reciprocal.size
    weights = project_out_noise(problem.noise, covariance[where.bridge] @ jacobian[:data].T)
    span_m = problem.crossing.span_m
    near = (rear_m > -BESIDE_M) & (rear_m < span_m + BESIDE_M)
    # More than a period of the longest wave covers the bridge and what is correlated with it.
    step = 1.0 / np.ceil(span_m + 3.0 * BESIDE_M)
    waves = step * np.arange(1, 1 + int(_MAX_CYCLES_PER_M / step))
    turn = np.exp(2j * np.pi * np.outer(rear_m[near], waves))
    of_samples = np.empty((where.bridge.size, rear_m.size))
    for k, one in enumerate(weights):
        row = np.ascontiguousarray(one)
        solve_transposed(problem.noise.factor, problem.noise.reciprocal, row)
        of_samples[k] = filter_adjoint(problem.rows, row[::RESIDUALS], rear_m.size)
    response = of_samples[:, near] @ turn
    return ShortWaveResponse(float(step), response.real, response.imag)


def shared_error_roots(
    responses: Sequence[ShortWaveResponse], density_m3: FloatArray
) -> list[FloatArray]:
    """Return for each run a root (b, r) of its errors' covariance with those of all other runs.

    `density_m3` (n,) is the one-sided spectrum of the shared part, at the waves of the responses.
    Each of two runs takes half of their covariance.
    """
    phasors = np.stack([one.cosine + 1j * one.sine for one in responses])
    weighted = phasors * (density_m3 * responses[0].step_cycles_per_m)
    others = weighted.sum(axis=0) - weighted
    roots = []
    for mine, theirs in zip(phasors, others, strict=True):
        covariance = (mine @ theirs.conj().T).real
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        kept = values > 0.0
        roots.append(np.asarray(vectors[:, kept] * np.sqrt(values[kept])))
    return roots
