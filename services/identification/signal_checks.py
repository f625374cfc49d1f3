"""Checks of signals before any fit, by physics that holds for every truck.

`pre_core.diagnostics` computes the measures; here are the thresholds, each with its values on
fault-free and on faulty crossings (studies/faults.md).
"""

from collections.abc import Callable, Mapping
from itertools import combinations

import numpy as np

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.diagnostics import frozen, quality, same_place
from pre_core.physics.simulate import Motion
from schemas.reasons import Reason
from schemas.site import Vehicle
from services.common.arrays import Floats
from services.finding import placed

# Fault-free: 300 simulated crossings, no false accusation (studies/faults.md).
LONGEST_HOLD_S = 0.2
"""Longest constant signal in s; a coarse converter (12 bits) holds a value for 0.03 s."""
ALIKE = 1e-3
"""Relative difference below which two channels are identical."""
_PILE_UP, _PILE_VISITS = 8.0, 3
"""Limits of `SaturationEvidence.ratio` and `visits`. Fault-free: a ratio of at most 5.8 over three
visits; half the required range: 12 to 67."""
_REPEATS = 4
"""Number of exact repetitions of an extreme at the end of a range: noise repeats none."""
SPIKE_HEIGHT = 20.0
"""Height over the typical distance from the neighbours; fault-free at most 7."""
LARGEST_MEAN_M_PER_S2 = 0.3 * STANDARD_GRAVITY_M_PER_S2
"""Mean that indicates gravity or a broken sensor: no truck falls for seconds."""
MAX_UNEXPLAINED = 0.3
"""Largest share of the body's motion that the body equations may leave unexplained.

Fault-free: at most 0.10; two channels swapped or one inverted: at least 0.36, and then at most
0.10 after correction.
"""
_CLEARLY_LESS = 0.5
"""Ratio of unexplained shares below which another order or sign of channels explains more."""
_AXLE_CORRELATION = 0.6
"""Correlation of the axles' motions at one chainage.

Fault-free: 0.71 to 0.99 (with the axles swapped: -0.72 to 0.49).
"""
_TANDEM_CORRELATION = 0.25
"""Correlation of a tandem's axles at one place, and of the body in front with a mass on its springs
over their road. Axles: fault-free 0.34 to 0.77, swapped -0.30 to 0.15. Body, of 30 drawn crossings:
0.3 to 0.95, inverted the same below zero. Unexplained share of the bogie's equation: fault-free
0.04 to 0.16, another reading inverted or swapped 0.37 to 0.98."""


def reasons_before_fit(
    vehicle: Vehicle,
    acceleration: Floats,
    step_s: float,
    motion: Motion,
    direction: int,
    spreads: placed.Spreads = placed.USUAL_SPREADS,
) -> Mapping[Reason, str]:
    """Return reasons in the accelerations (m, n) alone, with their channels.

    The channels are the vehicle's in their order. Each reason forbids a fit. `motion` is the
    position of the front axle at every sample.
    """
    broken = _channel_faults(vehicle.channels, acceleration, step_s)
    if broken:
        return broken
    disagreeing = placed.disagreement(vehicle, acceleration, step_s, spreads)
    if disagreeing:
        return disagreeing
    readings = placed.middle_of(vehicle, acceleration)
    if vehicle.tandem is not None:
        return of_tandem(vehicle, readings, step_s, motion, direction)
    one = of_one_sensor(vehicle, acceleration, readings, step_s)
    if one:
        return one
    reasons = order_and_signs(vehicle, readings, step_s, motion, direction)
    if not reasons:
        return {}
    found = quality.assign_channels(readings, step_s, *body_constants(vehicle))
    named = {Reason.CHANNEL_INVERTED: _inverted, Reason.CHANNEL_SWAPPED: _swapped}
    names = placed.middle_names(vehicle)
    return {reason: named[reason](found, names) for reason in reasons}


def unmeasured(channels: tuple[str, ...], acceleration: Floats, step_s: float) -> dict[Reason, str]:
    """Return the reason, and the channels (m, n), of segments that no sensor measured.

    The whole record is checked, as all of it is fitted.
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
    """Return the reason and the sensors whose inversion or swap explains an inconsistent body.

    Where several sensors form a middle reading, one inverted among them makes it a roll.
    """
    if not vehicle.sensors:
        return {}
    constants = body_constants(vehicle)
    recorded = max(quality.unexplained_by_axle(readings, step_s, *constants))
    if recorded <= MAX_UNEXPLAINED:
        return {}
    best, found = _CLEARLY_LESS * recorded, dict[Reason, str]()
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


def _channel_faults(
    channels: tuple[str, ...], acceleration: Floats, step_s: float
) -> dict[Reason, str]:
    """Return the most evident fault of single channels, which also causes the others."""

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
        return {Reason.CHANNELS_ALIKE: _identical_channels(channels, acceleration)}
    for reason, is_wrong in of_each:
        names = those(is_wrong)
        if names:
            return {reason: names}
    return {}


def _identical_channels(channels: tuple[str, ...], acceleration: Floats) -> str:
    """Return the names of channels (m, n) with identical signals."""
    pairs = combinations(range(len(channels)), 2)
    return ", ".join(
        f"{channels[i]} and {channels[k]}"
        for i, k in pairs
        if quality.smallest_difference(acceleration[[i, k]]) < ALIKE
    )


def _inverted(found: quality.ChannelAssignment, names: tuple[str, ...]) -> str:
    """Return the names of channels of which one is inverted."""
    ends = [end for end, upright in enumerate(found.upright) if upright > MAX_UNEXPLAINED]
    if not ends:
        return "both of one axle"
    return " and ".join(f"{names[end]} or {names[2 + end]}" for end in ends)


def _swapped(found: quality.ChannelAssignment, names: tuple[str, ...]) -> str:
    """Return the names of swapped channels; with "or" where the equations are ambiguous.

    Front and rear are alike to them: with both pairs swapped as well they hold as before. So of
    both corrections the one that moves fewer channels is named.
    """
    if found.recorded <= MAX_UNEXPLAINED:
        return "front and rear, of body and axle alike"
    order = found.best_order
    ways = [order, (order[1], order[0], order[3], order[2])]
    moved = [[k for k in range(4) if way[k] != k] for way in ways]
    fewest = min(map(len, moved))
    return ", or ".join(
        " and ".join(names[k] for k in one) for one in sorted(moved) if len(one) == fewest
    )


def of_tandem(
    vehicle: Vehicle, readings: Floats, step_s: float, motion: Motion, direction: int
) -> dict[Reason, str]:
    """Return the reason, and the channels, if readings (4, n) of a tandem are mixed up or inverted.

    The body above the tandem follows from the mean of both axles; the second axle meets the road
    after the first, and both after the body in front. Above several front axles the body does not
    follow clearly enough: there the fit shows an inverted reading.
    """
    tandem = vehicle.tandem
    assert tandem is not None  # noqa: S101 - the caller has checked
    names, constants = placed.middle_names(vehicle), body_constants(vehicle)

    def bogie(of: Floats) -> Floats:
        return np.asarray(tandem.share * of[2] + (1.0 - tandem.share) * of[3])

    def unexplained(of: Floats) -> float:
        axles = bogie(of)
        return quality.unexplained_by_axle(
            np.stack([of[0], of[1], axles, axles]), step_s, *constants
        )[1]

    recorded = unexplained(readings)
    if recorded > MAX_UNEXPLAINED:
        best, found = _CLEARLY_LESS * recorded, dict[Reason, str]()
        for k in (1, 2, 3):
            other = readings.copy()
            other[k] *= -1.0
            if unexplained(other) < best:
                best, found = unexplained(other), {Reason.CHANNEL_INVERTED: names[k]}
        for i, k in combinations(range(4), 2):
            other = readings.copy()
            other[[i, k]] = readings[[k, i]]
            if unexplained(other) < best:
                pair = f"{names[i]} and {names[k]}"
                best, found = unexplained(other), {Reason.CHANNEL_SWAPPED: pair}
        return found
    travelled = direction * (motion.position_m - motion.position_m[0])
    if np.any(np.diff(travelled) <= 0.0):
        return {}
    right, swapped = same_place.axle_correlation(
        readings[2], readings[3], step_s, travelled, tandem.gap_m
    )
    if swapped > _TANDEM_CORRELATION and right < 0.5 * swapped:
        return {Reason.CHANNEL_SWAPPED: f"{names[2]} and {names[3]}"}
    if len(tandem.front_axles) > 1:
        return {}
    spring = float(constants[0][0]), float(constants[1][0])
    follows = same_place.sprung_correlation(
        readings[0], bogie(readings), step_s, travelled, vehicle.wheelbase_m, spring
    )
    return {Reason.CHANNEL_INVERTED: names[0]} if follows < -_TANDEM_CORRELATION else {}


def is_saturated(values: Floats) -> bool:
    """Return whether a signal (n,) stays at the end of a sensor's range."""
    rail = quality.pile_up(values)
    piled_up = rail.ratio > _PILE_UP and rail.visits >= _PILE_VISITS
    return piled_up or quality.repeated_extremes(values) >= _REPEATS


def body_constants(vehicle: Vehicle) -> tuple[Floats, Floats]:
    """Return nominal springs and dampers over their masses, front and rear: (2,) each."""
    d_1, wheelbase = vehicle.front_axle_to_cg_m, vehicle.wheelbase_m
    body = vehicle.sprung_mass_kg * np.array([wheelbase - d_1, d_1]) / wheelbase
    return (
        np.array(vehicle.suspension_stiffness_n_per_m) / body,
        np.array(vehicle.suspension_damping_ns_per_m) / body,
    )


def order_and_signs(
    vehicle: Vehicle, acceleration: Floats, step_s: float, motion: Motion, direction: int
) -> list[Reason]:
    """Return the reason if channels (4, n) are swapped or inverted; else an empty list."""
    found = quality.assign_channels(acceleration, step_s, *body_constants(vehicle))
    if found.recorded > MAX_UNEXPLAINED:
        turned = [
            reversed_ < _CLEARLY_LESS * upright
            for upright, reversed_ in zip(found.upright, found.reversed_, strict=True)
            if upright > MAX_UNEXPLAINED
        ]
        if all(turned) and min(found.reversed_) < found.best:
            return [Reason.CHANNEL_INVERTED]
        if found.best < _CLEARLY_LESS * found.recorded:
            return [Reason.CHANNEL_SWAPPED]
        return []  # another fault, which the fit will show
    travelled = direction * (motion.position_m - motion.position_m[0])
    if np.any(np.diff(travelled) <= 0.0):
        return []
    right, swapped = same_place.axle_correlation(
        acceleration[2], acceleration[3], step_s, travelled, vehicle.wheelbase_m
    )
    if right < -_AXLE_CORRELATION:
        return [Reason.CHANNEL_INVERTED]
    if swapped > _AXLE_CORRELATION > 2.0 * right:
        return [Reason.CHANNEL_SWAPPED]
    return []
