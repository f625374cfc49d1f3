"""The lane of `driveby simulate`: the site file's unless options give another."""

from pathlib import Path

import numpy as np
import pytest

from schemas.site import Site
from schemas.site_file import parse_site, site_toml
from services.cli.main import main
from services.common.geodesy import bridge_frame, to_chainage
from services.notebook.read import read
from services.notebook.simulate import simulate
from services.simulation.drive import paper_site
from services.simulation.lane import driven_lane, twist_of

DECLARED = {"lane_offset_m": 1.5, "torsional_frequency_ratio": 2.0, "deck_gyration_m": 2.3}


def site_of(**more: float) -> Site:
    known = paper_site()
    bridge = known.bridges[0].model_copy(update=more)
    return parse_site(site_toml(known.model_copy(update={"bridges": (bridge,)})), "site.toml")


@pytest.mark.parametrize(
    ("declared", "given", "expected"),
    [
        ({}, (None, None), (0.0, None)),
        ({"lane_offset_m": 1.5}, (None, None), (1.5, None)),
        (DECLARED, (None, None), (1.5, (2.0, 2.3))),
        (DECLARED, (-1.0, None), (-1.0, (2.0, 2.3))),
        (DECLARED, (0.0, None), (0.0, None)),
        ({"lane_offset_m": 1.5}, (None, (3.0, 2.0)), (1.5, (3.0, 2.0))),
        (DECLARED, (0.5, (3.0, 2.0)), (0.5, (3.0, 2.0))),
    ],
)
def test_lane_is_the_site_files_unless_given(
    declared: dict[str, float],
    given: tuple[float | None, tuple[float, float] | None],
    expected: tuple[float, tuple[float, float] | None],
) -> None:
    assert driven_lane(site_of(**declared).bridges[0], *given) == expected


def test_simulated_truck_drives_the_declared_lane(tmp_path: Path) -> None:
    site, out = tmp_path / "site.toml", tmp_path / "a.mcap"
    site.write_text(site_toml(site_of(**DECLARED)))
    given = ["simulate", "--scenario", "6", "--rate", "200", "--site", str(site)]
    assert main([*given, "-o", str(out)]) == 0
    (signals,) = read(out)
    frame = bridge_frame(paper_site().bridges[0])
    _, lateral = to_chainage(frame, signals.fixes.latitude_deg, signals.fixes.longitude_deg)
    np.testing.assert_allclose(lateral, 1.5, atol=1e-3)
    same = simulate(scenario=6, rate=200.0, site=site_of(**DECLARED))
    flat = simulate(scenario=6, rate=200.0, site=site_of(lane_offset_m=1.5))
    series = signals.channels["unsprung_front"].acceleration_m_per_s2
    expected = same.signals.channels["unsprung_front"].acceleration_m_per_s2
    np.testing.assert_allclose(series, expected, atol=1e-5)
    stiff = flat.signals.channels["unsprung_front"].acceleration_m_per_s2
    assert np.abs(series - stiff).max() > 1e-3


def test_mirrored_lane_twists_the_deck_alike() -> None:
    """The opposite lane is rehearsed by another road, not by another sign."""
    bridge = paper_site().bridges[0]
    left, right = (twist_of(bridge, side, (2.0, 2.3)) for side in (1.5, -1.5))
    assert left is not None
    assert right is not None
    assert left.flexibility_per_n == right.flexibility_per_n > 0.0
    assert left.wave_speed_m_per_s == right.wave_speed_m_per_s
