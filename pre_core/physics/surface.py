"""Road surfaces: an axle's profile on a surface, and the difference between two axles' profiles.

A tyre averages the road over its width and contact length, an axle over its two wheels, a wheel
with twin tyres over two strips. On an isotropic random surface with the one-sided spectrum Phi(k),
k the spatial frequency in cycles/m in any direction, an axle multiplies the wave (n_x, n_y) by

    H = sinc(width n_y) sinc(length n_x) cos(pi track n_y) cos(pi twins n_y) exp(2 pi i offset n_y)

with sinc x = sin(pi x)/(pi x), and the profiles of axles i and j have the cross spectrum S_ij(n) =
integral of Phi(k) H_i conj(H_j) over n_y, k^2 = n^2 + n_y^2. The surface is the one whose profile
along every line has the density of ISO 8608, G_d(n_0) (n/n_0)^-2: Phi = G_d n_0^2/2 k^-3.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import ComplexArray, FloatArray
from pre_core.physics.road import GEOMETRIC_MEAN_M3, REFERENCE_CYCLES_PER_M, Profile

_WIDEST_CYCLES_PER_M = 40.0
"""Largest lateral frequency in cycles/m; tyres average shorter waves out."""
_AT_ONCE = 32  # longitudinal waves whose amplitudes are drawn at once
_ACROSS, _FINE = 400, 4000
"""Number of lateral waves: of a drawn surface, and of the integral to one side."""
_SHORTEST_WAVE_M, _LONGEST_WAVE_M = 0.05, 100.0
_SCALE = 0.02
"""Lateral frequency in cycles/m above which waves are spaced proportionally."""
_STEP = float(np.arcsinh(_WIDEST_CYCLES_PER_M / _SCALE)) / _FINE


class Footprint(NamedTuple):
    """Position and size of an axle's contact patches, in m."""

    width_m: float = 0.25
    """Width of a tyre's tread."""
    twin_distance_m: float = 0.0
    """Distance between the centres of twin tyres; 0 for single tyres."""
    length_m: float = 0.2
    """Length of the contact patch."""
    track_m: float = 1.9
    """Distance between the centres of the left and right wheels."""
    offset_m: float = 0.0
    """Distance of the axle to the left of the truck's path."""


TYPICAL_FOOTPRINTS = (Footprint(), Footprint(width_m=0.22, twin_distance_m=0.33))
"""Front and rear axle of a typical lorry: single tyres, and twin tyres behind."""


def response(axle: Footprint, n_x: FloatArray, n_y: FloatArray) -> ComplexArray:
    """Return H (see the module) for waves of n_x along and n_y across the road, (…) in cycles/m."""
    return np.asarray(np.sinc(axle.length_m * n_x) * _strips(axle, n_y))


def _strips(axle: Footprint, n_y: FloatArray) -> ComplexArray:
    """Return the lateral factor of H."""
    strips = np.cos(np.pi * axle.track_m * n_y) * np.cos(np.pi * axle.twin_distance_m * n_y)
    width = np.sinc(axle.width_m * n_y)
    return np.asarray(width * strips * np.exp(2j * np.pi * axle.offset_m * n_y))


def surface_density(road_class: str) -> float:
    """Return Phi k^3 in m² (Phi in m^4): 8e-8 for class A."""
    return 0.5 * GEOMETRIC_MEAN_M3[road_class] * REFERENCE_CYCLES_PER_M**2


def spectra(front: Footprint, rear: Footprint, n: FloatArray) -> tuple[FloatArray, ...]:
    """Return one-sided spectra (f,) in m³ at n > 0 cycles/m on a surface with Phi k^3 = 1 m².

    These are the spectra of the front axle and of the rear axle, the real part of their cross
    spectrum, and the spectrum of the difference front minus rear.
    """
    at_front, at_rear, n_y = _patches_and_waves(front, rear, n)
    of_front, of_rear = _strips(front, n_y), _strips(rear, n_y)
    apart = of_front - of_rear
    powers = (
        np.abs(of_front) ** 2,
        np.abs(of_rear) ** 2,
        (of_front * of_rear.conj()).real,
        np.abs(apart) ** 2,
        (apart * of_rear.conj()).real,
    )
    front_front, rear_rear, front_rear, apart_apart, apart_rear = _integrals(n, n_y, powers)
    return (
        at_front**2 * front_front,
        at_rear**2 * rear_rear,
        at_front * at_rear * front_rear,
        _difference(at_front, at_rear, apart_apart, apart_rear, rear_rear),
    )


def between_run_cross_spectrum(
    front: Footprint, rear: Footprint, n: FloatArray, wander_m: float
) -> FloatArray:
    """Return the one-sided cross spectrum (f,) between two runs of the difference in `spectra`.

    The lateral positions of the runs are normal with the standard deviation `wander_m`, so the
    distance between two paths has sqrt(2) times that. This multiplies lateral waves by exp(-(2 pi
    n_y wander)²).
    """
    at_front, at_rear, n_y = _patches_and_waves(front, rear, n)
    both = np.exp(-((2.0 * np.pi * n_y * wander_m) ** 2))
    of_rear = _strips(rear, n_y)
    apart = _strips(front, n_y) - of_rear
    powers = (np.abs(apart) ** 2, (apart * of_rear.conj()).real, np.abs(of_rear) ** 2)
    return _difference(at_front, at_rear, *_integrals(n, n_y, tuple(both * one for one in powers)))


def _patches_and_waves(
    front: Footprint, rear: Footprint, n: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the contact length factors of both axles for waves (f,), and lateral waves (q,)."""
    patches = (np.asarray(np.sinc(axle.length_m * np.asarray(n))) for axle in (front, rear))
    return *patches, _SCALE * np.sinh(_STEP * np.arange(_FINE + 1))


def _difference(
    at_front: FloatArray,
    at_rear: FloatArray,
    apart_apart: FloatArray,
    apart_rear: FloatArray,
    rear_rear: FloatArray,
) -> FloatArray:
    """Return the integral of |a F - b R|² from those of |D|², Re(D conj R) and |R|², D = F - R.

    The form a² |F|² - 2 a b Re(F conj R) + b² |R|² loses digits by cancellation: for long waves its
    terms differ by a millionth.
    """
    more = at_front - at_rear
    return at_front**2 * apart_apart + 2.0 * at_front * more * apart_rear + more**2 * rear_rear


def _integrals(
    n: FloatArray, n_y: FloatArray, powers: tuple[FloatArray, ...]
) -> tuple[FloatArray, ...]:
    """Return the integrals (f,) over all n_y of k^-3 times each of `powers` (q,), even in n_y >= 0.

    The sum has even steps in asinh(n_y/scale), because the integrands decay like a power of n_y.
    Longitudinal waves are processed one at a time: together they would take a hundred megabytes.
    """
    weight = 2.0 * _STEP * np.hypot(_SCALE, n_y)
    weight[0] *= 0.5
    weighted = np.stack([weight * one for one in powers], axis=1)
    squares = n_y**2
    out = np.empty((np.asarray(n).size, len(powers)))
    for row, one in enumerate(np.asarray(n).ravel()):
        square = squares + one**2
        out[row] = (1.0 / (square * np.sqrt(square))) @ weighted
    return tuple(out.T)


class Surface(NamedTuple):
    """A patch of random road as waves: `amplitude` (along, across), complex, in m."""

    start_m: float
    spacing_m: float
    samples: int
    n_x: FloatArray  # (along,) cycles/m
    n_y: FloatArray  # (across,)
    amplitude: ComplexArray


def random_surface(
    start_m: float, stop_m: float, spacing_m: float, road_class: str, seed: int
) -> Surface:
    """Return an isotropic Gaussian surface with the geometric mean density of an ISO 8608 class.

    Longitudinal waves are evenly spaced, their period longer than the patch, so
    that it does not repeat; lateral waves are denser where they are long. Waves are between 0.05 m
    and 100 m long.
    """
    rng = np.random.default_rng(seed)
    count = round((stop_m - start_m) / spacing_m) + 1
    period_m = max(4.0 * (count - 1) * spacing_m, _LONGEST_WAVE_M)
    step = 1.0 / period_m
    n_x = np.arange(1.0 / _LONGEST_WAVE_M, min(1.0 / _SHORTEST_WAVE_M, 0.5 / spacing_m), step)
    longest = np.arcsinh(_WIDEST_CYCLES_PER_M / _SCALE)
    edges = _SCALE * np.sinh(np.linspace(-longest, longest, _ACROSS + 1))
    n_y = 0.5 * (edges[1:] + edges[:-1])
    density = surface_density(road_class) * step
    # For half a kilometre these are a hundred megabytes: a few waves at a time stay in the cache.
    amplitude = np.empty((n_x.size, n_y.size), dtype=np.complex128)
    for begin in range(0, n_x.size, _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        along = n_x[some, None]
        # Exact integral of the density over each strip of n_y: that of k^-3 is n_y/(n_x^2 k).
        power = np.diff(edges / np.hypot(along, edges), axis=1)
        power *= density / along**2
        rng.standard_normal(out=amplitude[some].view(np.float64))
        amplitude[some] *= np.sqrt(power, out=power)
    return Surface(start_m, spacing_m, count, n_x, n_y, amplitude)


def axle_profile(surface: Surface, axle: Footprint, lateral_m: float = 0.0) -> Profile:
    """Return the profile of an axle of a truck that drives `lateral_m` to the left of y = 0."""
    moved = axle._replace(offset_m=axle.offset_m + lateral_m)
    across = response(moved, np.zeros(1), surface.n_y)
    wave = np.sinc(axle.length_m * surface.n_x) * (surface.amplitude @ across)
    x = surface.start_m + surface.spacing_m * np.arange(surface.samples, dtype=np.float64)
    step = surface.n_x[1] - surface.n_x[0]
    period = round(1.0 / (step * surface.spacing_m))
    phase = np.exp(2j * np.pi * surface.n_x * surface.start_m)
    # ifft sums exp(+2 pi i n x) over harmonics of the period; the first is not zero.
    waves = period * np.fft.ifft(wave * phase, period)[: surface.samples]
    lowest = surface.n_x[0]
    height = np.real(waves * np.exp(2j * np.pi * lowest * (x - surface.start_m)))
    return Profile(x, height)
