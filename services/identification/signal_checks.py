"""Whether signals can be trusted before any fit, by the physics that any truck obeys.

What is measured is in `pre_core.diagnostics`; here are the thresholds, each with what it was
measured to be on sound crossings and on broken ones (docs/verdicts.md).
"""

from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.diagnostics import frozen, quality
from pre_core.physics.simulate import Motion
from schemas.reasons import Reason
from schemas.site import Vehicle
from services.identification import placed

Floats = NDArray[np.float64]

# Sound: 300 drawn crossings, none accused (docs/verdicts.md).
LONGEST_HOLD_S = 0.2
"""Noise and motion change every sample; a coarse converter (12 bits) holds one for 0.03 s."""
ALIKE = 1e-3
"""Two channels that differ by less than this part of what they show are one."""
_PILE_UP = 8.0
_PILE_VISITS = 3
"""Sound: at most 5.8 over three visits; a range of half of what is needed: 12 to 67."""
_REPEATS = 4
"""An extreme that comes exactly so often is the end of a range: noise repeats none."""
SPIKE_HEIGHT = 20.0
"""Over the typical distance from the neighbours. Sound: at most 7."""
LARGEST_MEAN_M_PER_S2 = 0.3 * STANDARD_GRAVITY_M_PER_S2
"""No truck falls for seconds: a mean of this size is gravity or a broken sensor."""
UNEXPLAINED = 0.3
_BETTER = 0.5
"""Part of the body's motion that the body equations leave over. Sound: at most 0.10; two channels
exchanged or one inverted: at least 0.36, and then at most 0.10 once they are put right."""
_LEAD = 0.6
"""Correlation of what both axles feel at one place. Sound: 0.71 to 0.99 (with the axles exchanged:
-0.72 to 0.49)."""


def reasons_before_fit(
    vehicle: Vehicle,
    acceleration: Floats,
    step_s: float,
    motion: Motion,
    direction: int,
    spreads: placed.Spreads = placed.USUAL_SPREADS,
) -> Mapping[Reason, str]:
    """What the accelerations (m, n) alone say against the crossing, and of which channels.

    They are those of the vehicle's channels in their order. All of it forbids a fit. `motion` is
    where the front axle was at every sample.
    """
    broken = _broken(vehicle.channels, acceleration, step_s)
    if broken:
        return broken
    disagreeing = placed.disagreement(vehicle, acceleration, step_s, spreads)
    if disagreeing:
        return disagreeing
    readings = placed.middle_of(vehicle, acceleration)
    one = of_one_sensor(vehicle, acceleration, readings, step_s)
    if one:
        return one
    reasons = order_and_signs(vehicle, readings, step_s, motion, direction)
    if not reasons:
        return {}
    found = quality.pairing(readings, step_s, *body_constants(vehicle))
    named = {Reason.CHANNEL_INVERTED: _inverted, Reason.CHANNEL_SWAPPED: _exchanged}
    names = placed.middle_names(vehicle)
    return {reason: named[reason](found, names) for reason in reasons}


def unmeasured(channels: tuple[str, ...], acceleration: Floats, step_s: float) -> dict[Reason, str]:
    """Return the reason, and the channels (m, n), of stretches that no sensor measured.

    Anywhere in the record, for all of it is fitted.
    """
    of_each = {
        Reason.CHANNEL_STUCK: frozen.longest_hold_s,
        Reason.CHANNEL_BRIDGED: frozen.longest_line_s,
    }
    for reason, longest_s in of_each.items():
        found = [longest_s(values, step_s) for values in acceleration]
        names = [
            f"{name} for {1e3 * seconds:.0f} ms"
            for name, seconds in zip(channels, found, strict=True)
            if seconds > 0.0
        ]
        if names:
            return {reason: ", ".join(names)}
    return {}


def of_one_sensor(
    vehicle: Vehicle, acceleration: Floats, readings: Floats, step_s: float
) -> dict[Reason, str]:
    """Whether one sensor turned round, or two exchanged, explain a body that does not follow.

    Where several sensors make a middle reading: one inverted among them makes it a roll.
    """
    if not vehicle.sensors:
        return {}
    constants = body_constants(vehicle)
    recorded = max(quality.unexplained_by_axle(readings, step_s, *constants))
    if recorded <= UNEXPLAINED:
        return {}
    best, found = _BETTER * recorded, dict[Reason, str]()
    names = vehicle.channels
    pairs = combinations(range(len(names)), 2)
    for order in [*((k,) for k in range(len(names))), *pairs]:
        other = acceleration.copy()
        if len(order) == 1:
            other[order[0]] *= -1.0
        else:
            other[list(order)] = acceleration[list(order[::-1])]
        there = placed.middle_of(vehicle, other)
        left = max(quality.unexplained_by_axle(there, step_s, *constants))
        if left < best:
            reason = Reason.CHANNEL_INVERTED if len(order) == 1 else Reason.CHANNEL_SWAPPED
            best, found = left, {reason: " and ".join(names[k] for k in order)}
    return found


def _broken(channels: tuple[str, ...], acceleration: Floats, step_s: float) -> dict[Reason, str]:
    """The most plain of what is wrong with single channels: it makes the others show as well."""

    def those(is_wrong: Callable[[Floats], bool]) -> str:
        each = zip(channels, acceleration, strict=True)
        return ", ".join(name for name, values in each if is_wrong(values))

    of_each: list[tuple[Reason, Callable[[Floats], bool]]] = [
        (Reason.CHANNEL_BIASED, lambda values: abs(values.mean()) > LARGEST_MEAN_M_PER_S2),
        (Reason.SENSOR_SATURATED, is_saturated),
        (Reason.SIGNAL_SPIKES, lambda values: quality.spikes(values, SPIKE_HEIGHT) > 0),
    ]
    stuck = those(lambda values: quality.longest_hold(values) * step_s > LONGEST_HOLD_S)
    if stuck:
        return {Reason.CHANNEL_STUCK: stuck}
    if quality.smallest_difference(acceleration) < ALIKE:
        return {Reason.CHANNELS_ALIKE: _alike(channels, acceleration)}
    for reason, is_wrong in of_each:
        names = those(is_wrong)
        if names:
            return {reason: names}
    return {}


def _alike(channels: tuple[str, ...], acceleration: Floats) -> str:
    """Names of channels (m, n) that show the same."""
    pairs = combinations(range(len(channels)), 2)
    return ", ".join(
        f"{channels[i]} and {channels[k]}"
        for i, k in pairs
        if quality.smallest_difference(acceleration[[i, k]]) < ALIKE
    )


def _inverted(found: quality.Pairing, names: tuple[str, ...]) -> str:
    """Names of channels of which one is inverted."""
    ends = [end for end, upright in enumerate(found.upright) if upright > UNEXPLAINED]
    if not ends:
        return "both of one axle"
    return " and ".join(f"{names[end]} or {names[2 + end]}" for end in ends)


def _exchanged(found: quality.Pairing, names: tuple[str, ...]) -> str:
    """Names of channels that are exchanged; with "or" where the body's equations know no better.

    To them front and rear are alike: if both pairs change places as well, they hold as before. So
    of both ways the one that moves fewer channels is told.
    """
    if found.recorded <= UNEXPLAINED:
        return "front and rear, of body and axle alike"
    order = found.best_order
    ways = [order, (order[1], order[0], order[3], order[2])]
    moved = [[k for k in range(4) if way[k] != k] for way in ways]
    fewest = min(map(len, moved))
    return ", or ".join(
        " and ".join(names[k] for k in one) for one in sorted(moved) if len(one) == fewest
    )


def is_saturated(values: Floats) -> bool:
    """Whether a signal (n,) stays where a sensor's range ends."""
    rail = quality.pile_up(values)
    piled_up = rail.ratio > _PILE_UP and rail.visits >= _PILE_VISITS
    return piled_up or quality.repeated_extremes(values) >= _REPEATS


def body_constants(vehicle: Vehicle) -> tuple[Floats, Floats]:
    """Springs and dampers over the masses that they carry, front and rear: (2,) each, nominally."""
    d_1, wheelbase = vehicle.front_axle_to_cg_m, vehicle.wheelbase_m
    body = vehicle.sprung_mass_kg * np.array([wheelbase - d_1, d_1]) / wheelbase
    return (
        np.array(vehicle.suspension_stiffness_n_per_m) / body,
        np.array(vehicle.suspension_damping_ns_per_m) / body,
    )


def order_and_signs(
    vehicle: Vehicle, acceleration: Floats, step_s: float, motion: Motion, direction: int
) -> list[Reason]:
    """Whether channels (4, n) are exchanged or inverted; `motion` is the front axle's."""
    found = quality.pairing(acceleration, step_s, *body_constants(vehicle))
    if found.recorded > UNEXPLAINED:
        turned = [
            reversed_ < _BETTER * upright
            for upright, reversed_ in zip(found.upright, found.reversed_, strict=True)
            if upright > UNEXPLAINED
        ]
        if all(turned) and min(found.reversed_) < found.best:
            return [Reason.CHANNEL_INVERTED]
        if found.best < _BETTER * found.recorded:
            return [Reason.CHANNEL_SWAPPED]
        return []  # something else is wrong, which the fit will show
    travelled = direction * (motion.position_m - motion.position_m[0])
    if np.any(np.diff(travelled) <= 0.0):
        return []
    right, exchanged = quality.lead(
        acceleration[2], acceleration[3], step_s, travelled, vehicle.wheelbase_m
    )
    if right < -_LEAD:
        return [Reason.CHANNEL_INVERTED]
    if exchanged > _LEAD > 2.0 * right:
        return [Reason.CHANNEL_SWAPPED]
    return []
