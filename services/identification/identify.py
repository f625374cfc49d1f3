"""One crossing: from samples and fixes to a result with a verdict. No I/O, no clock.

`identify` checks what can be checked before any fitting (a missing channel, a gap, no position, too
slow), fits, and says what the answer is worth. Every way to fail is a verdict, not an exception.
"""

import logging
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from pre_core import unknowns
from pre_core.crossing.trajectory import Trajectory, fit_trajectory, motion_at, passing_time_s
from pre_core.paper import least_squares, random_walk, residual
from pre_core.paper.integrate import spline_integrate
from pre_core.paper.residual import Window
from pre_core.physics.bridge import natural_frequencies_hz
from pre_core.physics.models import body_masses
from pre_core.physics.simulate import Motion
from pre_core.search import levenberg_marquardt, loop
from schemas import results
from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS
from services.identification.checks import reasons_before_fit
from services.identification.crossing_data import (
    LONGEST_SURE_OUTAGE_S,
    MARGIN_S,
    NORMAL_975,
    CrossingData,
    Floats,
    Passing,
    beam_of,
    caveats,
    detrended,
    gaussian,
    header,
    longest_outage_s,
    nominal_parameters,
    rejected,
    road_result,
)
from services.identification.pre_method import Keep as Keep
from services.identification.pre_method import identify_pre
from services.identification.stays import Passage
from services.identification.streams import Samples

_log = logging.getLogger(__name__)
Stopwatch = Callable[[], float]
Report = Callable[[str, float], None]


class Identify(Protocol):
    """What `identify` is: from one crossing to its result."""

    def __call__(  # noqa: D102
        self,
        data: CrossingData,
        settings: IdentificationSettings,
        *,
        stopwatch: Stopwatch,
        report: Report = ...,
        keep: Keep = ...,
    ) -> results.Crossing: ...


_SLOWEST_M_PER_S = 3.0
"""Below this the wheels feel next to nothing of the bridge's stiffness."""
_STANDING_M_PER_S = 0.5
_LONGEST_OUTAGE_S = 8.0
"""So long without a fix the trajectory may be found from the axles' signals, by method `pre`."""
_LARGEST_MISFIT = 0.002
"""Root mean square of R_1 - R_2 relative to the bridge's largest deflection under a wheel. Without
noise a fit leaves 1e-5; from a few thousandths on the elements are not told apart."""
_LARGEST_FACTOR = 100.0
"""Nothing of a truck or a bridge is a hundred times what its owner says."""


class _Fit(NamedTuple):
    """What a method found: all parameters, their formal covariance, and how it went."""

    theta: Floats  # (p,)
    free: NDArray[np.int64]  # (f,)
    covariance: Floats  # (f, f) in physical units
    spread: Floats | None  # (f, 3) quantiles where the method has a cloud instead of a curvature
    ending: loop.Ending
    diagnostics: dict[str, float]


def identify(
    data: CrossingData,
    settings: IdentificationSettings,
    *,
    stopwatch: Stopwatch,
    report: Report = lambda stage, fraction: None,
    keep: Keep = lambda crossing_id, draws: None,
) -> results.Crossing:
    """The result of one crossing, whatever its data are; `keep` is given its draws, if any."""
    began = stopwatch()
    trajectory = _trajectory(data)
    entry_s, exit_s = _entry_and_exit(data, trajectory)
    passing = Passing(entry_s, exit_s, _speed_m_per_s(data, entry_s, exit_s))
    reject = partial(rejected, data, settings, passing)
    reasons = _unusable(data, settings.method, trajectory, entry_s, exit_s)
    if reasons or trajectory is None or data.samples is None:
        return reject(reasons or [Reason.FAILED])
    try:
        cut = _cut(data, trajectory, data.samples, passing)
        if cut is None:
            return reject([Reason.GAP_ON_BRIDGE])
        broken = reasons_before_fit(
            data.vehicle,
            cut.acceleration,
            1.0 / data.samples.rate_hz,
            cut.motion,
            data.stay.direction,
        )
        if broken:
            return reject(broken)
        if settings.method == "pre":
            return identify_pre(
                data, settings, passing, *cut, report, lambda: stopwatch() - began, keep
            )
        found = _fitted(data, settings, cut, report)
        if isinstance(found, Reason):
            return reject([found])
        return _result(data, settings, passing, *found, cut.motion, stopwatch() - began)
    except Exception:  # whatever the data are, the answer is a verdict
        _log.exception("identification of %s failed", data.crossing_id)
        return reject([Reason.FAILED])


class _Cut(NamedTuple):
    """The samples of a crossing and where the truck was at them."""

    acceleration: Floats  # (4, n)
    start_s: float
    motion: Motion


def _cut(
    data: CrossingData, trajectory: Trajectory, samples: Samples, passing: Passing
) -> _Cut | None:
    """The unbroken samples around the crossing; None if some are missing in it."""
    time_s = samples.start_s + np.arange(_size(samples)) / samples.rate_hz
    part = _covered(samples, time_s, passing.entry_s, passing.exit_s)
    if part is None:
        return None
    return _Cut(
        np.stack([samples.channels[name][part] for name in CHANNELS]),
        float(time_s[part][0]),
        motion_at(trajectory, time_s[part], data.stay.direction),
    )


def _fitted(
    data: CrossingData, settings: IdentificationSettings, cut: _Cut, report: Report
) -> tuple[Window, _Fit] | Reason:
    try:
        window = _window(data, settings, cut.acceleration, cut.motion)
    except residual.WindowError:
        return Reason.STOPPED_ON_BRIDGE
    fit = _METHODS[settings.method](data, settings, window, report)
    if fit.ending is loop.Ending.NOT_FINITE:
        return Reason.NOT_FINITE
    return window, fit


def _trajectory(data: CrossingData) -> Trajectory | None:
    # No fixes later than those that are waited for: what came by chance must not matter.
    near = (data.fixes.time_s > data.stay.entry_s - 10.0) & (
        data.fixes.time_s <= data.stay.exit_s + MARGIN_S
    )
    if near.sum() < 2 or data.stay.passage is not Passage.THROUGH:
        return None
    antenna = data.vehicle.gps_antenna_to_front_axle_m
    latency = data.receiver.latency_s
    # Perfect receivers exist only in simulations; a floor keeps the fit well posed there.
    return fit_trajectory(
        data.fixes.time_s[near] - latency,
        data.chainage_m[near] + data.stay.direction * antenna,
        data.stay.direction * np.abs(data.fixes.speed_m_per_s[near]),
        position_noise_m=max(data.receiver.position_noise_m, 1e-3),
        speed_noise_m_per_s=max(data.receiver.speed_noise_m_per_s, 1e-3),
        start_s=data.stay.entry_s - MARGIN_S,
        stop_s=data.stay.exit_s + MARGIN_S,
    )


def _entry_and_exit(data: CrossingData, trajectory: Trajectory | None) -> tuple[float, float]:
    """When the front axle enters and the rear axle leaves, by the smooth curve if it says so."""
    stay = data.stay
    if trajectory is None:
        return stay.entry_s, stay.exit_s
    direction, span = stay.direction, data.bridge.span_m
    near, far = (0.0, span) if direction > 0 else (span, 0.0)
    begin, end = stay.entry_s - MARGIN_S, stay.exit_s + MARGIN_S
    entry = passing_time_s(trajectory, near, direction, begin, end)
    beyond = far + direction * data.vehicle.wheelbase_m
    leave = passing_time_s(trajectory, beyond, direction, begin, end)
    if not (np.isfinite(entry) and np.isfinite(leave)):
        return stay.entry_s, stay.exit_s
    return entry, leave


def _speed_m_per_s(data: CrossingData, entry_s: float, exit_s: float) -> float:
    """Mean speed of a crossing; of what is none, the middle one of the receiver's speeds."""
    if data.stay.passage is Passage.THROUGH and exit_s > entry_s:
        return (data.bridge.span_m + data.vehicle.wheelbase_m) / (exit_s - entry_s)
    near = (data.fixes.time_s >= data.stay.entry_s) & (data.fixes.time_s <= data.stay.exit_s)
    return float(np.median(np.abs(data.fixes.speed_m_per_s[near]))) if near.any() else 0.0


def _unusable(
    data: CrossingData,
    method: str,
    trajectory: Trajectory | None,
    entry_s: float,
    exit_s: float,
) -> list[Reason]:
    """Everything that forbids a fit before its samples are looked at."""
    if method != "pre" and data.bridge.interior_supports_m:
        return [Reason.CONTINUOUS_BRIDGE]
    reasons = list(data.against)
    match data.stay.passage:
        case Passage.TURNED_BACK:
            reasons.append(Reason.STOPPED_ON_BRIDGE)
        case Passage.BEGINS_ON_BRIDGE | Passage.ENDS_ON_BRIDGE:
            reasons.append(Reason.INCOMPLETE_CROSSING)
        case Passage.THROUGH:
            pass
    channels = data.samples.channels if data.samples is not None else {}
    if any(name not in channels for name in CHANNELS):
        reasons.append(Reason.CHANNEL_MISSING)
    if data.stay.passage is not Passage.THROUGH:
        return reasons
    outage_s = longest_outage_s(data.fixes.time_s, entry_s, exit_s)
    longest_s = _LONGEST_OUTAGE_S if method == "pre" else LONGEST_SURE_OUTAGE_S
    if trajectory is None or outage_s > longest_s:
        return [*reasons, Reason.POSITION_OUTAGE]
    times = np.linspace(entry_s, exit_s, 200)
    speed = data.stay.direction * trajectory.spline.derivative()(times)
    if speed.min() < _STANDING_M_PER_S:
        reasons.append(Reason.STOPPED_ON_BRIDGE)
    elif np.median(speed) < _SLOWEST_M_PER_S:
        reasons.append(Reason.SPEED_TOO_LOW)
    return reasons


def _size(samples: Samples) -> int:
    return next(iter(samples.channels.values())).size


def _covered(samples: Samples, time_s: Floats, entry_s: float, exit_s: float) -> slice | None:
    """The unbroken stretch of samples around the crossing; None if some are missing in it."""
    first = int(np.searchsorted(time_s, entry_s))
    last = int(np.searchsorted(time_s, exit_s, side="right"))
    spare = 4  # for the interpolation at the ends
    if first < spare or last + spare > time_s.size:
        return None
    complete = np.all([np.isfinite(values) for values in samples.channels.values()], axis=0)
    if not np.all(complete[first - spare : last + spare]):
        return None
    holes = np.flatnonzero(~complete)
    begin = int(holes[holes < first].max(initial=-1)) + 1
    stop = int(holes[holes >= last].min(initial=time_s.size))
    return slice(begin, stop)


def _window(
    data: CrossingData, settings: IdentificationSettings, acceleration: Floats, motion: Motion
) -> Window:
    vehicle = data.vehicle
    assert data.samples is not None  # noqa: S101 - `_unusable` saw to it
    return residual.build_window(
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


def _least_squares(
    data: CrossingData, settings: IdentificationSettings, window: Window, report: Report
) -> _Fit:
    nominal = nominal_parameters(data.vehicle, data.bridge)
    free = unknowns.paper_subset(data.bridge.elements)
    free = free[nominal[free] > 0.0]  # a site may say that a damping is exactly zero
    problem = least_squares.Problem(window, nominal, free)
    work = residual.workspace(window)
    rng = np.random.default_rng(settings.seed)
    best: tuple[levenberg_marquardt.State, loop.Ending] | None = None
    steps = evaluations = 0

    def progress(count: int, info: levenberg_marquardt.Info) -> None:
        report(f"least squares, step {count}", min(0.95, count / least_squares.MAX_STEPS))

    for attempt in range(settings.starts):
        start = nominal[free]
        if attempt > 0:
            start = start * rng.uniform(random_walk.PRIOR_LOW, random_walk.PRIOR_HIGH, free.size)
        state, infos, ending = loop.run(
            partial(least_squares.init, problem, work, start),
            partial(least_squares.step, problem, work),
            least_squares.MAX_STEPS,
            progress=progress,
        )
        steps += len(infos)
        evaluations += sum(info.evaluations for info in infos)
        if best is None or state.objective < best[0].objective:
            best = state, ending
        if ending is loop.Ending.CONVERGED:
            break
    assert best is not None  # noqa: S101 - `starts` is at least 1
    state, ending = best
    slope = least_squares.derivative_of_values(problem, state.y)
    return _Fit(
        least_squares.full_vector(problem, state.y),
        free,
        levenberg_marquardt.covariance(state) * np.outer(slope, slope),
        None,
        ending,
        {"iterations": float(steps), "evaluations": float(evaluations)},
    )


def _random_walk(
    data: CrossingData, settings: IdentificationSettings, window: Window, report: Report
) -> _Fit:
    nominal = nominal_parameters(data.vehicle, data.bridge)
    free = unknowns.paper_subset(data.bridge.elements)
    free = free[nominal[free] > 0.0]
    problem = random_walk.problem(window, nominal, free, settings.seed)

    def progress(count: int, info: random_walk.Info) -> None:
        report(f"random walk, step {count}", count / settings.steps)

    state, infos, ending = loop.run(
        partial(random_walk.init, problem, settings.particles),
        partial(random_walk.step, problem),
        settings.steps,
        at_the_end=loop.Ending.STEPS_DONE,
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


_METHODS: dict[str, Callable[[CrossingData, IdentificationSettings, Window, Report], _Fit]] = {
    "least_squares": _least_squares,
    "random_walk": _random_walk,
}


def _ran_away(data: CrossingData, fit: _Fit) -> bool:
    """Whether the search ended anywhere but at a minimum within reason."""
    if fit.ending in (loop.Ending.STEPS_EXHAUSTED, loop.Ending.STUCK):
        return True
    nominal = nominal_parameters(data.vehicle, data.bridge)[fit.free]
    factors = np.abs(np.log(fit.theta[fit.free] / nominal))
    return bool(factors.max() > np.log(_LARGEST_FACTOR))


def _result(
    data: CrossingData,
    settings: IdentificationSettings,
    passing: Passing,
    window: Window,
    fit: _Fit,
    motion: Motion,
    seconds: float,
) -> results.Crossing:
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
    if _ran_away(data, fit):
        # Under noise the plain residual has no minimum to speak of: no number is an estimate.
        return rejected(data, settings, passing, [Reason.NOT_CONVERGED], diagnostics=diagnostics)
    reasons = [Reason.NO_NOISE_MODEL]
    deflection_m = residual.largest_deflection_m(window, fit.theta)
    diagnostics["misfit_over_deflection"] = misfit_m / max(deflection_m, 1e-12)
    if diagnostics["misfit_over_deflection"] > _LARGEST_MISFIT:
        reasons.append(Reason.MODEL_MISFIT)
    if any(data.vehicle.tyre_damping_ns_per_m):
        reasons.append(Reason.TYRE_DAMPING_IGNORED)
    reasons += caveats(data, motion)
    values = _parameters(data, fit, settings)
    names = tuple(unknowns.names(data.bridge.elements)[i] for i in fit.free)
    return results.Crossing(
        **header(data, settings, passing),
        verdict="suspect",  # without a noise model nothing can be shown to be good
        reasons=tuple(reasons),
        diagnostics=diagnostics,
        parameters=values,
        covariance=results.Covariance(
            names=names, matrix=tuple(tuple(row) for row in fit.covariance.tolist())
        ),
        derived=_derived(data, window, fit, values),
        road=road_result(data, roads.x_m, roads.front_m, roads.rear_m),
    )


def _parameters(
    data: CrossingData, fit: _Fit, settings: IdentificationSettings
) -> dict[str, results.Parameter]:
    nominal = nominal_parameters(data.vehicle, data.bridge)
    names = unknowns.names(data.bridge.elements)
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
            unit=unknowns.unit(names[i]),
            mean=mean,
            std=float(std[k]),
            q025=float(low),
            q50=float(middle),
            q975=float(high),
            prior=_start_of_search(float(nominal[i]), settings),
        )
    return values | _derived_masses(data, fit)


def _start_of_search(nominal: float, settings: IdentificationSettings) -> results.Prior | None:
    """The random walk starts uniformly around the nominal value; least squares has no prior."""
    if settings.method != "random_walk":
        return None
    half_width = 0.5 * (random_walk.PRIOR_HIGH - random_walk.PRIOR_LOW) * abs(nominal)
    return results.Prior(distribution="uniform", location=nominal, scale=half_width)


def _derived_masses(data: CrossingData, fit: _Fit) -> dict[str, results.Parameter]:
    """m_s, m_s1, m_s2 and their formal spread to first order."""
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
    """A quantity (q,) of the parameters and its standard deviation to first order.

    Central differences of a thousandth, as at the bottom of the search: smaller ones to one side
    would carry the processor's rounding into the spread.
    """
    centre = np.atleast_1d(quantity(fit.theta))
    slopes = np.empty((centre.size, fit.free.size))
    for k, i in enumerate(fit.free):
        ahead, behind = fit.theta.copy(), fit.theta.copy()
        step = 1e-3 * fit.theta[i]
        ahead[i] += step
        behind[i] -= step
        slopes[:, k] = (np.atleast_1d(quantity(ahead)) - np.atleast_1d(quantity(behind))) / (
            2.0 * step
        )
    variance = np.einsum("qi,ij,qj->q", slopes, fit.covariance, slopes)
    return centre, np.sqrt(np.maximum(variance, 0.0))


def _derived(
    data: CrossingData, window: Window, fit: _Fit, values: dict[str, results.Parameter]
) -> results.Derived:
    frequency, frequency_std = _propagated(
        fit, lambda theta: natural_frequencies_hz(beam_of(data, theta), 1)
    )
    deflection, deflection_std = _propagated(
        fit, lambda theta: np.array([residual.largest_deflection_m(window, theta)])
    )
    return results.Derived(
        f1_hz=gaussian("Hz", float(frequency[0]), float(frequency_std[0])),
        max_deflection_m=gaussian("m", float(deflection[0]), float(deflection_std[0])),
    )
