"""Checks of the GNSS receiver and the truck's clocks."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from schemas.site import Receiver
from services.common.arrays import Floats
from services.common.geodesy import on_plane_m
from services.common.naming import count_of
from services.finding.stays import STANDING_M_PER_S
from services.identification.methods import LONGEST_SURE_OUTAGE_S
from services.inspection.finding import CheckFinding, CheckStatus, check_finding
from services.inspection.recorded import ClockSeries, InspectedRun

_LOWEST_RATE_HZ: Final = 0.9
_SMALLEST_JUMP_M: Final = 5.0
_MAX_NOISE: Final = 2.0
"""Ratio to the declared noise."""
_POOR_M: Final = 5.0
"""Accuracy in m at which a receiver determines no lane, and hardly a bridge."""
_FEWEST_FIXES: Final = 20
_LARGEST_STEP_S: Final = 0.05
_LARGEST_OFFSET_S: Final = 0.05
_LARGEST_DRIFT: Final = 1e-4
_SHORTEST_FOR_DRIFT_S: Final = 60.0
_LONGEST_CURVE_S: Final = 1.0
"""Distance in s beyond which fixes show the truck's own motion instead of noise."""


def receiver_of(run: InspectedRun, declared: Receiver) -> Iterator[CheckFinding]:
    """Yield findings on rate, gaps, jumps, noise and stated accuracy of the fixes."""
    time_s = run.fixes.time_s
    if time_s.size < _FEWEST_FIXES:
        yield CheckFinding(
            "positions",
            CheckStatus.WRONG,
            f"{count_of(time_s.size, 'fix', 'fixes')}, at least {_FEWEST_FIXES} are needed",
            "record longer, or check receiver and antenna: crossings are detected by the positions",
        )
        return
    apart_s = float(np.median(np.diff(time_s)))
    yield check_finding(
        "position_rate",
        f"fixes at {1.0 / apart_s:.3g} Hz",
        "set the receiver to 1 Hz or more, better to 10 Hz",
        is_wrong=1.0 / apart_s < _LOWEST_RATE_HZ,
    )
    longest_s = float(np.diff(time_s).max())
    yield check_finding(
        "position_gaps",
        f"longest time without a fix {longest_s:.2f} s",
        f"more than {LONGEST_SURE_OUTAGE_S:g} s at the bridge makes a crossing suspect: check "
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
        yield check_finding(
            "accuracy_stated",
            f"the receiver states an accuracy of ± {typical:.2f} m",
            "wait for a better fix, check the antenna, use corrections",
            is_wrong=typical > _POOR_M,
        )


def _jumps(time_s: Floats, x: Floats, y: Floats, speed: Floats, declared: Receiver) -> CheckFinding:
    """Check for steps of the position that the speed does not explain, shapes (n,)."""
    moved = np.hypot(np.diff(x), np.diff(y))
    expected = 0.5 * (speed[1:] + speed[:-1]) * np.diff(time_s)
    limit = max(_SMALLEST_JUMP_M, 8.0 * declared.position_noise_m)
    jumps = np.abs(moved - expected)
    count = int(np.count_nonzero(jumps > limit))
    return check_finding(
        "position_jumps",
        f"{count_of(count, 'jump')} of the position"
        + (f", the largest by {jumps.max():.1f} m" if count else ""),
        "check the antenna's view; a jump at a bridge spoils the trajectory",
        is_wrong=count > 0,
    )


def _white(values: Floats) -> float:
    """Return the standard deviation of white noise in (n,), by third differences."""
    third = np.diff(values, 3)
    # Third differences of unit white noise have the variance 1 + 9 + 9 + 1; the median is robust to
    # jumps.
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20.0))


def _position_noise(x: Floats, y: Floats, declared: Receiver) -> CheckFinding:
    noise = float(np.hypot(_white(x), _white(y)) / np.sqrt(2.0))
    return check_finding(
        "position_noise",
        f"positions scatter by {noise:.2f} m from fix to fix, position_noise_m is "
        f"{declared.position_noise_m:g}",
        "declare position_noise_m in [receiver], or check the antenna",
        is_wrong=noise > _MAX_NOISE * max(declared.position_noise_m, 0.01),
    )


def _speed_noise(speed: Floats, declared: Receiver) -> CheckFinding:
    noise = _white(speed)
    return check_finding(
        "speed_noise",
        f"speeds scatter by {noise:.3f} m/s, speed_noise_m_per_s is "
        f"{declared.speed_noise_m_per_s:g}",
        "declare speed_noise_m_per_s in [receiver]",
        is_wrong=noise > _MAX_NOISE * max(declared.speed_noise_m_per_s, 0.003),
    )


def clocks(run: InspectedRun) -> Iterator[CheckFinding]:
    """Yield findings on steps and drift of the wall clock, and on the offset between streams."""
    usable = {name: clock for name, clock in run.clocks.items() if clock.device_s.size > 1}
    for name, clock in usable.items():
        steps = np.abs(np.diff(clock.wall_less_device_s))
        yield check_finding(
            "clock_steps",
            f"{name}: largest step of the wall clock {steps.max() * 1e3:.1f} ms",
            "keep the clock disciplined (chrony, PTP) and do not set it while recording",
            is_wrong=float(steps.max()) > _LARGEST_STEP_S,
        )
        seconds = float(np.ptp(clock.device_s))
        if seconds >= _SHORTEST_FOR_DRIFT_S:
            drift = _drift(clock)
            yield check_finding(
                "clock_drift",
                f"{name}: the truck's clock drifts by {1e6 * drift:+.1f} ppm",
                "check the truck's clock: accelerations and positions drift apart",
                is_wrong=abs(drift) > _LARGEST_DRIFT,
            )
    if len(usable) == len(run.clocks):
        offsets = [float(np.median(clock.wall_less_device_s)) for clock in usable.values()]
        apart_s = abs(offsets[0] - offsets[1])
        yield check_finding(
            "clock_offset",
            f"clocks of accelerations and positions {apart_s * 1e3:.1f} ms apart",
            "take both time stamps from one clock",
            is_wrong=apart_s > _LARGEST_OFFSET_S,
        )


def _drift(clock: ClockSeries) -> float:
    centred = clock.device_s - clock.device_s.mean()
    return float(centred @ clock.wall_less_device_s / (centred @ centred))


def longest_standstill(run: InspectedRun) -> tuple[float, float] | None:
    """Return begin and end of the truck's longest standstill, by its fixes; None without one."""
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
