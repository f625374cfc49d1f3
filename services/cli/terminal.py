"""Terminal control of a replay: keys, and a status line."""

import contextlib
import logging
import os
import select
import shutil
import signal
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from typing import Final

from services.replay.drive import ReplayDrive
from services.replay.player import Command, Controls, Status

KEYS: Final = {
    " ": Command.PAUSE,
    "s": Command.STEP,
    "\x1b[C": Command.STEP,
    "+": Command.FASTER,
    "\x1b[A": Command.FASTER,
    "-": Command.SLOWER,
    "\x1b[B": Command.SLOWER,
    "n": Command.NEXT_CROSSING,
    "q": Command.QUIT,
}
HELP: Final = "space pause · s step · + - speed · n next crossing · q quit"
_ERASE = "\r\x1b[K"
_BAR_CELLS: Final = 24
_FEWEST_CELLS: Final = 6
"""Fewest cells of a useful bar."""


def has_terminal() -> bool:
    """Return whether there is a user with keys: in the foreground, with terminals at both ends."""
    try:
        both = sys.stdin.isatty() and sys.stdout.isatty()
        return both and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except (OSError, ValueError):
        return False


@contextlib.contextmanager
def terminal(realm: str, drive: ReplayDrive, stop: threading.Event) -> Iterator[Controls]:
    """Read keys and show the status line; restore the terminal at the end."""
    waiting = bytearray()

    def wait(seconds: float) -> Command | None:
        if not stop.is_set() and not waiting and select.select([descriptor], [], [], seconds)[0]:
            waiting.extend(os.read(descriptor, 1024))
        return Command.QUIT if stop.is_set() else _next_command(waiting)

    def show(status: Status) -> None:
        width = shutil.get_terminal_size().columns
        sys.stdout.write(_ERASE + status_line(drive, status, width - 1))
        sys.stdout.flush()

    descriptor = sys.stdin.fileno()
    print(f"realm {realm}: {HELP}")
    with _pressed_at_once(descriptor), _log_on_lines_of_its_own():
        try:
            yield Controls(wait, show)
        finally:
            sys.stdout.write(_ERASE)
            sys.stdout.flush()


def status_line(drive: ReplayDrive, status: Status, width: int) -> str:
    """Return the status line: ▶ 10×  0:12.3 / 0:35.9  ━━━◆━━━────◇──  crossing 1 of 2.

    It has at most `width` columns: the bar is shortened first, as the words are more useful.
    """
    begin_ns, end_ns = drive.window
    length_s = (end_ns - begin_ns) * 1e-9
    at_s = min(max(0.0, (status.position_ns - begin_ns) * 1e-9), length_s)
    speed = "max" if status.speed == 0.0 else f"{status.speed:g}×"
    parts = [
        f"{'⏸' if status.is_paused else '▶'} {speed}",
        f"{_clock(at_s)} / {_clock(length_s)}",
    ]
    if drive.crossings_ns:
        begun = sum(entry_ns <= status.position_ns for entry_ns in drive.crossings_ns)
        parts.append(f"crossing {begun} of {len(drive.crossings_ns)}")
    parts.append(status.note or f"{status.sent} messages")
    cells = min(_BAR_CELLS, width - len("  ".join(["", *parts])))
    if cells >= _FEWEST_CELLS:
        parts.insert(2, _bar(at_s / length_s if length_s > 0.0 else 1.0, drive, cells))
    return "  ".join(parts)[:width]


def _bar(share: float, drive: ReplayDrive, length: int) -> str:
    begin_ns, end_ns = drive.window
    done = round(share * length)
    cells = ["━" if cell < done else "─" for cell in range(length)]
    for entry_ns in drive.crossings_ns:
        cell = (entry_ns - begin_ns) * length // max(1, end_ns - begin_ns)
        cells[cell] = "◆" if cell < done else "◇"
    return "".join(cells)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60.0)
    hours, minutes = divmod(int(minutes), 60)
    return f"{hours}:{minutes:02d}:{rest:04.1f}" if hours else f"{minutes}:{rest:04.1f}"


def _next_command(pressed: bytearray) -> Command | None:
    """Remove and return the next command from the keys; ignore keys without a meaning."""
    while pressed:
        text = pressed.decode("latin-1")
        key = next((key for key in KEYS if text.lower().startswith(key.lower())), None)
        if key is not None:
            del pressed[: len(key)]
            return KEYS[key]
        # No part of an unknown sequence that begins with Escape may count as a key.
        del pressed[: len(text) if text[0] == "\x1b" else 1]
    return None


@contextlib.contextmanager
def _pressed_at_once(descriptor: int) -> Iterator[None]:
    """Receive keys without Enter and echo; also after a stop by Ctrl-Z."""
    before = termios.tcgetattr(descriptor)

    def again(*_: object) -> None:
        tty.setcbreak(descriptor, termios.TCSANOW)

    again()
    continued = signal.signal(signal.SIGCONT, again)
    try:
        yield
    finally:
        signal.signal(signal.SIGCONT, continued)
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


@contextlib.contextmanager
def _log_on_lines_of_its_own() -> Iterator[None]:
    """Write log messages on lines of their own, not behind the status line."""

    def erase(record: logging.LogRecord) -> bool:
        sys.stdout.write(_ERASE)
        sys.stdout.flush()
        return True

    handlers = logging.getLogger().handlers[:]
    for handler in handlers:
        handler.addFilter(erase)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(erase)
