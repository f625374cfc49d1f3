"""Comparison of two optima of one crossing.

Chi2 shows whether a fit explains the residuals by its own noise, but not which of two fits is
likelier: levels of mismatch and suspension noise follow from the residuals, so a wrong bridge with
more noise has a chi2 of one, too. Two accepted fits are therefore compared by their posterior
densities, which contain the normalisation of the noise.
"""

import numpy as np

from pre_core.crossing.fit import Optimum, is_accepted
from pre_core.crossing.posterior import all_rows


def is_better(one: Optimum, other: Optimum) -> bool:
    """Return whether an optimum is better than another one of the same crossing.

    Misfits, and fits with forces of different form (from inertia or from springs), whose residuals
    are not the same quantities, are compared by chi2.
    """
    if (
        one.problem.crossing.is_inertial == other.problem.crossing.is_inertial
        and one.problem.lines_hz == other.problem.lines_hz
        and all(is_accepted(each.problem, each.chi2_per_dof) for each in (one, other))
    ):
        return minus_two_log_posterior(one) < minus_two_log_posterior(other)
    return one.chi2_per_dof < other.chi2_per_dof


def minus_two_log_posterior(found: Optimum) -> float:
    """Return -2 ln of the posterior density at an optimum, up to a constant of its crossing.

    The whitener W satisfies W'W = C^-1, so the normalisation is ln |C| = -2 ln |W|. `noise_slope`,
    its gradient in a search with fixed noise, is left out.
    """
    problem = found.problem
    (rows,) = all_rows(problem._replace(noise_slope=np.zeros(0)), found.state.y[None, :])
    return float(rows @ rows) - 2.0 * float(np.log(problem.noise.reciprocal).sum())
