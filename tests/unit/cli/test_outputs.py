"""No output replaces an input, or a file of another kind: every option of every command."""

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.cli import main as cli
from services.common.errors import InputError
from services.common.files import check_writable, write_atomically
from services.common.kinds import RESULTS, Kind, family_of
from services.common.options import OutputFile, folder_here, source
from services.common.outputs import add_input, declared

PROJECT = Path(__file__).parents[3]
EXAMPLE = PROJECT / "tests" / "data" / "csv_example"
SAMPLE = PROJECT / "recordings" / "sample" / "crossing.mcap"

READ = "READ"
"""Stands for a file that the command reads."""
OUTPUTS: dict[tuple[str, str], list[str]] = {
    ("catalog", "--csv"): [".", "--site", READ],
    ("check", "--template"): [],
    ("fuse", "--json"): [READ],
    ("history", "--csv"): ["bridge-1"],
    ("history", "--json"): ["bridge-1"],
    ("history", "--rrd"): ["bridge-1"],
    ("identify", "--draws"): [str(SAMPLE), "--site", READ],
    ("identify", "--json"): [str(SAMPLE), "--site", READ],
    ("identify", "--rrd"): [str(SAMPLE), "--site", READ],
    ("import", "--output"): [str(EXAMPLE), "--site", READ, "--force"],
    ("import", "--picture"): [str(EXAMPLE), "--site", READ],
    ("import", "--write-map"): [str(EXAMPLE), "--site", READ],
    ("logger", "--file"): ["--site", READ],
    ("recover", "--output"): [READ, "--force"],
    ("report", "--output"): ["results.json", "--site", READ],
    ("simulate", "--output"): ["--scenario", "6", "--site", READ, "--force"],
    ("survey", "--figure"): ["--site", READ],
    ("survey", "--json"): ["--site", READ],
    ("validate", "--json"): ["--method", "pre", "--site", READ],
    ("validate", "--page"): ["--method", "pre", "--site", READ],
    ("validate", "--records"): ["--method", "pre", "--out-of-model", "1", "--site", READ],
    ("worker", "--file"): ["--site", READ],
}
FOLDERS = {
    ("demo", "--out"), ("export", "--to"), ("history", "--figures"), ("identify", "--figures"),
    ("identify", "--into"), ("validate", "--figures"),
}  # fmt: skip
READS = {
    "--site", "--baseline", "--tls", "--validations", "--history", "--truth", "--temperature",
    "--recordings", "--folder", "--spool", "--map", "--config",
}  # fmt: skip
"""Options with a path that no file is put to by its own name."""

SITE = (EXAMPLE / "site.toml").read_bytes()
OTHERS = {
    "site file": SITE,
    "package": b'{"name": "x", "version": "1.0.0"}\n',
    "table": b"time_s,sprung_front,sprung_rear\n0,1,2\n",
    "picture": b"\x89PNG\r\n\x1a\n" + bytes(50),
    "pdf": b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n",
    "key": b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n",
    "notes": "Brücke\n".encode(),
    "binary": b"\x00\xff\x01\xfe" * 10,
}
SAME_FAMILY = {
    ("import", "--picture"): {"picture"},
    ("survey", "--figure"): {"picture"},
    ("validate", "--records"): {"package"},
}


def commands() -> dict[str, argparse.ArgumentParser]:
    parser = cli.whole_parser()
    (found,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return dict(found.choices)


def paths_of(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.Action]]:
    for action in parser._actions:
        if action.type in (Path, folder_here, source) or isinstance(action.type, OutputFile):
            yield max(action.option_strings, key=len, default=""), action


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    assert cli.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err


def test_every_option_with_a_path_says_what_it_is_for() -> None:
    found: dict[type | str, set[tuple[str, str]]] = {"output": set(), "folder": set()}
    for name, parser in commands().items():
        for option, action in paths_of(parser):
            if isinstance(action.type, OutputFile):
                found["output"].add((name, option))
            elif action.type is folder_here:
                found["folder"].add((name, option))
            else:
                assert option == "" or option in READS, (name, option)
    assert found == {"output": set(OUTPUTS), "folder": FOLDERS}


def another_path(kind: str, path: Path) -> Path:
    other = path.with_name("other")
    if kind == "link":
        other.symlink_to(path)
    elif kind == "hard link":
        os.link(path, other)
    elif kind == "folder that is a link":
        other.symlink_to(path.parent, target_is_directory=True)
        return other / path.name
    else:
        return path.parent / ".." / path.parent.name / path.name
    return other


@pytest.mark.parametrize("kind", ["path", "link", "hard link", "folder that is a link"])
@pytest.mark.parametrize(("command", "option"), OUTPUTS)
def test_an_output_is_never_an_input(
    command: str, option: str, kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    read = tmp_path / "site.toml"
    read.write_bytes(SITE)
    arguments = [str(read) if one == READ else one for one in OUTPUTS[command, option]]
    err = refused(capsys, [command, *arguments, option, str(another_path(kind, read))])
    assert str(tmp_path) in err
    if READ in OUTPUTS[command, option] and (command, option) != ("worker", "--file"):
        assert "is read by this command" in err
    assert read.read_bytes() == SITE


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize(("command", "option"), OUTPUTS)
def test_an_output_replaces_no_file_of_another_kind(
    command: str, option: str, other: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    if other in SAME_FAMILY.get((command, option), ()):
        pytest.skip("files of this family are its own")
    monkeypatch.chdir(tmp_path)
    read = tmp_path / "site.toml"
    read.write_bytes(SITE)
    there = tmp_path / "there.out"
    there.write_bytes(OTHERS[other])
    arguments = [str(read) if one == READ else one for one in OUTPUTS[command, option]]
    err = refused(capsys, [command, *arguments, option, str(there)])
    assert str(there) in err
    assert there.read_bytes() == OTHERS[other]


def test_two_outputs_have_two_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    for other in (out, tmp_path / "." / "out", tmp_path / "none" / ".." / "out"):
        arguments = ["identify", str(SAMPLE), "--json", str(out), "--rrd", str(other)]
        assert "two outputs" in refused(capsys, arguments)


def test_a_baseline_that_a_site_file_names_is_an_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Results would replace results: the kind alone does not show it."""
    site, stored = tmp_path / "site.toml", tmp_path / "base.json"
    text = SITE.decode()
    site.write_text(text.replace("[bridge]", '[bridge]\nbaseline = "base.json"'))
    content = '{"program": "driveby"}\n'
    stored.write_text(content)
    arguments = ["identify", str(SAMPLE), "--site", str(site), "--json", str(stored)]
    assert "is read by this command" in refused(capsys, arguments)
    assert stored.read_text() == content


def test_inputs_are_forgotten_when_a_command_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("{}")
    with pytest.raises(InputError), declared([path], [path]):
        pass
    with declared([path], []), pytest.raises(InputError):
        write_atomically(path, "{}")
    with declared([], [path]), pytest.raises(InputError):
        add_input(path)
    write_atomically(path, "[]")
    assert path.read_text() == "[]"


@pytest.mark.parametrize("new", ['{"program": 1}\n', "a,b\n", "<svg></svg>", b"%PDF-1.7", ""])
def test_no_writer_replaces_a_site_file(tmp_path: Path, new: str | bytes) -> None:
    path = tmp_path / "site.toml"
    for content in (SITE, b"# a comment\n" * 4000 + SITE, b"\xef\xbb\xbf" + SITE):
        path.write_bytes(content)
        with pytest.raises(InputError, match="is a site file, and none is replaced"):
            write_atomically(path, new)
        write_atomically(path, content)  # the same text is no loss
        assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("there", ["picture", "pdf", "package"])
def test_no_writer_replaces_a_file_of_another_family(tmp_path: Path, there: str) -> None:
    path = tmp_path / "out"
    path.write_bytes(OTHERS[there])
    with pytest.raises(InputError, match="would be replaced by"):
        write_atomically(path, "<!DOCTYPE html>\n<html></html>\n")
    assert path.read_bytes() == OTHERS[there]


def test_a_file_of_its_kind_is_replaced_and_so_is_an_empty_one(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    for content in ("", '{"program": 1}', '\ufeff{\n "program": 2}'):
        path.write_text(content)
        check_writable(path, kinds=(RESULTS,))
    path.write_text('{"crossings": []}')
    with pytest.raises(InputError, match='a JSON file that begins with "crossings", and only a r'):
        check_writable(path, kinds=(RESULTS,))


def test_text_that_is_cut_within_a_character_is_text() -> None:
    assert family_of("a,Brü".encode()[:-1]) == "a text file"
    assert family_of(b"\xfc" * 8) == "a file of an unknown kind"
    assert not Kind("", "a text file").matches(b"\xfc" * 8)


def test_an_export_keeps_the_site_file_of_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And writes nothing at all, not even the tables before it."""
    for path in EXAMPLE.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    err = refused(capsys, ["export", str(SAMPLE), "--to", str(tmp_path)])
    assert "site.toml: is a site file" in err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
