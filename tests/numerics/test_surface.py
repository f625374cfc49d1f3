"""Random surfaces: what axles feel of them, against the integral, and that against known values."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import csd

from pre_core.arrays import FloatArray
from pre_core.physics.road import Profile, under_axles, under_wheels
from pre_core.physics.simulate import constant_speed
from pre_core.physics.surface import (
    Footprint,
    axle_profile,
    random_surface,
    spectra,
    surface_density,
)

SINGLE = Footprint()
TWIN = Footprint(width_m=0.22, twin_distance_m=0.33, offset_m=0.005)
POINT = Footprint(width_m=0.0, length_m=0.0, track_m=0.0)
PLACES_M = (-24.0, -8.0, 8.0, 24.0)
"""Beside the line: most waves across know nothing of one another there."""


@pytest.mark.parametrize(
    ("front", "rear", "expected"),
    [
        (SINGLE, TWIN._replace(offset_m=0.0), (2.8e-8, 2.6e-8, 1.2e-8)),
        (SINGLE, SINGLE._replace(offset_m=0.005), (2.5e-10, 1.3e-10, 3.4e-11)),
        (SINGLE, SINGLE._replace(width_m=0.385), (3.6e-9, 3.3e-9, 1.7e-9)),
    ],
    ids=["twin behind", "5 mm aside", "wider"],
)
def test_the_difference_of_two_axles(
    front: Footprint, rear: Footprint, expected: tuple[float, float, float]
) -> None:
    """Against known values of two digits (class A, m³)."""
    n = np.array([0.05, 0.2, 1.0])
    difference = surface_density("A") * spectra(front, rear, n)[3]
    np.testing.assert_allclose(difference, expected, rtol=0.08)


def test_a_point_on_the_surface_feels_the_roads_class() -> None:
    """The integral over all waves across of Phi k^-3 is 2 Phi/n²: G_d(n_0) (n_0/n)²."""
    n = np.array([0.05, 0.2, 1.0])
    for profile in spectra(POINT, POINT, n)[:3]:
        np.testing.assert_allclose(surface_density("A") * profile, 1.6e-7 / n**2, rtol=2e-3)
    assert surface_density("C") == pytest.approx(16.0 * 8e-8)


def densities(
    spacing_m: float, length_m: float, seeds: range, front: Footprint, rears: tuple[Footprint, ...]
) -> tuple[FloatArray, FloatArray]:
    """Frequencies (f,) and what `spectra` says of each rear axle, measured: (rears, 4, f), m³."""
    points = round(200.0 / spacing_m)

    def density(one: FloatArray, other: FloatArray) -> FloatArray:
        return np.asarray(csd(one, other, fs=1.0 / spacing_m, nperseg=points)[1].real)

    of_all = []
    for seed in seeds:
        surface = random_surface(-10.0, length_m - 10.0, spacing_m, "A", seed)
        for beside in PLACES_M:
            one = axle_profile(surface, front, beside).height_m
            others = [axle_profile(surface, rear, beside).height_m for rear in rears]
            of_front = density(one, one)
            of_all.append(
                [
                    [
                        of_front,
                        density(other, other),
                        density(one, other),
                        density(one - other, one - other),
                    ]
                    for other in others
                ]
            )
    return np.fft.rfftfreq(points, spacing_m), np.mean(of_all, axis=0)


@pytest.mark.parametrize(
    ("spacing_m", "length_m", "seeds", "octaves"),
    [
        (0.5, 1000.0, range(12), (0.04, 0.08, 0.16, 0.32, 0.64)),
        (0.08, 200.0, range(100, 110), (0.625, 1.25, 2.5, 5.0)),
    ],
    ids=["long waves", "short waves"],
)
def test_drawn_surfaces_have_the_spectra_of_the_integral(
    spacing_m: float, length_m: float, seeds: range, octaves: tuple[float, ...]
) -> None:
    """Octave by octave; the means of so many scatter by 2 to 3 %."""
    rears = (TWIN, SINGLE._replace(offset_m=0.005))
    n, drawn = densities(spacing_m, length_m, seeds, SINGLE, rears)
    for rear, measured in zip(rears, drawn, strict=True):
        expected = surface_density("A") * np.array(spectra(SINGLE, rear, n[1:]))
        for low, high in pairwise(octaves):
            within = (n[1:] >= low) & (n[1:] < high)
            level = n[1:][within] ** 2  # every wave has the same say
            ratio = (measured[:, 1:][:, within] @ level) / (expected[:, within] @ level)
            np.testing.assert_allclose(ratio, 1.0, atol=0.1, err_msg=f"{rear}, {low} cycles/m")


def test_a_surface_is_as_rough_along_as_across() -> None:
    """E (h(x + d) - h(x))² of a density of 1.6e-7/n² is 2 pi² 1.6e-7 d, whichever way d points."""
    apart = 0.48
    along, across, density = [], [], []
    for seed in range(6):
        surface = random_surface(0.0, 200.0, 0.08, "A", seed)
        for beside in PLACES_M:
            here = axle_profile(surface, POINT, beside).height_m
            there = axle_profile(surface, POINT, beside + apart).height_m
            along.append(np.mean((here[6:] - here[:-6]) ** 2))
            across.append(np.mean((here - there) ** 2))
            density.append(csd(here, here, fs=1.0 / 0.08, nperseg=1250)[1].real)
    expected = 2.0 * np.pi**2 * 1.6e-7 * apart
    # The waves drawn, up to 6.25 cycles/m along the road, have 3 % less.
    assert np.mean(along) == pytest.approx(expected, rel=0.08)
    assert np.mean(across) == pytest.approx(expected, rel=0.08)
    n = np.fft.rfftfreq(1250, 0.08)
    within = (n > 0.3) & (n < 5.0)
    level = np.mean(density, axis=0)[within] * n[within] ** 2
    assert level.mean() == pytest.approx(1.6e-7, rel=0.05)


def test_a_surface_is_drawn_by_its_seed() -> None:
    one, again, other = (random_surface(0.0, 20.0, 0.1, "A", seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.amplitude, again.amplitude)
    assert not np.array_equal(one.amplitude, other.amplitude)


def test_an_axle_beside_the_other_feels_what_that_one_feels_there() -> None:
    surface = random_surface(0.0, 50.0, 0.05, "A", 4)
    np.testing.assert_allclose(
        axle_profile(surface, TWIN._replace(offset_m=0.3), -0.1).height_m,
        axle_profile(surface, TWIN._replace(offset_m=0.0), 0.2).height_m,
        atol=1e-15,
    )


@pytest.mark.parametrize("direction", [1, -1])
def test_each_axle_has_its_own_profile_under_it(direction: int) -> None:
    """Two waves known in closed form, and the same ones under both wheels."""
    x = np.arange(-20.0, 60.0, 0.02)
    front, rear = Profile(x, 0.01 * np.sin(x)), Profile(x, 0.02 * np.cos(2.0 * x))
    motion = constant_speed(10.0, direction * 12.0, 500, 0.001)
    road = under_axles(front, rear, motion, 4.4, direction)
    at = motion.position_m - direction * 4.4
    np.testing.assert_allclose(road.height_m[:, 1], 0.02 * np.cos(2.0 * at), atol=1e-8)
    rate = -0.04 * np.sin(2.0 * at) * direction * 12.0
    np.testing.assert_allclose(road.rate_m_per_s[:, 1], rate, atol=1e-5)
    alone = under_wheels(front, motion, 4.4, direction)
    np.testing.assert_array_equal(road.height_m[:, 0], alone.height_m[:, 0])
    np.testing.assert_array_equal(road.rate_m_per_s[:, 0], alone.rate_m_per_s[:, 0])
    with pytest.raises(ValueError, match="does not reach under"):
        under_axles(front, Profile(x[:1500], x[:1500]), motion, 4.4, direction)
