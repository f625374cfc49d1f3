"""What the fit of method `pre` says against its own answer, and of what.

The rows and diagnostics that `checks` judges are gathered here from the optimum.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pre_core import unknowns
from pre_core.crossing import optimum, posterior, shaking, slip, speeds
from pre_core.crossing.compliances import LEANING_SPREAD, led_by_mismatch
from pre_core.crossing.preparation import mismatch_excess, off_bridge_m, rear_at_rows_m
from pre_core.crossing.whitening import RESIDUALS
from pre_core.search.loop import Ending
from schemas.reasons import Reason
from services.identification.checks import (
    Fit,
    coarse_converters,
    is_led_away,
    odd_parameters,
    reasons_after_fit,
    steps_of_channels,
    undeclared_axles,
)
from services.identification.crossing_data import CrossingData, Floats
from services.identification.placed import middle_names


class Against(NamedTuple):
    """Reasons against a fit; those about something name it."""

    reasons: tuple[Reason, ...]
    about: Mapping[Reason, str]
    forbids: bool
    """Whether no number of the fit can be used."""


def reasons_of_fit(
    data: CrossingData, found: optimum.Optimum, acceleration: Floats, step_s: float
) -> Against:
    """Return the reasons against an optimum, the most telling first.

    `acceleration` (4, n) are the middle readings, `step_s` apart.
    """
    fit = _fit(data, found)
    names, densities = middle_names(data.vehicle), data.sensor.noise_density_ug_per_rthz
    slipped = steps_of_channels(names, fit)
    reasons = [*slipped, *reasons_after_fit(data, fit)]
    if found.ending is not Ending.CONVERGED:
        reasons.append(Reason.NOT_CONVERGED)
    axles = undeclared_axles(data.vehicle, acceleration, step_s, is_doubted=bool(reasons))
    coarse = coarse_converters(names, densities, acceleration, step_s)
    if (coarse or found.noise_power > 1.0) and Reason.NOISE_ABOVE_DECLARED not in reasons:
        reasons.insert(0, Reason.NOISE_ABOVE_DECLARED)
    about = {
        **slipped,
        **axles,
        Reason.NOISE_ABOVE_DECLARED: coarse,
        Reason.IMPLAUSIBLE_VEHICLE: odd_parameters(fit),
    }
    return Against((*axles, *reasons), about, bool(slipped) or is_led_away(fit))


def _fit(data: CrossingData, found: optimum.Optimum) -> Fit:
    """What the checks after the fit look at."""
    problem, y = found.problem, found.state.y
    where, rows = posterior.layout(problem), problem.rows
    white = posterior.data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)
    rows_of = unknowns.table(data.bridge.elements)
    estimated = [rows_of[i] for i in np.flatnonzero(problem.priors.estimated)]
    # Where the axles' roads differ that leads the truck as far as it is known.
    moved = led_by_mismatch(found)
    led = np.hypot(1.0, LEANING_SPREAD * moved)
    prior_z = {
        row.name: float(y[k] / led[k])
        for k, row in enumerate(estimated)
        if row.part == unknowns.TRUCK
    }
    _, covariance = optimum.normal_approximation(found)
    return Fit(
        white,
        rows.every * rows.step_s,
        rear_at_rows_m(problem, y),
        found.chi2_per_dof,
        prior_z | {"wheelbase": float(y[where.wheelbase])},
        float(problem.receiver_rows[-1, -1] * y[where.offset]),
        np.sqrt(np.diag(covariance)[where.elements]),
        bool(problem.mismatch.level_m3.any()),
        off_bridge_m(problem, y),
        speeds.speed_bias(problem, y),
        shaking.coherence(problem, y) if problem.force.any() else 0.0,
        slip.largest_step(problem, found.state, covariance),
        mismatch_excess(problem, y) if problem.mismatch.level_m3.any() else 0.0,
        float(np.abs(moved).max()),
    )
