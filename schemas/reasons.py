"""Reasons why a crossing is not `good`, a sentence each."""

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Final


class Reason(StrEnum):
    """A code in `reasons` of a result. A code never changes its meaning."""

    # Faults of the recording.
    CHANNEL_MISSING = "channel_missing"
    GAP_ON_BRIDGE = "gap_on_bridge"
    POSITION_OUTAGE = "position_outage"
    NOT_FINITE = "not_finite"
    SENSOR_SATURATED = "sensor_saturated"
    CHANNEL_SWAPPED = "channel_swapped"
    CHANNEL_INVERTED = "channel_inverted"
    CHANNEL_STUCK = "channel_stuck"
    CHANNEL_BRIDGED = "channel_bridged"
    CHANNELS_ALIKE = "channels_alike"
    CHANNEL_BIASED = "channel_biased"
    CHANNEL_SLIPPED = "channel_slipped"
    GAIN_CHANGED = "gain_changed"
    SIGNAL_SPIKES = "signal_spikes"
    ROLL_NOT_SEEN = "roll_not_seen"
    SENSORS_DISAGREE = "sensors_disagree"
    INCOMPLETE_CROSSING = "incomplete_crossing"
    # Knowledge from outside the signals.
    VEHICLE_DIFFERS_FROM_SITE = "vehicle_differs_from_site"
    OTHER_TRUCK_ON_BRIDGE = "other_truck_on_bridge"
    # The way the truck was driven.
    SPEED_TOO_LOW = "speed_too_low"
    STOPPED_ON_BRIDGE = "stopped_on_bridge"
    ACCELERATING_CG_UNKNOWN = "accelerating_cg_unknown"
    AXLES_ALIKE = "axles_alike"
    APPROACH_TOO_SHORT = "approach_too_short"
    # Diagnostics of the fit.
    NO_NOISE_MODEL = "no_noise_model"
    MODEL_MISFIT = "model_misfit"
    RESIDUALS_COLOURED = "residuals_coloured"
    NOISE_ABOVE_DECLARED = "noise_above_declared"
    NOISE_BELOW_DECLARED = "noise_below_declared"
    IMPLAUSIBLE_VEHICLE = "implausible_vehicle"
    TANDEM_FRICTION = "tandem_friction"
    MORE_AXLES_THAN_DECLARED = "more_axles_than_declared"
    MISMATCH_IMPLAUSIBLE = "mismatch_implausible"
    COMMON_DISTURBANCE = "common_disturbance"
    IMPLAUSIBLE_BRIDGE = "implausible_bridge"
    POSITION_INCONSISTENT = "position_inconsistent"
    SPEED_INCONSISTENT = "speed_inconsistent"
    # Outcome of the search.
    NOT_CONVERGED = "not_converged"
    SAMPLER_DIAGNOSTICS = "sampler_diagnostics"
    FAILED = "failed"
    CONTINUOUS_BRIDGE = "continuous_bridge"
    TANDEM = "tandem"


REASON_TEXTS: Final[dict[Reason, str]] = {
    Reason.CHANNEL_MISSING: "The truck lacks one of the four accelerometers that the method needs.",
    Reason.GAP_ON_BRIDGE: "Samples are missing from the time on the bridge.",
    Reason.POSITION_OUTAGE: (
        "The receiver reported no position for more than 1.5 s near the bridge."
    ),
    Reason.NOT_FINITE: "The recording or the fit contains values that are not finite numbers.",
    Reason.SENSOR_SATURATED: "An accelerometer reached the end of its range.",
    Reason.CHANNEL_SWAPPED: "Two channels seem to be swapped.",
    Reason.CHANNEL_INVERTED: "A channel seems to have the wrong sign.",
    Reason.CHANNEL_STUCK: "A channel repeats one value.",
    Reason.CHANNEL_BRIDGED: "A channel contains a straight line in place of measured samples.",
    Reason.CHANNELS_ALIKE: "Two channels are identical.",
    Reason.CHANNEL_BIASED: "A channel has an offset that is a considerable part of gravity.",
    Reason.CHANNEL_SLIPPED: "The delay of a channel changes within the record.",
    Reason.GAIN_CHANGED: "The gain of a channel changes within the record.",
    Reason.SIGNAL_SPIKES: "Single samples of a channel are far from their neighbours.",
    Reason.ROLL_NOT_SEEN: (
        "A part of the truck is measured on one side only, so its roll cannot be separated from "
        "its heave."
    ),
    Reason.SENSORS_DISAGREE: (
        "Accelerometers of one part of the truck do not agree: a gain or delay is wrong, or a "
        "sensor is loose."
    ),
    Reason.INCOMPLETE_CROSSING: "The recording begins or ends while the truck is on the bridge.",
    Reason.VEHICLE_DIFFERS_FROM_SITE: (
        "The truck reports values of its own that differ from the site file."
    ),
    Reason.OTHER_TRUCK_ON_BRIDGE: "Another truck was on the bridge at the same time.",
    Reason.SPEED_TOO_LOW: (
        "The truck was so slow that the bridge's stiffness hardly affects its axles."
    ),
    Reason.STOPPED_ON_BRIDGE: "The truck stopped or turned back on the bridge.",
    Reason.ACCELERATING_CG_UNKNOWN: (
        "The truck braked or accelerated and the height of its centre of gravity is unknown."
    ),
    Reason.AXLES_ALIKE: (
        "The axle loads are nearly equal, so the difference between the axles carries little "
        "information."
    ),
    Reason.APPROACH_TOO_SHORT: (
        "The axles seem to follow different road profiles, and too little road was recorded before "
        "and after the bridge to estimate by how much they differ."
    ),
    Reason.NO_NOISE_MODEL: "The method has no noise model, so it provides no valid intervals.",
    Reason.MODEL_MISFIT: "The model does not explain the measured accelerations.",
    Reason.RESIDUALS_COLOURED: "The residuals are not random noise.",
    Reason.NOISE_ABOVE_DECLARED: "The accelerometers are noisier than the site file declares.",
    Reason.NOISE_BELOW_DECLARED: (
        "The accelerometers are much quieter than the site file declares, which could hide a "
        "misfit."
    ),
    Reason.IMPLAUSIBLE_VEHICLE: "The estimated truck parameters contradict the site file.",
    Reason.TANDEM_FRICTION: (
        "Friction in the springs of the tandem, which has no load equalisation, hides the "
        "difference of the deflections under its axles."
    ),
    Reason.MORE_AXLES_THAN_DECLARED: (
        "The rear of the truck moves as if pushed by a further axle or a trailer that the site "
        "file does not declare."
    ),
    Reason.MISMATCH_IMPLAUSIBLE: (
        "The road profiles under the axles differ by far more than the declared tyres and tracks "
        "can cause."
    ),
    Reason.COMMON_DISTURBANCE: (
        "All sensors share a disturbance that is not vertical motion, such as that of tilted "
        "sensors."
    ),
    Reason.IMPLAUSIBLE_BRIDGE: (
        "An element is so much stiffer than its nominal value and than the others that no damage "
        "of the others explains it."
    ),
    Reason.POSITION_INCONSISTENT: "The estimated position contradicts the receiver.",
    Reason.SPEED_INCONSISTENT: "The receiver's speeds contradict its positions or the estimate.",
    Reason.NOT_CONVERGED: "The search did not converge.",
    Reason.SAMPLER_DIAGNOSTICS: "The posterior draws did not converge.",
    Reason.FAILED: "The identification failed.",
    Reason.CONTINUOUS_BRIDGE: (
        "The bridge has supports between its ends, and the method is for a single span."
    ),
    Reason.TANDEM: "The truck has a tandem, and the method is for two axles.",
}


class BridgeReason(StrEnum):
    """A reason why the fused estimate of a bridge is not `good`."""

    NO_GOOD_CROSSING = "no_good_crossing"
    NOT_FUSED = "not_fused"
    CROSSINGS_DISAGREE = "crossings_disagree"
    NEWEST_DISAGREE = "newest_disagree"
    MANY_LEFT_OUT = "many_left_out"
    USES_SUSPECT = "uses_suspect"


BRIDGE_REASON_TEXTS: Final[dict[BridgeReason, str]] = {
    BridgeReason.NO_GOOD_CROSSING: "No crossing of the bridge is good.",
    BridgeReason.NOT_FUSED: (
        "The method provides no likelihood to fuse; this is the latest crossing alone."
    ),
    BridgeReason.CROSSINGS_DISAGREE: (
        "Crossings scatter by more than their uncertainty explains, over all elements or truck "
        "values together, even if single intervals overlap; they are too few to show which "
        "crossing is wrong."
    ),
    BridgeReason.NEWEST_DISAGREE: (
        "The newest crossings disagree with the earlier ones, on which the values are based: the "
        "bridge may have changed."
    ),
    BridgeReason.MANY_LEFT_OUT: "Two or more good crossings disagree with the others.",
    BridgeReason.USES_SUSPECT: "Suspect crossings were fused on request.",
}


class LeftOutReason(StrEnum):
    """A reason why a crossing is excluded from the fused estimate of its bridge."""

    SUSPECT = "suspect"
    DISAGREES = "disagrees"
    OTHER_MODEL = "other_model"
    NO_LIKELIHOOD = "no_likelihood"
    NOT_FUSED = "not_fused"


LEFT_OUT_TEXTS: Final[dict[str, str]] = {
    LeftOutReason.SUSPECT: "suspect",
    LeftOutReason.DISAGREES: "disagrees with the others beyond its uncertainty",
    LeftOutReason.OTHER_MODEL: "was identified with other elements or parameters",
    LeftOutReason.NO_LIKELIHOOD: "is an older result without the data that fusion needs",
    LeftOutReason.NOT_FUSED: "this method's results are not fused",
}


def texts(reasons: Iterable[Reason], about: Mapping[Reason, str] | None = None) -> list[str]:
    """Return the sentence of each reason in the same order; `about` has the names it concerns."""
    names = about or {}
    return [
        f"{REASON_TEXTS[reason].removesuffix('.')}: {names[reason]}."
        if names.get(reason)
        else REASON_TEXTS[reason]
        for reason in reasons
    ]
