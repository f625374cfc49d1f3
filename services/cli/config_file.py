"""Options of a command from a TOML file: keys are the options' names with `_` for `-`.

The command line overrides the file: a key is left out where its option, or an alternative to it,
is given as an argument.
"""

import argparse
import difflib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

from schemas.toml_text import parse_toml, read_toml_text
from schemas.topics import check_realms
from services.common.errors import InputError

CONFIG: Final = "--config"
_ALIKE: Final = 0.7
"""Least similarity of a misspelt key, from 0 to 1."""


def with_config(parser: argparse.ArgumentParser, given: Sequence[str]) -> list[str]:
    """Return the arguments with those of the configuration file before them.

    Raise InputError, in one line, for an unreadable file, an unknown key or an impossible value.
    """
    path = _config_path(given)
    if path is None:
        return list(given)
    actions = options_by_key(parser)
    overridden = _overridden(parser, given)
    arguments: list[str] = []
    for key, value in parse_toml(read_toml_text(path, "a configuration file"), str(path)).items():
        if key not in actions:
            raise InputError(f"{path}: {unknown_key(key, actions)}")
        of_key = list(_arguments_of(actions[key], f"{path}: {key}", value))
        if actions[key] not in overridden:
            arguments += of_key
    return [*arguments, *given]


def options_by_key(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    """Return the options that have a key, by their keys."""
    return {_key(action): action for action in parser._actions if _key(action)}


def unknown_key(key: str, known: Iterable[str]) -> str:
    """Return the sentence on a key that is none of the known ones, with one that is spelt alike."""
    close = difflib.get_close_matches(key.replace("-", "_"), list(known), n=1, cutoff=_ALIKE)
    hint = f"did you mean {close[0]}?" if close else "check its spelling or remove it"
    return f"{key}: is unknown, {hint}"


def _config_path(given: Sequence[str]) -> Path | None:
    """Return the last configuration file among arguments."""
    path = None
    for argument, following in zip(given, [*given, ""][1:], strict=True):
        name, equals, value = argument.partition("=")
        if name == CONFIG:
            path = Path(value if equals else following)
    return path


def _key(action: argparse.Action) -> str:
    """Return the key of an option; empty for what a file cannot set."""
    names = [name for name in action.option_strings if name.startswith("--")]
    if not names or names[0] in (CONFIG, "--help"):
        return ""
    return names[0].removeprefix("--").replace("-", "_")


def _overridden(parser: argparse.ArgumentParser, given: Sequence[str]) -> set[argparse.Action]:
    """Return the options among the arguments, and the alternatives to them."""
    names = {argument.partition("=")[0] for argument in given}
    found = {action for action in parser._actions if names & set(action.option_strings)}
    for group in parser._mutually_exclusive_groups:
        if found & set(group._group_actions):
            found |= set(group._group_actions)
    return found


def _arguments_of(action: argparse.Action, where: str, value: object) -> Iterator[str]:
    """Yield the arguments that a key stands for."""
    option = action.option_strings[-1]
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise InputError(f"{where}: is {value!r}, it must be true or false")
        if value:
            yield option
        return
    if isinstance(value, list) and not isinstance(action, argparse._AppendAction):
        raise InputError(f"{where}: is {value!r}, it must be one value")
    for one in value if isinstance(value, list) else [value]:
        if isinstance(one, bool) or not isinstance(one, str | int | float):
            raise InputError(f"{where}: is {one!r}, it must be a text or a number")
        yield f"{option}={_checked(action, where, one)}"


def _checked(action: argparse.Action, where: str, value: str | float) -> str:
    """Return the text of a value if the option accepts it."""
    text = str(value)
    parsed: object = text
    if _key(action) == "realm" and isinstance(value, str):
        try:
            check_realms(text)
        except ValueError as error:
            raise InputError(f"{where}: {str(error).removeprefix('realm ')}") from None
    if callable(action.type):
        try:
            parsed = action.type(text)
        except (argparse.ArgumentTypeError, ValueError) as error:
            raise InputError(f"{where}: {error}") from None
    if isinstance(value, str) and isinstance(parsed, int | float):
        raise InputError(f'{where}: is "{text}", it must be a number without quotes: {parsed:g}')
    if isinstance(parsed, str | Path) and not isinstance(value, str):
        raise InputError(f'{where}: is {value!r}, it must be a text in quotes: "{text}"')
    if action.choices is not None and text not in action.choices:
        raise InputError(f"{where}: is {text!r}, it must be one of {', '.join(action.choices)}")
    return text
