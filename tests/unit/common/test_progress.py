"""Bars: what they are told, and that they are seen on a terminal only."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from services.common.progress import reading_bar
from services.drives.signals import signals_of_recording
from services.drives.survey import survey
from services.recordings.recovery import recover_recording
from services.recordings.writer import write_recording
from services.viewer.view import convert
from tests.unit.drives.recorded import drive


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "r.mcap"
    write_recording(path, drive(), site_toml=None, reason="test")
    return path


@pytest.mark.parametrize("work", ["survey", "signals", "recover", "view"])
def test_what_reads_a_recording_tells_how_far_it_is(recording: Path, work: str) -> None:
    told: list[int] = []
    out = recording.with_name("out")
    match work:
        case "survey":
            survey(recording, progress=told.append)
        case "signals":
            signals_of_recording(recording, told.append)
        case "recover":
            recover_recording(recording, out.with_suffix(".mcap"), progress=told.append)
        case "view":
            convert(recording, out.with_suffix(".rrd"), progress=told.append)
    assert told == sorted(set(told))
    assert len(told) > 5
    assert 0.8 * recording.stat().st_size < told[-1] <= recording.stat().st_size


def test_a_bar_goes_over_all_files(tmp_path: Path) -> None:
    files = [tmp_path / "a", tmp_path / "b"]
    for file in files:
        file.write_bytes(bytes(100))
    shown = io.StringIO()
    terminal = Console(file=shown, force_terminal=True, width=80, color_system=None)
    with reading_bar("reading", files, terminal) as next_file:
        first = next_file()
        first(100)
        second = next_file()
        second(50)
    # Three quarters of a bar of 40 characters, when it is drawn at last.
    last = [line for line in shown.getvalue().split("\r") if "reading" in line][-1]
    assert last.count("━") == 30
    assert ":" in last  # the time that is left


def test_nothing_is_seen_where_there_is_no_terminal(tmp_path: Path) -> None:
    shown = io.StringIO()
    with reading_bar("reading", [tmp_path / "missing"], Console(file=shown)) as next_file:
        next_file()(10)
    assert shown.getvalue() == ""
