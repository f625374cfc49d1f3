"""Commands whose options are the fields of a frozen dataclass: parser and instance."""

import argparse
from collections.abc import Callable
from dataclasses import MISSING, fields
from functools import partial
from importlib import import_module
from typing import Any, Generic, NamedTuple, TypeVar

from services.cli import commands
from services.cli.announcing import announcement
from services.cli.parsing import Parser, add_common
from services.cli.table import COMMANDS
from services.common.options import OPTION, Option

_Asked = TypeVar("_Asked")
Announce = Callable[[str], Callable[[], None]]


class Subcommand(NamedTuple, Generic[_Asked]):
    """A command: the class of its options, and the function that runs it with an instance."""

    options: type[_Asked]
    example: str
    run: Callable[[_Asked], int]

    def fill(self, parser: Parser) -> None:
        """Add the options to the parser of the command."""
        _fill(parser, self)

    def handle(self, given: argparse.Namespace) -> int:
        """Run the command with what was given."""
        return self.run(_filled(self.options, given))


class ServiceCommand(NamedTuple, Generic[_Asked]):
    """A command that runs until it is stopped, and whose log is its only output."""

    options: type[_Asked]
    example: str
    run: Callable[[_Asked, Announce], int]
    """Function of the options and of a function that announces a line."""

    def fill(self, parser: Parser) -> None:
        """Add the options to the parser of the command."""
        _fill(parser, self)

    def handle(self, given: argparse.Namespace) -> int:
        """Run the command with what was given."""
        return self.run(_filled(self.options, given), partial(announcement, given))


def add_command(subparsers: Any, name: str) -> Parser:
    """Add a command of the table; its options are added when it is parsed."""
    summary, *_, module = COMMANDS[name]
    parser: Parser = subparsers.add_parser(
        name,
        help=summary,
        description=f"{summary[0].upper()}{summary[1:]}.",
        allow_abbrev=False,
    )
    parser.put_off(lambda: _command(module or name).fill(parser), name)
    return parser


def _command(module: str) -> "Subcommand[Any] | ServiceCommand[Any]":
    found: Subcommand[Any] | ServiceCommand[Any]
    found = import_module(f"{commands.__name__}.{module}").COMMAND
    return found


def _fill(parser: Parser, command: "Subcommand[Any] | ServiceCommand[Any]") -> None:
    parser.epilog = f"example: {command.example}"
    parser.set_defaults(handler=command.handle, parser=parser)
    add_common(parser, suppressed=True)
    _add_fields(parser, command.options)


def _add_fields(parser: argparse.ArgumentParser, options: Any) -> None:
    groups: dict[tuple[str, str], Any] = {("", ""): parser}
    for one in fields(options):
        option: Option = one.metadata[OPTION]
        titled = (option.group, "")
        if titled not in groups:
            groups[titled] = parser.add_argument_group(option.group)
        place = (option.group, option.alternatives)
        settings = dict(option.settings)
        is_one_required = bool(option.alternatives) and settings.pop("required", False)
        if place not in groups:
            groups[place] = groups[titled].add_mutually_exclusive_group(required=is_one_required)
        is_repeated = settings.get("action") in ("append", "extend")
        if one.default is not MISSING and not is_repeated:
            settings["default"] = one.default
        flags = option.flags or (f"--{one.name.replace('_', '-')}",)
        if flags == ("",):
            flags = (one.name,)
        groups[place].add_argument(*flags, **settings)


def _filled(options: type[_Asked], given: argparse.Namespace) -> _Asked:
    """Return the instance of the options with the parsed values."""
    values = {}
    for one in fields(options):  # type: ignore[arg-type]
        option: Option = one.metadata[OPTION]
        flag = option.flags[-1] if option.flags else ""
        value = getattr(given, flag.lstrip("-").replace("-", "_") or one.name)
        if value is None and isinstance(one.default, tuple):
            value = one.default  # it may be given repeatedly, and was not
        values[one.name] = tuple(value) if isinstance(value, list) else value
    return options(**values)
