"""Tracks of unlike width: what the axles do not feel alike is common to the runs.

A single-tyred front axle on a track of 2.05 m and a twin-tyred rear one on 1.83 m, twelve runs that
wander by 0.12 m over one surface of ISO class A.
"""

from pathlib import Path

import numpy as np
import pytest

from schemas.results import load_results
from schemas.site import Site, Vehicle
from schemas.site_file import site_toml
from services.cli import main as cli
from services.simulation.drive import paper_site

RATIOS = np.array([1.0, 1.0, 0.5, 1.0, 1.0, 1.0, 1.0])
TYRES = {
    "track_m": (2.05, 1.83),
    "tyre_width_m": (0.25, 0.22),
    "twin_tyre_distance_m": (0.0, 0.33),
}


def site() -> Site:
    paper = paper_site()
    vehicle = Vehicle.model_validate(paper.vehicles[0].model_dump(exclude_none=True) | TYRES)
    return paper.model_copy(update={"vehicles": (vehicle,)})


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_unlike_tracks_are_common_to_runs_and_stated(tmp_path: Path) -> None:
    file, recording, out = (tmp_path / name for name in ("site.toml", "a.mcap", "a.json"))
    file.write_text(site_toml(site()))
    drive = "--noise 10 --gps-noise --rate 500 --road-surface --wander 0.12 --runs 12 --seed 3"
    ei = ",".join(str(ratio) for ratio in RATIOS)
    simulate = ["simulate", "--site", str(file), "--ei", ei, *drive.split(), "-o", str(recording)]
    assert cli.main(simulate) == 0
    assert cli.main(["identify", str(recording), "--json", str(out)]) == 0
    results = load_results(out)
    assert {crossing.verdict for crossing in results.crossings} == {"good"}
    (bridge,) = results.bridges.values()
    (track,) = bridge.tracks
    assert track.common_share >= 0.6
    nominal = np.array(site().bridges[0].nominal_flexural_rigidity_nm2)
    states = [bridge.elements[f"EI_{e + 1}"] for e in range(7)]
    low, high = (np.log([getattr(one, key) for one in states]) for key in ("q025", "q975"))
    spread = (high - low) / 3.92
    z = (0.5 * (high + low) - np.log(nominal * RATIOS)) / spread
    assert 0.36 < np.median(spread) < 0.42
    assert np.sqrt(np.mean(z**2)) < 1.15
