"""Comparison of posterior and prior: the interval of each parameter against its prior's.

All parameters are on one scale, standard deviations of their own prior from its centre (of the
logarithm, where the prior is log-normal). An interval as wide as the prior means no information, a
point complete information; one at the prior's edge contradicts the site file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pre_core.constants import NORMAL_975
from schemas.results import Prior
from services.viewer.crossing_view import ParameterRow

_HALF_NORMAL_025, _HALF_NORMAL_975 = 0.0313379, 2.2414027
_BEYOND = 4.5
"""Prior standard deviations at which the picture ends."""


class PriorPosterior(NamedTuple):
    """One parameter; limits of 95 % in standard deviations of its prior."""

    name: str
    prior: tuple[float, float]
    low: float
    estimate: float
    high: float

    @property
    def share(self) -> float:
        """Width of the interval over the prior's: 0 for complete information, 1 for none."""
        return (self.high - self.low) / (self.prior[1] - self.prior[0])


def prior_posterior_rows(parameters: Sequence[ParameterRow]) -> list[PriorPosterior]:
    """Return the parameters that have a prior, the bridge's elements first."""
    rows = [_row_of(row, row.prior) for row in parameters if row.prior is not None]
    return sorted(rows, key=lambda row: not row.name.startswith("EI_"))


def _row_of(row: ParameterRow, prior: Prior) -> PriorPosterior:
    low, estimate, high = (
        float(np.clip(_in_standard_deviations(value, prior), -_BEYOND, _BEYOND))
        for value in (row.low, row.mean, row.high)
    )
    return PriorPosterior(row.name, _limits(prior), low, estimate, high)


def _in_standard_deviations(value: float, prior: Prior) -> float:
    if prior.scale <= 0.0:
        return 0.0
    if prior.distribution != "log_normal":
        return (value - prior.location) / prior.scale
    if value <= 0.0 or prior.location <= 0.0:
        return -_BEYOND
    return float(np.log(value / prior.location)) / prior.scale


def _limits(prior: Prior) -> tuple[float, float]:
    match prior.distribution:
        case "half_normal":
            return _HALF_NORMAL_025, _HALF_NORMAL_975
        case "uniform":  # its scale is half its width
            return -0.95, 0.95
        case _:
            return -NORMAL_975, NORMAL_975
