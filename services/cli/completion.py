"""Completion of commands, options and their choices in a shell, derived from the parser."""

import argparse
import shlex
from typing import Final

from services.cli.parsing import Parser

SHELLS: Final = ("bash", "zsh")

_SCRIPT = """\
_driveby() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} previous=${{COMP_WORDS[COMP_CWORD-1]}}
  local command= words= number
  for ((number = 1; number < COMP_CWORD; number++)); do
    case ${{COMP_WORDS[number]}} in
      {commands}) command=${{COMP_WORDS[number]}}; break ;;
    esac
  done
  case "$command $previous" in
{choices}
    *)
      case $current in
        -*)
          case $command in
{options}
          esac ;;
        *) [ -z "$command" ] && words={names} ;;
      esac ;;
  esac
  COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o default -F _driveby driveby
"""
# Where there are no words, `-o default` completes names of files.

_ZSH = "autoload -Uz compinit bashcompinit\ncompinit\nbashcompinit\n"


def completion(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return a script for `bash`, or `zsh`, which accepts that of bash, for all of `parser`."""
    commands = commands_of(parser)
    everything = {"": parser, **commands}
    script = _SCRIPT.format(
        commands="|".join(commands),
        names=shlex.quote(" ".join(commands)),
        choices="\n".join(
            f'    "{name} {option}") words={shlex.quote(" ".join(map(str, action.choices)))} ;;'
            for name, one in everything.items()
            for action in _options(one)
            if action.choices is not None
            for option in action.option_strings
        ),
        options="\n".join(
            f"            {name or shlex.quote('')}) words={_words(one)} ;;"
            for name, one in everything.items()
        ),
    )
    return script if shell == "bash" else _ZSH + script


def commands_of(parser: argparse.ArgumentParser) -> dict[str, Parser]:
    """Return the parsers of the commands."""
    (found,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return dict(found.choices)


def _options(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    return [action for action in parser._actions if action.option_strings]


def _words(parser: argparse.ArgumentParser) -> str:
    return shlex.quote(
        " ".join(option for action in _options(parser) for option in action.option_strings)
    )
