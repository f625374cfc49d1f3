"""One crossing: from samples and fixes to a result with a verdict. No I/O, no clock.

`identify` checks what can be checked before any fitting (a missing channel, a gap, no position, too
slow), fits, and says what the answer is worth. Every way to fail is a verdict, not an exception.
"""

import logging
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from pydantic import ValidationError

from pre_core.crossing.splines import value_at
from pre_core.crossing.trajectory import Trajectory, fit_trajectory, motion_at, passing_time_s
from pre_core.physics.simulate import Motion
from pre_core.search.loop import Report
from schemas import results
from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from services.identification.crossing_data import (
    LONGEST_SURE_OUTAGE_S,
    CrossingData,
    Floats,
    Passing,
    Window,
    longest_outage_s,
    rejected,
    window,
)
from services.identification.paper_method import identify_paper
from services.identification.placed import Spreads, hidden, middle_of
from services.identification.pre_method import Keep as Keep
from services.identification.pre_method import identify_pre
from services.identification.signal_checks import reasons_before_fit, unmeasured
from services.identification.stays import STANDING_M_PER_S, Passage
from services.identification.streams import Samples

_log = logging.getLogger(__name__)
Stopwatch = Callable[[], float]


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


SLOWEST_M_PER_S = 3.0
"""Below this the wheels feel next to nothing of the bridge's stiffness."""
_JUDGED_ASIDE_S = 1.0
"""Signals are judged so far before and behind the bridge, where thresholds were found."""
_SLOW_SHARE = 0.4
"""Slower than this share of the speed on the bridge the road on either side is not looked at."""
_LONGEST_OUTAGE_S = 8.0
"""So long without a fix the trajectory may be found from the axles' signals, by method `pre`."""


# A search tries values beyond what floats hold, and sees by itself that an objective is not finite.
@np.errstate(all="ignore")
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
    around = window(data.stay, data.bridge, data.vehicle, settings.method)
    trajectory = _trajectory(data, around)
    entry_s, exit_s = _entry_and_exit(data, trajectory, around)
    passing = Passing(entry_s, exit_s, _speed_m_per_s(data, entry_s, exit_s))
    reject = partial(rejected, data, settings, passing)
    reasons = _unusable(data, settings.method, trajectory, entry_s, exit_s)
    if reasons or trajectory is None or data.samples is None:
        about = {Reason.CHANNEL_MISSING: _missing(data), Reason.ROLL_NOT_SEEN: _hidden(data)}
        return reject(reasons or [Reason.FAILED], about)
    try:
        cut = _cut(data, trajectory, data.samples, passing)
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
        if settings.method == "pre":
            return identify_pre(
                data, settings, passing, *cut, report, lambda: stopwatch() - began, keep
            )
        return identify_paper(
            data,
            settings,
            passing,
            cut.acceleration,
            cut.motion,
            report,
            lambda: stopwatch() - began,
        )
    except Exception as error:  # whatever the data are, the answer is a verdict
        if is_not_finite(error):
            _log.info("%s: %s: %s", data.crossing_id, type(error).__name__, error)
            return reject([Reason.NOT_FINITE])
        _log.exception("identification of %s failed", data.crossing_id)
        return reject([Reason.FAILED])


def is_not_finite(error: Exception) -> bool:
    """Return whether an error says that numbers of a fit or a result are beyond what floats hold.

    Values at the edge of what a site file may say lead there: overflows, bridges without modes,
    and fields of a result that only take finite numbers.
    """
    if isinstance(error, ValidationError):
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        return all(problem["type"] == "finite_number" for problem in problems)
    return isinstance(error, ArithmeticError)


class _Cut(NamedTuple):
    """The samples of a crossing and where the truck was at them."""

    acceleration: Floats
    """(m, n) of all channels of the vehicle, in its order; (4, n) once they are reduced."""
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
    motion = motion_at(trajectory, time_s[part], data.stay.direction)
    driving = _driving(time_s[part], motion, passing)
    return _Cut(
        np.stack([samples.channels[name][part][driving] for name in data.vehicle.channels]),
        float(time_s[part][driving][0]),
        Motion(*(values[driving] for values in motion)),
    )


def _near(cut: _Cut, passing: Passing, step_s: float) -> slice:
    """The samples of the crossing itself: signals are judged where the thresholds were found."""
    time_s = cut.start_s + step_s * np.arange(cut.acceleration.shape[1])
    edges = (passing.entry_s - _JUDGED_ASIDE_S, passing.exit_s + _JUDGED_ASIDE_S)
    first, last = np.searchsorted(time_s, edges)
    return slice(int(first), int(last))


def _driving(time_s: Floats, motion: Motion, passing: Passing) -> slice:
    """The samples around the crossing at which the truck does not nearly stand."""
    slow = np.abs(motion.speed_m_per_s) < _SLOW_SHARE * passing.speed_m_per_s
    before = np.flatnonzero(slow & (time_s < passing.entry_s))
    behind = np.flatnonzero(slow & (time_s > passing.exit_s))
    return slice(int(before.max(initial=-1)) + 1, int(behind.min(initial=time_s.size)))


def _trajectory(data: CrossingData, around: Window) -> Trajectory | None:
    # No fixes later than those that are waited for: what came by chance must not matter.
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
    data: CrossingData, trajectory: Trajectory | None, around: Window
) -> tuple[float, float]:
    """When the front axle enters and the rear axle leaves, by the smooth curve if it says so."""
    stay = data.stay
    if trajectory is None:
        return stay.entry_s, stay.exit_s
    direction, span = stay.direction, data.bridge.span_m
    near, far = (0.0, span) if direction > 0 else (span, 0.0)
    begin, end = around
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
    if _missing(data):
        reasons.append(Reason.CHANNEL_MISSING)
    if _hidden(data):
        reasons.append(Reason.ROLL_NOT_SEEN)
    if data.stay.passage is not Passage.THROUGH:
        return reasons
    outage_s = longest_outage_s(data.fixes.time_s, entry_s, exit_s)
    longest_s = _LONGEST_OUTAGE_S if method == "pre" else LONGEST_SURE_OUTAGE_S
    if trajectory is None or outage_s > longest_s:
        return [*reasons, Reason.POSITION_OUTAGE]
    times = np.linspace(entry_s, exit_s, 200)
    speed = data.stay.direction * value_at(trajectory.spline, times, 1)
    if speed.min() < STANDING_M_PER_S:
        reasons.append(Reason.STOPPED_ON_BRIDGE)
    elif np.median(speed) < SLOWEST_M_PER_S:
        reasons.append(Reason.SPEED_TOO_LOW)
    return reasons


def _missing(data: CrossingData) -> str:
    """Names of the channels that the truck lacks."""
    there = data.samples.channels if data.samples is not None else {}
    return ", ".join(name for name in data.vehicle.channels if name not in there)


def _hidden(data: CrossingData) -> str:
    """Names of the sensors that there are of parts that are measured on one side only."""
    return hidden(data.vehicle, () if data.samples is None else data.samples.channels)


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
