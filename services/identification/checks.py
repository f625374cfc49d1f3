"""Checks of a fit: the reasons not to trust its estimate.

`pre_core.diagnostics` measures; this module holds the thresholds, each with the values measured on
fault-free and on faulty crossings (studies/faults.md). `signal_checks` holds the checks that need
the signals alone.
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
from schemas.site_vehicle import axle_loads_kg
from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData
from services.identification.signal_checks import body_constants

_BANDS_HZ = np.array([0.0, 6.0, 12.0, 30.0, np.inf])
"""Frequency bands. The motion of bridge, body and wheels is mostly in the first three."""
_FALSE_ALARM_Z = 4.5
"""Threshold that one of 36 residual bins exceeds by chance in 1e-4 of the crossings."""
_TOLERATED_POWER = (1.35, 1.35, 1.35, 1.15)
"""Tolerated noise power of each band, relative to the declared one. The declared density comes from
a data sheet, which omits the sensor's 1/f noise."""
_TOLERATED_WITH_MISMATCH = 1.6
"""Tolerated power where the axles' profiles differ: three standard deviations of a mismatch level
estimated from some ten waves."""
SHORTEST_APPROACH_M = 12.0
"""Length of road off the bridge below which the mismatch level is uncertain by a factor of 1.4."""
_NOISY = 1.2
"""Noise power, relative to the declared one, above which white residuals are called noisy."""
_GOOD_CHI2 = 1.25
"""Largest chi2 per degree of freedom without a misfit of the model, unless noise alone explains
it."""
_SMALLEST_CHI2 = 0.6
"""Smallest chi2 per degree of freedom without noise far below the declared, which makes intervals
too wide."""
LARGEST_PRIOR_Z = 4.0
"""Largest plausible distance of a parameter from its prior, in standard deviations."""
_MAX_NAMED = 3
_LARGEST_POSITION_Z = 4.0
"""Largest plausible slow error of the receiver, in standard deviations."""
_LARGEST_STEP_Z = {slip.DELAY: 6.0, slip.GAIN: 7.0}
"""Largest tolerated step in the delay or gain of a channel, in standard deviations for residuals of
the estimated variance. Fault-free: at most 3.5; one lost sample of 1 kHz: 6.8 to 38."""
_SHORTEST_SLIP_S = 1e-4
"""Change of a delay that is less than one lost sample at 10 kHz, and has no effect on the bridge:
delays are known to 0.5 ms. A plate that bends across its axis resembles a step of 0.03 ms."""
_LARGEST_SPEED_SCALE_Z = 5.0
"""Largest tolerated difference between the receiver's speeds and the derivative of its positions,
in standard deviations. Fault-free: at most 2."""
_COMPARED_FIXES_S = 4.0
"""Time before and after the bridge over which fixes are compared; the fit uses the same."""
_SPEED_SCALE_SPREAD = 0.002
"""Standard deviation of the speed scale for a road that is not quite parallel to the bridge's
axis."""
_LARGEST_SPEED_BIAS, _LARGEST_SPEED_BIAS_Z = 1.0, 5.0
"""Largest tolerated mean difference between the receiver's speeds and the fit's, in multiples of
their noise and of the standard error of the mean. Fault-free: at most 0.3 at ten fixes a second;
speeds 3 % high: 1.3 to 3.7."""
_LARGEST_COHERENCE = 0.7
"""Largest tolerated coherence between the residuals of the body equations, where they exceed the
sensors' noise. Dry friction and nonlinear dampers: -0.13 to 0.28; tilted sensors on a truck that
shakes above 2 Hz: 0.95 to 0.97."""
_NAMED_QUANTISATION = 1.4
"""Quantisation noise, relative to the declared noise, above which a converter is named."""
_EXCITED_RMS = 3.0
"""RMS of an acceleration, relative to the declared noise, above which the road excites the truck:
12 on a road fifty times smoother than class A, 1.7 on a flat one."""
_IMPLAUSIBLE_RATIO = 1.5
"""Ratio of an element's EI to its nominal value, and to the other elements, that only wrong signals
exceed. Ageing and an inaccurate nominal value change it by less."""
_LOW_QUANTILE = 0.025
"""Quantile of the draws that must exceed `_IMPLAUSIBLE_RATIO`."""
_UNDECLARED, _PLAINLY_UNDECLARED = 0.12, 0.3
_REAR_OVER_FRONT = 2.5
"""Unexplained part of the rear body's motion, alone and relative to the front's. Sixteen
semitrailers and tandems declared with two axles: 0.15 to 1.3, 1.9 to 190 times the front's.
Two-axle trucks: at most 0.05, with dry friction 0.21. Between the first and the second threshold it
is a cause to name where another check fails, and no reason by itself."""
_LARGEST_MISMATCH_BIAS = 40.0
"""Largest tolerated correction for the mismatch, in multiples of a prior's spread. Fault-free: at
most 3; trailers and searches that diverged: 540 to 13,000."""
_MISMATCH_EXCESS = 30.0
"""Largest tolerated ratio of measured to declared mismatch power: tyres twice as wide as declared,
or tracks that differ by 20 cm where they are declared equal."""
_TANDEM_FRICTION = 0.001
"""Largest tolerated friction, over the static load, of a tandem's springs that do not share it. At
0.002 the elements are known no better than to 40 %."""
ALIKE_LOADS = 0.1
"""Share of the total load below which a difference between the axle loads counts as none. Equal
loads make the effect of the road indistinguishable from that of the bridge."""
_LARGEST_PAVEMENT_RATIO = 6.0
"""Largest tolerated mismatch on the bridge over that off it, 2.5 standard deviations of its prior:
decks were up to 3.8 times as rough as the road before them."""
_UNINFORMATIVE_SPREAD = 0.8
"""Posterior spread of the best-known element, relative to its prior, above which the crossing was
uninformative."""

ROAD, BODY_FRONT, BODY_REAR = range(3)
BEFORE, ON, AFTER = range(3)


class FitDiagnostics(NamedTuple):
    """Residuals and implied corrections of a fit by method `pre`."""

    white: Floats
    """Whitened residuals (m, 3): profile mismatch, front and rear body equation. Their variance is
    one for the noise that the site file declares; not inflated."""
    step_s: float
    """Time between residuals."""
    chainage_m: Floats
    """Chainage (m,) at which a residual compares the profiles: the rear axle's at the middle of the
    filter."""
    chi2_per_dof: float
    prior_z: dict[str, float]
    """Parameters of the truck, c_s1 … kappa and wheelbase, in multiples of their prior's spread."""
    position_z: float
    """Slow error of the receiver in multiples of its spread."""
    rigidity_spread: Floats
    """Standard deviation of ln EI (elements,), relative to the prior's."""
    has_mismatch: bool
    """Whether the residuals off the bridge show that the axles' profiles differ."""
    off_bridge_m: float
    """Length of road off the bridge from which the mismatch was estimated."""
    speed_bias: float = 0.0
    """Mean difference between the receiver's speeds and the fit's, in multiples of their noise."""
    coherence: float = 0.0
    """Coherence between the residuals of the body equations, where their weight is reduced."""
    step: slip.Step | None = None
    """The most significant step in the delay or the gain of a channel."""
    mismatch_excess: float = 0.0
    """Power of the mismatch off the bridge, relative to that of the declared axles."""
    mismatch_bias: float = 0.0
    """Largest correction of a truck's parameter for the mismatch, in multiples of its prior's
    spread."""
    pavement_ratio: float = 1.0
    """Amplitude of the mismatch on the bridge over that off it, in waves of a metre."""
    tandem_friction: float = 0.0
    """Friction of a tandem's springs over their load, where they do not share it."""


def reasons_after_fit(data: CrossingData, fit: FitDiagnostics) -> list[Reason]:
    """Return the reasons not to trust a fit, the most significant first; none if it is reliable."""
    reasons = [Reason.TANDEM_FRICTION] if fit.tandem_friction > _TANDEM_FRICTION else []
    reasons += _residual_reasons(data, fit)
    is_unexplained = bool({Reason.MODEL_MISFIT, Reason.RESIDUALS_COLOURED} & set(reasons))
    if fit.off_bridge_m < SHORTEST_APPROACH_M and (fit.has_mismatch or is_unexplained):
        reasons.append(Reason.APPROACH_TOO_SHORT)
    if fit.prior_z and max(abs(z) for z in fit.prior_z.values()) > LARGEST_PRIOR_Z:
        reasons.append(Reason.IMPLAUSIBLE_VEHICLE)
    if (
        fit.mismatch_excess > _MISMATCH_EXCESS
        or fit.pavement_ratio > _LARGEST_PAVEMENT_RATIO
        or is_biased_by_mismatch(fit)
    ):
        reasons.append(Reason.MISMATCH_IMPLAUSIBLE)
    if abs(fit.position_z) > _LARGEST_POSITION_Z:
        reasons.append(Reason.POSITION_INCONSISTENT)
    if _speeds_differ(data, fit):
        reasons.append(Reason.SPEED_INCONSISTENT)
    if fit.coherence > _LARGEST_COHERENCE:
        reasons.append(Reason.COMMON_DISTURBANCE)
    if fit.rigidity_spread.min() > _UNINFORMATIVE_SPREAD and loads_are_alike(data.vehicle):
        reasons.append(Reason.AXLES_ALIKE)
    return reasons


def coarse_converters(
    names: tuple[str, ...],
    density_ug_per_rthz: tuple[float, ...],
    acceleration: Floats,
    step_s: float,
) -> str:
    """Return the channels (4, n) whose quantisation noise alone exceeds the declared one, or "".

    Rounding to steps of size q adds noise of standard deviation q/√12.
    """
    found = []
    for name, density, values in zip(names, density_ug_per_rthz, acceleration, strict=True):
        step = converter_step(values)
        declared = density * MICRO_G_M_PER_S2 * np.sqrt(0.5 / step_s)
        if step / np.sqrt(12.0) > _NAMED_QUANTISATION * declared:
            found.append(f"{name} in steps of {step:.2g} m/s²")
    return ", ".join(found)


def weak_excitation(
    density_ug_per_rthz: tuple[float, ...], acceleration: Floats, step_s: float
) -> str:
    """Return a clause if all channels (4, n) hardly exceed their declared noise, or "".

    Then the road excites the truck too little to distinguish a step from chance.
    """
    declared = np.array(density_ug_per_rthz) * MICRO_G_M_PER_S2 * np.sqrt(0.5 / step_s)
    largest = float(np.max(np.std(acceleration, axis=1) / np.maximum(declared, 1e-12)))
    if largest > _EXCITED_RMS:
        return ""
    return (
        f"but the RMS of all accelerations is at most {largest:.2g} times the sensors' noise: the "
        "road hardly excites the truck, and the step may be chance; drive faster, or use quieter "
        "sensors"
    )


def _speeds_differ(data: CrossingData, fit: FitDiagnostics) -> bool:
    """Return whether the receiver's speeds contradict its positions or the fit."""
    stay, time_s = data.stay, data.fixes.time_s
    around = (time_s > stay.entry_s - _COMPARED_FIXES_S) & (
        time_s < stay.exit_s + _COMPARED_FIXES_S
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


def steps_of_channels(names: tuple[str, ...], fit: FitDiagnostics) -> dict[Reason, str]:
    """Return the reason and the channel's name where a channel's delay or gain changes.

    The fit has spread the step over truck and bridge, so none of its numbers can be used.
    """
    step = fit.step
    if step is None:
        return {}
    if abs(step.z) < _LARGEST_STEP_Z[step.kind] * np.sqrt(max(fit.chi2_per_dof, 1.0)):
        return {}
    if step.kind == slip.DELAY and abs(step.size) < _SHORTEST_SLIP_S:
        return {}
    name = names[step.channel]
    if step.kind == slip.GAIN:
        return {Reason.GAIN_CHANGED: f"{name}, by about {100.0 * step.size:+.2g} %"}
    return {Reason.CHANNEL_SLIPPED: f"{name}, by about {1e3 * step.size:+.2g} ms"}


def stiffer_elements(ratio: Floats) -> list[int]:
    """Return the elements whose draws (k, n) of EI over nominal are implausibly high.

    Such an element exceeds both its nominal value and the median of the others by
    `_IMPLAUSIBLE_RATIO`, with a probability of at least 1 - `_LOW_QUANTILE`. Low values alone,
    however low, never make another element implausible.
    """
    count = ratio.shape[1]
    if count < 2:
        return []
    clear = [
        min(
            np.quantile(ratio[:, e], _LOW_QUANTILE),
            np.quantile(
                ratio[:, e] / np.median(np.delete(ratio, e, axis=1), axis=1), _LOW_QUANTILE
            ),
        )
        for e in range(count)
    ]
    return [e for e in range(count) if clear[e] > _IMPLAUSIBLE_RATIO]


def _residual_reasons(data: CrossingData, fit: FitDiagnostics) -> list[Reason]:
    segment = _segments(data, fit)
    found = quality.residual_bins(fit.white, segment, fit.step_s, _BANDS_HZ)
    suspicious = {
        key: cell
        for key, cell in found.items()
        if quality.bin_excess(cell, _tolerated_power(fit, *key)) > _FALSE_ALARM_Z
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


def _tolerated_power(fit: FitDiagnostics, kind: int, segment: int, band: int) -> float:
    """Return the tolerated power of a residual bin, relative to the expected one."""
    return _TOLERATED_POWER[band] * (
        _TOLERATED_WITH_MISMATCH if fit.has_mismatch and kind == ROAD else 1.0
    )


def _segments(data: CrossingData, fit: FitDiagnostics) -> NDArray[np.int64]:
    """Return for each residual (m,) whether it lies before, on or after the bridge."""
    span = data.bridge.span_m
    travelled = fit.chainage_m if data.stay.direction > 0 else span - fit.chainage_m
    return np.where(travelled < 0.0, BEFORE, np.where(travelled > span, AFTER, ON)).astype(np.int64)


def _is_only_noise(
    fit: FitDiagnostics, found: dict[tuple[int, int, int], quality.ResidualBin]
) -> bool:
    """Return whether noise of more than the declared power alone explains the residuals.

    The power is estimated from the highest band, which contains only noise. It may differ between
    the kinds of residuals, as the sensors do, and must fit all other bins.
    """
    top = _BANDS_HZ.size - 2
    powers = []
    for kind in (ROAD, BODY_FRONT, BODY_REAR):
        parts = {key: cell for key, cell in found.items() if key[0] == kind}
        noise = quality.merge_bins([cell for key, cell in parts.items() if key[2] == top])
        power = max(noise.mean_square, 1.0)
        powers.append(power)
        for key, cell in parts.items():
            if quality.bin_excess(cell, power * _tolerated_power(fit, *key)) > _FALSE_ALARM_Z:
                return False
    return max(powers) > _NOISY


def loads_are_alike(vehicle: Vehicle) -> bool:
    """Return whether both axle loads are equal within `ALIKE_LOADS`."""
    front, rear = axle_loads_kg(vehicle)
    return abs(front - rear) < ALIKE_LOADS * (front + rear)


def is_biased_by_mismatch(fit: FitDiagnostics) -> bool:
    """Return whether the correction for the mismatch exceeds that of any truck.

    None of the fit's numbers can be used then.
    """
    return fit.mismatch_bias > _LARGEST_MISMATCH_BIAS


def undeclared_axles(
    vehicle: Vehicle, acceleration: Floats, step_s: float, *, has_reasons: bool
) -> dict[Reason, str]:
    """Return the reason if an undeclared axle acts on the rear of the body, else nothing.

    The body equations are evaluated with the middle readings (4, n). Where other checks have failed
    (`has_reasons`), a lower threshold holds.
    """
    if vehicle.tandem is not None:  # whose front axle has no reading
        return {}
    front, rear = quality.unexplained_by_axle(acceleration, step_s, *body_constants(vehicle))
    least = _UNDECLARED if has_reasons else _PLAINLY_UNDECLARED
    if rear < max(least, _REAR_OVER_FRONT * front):
        return {}
    return {
        Reason.MORE_AXLES_THAN_DECLARED: (
            f"{100.0 * rear:.0f} % of the rear's motion is unexplained, "
            f"{100.0 * front:.0f} % of the front's"
        )
    }


def implausible_parameters(fit: FitDiagnostics) -> str:
    """Return the names of implausible truck parameters, most deviating first, or ""."""
    far = {name: z for name, z in fit.prior_z.items() if abs(z) > LARGEST_PRIOR_Z}
    named = sorted(far, key=lambda name: -abs(far[name]))[:_MAX_NAMED]
    if not named:
        return ""
    values = ", ".join(f"{name} {far[name]:+.1f}" for name in named)
    return f"{values} standard deviations"
