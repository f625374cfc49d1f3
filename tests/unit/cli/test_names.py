"""Names that a file system does not take, or that no library can store: one line, exit code 2."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from services.cli import main as cli
from services.cli.completion import commands_of
from services.cli.main import whole_parser
from services.common.files import is_unicode, replaced_atomically, write_atomically

PROJECT = Path(__file__).parents[3]
EXAMPLE = PROJECT / "tests" / "data" / "csv_example"
SAMPLE = PROJECT / "recordings" / "sample" / "crossing.mcap"
LONG = "n" * 300
UNDECODABLE = os.fsdecode(b"r\xff")

NAME = "NAME"
SITE = str(EXAMPLE / "site.toml")
COMMANDS = {
    "survey": ["--site", NAME],
    "survey --json": ["--site", SITE, "--json", NAME],
    "check": [NAME],
    "check site": [f"{NAME}.toml"],
    "check --template": ["--template", NAME],
    "simulate": ["--scenario", "6", "-o", f"{NAME}.mcap"],
    "import": [NAME, "--site", SITE, "-o", "out.mcap"],
    "identify": [f"{NAME}.mcap"],
    "identify --into": [str(SAMPLE), "--into", NAME],
    "identify --figures": [str(SAMPLE), "--figures", NAME],
    "fuse": [f"{NAME}.json"],
    "history": ["--history", NAME],
    "history add": ["add", f"{NAME}.json"],
    "alarm": ["list", "--history", NAME],
    "info": [f"{NAME}.mcap"],
    "catalog": [NAME],
    "export": [str(SAMPLE), "--to", NAME],
    "report": [f"{NAME}.json"],
    "validate": ["--site", NAME],
    "recover": [f"{NAME}.mcap"],
    "recover -o": [str(SAMPLE), "-o", f"{NAME}.mcap"],
    "view": [f"{NAME}.mcap"],
    "truck": [f"{NAME}.mcap"],
    "replay": [f"{NAME}.mcap"],
    "worker": ["--site", NAME],
    "logger": ["--file", f"{NAME}.mcap"],
    "certs": [NAME],
    "demo": ["--out", NAME],
}


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    code = cli.main(arguments)
    err = capsys.readouterr().err
    assert code == 2, err
    assert err.count("\n") == 1, err
    assert "internal error" not in err
    return err


@pytest.mark.parametrize("name", COMMANDS)
def test_names_that_are_too_long_are_refused_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [one.replace(NAME, LONG) for one in COMMANDS[name]]
    err = refused(capsys, [name.split()[0], *arguments])
    assert "too long" in err or (name == "catalog" and "no such folder" in err)
    assert len(err) < 400
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "name",
    ["survey --json", "simulate", "identify --into", "identify --figures", "export", "recover -o"],
)
def test_outputs_with_names_that_are_no_text_are_refused(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [one.replace(NAME, UNDECODABLE) for one in COMMANDS[name]]
    assert "the name is not UTF-8" in refused(capsys, [name.split()[0], *arguments])
    assert list(tmp_path.iterdir()) == []


def test_inputs_with_names_that_are_no_text_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"{UNDECODABLE}.mcap"
    shutil.copy(SAMPLE, path)
    assert cli.main(["info", str(path)]) == 0
    assert "r\\udcff.mcap" in capsys.readouterr().out
    assert cli.main(["export", str(path), "--to", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert cli.main(["catalog", str(tmp_path)]) == 3
    assert "the name is not UTF-8; rename it" in capsys.readouterr().out


def test_a_text_with_a_name_that_is_no_text_is_written(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_atomically(path, f"<html>{UNDECODABLE}</html>")
    assert path.read_text() == "<html>r\\udcff</html>"
    assert is_unicode("Brücke")
    assert not is_unicode(UNDECODABLE)


def test_the_longest_name_can_be_written(tmp_path: Path) -> None:
    """The name that the file has meanwhile is no longer."""
    path = tmp_path / ("ü" * 125 + ".json")
    with replaced_atomically(path) as temporary:
        assert temporary.suffix == path.suffix
        temporary.write_text("{}")
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("option", ["--into", "--figures"])
def test_a_link_to_nothing_is_no_folder(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nothing")
    for folder in (link, link / "below"):
        err = refused(capsys, ["identify", str(SAMPLE), option, str(folder)])
        assert "cannot be created" in err
    assert not (tmp_path / "nothing").exists()


def test_a_working_directory_that_is_gone_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "gone"
    folder.mkdir()
    code = (
        f"import os, shutil, sys; sys.path.insert(0, {str(PROJECT)!r}); os.chdir({str(folder)!r});"
        f"shutil.rmtree({str(folder)!r}); from services.cli.main import main;"
        "sys.exit(main(['info', 'a.mcap']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "driveby: the working directory no longer exists, change to another one\n"


def test_help_has_no_two_groups_of_one_title() -> None:
    """Two groups called messages had log options in one and topics in the other."""
    for name, parser in commands_of(whole_parser()).items():
        titles = [group.title for group in parser._action_groups]
        assert len(titles) == len(set(titles)), name
