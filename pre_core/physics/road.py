"""Road profiles: generated from an ISO 8608 class, filtered by a tyre, rated (IRI, class).

ISO 8608 describes a profile by the displacement spectral density G_d(n) = G_d(n_0) (n/n_0)^-w, n_0
= 0.1 cycles/m, w = 2; class A has the geometric mean G_d(n_0) = 16e-6 m^3, each further class four
times that of the previous one.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from pre_core.arrays import FloatArray
from pre_core.physics.simulate import Motion, WheelRoad, rear_position_m

REFERENCE_CYCLES_PER_M = 0.1
WAVINESS = 2.0
_FITTED_CYCLES_PER_M = (0.05, 1.0)
"""Band of the spectrum to which the level of a road is fitted."""
CLASSES = "ABCDEFGH"
GEOMETRIC_MEAN_M3 = {name: 16e-6 * 4.0**i for i, name in enumerate(CLASSES)}

GOLDEN_CAR_SPEED_M_PER_S = 80.0 / 3.6
GOLDEN_CAR_K1_PER_S2 = 653.0
GOLDEN_CAR_K2_PER_S2 = 63.3
GOLDEN_CAR_C_PER_S = 6.0
GOLDEN_CAR_MU = 0.15
_GOLDEN_CAR_BASE_M = 0.25  # length of the moving average that models the contact patch
_GOLDEN_CAR_START_M = 0.5 * GOLDEN_CAR_SPEED_M_PER_S  # travel whose mean slope starts the filter


class Profile(NamedTuple):
    """Heights (n,) at increasing, evenly spaced chainages x (n,)."""

    x_m: FloatArray
    height_m: FloatArray


def iso_8608_profile(
    start_m: float,
    stop_m: float,
    spacing_m: float,
    road_class: str,
    seed: int,
    *,
    longest_wave_m: float = 100.0,
    shortest_wave_m: float = 0.1,
) -> Profile:
    """Return a random profile with the geometric mean spectral density of an ISO 8608 class.

    It is a sum of harmonics of random phase whose amplitudes sqrt(2 G_d(n) dn) follow the density
    between the longest and the shortest wave. Shorter waves do not reach the vehicle through a
    tyre; none is shorter than two spacings.
    """
    rng = np.random.default_rng(seed)
    count = round((stop_m - start_m) / spacing_m) + 1
    x = start_m + spacing_m * np.arange(count, dtype=np.float64)
    lowest = 1.0 / longest_wave_m
    # The period is four times the requested length, so that it does not repeat visibly.
    period = max(4 * (count - 1), int(np.ceil(longest_wave_m / spacing_m)))  # samples
    step = 1.0 / (period * spacing_m)
    n = np.arange(lowest, min(1.0 / shortest_wave_m, 0.5 / spacing_m), step)
    density = GEOMETRIC_MEAN_M3[road_class] * (n / REFERENCE_CYCLES_PER_M) ** -WAVINESS
    amplitude = np.sqrt(2.0 * density * step)
    phase = rng.uniform(0.0, 2.0 * np.pi, n.size) + 2.0 * np.pi * n * start_m
    waves = period * np.fft.ifft(amplitude * np.exp(1j * phase), period)[:count]
    height = np.real(waves * np.exp(2j * np.pi * lowest * (x - start_m)))
    return Profile(x, height)


def contact_patch_average(profile: Profile, length_m: float) -> Profile:
    """Return the moving average of a profile over a tyre's contact length.

    The average of the cubic spline through the heights is exact for any length; a wave of n
    cycles/m is multiplied by sin(pi n L)/(pi n L). Beyond its ends the road is level.
    """
    if length_m <= 0.0:
        return profile
    from scipy.interpolate import CubicSpline  # slow to import; only simulated roads need it

    x, height = profile.x_m, profile.height_m
    first, last = float(x[0]), float(x[-1])
    area = CubicSpline(x, height).antiderivative()

    def area_to(position: FloatArray) -> FloatArray:
        within = np.clip(position, first, last)
        beyond = height[0] * (position - within) * (position < first)
        beyond += height[-1] * (position - within) * (position > last)
        return np.asarray(area(within) + beyond)

    half = 0.5 * length_m
    return profile._replace(height_m=(area_to(x + half) - area_to(x - half)) / length_m)


def under_wheels(profile: Profile, motion: Motion, wheelbase_m: float, direction: int) -> WheelRoad:
    """Return height and rate of change under both wheels (steps, 2), by cubic splines.

    `direction` is 1 from the bridge's start to its end, -1 in the other direction. Raise ValueError
    if the profile does not cover the path of both wheels.
    """
    return under_axles(profile, profile, motion, wheelbase_m, direction)


def under_axles(
    front: Profile, rear: Profile, motion: Motion, wheelbase_m: float, direction: int
) -> WheelRoad:
    """Return what `under_wheels` does, where each axle has its own profile."""
    from scipy.interpolate import CubicSpline  # slow to import; only simulated roads need it

    behind_m = rear_position_m(motion.position_m, wheelbase_m, direction)
    heights, slopes = [], []
    for profile, wheel in ((front, motion.position_m), (rear, behind_m)):
        tolerance = 1e-9
        if wheel.min() < profile.x_m[0] - tolerance or wheel.max() > profile.x_m[-1] + tolerance:
            raise ValueError(
                f"the road from {profile.x_m[0]:.2f} m to {profile.x_m[-1]:.2f} m does not reach "
                f"under the wheels, which drive from {wheel.min():.2f} m to {wheel.max():.2f} m"
            )
        spline = CubicSpline(profile.x_m, profile.height_m)
        heights.append(spline(wheel))
        slopes.append(spline(wheel, 1))
    return WheelRoad(
        np.stack(heights, axis=1), np.stack(slopes, axis=1) * motion.speed_m_per_s[:, None]
    )


def golden_car_matrices(dx_m: float) -> tuple[FloatArray, FloatArray]:
    """Return state transition (4, 4) and input (4,) of the IRI's quarter car for one sample.

    States are the slopes [z_s', z_s'', z_u', z_u''] of Sayers' formulation (World Bank Technical
    Paper 46; ASTM E1926); the input is the slope of the profile, constant over the sample.
    """
    k1, k2, c, mu = (
        GOLDEN_CAR_K1_PER_S2,
        GOLDEN_CAR_K2_PER_S2,
        GOLDEN_CAR_C_PER_S,
        GOLDEN_CAR_MU,
    )
    a = np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-k2, -c, k2, c],
            [0.0, 0.0, 0.0, 1.0],
            [k2 / mu, c / mu, -(k1 + k2) / mu, -c / mu],
        ]
    )
    b = np.array([0.0, 0.0, 0.0, k1 / mu])
    transition = expm(a * dx_m / GOLDEN_CAR_SPEED_M_PER_S)
    gain = np.linalg.solve(a, (transition - np.eye(4)) @ b)
    return transition, gain


def iri_m_per_km(profile: Profile, segment_m: float | None = None) -> FloatArray:
    """Return the International Roughness Index, whole or per segment: (segments,) in m/km.

    Mean rectified slope of the golden car at 80 km/h (ASTM E1926), which starts on the mean slope
    of the first 0.5 s. Slopes are taken over 0.25 m. An incomplete last segment is omitted, unless
    it is the only one.
    """
    x, height = profile.x_m, profile.height_m
    dx = float(x[1] - x[0])
    reach = max(1, round(_GOLDEN_CAR_BASE_M / dx))
    slope = (height[reach:] - height[:-reach]) / (reach * dx)
    transition, gain = golden_car_matrices(dx)
    start_m = min(_GOLDEN_CAR_START_M, float(x[-1] - x[0]))
    mean_slope = (np.interp(x[0] + start_m, x, height) - height[0]) / start_m
    state = np.array([mean_slope, 0.0, mean_slope, 0.0])
    rectified = np.empty(slope.size)
    for i in range(slope.size):
        state = transition @ state + gain * slope[i]
        rectified[i] = abs(state[0] - state[2])
    if segment_m is None:
        return np.array([1000.0 * rectified.mean()])
    per_segment = max(1, round(segment_m / dx))
    count = max(1, (slope.size + reach - 1) // per_segment)
    return np.array(
        [1000.0 * rectified[i * per_segment : (i + 1) * per_segment].mean() for i in range(count)]
    )


def roughness_coefficient_m3(profile: Profile) -> float:
    """Return G_d(n_0) of a profile: a line of slope -2 fitted to its log-log spectrum."""
    spacing = float(profile.x_m[1] - profile.x_m[0])
    n, density = _welch(
        profile.height_m, spacing, min(profile.height_m.size, round(100.0 / spacing))
    )
    lowest = max(_FITTED_CYCLES_PER_M[0], 2.0 / (profile.x_m[-1] - profile.x_m[0]))
    level = density[1:] * (n[1:] / REFERENCE_CYCLES_PER_M) ** WAVINESS
    octave = np.floor(np.log2(n[1:] / lowest))
    within = (n[1:] >= lowest) & (n[1:] <= _FITTED_CYCLES_PER_M[1])
    # Average within an octave before the logarithm, as ISO 8608 smooths: the mean logarithm of
    # single periodogram lines is far below the logarithm of their mean. Then every octave
    # has the same weight.
    octaves = [level[within & (octave == k)].mean() for k in np.unique(octave[within])]
    return float(np.exp(np.mean(np.log(octaves))))


def _welch(values: FloatArray, spacing: float, length: int) -> tuple[FloatArray, FloatArray]:
    """Return frequencies (f,) and one-sided power density (f,) of even values (n,), n >= length.

    Welch's mean over Hann-windowed segments of `length` values that overlap by half, each detrended
    by a line. (scipy.signal has it too, and takes half a second to import.)
    """
    segments = np.lib.stride_tricks.sliding_window_view(values, length)[:: length - length // 2]
    line = np.vander(np.linspace(-1.0, 1.0, length), 2)
    level = segments - segments @ np.linalg.pinv(line).T @ line.T
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    power = np.abs(np.fft.rfft(window * level, axis=1)) ** 2
    density = 2.0 * spacing / float(window @ window) * power.mean(axis=0)
    density[0] *= 0.5
    if length % 2 == 0:
        density[-1] *= 0.5
    return np.asarray(np.fft.rfftfreq(length, spacing)), np.asarray(density)


def iso_8608_class(coefficient_m3: float) -> str:
    """Return the class of a roughness coefficient: limits are a factor of 2 from the means."""
    index = round(np.log(coefficient_m3 / GEOMETRIC_MEAN_M3["A"]) / np.log(4.0))
    return CLASSES[int(np.clip(index, 0, len(CLASSES) - 1))]
