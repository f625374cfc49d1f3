"""The command that asks whether the answers are true: validate."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from services.cli.parsing import (
    CERTIFICATES,
    SCENARIOS,
    OutputFile,
    a_console,
    add_certificates,
    add_noise,
    add_output_file,
    add_output_folder,
    add_seed,
    add_site,
    command,
    names,
    option_of,
    scenario,
    whole,
)
from services.common.errors import InputError
from services.common.kinds import AIMS_JSON, RECORDS, VALIDATION_JSON, VALIDATION_PAGE


def _scenarios(text: str) -> tuple[int, ...]:
    if text == "all":
        return tuple(SCENARIOS)
    return tuple(dict.fromkeys(scenario(part.strip()) for part in text.split(",")))


EFFECTS: Final = (
    "free",
    "sprung",
    "sinking",
    "swing",
    "tyres",
    "friction",
    "bilinear",
    "air",
    "spans",
    "surface",
    "torsion",
    "left-and-right",
    "everything",
)
"""As in `simulation.worlds`, which is not imported for a line of help."""


KINDS: Final = (
    "steady",
    "changing-2",
    "changing-5",
    "twin",
    "single-5",
    "single-10",
    "loaded-and-empty",
    "two-trucks",
    "both-ways",
    "five-elements",
    "three-elements",
    "everything",
    "scenario-1",
    "scenario-4",
    "scenario-10",
    "scenario-5",
    "scenario-11",
)
"""As in `validation.surveys`, which is not imported for a line of help."""


_OF_METHODS: Final = {
    "scenarios": tuple(SCENARIOS),
    "noise": 0.0,
    "out_of_model": 0,
    "surveys": 0,
    "json": None,
    "figures": None,
    "page": None,
}
_OF_CERTIFICATES: Final = {"truck": None, "bridge": None, "validations": None}
"""Options that belong to one kind of validation only, with their defaults."""


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
    """`driveby validate`: compare simulated crossings with the truth and the paper."""
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
    of_site = p.add_argument_group("certificates of --site, see docs/certificates.md")
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
        type=_some_of(KINDS),
        default=KINDS,
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


def _validate_site(options: argparse.Namespace) -> int:
    from services.cli.validate_site import validate_site_command

    return validate_site_command(
        site=options.site,
        truck=options.truck,
        bridge=options.bridge,
        certificates=options.validations or CERTIFICATES,
        seed=options.seed,
        processes=options.processes,
        console=a_console(),
    )


def _check_one_kind(options: argparse.Namespace) -> None:
    """InputError if an option belongs to another kind of validation than the one asked for."""
    makes_certificates = options.site is not None and options.method is None
    others = _OF_METHODS if makes_certificates else _OF_CERTIFICATES
    what = "only with --method" if makes_certificates else "only with --site, no --method"
    for name, default in others.items():
        if getattr(options, name) != default:
            raise InputError(
                f"{option_of(name)}: {what}, it has nothing to do with what is asked for"
            )


def _validate(options: argparse.Namespace) -> int:
    _check_one_kind(options)
    if options.site is not None and options.method is None:
        return _validate_site(options)
    if options.method == "pre" and options.surveys:
        from services.cli.validate_surveys import validate_surveys_command

        return validate_surveys_command(
            surveys=options.surveys,
            kinds=options.kinds,
            records=options.records,
            site=options.site,
            processes=options.processes,
            console=a_console(),
        )
    if options.method == "pre":
        from services.cli.validate_pre import validate_pre_command

        return validate_pre_command(
            crossings=options.crossings,
            control=options.control,
            scenarios=options.scenarios,
            worlds=options.out_of_model,
            effects=options.effects,
            records=options.records,
            folder=options.truth,
            site=options.site,
            processes=options.processes,
            json_path=options.json,
            figures=options.figures,
            page=options.page,
            console=a_console(),
        )
    from services.cli.validate_paper import validate_command

    return validate_command(
        scenarios=options.scenarios,
        noise=options.noise,
        json_path=options.json,
        figures=options.figures,
        seed=options.seed,
        site=options.site,
        particles=options.particles,
        steps=options.steps,
        console=a_console(),
    )
