"""Noise and road of a simulated drive: by option, else those that a given site declares."""

from pathlib import Path

import numpy as np
import pytest

from driveby import read, simulate
from pre_core.constants import MICRO_G_M_PER_S2
from schemas.signals import CHANNELS
from schemas.site_file import site_toml
from services.cli.main import main
from services.execution.offline import site_of
from services.simulation.drive import declared_site, paper_site

RATE_HZ = 200.0
DENSITIES = (10.0, 20.0, 30.0, 40.0)


def test_channels_have_the_densities_of_the_site() -> None:
    site = declared_site(paper_site(), DENSITIES, RATE_HZ)
    noisy, quiet = (
        simulate(scenario=6, site=site, speed=20.0, noise=noise).drive.run.channels
        for noise in (None, 0.0)
    )
    errors = [np.std(noisy[name] - quiet[name]) for name in CHANNELS]
    expected = np.array(DENSITIES) * MICRO_G_M_PER_S2 * np.sqrt(0.5 * RATE_HZ)
    assert errors == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(
    ("options", "declared"),
    [([], DENSITIES), (["--noise", "0"], (0.0,) * 4), (["--noise", "25"], (25.0,) * 4)],
)
def test_recording_declares_the_simulated_noise(
    options: list[str], declared: tuple[float, ...], tmp_path: Path
) -> None:
    file, out = tmp_path / "site.toml", tmp_path / "drive.mcap"
    file.write_text(site_toml(declared_site(paper_site(), DENSITIES, RATE_HZ)))
    given = ["simulate", "--site", str(file), "--scenario", "6", "--speed", "20", *options]
    assert main([*given, "-o", str(out)]) == 0
    assert site_of([out], None).sensor.noise_density_ug_per_rthz == declared


def test_road_has_the_class_of_the_site() -> None:
    site = paper_site()
    bridge = site.bridges[0].model_copy(update={"road_class": "C"})
    rough = site.model_copy(update={"bridges": (bridge,)})
    of_site, of_option, best = (
        simulate(scenario=6, speed=20.0, site=one, road=road).road_m[1]
        for one, road in ((rough, None), (rough, "B"), (site, None))
    )
    # Each class has twice the amplitude of the one before.
    np.testing.assert_allclose(of_site, 4.0 * best)
    np.testing.assert_allclose(of_option, 2.0 * best)


@pytest.mark.parametrize("axles", [["--seed", "2"], ["--axles", "3"]])
def test_command_takes_the_road_of_the_site(axles: list[str], tmp_path: Path) -> None:
    site = paper_site()
    written = []
    for name, road_class, options in (
        ("site", "C", []),
        ("option", None, ["--road", "C"]),
        ("best", None, []),
    ):
        bridge = site.bridges[0].model_copy(update={"road_class": road_class})
        file, out = tmp_path / f"{name}.toml", tmp_path / f"{name}.mcap"
        file.write_text(site_toml(site.model_copy(update={"bridges": (bridge,)})))
        given = ["simulate", "--site", str(file), "--scenario", "6", "--speed", "20", *axles]
        assert main([*given, *options, "-o", str(out)]) == 0
        (run,) = read(out)
        written.append(np.std(run.channels["sprung_front"].acceleration_m_per_s2))
    assert written[0] == written[1] > 1.5 * written[2]


@pytest.mark.parametrize("axles", [2, 3])
def test_declared_road_class_is_not_called_assumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], axles: int
) -> None:
    site = paper_site()
    bridge = site.bridges[0].model_copy(update={"road_class": "C"})
    file, out = tmp_path / "site.toml", tmp_path / "drive.mcap"
    file.write_text(site_toml(site.model_copy(update={"bridges": (bridge,)})))
    given = ["simulate", "--site", str(file), "--scenario", "6", "--speed", "20", "--rate", "100"]
    assert main([*given, "--axles", str(axles), "-o", str(out)]) == 0
    assert "assumed road class" not in capsys.readouterr().out
    assert main([*given, "--axles", str(axles), "--road", "B", "-o", str(out), "--force"]) == 0
    assert "; assumed road class B (--road)" in " ".join(capsys.readouterr().out.split())


def test_truth_of_other_elements_names_the_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = paper_site()
    bridge = site.bridges[0].model_copy(update={"elements": 5})
    file, out = tmp_path / "site.toml", tmp_path / "drive.mcap"
    file.write_text(site_toml(site.model_copy(update={"bridges": (bridge,)})))
    assert main(["simulate", "--site", str(file), "--scenario", "6", "-o", str(out)]) == 2
    line = "gives 7 elements, but bridge-1 of the site has 5: --ei takes one ratio for each"
    assert line in capsys.readouterr().err
    assert not out.exists()
