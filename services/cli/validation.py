"""The command for studies of the method's accuracy: validate."""

import argparse
import sys
from collections.abc import Callable
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final, TypeVar

from services.cli.parsing import (
    CERTIFICATES,
    SCENARIOS,
    a_console,
    add_certificates,
    add_noise,
    add_output_file,
    add_output_folder,
    add_seed,
    add_site,
    command,
    option_of,
    scenario,
)
from services.common.errors import InputError
from services.common.kinds import AIMS_JSON, RECORDS, VALIDATION_JSON, VALIDATION_PAGE
from services.common.options import OutputFile, names, whole
from services.simulation.effects import EFFECTS
from services.simulation.survey_kinds import KINDS
from services.simulation.validation_options import (
    CertificateOptions,
    IntervalOptions,
    ScenarioOptions,
    SurveyOptions,
)


def _scenarios(text: str) -> tuple[int, ...]:
    if text == "all":
        return tuple(SCENARIOS)
    return tuple(dict.fromkeys(scenario(part.strip()) for part in text.split(",")))


_CHECKOUT: Final = Path(__file__).parents[2]
_Options = TypeVar("_Options", CertificateOptions, ScenarioOptions, IntervalOptions, SurveyOptions)
_OF_CERTIFICATES: Final = frozenset(field.name for field in fields(CertificateOptions))
_OF_METHODS: Final = frozenset(
    field.name
    for kind in (ScenarioOptions, IntervalOptions, SurveyOptions)
    for field in fields(kind)
)


def _some_of(known: tuple[str, ...]) -> Callable[[str], tuple[str, ...]]:
    """Take all or some of the known names, each once."""

    def parse(text: str) -> tuple[str, ...]:
        if text == "all":
            return known
        for name in names(text):
            if name not in known:
                raise argparse.ArgumentTypeError(
                    f'is "{text}", it must be all or some of {", ".join(known)}'
                )
        return tuple(dict.fromkeys(names(text)))

    return parse


def add_validate(commands: Any) -> None:
    """Add `driveby validate`: compare simulated crossings with the truth and the paper."""
    p = command(
        commands,
        "validate",
        _validate,
        "identify simulated crossings and compare them with the truth and the paper",
        "driveby validate --scenarios 1,6,12 --noise 25 --json validation.json",
    )
    p.add_argument(
        "--scenarios",
        type=_scenarios,
        default=tuple(SCENARIOS),
        metavar="all|1,6,12",
        help="scenarios of the paper (default: all)",
    )
    add_noise(p, "accelerometers' noise density in µg/√Hz (default: 0)")
    add_site(
        p,
        "truck and bridge (default: those of the paper); without --method: makes a certificate "
        "for every pair of them (exit code 1 if one fails)",
    )
    text = "JSON file of the table"
    add_output_file(p, "--json", "OUT.json", text, VALIDATION_JSON, AIMS_JSON)
    add_output_folder(p, "--figures", "folder for figures")
    p.add_argument(
        "--particles",
        type=whole("particles", 1),
        default=500,
        help="number of particles (default: 500)",
    )
    p.add_argument(
        "--steps", type=whole("steps", 1), default=600, help="number of steps (default: 600)"
    )
    add_seed(p)
    p.add_argument(
        "--method",
        choices=("paper", "pre"),
        help="paper: its search and least squares, without sensors; pre: is its uncertainty true "
        "(exit code 1 if an aim is missed; the options below) (default: paper, and with --site "
        "neither, but certificates)",
    )
    of_site = p.add_argument_group("certificates of --site, see docs/worker.md")
    of_site.add_argument(
        "--truck", metavar="ID", help="identifier of the only vehicle to validate (default: each)"
    )
    of_site.add_argument(
        "--bridge", metavar="ID", help="identifier of the only bridge to validate (default: each)"
    )
    add_certificates(of_site, f"folder for certificates (default: {CERTIFICATES})")
    _add_options_of_pre(p)
    p.add_argument(
        "--processes",
        type=whole("processes", 1, 256),
        default=2,
        help="number of processes (default: 2)",
    )
    add_output_file(p, "--page", "PAGE.md", "Markdown page of the findings", VALIDATION_PAGE)


def _add_options_of_pre(p: argparse.ArgumentParser) -> None:
    """Add the options that only `--method pre` has."""
    p.add_argument(
        "--crossings",
        type=whole("a number of crossings", 0),
        default=200,
        help="number of crossings whose truth is drawn from the priors (default: 200)",
    )
    p.add_argument(
        "--control",
        type=whole("a number of crossings", 0),
        default=20,
        help="number of them repeated with half the noise declared (default: 20)",
    )
    p.add_argument(
        "--out-of-model",
        type=whole("a number of crossings", 0),
        default=0,
        help="number of crossings for each out-of-model effect (default: 0)",
    )
    p.add_argument(
        "--effects",
        type=_some_of(EFFECTS),
        default=EFFECTS,
        metavar="all|swing,friction,…",
        help=f"of {', '.join(EFFECTS)} (default: all)",
    )
    p.add_argument(
        "--records",
        type=OutputFile((RECORDS,)),
        default=Path("build/worlds.jsonl"),
        metavar="FILE.jsonl",
        help="file of finished crossings of --out-of-model and --surveys, which are not run again "
        "(default: build/worlds.jsonl)",
    )
    p.add_argument(
        "--surveys",
        type=whole("a number of surveys", 0),
        default=0,
        help="number of fused surveys, of 8 to 16 crossings, for each of --kinds; nothing else "
        "is run then (default: 0)",
    )
    p.add_argument(
        "--kinds",
        type=_some_of(tuple(KINDS)),
        default=tuple(KINDS),
        metavar="all|twin,steady,…",
        help=f"of {', '.join(KINDS)} (default: all)",
    )
    p.add_argument(
        "--truth",
        type=Path,
        default=Path("../shared/crossings"),
        metavar="DIR",
        help="folders of crossings with a truth.json (default: ../shared/crossings)",
    )


def _validate(options: argparse.Namespace) -> int:
    if options.site is not None and options.method is None:
        from services.cli.validate_site import validate_site_command

        _refuse(options, _OF_METHODS - _OF_CERTIFICATES, "only with --method")
        options.validations = options.validations or CERTIFICATES
        return validate_site_command(_taken(CertificateOptions, options), a_console())
    _refuse(options, _OF_CERTIFICATES - _OF_METHODS, "only with --site, no --method")
    code: int
    if options.method == "pre" and options.surveys:
        run_surveys = _study("validation.run_surveys")
        code = run_surveys.run(_taken(SurveyOptions, options), a_console())
    elif options.method == "pre":
        run_intervals = _study("validation.run_intervals")
        code = run_intervals.run(_taken(IntervalOptions, options), a_console())
    else:
        paper = _study("paper.run")
        code = paper.run(_taken(ScenarioOptions, options), a_console())
    return code


def _refuse(options: argparse.Namespace, others: frozenset[str], what: str) -> None:
    """Raise InputError if an option of another kind of validation was given."""
    for action in options.parser._actions:
        if action.dest in others and getattr(options, action.dest) != action.default:
            raise InputError(
                f"{option_of(action.dest)}: {what}, it has nothing to do with what is asked for"
            )


def _taken(kind: type[_Options], options: argparse.Namespace) -> _Options:
    """Return the options of one kind of validation."""
    return kind(**{field.name: getattr(options, field.name) for field in fields(kind)})


def _study(module: str) -> ModuleType:
    """Import a module of the checkout's studies; InputError where there is no checkout."""
    if not (_CHECKOUT / "studies").is_dir():
        raise InputError(
            "driveby validate runs from a checkout of the source only; the installed program has "
            "the validation of a site: --site SITE.toml without --method"
        )
    if str(_CHECKOUT) not in sys.path:
        sys.path.insert(0, str(_CHECKOUT))
    return import_module(f"studies.{module}")
