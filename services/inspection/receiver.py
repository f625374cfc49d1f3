"""The satellite receiver and the truck's clocks."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.site import Receiver
from services.common.geodesy import on_plane_m
from services.identification.crossing_data import LONGEST_SURE_OUTAGE_S
from services.identification.stays import STANDING_M_PER_S
from services.inspection.finding import Finding, State, judged
from services.inspection.recorded import Clock, Recorded

Floats = NDArray[np.float64]

_LOWEST_RATE_HZ: Final = 0.9
_SMALLEST_JUMP_M: Final = 5.0
_MOST_NOISE: Final = 2.0
"""Over the declared."""
_POOR_M: Final = 5.0
"""A receiver that is no better does not tell which lane, and hardly which bridge."""
_FEWEST_FIXES: Final = 20
_LARGEST_STEP_S: Final = 0.05
_LARGEST_OFFSET_S: Final = 0.05
_LARGEST_DRIFT: Final = 1e-4
_SHORTEST_FOR_DRIFT_S: Final = 60.0
_LONGEST_CURVE_S: Final = 1.0
"""Fixes further apart show the truck's own turns and changes of speed instead of noise."""


def receiver_of(run: Recorded, declared: Receiver) -> Iterator[Finding]:
    """Rate, gaps, jumps, noise and stated accuracy of the fixes."""
    time_s = run.fixes.time_s
    if time_s.size < _FEWEST_FIXES:
        yield Finding(
            "positions",
            State.WRONG,
            f"{time_s.size} fixes",
            "look at receiver and antenna: crossings are found by the positions",
        )
        return
    apart_s = float(np.median(np.diff(time_s)))
    yield judged(
        "position_rate",
        f"{1.0 / apart_s:.3g} fixes a second",
        "set the receiver to 1 Hz or more, better 10",
        is_wrong=1.0 / apart_s < _LOWEST_RATE_HZ,
    )
    longest_s = float(np.diff(time_s).max())
    yield judged(
        "position_gaps",
        f"longest time without a fix {longest_s:.2f} s",
        f"more than {LONGEST_SURE_OUTAGE_S:g} s at the bridge makes a crossing suspect: look at "
        "the antenna's view",
        is_wrong=longest_s > max(LONGEST_SURE_OUTAGE_S, 1.5 * apart_s),
    )
    along, beside = on_plane_m(run.fixes.latitude_deg, run.fixes.longitude_deg)
    yield _jumps(time_s, along, beside, run.fixes.speed_m_per_s, declared)
    if apart_s <= _LONGEST_CURVE_S:
        yield _position_noise(along, beside, declared)
        yield _speed_noise(run.fixes.speed_m_per_s, declared)
    stated = run.accuracy_m[np.isfinite(run.accuracy_m)]
    if stated.size:
        typical = float(np.median(stated))
        yield judged(
            "accuracy_stated",
            f"the receiver says ± {typical:.2f} m of itself",
            "wait for a better fix, look at the antenna, use corrections",
            is_wrong=typical > _POOR_M,
        )


def _jumps(time_s: Floats, x: Floats, y: Floats, speed: Floats, declared: Receiver) -> Finding:
    """Steps of the position that the speed does not explain."""
    moved = np.hypot(np.diff(x), np.diff(y))
    expected = 0.5 * (speed[1:] + speed[:-1]) * np.diff(time_s)
    limit = max(_SMALLEST_JUMP_M, 8.0 * declared.position_noise_m)
    jumps = np.abs(moved - expected)
    count = int(np.count_nonzero(jumps > limit))
    return judged(
        "position_jumps",
        f"{count} jumps of the position"
        + (f", the largest by {jumps.max():.1f} m" if count else ""),
        "look at the antenna's view; a jump at a bridge spoils the trajectory",
        is_wrong=count > 0,
    )


def _white(values: Floats) -> float:
    """Standard deviation of white noise by third differences, which smooth motion has not."""
    third = np.diff(values, 3)
    # Those of unit white noise have the variance 1 + 9 + 9 + 1; the median is blind to jumps.
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0))


def _position_noise(x: Floats, y: Floats, declared: Receiver) -> Finding:
    noise = float(np.hypot(_white(x), _white(y)) / np.sqrt(2.0))
    return judged(
        "position_noise",
        f"positions scatter by {noise:.2f} m from fix to fix, position_noise_m "
        f"{declared.position_noise_m:g}",
        "declare it in [receiver], or look at the antenna",
        is_wrong=noise > _MOST_NOISE * max(declared.position_noise_m, 0.01),
    )


def _speed_noise(speed: Floats, declared: Receiver) -> Finding:
    noise = _white(speed)
    return judged(
        "speed_noise",
        f"speeds scatter by {noise:.3f} m/s, speed_noise_m_per_s {declared.speed_noise_m_per_s:g}",
        "declare it in [receiver]",
        is_wrong=noise > _MOST_NOISE * max(declared.speed_noise_m_per_s, 0.003),
    )


def clocks(run: Recorded) -> Iterator[Finding]:
    """Steps and drift of the wall clock, and whether both streams have the same."""
    usable = {name: clock for name, clock in run.clocks.items() if clock.device_s.size > 1}
    for name, clock in usable.items():
        steps = np.abs(np.diff(clock.wall_less_device_s))
        yield judged(
            "clock_steps",
            f"{name}: largest step of the wall clock {steps.max() * 1e3:.1f} ms",
            "keep the clock disciplined (chrony, PTP) and do not set it while recording",
            is_wrong=float(steps.max()) > _LARGEST_STEP_S,
        )
        seconds = float(np.ptp(clock.device_s))
        if seconds >= _SHORTEST_FOR_DRIFT_S:
            drift = _drift(clock)
            yield judged(
                "clock_drift",
                f"{name}: the truck's clock drifts by {1e6 * drift:+.1f} ppm",
                "look at the logger's clock: accelerations and positions would come apart",
                is_wrong=abs(drift) > _LARGEST_DRIFT,
            )
    if len(usable) == len(run.clocks):
        offsets = [float(np.median(clock.wall_less_device_s)) for clock in usable.values()]
        apart_s = abs(offsets[0] - offsets[1])
        yield judged(
            "clock_offset",
            f"clocks of accelerations and positions {apart_s * 1e3:.1f} ms apart",
            "stamp both by one clock",
            is_wrong=apart_s > _LARGEST_OFFSET_S,
        )


def _drift(clock: Clock) -> float:
    centred = clock.device_s - clock.device_s.mean()
    return float(centred @ clock.wall_less_device_s / (centred @ centred))


def standing(run: Recorded) -> tuple[float, float] | None:
    """From when to when the truck stood longest, by its fixes; None if it did not."""
    time_s, speed = run.fixes.time_s, run.fixes.speed_m_per_s
    best: tuple[float, float] | None = None
    begin: float | None = None
    for t, v in zip(time_s.tolist(), speed.tolist(), strict=True):
        if v >= STANDING_M_PER_S:
            begin = None
            continue
        begin = t if begin is None else begin
        if best is None or t - begin > best[1] - best[0]:
            best = (begin, t)
    return best
