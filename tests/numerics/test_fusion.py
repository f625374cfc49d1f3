"""Several crossings as one: what is shared, and twelve runs of an independent simulator."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pre_core.crossing import mismatch as mm
from pre_core.crossing.optimum import Optimum
from pre_core.fusion import joint
from pre_core.physics.road import REFERENCE_CYCLES_PER_M
from pre_core.physics.surface import COMMON_LORRY, felt_by, random_surface, spectra, surface_density
from pre_core.unknowns import EI_1
from schemas.settings import IdentificationSettings
from schemas.site_file import load_site
from services.drives.csv_import import read_folder
from services.drives.runs import normalised
from services.identification import pre_method
from services.simulation.drawn import see

FRONT, REAR = COMMON_LORRY


def whole() -> mm.Mismatch:
    at = np.array([REFERENCE_CYCLES_PER_M])
    level = surface_density("A") * float(spectra(FRONT, REAR, at)[3][0])
    return mm.Mismatch(mm.shapes_of(FRONT, REAR), np.array([level, 0.0]), 10.0)


def test_covariance_of_a_density() -> None:
    shapes = whole().shapes
    density = whole().level_m3 @ shapes.density
    found = joint.covariance(shapes.cycles_per_m, density, np.array([0.0, 0.3, 1.0, 9.0]))
    difference = []
    for seed in range(12):
        surface = random_surface(0.0, 120.0, 0.1, "A", seed)
        difference.append(felt_by(surface, FRONT).height_m - felt_by(surface, REAR).height_m)
    drawn = np.array(difference)
    assert np.mean(drawn**2) == pytest.approx(found[0], rel=0.15)
    assert np.mean(drawn[:, 3:] * drawn[:, :-3]) == pytest.approx(found[1], rel=0.2)
    assert found[3] == 0.0


@pytest.mark.parametrize("wander_m", [0.06, 0.12, 0.2])
def test_common_part_of_two_tracks(wander_m: float) -> None:
    """Two tracks apart by sqrt(2) of the wander, on drawn surfaces."""
    shapes = whole().shapes
    common = mm.common_shapes(FRONT, REAR, wander_m)[0]
    rng = np.random.default_rng(7)
    together, power = 0.0, 0.0
    for seed in range(30):
        surface = random_surface(0.0, 120.0, 0.1, "A", seed)
        d = []
        for beside in wander_m * rng.standard_normal(2):
            front, rear = felt_by(surface, FRONT, beside), felt_by(surface, REAR, beside)
            d.append(front.height_m - rear.height_m)
        together += float(d[0] @ d[1])
        power += 0.5 * float(d[0] @ d[0] + d[1] @ d[1])
    # Of all waves that the surface has, by the spectra.
    expected = common[1:].sum() / shapes.density[0][1:].sum()
    assert together / power == pytest.approx(expected, abs=0.1)


def test_the_wander_is_found_by_its_share() -> None:
    mismatch = whole()
    for wander_m in (0.05, 0.12, 0.3):
        n = mismatch.shapes.cycles_per_m
        seen = np.sin(0.5 * np.pi * n) ** 4
        common = mm.common_shapes(FRONT, REAR, wander_m)[0]
        share = float(common @ seen / (mismatch.shapes.density[0] @ seen))
        assert joint.wander(mismatch, share) == pytest.approx(wander_m, rel=0.02)


@pytest.mark.slow
def test_twelve_runs_over_a_real_road(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every element within two standard deviations, the level to less than a tenth."""
    folder = shared / "crossings" / "d8_real_road_12_runs"
    site = load_site(folder / "site.toml")
    runs: list[Optimum] = []
    kept = pre_method.optimum.find_optimum

    def keeping(*args: object) -> Optimum:
        runs.append(kept(*args))  # type: ignore[arg-type]
        return runs[-1]

    monkeypatch.setattr(pre_method.optimum, "find_optimum", keeping)
    for drive in read_folder(folder):
        see([normalised(drive, site.sensor)], site, IdentificationSettings(threads=1))
    assert len(runs) == 12
    fused = joint.fuse(runs, 150, 1)
    priors = runs[0].problem.priors
    ln_ei: NDArray[np.float64] = (
        np.log(priors.theta[EI_1:])
        + priors.spread[EI_1:] * (fused.draws.reshape(-1, fused.draws.shape[2])[:, -7:])
    )
    truth = np.log(json.loads((folder / "truth.json").read_text(encoding="utf-8"))["EI"])
    z = (ln_ei.mean(axis=0) - truth) / ln_ei.std(axis=0)
    assert np.abs(z).max() < 2.5
    level = ln_ei.mean(axis=1)
    assert level.std() < 0.1
    assert abs(level.mean() - truth.mean()) < 2.5 * level.std()
    assert fused.wander_m is not None
    assert 0.06 < fused.wander_m < 0.25  # 0.12 m
