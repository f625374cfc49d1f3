"""Correlation of motions at the same place of the road, which shows which sensor is in front."""

import numpy as np

from pre_core.arrays import FloatArray

_BOUNCE_BAND_HZ = (0.3, 4.0)
"""Band of a body's motion on its springs."""
_ROAD_BAND_HZ = (1.0, 8.0)
"""Band in which both axles follow the road equally."""


def axle_correlation(
    front_m_per_s2: FloatArray,
    rear_m_per_s2: FloatArray,
    step_s: float,
    travelled_m: FloatArray,
    wheelbase_m: float,
) -> tuple[float, float]:
    """Return the correlation of both axles' motion at the same place, as recorded and swapped.

    Below 8 Hz an axle follows the road. `travelled_m` (n,) is the increasing distance of the front
    axle at every sample of both accelerations (n,); the rear axle is a wheelbase behind it. Swapped
    means that the accelerometer recorded as rear is in front.
    """
    smooth = _band_passed(np.stack([front_m_per_s2, rear_m_per_s2]), step_s, _ROAD_BAND_HZ)
    return (
        _correlation(smooth[0], smooth[1], travelled_m, -wheelbase_m),
        _correlation(smooth[0], smooth[1], travelled_m, wheelbase_m),
    )


def sprung_correlation(
    body_m_per_s2: FloatArray,
    axle_m_per_s2: FloatArray,
    step_s: float,
    travelled_m: FloatArray,
    ahead_m: float,
    spring: tuple[float, float],
) -> float:
    """Return the correlation of a body's motion (n,) with that of a mass on a spring.

    The mass is driven by the road that an axle `ahead_m` behind the body's own axle follows, at the
    same place: the own axle has no sensor. `spring` is stiffness and damping over mass, in 1/s² and
    1/s. `travelled_m` (n,) as in `axle_correlation`.
    """
    stiffness, damping = spring
    n = axle_m_per_s2.size
    s = 2j * np.pi * np.fft.rfftfreq(n, step_s)
    transfer = (damping * s + stiffness) / (s**2 + damping * s + stiffness)
    sprung = np.fft.irfft(np.fft.rfft(axle_m_per_s2) * transfer, n)
    smooth = _band_passed(np.stack([body_m_per_s2, sprung]), step_s, _BOUNCE_BAND_HZ)
    return _correlation(smooth[0], smooth[1], travelled_m, -ahead_m)


def _band_passed(signals: FloatArray, step_s: float, band_hz: tuple[float, float]) -> FloatArray:
    n = signals.shape[1]
    spectrum = np.fft.rfft((signals - signals.mean(axis=1, keepdims=True)) * np.hanning(n), axis=1)
    frequency = np.fft.rfftfreq(n, step_s)
    spectrum[:, (frequency < band_hz[0]) | (frequency > band_hz[1])] = 0.0
    return np.fft.irfft(spectrum, n, axis=1)


def _correlation(
    front: FloatArray, rear: FloatArray, travelled_m: FloatArray, rear_offset_m: float
) -> float:
    """Return the correlation at the same place of two signals whose sensors are an offset apart."""
    rear_at = travelled_m + rear_offset_m
    low, high = max(travelled_m[0], rear_at[0]), min(travelled_m[-1], rear_at[-1])
    if high - low < 2.0 * abs(rear_offset_m):
        return 0.0
    place = np.linspace(low, high, front.size)
    a = np.interp(place, travelled_m, front)
    b = np.interp(place, rear_at, rear)
    scale = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / scale) if scale > 0.0 else 0.0
