"""Progress of work that takes longer than a second or two: a bar, or lines without a terminal.

The lines are log records, which only commands show (`configure_logging`).
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from services.common.log_lines import progress_log

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

_LINE_S: Final = 30.0
"""Shortest time between two lines in s; shorter work prints none."""
_SILENCE_S: Final = 300.0
"""Longest time between two lines in s."""
_MINUTES_FROM_S: Final = 90.0
"""Duration from which minutes are stated."""
_HOURS_FROM_S: Final = 5400.0
"""Duration from which hours are stated."""

Offset = Callable[[int], object]
"""Callback with the number of bytes read from a file."""


Steps = Callable[[int, int], object]
"""Callback with the number of completed and of all steps."""


Parts = Callable[[str, str, float], None]
"""Callback with the part of the work, its stage in words, and the completed fraction, 0 to 1."""


def no_progress(offset: int) -> None:
    """Ignore progress."""


def no_part_progress(name: str, stage: str, share: float) -> None:
    """Ignore progress of parts."""


def no_step_progress(done: int, steps: int) -> None:
    """Ignore progress in steps."""


def progress_bar(console: "Console") -> "Progress":
    """Return a bar with a description and the remaining time; without a terminal, sparse lines."""
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    class BarOrLines(Progress):
        """Bar on a terminal, lines elsewhere."""

        lines = _SparseLines()

        def update(self, task_id: TaskID, *args: Any, **kwargs: Any) -> None:
            """Update a task and, without a terminal, log a line if one is due."""
            super().update(task_id, *args, **kwargs)
            if self.disable:
                task = self.tasks[self.task_ids.index(task_id)]
                self.lines.add(task.description, task.completed, task.total)

    return BarOrLines(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


class _SparseLines:
    """Lines on the progress of one piece of work: more time between them the longer it takes."""

    def __init__(self) -> None:
        self._began = self._last = time.monotonic()
        self._first: float | None = None

    def add(self, description: str, completed: float, total: float | None) -> None:
        """Log the completed part of the work unless the last line is recent."""
        if self._first is None:  # what earlier runs have completed took no time of this one
            self._first = completed
        now = time.monotonic()
        passed_s = now - self._began
        if now - self._last < min(_SILENCE_S, max(_LINE_S, 0.1 * passed_s)):
            return
        self._last = now
        share = f", {100.0 * completed / total:.0f} %" if total else ""
        left = ""
        if total and completed > self._first:
            rest = (total - completed) / (completed - self._first)
            left = f", about {_duration(rest * passed_s)} left"
        progress_log.info("%s%s after %.0f s%s", description, share, passed_s, left)


def _duration(seconds: float) -> str:
    """Return a duration with two digits or fewer."""
    if seconds < _MINUTES_FROM_S:
        return f"{seconds:.0f} s"
    if seconds < _HOURS_FROM_S:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


def start_line(console: "Console", line: str) -> None:
    """Log what starts and how much it is, where there is no terminal for a bar."""
    if not console.is_terminal:
        progress_log.info("%s", line)


@contextlib.contextmanager
def steps_bar(
    description: str, console: "Console | None" = None, start: str | None = None
) -> Iterator[Steps]:
    """Yield a callback for a bar over steps of equal duration; on standard error by default.

    Without a terminal the first call logs the line `start`, whose `{steps}` are those still to do.
    """
    from rich.console import Console

    console = console or Console(stderr=True)
    with progress_bar(console) as bar:
        task = bar.add_task(description, total=None)
        line = start

        def show(done: int, steps: int) -> None:
            nonlocal line
            if line is not None:
                start_line(console, line.format(steps=steps - done))
                line = None
            bar.update(task, completed=done, total=max(1, steps))

        yield show


@contextlib.contextmanager
def parts_bar(description: str, parts: int, console: "Console | None" = None) -> Iterator[Parts]:
    """Yield a callback for a bar over parts of equal duration: "crossing 2 of 4: stage".

    It moves within a part too, and never back, because some work is restarted in another way. For
    an unknown number of `parts` (0) it shows activity, without a time.
    """
    from rich.console import Console

    with progress_bar(console or Console(stderr=True)) as bar:
        task = bar.add_task(description, total=parts or None)
        done: dict[str, float] = {}

        def show(part: str, stage: str, fraction: float) -> None:
            done[part] = max(done.get(part, 0.0), fraction)
            number = f"{description} {len(done)}" + (f" of {parts}" if parts else "")
            bar.update(task, description=f"{number}: {stage}", completed=sum(done.values()))

        yield show


@contextlib.contextmanager
def reading_bar(
    description: str, paths: Sequence[Path], console: "Console | None" = None
) -> Iterator[Callable[[], Offset]]:
    """Yield a callback for a bar over all bytes of files in order; on standard error by default.

    Call it at the beginning of each file, in their order.
    """
    from rich.console import Console

    sizes = [path.stat().st_size if path.is_file() else 0 for path in paths]
    with progress_bar(console or Console(stderr=True)) as bar:
        task = bar.add_task(description, total=max(1, sum(sizes)))
        begun: list[int] = []

        def next_file() -> Offset:
            before = sum(begun)
            begun.append(sizes[len(begun)])

            def show(offset: int) -> None:
                bar.update(task, completed=before + offset)

            return show

        yield next_file
