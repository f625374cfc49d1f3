"""What redundant sensors of a rigid part say against one another: numbers, no verdicts.

A part with more sensors than it has motions (a body shows three: above both axles, and roll; an
axle two) has combinations of sensors in which its motion cancels. What is left of them is noise,
unless a gain or a delay is wrong or a sensor is loose. Four sensors on the corners of a body have
one such combination: it sees a gain that is off by some 5 %, and a delay of some ms.

It cannot see what all sensors of a part share, nor tell a wrong gain from the opposite error of a
sensor that moves alike; then both are named. A frame that twists shows as well, and is no fault:
what is not explained by one sensor's gain and delay counts only where it is large.

Left and right on an axle are not redundant: their difference is the axle's roll, which at its hop
is several times its heave. Only physics bounds it, and loosely: one side does not move several
times as much as the other. A gain that is off by less is not seen before the fit.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_BAND_HZ = (0.7, 12.0)
"""Where bodies and axles move more than sensors hiss."""


class Leftover(NamedTuple):
    """What is left where the motion of a part cancels; powers in units of the parity's noise."""

    power: float
    """Mean square of the combinations, over the band."""
    expected: float
    """What noise, gains and delays within their spreads make of it, at `slack` deviations."""
    motion: float
    """What it were if every sensor moved for itself."""
    unexplained: FloatArray
    """(m,) part of the power that one sensor's gain and delay leave; NaN of sensors elsewhere."""
    gain: FloatArray
    """(m,) relative error of that gain."""
    delay_s: FloatArray
    """(m,) that delay, positive if the sensor is late."""


def leftover(
    parity: FloatArray,
    acceleration: FloatArray,
    step_s: float,
    gain_spread: float,
    delay_spread_s: float,
    slack: float,
) -> Leftover:
    """Judge sensors (m, n) by the combinations `parity` (r, m) of unit one-sided noise density."""
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
    return Leftover(
        total, slack**2 * (noise + errors), float(size @ moved), unexplained, gain, delay
    )


def apart(one: FloatArray, other: FloatArray, step_s: float) -> float:
    """Return how many times more the livelier of two signals (n,) moves than the other."""
    spectrum, _ = _spectrum(np.stack([one, other]), step_s)
    power = np.sum(np.abs(spectrum) ** 2, axis=1)
    return float(np.sqrt(power.max() / power.min())) if power.min() > 0.0 else np.inf


def _power(values: NDArray[np.complex128]) -> float:
    return float(np.sum(np.abs(values) ** 2))


def _spectrum(signals: FloatArray, step_s: float) -> tuple[NDArray[np.complex128], FloatArray]:
    """Return spectra (m, k) in the band, of unit power for unit one-sided density, and omega."""
    size = signals.shape[1]
    window = np.hanning(size)
    centred = window * (signals - signals.mean(axis=1, keepdims=True))
    frequency = np.fft.rfftfreq(size, step_s)
    band = (frequency >= _BAND_HZ[0]) & (frequency <= _BAND_HZ[1])
    scale = np.sqrt(2.0 * step_s / float(window @ window))
    spectrum = np.fft.rfft(centred, axis=1)[:, band] * scale
    return spectrum, np.asarray(2.0 * np.pi * frequency[band], dtype=np.float64)
