"""The command `driveby check`: faults of truck, site file and recording before a survey."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from services.cli.parser import Subcommand
from services.common.naming import count_of
from services.common.options import flag, opt, output_option, positional, site_option

if TYPE_CHECKING:
    from services.inspection.inspect import CheckReport


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Options of `driveby check`: what to check before a survey."""

    paths: tuple[Path, ...] = positional(
        "a site file (default: the recordings' own), and recordings or folders of CSV "
        "files: a minute at standstill, or any drive",
        Path,
        nargs="*",
        metavar="SITE.toml|REC.mcap|DIR",
    )
    site: Path | None = site_option("site file (.toml) to check, which may also be an argument")
    template: Path | None = output_option(
        "write a commented site file to start from, and check nothing", "NEW.toml"
    )
    truck: str | None = opt(
        "with --template: fill in springs, dampers, axle masses and tyres of a typical "
        "two-axle lorry, with spreads of 30 %%",
        choices=("lorry-single", "lorry-twin"),
    )
    json: bool = flag("print all findings as JSON")


def _check(options: CheckOptions) -> int:
    from services.common.errors import InputError
    from services.common.files import check_writable, write_atomically
    from services.common.progress import reading_bar
    from services.inspection.finding import without_repetition
    from services.inspection.inspect import inspect

    paths = options.paths if options.site is None else (options.site, *options.paths)
    if options.site is not None and options.site.suffix != ".toml":
        raise InputError(f"--site: {options.site} is not a .toml file")
    if options.template is not None:
        from services.inspection.template import TEMPLATE, template_of
        from services.simulation.usual_trucks import usual_lorry

        if paths:
            raise InputError(f"--template: checks nothing, give {paths[0]} without it")
        if options.template.exists():
            raise InputError(f"{options.template}: exists, give the name of a new site file")
        check_writable(options.template)
        kind = options.truck
        text = template_of(usual_lorry(kind.removeprefix("lorry-"))) if kind else TEMPLATE
        write_atomically(options.template, text)
        print(f"{options.template}: fill it in, then driveby check {options.template}")
        return 0
    if options.truck is not None:
        raise InputError("--truck: fills in a new site file, give --template NEW.toml")
    if not paths:
        raise InputError("a site file or recordings are expected, or --template NEW.toml")
    for path in paths:
        if path.suffix == ".toml":
            _raise_on_faults(path, wants_json=options.json)
    recordings = [path for path in paths if path.suffix != ".toml"]
    with reading_bar("checking", recordings) as next_file:
        found = list(inspect(paths, next_file))
    is_wrong = any(report.is_wrong for report in found)
    if options.json:
        _print_json(found)
        return int(is_wrong)
    runs = sum(report.is_run for report in found)
    for report in found:
        print("\n".join(lines_of(report, is_brief=report.is_run and runs > 1)))
    states = [one.state.value for report in found for one in without_repetition(report.findings)]
    wrong, left_open = states.count("wrong"), states.count("open")
    print(
        f"{wrong} wrong, {left_open} open"
        if wrong or left_open
        else "nothing is wrong or open; driveby survey forecasts what a survey would detect"
    )
    return int(is_wrong)


def _raise_on_faults(path: Path, *, wants_json: bool) -> None:
    """Raise InputError for an unreadable site file; print several faults before."""
    from schemas.site_file import faults_of_site, read_site_text
    from services.common.errors import InputError
    from services.inspection.finding import CheckFinding, CheckStatus
    from services.inspection.inspect import CheckReport

    faults = faults_of_site(read_site_text(path), str(path))
    if not faults:
        return
    if len(faults) == 1:
        raise InputError(faults[0])
    texts = [fault.removeprefix(f"{path}: ") for fault in faults]
    report = CheckReport(
        str(path),
        tuple(CheckFinding("site_file", CheckStatus.WRONG, text) for text in texts),
        is_run=False,
    )
    if wants_json:
        _print_json([report])
    else:
        print("\n".join(lines_of(report, is_brief=False)))
    raise InputError(f"{path}: {len(faults)} values are wrong; nothing else was checked")


def _print_json(reports: "list[CheckReport]") -> None:
    is_wrong = any(report.is_wrong for report in reports)
    content = {"is_wrong": is_wrong, "reports": [as_json(report) for report in reports]}
    print(json.dumps(content, indent=1, ensure_ascii=False))


def lines_of(report: "CheckReport", *, is_brief: bool) -> Iterator[str]:
    """Yield a line for each finding on all its channels; of many runs only those not in order."""
    from services.inspection.finding import without_repetition

    yield report.source
    shown = [one for one in report.findings if not is_brief or one.state.value != "ok"]
    fine = len(report.findings) - len(shown)
    for finding in without_repetition(shown):
        advice = f"; {finding.advice}" if finding.advice else ""
        yield f"  {finding.state.value:5}  {finding.text}{advice}"
    if fine:
        yield f"  ok     {count_of(fine, 'other finding')} (--json has all)"


def as_json(report: "CheckReport") -> dict[str, Any]:
    """Return one source and its findings."""
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


COMMAND: Final = Subcommand(
    CheckOptions,
    "driveby check site.toml standstill.mcap trial.mcap",
    _check,
)
