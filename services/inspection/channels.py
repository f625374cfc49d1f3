"""Accelerometers: which there are, whether they are alive, in their places and the right way up."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.diagnostics import quality
from pre_core.physics.simulate import Motion
from schemas.reasons import REASON_TEXTS, Reason
from schemas.site import Sensor, Vehicle
from services.identification import placed, signal_checks
from services.identification.placed import rates_hz
from services.inspection.finding import Finding, State, judged
from services.inspection.recorded import Recorded

Floats = NDArray[np.float64]

_LARGEST_RATE_ERROR: Final = 0.02
"""A crystal is right to 1e-4; what is further off is another setting of the sensor."""
_TRIED: Final = (0.6, 1.6)
_STEP_M: Final = 0.02
_OTHER_WHEELBASE_M, _OTHER_WHEELBASE = 0.4, 0.08
"""What correlation of the axles may be off by chance."""
_FAR_LEAD: Final = 0.6
_LARGEST_FACTOR: Final = 2.5
"""Of k/m from what the site file says: a data sheet's 15 % of both is far within."""


def present(run: Recorded, vehicle: Vehicle) -> Iterator[Finding]:
    """Whether all of the vehicle's are there, and others that the site file does not name."""
    recorded = () if run.samples is None else tuple(run.samples.channels)
    missing = [name for name in vehicle.channels if name not in recorded]
    unknown = [name for name in recorded if name not in vehicle.channels]
    if unknown:
        yield Finding(
            "channels_unknown",
            State.WRONG,
            f"{', '.join(unknown)} recorded, not in the site file",
            "name every accelerometer in [[vehicle.sensors]]: one that is not named is not used",
        )
    there = len(vehicle.channels) - len(missing)
    yield judged(
        "channels_present",
        f"{there} of {len(vehicle.channels)} accelerometers recorded"
        + (f", {', '.join(missing)} missing" if missing else ""),
        "look at plugs and logger: a crossing without one of them is rejected",
        is_wrong=bool(missing),
    )


def rates(run: Recorded, sensor: Sensor, vehicle: Vehicle) -> Iterator[Finding]:
    """Sampling rates against the site file, and what is missing."""
    for name, declared in rates_hz(sensor, vehicle).items():
        if name not in run.rates_hz:
            continue
        rate = run.rates_hz[name]
        yield judged(
            "sampling_rate",
            f"{name}: {rate:.1f} samples a second, {declared:g} declared",
            "declare the rate that the sensor is set to, or set it",
            is_wrong=abs(rate / declared - 1.0) > _LARGEST_RATE_ERROR,
        )


def gaps(run: Recorded) -> Finding:
    """Whether samples are missing."""
    assert run.samples is not None  # noqa: S101 - who asks has looked
    values = np.stack(list(run.samples.channels.values()))
    holes = ~np.isfinite(values).all(axis=0)
    longest_s = _longest(np.asarray(holes)) / run.samples.rate_hz
    return judged(
        "gaps",
        f"{holes.mean():.2%} of the samples missing, {run.missing_batches} batches lost, "
        f"longest gap {longest_s:.2f} s",
        "look at logger and cables: a gap on the bridge rejects the crossing",
        is_wrong=bool(holes.any()),
    )


def _longest(holes: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holes, [False]]).astype(np.int8)))
    return int(np.diff(edges)[::2].max(initial=0))


def alive(names: tuple[str, ...], acceleration: Floats, step_s: float) -> Iterator[Finding]:
    """Each channel (c, n) by itself: dead, biased, at the end of its range, with spikes."""
    for name, values in zip(names, acceleration, strict=True):
        held_s = quality.longest_hold(values) * step_s
        mean = float(values.mean())
        if held_s > signal_checks.LONGEST_HOLD_S:
            yield Finding(
                "channel_stuck",
                State.WRONG,
                f"{name}: one value for {held_s:.2f} s",
                "it is dead: look at plug and supply",
            )
        elif abs(mean) > signal_checks.LARGEST_MEAN_M_PER_S2:
            yield Finding(
                "channel_biased",
                State.WRONG,
                f"{name}: mean {mean:.2f} m/s²",
                "is gravity in it? say gravity_included and up in [sensor], or mend the sensor",
            )
        elif _is_saturated(values):
            yield Finding(
                "sensor_saturated",
                State.WRONG,
                f"{name}: values pile up at an end, {np.abs(values).max():.1f} m/s²",
                "set a larger range",
            )
        elif (spikes := quality.spikes(values, signal_checks.SPIKE_HEIGHT)) > 0:
            yield Finding(
                "signal_spikes",
                State.WRONG,
                f"{name}: {spikes} single samples far off",
                "look at cables and shielding",
            )
        else:
            yield Finding(
                "channel_alive",
                State.OK,
                f"{name}: alive, mean {mean:+.3f}, largest {np.abs(values).max():.2f} m/s²",
            )
    if len(names) > 1 and quality.smallest_difference(acceleration) < signal_checks.ALIKE:
        yield Finding(
            "channels_alike",
            State.WRONG,
            "two channels show the same",
            "one sensor is connected twice: look at the wiring",
        )


def _is_saturated(values: Floats) -> bool:
    """Whether a range ends where a signal (n,) goes, as a whole and in one half at least.

    Many stretches are looked at: chance made one of a hundred sound ones look so as a whole.
    """
    halves = np.array_split(values, 2)
    return signal_checks.is_saturated(values) and any(
        signal_checks.is_saturated(half) for half in halves
    )


def agreement(vehicle: Vehicle, sensor: Sensor, acceleration: Floats, step_s: float) -> Finding:
    """Whether the sensors (m, n) of each part agree; only for a truck that names its own."""
    spreads = placed.Spreads(sensor.gain_spread, sensor.delay_spread_s)
    found = placed.disagreement(vehicle, acceleration, step_s, spreads)
    if not found:
        readings = placed.middle_of(vehicle, acceleration)
        found = signal_checks.of_one_sensor(vehicle, acceleration, readings, step_s)
    for reason, names in found.items():
        return Finding(
            str(reason),
            State.WRONG,
            f"{REASON_TEXTS[reason].removesuffix('.')}: {names}",
            "look at mounts, cables and the channels' order, and have the sensor calibrated",
        )
    return Finding("sensors_agree", State.OK, "sensors of one part do not contradict one another")


def in_place(vehicle: Vehicle, acceleration: Floats, step_s: float, motion: Motion) -> Finding:
    """Order and signs of the middle readings (4, n) of a drive, by the equations of the body."""
    reasons = signal_checks.order_and_signs(vehicle, acceleration, step_s, motion, 1)
    found = quality.pairing(acceleration, step_s, *signal_checks.body_constants(vehicle))
    explained = 1.0 - found.recorded
    if Reason.CHANNEL_INVERTED in reasons and found.recorded <= signal_checks.UNEXPLAINED:
        # Axles that move against each other at one distance move alike at another.
        follows = followed(vehicle, acceleration, step_s, motion.position_m)
        if follows.alike > follows.opposite:
            reasons = []
    names = placed.middle_names(vehicle)
    if Reason.CHANNEL_SWAPPED in reasons:
        return Finding(
            "channel_swapped", State.WRONG, _swapped(found, names), "exchange them, or say so"
        )
    if Reason.CHANNEL_INVERTED in reasons:
        return Finding(
            "channel_inverted",
            State.WRONG,
            _inverted(found, names),
            "turn it, or say so by `up` in [sensor]",
        )
    return judged(
        "channels_in_place",
        f"the axles' motion explains {explained:.0%} of the body's",
        "springs, masses or sensors are not those of the site file",
        is_wrong=found.recorded > signal_checks.UNEXPLAINED,
    )


class Followed(NamedTuple):
    """Where the rear axle feels what the front one felt."""

    wheelbase_m: float
    alike: float
    """Correlation of both there."""
    opposite: float
    """Size of the most negative one at any distance: of one axle inverted it is the larger."""


def followed(
    vehicle: Vehicle, acceleration: Floats, step_s: float, travelled_m: Floats
) -> Followed:
    """Try distances about the wheelbase of the site file."""
    tried = vehicle.wheelbase_m * np.arange(*_TRIED, _STEP_M / vehicle.wheelbase_m)
    alike = np.array(
        [
            quality.lead(acceleration[2], acceleration[3], step_s, travelled_m, float(w))[0]
            for w in tried
        ]
    )
    best = int(np.argmax(alike))
    return Followed(float(tried[best]), float(alike[best]), -float(alike.min()))


def _swapped(found: quality.Pairing, names: tuple[str, ...]) -> str:
    if found.recorded <= signal_checks.UNEXPLAINED:
        return "the rear axle meets the road first: front and rear are exchanged"
    pairs = [
        f"{names[k]} looks like {names[found.best_order.index(k)]}"
        for k in range(4)
        if found.best_order[k] != k
    ]
    return f"{found.recorded:.0%} of the body's motion unexplained: {', '.join(pairs)}"


def _inverted(found: quality.Pairing, names: tuple[str, ...]) -> str:
    ends = [end for end, upright in enumerate(found.upright) if upright > signal_checks.UNEXPLAINED]
    if not ends:
        return "both channels of one axle are inverted: the axles move against each other"
    return f"{names[ends[0]]} or {names[2 + ends[0]]} is inverted"


def wheelbase(
    vehicle: Vehicle, acceleration: Floats, step_s: float, travelled_m: Floats
) -> Finding:
    """Where the rear axle feels what the front one felt, against the wheelbase of the site file."""
    found = followed(vehicle, acceleration, step_s, travelled_m)
    if found.alike < _FAR_LEAD:
        return Finding(
            "wheelbase",
            State.OPEN,
            f"the axles feel too different roads to tell the wheelbase (correlation "
            f"{found.alike:.2f})",
            "drive at 10 m/s or more over a rough stretch",
        )
    apart = abs(found.wheelbase_m - vehicle.wheelbase_m)
    return judged(
        "wheelbase",
        f"the rear axle follows {found.wheelbase_m:.2f} m behind the front one, wheelbase_m "
        f"{vehicle.wheelbase_m:g}",
        "measure the wheelbase; is it this truck?",
        is_wrong=apart > max(_OTHER_WHEELBASE_M, _OTHER_WHEELBASE * vehicle.wheelbase_m),
    )


def masses(vehicle: Vehicle, acceleration: Floats, step_s: float) -> Iterator[Finding]:
    """Springs over the masses that they carry, by the body's motion, against the site file."""
    declared, damping = signal_checks.body_constants(vehicle)
    found = quality.stiffness_per_mass(acceleration, step_s, declared, damping)
    for end, measured, known in zip(("front", "rear"), found, declared.tolist(), strict=True):
        text = (
            f"{end}: the body's motion tells a spring of {measured:.0f} /s² over its mass, "
            f"{known:.0f} by the site file"
        )
        if measured > _LARGEST_FACTOR * known:
            yield Finding(
                "spring_over_mass",
                State.OPEN,
                text,
                "leaf springs that rub look like that; if these do not, weigh both axles",
            )
        else:
            yield judged(
                "spring_over_mass",
                text,
                "total_mass_kg, front_axle_to_cg_m or suspension_stiffness_n_per_m is wrong: "
                "weigh both axles",
                is_wrong=measured < known / _LARGEST_FACTOR,
            )
