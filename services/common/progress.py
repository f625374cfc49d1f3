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


Parts = Callable[[str, str, float], None]
"""Is told which part of the work, its stage in words, and how much of it is done, 0 to 1."""


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
def parts_bar(description: str, parts: int, console: "Console | None" = None) -> Iterator[Parts]:
    """A bar over parts of work that each take about as long: "crossing 2 of 4: stage".

    It moves within a part too, and never back, for some work is begun again in another way. Where
    it is not known how many `parts` there are (0) it shows that something is done, and no time.
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
