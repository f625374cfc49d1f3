"""`driveby replay` on a terminal of its own, with keys that are really typed."""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from schemas.topics import Key
from services.recordings.recording import read_messages
from tests.builders.commands import run
from tests.process_replay.starting import End, Start, start_logger
from tests.waiting import LONGEST_S

pytestmark = pytest.mark.process

# A terminal around a command: what is written to it is typed, what it shows is what comes out.
_ON_A_TERMINAL = "import os, pty, sys; sys.exit(os.waitstatus_to_exitcode(pty.spawn(sys.argv[1:])))"


def replay(recording: Path, endpoint: str, *options: str) -> list[str]:
    common = ("--endpoint", endpoint, "--name", "x", *options)
    return [sys.executable, "-m", "services", "replay", str(recording), *common]


class OnATerminal:
    """A command on a terminal."""

    def __init__(self, command: list[str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", _ON_A_TERMINAL, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        self.seen = ""

    def type(self, keys: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(keys.encode())

    def shows(self, pattern: str) -> re.Match[str]:
        """Read on until the pattern has come; pytest's own limit guards against a hang."""
        assert self.process.stdout is not None
        raw = b""
        while (found := re.search(pattern, self.seen)) is None:
            piece = self.process.stdout.read(4096)
            assert piece, self.seen
            raw += piece
            self.seen += raw.decode("utf-8", errors="ignore")
            raw = b"" if raw.decode("utf-8", errors="ignore").encode() == raw else raw[-3:]
        self.seen = self.seen[found.end() :]
        return found

    def ends(self) -> int:
        self.process.communicate(timeout=LONGEST_S)
        return self.process.returncode


Begin = Callable[[list[str]], OnATerminal]


@pytest.fixture
def on_a_terminal() -> Iterator[Begin]:
    """Commands on terminals; all are ended with the test."""
    begun: list[OnATerminal] = []

    def begin(command: list[str]) -> OnATerminal:
        begun.append(OnATerminal(command))
        return begun[-1]

    yield begin
    for one in begun:
        one.process.kill()
        one.process.communicate()


def test_steps_and_quits_by_the_keys(
    start: Start,
    terminate: End,
    on_a_terminal: Begin,
    endpoint: str,
    recording: Path,
    tmp_path: Path,
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "again.mcap")
    shown = on_a_terminal(replay(recording, endpoint, "--paused"))
    shown.shows("realm replay-x: space pause")
    shown.shows("⏸ 1×  0:00.0 / .* 0 messages")
    for number in range(1, 4):
        shown.type("s")
        shown.shows(rf"⏸ 1×.* {number} messages")
    shown.type("+")
    shown.shows("⏸ 2×")
    shown.type("n")
    shown.shows("no crossing ahead")
    shown.type("q")
    shown.shows("3 messages published in realm replay-x: accel 1, gnss 1, info 1")
    shown.shows("a logger has them on disk")
    assert shown.ends() == 0
    terminate(logger)
    first = [m.payload for m in read_messages(recording)][:3]
    assert [m.payload for m in read_messages(tmp_path / "again.mcap")] == first


def test_goes_on_after_a_pause_and_plays_to_the_end(
    start: Start,
    terminate: End,
    on_a_terminal: Begin,
    endpoint: str,
    recording: Path,
    tmp_path: Path,
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "again.mcap")
    shown = on_a_terminal(replay(recording, endpoint, "--paused", "--speed", "50"))
    shown.shows("⏸")
    shown.type(" ")
    shown.shows("▶ 50×")
    shown.shows("401 messages published")
    assert shown.ends() == 0
    terminate(logger)
    assert len(list(read_messages(tmp_path / "again.mcap"))) == 401


def test_where_there_is_no_terminal_there_are_the_statistics_and_nothing_else(
    start: Start, terminate: End, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "again.mcap")
    chosen = ("--start", "2", "--duration", "4", "--topics", "accel,info", "--rename")
    done = subprocess.run(
        replay(recording, endpoint, "--speed", "0", *chosen, "truck-1=truck-9"),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=True,
    )
    terminate(logger)
    lines = done.stdout.splitlines()
    assert lines[0] == "81 messages published in realm replay-x: accel 80, info 1"
    assert re.fullmatch(r"4\.0 s of the drive in [\d.]+ s, [\d,.]+ times real speed", lines[1])
    assert lines[2:] == ["trucks: truck-9", "a logger has them on disk"]
    assert done.stderr == ""
    again = list(read_messages(tmp_path / "again.mcap"))
    wanted = [m for m in read_messages(recording) if m.key.stream in ("accel", "info")]
    chosen_ones = [wanted[0], *wanted[41:121]]
    assert [m.payload for m in again] == [m.payload for m in chosen_ones]
    assert {m.key for m in again} == {
        Key("replay-x", "vehicle", "truck-9", stream) for stream in ("accel", "info")
    }


def test_a_loop_is_logged_once_and_ends_with_a_signal(
    start: Start,
    terminate: End,
    on_a_terminal: Begin,
    endpoint: str,
    recording: Path,
    tmp_path: Path,
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "again.mcap")
    shown = on_a_terminal(replay(recording, endpoint, "--loop", "--speed", "10"))
    # The second time it begins anew: the clock goes back.
    shown.shows(r"0:0[5-9]\.\d / ")
    shown.shows(r"0:0[0-4]\.\d / ")
    shown.type("\x03")  # Ctrl-C
    found = shown.shows(r"(\d+) messages published in realm replay-x")
    assert int(found[1]) > 401
    shown.shows(r"\d+ rounds")
    assert shown.ends() == 0
    terminate(logger)
    assert len(list(read_messages(tmp_path / "again.mcap"))) == 401


def test_a_loop_keeps_the_pause_and_the_speed_of_the_round_before(
    start: Start, on_a_terminal: Begin, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    start_logger(start, endpoint, tmp_path / "again.mcap")
    first_two = ("--duration", "0.07", "--topics", "accel")
    shown = on_a_terminal(replay(recording, endpoint, "--loop", "--paused", *first_two))
    shown.shows("⏸ 1×.* 0 messages")
    for key, line in (("+", "⏸ 2×.* 0 messages"), ("s", "⏸ 2×.* 1 messages"), ("s", "2 messages")):
        shown.type(key)
        shown.shows(line)
    assert shown.shows(r"([⏸▶] [^ ]+)[^\r]* 0 messages")[1] == "⏸ 2×"
    shown.type("q")
    assert shown.ends() == 0


def test_a_damaged_file_in_a_folder_gives_what_is_intact(
    start: Start, terminate: End, endpoint: str, recording: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "drives"
    folder.mkdir()
    whole = recording.read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.mcap").touch()
    intact = sum(1 for _ in read_messages(folder / "cut.mcap"))
    assert 0 < intact < 401
    logger = start_logger(start, endpoint, tmp_path / "again.mcap")
    done = subprocess.run(
        replay(folder, endpoint, "--speed", "0"), capture_output=True, text=True, check=True
    )
    terminate(logger)
    assert f"{intact} messages published" in done.stdout
    assert "cut.mcap: damaged, only its intact chunks are replayed" in done.stderr
    assert "empty.mcap: is empty; an MCAP recording is expected; skipped" in done.stderr
    assert len(list(read_messages(tmp_path / "again.mcap"))) == intact


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--start", "11"], "--start: is 11, but the drive lasts 9.9 s"),
        (["--vehicle", "truck-2"], '"truck-2" is not in the recording'),
        (["--paused"], "--paused: cannot be resumed"),
        (["--start", "1", "--end", "1"], "it must be later than the start"),
    ],
)
def test_impossible_request_is_refused_before_any_query(
    capsys: pytest.CaptureFixture[str], recording: Path, options: list[str], words: str
) -> None:
    nowhere = ("--endpoint", "tcp/127.0.0.1:1", "--name", "x")
    done = run(capsys, "replay", recording, *nowhere, *options)
    assert done.code == 2
    assert words in done.err
    assert done.err.count("\n") == 1


def test_nothing_is_published_again_in_the_realm_that_was_recorded(
    capsys: pytest.CaptureFixture[str],
    start: Start,
    terminate: End,
    endpoint: str,
    recording: Path,
    tmp_path: Path,
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "again.mcap")
    fast = ("--endpoint", endpoint, "--name", "x", "--speed", "0")
    assert run(capsys, "replay", recording, *fast).code == 0
    terminate(logger)
    done = run(capsys, "replay", tmp_path / "again.mcap", *fast)
    assert done.code == 2
    assert "realm replay-x is the one that was recorded" in done.err
