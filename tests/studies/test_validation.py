"""`driveby validate`: what it prints, writes and refuses, and the paper's answers in small."""

import io
import json
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from rich.console import Console

from pre_core.paper import experiment
from pre_core.search.loop import Termination
from schemas.site_file import site_toml
from services.cli import main as cli
from services.common.errors import InputError
from services.simulation.drive import paper_site
from services.simulation.validation_options import ScenarioOptions
from studies.paper.run import print_table
from studies.paper.run import run as run_paper
from studies.paper.scenarios import (
    DERIVED,
    NAMES,
    Cloud,
    Scenario,
    compare_with_paper,
    run_scenario,
)
from studies.paper.tables import tables_of_paper

SOUND = experiment.beam(np.ones(experiment.ELEMENTS))


def run(
    scenario: int, *, particles: int = 500, steps: int = 600, noise: float = 0.0, seed: int = 0
) -> Scenario:
    asked = ScenarioOptions(
        scenarios=(scenario,),
        noise=noise,
        seed=seed,
        site=None,
        particles=particles,
        steps=steps,
        json=None,
        figures=None,
    )
    return run_scenario(scenario, experiment.TRUCK, SOUND, asked)


def command(
    width: int = 80,
    scenarios: tuple[int, ...] = (6,),
    noise: float = 0.0,
    json_path: Path | None = None,
    figures: Path | None = None,
    site: Path | None = None,
) -> list[str]:
    """Lines of a very short run."""
    out = io.StringIO()
    asked = ScenarioOptions(
        scenarios=scenarios,
        noise=noise,
        json=json_path,
        figures=figures,
        seed=0,
        site=site,
        particles=8,
        steps=2,
    )
    code = run_paper(asked, Console(file=out, width=width))
    assert code == 0
    return out.getvalue().splitlines()


# What is printed and written


@pytest.mark.parametrize("noise", [0.0, 25.0])
def test_table_fits_80_columns_with_one_line_for_each_parameter(noise: float) -> None:
    lines = command(80, (6, 12), noise)
    assert max(len(line) for line in lines) <= 80
    head, *rows = lines[:42]
    assert head.split() == [
        *("scenario", "parameter", "truth", "paper", "S_A", "random", "walk", "S_A", "ours", "S_A")
    ]
    words = [row.split() for row in rows if row.strip()]
    assert [(row[0], row[1]) for row in words] == [(n, name) for n in ("6", "12") for name in NAMES]
    assert {len(row) for row in words} == {3 + 3 + 1 + 3 + 1 + 2}  # "mean ± std" is three words
    assert not any("…" in line for line in lines)


def test_a_walk_that_went_astray_still_fits() -> None:
    """With the noise of a real sensor the particles take all load off the front axle."""
    found = run(6, particles=8, steps=2, noise=25.0)
    astray = dict.fromkeys(NAMES, 3.52)
    walk = found.random_walk._replace(
        mean=astray, accuracy={name: 1.0 - abs(3.52 - found.truth[name]) for name in NAMES}
    )
    out = io.StringIO()
    print_table(Console(file=out, width=80), [found._replace(random_walk=walk)], published=True)
    lines = out.getvalue().splitlines()
    assert max(len(line) for line in lines) <= 80
    assert "…" not in out.getvalue()
    assert " -1.5 " in next(line for line in lines if " EI_1 " in line)


def test_table_shows_truth_and_paper_where_they_belong() -> None:
    row = next(line.split() for line in command(120, (6,)) if " EI_4 " in line)
    assert row[:7] == ["6", "EI_4", "0.40", "0.54", "±", "0.13", "0.86"]  # Tables 3, 7 and 8
    assert row[-2:] == ["0.4000", "1.0000"]


def test_missing_convergence_is_reported() -> None:
    lines = command(noise=25.0)
    assert f"scenario 6, ours: {Termination.STEPS_EXHAUSTED.value}" in lines
    assert not any("did not converge" in line for line in command())


def test_json_has_the_keys_and_names_of_the_papers_tables(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    command(scenarios=(6, 12), json_path=path)
    scenarios = json.loads(path.read_text())["scenarios"]
    assert set(scenarios) == {"6", "12"}
    names = set(tables_of_paper()["table8_accuracy_S_A"])
    for number, found in scenarios.items():
        truth = dict.fromkeys(names, 1.0)
        truth |= {
            f"EI_{e}": ratio
            for e, ratio in enumerate(tables_of_paper()["table3_scenarios_EI_ratio"][number], 1)
        }
        for method in ("least_squares", "random_walk"):
            accuracy, mean = found[method]["S_A"], found[method]["mean"]
            assert set(accuracy) == set(mean) == names
            for name in names:
                assert accuracy[name] == pytest.approx(1.0 - abs(mean[name] - truth[name]))
        assert set(found["random_walk"]["std"]) == names
        assert min(found["least_squares"]["S_A"].values()) >= 0.999


def test_figures_are_written_for_every_scenario(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    command(scenarios=(6, 12), figures=folder)
    written = {path.name: path.read_bytes()[:8] for path in folder.iterdir()}
    assert set(written) == {"scenario-06.png", "scenario-12.png", "scenarios.png"}
    assert set(written.values()) == {b"\x89PNG\r\n\x1a\n"}


def test_a_site_of_ones_own_is_not_compared_with_the_paper(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text(site_toml(paper_site()))
    lines = command(site=path)
    assert not any(word in line for line in lines for word in ("paper", "Table 7"))
    row = next(line.split() for line in lines if " EI_4 " in line)
    assert (row[:3], row[-2:]) == (["6", "EI_4", "0.40"], ["0.4000", "1.0000"])


def test_a_damping_of_exactly_zero_is_no_unknown(tmp_path: Path) -> None:
    site = paper_site()
    bridge = site.bridges[0].model_copy(update={"rayleigh_alpha_per_s": 0.0})
    path = tmp_path / "site.toml"
    path.write_text(site_toml(site.model_copy(update={"bridges": (bridge,)})))
    lines = command(site=path)
    assert len([line for line in lines if line.lstrip().startswith("6 ")]) == 19
    assert not any(" alpha " in line for line in lines)
    assert "S_A ≥ 0.999 in 19 of 19" in "\n".join(lines)


# What is refused, before minutes of work


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    begun = AssertionError("begun")
    with (
        mock.patch("studies.paper.run.run_scenario", side_effect=begun),
        mock.patch("studies.validation.run_intervals.run_parts", side_effect=begun),
    ):
        code = cli.main(["validate", *arguments])
    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert err.startswith("driveby: ")
    assert err.count("\n") == 1
    return err


def test_bad_input_is_one_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert '"13"' in refused(capsys, "--scenarios", "6,13")
    assert "does not exist" in refused(capsys, "--json", str(tmp_path / "no" / "out.json"))
    file = tmp_path / "file"
    file.touch()
    assert "cannot be created as a folder" in refused(capsys, "--figures", str(file))
    assert "cannot be created as a folder" in refused(capsys, "--figures", str(file / "below"))
    for method, picture in (("paper", "scenarios.png"), ("pre", "calibration.png")):
        (tmp_path / method / picture).mkdir(parents=True)
        figures = ("--figures", str(tmp_path / method), "--worlds", "0")
        message = refused(capsys, "--method", method, *figures)
        assert f"{picture}: is a folder" in message
    site = paper_site()
    shorter = site.bridges[0].model_copy(
        update={"elements": 5, "nominal_flexural_rigidity_nm2": (1.56e10,) * 5}
    )
    path = tmp_path / "site.toml"
    path.write_text(site_toml(site.model_copy(update={"bridges": (shorter,)})))
    message = refused(capsys, "--method", "paper", "--site", str(path))
    assert f"{path}: bridge {shorter.id} has 5 elements" in message


def test_a_json_that_cannot_be_written_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a folder"):
        command(json_path=tmp_path)


# The comparison with Table 7


def clouds_of_paper() -> dict[int, Cloud]:
    rows = tables_of_paper()["table7_normalised_estimates"]
    return {
        number: Cloud(
            {name: rows[name]["mean"][number - 1] for name in NAMES},
            {name: rows[name]["std"][number - 1] for name in NAMES},
            {},
            np.empty((0, len(NAMES))),
        )
        for number in experiment.SCENARIOS
    }


def test_the_paper_agrees_with_itself_and_a_cell_that_is_off_is_counted() -> None:
    clouds = clouds_of_paper()
    assert compare_with_paper(clouds) == {"cells": 216, "mean": 216, "std": 216}
    clouds[6].mean["EI_4"] += 0.081
    clouds[6].std["EI_4"] += 0.059
    clouds[7].std["rhoA"] -= 0.061
    clouds[8].mean["m_s1"] += 1.0  # follows the road: left out
    assert compare_with_paper(clouds) == {"cells": 216, "mean": 215, "std": 215}


# The reproduction


def test_the_prior_is_the_papers_with_masses_that_follow() -> None:
    found = run(1, particles=200, steps=1)
    prior = dict(zip(found.names, found.prior.T, strict=True))
    assert found.names == NAMES
    for name in NAMES:
        if name not in DERIVED:
            assert 0.8 <= prior[name].min() < 0.82 < 1.18 < prior[name].max() <= 1.2
    # m_s1 goes with d_2 = D - d_1, of which d_1 is 28 %: the prior of m_s1 is narrower.
    assert np.ptp(prior["m_s1"]) < 0.25
    assert np.ptp(prior["m_s2"]) > 0.38


def test_picture_of_scenarios_6_and_12_in_small() -> None:
    """The paper's figures 11 and 16c with a fifth of its particles."""
    six, twelve = (run(number, particles=100).random_walk for number in (6, 12))
    assert six.mean["EI_4"] < 0.65  # Table 7: 0.54, truth 0.4
    assert six.mean["EI_3"] < 0.97  # 0.79, truth 1
    assert six.mean["EI_5"] < 0.97  # 0.81, truth 1
    assert twelve.mean["EI_7"] > 0.85  # 0.92, truth 0.4: not found
    assert twelve.mean["EI_4"] == pytest.approx(1.0, abs=0.1)  # 1.03
    close = compare_with_paper({6: six, 12: twelve})
    # 100 particles know their standard deviation to 7 % and more: fewer cells than in full.
    assert close["std"] >= 0.75 * 36
    assert close["mean"] >= 0.75 * 36


def test_a_random_walk_of_few_steps_does_not_reproduce_the_paper() -> None:
    """The counts above must be able to fail: after 20 steps the particles are still spread wide."""
    clouds = {n: run(n, particles=100, steps=20).random_walk for n in (6, 12)}
    assert clouds[6].mean["EI_4"] > 0.65
    assert compare_with_paper(clouds)["std"] < 0.75 * 36


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_the_paper_in_full() -> None:
    found = [run(number) for number in experiment.SCENARIOS]
    close = compare_with_paper({scenario.number: scenario.random_walk for scenario in found})
    assert close["cells"] == 216
    assert close["std"] >= 195
    assert close["mean"] >= 190
    accuracies = [a for scenario in found for a in scenario.least_squares.accuracy.values()]
    assert len(accuracies) == 240
    assert min(accuracies) >= 0.999
    six, twelve = found[5].random_walk, found[11].random_walk
    assert 0.4 < six.mean["EI_4"] < 0.65
    assert max(six.mean["EI_3"], six.mean["EI_5"]) < 0.95
    assert twelve.mean["EI_7"] > 0.85
