"""Tables to interpolate signals between samples, and the force step of a wheel on a bearing."""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.channels import PASS_BAND, STOP
from pre_core.kernels.windowed_sinc import kaiser_beta, windowed_sinc

PHASES = 64
"""Number of phases between two samples in the table of a wheel's step on entry or exit."""
SINC_TAPS = 16
"""Number of samples that interpolate a signal between two samples."""
STEP_REACH = 8
"""Number of samples to either side over which a band-limited step rings."""


def step_table() -> FloatArray:
    """Return band-limited unit steps at all phases between two samples: (phases + 1, 2 reach).

    Row p has a step that occurs p/phases of a sample before sample `reach`: the integral of the
    sinc of `sinc_table`. The force of a wheel that enters on a compliant bearing, and the
    deflection that it follows, begin with such a step.
    """
    fine = np.arange(2 * STEP_REACH * PHASES + 1) / PHASES - STEP_REACH
    impulse = windowed_sinc(fine, *_sinc_design(STEP_REACH), pedestal=1.0)
    rising = np.concatenate([[0.0], np.cumsum(0.5 * (impulse[1:] + impulse[:-1]))])
    rising /= rising[-1]
    phases = np.arange(PHASES + 1)
    samples = PHASES * np.arange(2 * STEP_REACH)
    return np.ascontiguousarray(rising[samples[None, :] + phases[:, None]])


def sinc_table() -> FloatArray:
    """Return weights (phases + 1, 2, taps) that interpolate signals between two samples.

    Row p interpolates at p/phases of the way from sample taps/2 - 1 to the next; the second axis
    has the weights and their slopes per phase, for smooth cubics between the rows. It is a
    sinc in a Kaiser window: images of the model's signals (up to channels.STOP of the rate) begin
    at 1 - STOP.
    """
    phase = np.arange(PHASES + 1) / PHASES
    step = 1e-4
    before, at, after = (_sinc_weights(phase + shift) for shift in (-step, 0.0, step))
    slope = (after - before) / (2.0 * step * PHASES)
    return np.ascontiguousarray(np.stack([at, slope], axis=1))


def _sinc_design(half: int) -> tuple[float, int, float]:
    """Return cutoff, half length and Kaiser's beta of the sinc for the model's band."""
    width = 1.0 - STOP - PASS_BAND
    attenuation = 14.36 * width * (2 * half - 1) + 7.95
    return 0.5 * (PASS_BAND + 1.0 - STOP), half, kaiser_beta(attenuation)


def _sinc_weights(phase: FloatArray) -> FloatArray:
    half = SINC_TAPS // 2
    distance = np.arange(SINC_TAPS) - (half - 1) - phase[:, None]
    weight = windowed_sinc(distance, *_sinc_design(half), pedestal=1.0)
    # Integrated accelerations drift far; parabolas are interpolated exactly at any phase.
    powers = distance[:, None, :] ** np.arange(3)[:, None]
    moments = np.einsum("pit,pjt,pt->pij", powers, powers, weight)
    share = np.linalg.solve(moments, np.tile([[1.0], [0.0], [0.0]], (phase.size, 1, 1)))
    return np.asarray(weight * np.einsum("pi,pit->pt", share[:, :, 0], powers))
