"""Print the known answers and measured orders that the tests of this folder compare, as Markdown.

    .venv/bin/python tests/numerics/table.py [--all]

runs the tests and prints, of every group of values, the one that comes worst off; with --all, all
of them. studies/forward-problem.md holds the output. The tests' own report goes to standard error,
and the exit code is theirs.
"""

import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from itertools import groupby
from pathlib import Path

import pytest

Row = tuple[str, float, float, float]


class Collector:
    """Gathers what the tests recorded, in the order in which they ran."""

    def __init__(self) -> None:
        self.rows: dict[str, list[Row]] = {"known answer": [], "measured": []}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call":
            for name, value in report.user_properties:
                if name in self.rows:
                    self.rows[name].append(value)  # type: ignore[arg-type]


def group(row: Row) -> str:
    return row[0].split(":")[0]


def relative(row: Row) -> float:
    return row[2] / row[1] - 1.0


def absolute(row: Row) -> float:
    return row[2] - row[1]


def worst_of_each_group(
    rows: list[Row], difference: Callable[[Row], float]
) -> list[tuple[Row, int]]:
    groups = [list(rows) for _, rows in groupby(sorted(rows, key=group), key=group)]
    order = {group(row): i for i, row in reversed(list(enumerate(rows)))}
    groups.sort(key=lambda members: order[group(members[0])])
    return [
        (max(members, key=lambda row: abs(difference(row)) / row[3]), len(members))
        for members in groups
    ]


def main() -> int:
    collector = Collector()
    with redirect_stdout(sys.stderr):
        code = pytest.main([str(Path(__file__).parent), "-q"], plugins=[collector])
    known, measured = collector.rows["known answer"], collector.rows["measured"]
    every = "--all" in sys.argv[1:]
    print("| known answer (of how many) | known | ours | relative difference | allowed |")
    print("| --- | ---: | ---: | ---: | ---: |")
    rows = [(row, 1) for row in known] if every else worst_of_each_group(known, relative)
    for row, count in rows:
        what = row[0] if count == 1 else f"{row[0]} ({count})"
        print(f"| {what} | {row[1]:.6g} | {row[2]:.6g} | {relative(row):.1e} | {row[3]:.0e} |")
    print()
    print("| measured (of how many) | expected | ours | difference | allowed |")
    print("| --- | ---: | ---: | ---: | ---: |")
    rows = [(row, 1) for row in measured] if every else worst_of_each_group(measured, absolute)
    for row, count in rows:
        what = row[0] if count == 1 else f"{row[0]} ({count})"
        print(f"| {what} | {row[1]:g} | {row[2]:.4g} | {absolute(row):.1e} | {row[3]:.2g} |")
    return int(code)


if __name__ == "__main__":
    sys.exit(main())
