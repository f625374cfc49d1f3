"""Waves in a bar that is held against twist at its ends: what sums of sines must give."""

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray

_PLACES = 400


def bar_receptance(
    lengths_m: FloatArray,
    wave_m_per_s: float,
    damping: tuple[float, float],
    omega: FloatArray,
) -> NDArray[np.complex128]:
    """Return the mean receptance (f,) of bars (b,) in m per unit flexibility, over their places.

    Green's function of the wave equation is sin kx sin k(L - x)/(k sin kL); with the Rayleigh
    damping (alpha, beta) k² = (omega² - i omega alpha)/(c² (1 + i omega beta)).
    """
    alpha, beta = damping
    loss = 1.0 + 1j * omega * beta
    k = np.sqrt((omega**2 - 1j * omega * alpha) / loss) / wave_m_per_s
    x = (np.arange(_PLACES)[:, None] + 0.5) / _PLACES
    total = np.zeros(omega.size, dtype=np.complex128)
    for length in lengths_m:
        wave = np.sin(k * x * length) * np.sin(k * (1.0 - x) * length) / (k * np.sin(k * length))
        total += length / lengths_m.sum() * wave.mean(axis=0) / loss
    return total
