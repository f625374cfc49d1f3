"""Whether an answer can be trusted: from signals, site and fit to the reasons against it.

`reasons_before_fit` looks at the accelerations alone, by the physics that any truck obeys;
`reasons_after_fit` at what the fit leaves over. What is measured is in
`pre_core.diagnostics.quality`; here are the thresholds, each with what it was measured to be on
sound crossings and on broken ones (docs/verdicts.md).
"""

from collections.abc import Callable, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import MICRO_G_M_PER_S2, STANDARD_GRAVITY_M_PER_S2
from pre_core.crossing import slip
from pre_core.diagnostics import frozen, quality, receiver
from pre_core.physics.simulate import Motion
from schemas.reasons import Reason
from schemas.site import Vehicle
from services.identification import placed
from services.identification.crossing_data import CrossingData, Floats

# Before the fit. Sound: 300 drawn crossings, none accused (docs/verdicts.md).
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


# After the fit.
_BANDS_HZ = np.array([0.0, 6.0, 12.0, 30.0, np.inf])
"""What bridge, body and wheels do lies mostly in the first three; the rest is noise."""
_FALSE_ALARM_Z = 4.5
"""Chance brings one of 36 cells above it in 1e-4 of the crossings."""
_SLACK = (1.35, 1.35, 1.35, 1.15)
"""So many times the declared noise power a band may have: its density is a data sheet's, and the
1/f noise of a sensor is not declared."""
_SLACK_OF_TWO_ROADS = 1.6
"""The level of the roads' mismatch is read off some ten waves: so much is three deviations."""
SHORTEST_APPROACH_M = 12.0
"""Fewer metres off the bridge tell the level no better than to a factor of 1.4."""
_NOISY = 1.2
"""From here on a kind of residual is called noisier than declared, if it is white."""
_GOOD_CHI2 = 1.25
"""A larger one is a misfit of the model, where it is not only the noise."""
_SMALLEST_CHI2 = 0.6
"""A smaller one means that the noise is far below the declared, and intervals are too wide."""
_LARGEST_VEHICLE_Z = 4.0
"""No unknown of a truck is by chance so many standard deviations from its prior."""
_LARGEST_POSITION_Z = 4.0
"""Nor is the receiver's slow error."""
_LARGEST_STEP_Z = {slip.DELAY: 6.0, slip.GAIN: 7.0}
"""Standard deviations of a step in a channel's delay or gain, for rows of the variance that they
have. Sound: at most 3.5; one sample of 1 kHz lost: 6.8 to 38."""
_LARGEST_SPEED_SCALE_Z = 5.0
"""Standard deviations by which a receiver's speeds differ from what its positions make of them.
Sound: at most 2."""
_RECEIVER_ASIDE_S = 4.0
"""Fixes are compared so far before and behind the bridge, as the fit uses them."""
_SPEED_SCALE_SPREAD = 0.002
"""Chainage is along the bridge's axis, and a road is not quite straight."""
_LARGEST_SPEED_BIAS, _LARGEST_SPEED_BIAS_Z = 1.0, 5.0
"""Mean difference of the receiver's speeds from the fit's, in their noise, and in standard
deviations of the mean. Sound: at most 0.3 of ten fixes a second; speeds 3 % high: 1.3 to 3.7."""
_COMMON = 0.7
"""Coherence of both body equations' residuals, where these are more than the sensors' noise.
Springs that rub, dampers that are not linear: -0.13 to 0.28; tilted sensors on a truck that shakes
above 2 Hz: 0.95 to 0.97."""
_COARSE = 1.4
"""Noise of a converter's step over the declared one, from which on it is named."""
_STIFFER = 1.5
"""Age and a nominal value raise an element's EI over nominal by less, and never over that of all
others: wrong signals do."""
_CLEARLY = 0.025
"""Quantile of the draws that must be above it."""
ALIKE_LOADS = 0.1
"""Axles whose loads differ by less than this share of their sum press the bridge alike: what the
road does to both cannot be told from what the bridge does."""
_UNINFORMED = 0.8
"""Where the narrowest posterior of an element is wider than this part of its prior, nothing was
learnt."""

ROAD, BODY_FRONT, BODY_REAR = range(3)
BEFORE, ON, AFTER = range(3)


class Fit(NamedTuple):
    """What is left over by a fit of method `pre`."""

    white: Floats
    """(m, 3): mismatch of the roads, front and rear body equation, of unit variance by the noise
    that the site file declares. Not inflated."""
    step_s: float
    """Between rows."""
    place_m: Floats
    """(m,) chainage at which a row compares the roads: the rear axle's at the row's middle."""
    chi2_per_dof: float
    prior_z: dict[str, float]
    """Unknowns of the truck in multiples of their prior's spread: c_s1 … kappa, wheelbase."""
    position_z: float
    """The receiver's slow error in multiples of its spread."""
    rigidity_spread: Floats
    """(elements,) standard deviation of ln EI, over the prior's."""
    has_two_roads: bool
    """Whether the axles' roads were taken to differ, by what the rows off the bridge say."""
    off_bridge_m: float
    """How much road off the bridge there was to tell that from."""
    speed_bias: float = 0.0
    """Mean difference of the receiver's speeds from the fit's, in multiples of their noise."""
    coherence: float = 0.0
    """That of the body equations' residuals, where springs are doubted for them."""
    step: slip.Step | None = None
    """The most significant step in the delay or the gain of a channel."""


def reasons_after_fit(data: CrossingData, fit: Fit) -> list[Reason]:
    """What the fit says against its own answer, the most telling first; empty if nothing does."""
    reasons = _of_the_rows(data, fit)
    is_unexplained = bool({Reason.MODEL_MISFIT, Reason.RESIDUALS_COLOURED} & set(reasons))
    if fit.off_bridge_m < SHORTEST_APPROACH_M and (fit.has_two_roads or is_unexplained):
        reasons.append(Reason.APPROACH_TOO_SHORT)
    if fit.prior_z and max(abs(z) for z in fit.prior_z.values()) > _LARGEST_VEHICLE_Z:
        reasons.append(Reason.IMPLAUSIBLE_VEHICLE)
    if abs(fit.position_z) > _LARGEST_POSITION_Z:
        reasons.append(Reason.POSITION_INCONSISTENT)
    if _speeds_differ(data, fit):
        reasons.append(Reason.SPEED_INCONSISTENT)
    if fit.coherence > _COMMON:
        reasons.append(Reason.COMMON_DISTURBANCE)
    if fit.rigidity_spread.min() > _UNINFORMED and loads_are_alike(data.vehicle):
        reasons.append(Reason.AXLES_ALIKE)
    return reasons


def coarse_converters(
    names: tuple[str, ...],
    density_ug_per_rthz: tuple[float, ...],
    acceleration: Floats,
    step_s: float,
) -> str:
    """Return the channels (4, n) whose converter alone is plainly noisier than declared, or "".

    Rounding to a step adds noise of the step over the root of twelve.
    """
    found = []
    for name, density, values in zip(names, density_ug_per_rthz, acceleration, strict=True):
        step = quality.converter_step(values)
        declared = density * MICRO_G_M_PER_S2 * np.sqrt(0.5 / step_s)
        if step / np.sqrt(12.0) > _COARSE * declared:
            found.append(f"{name} in steps of {step:.2g} m/s²")
    return ", ".join(found)


def _speeds_differ(data: CrossingData, fit: Fit) -> bool:
    """Return whether the receiver's speeds contradict its positions or the fit."""
    stay, time_s = data.stay, data.fixes.time_s
    around = (time_s > stay.entry_s - _RECEIVER_ASIDE_S) & (
        time_s < stay.exit_s + _RECEIVER_ASIDE_S
    )
    count = int(np.count_nonzero(around))
    bias = abs(fit.speed_bias)
    if bias > max(_LARGEST_SPEED_BIAS, _LARGEST_SPEED_BIAS_Z / np.sqrt(max(count, 1))):
        return True
    scale, spread = receiver.speed_scale(
        time_s[around],
        data.chainage_m[around],
        np.abs(data.fixes.speed_m_per_s[around]),
        noise_m=max(data.receiver.position_noise_m, 0.01),
        spread_m=data.receiver.position_spread_m,
    )
    return bool(abs(scale) > _LARGEST_SPEED_SCALE_Z * np.hypot(spread, _SPEED_SCALE_SPREAD))


def steps_of_channels(names: tuple[str, ...], fit: Fit) -> dict[Reason, str]:
    """Return the reason, and the channel's name, where a channel's delay or gain changes.

    The fit has spread the step over truck and bridge, so that no number of it can be used.
    """
    step = fit.step
    if step is None:
        return {}
    if abs(step.z) < _LARGEST_STEP_Z[step.kind] * np.sqrt(max(fit.chi2_per_dof, 1.0)):
        return {}
    name = names[step.channel]
    if step.kind == slip.GAIN:
        return {Reason.GAIN_CHANGED: f"{name}, by about {100.0 * step.size:+.2g} %"}
    return {Reason.CHANNEL_SLIPPED: f"{name}, by about {1e3 * step.size:+.2g} ms"}


def stiffer_elements(ratio: Floats) -> list[int]:
    """Return the elements whose EI over nominal, draws (k, n), no damage explains.

    Each is stiffer than nominal and than the median of the others by more than a factor, clearly.
    Low values alone, however low, never make another element implausible.
    """
    count = ratio.shape[1]
    if count < 2:
        return []
    clear = [
        min(
            np.quantile(ratio[:, e], _CLEARLY),
            np.quantile(ratio[:, e] / np.median(np.delete(ratio, e, axis=1), axis=1), _CLEARLY),
        )
        for e in range(count)
    ]
    return [e for e in range(count) if clear[e] > _STIFFER]


def _of_the_rows(data: CrossingData, fit: Fit) -> list[Reason]:
    stretch = _stretches(data, fit)
    found = quality.cells(fit.white, stretch, fit.step_s, _BANDS_HZ)
    suspicious = {
        key: cell
        for key, cell in found.items()
        if quality.cell_excess(cell, _slack(fit, *key)) > _FALSE_ALARM_Z
    }
    reasons: list[Reason] = []
    if suspicious and _is_only_noise(fit, found):
        reasons.append(Reason.NOISE_ABOVE_DECLARED)
    elif suspicious or fit.chi2_per_dof > _GOOD_CHI2:
        if fit.chi2_per_dof > _GOOD_CHI2:
            reasons.append(Reason.MODEL_MISFIT)
        else:
            reasons.append(Reason.RESIDUALS_COLOURED)
    if fit.chi2_per_dof < _SMALLEST_CHI2:
        reasons.append(Reason.NOISE_BELOW_DECLARED)
    return reasons


def _slack(fit: Fit, kind: int, stretch: int, band: int) -> float:
    """So many times its expected power a cell may have."""
    return _SLACK[band] * (_SLACK_OF_TWO_ROADS if fit.has_two_roads and kind == ROAD else 1.0)


def _stretches(data: CrossingData, fit: Fit) -> NDArray[np.int64]:
    """Whether a row compares the roads before, on or behind the bridge (m,)."""
    span = data.bridge.span_m
    travelled = fit.place_m if data.stay.direction > 0 else span - fit.place_m
    return np.where(travelled < 0.0, BEFORE, np.where(travelled > span, AFTER, ON)).astype(np.int64)


def _is_only_noise(fit: Fit, found: dict[tuple[int, int, int], quality.Cell]) -> bool:
    """Whether the rows are like noise of more power than declared, and of nothing else.

    That power is read off the highest band, where there is nothing but noise; it may differ from
    kind to kind, as the sensors do, and must be found everywhere else.
    """
    top = _BANDS_HZ.size - 2
    powers = []
    for kind in (ROAD, BODY_FRONT, BODY_REAR):
        parts = {key: cell for key, cell in found.items() if key[0] == kind}
        noise = quality.joined([cell for key, cell in parts.items() if key[2] == top])
        power = max(noise.mean_square, 1.0)
        powers.append(power)
        for key, cell in parts.items():
            if quality.cell_excess(cell, power * _slack(fit, *key)) > _FALSE_ALARM_Z:
                return False
    return max(powers) > _NOISY


def axle_loads_kg(vehicle: Vehicle) -> tuple[float, float]:
    """Static loads of the front and the rear axle, nominally."""
    share = vehicle.front_axle_to_cg_m / vehicle.wheelbase_m
    return (
        vehicle.sprung_mass_kg * (1.0 - share) + vehicle.unsprung_mass_kg[0],
        vehicle.sprung_mass_kg * share + vehicle.unsprung_mass_kg[1],
    )


def loads_are_alike(vehicle: Vehicle) -> bool:
    """Whether both axles press the bridge alike."""
    front, rear = axle_loads_kg(vehicle)
    return abs(front - rear) < ALIKE_LOADS * (front + rear)


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
    recorded = quality.unexplained(readings, step_s, *constants)
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
        left = quality.unexplained(placed.middle_of(vehicle, other), step_s, *constants)
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
