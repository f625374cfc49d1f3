"""Keys and the line of a replay."""

import logging
import os
import pty
import re
import signal
import sys
import termios
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.cli import terminal
from services.cli.commands.replay import summary
from services.replay.choice import ReplayWindow
from services.replay.drive import ReplayDrive
from services.replay.player import Command, Status
from services.replay.run import ReplayStatistics

S = 1_000_000_000
DRIVE = ReplayDrive((), {}, ReplayWindow(100 * S, 160 * S), (110 * S, 140 * S), ())


def status(at_s: float, speed: float = 1.0, *, paused: bool = False, note: str = "") -> Status:
    return Status(round((100.0 + at_s) * S), speed, paused, 42, note)


def test_the_line_says_where_it_is() -> None:
    line = terminal.status_line(DRIVE, status(15.0, 2.0), 99)
    assert line.startswith("▶ 2×  0:15.0 / 1:00.0  ━━━━◆━──────")
    assert line.endswith("crossing 1 of 2  42 messages")
    bar = line.split("  ")[2]
    assert len(bar) == 24
    assert [bar.index(mark) for mark in "◆◇"] == [4, 16]
    paused = terminal.status_line(DRIVE, status(0.0, 0.0, paused=True, note="no more"), 99)
    assert paused.startswith("⏸ max  0:00.0 / 1:00.0  ────◇")
    assert paused.endswith("crossing 0 of 2  no more")


def test_where_columns_are_few_the_bar_gives_way_and_the_words_stay() -> None:
    day = ReplayDrive((), {}, ReplayWindow(0, 29_008 * S), (3 * S, 28_000 * S), ())
    at_rest = Status(60 * S, 10.0, is_paused=True, sent=10_255, note="no crossing ahead")
    wide, narrow, tiny = (terminal.status_line(day, at_rest, width) for width in (99, 79, 64))
    assert [len(line.split("  ")[2]) for line in (wide, narrow)] == [24, 16]
    assert [narrow.count(mark) for mark in "◆◇"] == [0, 2]
    assert all(line.endswith("crossing 1 of 2  no crossing ahead") for line in (wide, narrow, tiny))
    assert len(narrow) == 79
    assert "─" not in tiny
    assert len(terminal.status_line(day, at_rest, 20)) == 20


def test_the_bar_is_full_at_the_end_and_never_fuller() -> None:
    for at_s in (60.0, 900.0):
        line = terminal.status_line(DRIVE, status(at_s), 99)
        assert "1:00.0 / 1:00.0" in line
        assert line.count("━") == 22
    hour = ReplayDrive((), {}, ReplayWindow(0, 3700 * S), (), ())
    assert "1:01:40.0" in terminal.status_line(hour, status(0.0), 99)
    assert "crossing" not in terminal.status_line(hour, status(0.0), 99)
    nothing = ReplayDrive((), {}, ReplayWindow(5, 6), (5,), ())
    assert "◆" in terminal.status_line(nothing, status(0.0), 99)


def test_the_pace_counts_neither_silence_that_was_passed_over_nor_jumps() -> None:
    of_all = ReplayStatistics(
        "replay-x", {"accel": 9}, (), 1, 1800.0, 4.0, 0, 0.0, is_confirmed=True
    )
    assert summary(of_all)[1] == "1800.0 s of the drive in 4.00 s, 450 times real speed"
    lines = summary(of_all._replace(skipped_s=1760.0))
    assert lines[1] == "1800.0 s of the drive in 4.00 s, 10 times real speed"
    assert "1760.0 s of silence skipped" in lines
    lines = summary(of_all._replace(jumped_over=7))
    assert lines[1] == "1800.0 s of the drive in 4.00 s"
    assert "7 messages left out by jumps" in lines


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A terminal at standard input; what is written to the descriptor is typed."""
    person, ours = pty.openpty()
    with os.fdopen(ours, "r") as keyboard:
        monkeypatch.setattr(sys, "stdin", keyboard)
        yield person
    os.close(person)


def commands(typed: int, keys: bytes, stop: threading.Event) -> list[Command | None]:
    with terminal.terminal("replay-x", DRIVE, stop) as controls:
        os.write(typed, keys)
        found = []
        while (command := controls.wait(2.0 if not found else 0.0)) is not None:
            found.append(command)
            if stop.is_set():
                break
    return found


def test_every_key_is_understood_and_others_do_nothing(
    typed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = b" sS\x1b[C+\x1b[A-\x1b[BnxN"
    assert commands(typed, keys, threading.Event()) == [
        Command.PAUSE, Command.STEP, Command.STEP, Command.STEP, Command.FASTER, Command.FASTER,
        Command.SLOWER, Command.SLOWER, Command.NEXT_CROSSING, Command.NEXT_CROSSING,
    ]  # fmt: skip
    assert commands(typed, b"\x1b[5~q", threading.Event()) == []  # Page up is not a q behind it
    assert commands(typed, b"q", threading.Event()) == [Command.QUIT]
    assert terminal.HELP in capsys.readouterr().out


def test_a_signal_is_a_wish_to_quit(typed: int) -> None:
    stop = threading.Event()
    stop.set()
    assert commands(typed, b" ", stop) == [Command.QUIT]


def test_the_terminal_is_left_as_it_was(typed: int, capsys: pytest.CaptureFixture[str]) -> None:
    descriptor = sys.stdin.fileno()
    before, handler = termios.tcgetattr(descriptor), signal.getsignal(signal.SIGCONT)

    def echoes() -> bool:
        return bool(termios.tcgetattr(descriptor)[3] & termios.ECHO)

    def use() -> None:
        with terminal.terminal("replay-x", DRIVE, threading.Event()) as controls:
            assert not echoes()
            termios.tcsetattr(descriptor, termios.TCSANOW, before)  # as a shell does after Ctrl-Z
            os.kill(os.getpid(), signal.SIGCONT)
            assert not echoes()
            controls.show(status(15.0))
            logging.getLogger("x").warning("beside it")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        use()
    assert termios.tcgetattr(descriptor) == before
    assert signal.getsignal(signal.SIGCONT) == handler
    assert all(not h.filters for h in logging.getLogger().handlers)
    out = capsys.readouterr().out
    assert out.endswith("\r\x1b[K")
    assert re.search(r"▶ 1×.*42 messages\r\x1b\[K", out)


def test_without_a_terminal_at_both_ends_there_is_none(
    typed: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert not terminal.has_terminal()  # pytest takes standard output
    with (tmp_path / "out").open("w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert not terminal.has_terminal()
