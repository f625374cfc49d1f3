"""A crossing's residuals as a function of shared variables, linear or of second order."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.compliances import to_compliance_coordinates
from pre_core.crossing.response_surface import ResponseSurface
from pre_core.fusion.curvature import CurvatureTerms
from pre_core.search import levenberg_marquardt

_LEAST_TERM = 0.05
"""Smallest curvature term that is kept: change of the residuals, in their standard deviation, by
moves of unit size."""
_MAX_TERMS = 60


class Linearised(NamedTuple):
    """Residuals residual (m,) + jacobian (m, n) (x - centre) as a function of x (n,).

    The entries of x are those of bridge, truck and waves, then all others.
    """

    jacobian: FloatArray
    residual: FloatArray
    centre: FloatArray


def of_surface(surface: ResponseSurface, sigma: FloatArray) -> tuple[CurvatureTerms, Linearised]:
    """Return the curvature terms of a surface, and the surface in the form of `Linearised`.

    Offset and terms come after the waves. `sigma` (elements,) are the spreads of ln EI, for c =
    exp(-sigma y).
    """
    n = sigma.size
    weight, shapes = np.linalg.eigh(surface.products.T @ surface.products)
    shapes = shapes[:, np.flatnonzero(weight > _LEAST_TERM**2)[::-1][:_MAX_TERMS]]
    per_y = np.ones(surface.centre.size)
    per_y[-1 - n : -1] = -sigma
    centre = per_y * surface.centre
    centre[-1] = 0.0  # the offset is relative to the surface's centre
    size = per_y * surface.size
    about = centre[:-1].copy()
    about[-n:] = np.exp(about[-n:])
    # Derivatives with respect to the bridge for a fixed truck.
    slopes = (surface.slopes - surface.linear @ surface.follow) / size
    jacobian = np.hstack(
        [slopes[:, :-1], surface.linear, surface.waves, slopes[:, -1:], surface.products @ shapes]
    )
    at = np.zeros(jacobian.shape[1])
    at[: centre.size - 1 + surface.at.size] = np.concatenate([centre[:-1], surface.at])
    terms = CurvatureTerms(about, np.diag(size), shapes.T, n)
    return terms, Linearised(jacobian, surface.constant, at)


def of_optimum(
    problem: posterior.PosteriorProblem,
    state: levenberg_marquardt.LMState,
    rows: NDArray[np.int64],
    kept: NDArray[np.int64],
    waves: FloatArray,
) -> Linearised:
    """Return the linearisation at an optimum, of its residuals `rows` (m,).

    The entries of x are the coordinates `kept` (n,), the mismatch with the effects `waves` (m, q),
    and all other coordinates.
    """
    centre, jacobian = to_compliance_coordinates(problem, state.y, state.jacobian[rows])
    others = np.setdiff1d(np.arange(centre.size), kept)
    return Linearised(
        np.hstack([jacobian[:, kept], waves, jacobian[:, others]]),
        state.residual[rows],
        np.concatenate([centre[kept], np.zeros(waves.shape[1]), centre[others]]),
    )
