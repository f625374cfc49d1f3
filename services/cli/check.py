"""`driveby check`: what is wrong with truck, site file and recording, before it is too late."""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from services.cli.parsing import command

if TYPE_CHECKING:
    from services.inspection.inspect import Report


def add_check(commands: Any) -> None:
    """`driveby check`: look at a site file and at recordings before a survey."""
    p = command(
        commands,
        "check",
        _check,
        "say what is wrong with site file, sensors, receiver and place before a survey",
        "driveby check site.toml standstill.mcap trial.mcap",
    )
    p.add_argument(
        "paths",
        type=Path,
        nargs="+",
        metavar="SITE.toml|REC.mcap|DIR",
        help="a site file (default: the recordings' own), and recordings or folders of CSV "
        "files: a minute of standstill, or any drive",
    )
    p.add_argument("--json", action="store_true", help="everything, as JSON")


def _check(options: argparse.Namespace) -> int:
    from services.common.progress import reading_bar
    from services.inspection.inspect import inspect

    recordings = [path for path in options.paths if path.suffix != ".toml"]
    with reading_bar("looking", recordings) as next_file:
        found = list(inspect(options.paths, next_file))
    is_wrong = any(report.is_wrong for report in found)
    if options.json:
        content = {"is_wrong": is_wrong, "reports": [as_json(report) for report in found]}
        print(json.dumps(content, indent=1, ensure_ascii=False))
        return int(is_wrong)
    runs = sum(report.is_run for report in found)
    for report in found:
        print("\n".join(lines_of(report, is_brief=report.is_run and runs > 1)))
    wrong, left_open = (
        sum(finding.state.value == state for report in found for finding in report.findings)
        for state in ("wrong", "open")
    )
    print(
        f"{wrong} wrong, {left_open} open"
        if wrong or left_open
        else "nothing is known against a survey"
    )
    return int(is_wrong)


def lines_of(report: "Report", *, is_brief: bool) -> Iterator[str]:
    """A line for each finding; of what is in order only how many, where there are many runs."""
    yield report.source
    fine = 0
    for finding in report.findings:
        if is_brief and finding.state.value == "ok":
            fine += 1
            continue
        advice = f": {finding.advice}" if finding.advice else ""
        yield f"  {finding.state.value:5}  {finding.text}{advice}"
    if fine:
        yield f"  ok     {fine} others (--json has all)"


def as_json(report: "Report") -> dict[str, Any]:
    """One source and its findings."""
    return {
        "source": report.source,
        "findings": [
            {
                "name": finding.name,
                "state": finding.state.value,
                "text": finding.text,
                "advice": finding.advice or None,
            }
            for finding in report.findings
        ],
    }
