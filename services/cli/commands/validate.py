"""The command `driveby validate`: simulated crossings compared with the truth and the paper."""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Final, TypeVar

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.common.errors import InputError
from services.common.kinds import AIMS_JSON, RECORDS, VALIDATION_JSON, VALIDATION_PAGE
from services.common.options import (
    CERTIFICATES,
    SCENARIOS,
    count_option,
    names,
    noise_option,
    opt,
    option_of,
    output_folder_option,
    output_option,
    scenario,
    seed_option,
    site_option,
    validations_folder,
    validations_option,
)
from services.simulation.effects import EFFECTS
from services.simulation.survey_kinds import KINDS
from services.simulation.validation_options import (
    IntervalOptions,
    ScenarioOptions,
    SiteValidationOptions,
    SurveyOptions,
)

_CHECKOUT: Final = Path(__file__).parents[3]
_TRUTHS: Final = _CHECKOUT.parent / "shared/crossings"
_Options = TypeVar(
    "_Options", SiteValidationOptions, ScenarioOptions, IntervalOptions, SurveyOptions
)
_OF_SITE_VALIDATION: Final = frozenset(field.name for field in fields(SiteValidationOptions))
_OF_METHODS: Final = frozenset(
    field.name
    for kind in (ScenarioOptions, IntervalOptions, SurveyOptions)
    for field in fields(kind)
)


_OF_SITE: Final = "site validation of --site, see docs/worker.md"
_KINDS: Final = tuple(KINDS)


def _scenarios(text: str) -> tuple[int, ...]:
    if text == "all":
        return tuple(SCENARIOS)
    return tuple(dict.fromkeys(scenario(part.strip()) for part in text.split(",")))


def _some_of(known: tuple[str, ...]) -> Callable[[str], tuple[str, ...]]:
    """Return a parser of all or some of the known names, each once."""

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


@dataclass(frozen=True, kw_only=True)
class ValidateOptions:
    """Options of `driveby validate`, of all kinds together."""

    scenarios: tuple[int, ...] = opt(
        "scenarios of the paper, see docs/validation.md (default: all)",
        _scenarios,
        default=tuple(SCENARIOS),
        metavar="all|1,6,12",
    )
    noise: float = noise_option("accelerometers' noise density in µg/√Hz (default: 0)")
    site: Path | None = site_option(
        "site file (default: truck and bridge of the paper); without --method: site validation "
        "for every pair of truck and bridge in it (exit code 1 if one fails)"
    )
    json: Path | None = output_option(
        "JSON file of the results", "OUT.json", VALIDATION_JSON, AIMS_JSON
    )
    figures: Path | None = output_folder_option("folder for figures")
    particles: int = count_option(
        "number of particles of the paper's random-walk search", "particles", 500, 1
    )
    steps: int = count_option("number of steps of the paper's random-walk search", "steps", 600, 1)
    seed: int = seed_option()
    method: str | None = opt(
        "paper: the paper's search and least squares, with no sensor error but --noise; pre: "
        "coverage of intervals, with the options below; exit code 1 on a missed target (default: "
        "paper; with --site: site validation)",
        choices=("paper", "pre"),
    )
    truck: str | None = opt(
        "identifier of the only vehicle to validate (default: each)", group=_OF_SITE, metavar="ID"
    )
    bridge: str | None = opt(
        "identifier of the only bridge to validate (default: each)", group=_OF_SITE, metavar="ID"
    )
    validations: Path | None = validations_option(
        f"folder for validation records (default: {CERTIFICATES})", group=_OF_SITE
    )
    crossings: int = count_option(
        "number of crossings whose truth is drawn from the priors", "a number of crossings", 200
    )
    control: int = count_option(
        "number of crossings repeated with only half of their noise declared",
        "a number of crossings",
        20,
    )
    out_of_model: int = count_option(
        "number of crossings for each out-of-model effect", "a number of crossings", 0
    )
    effects: tuple[str, ...] = opt(
        f"out-of-model effects, see docs/validation.md: {', '.join(EFFECTS)} (default: all)",
        _some_of(EFFECTS),
        default=EFFECTS,
        metavar="all|swing,friction,…",
    )
    records: Path = output_option(
        "file of finished crossings of --out-of-model and --surveys, which are not run again "
        "(default: build/worlds.jsonl)",
        "FILE.jsonl",
        RECORDS,
        default=Path("build/worlds.jsonl"),
    )
    surveys: int = count_option(
        "number of fused surveys, of 8 to 16 crossings, for each of --kinds; with it nothing "
        "else is run",
        "a number of surveys",
        0,
    )
    kinds: tuple[str, ...] = opt(
        f"kinds of survey, see studies/surveys.md: {', '.join(_KINDS)} (default: all)",
        _some_of(_KINDS),
        default=_KINDS,
        metavar="all|twin,steady,…",
    )
    truth: Path = opt(
        "folder with a subfolder for each crossing of another simulator, with its truth.json "
        "(default: shared/crossings next to the checkout; left out where it is missing)",
        Path,
        default=_TRUTHS,
        metavar="DIR",
    )
    processes: int = count_option("number of processes", "processes", 2, 1, 256)
    page: Path | None = output_option("Markdown page of the results", "PAGE.md", VALIDATION_PAGE)


def _validate(asked: ValidateOptions) -> int:
    if asked.site is not None and asked.method is None:
        from services.cli.validate_site import validate_site_command

        _refuse(asked, _OF_METHODS - _OF_SITE_VALIDATION, "only with --method")
        asked = replace(asked, validations=validations_folder(asked.validations))
        return validate_site_command(_of_kind(SiteValidationOptions, asked), a_console())
    _refuse(asked, _OF_SITE_VALIDATION - _OF_METHODS, "only with --site, no --method")
    code: int
    if asked.method == "pre" and asked.surveys:
        run_surveys = _study("validation.run_surveys")
        code = run_surveys.run(_of_kind(SurveyOptions, asked), a_console())
    elif asked.method == "pre":
        if asked.truth != _TRUTHS and not asked.truth.is_dir():
            raise InputError(f"--truth: {asked.truth} is not a folder, name one with crossings")
        run_intervals = _study("validation.run_intervals")
        code = run_intervals.run(_of_kind(IntervalOptions, asked), a_console())
    else:
        paper = _study("paper.run")
        code = paper.run(_of_kind(ScenarioOptions, asked), a_console())
    return code


def _refuse(asked: ValidateOptions, others: frozenset[str], what: str) -> None:
    """Raise InputError if an option of another kind of validation was given."""
    for field in fields(asked):
        if field.name in others and getattr(asked, field.name) != field.default:
            raise InputError(
                f"{option_of(field.name)}: {what}; it has no effect here, leave it out"
            )


def _of_kind(kind: type[_Options], asked: ValidateOptions) -> _Options:
    """Return the options of one kind of validation."""
    return kind(**{field.name: getattr(asked, field.name) for field in fields(kind)})


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


COMMAND: Final = Subcommand(
    ValidateOptions,
    "driveby validate --scenarios 1,6,12 --noise 25 --json validation.json",
    _validate,
)
