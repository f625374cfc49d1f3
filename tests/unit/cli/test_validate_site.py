"""`driveby validate --site`: what it prints, writes and refuses; the crossings are made up."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from schemas.settings import IdentificationSettings
from schemas.site_file import load_site, site_toml
from schemas.validation_records import load_validation, pair_hash
from services.cli import main as cli
from services.cli import validate_site
from services.simulation.drive import paper_site
from services.simulation.validation_trial import ValidationTrial
from tests.unit.simulation.test_validation_trial import made_up

SETTINGS = IdentificationSettings()


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Two trucks, two bridges."""
    paper = paper_site()
    truck, bridge = paper.vehicles[0], paper.bridges[0]
    two = paper.model_copy(
        update={
            "vehicles": (truck, truck.model_copy(update={"id": "truck-2"})),
            "bridges": (bridge, bridge.model_copy(update={"id": "bridge-2"})),
        }
    )
    path = tmp_path / "site.toml"
    path.write_text(site_toml(two))
    return path


@pytest.fixture(autouse=True)
def made_up_crossings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those on bridge-2 are all rejected."""

    def tried(trial: ValidationTrial, *_: Any) -> Iterator[float]:
        verdict = "good" if trial.pair.bridge == "bridge-1" else "rejected"
        while trial.judgement is None:
            run = trial.next_run()
            assert run is not None
            trial.add(run.number, made_up(run.number, verdict=verdict))
            yield trial.share

    monkeypatch.setattr(validate_site, "run_trial", tried)


def validate(*arguments: object) -> int:
    return cli.main(["validate", *map(str, arguments)])


def test_every_pair_gets_a_line_and_a_file(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "made" / "here"
    assert validate("--site", site, "--validations", folder, "--seed", 4) == 1
    *lines, advice = capsys.readouterr().out.splitlines()
    assert "fewer elements or a truck with equal single tyres or an equalised tandem, and" in advice
    assert advice.startswith(
        "Most frequent reasons of crossings that were not good: The model does not explain the "
        "measured accelerations (10). Do not rely on intervals of a pair that failed: check"
    )
    assert [line.split(":")[0] for line in lines] == [
        "truck-1 on bridge-1",
        "truck-1 on bridge-2",
        "truck-2 on bridge-1",
        "truck-2 on bridge-2",
    ]
    assert "passed after 8 of at most 12 crossings: 8 of 8 crossings are good" in lines[0]
    assert "EI ± 10 % on one road profile under both axles, so real crossings are less" in lines[0]
    assert "FAILED after 5 of at most 12 crossings: 0 of 5 crossings are good" in lines[1]
    found = {path: load_validation(path) for path in folder.iterdir()}
    assert len(found) == 4
    assert {one.seed for one in found.values()} == {4}
    known = load_site(site)
    for path, one in found.items():
        assert path.stem == pair_hash(known, one.pair, SETTINGS)
        assert one.passed == (one.bridge == "bridge-1")
        assert any(str(path) in line for line in lines)


def test_line_names_the_road_only_where_both_axles_share_it(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = load_site(site)
    truck = known.vehicles[0].model_copy(update={"rear_axle_offset_m": 0.005})
    path = tmp_path / "two_roads.toml"
    path.write_text(site_toml(known.model_copy(update={"vehicles": (truck,)})))
    folder = tmp_path / "certificates"
    assert validate("--site", path, "--validations", folder, "--bridge", "bridge-1") == 0
    line = capsys.readouterr().out
    assert "EI ± 10 %;" in line
    assert "one road profile" not in line


@pytest.mark.parametrize(("declared", "is_assumed"), [(None, True), ("B", False)])
def test_line_names_the_road_class_that_the_site_lacks(
    site: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    declared: str | None,
    is_assumed: bool,
) -> None:
    known = load_site(site)
    bridge = known.bridges[0].model_copy(update={"road_class": declared})
    path = tmp_path / "road.toml"
    path.write_text(site_toml(known.model_copy(update={"bridges": (bridge,)})))
    assert validate("--site", path, "--validations", tmp_path / "here", "--truck", "truck-2") == 0
    line = capsys.readouterr().out
    assert ("; assumed road class B (road_class in the site file);" in line) == is_assumed


@pytest.mark.parametrize(
    ("declared", "two"),
    [
        ({}, "; to simulate two profiles, declare twin_tyre_distance_m or rear_axle_offset_m)"),
        (
            {"twin_tyre_distance_m": (0.0, 0.0)},
            "; to simulate two profiles, declare rear_axle_offset_m)",
        ),
        ({"twin_tyre_distance_m": (0.0, 0.0), "rear_axle_offset_m": 0.0}, ")"),
    ],
)
def test_line_names_only_paths_that_are_not_declared(
    site: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    declared: dict[str, Any],
    two: str,
) -> None:
    known = load_site(site)
    truck = known.vehicles[0].model_copy(update=declared)
    path = tmp_path / "single_tyres.toml"
    path.write_text(site_toml(known.model_copy(update={"vehicles": (truck,)})))
    folder = tmp_path / "certificates"
    assert validate("--site", path, "--validations", folder, "--bridge", "bridge-1") == 0
    line = capsys.readouterr().out
    assert f"are less accurate (driveby survey forecasts how accurate{two}; " in line


def test_validation_announces_pairs_and_processes(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "certificates"
    assert validate("--site", site, "--validations", folder, "--processes", 1) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(
        "validating 4 pairs of truck and bridge: at most 12 simulated crossings each, on 1 process"
    )


def test_validation_announces_surfaces(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paper = paper_site()
    unlike = paper.vehicles[0].model_copy(update={"twin_tyre_distance_m": (0.0, 0.33)})
    site.write_text(site_toml(paper.model_copy(update={"vehicles": (unlike,)})))
    assert validate("--site", site, "--validations", tmp_path / "certificates") == 0
    _, line = capsys.readouterr().err.splitlines()
    assert "truck-1 on bridge-1: axles follow different paths; computing 2-D road surfaces" in line


def test_one_pair_may_be_asked_for(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "certificates"
    chosen = ("--truck", "truck-2", "--bridge", "bridge-1")
    assert validate("--site", site, "--validations", folder, *chosen) == 0
    assert capsys.readouterr().out.startswith("truck-2 on bridge-1: passed")
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--truck", "truck-9"), "--truck: is truck-9, {site} has only truck-1, truck-2"),
        (("--bridge", "b"), "--bridge: is b, {site} has only bridge-1, bridge-2"),
        (("--json", "x.json"), "--json: only with --method"),
        (("--scenarios", "1"), "--scenarios: only with --method"),
        (("--noise", "25"), "--noise: only with --method"),
        (("--method", "pre", "--truck", "truck-1"), "--truck: only with --site, no --method"),
        (("--validations", "{site}"), "{site}: cannot be created as a folder"),
    ],
)
def test_bad_input_is_one_line(
    site: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    words: str,
) -> None:
    given = [argument.format(site=site) for argument in arguments]
    where = () if "--validations" in given else ("--validations", tmp_path / "c")
    if "--method" in given:
        where = ()
    assert validate("--site", site, *given, *where) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"driveby: {words.format(site=site)}")
    assert error.count("\n") == 1
    assert not (tmp_path / "c").exists()


def test_without_a_site_there_is_nothing_to_certify(capsys: pytest.CaptureFixture[str]) -> None:
    assert validate("--bridge", "bridge-1") == 2
    assert "--bridge: only with --site" in capsys.readouterr().err
