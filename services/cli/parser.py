"""Commands whose options are the fields of a frozen dataclass: parser and instance."""

import argparse
from collections.abc import Callable
from dataclasses import MISSING, fields
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

from services.cli.announcing import announcement
from services.cli.parsing import command
from services.common.options import OPTION, Option

_Asked = TypeVar("_Asked")
Announce = Callable[[str], Callable[[], None]]


class Subcommand(NamedTuple, Generic[_Asked]):
    """A command: the class of its options, and the function that runs it with an instance."""

    name: str
    options: type[_Asked]
    summary: str
    example: str
    run: Callable[[_Asked], int]

    def add(self, commands: Any) -> None:
        """Add the command to a parser."""
        parser = command(commands, self.name, self.handle, self.summary, self.example)
        _add_fields(parser, self.options)

    def handle(self, given: argparse.Namespace) -> int:
        """Run the command with what was given."""
        return self.run(_filled(self.options, given))


class ServiceCommand(NamedTuple, Generic[_Asked]):
    """A command that runs until it is stopped, and whose log is its only output."""

    name: str
    options: type[_Asked]
    summary: str
    example: str
    run: Callable[[_Asked, Announce], int]
    """Function of the options and of a function that announces a line."""

    def add(self, commands: Any) -> None:
        """Add the command to a parser."""
        parser = command(commands, self.name, self.handle, self.summary, self.example)
        _add_fields(parser, self.options)

    def handle(self, given: argparse.Namespace) -> int:
        """Run the command with what was given."""
        return self.run(_filled(self.options, given), partial(announcement, given))


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
