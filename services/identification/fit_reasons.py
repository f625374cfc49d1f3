"""Reasons against a fit of method `pre`, with their subjects.

The residuals and diagnostics that `checks` judges are collected here from the optimum.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from pre_core import parameters
from pre_core.crossing import common_disturbance, posterior, slip, speeds
from pre_core.crossing.compliances import MISMATCH_BIAS_SPREAD, mismatch_bias
from pre_core.crossing.fit import FAR_OFF_CHI2, Optimum, normal_approximation
from pre_core.crossing.misfit import EXPLAINED_CHI2, fit_off_bridge
from pre_core.crossing.mismatch import pavement_ratio
from pre_core.crossing.off_bridge import compared_length_m, mismatch_excess, rear_axle_chainage_m
from pre_core.crossing.rows import RESIDUALS
from pre_core.crossing.tandem_friction import tandem_friction
from pre_core.physics.beam_basis import first_frequencies_hz
from pre_core.search.loop import Termination
from schemas.reasons import Reason
from schemas.results import Derived
from schemas.site import Bridge
from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData
from services.finding.placed import first_axle, middle_names
from services.identification.bridge_remarks import FREQUENCY_RATIO, PRIOR_Z
from services.identification.checks import (
    LARGEST_PRIOR_Z,
    FitDiagnostics,
    coarse_converters,
    implausible_parameters,
    is_biased_by_mismatch,
    reasons_after_fit,
    steps_of_channels,
    undeclared_axles,
    weak_excitation,
)

_CONTRADICTION = 1.2
"""Factor between the fitted first frequency and the declared one that is a contradiction: an
estimate from the span or another temperature is within it."""
_UNEXPLAINED_CHI2 = 3.0
"""Smallest chi2 of a fit off the bridge alone that shows an error in the model of the truck."""

FAR_FROM_MEASUREMENT: Final = "it ended at values far from the measurement"
_ENDINGS: Final[Mapping[Termination, str]] = {
    Termination.STEPS_EXHAUSTED: "it reached its limit of steps",
    Termination.STUCK: "no further step improved the fit",
}


class ReasonsOfFit(NamedTuple):
    """Reasons against a fit, with the parameters or channels concerned."""

    reasons: tuple[Reason, ...]
    about: Mapping[Reason, str]
    forbids: bool
    """Whether no value of the fit is usable."""


def reasons_of_fit(
    data: CrossingData, found: Optimum, acceleration: Floats, step_s: float
) -> ReasonsOfFit:
    """Return the reasons against an optimum, the strongest first.

    `acceleration` (4, n) are the middle readings, `step_s` apart.
    """
    fit = _fit(data, found)
    names, densities = middle_names(data.vehicle), data.sensor.noise_density_ug_per_rthz
    slipped = steps_of_channels(names, fit)
    reasons = reasons_after_fit(data, fit)
    off_bridge_chi2 = np.inf
    if Reason.MODEL_MISFIT in reasons or (slipped and found.unfinished is not None):
        off_bridge_chi2 = fit_off_bridge(found).chi2
    if found.unfinished is not None and off_bridge_chi2 <= EXPLAINED_CHI2:
        slipped = {}  # a step in a channel would leave residuals off the bridge, too
    reasons = [*slipped, *reasons]
    if found.ending is not Termination.CONVERGED:
        reasons.append(Reason.NOT_CONVERGED)
    unexcited = weak_excitation(densities, acceleration, step_s) if slipped else ""
    if unexcited:
        slipped = {reason: f"{text}, {unexcited}" for reason, text in slipped.items()}
    axles = undeclared_axles(data.vehicle, acceleration, step_s, has_reasons=bool(reasons))
    coarse = coarse_converters(names, densities, acceleration, step_s)
    if (coarse or found.noise_power > 1.0) and Reason.NOISE_ABOVE_DECLARED not in reasons:
        reasons.insert(0, Reason.NOISE_ABOVE_DECLARED)
    about = {
        **slipped,
        **axles,
        Reason.MODEL_MISFIT: "; ".join(
            filter(None, (_place_of_misfit(off_bridge_chi2), _wrong_bridge(data, found)))
        ),
        Reason.NOT_CONVERGED: _ending_of_search(found),
        Reason.NOISE_ABOVE_DECLARED: coarse,
        Reason.IMPLAUSIBLE_VEHICLE: implausible_parameters(fit),
        Reason.TANDEM_FRICTION: f"about {100.0 * fit.tandem_friction:.2g} % of the springs' load",
    }
    return ReasonsOfFit((*axles, *reasons), about, bool(slipped) or is_biased_by_mismatch(fit))


def _ending_of_search(found: Optimum) -> str:
    """Return how a search ended that did not converge, in words."""
    if found.chi2_per_dof > FAR_OFF_CHI2:
        return FAR_FROM_MEASUREMENT
    return words_of_ending(found.ending)


def words_of_ending(ending: Termination) -> str:
    """Return how a search ended, in words; "" for an ending that is no failure."""
    return _ENDINGS.get(ending, "")


def _place_of_misfit(off_bridge_chi2: float) -> str:
    """Return where the model fails, with the likely causes, or "" if that is not clear.

    It follows from the chi2 of truck and road fitted off the bridge alone.
    """
    is_between = EXPLAINED_CHI2 < off_bridge_chi2 < _UNEXPLAINED_CHI2
    if is_between or not np.isfinite(off_bridge_chi2):
        return ""
    if off_bridge_chi2 <= EXPLAINED_CHI2:
        return (
            "only on the bridge; likely causes are another vehicle on it, an undeclared support, a "
            "wrong span, or a bridge that is not a beam"
        )
    return (
        f"also before and after the bridge (χ² {off_bridge_chi2:.2g}); likely causes are another "
        "truck than declared, a faulty sensor, or different profiles under the axles"
    )


def _wrong_bridge(data: CrossingData, found: Optimum) -> str:
    """Return how the fitted first frequency contradicts the declared one; "" if it does not."""
    declared_hz = data.bridge.first_frequency_hz
    if declared_hz is None:
        return ""
    theta = posterior.values_of(found.problem, found.state.y[None, :]).theta
    fitted_hz = float(first_frequencies_hz(found.problem.crossing.basis, theta)[0])
    return contradicted_frequency(fitted_hz, declared_hz)


def is_contradicted_frequency(fitted_hz: float, declared_hz: float) -> bool:
    """Return whether a first frequency is far from the declared one."""
    return not 1.0 / _CONTRADICTION <= fitted_hz / declared_hz <= _CONTRADICTION


def contradicted_frequency(fitted_hz: float, declared_hz: float) -> str:
    """Return the sentence on a first frequency far from the declared one; "" if it is near."""
    if not is_contradicted_frequency(fitted_hz, declared_hz):
        return ""
    return (
        f"the estimated first frequency is {fitted_hz:.3g} Hz, declared {declared_hz:.3g} Hz, so "
        "the search may have ended at wrong bridge values"
    )


def contradictions(
    bridge: Bridge, problem: posterior.PosteriorProblem, draws: Floats, derived: Derived
) -> dict[str, float]:
    """Return, as diagnostics, the bridge parameters other than EI that contradict the site file.

    `draws` (steps, chains, f) are search coordinates, which are deviations from the priors in their
    standard deviations. A parameter is listed if its mean deviates by more than 4 of them.
    """
    estimated = np.flatnonzero(problem.priors.estimated)
    found = {
        f"{PRIOR_Z}{parameters.SCALARS[i].name}": float(z)
        for i, z in zip(estimated, draws.mean(axis=(0, 1))[: estimated.size], strict=True)
        if parameters.FIRST_OF_BRIDGE <= i < parameters.EI_1 and abs(z) > LARGEST_PRIOR_Z
    }
    f1_hz, declared_hz = derived.f1_hz.mean, bridge.first_frequency_hz
    if declared_hz is not None and is_contradicted_frequency(f1_hz, declared_hz):
        found[FREQUENCY_RATIO] = f1_hz / declared_hz
    return found


def _fit(data: CrossingData, found: Optimum) -> FitDiagnostics:
    """Return the input of the checks after the fit."""
    problem, y = found.problem, found.state.y
    where, rows = posterior.layout(problem), problem.rows
    has_friction = bool(problem.force.any())
    white = posterior.data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)
    rows_of = parameters.table(data.bridge.elements, first_axle(data.vehicle))
    estimated = [rows_of[i] for i in np.flatnonzero(problem.priors.estimated)]
    # A profile mismatch biases the truck as far as it is known.
    moved = mismatch_bias(found)
    led = np.hypot(1.0, MISMATCH_BIAS_SPREAD * moved)
    prior_z = {
        row.name: float(y[k] / led[k])
        for k, row in enumerate(estimated)
        if row.part == parameters.TRUCK
    }
    _, covariance = normal_approximation(found)
    return FitDiagnostics(
        white,
        rows.every * rows.step_s,
        rear_axle_chainage_m(problem, y),
        found.chi2_per_dof,
        prior_z | {"wheelbase": float(y[where.wheelbase])},
        float(problem.receiver_rows[-1, -1] * y[where.offset]),
        np.sqrt(np.diag(covariance)[where.elements]),
        bool(problem.mismatch.level_m3.any()),
        compared_length_m(problem, y),
        speeds.speed_bias(problem, y),
        common_disturbance.coherence(problem, y)
        if has_friction and not posterior.has_tandem(problem)
        else 0.0,
        slip.largest_step(problem, found.state, covariance),
        mismatch_excess(problem, y) if problem.mismatch.level_m3.any() else 0.0,
        float(np.abs(moved).max()),
        pavement_ratio(problem.mismatch),
        tandem_friction(problem, y),
    )
