"""Profile mismatch of the two axles as noise whose level the run itself determines.

The profile of the front axle at a place minus that of the rear axle there, d(x), is a stationary
random process along the road with the one-sided spectrum

    S_d(n) = sum over j of A_j T_j(n),   A_j >= 0.

The shapes T_j are those of axles on an isotropic surface (`physics.surface`): tyres that average
over different strips, and an axle with a lateral offset. Both have a known limit at long waves,
which affect the bridge but cannot be measured in one run. The levels A_j follow from the residuals
before and after the bridge. At the speed v, d is noise in time with the spectrum S_d(f/v)/v.

The axles of a tandem differ so little that their roll matters: a sensor at the distance e from the
middle of its axle reads e times the roll angle as well. The left and the right profile excite this
roll, and tyres hardly damp it, so the spectrum of an offset rises around the roll resonance. Bands
there have levels of their own (`with_axle_roll`); otherwise the offset would be overestimated.

The Bohman window truncates the covariance of d and keeps it positive; the residuals' covariance is
then banded. Its half length of 5 m changes the spectrum of unequal tyres by at most 2 %, and that
of an offset, which grows like the logarithm of the wavelength, by at most a quarter up to
wavelengths of 30 m.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.whittle import maximum_likelihood_levels
from pre_core.physics.road import REFERENCE_CYCLES_PER_M
from pre_core.physics.surface import Footprint, between_run_cross_spectrum, spectra, surface_density

CORRELATION_LENGTH_M = 5.0
_OFFSET_M = 0.005
"""Offset for the shape of a laterally shifted axle, which is the same for all small offsets."""
_LARGE_OFFSET_M = 0.02
"""Root mean square of the offset's prior: axles are aligned to millimetres, and steer to
centimetres. Without it an offset of a hand's width would pass for twin tyres."""
_WORN = 0.9
"""Width of a worn tyre relative to an equal one."""
_GRID_CYCLES_PER_M = 0.02
TRACK_SHAPES = 2
"""Number of spectra that belong to the axles' tracks: of unequal tyres, and of an offset."""
_CLEAR_ROLL = 10.0
"""Rise of the statistic of levels above which axles roll. Of 30 roads without roll it was 3.8 in
the mean, above 10 in one; of 30 with a damping ratio of 0.05, 22 in the mean."""
_ROLL_STEP = 0.125
_ROLL_BANDS = np.exp(_ROLL_STEP * np.arange(0, 7))
"""Centres of the bands of the axles' roll relative to the frequency of an axle on its tyres. The
roll inertia of an axle is 0.3 to 0.9 of its mass times half the track squared."""
_MAX_CYCLES_PER_M = 24.0
LONG_CYCLES_PER_M = 0.05
"""Spatial frequency relevant for bridges, at which a mismatch is reported."""
_EVERY_LONG, _OTHERS = 30, 50
"""Number of longest grid waves, and of others, for which the shared part is computed; it is smooth.
"""
_SURFACE_CYCLES_PER_M = (0.5, 4.0)
"""Band from which the level of the surface is estimated."""
_TILTED_CYCLES_PER_M, _PIVOT_CYCLES_PER_M = (0.05, 4.0), 1.0
"""Limits of n in L(n), and n_p, see `crossing.pavement`."""
_ENOUGH = 1e-4
_NOTHING = 1e-12


class MismatchSpectra(NamedTuple):
    """Spectra (s, g) on an even grid (g,) of cycles/m from zero, normalised at 0.1 cycles/m.

    There each is one, so a level A_j is the spectrum of its shape at 0.1 cycles/m.
    """

    cycles_per_m: FloatArray
    density: FloatArray
    """The spectrum of d, windowed."""
    front_cross_spectrum_density: FloatArray
    """Cross spectrum (s, g) of the front axle's profile with d, not windowed."""
    rear_cross_spectrum_density: FloatArray
    """Cross spectrum (s, g) of the rear axle's profile with d: that of the front axle minus the
    spectrum of d before windowing. Windowing would fill the zero at the contact length."""
    footprints: tuple[Footprint, Footprint]
    road: FloatArray
    """Windowed profile spectrum (g,) of the front axle on a surface of Phi k^3 = 1 m²."""
    road_spread: FloatArray
    """Ratio (g,) of `road` to the unwindowed spectrum: the window spreads the longest waves, by far
    the highest."""
    expected_m: FloatArray
    """Expected levels (s,) in m³ over Phi k^3 in m², for the given tyres and for an offset of
    `_LARGE_OFFSET_M`."""


class BridgePavement(NamedTuple):
    """The mismatch on the bridge relative to that off it, see `crossing.pavement`."""

    ratio_and_tilt: FloatArray
    """Estimates (2,) of r and t."""
    covariance: FloatArray
    """Posterior covariance (2, 2) of r and t."""
    share: FloatArray
    """Share (m,) of each filtered residual's mismatch that is the bridge's, 0 to 1."""


class Mismatch(NamedTuple):
    """The mismatch noise of one run; without mismatch all levels are zero."""

    shapes: MismatchSpectra
    level_m3: FloatArray  # (s,)
    speed_m_per_s: float
    pavement: BridgePavement | None = None
    """Mismatch on the bridge relative to that off it; None where both are alike."""


@lru_cache(maxsize=8)
def mismatch_spectra(front: Footprint, rear: Footprint) -> MismatchSpectra:
    """Return the spectra of unequal tyres, and of a laterally shifted axle."""
    grid = _above_zero()
    density, of_front_with_d, of_rear_with_d, expected = [], [], [], []
    for (one, other), larger in zip(
        _pairs(front, rear), (1.0, _LARGE_OFFSET_M / _OFFSET_M), strict=True
    ):
        of_front, _, common, difference = spectra(one, other, grid)
        at = np.interp(REFERENCE_CYCLES_PER_M, grid, difference)
        density.append(_windowed(difference / at))
        of_front_with_d.append((of_front - common) / at)
        of_rear_with_d.append((of_front - common - difference) / at)
        expected.append(at * larger**2)
    road = _windowed(of_front)
    spread = road / of_front
    grid[0] = 0.0
    return MismatchSpectra(
        grid,
        np.stack(density),
        np.stack(of_front_with_d),
        np.stack(of_rear_with_d),
        (front, rear),
        road,
        spread,
        np.array(expected),
    )


@lru_cache(maxsize=64)
def between_run_spectra(front: Footprint, rear: Footprint, wander_m: float) -> FloatArray:
    """Return the part (s, g) of `mismatch_spectra` densities that runs with this wander share.

    Lateral long waves are the same on all paths, short ones are not: the shared fraction depends on
    the wave, and no run determines it at long ones.
    """
    at, grid = np.array([REFERENCE_CYCLES_PER_M]), _above_zero()
    some = np.concatenate([grid[:_EVERY_LONG], np.geomspace(grid[_EVERY_LONG], grid[-1], _OTHERS)])
    return np.stack(
        [
            _windowed(
                np.interp(grid, some, between_run_cross_spectrum(one, other, some, wander_m))
                / spectra(one, other, at)[3][0]
            )
            for one, other in _pairs(front, rear)
        ]
    )


def with_axle_roll(shapes: MismatchSpectra, hop_hz: float, speed_m_per_s: float) -> MismatchSpectra:
    """Return the spectra with one more for each band in which the axles may roll at a speed.

    A sensor off the middle of its axle reads a part of the roll, by which an offset's spectrum
    rises at the axle's roll resonance, `_ROLL_BANDS` relative to the frequency `hop_hz` of its mass
    on its tyres. A band is a hat function of the logarithm of the frequency.
    """
    n = shapes.cycles_per_m
    at = np.log(np.maximum(n, n[1]) * speed_m_per_s / hop_hz)
    hats = np.maximum(0.0, 1.0 - np.abs(at - np.log(_ROLL_BANDS)[:, None]) / _ROLL_STEP)
    front = hats * shapes.front_cross_spectrum_density[1]
    rear = hats * shapes.rear_cross_spectrum_density[1]
    return shapes._replace(
        density=np.vstack([shapes.density, [_windowed(one) for one in front - rear]]),
        front_cross_spectrum_density=np.vstack([shapes.front_cross_spectrum_density, front]),
        rear_cross_spectrum_density=np.vstack([shapes.rear_cross_spectrum_density, rear]),
        expected_m=np.append(shapes.expected_m, np.zeros(len(hats))),
    )


def expected_levels(front: Footprint, rear: Footprint, road_class: str) -> FloatArray:
    """Return the levels (s,) in m³ on a surface of an ISO 8608 class under these axles.

    Equal tyres have the level zero here; `mismatch_spectra` treats them as worn, because no run can
    exclude wear.
    """
    at = np.array([REFERENCE_CYCLES_PER_M])
    single, unlike = front._replace(offset_m=0.0), rear._replace(offset_m=0.0)
    beside = single._replace(offset_m=rear.offset_m - front.offset_m)
    density = surface_density(road_class)
    return density * np.array([spectra(single, other, at)[3][0] for other in (unlike, beside)])


def has_equal_tyres(front: Footprint, rear: Footprint) -> bool:
    """Return whether the axles differ by a lateral offset at most."""
    return front._replace(offset_m=0.0) == rear._replace(offset_m=0.0)


def _above_zero() -> FloatArray:
    """Return the grid without its zero, where the spectrum of an offset has no limit."""
    points = round(_MAX_CYCLES_PER_M / _GRID_CYCLES_PER_M) + 1
    grid = _GRID_CYCLES_PER_M * np.arange(points, dtype=np.float64)
    grid[0] = 0.02 * _GRID_CYCLES_PER_M
    return grid


def _pairs(front: Footprint, rear: Footprint) -> tuple[tuple[Footprint, Footprint], ...]:
    """Return two axles for each shape: with unequal tyres, and with a lateral offset.

    Equal tyres are replaced by worn ones, because real ones are never exactly equal.
    """
    single, unlike = front._replace(offset_m=0.0), rear._replace(offset_m=0.0)
    if has_equal_tyres(front, rear):
        unlike = single._replace(width_m=_WORN * single.width_m)
    return (single, unlike), (single, single._replace(offset_m=_OFFSET_M))


def _windowed(spectrum: FloatArray) -> FloatArray:
    """Return a spectrum (g,) on the grid whose covariance ends at `CORRELATION_LENGTH_M`."""
    both = np.concatenate([spectrum, spectrum[-2:0:-1]])
    apart = 1.0 / (both.size * _GRID_CYCLES_PER_M)
    covariance = np.fft.irfft(spectrum, both.size)
    lag = apart * np.minimum(np.arange(both.size), both.size - np.arange(both.size))
    return np.asarray(np.fft.rfft(covariance * _bohman(lag / CORRELATION_LENGTH_M)).real)


def _bohman(share: FloatArray) -> FloatArray:
    """Return the Bohman window at a share (…) of its length."""
    inside = np.minimum(np.abs(share), 1.0)
    return (1.0 - inside) * np.cos(np.pi * inside) + np.sin(np.pi * inside) / np.pi


def density_at(mismatch: Mismatch, omega: FloatArray, table: FloatArray) -> FloatArray:
    """Return spectra (s, f) in time, in m²/Hz per m³ of level, of a spatial table (s, g)."""
    n = omega / (2.0 * np.pi * mismatch.speed_m_per_s)
    grid = mismatch.shapes.cycles_per_m
    read = [np.interp(n, grid, row, right=0.0) for row in table]
    return np.stack(read) / mismatch.speed_m_per_s


def unwindowed(shapes: MismatchSpectra) -> FloatArray:
    """Return the spectra (s, g) of d before windowing.

    Only a covariance that whitens needs the window; elsewhere it would fill the zero of a spectrum
    at the contact length, which makes levels 5 % too low.
    """
    return shapes.front_cross_spectrum_density - shapes.rear_cross_spectrum_density


def spectrum(mismatch: Mismatch, omega: FloatArray) -> FloatArray:
    """Return the one-sided spectrum (f,) of d in time at angular frequencies (f,), in m²/Hz."""
    return mismatch.level_m3 @ density_at(mismatch, omega, mismatch.shapes.density)


def cross_spectra(mismatch: Mismatch, omega: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return cross spectra (f,) in time of the front and the rear profile with d, in m²/Hz."""
    shapes, level = mismatch.shapes, mismatch.level_m3
    return (
        level @ density_at(mismatch, omega, shapes.front_cross_spectrum_density),
        level @ density_at(mismatch, omega, shapes.rear_cross_spectrum_density),
    )


def tilt_of(cycles_per_m: FloatArray) -> FloatArray:
    """Return ln(n/n_p), n limited to the tilted band, at spatial frequencies n (…)."""
    low, high = _TILTED_CYCLES_PER_M
    return np.asarray(np.log(np.clip(cycles_per_m, low, high) / _PIVOT_CYCLES_PER_M))


def has_alike_tyres(mismatch: Mismatch) -> bool:
    """Return whether the compared axles both have single tyres, or both twin ones."""
    front, rear = mismatch.shapes.footprints
    return (front.twin_distance_m > 0.0) == (rear.twin_distance_m > 0.0)


def long_wave_power(mismatch: Mismatch) -> float:
    """Return the ratio of expected power on the bridge to that off it, at `LONG_CYCLES_PER_M`."""
    if mismatch.pavement is None:
        return 1.0
    return float(_power_ratio(mismatch.pavement, np.array([LONG_CYCLES_PER_M]))[0])


def _power_ratio(pavement: BridgePavement, cycles_per_m: FloatArray) -> FloatArray:
    """Return the ratio (g,) of expected power on the bridge to that off it, at frequencies (g,)."""
    tilt = tilt_of(cycles_per_m)
    columns = np.stack([np.ones_like(tilt), tilt], axis=1)
    variance = np.einsum("gi,ij,gj->g", columns, pavement.covariance, columns)
    return np.asarray(np.exp(2.0 * (columns @ pavement.ratio_and_tilt + variance)))


def on_bridge(mismatch: Mismatch) -> Mismatch:
    """Return the mismatch expected on the bridge, as one shape of level 1.

    Without a `pavement` it is the given one, with all its shapes.
    """
    if mismatch.pavement is None:
        return mismatch
    shapes = mismatch.shapes
    factor = _power_ratio(mismatch.pavement, shapes.cycles_per_m)
    level = mismatch.level_m3
    changed = shapes._replace(
        density=_windowed(factor * (level @ unwindowed(shapes)))[None, :],
        front_cross_spectrum_density=factor * (level @ shapes.front_cross_spectrum_density)[None],
        rear_cross_spectrum_density=factor * (level @ shapes.rear_cross_spectrum_density)[None],
    )
    return Mismatch(changed, np.ones(1), mismatch.speed_m_per_s)


def pavement_ratio(mismatch: Mismatch) -> float:
    """Return the ratio of estimated amplitude on the bridge to that off it, in waves of a metre."""
    return 1.0 if mismatch.pavement is None else float(np.exp(mismatch.pavement.ratio_and_tilt[0]))


def two_parameter_spectrum(mismatch: Mismatch) -> tuple[float, float]:
    """Return A (m³) and n_0 (cycles/m) of A/(1 + (n/n_0)²)² similar to the spectrum of d.

    A is the spectrum at waves of 20 m; n_0 is the frequency at which it has fallen to a quarter.
    """
    density = mismatch.level_m3 @ mismatch.shapes.density
    grid = mismatch.shapes.cycles_per_m
    long_waves = float(np.interp(LONG_CYCLES_PER_M, grid, density))
    below = np.flatnonzero((density < 0.25 * long_waves) & (grid > LONG_CYCLES_PER_M))
    return long_waves, float(grid[below[0]] if below.size else grid[-1])


def correlation_time_s(mismatch: Mismatch) -> float:
    """Return the time after which d is uncorrelated."""
    return CORRELATION_LENGTH_M / mismatch.speed_m_per_s


class PeriodogramSegment(NamedTuple):
    """Periodogram of a segment of residuals, and its expectation by source."""

    observed: FloatArray  # (f,): periodogram
    sensors: FloatArray  # (f,): expectation from sensor noise
    shapes: FloatArray  # (s, f): expectation from each shape of unit level


def hann_taper(count: int) -> FloatArray:
    """Return a Hann taper (count,) of unit energy without zeros."""
    taper = np.hanning(count + 2)[1:-1]
    return np.asarray(taper / np.sqrt(taper @ taper))


def tapered_periodogram(
    values: FloatArray, sensors: FloatArray, shapes: FloatArray
) -> PeriodogramSegment:
    """Return the tapered periodogram of values (m,), and its exact expectation for covariances.

    `sensors` (lags,) is the autocovariance of the values from sensor noise, `shapes` (s, lags) that
    of each shape (the debiased periodogram of Sykulski et al. 2019).
    """
    m = values.size
    taper = hann_taper(m)
    observed = np.abs(np.fft.rfft(taper * values)[1:]) ** 2
    size = 2 * m
    # Overlap of the taper with itself, lag by lag.
    overlap = np.fft.irfft(np.abs(np.fft.rfft(taper, size)) ** 2, size)[:m]

    def expected(covariance: FloatArray) -> FloatArray:
        lags = min(m, covariance.size)
        weighted = np.zeros(m)
        weighted[:lags] = covariance[:lags] * overlap[:lags]
        weighted[0] *= 0.5
        power = np.asarray(2.0 * np.fft.fft(weighted).real[1 : m // 2 + 1])
        # Only rounding makes a zero negative.
        return np.maximum(power, _NOTHING * power.max())

    return PeriodogramSegment(
        observed, expected(sensors), np.stack([expected(row) for row in shapes])
    )


def surface_level(
    shapes: MismatchSpectra, roads: list[PeriodogramSegment], lengths_m: list[float]
) -> float:
    """Return Phi k^3 in m² of the surface, from periodograms of an axle's profile on it.

    It is the median over waves of a quarter of a metre to two; the window of `road` has spread
    longer ones. Zero if no segment has such waves.
    """
    found = []
    for one, length in zip(roads, lengths_m, strict=True):
        n = np.arange(1, one.observed.size + 1) / length
        inside = (n > _SURFACE_CYCLES_PER_M[0]) & (n < _SURFACE_CYCLES_PER_M[1])
        spread = np.interp(n[inside], shapes.cycles_per_m, shapes.road_spread)
        found.append(one.observed[inside] / one.shapes[0, inside] * spread)
    ratio = np.concatenate(found)
    # The median of an exponential is ln 2 times its mean.
    return float(np.median(ratio) / np.log(2.0)) if ratio.size else 0.0


def estimate_levels(
    segments: list[PeriodogramSegment], typical: FloatArray, bands: int = 0
) -> tuple[FloatArray, float]:
    """Return the most likely levels (s,) in m³ (Whittle's likelihood), and a statistic.

    `typical` (s,) are the means of their exponential priors, infinite without one; the statistic is
    that of `maximum_likelihood_levels`. The last `bands` of the levels, of axles that roll, are
    zero unless they raise the statistic by `_CLEAR_ROLL`: free levels would absorb the excess by
    chance in a band, and the others would be a tenth too low.
    """
    if bands == 0:
        return _most_likely_levels(segments, typical)
    fewer = [one._replace(shapes=one.shapes[:-bands]) for one in segments]
    level, statistic = _most_likely_levels(fewer, typical[:-bands])
    with_roll, higher = _most_likely_levels(segments, typical)
    if higher > statistic + _CLEAR_ROLL:
        return with_roll, higher
    return np.append(level, np.zeros(bands)), statistic


def _most_likely_levels(
    segments: list[PeriodogramSegment], typical: FloatArray
) -> tuple[FloatArray, float]:
    observed = np.concatenate([one.observed for one in segments])
    known = np.concatenate([one.sensors for one in segments])
    shape = np.concatenate([one.shapes for one in segments], axis=1)
    start = np.full(shape.shape[0], np.mean(observed) / np.mean(shape.sum(axis=0)))
    return maximum_likelihood_levels(observed, known, shape, start, 2.0 / typical, _ENOUGH)
