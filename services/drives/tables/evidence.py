"""Evidence in a drive's numbers on units, gravity, axes and the order of coordinates.

A mean of about 1, 9.81, 981 or 1000 is gravity and shows the unit. Without gravity the ratio of the
sensors' noise to the declared one does. An undetermined unit is refused, with the key of the map
that declares it.
"""

from collections.abc import Iterable, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.diagnostics.noise_floor import NoiseSegment, density
from schemas.site import Bridge, Site, Vehicle
from schemas.wgs84 import SEMI_MAJOR_AXIS_M
from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.geodesy import on_plane_m
from services.drives.tables.units import ACCELERATION, SPEED, G
from services.finding.placed import densities_ug_per_rthz

NEAR_M: Final = 100_000.0
_GRAVITY_TOLERANCE: Final = 0.03
_NO_GRAVITY: Final = 0.2
"""Mean over g below which a channel shows no gravity."""
_IN_G: Final = (0.06, 0.16)
_IN_M_PER_S2: Final = (0.5, 3.0)
_IN_MG: Final = (60.0, 160.0)
"""Measured noise over the declared one, for accelerations in g, m/s², mg or cm/s².

The least of all channels counts, as the motion of wheels hides the noise of their sensors.
"""
_GRAVITIES: Final = (
    ("g", 1.0), ("m/s2", G), ("ft/s2", G / 0.3048), ("cm/s2", 100.0 * G), ("mg", 1000.0),
    ("mm/s2", 1000.0 * G),
)  # fmt: skip
_UNLIKELY_M_PER_S2: Final = 3.0
_IMPOSSIBLE_M_PER_S2: Final = 30.0
"""Standard deviations of a truck's quietest sensor that are unlikely, and impossible."""
_SENTINELS: Final = (999.0, 999.9, 9999.0, 9999.9, 99999.0, 32767.0, 32768.0, 99.99, 9999.99)
"""Numbers that loggers write where they have none, of either sign."""
_MAX_ABSENT, _FAR_BEYOND = 0.2, 5.0
_DRIVING_M: Final = 20.0
"""Distance in m below which a speed is not judged: fixes scatter by metres."""
_STRETCH_S: Final = 5.0
"""Length in s of the stretches of a drive that turns."""
_UNIT_TOLERANCE: Final = 0.04


class Gravity(NamedTuple):
    """Form of one channel's measurements."""

    is_included: bool
    up: int


class UnitEvidence(NamedTuple):
    """Unit of accelerations, and the evidence for it."""

    unit: str
    why: str


def noise_ratio(
    channels: Mapping[str, Floats], rate_hz: float, site: Site, vehicle: Vehicle
) -> float | None:
    """Return the least ratio of noise to its declared value over all channels; None if unknown."""
    declared = densities_ug_per_rthz(site.sensor, vehicle)
    ratios = []
    for name, values in channels.items():
        found = density(NoiseSegment(values, rate_hz, is_standing=False))
        if found is not None and declared.get(name, 0.0) > 0.0 and found.ug_per_rthz > 0.0:
            ratios.append(found.ug_per_rthz / declared[name])
    return min(ratios) if len(ratios) == len(channels) else None


def unit_by_numbers(channels: Mapping[str, Floats], ratio: float | None) -> UnitEvidence | None:
    """Return the unit of channels as in the file; None without evidence."""
    means = [abs(float(np.mean(values))) for values in channels.values()]
    shown = f"{np.mean(means):.4g}"
    for unit, size in _GRAVITIES:
        within = 0.009 if size > 100.0 else _GRAVITY_TOLERANCE
        if all(abs(mean / size - 1.0) < within for mean in means):
            return UnitEvidence(unit, f"their mean is about {shown}, which is gravity in {unit}")
    if ratio is None:
        return None
    if _IN_G[0] <= ratio <= _IN_G[1]:
        return UnitEvidence("g", f"their noise is {ratio:.3f} of the declared one, about 1/9.8")
    if _IN_M_PER_S2[0] <= ratio <= _IN_M_PER_S2[1]:
        return UnitEvidence("m/s2", f"their noise is {ratio:.2f} of the declared one")
    return None


def is_beyond(channels: Mapping[str, Floats], ratio: float | None) -> bool:
    """Return whether channels in m/s² would shake as no truck does, so that the unit is another."""
    quietest = min(float(np.std(values)) for values in channels.values())
    return quietest > _IMPOSSIBLE_M_PER_S2 or (
        ratio is not None and ratio >= _IN_MG[0] and quietest > _UNLIKELY_M_PER_S2
    )


def is_counted(channels: Mapping[str, Floats]) -> bool:
    """Return whether all numbers are whole and of some size, as a converter's counts are."""
    return all(
        bool(np.all(values == np.rint(values))) and float(np.std(values)) > 1.0
        for values in channels.values()
    )


def sentinels(values: Floats) -> NDArray[np.bool_]:
    """Return which values (n,) stand for none: 9999 and the like, far beyond all others."""
    size = np.abs(values)
    known = np.isfinite(size)
    is_one = known & np.isin(size, _SENTINELS)
    rest = size[known & ~is_one]
    if not is_one.any() or not rest.size or is_one.mean() > _MAX_ABSENT:
        return np.zeros(values.size, dtype=bool)
    return is_one & (size > _FAR_BEYOND * max(float(rest.max()), 1e-9))


def no_unit(ratio: float | None) -> str:
    """Return the statement that the unit of accelerations is undetermined, with the evidence."""
    seen = ""
    if ratio is not None:
        seen = f" (their noise is {ratio:.3g} of the declared one"
        in_mm = 6.0 * _IN_MG[0] <= ratio <= 10.0 * _IN_MG[1]
        is_in_mg = _IN_MG[0] <= ratio <= _IN_MG[1]
        seen += ", as in mg or cm/s2)" if is_in_mg else ", as in mm/s2)" if in_mm else ")"
    return f"the unit of the accelerations is undetermined{seen}"


COUNTED: Final = "accelerations are whole numbers, as counts of a converter are"


def refuse_unit(where: str, ratio: float | None) -> InputError:
    """Return the error that requests the unit of accelerations."""
    return InputError(
        f"{where}: {no_unit(ratio)}; give it in a map (--map), "
        f"unit = one of {', '.join(ACCELERATION)}"
    )


def refuse_counts(where: str) -> InputError:
    """Return the error that requests the factor of a converter's counts."""
    return InputError(
        f"{where}: {COUNTED}: give factor, the "
        "calibrated factor to the unit, and unit of each in [file.columns] of a map (--map)"
    )


def gravity_of(
    channels: Mapping[str, Floats], expected: Mapping[str, Gravity], where: str
) -> dict[str, Gravity]:
    """Return whether accelerations in m/s² (n,) include gravity, and their axes' directions.

    `expected` is the declaration of site file or map; it stays where the numbers do not contradict
    it. Raise InputError if gravity shows in some channels only.
    """
    shares = {name: float(np.mean(values)) / G for name, values in channels.items()}
    with_g = {n for n, share in shares.items() if abs(abs(share) - 1.0) < _GRAVITY_TOLERANCE}
    without = {n for n, share in shares.items() if abs(share) < _NO_GRAVITY}
    if with_g and without:
        raise InputError(
            f"{where}: gravity shows in {', '.join(sorted(with_g))} and not in "
            f"{', '.join(sorted(without))}: another axis or unit? give gravity_included and unit "
            "of each in a map (--map)"
        )
    found = dict(expected)
    for name, share in shares.items():
        if name in with_g:
            found[name] = Gravity(is_included=True, up=1 if share > 0 else -1)
        elif name in without and expected[name].is_included:
            found[name] = Gravity(is_included=False, up=expected[name].up)
    return found


def speed_ratio(latitude: Floats, longitude: Floats, time_s: Floats, speed: Floats) -> float | None:
    """Return a speed column over the speed of the positions; None without a straight stretch.

    A drive that turns is compared on its straight stretches, whose median counts.
    """
    north, west = on_plane_m(latitude, longitude)
    track = np.column_stack([time_s, north, west, speed])
    whole = _straight_ratio(track)
    if whole is not None:
        return whole
    ends = np.arange(time_s[0] + _STRETCH_S, time_s[-1], _STRETCH_S)
    ratios = [_straight_ratio(part) for part in np.split(track, np.searchsorted(time_s, ends))]
    known = [ratio for ratio in ratios if ratio is not None]
    return float(np.median(known)) if known else None


def _straight_ratio(track: Floats) -> float | None:
    """Return the ratio for rows (n, 4) of time, north, west and speed; None unless straight."""
    if len(track) < 2:
        return None
    time_s, speed = track[:, 0], track[:, 3]
    straight = float(np.hypot(*(track[-1, 1:3] - track[0, 1:3])))
    # Fixes scatter, which lengthens a path through all of them.
    second = max(1, round(1.0 / max(float(np.median(np.diff(time_s))), 1e-3)))
    for every in (1, second):
        steps_m = np.diff(track[::every, 1:3], axis=0)
        if straight >= max(_DRIVING_M, 0.9 * float(np.hypot(*steps_m.T).sum())):
            driven_m = 0.5 * (speed[1:] + speed[:-1]) * np.diff(time_s)
            return float(np.abs(driven_m).sum()) / straight
    return None


def speed_unit(ratio: float) -> str | None:
    """Return the unit of a speed column with this ratio to the speed of the positions."""
    for unit, factor in SPEED.items():
        tolerance = 0.15 if unit == "m/s" else _UNIT_TOLERANCE
        if abs(ratio * factor - 1.0) < tolerance:
            return unit
    return None


def speeds_of_positions(latitude: Floats, longitude: Floats, time_s: Floats) -> Floats:
    """Return the slopes of positions (n,) over a second before and after each fix, m/s."""
    north, west = on_plane_m(latitude, longitude)
    first = np.searchsorted(time_s, time_s - 1.0, side="left")
    last = np.searchsorted(time_s, time_s + 1.0, side="right")
    speed = np.zeros(time_s.size)
    for k, (a, b) in enumerate(zip(first, last, strict=True)):
        if b - a < 2:  # alone in a gap: only its neighbours remain
            a, b = max(k - 1, 0), min(k + 2, time_s.size)
        local = time_s[a:b] - time_s[a:b].mean()
        spread = float(local @ local)
        speed[k] = np.hypot(float(local @ north[a:b]), float(local @ west[a:b])) / spread
    return speed


Angle = Literal["deg", "1e-7 deg", "ddmm", "rad"]


class CoordinateForm(NamedTuple):
    """Interpretation of the columns of latitude and longitude."""

    unit: Angle
    is_swapped: bool
    signs: tuple[float, float]
    """Factors of latitude and longitude, -1 where the sign is turned."""
    distance_m: float
    """Distance to the nearest bridge in this interpretation."""


def degrees(values: Floats, unit: str) -> Floats:
    """Return angles in degrees."""
    if unit == "1e-7 deg":
        return values * 1e-7
    if unit == "rad":
        return np.asarray(np.degrees(values))
    if unit == "ddmm":
        whole = np.trunc(values / 100.0)
        return np.asarray(whole + (values - 100.0 * whole) / 60.0)
    return values


def coordinates(
    first: Floats, second: Floats, site: Site, unit: Angle | None, *, has_signs: bool = False
) -> CoordinateForm:
    """Return the unit, order and signs by which positions are near a bridge, or as they are.

    Signs stay as they are where `has_signs`.
    """
    units: tuple[Angle, ...] = ("deg", "1e-7 deg", "ddmm", "rad") if unit is None else (unit,)
    turned = ((1.0, 1.0),) if has_signs else ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
    found = [
        CoordinateForm(
            one, swapped, signs, nearest_m(signs[0] * pair[0], signs[1] * pair[1], site.bridges)
        )
        for signs in turned
        for swapped in (False, True)
        for one in units
        for pair in [_ordered(degrees(first, one), degrees(second, one), swap=swapped)]
    ]
    near = [one for one in found if one.distance_m < NEAR_M]
    return near[0] if near else found[0]


def _ordered(first: Floats, second: Floats, *, swap: bool) -> tuple[Floats, Floats]:
    return (second, first) if swap else (first, second)


def nearest_m(latitude: Floats, longitude: Floats, bridges: Iterable[Bridge]) -> float:
    """Return the distance on a sphere to the nearest of the bridges' starts, of any fix."""
    if np.abs(latitude).max() > 90.0 or np.abs(longitude).max() > 360.0:
        return np.inf
    places = np.radians([(b.start_latitude_deg, b.start_longitude_deg) for b in bridges])
    every = max(1, latitude.size // 200)
    phi, lam = np.radians(np.column_stack([latitude, longitude])[::every]).T[:, :, None]
    a = (
        np.sin(0.5 * (places[:, 0] - phi)) ** 2
        + np.cos(phi) * np.cos(places[:, 0]) * np.sin(0.5 * (places[:, 1] - lam)) ** 2
    )
    nearest = np.fmin.reduce(a, axis=None, initial=1.0)  # a fix may be NaN
    return float(2.0 * SEMI_MAJOR_AXIS_M * np.arcsin(np.sqrt(nearest)))
