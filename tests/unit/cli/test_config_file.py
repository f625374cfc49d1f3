"""A configuration file sets options of a service; the command line overrides it."""

from pathlib import Path
from typing import Any

import pytest

from services.cli import main as cli

_LOGGER = 'realm = ["sim-a", "sim-b"]\nrotate_minutes = 5\ninsecure = true\nmin_free = 800.5\n'


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "config.toml"
    path.write_text(_LOGGER)
    return path


def parsed(*arguments: object) -> Any:
    return cli._parser().parse_args([str(one) for one in arguments])


@pytest.mark.parametrize("is_joined", [True, False])
def test_options_are_those_of_the_file(config: Path, is_joined: bool) -> None:
    given = [f"--config={config}"] if is_joined else ["--config", config]
    options = parsed("logger", *given)
    assert options.realm == ["sim-a", "sim-b"]
    assert (options.rotate_minutes, options.min_free, options.insecure) == (5.0, 800.5, True)
    assert options.rotate_mb == 1000.0  # as without the file


@pytest.mark.parametrize("is_first", [True, False])
def test_command_line_overrides_the_file(config: Path, is_first: bool) -> None:
    of_file, given = ["--config", config], ["--realm=sim-c", "--rotate-minutes", "7"]
    options = parsed("logger", *(given + of_file if is_first else of_file + given))
    assert options.realm == ["sim-c"]
    assert options.rotate_minutes == 7.0
    assert options.min_free == 800.5


def test_command_line_overrides_an_alternative_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text('site = "site.toml"\nvalidate_first = true\n')
    assert parsed("worker", "--config", path).validate_first
    options = parsed("worker", "--config", path, "--skip-validation")
    assert options.skip_validation
    assert not options.validate_first
    assert options.site == Path("site.toml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("rotate_minute = 5", "rotate_minute: is unknown, did you mean rotate_minutes?"),
        ("connect = 5", "connect: is unknown, check its spelling or remove it"),
        ("folder = 5", 'folder: is 5, it must be a text in quotes: "5"'),
        ('realm = "Live"', "realm: 'Live' must be live, replay-NAME, sim-NAME or import-NAME"),
        ("realm = [7]", 'realm: is 7, it must be a text in quotes: "7"'),
        ('config = "x.toml"', "config: is unknown"),
        ('rotate_minutes = "x"', "rotate_minutes: is"),
        (
            'rotate_minutes = "5"',
            'rotate_minutes: is "5", it must be a number without quotes: 5',
        ),
        ("insecure = 1", "insecure: is 1, it must be true or false"),
        ('listen = ["a"]', "listen: is"),
        ("listen = true", "listen: is"),
        ('log_format = "xml"', "log_format: is"),
        ("realm = [", "line 1: is not TOML"),
    ],
)
def test_fault_of_the_file_is_one_line_with_its_key(
    config: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    config.write_text(text)
    assert cli.main(["logger", "--config", str(config)]) == cli.EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"driveby: {config}: {words}")


def test_missing_file_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["worker", "--config", str(tmp_path / "no.toml")]) == cli.EXIT_BAD_INPUT
    assert "no such file" in capsys.readouterr().err


def test_no_argument_names_no_file() -> None:
    assert parsed("logger").realm != ["sim-a", "sim-b"]
