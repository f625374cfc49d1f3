"""Recordings of simulated drives from a notebook, with every option of `driveby simulate`."""

import argparse
import difflib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from schemas.site import Site
from schemas.site_file import site_toml
from services.cli.parser import add_command
from services.cli.parsing import Parser
from services.common.errors import InputError
from services.execution.blas import one_blas_thread
from services.notebook.read import Name


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
        parsed = _parsed(*_arguments(options), f"--output={output}")
        with one_blas_thread():
            parsed.handler(parsed)
    return Path(output)


def _arguments(options: dict[str, object]) -> Iterator[str]:
    """Yield the arguments of the command."""
    known = _names()
    for name, value in options.items():
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
            raise InputError(f"{name}: is unknown, did you mean {close[0]}?")
        option = f"--{name.replace('_', '-')}"
        if value is True:
            yield option
        elif isinstance(value, str) or not hasattr(value, "__iter__"):
            if value is not None and value is not False:
                yield f"{option}={value}"
        else:
            yield f"{option}={(',' if name == 'ei' else ':').join(map(str, value))}"


def _parsed(*arguments: str) -> argparse.Namespace:
    parser = Parser(prog="driveby", allow_abbrev=False)
    add_command(parser.add_subparsers(parser_class=Parser), "simulate")
    return parser.parse_args(["simulate", *arguments])


def _names() -> list[str]:
    parser: argparse.ArgumentParser = _parsed("--scenario=1", "--output=x.mcap").parser
    left_out = ("help", "output", "verbose", "log_format", "debug")
    names = [action.option_strings[-1] for action in parser._actions if action.option_strings]
    plain = [name.removeprefix("--").replace("-", "_") for name in names]
    return [name for name in plain if name not in left_out]
