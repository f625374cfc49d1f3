"""Identification of one crossing: from samples and fixes to a result with a verdict.

`identify` checks conditions before any fit (a missing channel, a gap, no position, too slow), fits,
and judges the answer. Every failure is a verdict, not an exception. No I/O, no clock.
"""

import logging
from collections.abc import Callable
from functools import partial
from typing import Protocol

import numpy as np
from pydantic import ValidationError

from pre_core.crossing.splines import Spline, value_at
from pre_core.crossing.trajectory import arrival_time_s, fit_trajectory, motion_at
from pre_core.physics.simulate import Motion
from pre_core.search.loop import Report
from schemas import results
from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData, Window
from services.finding.placed import Spreads, middle_of, one_sided_channels
from services.finding.stays import STANDING_M_PER_S, Passage
from services.finding.streams import Samples
from services.identification.methods import METHODS, IdentificationMethod
from services.identification.paper_method import identify_paper
from services.identification.pre_method import Keep as Keep
from services.identification.pre_method import MethodRun, identify_pre
from services.identification.result_parts import (
    CrossingSamples,
    CrossingTimes,
    longest_outage_s,
    rejected,
)
from services.identification.signal_checks import reasons_before_fit, unmeasured

_log = logging.getLogger(__name__)
Stopwatch = Callable[[], float]


class Identify(Protocol):
    """Type of `identify`, from one crossing to its result."""

    def __call__(  # noqa: D102
        self,
        data: CrossingData,
        settings: IdentificationSettings,
        *,
        stopwatch: Stopwatch,
        report: Report = ...,
        keep: Keep = ...,
    ) -> results.CrossingResult: ...


SLOWEST_M_PER_S = 3.0
"""Speed below which the wheels are hardly affected by the bridge's stiffness."""
_JUDGED_MARGIN_S = 1.0
"""Time in s before and after the bridge over which signals are judged, and the thresholds were
determined."""
_SLOW_SHARE = 0.4
"""Share of the speed on the bridge below which the road on either side is not used."""


# A search tries values beyond the range of floats, and detects an infinite objective itself.
@np.errstate(all="ignore")
def identify(
    data: CrossingData,
    settings: IdentificationSettings,
    *,
    stopwatch: Stopwatch,
    report: Report = lambda stage, fraction: None,
    keep: Keep = lambda crossing_id, draws: None,
) -> results.CrossingResult:
    """Return the result of one crossing, whatever its data; pass its draws, if any, to `keep`."""
    began = stopwatch()
    method = METHODS[settings.method]
    around = method.window(data.stay, data.bridge, data.vehicle)
    trajectory = _trajectory(data, around)
    entry_s, exit_s = _entry_and_exit(data, trajectory, around)
    passing = CrossingTimes(entry_s, exit_s, _speed_m_per_s(data, entry_s, exit_s))
    reject = partial(rejected, data, settings, passing)
    reasons = _rejection_reasons(data, method, trajectory, entry_s, exit_s)
    if reasons or trajectory is None or data.samples is None:
        about = {
            Reason.CHANNEL_MISSING: _missing_channels(data),
            Reason.ROLL_NOT_SEEN: _one_sided_sensors(data),
        }
        return reject(reasons or [Reason.FAILED], about)
    try:
        cut = _crossing_samples(data, trajectory, data.samples, passing)
        if cut is None:
            return reject([Reason.GAP_ON_BRIDGE])
        near = _near(cut, passing, 1.0 / data.samples.rate_hz)
        step_s = 1.0 / data.samples.rate_hz
        broken = reasons_before_fit(
            data.vehicle,
            cut.acceleration[:, near],
            step_s,
            Motion(*(values[near] for values in cut.motion)),
            data.stay.direction,
            Spreads(data.sensor.gain_spread, data.sensor.delay_spread_s),
        ) or unmeasured(data.vehicle.channels, cut.acceleration, step_s)
        if broken:
            return reject(broken, broken)
        cut = cut._replace(acceleration=middle_of(data.vehicle, cut.acceleration))
        if method.has_noise_model:
            run = MethodRun(report, lambda: stopwatch() - began, keep)
            return identify_pre(data, settings, passing, cut, run)
        return identify_paper(
            data,
            settings,
            passing,
            cut.acceleration,
            cut.motion,
            report,
            lambda: stopwatch() - began,
        )
    except Exception as error:  # whatever the data, the answer is a verdict
        if is_not_finite(error):
            _log.info("%s: %s: %s", data.crossing_id, type(error).__name__, error)
            return reject([Reason.NOT_FINITE])
        _log.exception("identification of %s failed", data.crossing_id)
        return reject([Reason.FAILED])


def is_not_finite(error: Exception) -> bool:
    """Return whether an error indicates numbers beyond the range of floats.

    Extreme values of a site file lead there: overflows, bridges without modes, and fields of a
    result that only accept finite numbers.
    """
    if isinstance(error, ValidationError):
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        return all(problem["type"] == "finite_number" for problem in problems)
    return isinstance(error, ArithmeticError)


def _crossing_samples(
    data: CrossingData, trajectory: Spline, samples: Samples, passing: CrossingTimes
) -> CrossingSamples | None:
    """Return the unbroken samples around the crossing; None if some are missing in it."""
    time_s = samples.start_s + np.arange(_size(samples)) / samples.rate_hz
    part = _unbroken_samples(samples, time_s, passing.entry_s, passing.exit_s)
    if part is None:
        return None
    motion = motion_at(trajectory, time_s[part], data.stay.direction)
    driving = _driving(time_s[part], motion, passing)
    return CrossingSamples(
        np.stack([samples.channels[name][part][driving] for name in data.vehicle.channels]),
        float(time_s[part][driving][0]),
        Motion(*(values[driving] for values in motion)),
    )


def _near(cut: CrossingSamples, passing: CrossingTimes, step_s: float) -> slice:
    """Return the samples of the crossing itself, for which the thresholds were determined."""
    time_s = cut.start_s + step_s * np.arange(cut.acceleration.shape[1])
    edges = (passing.entry_s - _JUDGED_MARGIN_S, passing.exit_s + _JUDGED_MARGIN_S)
    first, last = np.searchsorted(time_s, edges)
    return slice(int(first), int(last))


def _driving(time_s: Floats, motion: Motion, passing: CrossingTimes) -> slice:
    """Return the samples around the crossing at which the truck does not nearly stand."""
    slow = np.abs(motion.speed_m_per_s) < _SLOW_SHARE * passing.speed_m_per_s
    before = np.flatnonzero(slow & (time_s < passing.entry_s))
    behind = np.flatnonzero(slow & (time_s > passing.exit_s))
    return slice(int(before.max(initial=-1)) + 1, int(behind.min(initial=time_s.size)))


def _trajectory(data: CrossingData, around: Window) -> Spline | None:
    # Use no fixes later than those awaited: later ones, present by chance, must not matter.
    near = (data.fixes.time_s > data.stay.entry_s - 10.0) & (data.fixes.time_s <= around.end_s)
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
        start_s=around.begin_s,
        stop_s=around.end_s,
    )


def _entry_and_exit(
    data: CrossingData, trajectory: Spline | None, around: Window
) -> tuple[float, float]:
    """Return entry of the front and exit of the rear axle, by the smooth curve if it has them."""
    stay = data.stay
    if trajectory is None:
        return stay.entry_s, stay.exit_s
    direction, span = stay.direction, data.bridge.span_m
    near, far = (0.0, span) if direction > 0 else (span, 0.0)
    begin, end = around
    entry = arrival_time_s(trajectory, near, direction, begin, end)
    beyond = far + direction * data.vehicle.length_m
    leave = arrival_time_s(trajectory, beyond, direction, begin, end)
    if not (np.isfinite(entry) and np.isfinite(leave)):
        return stay.entry_s, stay.exit_s
    return entry, leave


def _speed_m_per_s(data: CrossingData, entry_s: float, exit_s: float) -> float:
    """Return the mean speed of a crossing; otherwise the median of the receiver's speeds."""
    if data.stay.passage is Passage.THROUGH and exit_s > entry_s:
        return (data.bridge.span_m + data.vehicle.length_m) / (exit_s - entry_s)
    near = (data.fixes.time_s >= data.stay.entry_s) & (data.fixes.time_s <= data.stay.exit_s)
    return float(np.median(np.abs(data.fixes.speed_m_per_s[near]))) if near.any() else 0.0


def _rejection_reasons(
    data: CrossingData,
    method: IdentificationMethod,
    trajectory: Spline | None,
    entry_s: float,
    exit_s: float,
) -> list[Reason]:
    """Return all reasons that forbid a fit before its samples are checked."""
    if not method.is_general and data.bridge.interior_supports_m:
        return [Reason.CONTINUOUS_BRIDGE]
    if not method.is_general and data.vehicle.tandem is not None:
        return [Reason.TANDEM]
    reasons = list(data.against)
    match data.stay.passage:
        case Passage.TURNED_BACK:
            reasons.append(Reason.STOPPED_ON_BRIDGE)
        case Passage.BEGINS_ON_BRIDGE | Passage.ENDS_ON_BRIDGE:
            reasons.append(Reason.INCOMPLETE_CROSSING)
        case Passage.THROUGH:
            pass
    if _missing_channels(data):
        reasons.append(Reason.CHANNEL_MISSING)
    if _one_sided_sensors(data):
        reasons.append(Reason.ROLL_NOT_SEEN)
    if data.stay.passage is not Passage.THROUGH:
        return reasons
    outage_s = longest_outage_s(data.fixes.time_s, entry_s, exit_s)
    if trajectory is None or outage_s > method.longest_outage_s:
        return [*reasons, Reason.POSITION_OUTAGE]
    times = np.linspace(entry_s, exit_s, 200)
    speed = data.stay.direction * value_at(trajectory, times, 1)
    if speed.min() < STANDING_M_PER_S:
        reasons.append(Reason.STOPPED_ON_BRIDGE)
    elif np.median(speed) < SLOWEST_M_PER_S:
        reasons.append(Reason.SPEED_TOO_LOW)
    return reasons


def _missing_channels(data: CrossingData) -> str:
    """Return the names of the channels that the truck lacks."""
    there = data.samples.channels if data.samples is not None else {}
    return ", ".join(name for name in data.vehicle.channels if name not in there)


def _one_sided_sensors(data: CrossingData) -> str:
    """Return the names of the sensors of parts that are measured on one side only."""
    return one_sided_channels(data.vehicle, () if data.samples is None else data.samples.channels)


def _size(samples: Samples) -> int:
    return next(iter(samples.channels.values())).size


def _unbroken_samples(
    samples: Samples, time_s: Floats, entry_s: float, exit_s: float
) -> slice | None:
    """Return the unbroken samples around the crossing; None if some are missing in it."""
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
