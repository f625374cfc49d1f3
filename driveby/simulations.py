"""Recordings of simulated drives from a notebook, with every option of `driveby simulate`."""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from schemas.site import Site
from schemas.site_file import site_toml
from services.cli.config_file import options_by_key, unknown_key
from services.cli.parser import add_command
from services.cli.parsing import Parser
from services.common.errors import InputError
from services.common.options import option_of
from services.execution.blas import one_blas_thread
from services.notebook.arguments import naming_force
from services.notebook.read import Name

_NOT_OF_NOTEBOOKS: Final = {"output", "verbose", "log_format", "debug"}
"""Options that are an argument here, or belong to the command line."""


def simulate_recording(output: Name, site: Name | Site | None = None, **options: object) -> Path:
    """Write a recording as `driveby simulate` does, and return its path.

    Options have the names of the command's, with `_` for `-`: `runs=3`, `road_surface=True`. A
    sequence stands for values between commas or colons: `ei=[1, 1, 0.6, 1, 1]`, `speed=(9, 11)`.
    BLAS is limited to one thread meanwhile. Raise InputError, in one line, for an unknown option or
    an impossible value.
    """
    with tempfile.TemporaryDirectory() as folder:
        if isinstance(site, Site):
            path = Path(folder) / "site.toml"
            path.write_text(site_toml(site), encoding="utf-8")
            site = path
        if site is not None:
            options["site"] = site
        parser = Parser(prog="driveby", allow_abbrev=False)
        command = add_command(parser.add_subparsers(parser_class=Parser), "simulate")
        command.complete()
        known = options_by_key(command).keys() - _NOT_OF_NOTEBOOKS
        given = _arguments(options, sorted(known))
        parsed = parser.parse_args(["simulate", *given, f"--output={output}"])
        with one_blas_thread(), naming_force():
            parsed.handler(parsed)
    return Path(output)


def _arguments(options: dict[str, object], known: Sequence[str]) -> Iterator[str]:
    """Yield the arguments of the command."""
    for name, value in options.items():
        if name not in known:
            raise InputError(unknown_key(name, known))
        option = option_of(name)
        if value is True:
            yield option
        elif isinstance(value, str) or not hasattr(value, "__iter__"):
            if value is not None and value is not False:
                yield f"{option}={value}"
        else:
            yield f"{option}={(',' if name == 'ei' else ':').join(map(str, value))}"
