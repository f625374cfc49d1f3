"""Checks of accelerometers: presence, signals, positions and orientation."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.diagnostics import quality, same_place
from pre_core.physics.simulate import Motion
from schemas.reasons import REASON_TEXTS, Reason
from schemas.site import Sensor, Vehicle
from services.common.arrays import Floats
from services.common.naming import count_of
from services.finding import placed
from services.finding.placed import rates_hz
from services.identification import signal_checks
from services.inspection.finding import CheckFinding, CheckStatus, check_finding
from services.inspection.recorded import InspectedRun

_LARGEST_RATE_ERROR: Final = 0.02
"""Largest relative error of a rate: a crystal has 1e-4, more is another setting."""
_TRIED: Final = (0.6, 1.6)
_STEP_M: Final = 0.02
_OTHER_WHEELBASE_M, _OTHER_WHEELBASE = 0.4, 0.08
"""Deviation of the wheelbase that a correlation of the axles may have by chance."""
_FAR_LEAD: Final = 0.6
_LARGEST_FACTOR: Final = 2.5
"""Factor between k/m and its declared value; a data sheet's 15 % of both is far below."""


def check_presence(run: InspectedRun, vehicle: Vehicle) -> Iterator[CheckFinding]:
    """Check whether all of the vehicle's accelerometers were recorded, and no unlisted ones."""
    recorded = () if run.samples is None else tuple(run.samples.channels)
    missing = [name for name in vehicle.channels if name not in recorded]
    unknown = [name for name in recorded if name not in vehicle.channels]
    if unknown:
        yield CheckFinding(
            "channels_unknown",
            CheckStatus.WRONG,
            f"{', '.join(unknown)} recorded, but not in the site file",
            "name every accelerometer in [[vehicle.sensors]]: others are not used",
        )
    there = len(vehicle.channels) - len(missing)
    yield check_finding(
        "channels_present",
        f"{there} of {len(vehicle.channels)} accelerometers recorded"
        + (f", {', '.join(missing)} missing" if missing else ""),
        "check plugs and logger: a crossing without one of them is rejected",
        is_wrong=bool(missing),
    )


def rates(run: InspectedRun, sensor: Sensor, vehicle: Vehicle) -> Iterator[CheckFinding]:
    """Check sampling rates against the site file."""
    for name, declared in rates_hz(sensor, vehicle).items():
        if name not in run.rates_hz:
            continue
        rate = run.rates_hz[name]
        yield check_finding(
            "sampling_rate",
            f"{name}: {rate:.1f} samples a second, {declared:g} declared",
            "declare the sensor's rate, or set the sensor to the declared one",
            is_wrong=abs(rate / declared - 1.0) > _LARGEST_RATE_ERROR,
        )


def gaps(run: InspectedRun) -> CheckFinding:
    """Check for missing samples."""
    assert run.samples is not None  # noqa: S101 - the caller has checked
    values = np.stack(list(run.samples.channels.values()))
    holes = ~np.isfinite(values).all(axis=0)
    longest_s = _longest(np.asarray(holes)) / run.samples.rate_hz
    return check_finding(
        "gaps",
        f"{100.0 * holes.mean():.2f} % of the samples missing, "
        f"{count_of(run.missing_batches, 'batch', 'batches')} lost, longest gap {longest_s:.2f} s",
        "check logger and cables: a gap on the bridge rejects the crossing",
        is_wrong=bool(holes.any()),
    )


def _longest(holes: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holes, [False]]).astype(np.int8)))
    return int(np.diff(edges)[::2].max(initial=0))


def check_signals(
    names: tuple[str, ...], acceleration: Floats, step_s: float
) -> Iterator[CheckFinding]:
    """Check each channel (c, n) for constant, biased or saturated signals, and spikes."""
    for name, values in zip(names, acceleration, strict=True):
        held_s = quality.longest_hold(values) * step_s
        mean = float(values.mean())
        if held_s > signal_checks.LONGEST_HOLD_S:
            yield CheckFinding(
                "channel_stuck",
                CheckStatus.WRONG,
                f"{name}: constant for {held_s:.2f} s",
                "the sensor does not measure: check its plug and power supply",
            )
        elif abs(mean) > signal_checks.LARGEST_MEAN_M_PER_S2:
            yield CheckFinding(
                "channel_biased",
                CheckStatus.WRONG,
                f"{name}: mean {mean:.2f} m/s²",
                "if gravity is included, declare gravity_included and up in [sensor]; otherwise "
                "repair the sensor",
            )
        elif _is_saturated(values):
            yield CheckFinding(
                "sensor_saturated",
                CheckStatus.WRONG,
                f"{name}: saturated at {np.abs(values).max():.1f} m/s²",
                "set the sensor to a larger range",
            )
        elif (spikes := quality.spikes(values, signal_checks.SPIKE_HEIGHT)) > 0:
            yield CheckFinding(
                "signal_spikes",
                CheckStatus.WRONG,
                f"{name}: {count_of(spikes, 'single sample')} far from the neighbours",
                "check cables and shielding",
            )
        else:
            yield CheckFinding(
                "channel_alive",
                CheckStatus.OK,
                f"{name}: mean {mean:+.3f} m/s², largest value {np.abs(values).max():.2f} m/s²",
            )
    if len(names) > 1 and quality.smallest_difference(acceleration) < signal_checks.ALIKE:
        yield CheckFinding(
            "channels_alike",
            CheckStatus.WRONG,
            "two channels have the same signal",
            "one sensor is connected twice: check the wiring",
        )


def _is_saturated(values: Floats) -> bool:
    """Return whether a signal (n,) is saturated as a whole and in one half at least.

    Many segments are checked: by chance one of a hundred fault-free ones looked saturated.
    """
    halves = np.array_split(values, 2)
    return signal_checks.is_saturated(values) and any(
        signal_checks.is_saturated(half) for half in halves
    )


def agreement(
    vehicle: Vehicle, sensor: Sensor, acceleration: Floats, step_s: float
) -> CheckFinding:
    """Check whether the sensors (m, n) of each part agree, for a truck that names its own."""
    spreads = placed.Spreads(sensor.gain_spread, sensor.delay_spread_s)
    found = placed.disagreement(vehicle, acceleration, step_s, spreads)
    if not found and vehicle.tandem is None:
        readings = placed.middle_of(vehicle, acceleration)
        found = signal_checks.of_one_sensor(vehicle, acceleration, readings, step_s)
    for reason, names in found.items():
        return CheckFinding(
            str(reason),
            CheckStatus.WRONG,
            f"{REASON_TEXTS[reason].removesuffix('.')}: {names}",
            "check mounts, cables and the channels' order, and have the sensor calibrated",
        )
    return CheckFinding(
        "sensors_agree", CheckStatus.OK, "sensors of one part do not contradict one another"
    )


def check_assignment(
    vehicle: Vehicle, acceleration: Floats, step_s: float, motion: Motion
) -> CheckFinding:
    """Check order and signs of the middle readings (4, n) by the equations of the body."""
    reasons = signal_checks.order_and_signs(vehicle, acceleration, step_s, motion, 1)
    found = quality.assign_channels(acceleration, step_s, *signal_checks.body_constants(vehicle))
    explained = max(0.0, 1.0 - found.recorded)
    if Reason.CHANNEL_INVERTED in reasons and found.recorded <= signal_checks.MAX_UNEXPLAINED:
        # Axles that move against each other at one distance move alike at another.
        follows = scan_wheelbase(vehicle, acceleration, step_s, motion.position_m)
        if follows.alike > follows.opposite:
            reasons = []
    names = placed.middle_names(vehicle)
    if Reason.CHANNEL_SWAPPED in reasons:
        return CheckFinding(
            "channel_swapped",
            CheckStatus.WRONG,
            _swapped(found, names),
            "swap the two plugs, or correct the names, masses or springs",
        )
    if Reason.CHANNEL_INVERTED in reasons:
        return CheckFinding(
            "channel_inverted",
            CheckStatus.WRONG,
            _inverted(found, names),
            "turn the sensor, or declare `up` in [sensor]",
        )
    return check_finding(
        "channels_in_place",
        f"the axles' motion explains {100.0 * explained:.0f} % of the body's motion",
        "springs, masses or sensors are not those of the site file",
        is_wrong=found.recorded > signal_checks.MAX_UNEXPLAINED,
    )


def tandem_in_place(
    vehicle: Vehicle, acceleration: Floats, step_s: float, motion: Motion
) -> CheckFinding:
    """Check order and signs of the middle readings (4, n) of a truck with a tandem."""
    for reason, names in signal_checks.of_tandem(vehicle, acceleration, step_s, motion, 1).items():
        text = f"{REASON_TEXTS[reason].removesuffix('.')}: {names}"
        return CheckFinding(
            str(reason),
            CheckStatus.WRONG,
            text,
            "swap the plugs, turn the sensor, or correct the names",
        )
    text = "the tandem's axles explain the body's motion"
    return CheckFinding("channels_in_place", CheckStatus.OK, text)


class WheelbaseScan(NamedTuple):
    """Correlation of the axles' motions over distances about the wheelbase."""

    wheelbase_m: float
    alike: float
    """Correlation of both at that distance."""
    opposite: float
    """Size of the most negative correlation: with one axle inverted it is the larger."""


def scan_wheelbase(
    vehicle: Vehicle, acceleration: Floats, step_s: float, travelled_m: Floats
) -> WheelbaseScan:
    """Try distances about the wheelbase of the site file; shapes (4, n) and (n,), in m."""
    tried = vehicle.wheelbase_m * np.arange(*_TRIED, _STEP_M / vehicle.wheelbase_m)
    alike = np.array(
        [
            same_place.axle_correlation(
                acceleration[2], acceleration[3], step_s, travelled_m, float(w)
            )[0]
            for w in tried
        ]
    )
    best = int(np.argmax(alike))
    return WheelbaseScan(float(tried[best]), float(alike[best]), -float(alike.min()))


def _swapped(found: quality.ChannelAssignment, names: tuple[str, ...]) -> str:
    if found.recorded <= signal_checks.MAX_UNEXPLAINED:
        return "the rear axle moves first: front and rear are swapped"
    pairs = [
        f"{names[k]} looks like {names[found.best_order.index(k)]}"
        for k in range(4)
        if found.best_order[k] != k
    ]
    share = f"{100.0 * min(1.0, found.recorded):.0f} % of the body's motion is unexplained"
    return f"{share}, and {', '.join(pairs)}"


def _inverted(found: quality.ChannelAssignment, names: tuple[str, ...]) -> str:
    ends = [
        end for end, upright in enumerate(found.upright) if upright > signal_checks.MAX_UNEXPLAINED
    ]
    if not ends:
        return "both channels of one axle are inverted: the axles move against each other"
    return f"{names[ends[0]]} or {names[2 + ends[0]]} is inverted"


def wheelbase(
    vehicle: Vehicle, acceleration: Floats, step_s: float, travelled_m: Floats
) -> CheckFinding:
    """Check the distance at which the rear axle follows the front one, shapes (4, n) and (n,)."""
    found = scan_wheelbase(vehicle, acceleration, step_s, travelled_m)
    if found.alike < _FAR_LEAD:
        return CheckFinding(
            "wheelbase",
            CheckStatus.OPEN,
            f"the axles' profiles differ too much to determine the wheelbase (correlation "
            f"{found.alike:.2f})",
            "drive at 10 m/s or more over a rough stretch",
        )
    apart = abs(found.wheelbase_m - vehicle.wheelbase_m)
    return check_finding(
        "wheelbase",
        f"the rear axle follows {found.wheelbase_m:.2f} m behind the front one, wheelbase_m is "
        f"{vehicle.wheelbase_m:g}",
        "measure the wheelbase, and make sure that it was this truck",
        is_wrong=apart > max(_OTHER_WHEELBASE_M, _OTHER_WHEELBASE * vehicle.wheelbase_m),
    )


def masses(vehicle: Vehicle, acceleration: Floats, step_s: float) -> Iterator[CheckFinding]:
    """Check stiffness over sprung mass by the body's motion (4, n) against the site file."""
    declared, damping = signal_checks.body_constants(vehicle)
    found = quality.stiffness_per_mass(acceleration, step_s, declared, damping)
    for end, measured, known in zip(("front", "rear"), found, declared.tolist(), strict=True):
        text = (
            f"{end}: stiffness over mass of the body {measured:.0f} 1/s² from its motion, "
            f"{known:.0f} 1/s² from the site file"
        )
        if measured > _LARGEST_FACTOR * known:
            yield CheckFinding(
                "spring_over_mass",
                CheckStatus.OPEN,
                text,
                "friction in leaf springs may cause this; for other springs, weigh both axles",
            )
        else:
            yield check_finding(
                "spring_over_mass",
                text,
                "total_mass_kg, front_axle_to_cg_m or suspension_stiffness_n_per_m is wrong: "
                "weigh both axles",
                is_wrong=measured < known / _LARGEST_FACTOR,
            )
