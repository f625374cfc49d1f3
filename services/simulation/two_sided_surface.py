"""Isotropic random road surfaces, sampled under single tyres.

A surface is a sum of plane waves whose profile along any line has the density of ISO 8608, G_d(n_0)
(n/n_0)^-2. Its two-dimensional density is Phi(k) = G_d(n_0) n_0^2/2 k^-3, one-sided in n_x: the
integral of Phi over all n_y is the density of the profile at n_x. A tyre averages over its width
and contact length, which multiplies the wave (n_x, n_y) by sinc(width n_y) sinc(length n_x).

The waves are drawn one in each cell of a grid over (n_x, n_y), at a random place in the cell, with
a Gaussian complex amplitude. Nothing here is shared with `pre_core.physics.surface`, which the
truth of a validation must not depend on.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.kernels.lanes import compiled
from services.common.arrays import Floats

Complexes = NDArray[np.complex128]

_CLASSES: Final = "ABCDE"
_CLASS_A_M3: Final = 16e-6
"""Geometric mean of G_d at the reference frequency; four times as much in each next class."""
_REFERENCE_CYCLES_PER_M: Final = 0.1
_LONGEST_WAVE_M: Final = 100.0
_SHORTEST_WAVE_M: Final = 0.1
"""Shortest wave along the road; the contact patch averages out shorter ones."""
_ALONG_STEP_CYCLES_PER_M: Final = 0.004
"""Spacing of waves: two for each line that 120 m of road can resolve."""
_ACROSS: Final = 160
_WIDEST_CYCLES_PER_M: Final = 40.0
_ACROSS_SCALE_CYCLES_PER_M: Final = 0.02
"""Lateral spatial frequency below which cells are even, and above which they grow in proportion."""


class Waves(NamedTuple):
    """Plane waves of a surface."""

    n_x: Floats  # (along,) cycles/m
    n_y: Floats  # (along, across) cycles/m
    amplitude: Complexes  # (along, across) m


class Strip(NamedTuple):
    """Part of the surface that one tyre covers."""

    lateral_m: float
    """Distance of its middle to the left of the bridge's axis, seen from start to end."""
    width_m: float
    length_m: float


def draw_waves(road_class: str, seed: int) -> Waves:
    """Draw the surface of an ISO 8608 class (A to E, geometric mean) from a seed."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 0x2D]))
    edges_x = np.arange(1.0 / _LONGEST_WAVE_M, 1.0 / _SHORTEST_WAVE_M, _ALONG_STEP_CYCLES_PER_M)
    along = edges_x.size - 1
    n_x = edges_x[:-1] + _ALONG_STEP_CYCLES_PER_M * rng.uniform(size=along)
    longest = float(np.arcsinh(_WIDEST_CYCLES_PER_M / _ACROSS_SCALE_CYCLES_PER_M))
    places = np.linspace(-longest, longest, _ACROSS + 1)
    edges_y = _ACROSS_SCALE_CYCLES_PER_M * np.sinh(places)
    # The integral of k^-3 over n_y is n_y/(n_x^2 k).
    up_to = edges_y / np.hypot(n_x[:, None], edges_y)
    power = density_constant_m2(road_class) * np.diff(up_to, axis=1) / n_x[:, None] ** 2
    power *= _ALONG_STEP_CYCLES_PER_M
    # Uniform in the cell's share of the integral, so that the place has the density of Phi.
    share = up_to[:, :-1] + rng.uniform(size=power.shape) * np.diff(up_to, axis=1)
    n_y = n_x[:, None] * share / np.sqrt(1.0 - share**2)
    normal = rng.standard_normal((2, *power.shape))
    return Waves(n_x, n_y, np.sqrt(power) * (normal[0] + 1j * normal[1]))


def density_constant_m2(road_class: str) -> float:
    """Return Phi k^3, 8e-8 m² for class A; raise ValueError for an unknown class."""
    grade = _CLASSES.find(road_class) if road_class else -1
    if grade < 0:
        raise ValueError(f"{road_class} is no road class, it must be one of {', '.join(_CLASSES)}")
    return 0.5 * _CLASS_A_M3 * 4.0**grade * _REFERENCE_CYCLES_PER_M**2


def heights_m(waves: Waves, strip: Strip, start_m: float, spacing_m: float, count: int) -> Floats:
    """Return the mean heights (count,) of the surface under a tyre at equally spaced chainages."""
    return np.asarray(_heights(waves, strip, start_m, spacing_m, count))


@compiled()
def _sinc(x: float) -> float:
    angle = np.pi * x
    return 1.0 if abs(angle) < 1e-9 else np.sin(angle) / angle


@compiled()
def _heights(waves: Waves, strip: Strip, start: float, spacing: float, count: int) -> Floats:
    n_x, n_y, amplitude = waves.n_x, waves.n_y, waves.amplitude
    lateral, width, length = strip.lateral_m, strip.width_m, strip.length_m
    out = np.zeros(count)
    two_pi = 2.0 * np.pi
    for j in range(n_x.size):
        real, imaginary = 0.0, 0.0
        for m in range(n_y.shape[1]):
            across = n_y[j, m]
            weight = _sinc(width * across)
            angle = two_pi * across * lateral
            cosine, sine = weight * np.cos(angle), weight * np.sin(angle)
            a = amplitude[j, m]
            real += a.real * cosine - a.imag * sine
            imaginary += a.real * sine + a.imag * cosine
        patch = _sinc(length * n_x[j])
        angle = two_pi * n_x[j] * start
        cosine, sine = patch * np.cos(angle), patch * np.sin(angle)
        real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
        # A rotation from sample to sample; its rounding grows to 1e-12 over 10^4 samples.
        turn = two_pi * n_x[j] * spacing
        turn_cosine, turn_sine = np.cos(turn), np.sin(turn)
        for i in range(count):
            out[i] += real
            real, imaginary = (
                real * turn_cosine - imaginary * turn_sine,
                real * turn_sine + imaginary * turn_cosine,
            )
    return out
