"""Whether the answer of a fit can be trusted: the reasons against it.

What is measured is in `pre_core.diagnostics`; here are the thresholds, each with what it was
measured to be on sound crossings and on broken ones (docs/verdicts.md). What signals alone say is
in `signal_checks`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.crossing import slip
from pre_core.diagnostics import quality, receiver
from pre_core.diagnostics.converter import converter_step
from schemas.reasons import Reason
from schemas.site import Vehicle
from services.identification.crossing_data import CrossingData, Floats
from services.identification.signal_checks import body_constants

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
_MOST_NAMED = 3
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
_UNDECLARED, _PLAINLY_UNDECLARED = 0.12, 0.3
_REAR_OVER_FRONT = 2.5
"""Part of the rear body's motion that its equation leaves over, and over the front's. Sixteen
semitrailers and tandems declared with two axles: 0.15 to 1.3, 1.9 to 190 times the front's; sound
trucks 0.05 at most, with springs that rub 0.21: below the second figure the first is a cause to
name where something else is wrong, and no reason by itself."""
_LED_AWAY = 40.0
"""Sound: at most 3; trailers and searches that ran away: 540 to 13,000."""
_MISMATCH_EXCESS = 30.0
"""In power: tyres twice as wide, or tracks that differ by 20 cm where they are declared alike."""
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
    mismatch_excess: float = 0.0
    """Power of the mismatch off the bridge over what the declared axles would have."""
    led_by_mismatch: float = 0.0
    """Largest correction of a truck's unknown for the mismatch, in multiples of its prior's
    spread."""


def reasons_after_fit(data: CrossingData, fit: Fit) -> list[Reason]:
    """What the fit says against its own answer, the most telling first; empty if nothing does."""
    reasons = _of_the_rows(data, fit)
    is_unexplained = bool({Reason.MODEL_MISFIT, Reason.RESIDUALS_COLOURED} & set(reasons))
    if fit.off_bridge_m < SHORTEST_APPROACH_M and (fit.has_two_roads or is_unexplained):
        reasons.append(Reason.APPROACH_TOO_SHORT)
    if fit.prior_z and max(abs(z) for z in fit.prior_z.values()) > _LARGEST_VEHICLE_Z:
        reasons.append(Reason.IMPLAUSIBLE_VEHICLE)
    if fit.mismatch_excess > _MISMATCH_EXCESS or is_led_away(fit):
        reasons.append(Reason.MISMATCH_IMPLAUSIBLE)
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
        step = converter_step(values)
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


def is_led_away(fit: Fit) -> bool:
    """Return whether the correction for the mismatch is beyond any truck: no number can be used."""
    return fit.led_by_mismatch > _LED_AWAY


def undeclared_axles(
    vehicle: Vehicle, acceleration: Floats, step_s: float, *, is_doubted: bool
) -> dict[Reason, str]:
    """Return the reason why the rear of the body follows a force that no declared axle has.

    By the body equations of the middle readings (4, n). Where `is_doubted` for other reasons, less
    is enough.
    """
    front, rear = quality.unexplained_by_axle(acceleration, step_s, *body_constants(vehicle))
    least = _UNDECLARED if is_doubted else _PLAINLY_UNDECLARED
    if rear < max(least, _REAR_OVER_FRONT * front):
        return {}
    return {
        Reason.MORE_AXLES_THAN_DECLARED: f"{100.0 * rear:.0f} % of its motion are unexplained, "
        f"{100.0 * front:.0f} % at the front"
    }


def odd_parameters(fit: Fit) -> str:
    """Return the truck's parameters that are implausibly far from the site file, farthest first."""
    far = {name: z for name, z in fit.prior_z.items() if abs(z) > _LARGEST_VEHICLE_Z}
    named = sorted(far, key=lambda name: -abs(far[name]))[:_MOST_NAMED]
    if not named:
        return ""
    values = ", ".join(f"{name} {far[name]:+.1f}" for name in named)
    return f"{values} standard deviations"
