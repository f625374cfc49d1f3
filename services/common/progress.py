"""Progress bars for work that takes longer than a second or two."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

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
    """Return a bar with a description and the remaining time; invisible without a terminal."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


@contextlib.contextmanager
def steps_bar(description: str, console: "Console | None" = None) -> Iterator[Steps]:
    """Yield a callback for a bar over steps of equal duration; on standard error by default."""
    from rich.console import Console

    with progress_bar(console or Console(stderr=True)) as bar:
        task = bar.add_task(description, total=None)

        def show(done: int, steps: int) -> None:
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
