"""Two axles that do not feel the same road: their difference as noise that the run itself tells.

What the front axle feels at a place less what the rear axle feels there, d(x), is a stationary
random process along the road with the one-sided spectrum

    S_d(n) = sum over j of A_j T_j(n),   A_j >= 0.

The shapes T_j are those of axles on an isotropic surface (`physics.surface`): tyres that average
over different strips, and an axle that runs beside the other. Both have a known limit at long
waves, where the bridge is seen and no run tells the level. The levels A_j are read off the rows
before and behind the bridge. At the speed v, d is noise in time with the spectrum S_d(f/v)/v.

The covariance of d is brought to an end by Bohman's window, which keeps it positive, so that the
rows' covariance is banded. Five metres keep the spectrum of unlike tyres to 2 % everywhere, and
that of an offset, which grows like the logarithm of the wave, to a quarter down to waves of 30 m.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.whittle import likeliest_levels
from pre_core.physics.road import REFERENCE_CYCLES_PER_M
from pre_core.physics.surface import Footprint, common_spectrum, spectra, surface_density

FloatArray = NDArray[np.float64]

MEMORY_M = 5.0
_OFFSET_M = 0.005
"""For the shape of an axle that runs beside the other; it is the same for all small offsets."""
_LARGE_OFFSET_M = 0.02
"""Mean of the prior of such an offset's square, as a root: axles are set to millimetres, and steer
to centimetres. Without it an offset of a hand's width passes for twin tyres."""
_WORN = 0.9
_GRID_CYCLES_PER_M = 0.02
_MOST_CYCLES_PER_M = 24.0
LONG_CYCLES_PER_M = 0.05
"""Waves by which bridges are seen, and by which a mismatch is told."""
_EVERY_LONG, _OTHERS = 30, 50
"""Of the grid's waves the common part is computed for so many, the longest, and for so many of the
others: it has no detail."""
_SURFACE_CYCLES_PER_M = (0.5, 4.0)
_ENOUGH = 1e-4
_NOTHING = 1e-12


class Shapes(NamedTuple):
    """Spectra (s, g) on an even grid (g,) of cycles/m from zero on, one at 0.1 cycles/m.

    So a level A_j is its shape's spectrum there.
    """

    cycles_per_m: FloatArray
    density: FloatArray
    """The spectrum of d, windowed."""
    leaning: FloatArray
    """Cross spectrum of what the front axle feels with d: (s, g). The rear's is that less d's."""
    footprints: tuple[Footprint, Footprint]
    road: FloatArray
    """What the front axle feels of a surface of Phi k^3 = 1 m²: (g,), windowed."""
    road_spread: FloatArray
    """(g,) how many times the road itself that is: the window spreads its longest waves, which
    are by far the highest, over all others."""
    expected_m: FloatArray
    """(s,) m³ that a level is over Phi k^3: of tyres unlike each other as they are, of an offset of
    `_LARGE_OFFSET_M`."""


class Mismatch(NamedTuple):
    """The noise of one run; without mismatch all levels are zero."""

    shapes: Shapes
    level_m3: FloatArray  # (s,)
    speed_m_per_s: float


@lru_cache(maxsize=8)
def shapes_of(front: Footprint, rear: Footprint) -> Shapes:
    """Return what tyres unlike each other leave, and one axle beside the other."""
    grid = _above_zero()
    density, leaning, expected = [], [], []
    for (one, other), larger in zip(
        _pairs(front, rear), (1.0, _LARGE_OFFSET_M / _OFFSET_M), strict=True
    ):
        of_front, _, common, difference = spectra(one, other, grid)
        at = np.interp(REFERENCE_CYCLES_PER_M, grid, difference)
        density.append(_windowed(difference / at))
        leaning.append((of_front - common) / at)
        expected.append(at * larger**2)
    road = _windowed(of_front)
    spread = road / of_front
    grid[0] = 0.0
    return Shapes(
        grid,
        np.stack(density),
        np.stack(leaning),
        (front, rear),
        road,
        spread,
        np.array(expected),
    )


@lru_cache(maxsize=64)
def common_shapes(front: Footprint, rear: Footprint, wander_m: float) -> FloatArray:
    """The part (s, g) of the densities of `shapes_of` that runs on tracks so wide have in common.

    Long waves across the road are the same on all tracks, short ones are not: how much is common
    depends on the wave, and what it is at long ones no run tells.
    """
    at, grid = np.array([REFERENCE_CYCLES_PER_M]), _above_zero()
    some = np.concatenate([grid[:_EVERY_LONG], np.geomspace(grid[_EVERY_LONG], grid[-1], _OTHERS)])
    return np.stack(
        [
            _windowed(
                np.interp(grid, some, common_spectrum(one, other, some, wander_m))
                / spectra(one, other, at)[3][0]
            )
            for one, other in _pairs(front, rear)
        ]
    )


def levels_on(front: Footprint, rear: Footprint, road_class: str) -> FloatArray:
    """Levels (s,) in m³ that a surface of an ISO 8608 class has under these axles.

    Tyres that are alike differ by nothing: `shapes_of` takes them for worn ones only because no run
    can tell that they are not.
    """
    at = np.array([REFERENCE_CYCLES_PER_M])
    single, unlike = front._replace(offset_m=0.0), rear._replace(offset_m=0.0)
    beside = single._replace(offset_m=rear.offset_m - front.offset_m)
    density = surface_density(road_class)
    return density * np.array([spectra(single, other, at)[3][0] for other in (unlike, beside)])


def _above_zero() -> FloatArray:
    """The grid, but for its zero, where the spectrum of an offset has no limit."""
    points = round(_MOST_CYCLES_PER_M / _GRID_CYCLES_PER_M) + 1
    grid = _GRID_CYCLES_PER_M * np.arange(points, dtype=np.float64)
    grid[0] = 0.02 * _GRID_CYCLES_PER_M
    return grid


def _pairs(front: Footprint, rear: Footprint) -> tuple[tuple[Footprint, Footprint], ...]:
    """Two axles for each shape: with tyres unlike each other, and one beside the other.

    Tyres that are just alike are taken for worn ones: nobody has measured any.
    """
    single, unlike = front._replace(offset_m=0.0), rear._replace(offset_m=0.0)
    if unlike == single:
        unlike = single._replace(width_m=_WORN * single.width_m)
    return (single, unlike), (single, single._replace(offset_m=_OFFSET_M))


def _windowed(spectrum: FloatArray) -> FloatArray:
    """A spectrum (g,) on the grid when its covariance ends at `MEMORY_M`."""
    both = np.concatenate([spectrum, spectrum[-2:0:-1]])
    apart = 1.0 / (both.size * _GRID_CYCLES_PER_M)
    covariance = np.fft.irfft(spectrum, both.size)
    lag = apart * np.minimum(np.arange(both.size), both.size - np.arange(both.size))
    return np.asarray(np.fft.rfft(covariance * _bohman(lag / MEMORY_M)).real)


def _bohman(share: FloatArray) -> FloatArray:
    inside = np.minimum(np.abs(share), 1.0)
    return (1.0 - inside) * np.cos(np.pi * inside) + np.sin(np.pi * inside) / np.pi


def density_at(mismatch: Mismatch, omega: FloatArray, table: FloatArray) -> FloatArray:
    """Rows of a table (s, g) of shapes, as spectra in time: (s, f), per m³ of level, m²/Hz."""
    n = omega / (2.0 * np.pi * mismatch.speed_m_per_s)
    grid = mismatch.shapes.cycles_per_m
    read = [np.interp(n, grid, row, right=0.0) for row in table]
    return np.stack(read) / mismatch.speed_m_per_s


def spectrum(mismatch: Mismatch, omega: FloatArray) -> FloatArray:
    """One-sided spectrum (f,) of d in time at angular frequencies (f,), in m²/Hz."""
    return mismatch.level_m3 @ density_at(mismatch, omega, mismatch.shapes.density)


def leaning(mismatch: Mismatch, omega: FloatArray) -> FloatArray:
    """Cross spectrum (f,) in time of what the front axle feels with d, in m²/Hz."""
    return mismatch.level_m3 @ density_at(mismatch, omega, mismatch.shapes.leaning)


def as_two_numbers(mismatch: Mismatch) -> tuple[float, float]:
    """A (m³) and n_0 (cycles/m) of A/(1 + (n/n_0)²)² that is like the spectrum of d.

    A is the spectrum at waves of 20 m, n_0 where it has fallen to a quarter of that.
    """
    density = mismatch.level_m3 @ mismatch.shapes.density
    grid = mismatch.shapes.cycles_per_m
    long_waves = float(np.interp(LONG_CYCLES_PER_M, grid, density))
    below = np.flatnonzero((density < 0.25 * long_waves) & (grid > LONG_CYCLES_PER_M))
    return long_waves, float(grid[below[0]] if below.size else grid[-1])


def memory_s(mismatch: Mismatch) -> float:
    """How long d remembers."""
    return MEMORY_M / mismatch.speed_m_per_s


class Segment(NamedTuple):
    """What a periodogram shows of a stretch of rows and would show of each source: (f,), (s, f)."""

    seen: FloatArray
    sensors: FloatArray
    shapes: FloatArray


def segment(values: FloatArray, sensors: FloatArray, shapes: FloatArray) -> Segment:
    """The tapered periodogram of values (m,), and its exact expectation for covariances.

    `sensors` (lags,) is the autocovariance that the sensors' noise gives the values, `shapes`
    (s, lags) that of each shape (the debiased periodogram of Sykulski et al. 2019).
    """
    m = values.size
    taper = np.hanning(m + 2)[1:-1]
    taper /= np.sqrt(taper @ taper)
    seen = np.abs(np.fft.rfft(taper * values)[1:]) ** 2
    size = 2 * m
    # Lag by lag, how much of the taper overlaps itself.
    overlap = np.fft.irfft(np.abs(np.fft.rfft(taper, size)) ** 2, size)[:m]

    def expected(covariance: FloatArray) -> FloatArray:
        lags = min(m, covariance.size)
        weighted = np.zeros(m)
        weighted[:lags] = covariance[:lags] * overlap[:lags]
        weighted[0] *= 0.5
        power = np.asarray(2.0 * np.fft.fft(weighted).real[1 : m // 2 + 1])
        # Rounding alone makes what nothing is negative.
        return np.maximum(power, _NOTHING * power.max())

    return Segment(seen, expected(sensors), np.stack([expected(row) for row in shapes]))


def surface_level(shapes: Shapes, roads: list[Segment], lengths_m: list[float]) -> float:
    """Phi k^3 in m² of the surface, by periodograms of what an axle felt on stretches of it.

    By the median, over waves of a quarter of a metre to two: what is longer is what the window of
    `road` has spread. Zero if no stretch has such waves.
    """
    found = []
    for one, length in zip(roads, lengths_m, strict=True):
        n = np.arange(1, one.seen.size + 1) / length
        inside = (n > _SURFACE_CYCLES_PER_M[0]) & (n < _SURFACE_CYCLES_PER_M[1])
        spread = np.interp(n[inside], shapes.cycles_per_m, shapes.road_spread)
        found.append(one.seen[inside] / one.shapes[0, inside] * spread)
    ratio = np.concatenate(found)
    # The median of an exponential is ln 2 of its mean.
    return float(np.median(ratio) / np.log(2.0)) if ratio.size else 0.0


def levels(segments: list[Segment], usual: FloatArray | None = None) -> tuple[FloatArray, float]:
    """Most likely levels (s,) in m³ (Whittle's likelihood), and the gain over none of them.

    `usual` (s,) are the means of their exponential priors, infinite where there is none; the gain
    is that of `likeliest_levels`.
    """
    seen = np.concatenate([one.seen for one in segments])
    known = np.concatenate([one.sensors for one in segments])
    shape = np.concatenate([one.shapes for one in segments], axis=1)
    start = np.full(shape.shape[0], np.mean(seen) / np.mean(shape.sum(axis=0)))
    claimed = 0.0 if usual is None else 2.0 / usual
    return likeliest_levels(seen, known, shape, start, claimed, _ENOUGH)
