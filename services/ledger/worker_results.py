"""Results files of all runs of workers in a folder."""

from collections.abc import Callable, Iterator
from pathlib import Path

from schemas.results import Results, load_results
from services.common.errors import InputError


def files_of_workers(folder: Path, ending: str = "json") -> list[Path]:
    """Return the results of all runs of workers in a folder, in the order of the runs."""
    return sorted(folder.glob(f"results-*.{ending}"))


def results_of_workers(folder: Path, problem: Callable[[str], object]) -> Iterator[Results]:
    """Yield the results of each run; `problem` is called with a line for each unreadable file."""
    for path in files_of_workers(folder):
        try:
            yield load_results(path)
        except InputError as error:
            problem(str(error))
