"""`driveby validate`: which options go with which kind of validation, and where it runs."""

import argparse
from dataclasses import fields
from pathlib import Path

import pytest

from services.cli import main as cli
from services.cli.commands import validate
from services.simulation.effects import EFFECTS
from services.simulation.survey_kinds import KINDS
from services.simulation.validation_options import (
    IntervalOptions,
    ScenarioOptions,
    SiteValidationOptions,
    SurveyOptions,
)

COMMON = {
    "handler", "parser", "version", "print_completion", "verbose", "log_format", "debug", "method",
}  # fmt: skip
STUDIES = (ScenarioOptions, IntervalOptions, SurveyOptions)
VALUES = {
    "--effects": "swing",
    "--figures": "figures",
    "--json": "out.json",
    "--kinds": "twin",
    "--noise": "25",
    "--page": "page.md",
    "--records": "records.jsonl",
    "--scenarios": "6",
    "--truth": "folder",
}
"""Values that are no number; other options take 7."""


def parsed(*arguments: str) -> argparse.Namespace:
    return cli._parser().parse_args(["validate", *arguments])


def options_of(kind: type) -> set[str]:
    return {field.name for field in fields(kind)}


def only_in_studies() -> list[str]:
    names = set.union(*map(options_of, STUDIES)) - options_of(SiteValidationOptions)
    return sorted(f"--{name.replace('_', '-')}" for name in names)


def test_every_option_belongs_to_a_kind_of_validation() -> None:
    known = set.union(*map(options_of, (SiteValidationOptions, *STUDIES)))
    assert set(vars(parsed())) - COMMON == known


@pytest.mark.parametrize("option", only_in_studies())
def test_certificates_refuse_an_option_of_the_studies(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, option: str
) -> None:
    site = ["--site", str(tmp_path / "site.toml")]
    assert cli.main(["validate", *site, option, VALUES.get(option, "7")]) == 2
    assert capsys.readouterr().err == (
        f"driveby: {option}: only with --method; it has no effect here, leave it out\n"
    )


@pytest.mark.parametrize("method", [[], ["--method", "paper"], ["--method", "pre"]])
@pytest.mark.parametrize("option", ["--truck", "--bridge", "--validations"])
def test_a_study_refuses_an_option_of_certificates(
    capsys: pytest.CaptureFixture[str], method: list[str], option: str
) -> None:
    assert cli.main(["validate", *method, option, "x"]) == 2
    assert f"{option}: only with --site, no --method" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [[], ["--method", "paper"], ["--method", "pre"], ["--method", "pre", "--surveys", "3"]],
)
def test_without_a_checkout_a_study_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    arguments: list[str],
) -> None:
    monkeypatch.setattr(validate, "_CHECKOUT", tmp_path)
    assert cli.main(["validate", *arguments]) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.startswith("driveby: driveby validate runs from a checkout")
    assert error.count("\n") == 1


def test_all_and_some_names_are_taken() -> None:
    everything = parsed("--effects", "all", "--kinds", "all")
    assert (everything.effects, everything.kinds) == (EFFECTS, tuple(KINDS))
    assert parsed("--kinds", "twin, steady,twin").kinds == ("twin", "steady")


def test_truth_is_sought_next_to_the_checkout_from_any_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, project: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert parsed().truth == project.parent / "shared/crossings"


def test_named_truth_that_is_no_folder_is_refused_in_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    nowhere = tmp_path / "nowhere"
    assert cli.main(["validate", "--method", "pre", "--truth", str(nowhere)]) == 2
    assert capsys.readouterr().err == (
        f"driveby: --truth: {nowhere} is not a folder, name one with crossings\n"
    )
