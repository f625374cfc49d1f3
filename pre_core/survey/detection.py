"""Probability of detecting a loss of rigidity, for a given probability of a false alarm.

The test of an element is one-sided in its compliance c = EI_nominal/EI. Without a prior of this
element, the data give a normal about the truth (`crossing.compliances`), with all other parameters
integrated out. An alarm is raised where c exceeds one by more than chance allows. For any prior of
the element, this is where the posterior probability that it is weaker than nominal passes a limit.
A loss L changes c from 1 to 1/(1 - L).
"""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from pre_core.arrays import FloatArray
from pre_core.constants import DETECTION_PROBABILITY
from pre_core.survey.plan import BridgePrior

FALSE_ALARM = 0.01
"""Probability of a false alarm for each tested element without a loss."""


class DetectionErrors(NamedTuple):
    """Standard deviations (e,) of the test quantities, in 1/EI relative to nominal."""

    of_nominal: FloatArray
    """Error of an element compared with its nominal value, including the error common to all
    elements."""
    of_others: FloatArray
    """Error of an element compared with the mean of the others; the common error cancels."""


def detection_errors(
    known: BridgePrior, precision: FloatArray, scale_error: float
) -> DetectionErrors:
    """Return the standard errors of the tests of a survey with this precision (b, b).

    `scale_error` is the relative error common to all EI. Parameters that may be absent count as
    normal with their prior's second moment.
    """
    b, e = precision.shape[0], known.sigma.size
    prior = np.zeros(b)
    prior[: b - e] = 1.0 / known.second_moment
    # The log-normal priors as normals in c about one.
    prior[b - e :] = 1.0 / known.sigma**2
    alone, compared = np.empty(e), np.empty(e)
    for k in range(e):
        here = prior.copy()
        here[b - e + k] = 0.0
        # Keep the variance of an unobserved element infinite rather than undefined.
        here[b - e + k] += 1e-12
        covariance = np.linalg.inv(precision + np.diag(here))[b - e :, b - e :]
        against = np.full(e, -1.0 / max(1, e - 1))
        against[k] = 1.0
        alone[k] = covariance[k, k]
        compared[k] = against @ covariance @ against if e > 1 else np.inf
    return DetectionErrors(np.sqrt(alone + scale_error**2), np.sqrt(compared))


def detection_probability(loss: float, std: FloatArray) -> FloatArray:
    """Return the probabilities (e,) of detecting a loss in each element, with errors `std` (e,)."""
    shift = 1.0 / (1.0 - loss) - 1.0
    return np.asarray(ndtr(shift / std + ndtri(FALSE_ALARM)))


def minimum_detectable_loss(std: FloatArray) -> FloatArray:
    """Return the losses (e,) detected with `DETECTION_PROBABILITY`, with errors `std` (e,)."""
    shift = (ndtri(DETECTION_PROBABILITY) - ndtri(FALSE_ALARM)) * std
    return np.asarray(shift / (1.0 + shift))
