"""The paper's two methods on one crossing: their fits, and results with verdicts.

Neither has a noise model: no value of theirs is ever `good` (docs/contract.md).
"""

from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import parameters
from pre_core.constants import NORMAL_975
from pre_core.paper import least_squares, random_walk, residual
from pre_core.paper.integrate import spline_integrate
from pre_core.paper.window import MeasuredCrossing, PaperWindow, WindowError, build_window
from pre_core.physics.bridge import natural_frequencies_hz, strain_energy_shares
from pre_core.physics.models import body_masses
from pre_core.physics.simulate import Motion
from pre_core.search import levenberg_marquardt, loop
from pre_core.search.loop import Report
from schemas import results
from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData
from services.identification.fit_reasons import words_of_ending
from services.identification.result_parts import (
    CrossingTimes,
    beam_of,
    caveats,
    detrended,
    gaussian,
    header,
    nominal_parameters,
    rejected,
    road_result,
)

_LARGEST_MISFIT = 0.002
"""Limit of the rms of R_1 - R_2 relative to the bridge's largest deflection under a wheel.

Without noise a fit leaves 1e-5; from a few thousandths on elements cannot be distinguished.
"""
_LARGEST_FACTOR = 100.0
"""Largest factor between a value and its declaration: nothing differs a hundredfold."""

FAR_FROM_SITE: Final = "it ended at values far from those of the site file"


class _Fit(NamedTuple):
    """Fit of a method: all parameters, their formal covariance, and statistics."""

    theta: Floats  # (p,)
    free: NDArray[np.int64]  # (f,)
    covariance: Floats  # (f, f) in physical units
    spread: Floats | None  # (f, 3) quantiles of the random walk's particles
    ending: loop.Termination
    diagnostics: dict[str, float]


def identify_paper(
    data: CrossingData,
    settings: IdentificationSettings,
    passing: CrossingTimes,
    acceleration: Floats,
    motion: Motion,
    report: Report,
    elapsed: Callable[[], float],
) -> results.CrossingResult:
    """Return the result by `least_squares` or `random_walk`; its verdict is never `good`."""
    try:
        window = _window(data, settings, acceleration, motion)
    except WindowError:
        return rejected(data, settings, passing, [Reason.STOPPED_ON_BRIDGE])
    fit = _METHODS[settings.method](data, settings, window, report)
    if fit.ending is loop.Termination.NOT_FINITE:
        return rejected(data, settings, passing, [Reason.NOT_FINITE])
    return _result(data, settings, passing, window, fit, motion, elapsed())


def _window(
    data: CrossingData, settings: IdentificationSettings, acceleration: Floats, motion: Motion
) -> PaperWindow:
    vehicle = data.vehicle
    assert data.samples is not None  # noqa: S101 - `_unusable` checked it
    return build_window(
        MeasuredCrossing(
            acceleration,
            1.0 / data.samples.rate_hz,
            motion.position_m,
            data.stay.direction,
            element_lengths_m=np.array(data.bridge.lengths_m),
            total_mass_kg=vehicle.total_mass_kg,
            wheelbase_m=vehicle.wheelbase_m,
            integrate=spline_integrate,
            initial_state_known=False,
            bias_known=False,
            speed_change_m_per_s2=motion.acceleration_m_per_s2,
            cg_height_m=vehicle.cg_height_m or 0.0,
            parts=settings.parts,
        )
    )


def _least_squares(
    data: CrossingData, settings: IdentificationSettings, window: PaperWindow, report: Report
) -> _Fit:
    nominal = nominal_parameters(data.vehicle, data.bridge)
    free = parameters.paper_subset(data.bridge.elements)
    free = free[nominal[free] > 0.0]  # a site may declare a damping of exactly zero
    problem = least_squares.LeastSquaresProblem(window, nominal, free)
    work = residual.workspace(window)
    rng = np.random.default_rng(settings.seed)
    best: tuple[levenberg_marquardt.LMState, loop.Termination] | None = None
    steps = evaluations = 0

    def progress(count: int, info: levenberg_marquardt.LMInfo) -> None:
        report(f"least squares, step {count}", min(0.95, count / least_squares.MAX_STEPS))

    for attempt in range(settings.starts):
        start = nominal[free]
        if attempt > 0:
            start = start * rng.uniform(random_walk.PRIOR_LOW, random_walk.PRIOR_HIGH, free.size)
        state, infos, ending = loop.run_search(
            partial(least_squares.init, problem, work, start),
            partial(least_squares.step, problem, work),
            least_squares.MAX_STEPS,
            progress=progress,
        )
        steps += len(infos)
        evaluations += sum(info.evaluations for info in infos)
        if best is None or state.objective < best[0].objective:
            best = state, ending
        if ending is loop.Termination.CONVERGED:
            break
    assert best is not None  # noqa: S101 - `starts` is at least 1
    state, ending = best
    return _Fit(
        least_squares.full_vector(problem, state.y),
        free,
        least_squares.formal_covariance(problem, work, state.y),
        None,
        ending,
        {"iterations": float(steps), "evaluations": float(evaluations)},
    )


def _random_walk(
    data: CrossingData, settings: IdentificationSettings, window: PaperWindow, report: Report
) -> _Fit:
    nominal = nominal_parameters(data.vehicle, data.bridge)
    free = parameters.paper_subset(data.bridge.elements)
    free = free[nominal[free] > 0.0]
    problem = random_walk.problem(window, nominal, free, settings.seed)

    def progress(count: int, info: random_walk.RandomWalkInfo) -> None:
        report(f"random walk, step {count}", count / settings.steps)

    state, infos, ending = loop.run_search(
        partial(random_walk.init, problem, settings.particles),
        partial(random_walk.step, problem),
        settings.steps,
        at_limit=loop.Termination.STEPS_DONE,
        progress=progress,
    )
    values = state.ratios * nominal[free]
    theta = nominal.copy()
    theta[free] = values.mean(axis=0)
    return _Fit(
        theta,
        free,
        np.atleast_2d(np.cov(values.T)),
        np.quantile(values, [0.025, 0.5, 0.975], axis=0).T,
        ending,
        {
            "iterations": float(len(infos)),
            "evaluations": float(settings.particles * (len(infos) + 1)),
            "acceptance": float(np.mean([info.acceptance for info in infos])),
        },
    )


_METHODS: dict[str, Callable[[CrossingData, IdentificationSettings, PaperWindow, Report], _Fit]] = {
    "least_squares": _least_squares,
    "random_walk": _random_walk,
}


def _has_diverged(data: CrossingData, fit: _Fit) -> bool:
    """Return whether the search ended anywhere but at a plausible minimum."""
    if fit.ending in (loop.Termination.STEPS_EXHAUSTED, loop.Termination.STUCK):
        return True
    nominal = nominal_parameters(data.vehicle, data.bridge)[fit.free]
    factors = np.abs(np.log(fit.theta[fit.free] / nominal))
    return bool(factors.max() > np.log(_LARGEST_FACTOR))


def _result(
    data: CrossingData,
    settings: IdentificationSettings,
    passing: CrossingTimes,
    window: PaperWindow,
    fit: _Fit,
    motion: Motion,
    seconds: float,
) -> results.CrossingResult:
    work = residual.workspace(window)
    roads = residual.road_profiles(window, work, fit.theta)
    objective = residual.objective(window, work, fit.theta)
    length = abs(roads.x_m[-1] - roads.x_m[0])
    misfit_m = float(np.sqrt(objective / length))
    road_m = float(np.std(detrended(roads.x_m, 0.5 * (roads.front_m + roads.rear_m))))
    diagnostics = fit.diagnostics | {
        "seconds": seconds,
        "residual_rms_m": misfit_m,
        "road_rms_m": road_m,
        "relative_misfit": misfit_m / max(road_m, 1e-12),
    }
    if _has_diverged(data, fit):
        # Under noise the plain residual has no useful minimum: no value is an estimate.
        ending = words_of_ending(fit.ending) or FAR_FROM_SITE
        about = {Reason.NOT_CONVERGED: ending}
        return rejected(data, settings, passing, about, about, diagnostics=diagnostics)
    reasons = [Reason.NO_NOISE_MODEL]
    deflection_m = float(residual.deflections_m(window, fit.theta).max())
    diagnostics["misfit_over_deflection"] = misfit_m / max(deflection_m, 1e-12)
    if diagnostics["misfit_over_deflection"] > _LARGEST_MISFIT:
        reasons.append(Reason.MODEL_MISFIT)
    reasons += caveats(data, motion)
    values = _parameters(data, fit, settings)
    names = tuple(parameters.names(data.bridge.elements)[i] for i in fit.free)
    return results.CrossingResult(
        **header(data, settings, passing),
        verdict="suspect",  # without a noise model no result can be shown to be good
        reasons=tuple(reasons),
        diagnostics=diagnostics,
        parameters=values,
        covariance=results.Covariance(
            names=names, matrix=tuple(tuple(row) for row in fit.covariance.tolist())
        ),
        derived=_derived(data, window, fit),
        road=road_result(data, roads.x_m, roads.front_m, roads.rear_m),
    )


def _parameters(
    data: CrossingData, fit: _Fit, settings: IdentificationSettings
) -> dict[str, results.Parameter]:
    nominal = nominal_parameters(data.vehicle, data.bridge)
    names = parameters.names(data.bridge.elements)
    std = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    values: dict[str, results.Parameter] = {}
    for k, i in enumerate(fit.free):
        mean = float(fit.theta[i])
        low, middle, high = (
            fit.spread[k]
            if fit.spread is not None
            else (mean - NORMAL_975 * std[k], mean, mean + NORMAL_975 * std[k])
        )
        values[names[i]] = results.Parameter(
            unit=parameters.unit(names[i]),
            mean=mean,
            std=float(std[k]),
            q025=float(low),
            q50=float(middle),
            q975=float(high),
            prior=_start_of_search(float(nominal[i]), settings),
        )
    return values | _derived_masses(data, fit)


def _start_of_search(nominal: float, settings: IdentificationSettings) -> results.Prior | None:
    """Return the random walk's uniform start around the nominal value; least squares has none."""
    if settings.method != "random_walk":
        return None
    half_width = 0.5 * (random_walk.PRIOR_HIGH - random_walk.PRIOR_LOW) * abs(nominal)
    return results.Prior(distribution="uniform", location=nominal, scale=half_width)


def _derived_masses(data: CrossingData, fit: _Fit) -> dict[str, results.Parameter]:
    """Return m_s, m_s1, m_s2 and their formal spread to first order."""
    vehicle = data.vehicle
    masses = partial(
        body_masses,
        total_mass_kg=vehicle.total_mass_kg,
        wheelbase_m=vehicle.wheelbase_m,
    )
    means, spread = _propagated(fit, lambda theta: masses(theta))
    return {
        name: gaussian("kg", float(mean), float(std))
        for name, mean, std in zip(("m_s", "m_s1", "m_s2"), means, spread, strict=True)
    }


def _propagated(fit: _Fit, quantity: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
    """Return a quantity (q,) of the parameters and its standard deviation to first order."""

    def moved(changes: Floats) -> Floats:
        values = np.repeat(fit.theta[None, :], len(changes), axis=0)
        values[:, fit.free] *= 1.0 + changes
        return np.array([quantity(theta) for theta in values])

    slopes = levenberg_marquardt.sixth_order_jacobian(moved, np.zeros(fit.free.size))
    return quantity(fit.theta), _spread(fit, slopes)


def _spread(fit: _Fit, slopes: Floats) -> Floats:
    """Return standard deviations (q,) for `slopes` (q, f) in the parameters' logarithms."""
    by_values = slopes / fit.theta[fit.free]
    variance = np.einsum("qi,ij,qj->q", by_values, fit.covariance, by_values)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _first_frequency(data: CrossingData, fit: _Fit) -> tuple[float, float]:
    """Return f_1 in Hz and its standard deviation.

    An eigenvalue has twelve correct digits and its differences over thousandths nine, also for
    parameters without influence: where their spread is hundreds of times that of f_1, as for the
    damping of the bridge and its outermost elements, a millionth of the spread is rounding.
    """
    beam = beam_of(data, fit.theta)
    f1_hz = float(natural_frequencies_hz(beam, 1)[0])
    relative = np.zeros(fit.theta.size)
    relative[parameters.EI_1 :] = 0.5 * strain_energy_shares(beam)[: data.bridge.elements]
    relative[parameters.RHO_A] = -0.5
    return f1_hz, float(_spread(fit, f1_hz * relative[None, fit.free])[0])


def _largest_deflection(window: PaperWindow, fit: _Fit) -> tuple[float, float]:
    """Return the largest deflection under a wheel, in metres, and its standard deviation.

    Its slopes are those of the deflection at its maximum. Over steps of some thousandths another
    sample is the largest one, and differences of the maximum have kinks.
    """
    deflections_m = residual.deflections_m(window, fit.theta)
    at = np.unravel_index(deflections_m.argmax(), deflections_m.shape)
    means, spread = _propagated(
        fit, lambda theta: residual.deflections_m(window, theta)[at].reshape(1)
    )
    return float(means[0]), float(spread[0])


def _derived(data: CrossingData, window: PaperWindow, fit: _Fit) -> results.Derived:
    return results.Derived(
        f1_hz=gaussian("Hz", *_first_frequency(data, fit)),
        max_deflection_m=gaussian("m", *_largest_deflection(window, fit)),
    )
