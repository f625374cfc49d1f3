"""Completion, by the shells themselves."""

import shutil
import subprocess
from pathlib import Path

import pytest

from services.cli import main as cli

ASK = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _driveby
printf '%s\\n' "${COMPREPLY[@]}"
"""


def script_for(shell: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    with pytest.raises(SystemExit) as end:
        cli.main(["--print-completion", shell])
    assert end.value.code == 0
    path = folder / "completion"
    path.write_text(capsys.readouterr().out)
    return path


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_the_shell_takes_it(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = script_for(shell, tmp_path, capsys)
    done = subprocess.run([shell, "-n", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["re"], {"recover", "replay", "report"}),
        (["identify", "--me"], {"--method"}),
        (["identify", "--method", ""], {"pre", "least-squares", "random-walk"}),
        (["identify", "a.mcap", "--method", "l"], {"least-squares"}),
        (["--verbose", "view", "--w"], {"--web"}),
        (["--log-format", "j"], {"json"}),
        (["identify", ""], set()),  # then the shell completes names of files
        (["export", "x.mcap", "--to", "d"], set()),
    ],
)
def test_words_are_completed(
    words: list[str],
    expected: set[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    script = script_for("bash", tmp_path, capsys)
    command = ["bash", "-c", ASK, "bash", str(script), "driveby", *words]
    output = subprocess.run(command, capture_output=True, text=True, check=True)
    assert set(output.stdout.split()) == expected, output.stderr


def test_every_command_and_option_is_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--print-completion", "bash"])
    text = capsys.readouterr().out
    parser = cli.whole_parser()
    (commands,) = (a.choices for a in parser._actions if a.dest == "==SUPPRESS==" and a.choices)
    for name, one in commands.items():
        (line,) = (row for row in text.splitlines() if row.strip().startswith(f"{name}) words="))
        assert {o for a in one._actions for o in a.option_strings} == set(
            line.split("words=")[1].removesuffix(" ;;").strip("'").split()
        )


def test_another_shell_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--print-completion", "fish"]) == 2
    assert "bash" in capsys.readouterr().err
