"""The probability that a loss of rigidity is seen, at a given probability of a false alarm.

The test is one of an element's compliance c = EI_nominal/EI, one-sided. Without a prior of its own
the data leave it a normal about the truth (`crossing.compliances`), all other unknowns integrated
out with theirs. An alarm is given where that lies above one by more than chance allows: with any
prior of the element, where the posterior probability that it is weaker than nominal passes a
limit. A loss L moves c from 1 to 1/(1 - L).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from pre_core.survey.plan import Known

FloatArray = NDArray[np.float64]

FALSE_ALARM = 0.01
"""Of each element that is tested, where nothing is wrong with it."""
SURE = 0.95


class Errors(NamedTuple):
    """Standard deviations (e,) of what the tests look at, in 1/EI relative to nominal."""

    of_nominal: FloatArray
    """The element against its nominal value: with the error that all elements have in common."""
    of_others: FloatArray
    """The element against the mean of the others, which have that error as well."""


def errors(known: Known, precision: FloatArray, scale_error: float) -> Errors:
    """Of tests of a survey of this precision (b, b); `scale_error` is relative, common to all EI.

    What may be absent is taken for normal with its prior's second moment.
    """
    b, e = precision.shape[0], known.sigma.size
    prior = np.zeros(b)
    prior[: b - e] = 1.0 / known.second_moment
    # Of the log-normal priors as normals in c about one.
    prior[b - e :] = 1.0 / known.sigma**2
    alone, compared = np.empty(e), np.empty(e)
    for k in range(e):
        here = prior.copy()
        here[b - e + k] = 0.0
        # Of an element that nothing tells of the variance is infinite, not undefined.
        here[b - e + k] += 1e-12
        covariance = np.linalg.inv(precision + np.diag(here))[b - e :, b - e :]
        against = np.full(e, -1.0 / max(1, e - 1))
        against[k] = 1.0
        alone[k] = covariance[k, k]
        compared[k] = against @ covariance @ against if e > 1 else np.inf
    return Errors(np.sqrt(alone + scale_error**2), np.sqrt(compared))


def probability(loss: float, std: FloatArray, false_alarm: float = FALSE_ALARM) -> FloatArray:
    """Probabilities (e,) that a loss is seen in each element, of errors `std` (e,)."""
    shift = 1.0 / (1.0 - loss) - 1.0
    return np.asarray(ndtr(shift / std + ndtri(false_alarm)))


def smallest_loss(
    std: FloatArray, sure: float = SURE, false_alarm: float = FALSE_ALARM
) -> FloatArray:
    """Losses (e,) that are seen with probability `sure`, of errors `std` (e,)."""
    shift = (ndtri(sure) - ndtri(false_alarm)) * std
    return np.asarray(shift / (1.0 + shift))
