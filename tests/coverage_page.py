"""The page of branch coverage: `make coverage` writes it.

python -m tests.coverage_page build/coverage/coverage.json studies/coverage.md
"""

import json
import platform
import sys
from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

LISTED = 20
HEAD = """# Coverage

Branch coverage of the default tests, written by `make coverage`; do not edit by hand. Commands
that tests start as processes count. Compiled kernels do not: a selection of tests runs them once
more as Python (`NUMBA_DISABLE_JIT=1`).

| Python | coverage.py | date |
| --- | --- | --- |
| {python} | {version} | {date} |
"""


class Counts(NamedTuple):
    """Statements and branches of a module or a room, and how many of them ran."""

    statements: int = 0
    ran: int = 0
    branches: int = 0
    taken: int = 0

    @property
    def missing(self) -> int:
        return self.statements - self.ran + self.branches - self.taken

    @property
    def percent(self) -> float:
        return 100 - 100 * self.missing / max(1, self.statements + self.branches)


def counts_of(summary: dict[str, Any]) -> Counts:
    names = ("num_statements", "covered_lines", "num_branches", "covered_branches")
    return Counts(*(summary[name] for name in names))


def together(some: list[Counts]) -> Counts:
    return Counts(*(sum(values) for values in zip(*some, strict=True)))


def room_of(path: str) -> str:
    """Return the folder of a module, two levels deep: services/bus, pre_core/crossing."""
    return "/".join(Path(path).parent.parts[:2])


def row(name: str, counts: Counts, *more: str) -> str:
    cells = (name, f"{counts.percent:.1f} %", str(counts.statements), str(counts.branches), *more)
    return f"| {' | '.join(cells)} |"


def page(report: dict[str, Any], date: str) -> str:
    """Return the page of a report that `coverage json` wrote."""
    files = {path: counts_of(one["summary"]) for path, one in report["files"].items()}
    rooms: dict[str, list[Counts]] = defaultdict(list)
    for path, counts in files.items():
        rooms[room_of(path)].append(counts)
    python, version = platform.python_version(), report["meta"]["version"]
    lines = [HEAD.format(python=python, version=version, date=date)]
    lines += ["| folder | covered | statements | branches |", "| --- | ---: | ---: | ---: |"]
    lines += [row(f"`{name}`", together(some)) for name, some in sorted(rooms.items())]
    lines.append(row("all", together(list(files.values()))))
    lines += ["", f"## The {LISTED} least covered modules", ""]
    lines.append("| module | covered | statements | branches | lines that did not run |")
    lines.append("| --- | ---: | ---: | ---: | --- |")
    least = sorted(files, key=lambda path: (files[path].percent, path))[:LISTED]
    for path in least:
        missing = ranges(report["files"][path]["missing_lines"])
        lines.append(row(f"`{path}`", files[path], missing))
    return "\n".join(lines) + "\n"


def ranges(numbers: list[int]) -> str:
    """Return numbers in ascending order as ranges: 1-3, 7."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in found)


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:])
    today = datetime.now(UTC).date().isoformat()
    target.write_text(page(json.loads(source.read_text()), today))
    print(f"{target}: written")
