"""Consistency of redundant sensors on a rigid part; no verdicts.

A part with more sensors than motions (a body has three: above both axles, and roll; an axle two)
has combinations of sensors that cancel its motion. They contain noise only, unless a gain or a
delay is wrong or a sensor is loose. Four sensors on the corners of a body have one such
combination: it reveals a gain error of about 5 %, and a delay of some ms.

It reveals neither errors that all sensors of a part share, nor whether a gain is wrong or another
sensor with equal motion has the opposite error; then both are named. A frame that twists also
shows, and is not a fault: power that no sensor's gain and delay explain counts only if it is large.

Left and right on an axle are not redundant: their difference is the axle's roll, which near wheel
hop is several times its heave. Only a loose physical bound holds: one side does not move several
times as much as the other. Smaller gain errors are not detected before the fit.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray

_BAND_HZ = (0.7, 12.0)
"""Band in which the motion of bodies and axles exceeds sensor noise."""


class RedundancyResidual(NamedTuple):
    """Power of the motion-free combinations, in units of their noise density."""

    power: float
    """Sum of squares of the combinations over the band."""
    expected: float
    """Sum of squares that noise, gains and delays cause at `slack` standard deviations."""
    motion: float
    """Sum of squares that the combinations would have if all sensors moved independently."""
    unexplained: FloatArray
    """Share (m,) of the power that a gain error and a delay of this sensor alone do not explain;
    NaN for sensors outside the part."""
    gain: FloatArray
    """Relative gain error (m,) in that fit."""
    delay_s: FloatArray
    """Delay (m,) in that fit, positive if late."""


def redundancy_residual(
    parity: FloatArray,
    acceleration: FloatArray,
    step_s: float,
    gain_spread: float,
    delay_spread_s: float,
    slack: float,
) -> RedundancyResidual:
    """Return the power of combinations `parity` (r, m) of accelerations (m, n), and its limit.

    `parity` is scaled such that the combinations have unit one-sided noise density. The spreads are
    standard deviations of gain and delay.
    """
    spectrum, omega = _spectrum(acceleration, step_s)
    rate = 1j * omega * spectrum
    left = parity @ spectrum
    total = _power(left)
    moved, changed = (np.sum(np.abs(one) ** 2, axis=1) for one in (spectrum, rate))
    size = np.sum(parity**2, axis=0)
    noise = parity.shape[0] * omega.size
    errors = float(size @ (gain_spread**2 * moved + delay_spread_s**2 * changed))
    count = acceleration.shape[0]
    unexplained, gain, delay = (np.full(count, np.nan) for _ in range(3))
    for k in np.flatnonzero(size):
        shapes = np.stack([np.outer(parity[:, k], one[k]).ravel() for one in (spectrum, -rate)])
        normal = (shapes.conj() @ shapes.T).real
        found = np.linalg.lstsq(normal, (shapes.conj() @ left.ravel()).real, rcond=None)[0]
        rest = left.ravel() - found @ shapes
        unexplained[k] = _power(rest) / total if total > 0.0 else 0.0
        gain[k], delay[k] = found
    return RedundancyResidual(
        total, slack**2 * (noise + errors), float(size @ moved), unexplained, gain, delay
    )


def motion_ratio(one: FloatArray, other: FloatArray, step_s: float) -> float:
    """Return the ratio, 1 or more, of the RMS of two signals (n,) in the band."""
    spectrum, _ = _spectrum(np.stack([one, other]), step_s)
    power = np.sum(np.abs(spectrum) ** 2, axis=1)
    return float(np.sqrt(power.max() / power.min())) if power.min() > 0.0 else np.inf


def _power(values: NDArray[np.complex128]) -> float:
    return float(np.sum(np.abs(values) ** 2))


def _spectrum(signals: FloatArray, step_s: float) -> tuple[NDArray[np.complex128], FloatArray]:
    """Return spectra (m, k) in the band, whose power is the one-sided density, and omega (k,)."""
    size = signals.shape[1]
    window = np.hanning(size)
    centred = window * (signals - signals.mean(axis=1, keepdims=True))
    frequency = np.fft.rfftfreq(size, step_s)
    band = (frequency >= _BAND_HZ[0]) & (frequency <= _BAND_HZ[1])
    scale = np.sqrt(2.0 * step_s / float(window @ window))
    spectrum = np.fft.rfft(centred, axis=1)[:, band] * scale
    return spectrum, np.asarray(2.0 * np.pi * frequency[band], dtype=np.float64)
