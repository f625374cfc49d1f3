"""Simulated pavements: the deck's roughness, joints at its ends, and anisotropic surfaces."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import coherence, welch

from pre_core.physics.road import Profile
from pre_core.physics.simulate import constant_speed
from pre_core.physics.surface import Footprint, axle_profile, random_surface
from services.cli import main as cli
from services.simulation.drive import paper_site
from services.simulation.pavement import (
    JOINT_WIDTH_M,
    Pavement,
    joint_heights,
    on_stretched_surface,
    with_deck,
)
from services.simulation.wheel_paths import AxleRoads, WheelPaths, roads_of_surface

BRIDGE = paper_site().bridges[0]
SPAN_M = BRIDGE.span_m
FRONT, TWIN = Footprint(), Footprint(width_m=0.22, twin_distance_m=0.33, offset_m=0.005)


def roads(pavement: Pavement, *, seed: int = 1, sign: int = 1) -> AxleRoads:
    motion = constant_speed(15.0 - 50.0 * sign, 10.0 * sign, 1000, 0.01)
    paths = WheelPaths(FRONT, TWIN, 0.0, pavement)
    return roads_of_surface(BRIDGE, motion, 5.0, 0.02, ("A", seed), paths, np.random.default_rng(1))


def on_bridge(profile: Profile) -> NDArray[np.bool_]:
    return (profile.x_m > 0.1) & (profile.x_m < SPAN_M - 0.1)


def test_deck_multiplies_slopes_on_the_bridge_alone() -> None:
    plain, rough = roads(Pavement()), roads(Pavement(deck_roughness=2.5))
    for before, after in zip(plain, rough, strict=True):
        inside = on_bridge(before)
        outside = (before.x_m < -0.1) | (before.x_m > SPAN_M + 0.1)
        slopes = np.gradient(before.height_m), np.gradient(after.height_m)
        np.testing.assert_allclose(slopes[1][inside], 2.5 * slopes[0][inside], rtol=1e-9)
        np.testing.assert_allclose(slopes[1][outside], slopes[0][outside], atol=1e-12)
    difference = [one.front.height_m - one.rear.height_m for one in (plain, rough)]
    inside = on_bridge(plain.front)
    curvature = [np.std(np.diff(one[inside], 2)) for one in difference]
    assert curvature[1] == pytest.approx(2.5 * curvature[0], rel=1e-6)


def test_deck_without_a_change_is_the_same_surface() -> None:
    x = np.linspace(-5.0, 40.0, 2000)
    profile = Profile(x, np.sin(x))
    np.testing.assert_allclose(with_deck(profile, SPAN_M, 1.0).height_m, profile.height_m)


@pytest.mark.parametrize("sign", [1, -1])
def test_joints_are_at_the_ends_and_nearly_the_same_for_both_axles(sign: int) -> None:
    largest = 0.015
    plain = roads(Pavement(), sign=sign)
    with_joints = roads(Pavement(largest_joint_m=largest), sign=sign)
    joints = [b.height_m - a.height_m for a, b in zip(plain, with_joints, strict=True)]
    x = plain.front.x_m
    reach = 0.5 * (JOINT_WIDTH_M[1] + FRONT.length_m) + 0.05
    near = (np.abs(x) < reach) | (np.abs(x - SPAN_M) < reach)
    for heights in joints:
        np.testing.assert_allclose(np.diff(heights)[~near[1:]], 0.0, atol=1e-12)
        assert 0.05 * largest < np.ptp(heights) < 3.0 * largest
    apart = np.abs(joints[0] - joints[1]).max()
    assert 0.0 < apart < 0.3 * np.abs(joints[0]).max()


def test_sizes_of_joints_are_drawn_up_to_the_largest() -> None:
    # A wheel as narrow and short as a point feels the whole size.
    point = Footprint(width_m=1e-3, length_m=1e-3, track_m=0.0)
    x = np.arange(-1.0, 1.0, 0.001)
    tops = [np.abs(joint_heights(x, 1e3, 0.01, point, seed)).max() for seed in range(60)]
    assert np.median(tops) == pytest.approx(0.0065, rel=0.25)
    assert max(tops) < 0.014


def test_stretched_surface_has_the_same_profiles_and_similar_sides() -> None:
    """Left and right: coherence 0.31 at 0.05 to 0.2 cycles/m if isotropic, 0.8 on real decks."""
    surface = random_surface(0.0, 6000.0, 0.1, "A", 5)
    wheel = Footprint(width_m=0.1, length_m=0.1, track_m=0.0)
    found, level = {}, {}
    for factor in (1.0, 3.5):
        sides = [
            axle_profile(
                surface, on_stretched_surface(wheel._replace(offset_m=offset), factor)
            ).height_m
            for offset in (-0.95, 0.95)
        ]
        n, alike = coherence(*sides, fs=10.0, nperseg=1000)
        band = (n >= 0.05) & (n <= 0.2)
        found[factor] = float(alike[band].mean())
        power = welch(sides[0], fs=10.0, nperseg=1000)[1]
        level[factor] = float((power * n**2)[band].mean())
    assert found[1.0] == pytest.approx(0.31, abs=0.1)
    assert found[3.5] == pytest.approx(0.81, abs=0.07)
    assert level[3.5] == pytest.approx(level[1.0], rel=0.1)


@pytest.mark.parametrize(
    "option", [("--deck-roughness", "2"), ("--joints", "15"), ("--anisotropy", "3")]
)
def test_pavement_without_a_surface_is_refused(
    option: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["simulate", "--scenario", "1", *option, "-o", str(tmp_path / "a.mcap")]
    assert cli.main(asked) == 2
    assert f"{option[0]}: has no effect without --road-surface" in capsys.readouterr().err


def test_command_simulates_a_pavement(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    pavement = ["--deck-roughness", "2.5", "--joints", "15", "--anisotropy", "3"]
    asked = ["simulate", "--scenario", "1", "--road-surface", *pavement, "-o", str(path)]
    assert cli.main(asked) == 0
    assert path.stat().st_size > 0
