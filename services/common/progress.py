"""The bar of all work that takes longer than a second or two."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

Offset = Callable[[int], object]
"""Is told how many bytes of a file have been read."""


Steps = Callable[[int, int], object]
"""Is told how many of how many steps have been done."""


def unwatched(offset: int) -> None:
    """For who does not want to know."""


def unwatched_steps(done: int, steps: int) -> None:
    """For who does not want to know either."""


def progress_bar(console: "Console") -> "Progress":
    """A bar with a description and the time that is left; nothing where there is no terminal."""
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
    """A bar over steps of which each takes about as long; on standard error by default."""
    from rich.console import Console

    with progress_bar(console or Console(stderr=True)) as bar:
        task = bar.add_task(description, total=None)

        def show(done: int, steps: int) -> None:
            bar.update(task, completed=done, total=max(1, steps))

        yield show


@contextlib.contextmanager
def reading_bar(
    description: str, paths: Sequence[Path], console: "Console | None" = None
) -> Iterator[Callable[[], Offset]]:
    """A bar over all bytes of files that are read one after another; on standard error by default.

    What is yielded is called at the beginning of each file, in their order.
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
