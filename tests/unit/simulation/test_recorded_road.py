"""The road before and after the bridge that simulated drives record."""

from pathlib import Path

import pytest

from driveby import read
from schemas.site_file import site_toml
from services.cli.main import main
from services.simulation.drive import paper_site
from services.simulation.recorded_road import times_s
from services.simulation.usual_trucks import usual_tandem

ON_BRIDGE_M, WHEELBASE_M = 34.0, 4.0


@pytest.mark.parametrize("speeds", [(10.0, 10.0), (6.0, 6.0), (12.0, 6.0), (5.0, 11.0)])
def test_rear_axle_has_the_least_road_on_both_sides(speeds: tuple[float, float]) -> None:
    before_s, driven_s = times_s(speeds, ON_BRIDGE_M, WHEELBASE_M, (40.0, 25.0))
    begin, end = speeds
    before_m = begin * before_s + 0.5 * (end - begin) / driven_s * before_s**2
    after_m = 0.5 * (begin + end) * driven_s - before_m - ON_BRIDGE_M
    assert before_m >= 40.0 + WHEELBASE_M - 1e-9
    assert after_m >= 25.0 - 1e-9


def test_default_drive_keeps_its_times() -> None:
    assert times_s((8.0, 8.0), ON_BRIDGE_M, WHEELBASE_M, (0.0, 0.0)) == (3.0, 5.5 + 34.0 / 8.0)


@pytest.mark.parametrize("has_tandem", [False, True])
def test_drive_of_a_given_site_records_the_road_of_a_survey(
    has_tandem: bool, tmp_path: Path
) -> None:
    site, axle_m = paper_site(), paper_site().vehicles[0].wheelbase_m
    if has_tandem:
        site, axle_m = site.model_copy(update={"vehicles": (usual_tandem(10.0),)}), 5.95
    file, out = tmp_path / "site.toml", tmp_path / "drive.mcap"
    file.write_text(site_toml(site))
    given = ["simulate", "--site", str(file), "--scenario", "6", "--rate", "200", "--speed", "9"]
    assert main([*given, "--noise", "0", "-o", str(out)]) == 0
    (signals,) = read(out)
    time_ns = signals.channels["sprung_front"].time_ns
    road_m = 9e-9 * (time_ns[-1] - time_ns[0])
    assert road_m == pytest.approx(40.0 + axle_m + 30.0 + axle_m + 25.0, abs=0.1)
