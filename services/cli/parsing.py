"""Common parts of the commands' options: names, help, parsing and errors.

Nothing heavy is imported here: `driveby --help` does not wait for compilers and viewers.
"""

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn

from services.cli.config_file import CONFIG, with_config
from services.common.errors import InputError
from services.common.kinds import Kind
from services.common.options import OutputFile, folder_here

if TYPE_CHECKING:
    from rich.console import Console

EXIT_SOMETHING_LOST: Final = 3
"""Exit code of a success in which input could not be read or identified."""

Handler = Callable[[argparse.Namespace], int]
"""Type of a command's function, which returns the exit code."""

_ONE_OF: Final = re.compile("one of the arguments (.+) is required")
"""Error line of argparse if no option of an exclusive group is given."""


_FORMER_OPTIONS: Final = {
    "alarm": {"--learning": "--training"},
    "history": {"--later": "--defer-fusion"},
    "identify": {"--certificates": "--validations", "--patience": "--reconnect-timeout"},
    "import": {"--name": "--realm"},
    "simulate": {"--left": "--departed-vehicle"},
    "validate": {"--certificates": "--validations", "--worlds": "--out-of-model"},
    "worker": {
        "--certificates": "--validations",
        "--limit": "--cpu-limit",
        "--no-certificates": "--skip-validation",
    },
}
"""Former spellings of options by command; they are accepted for good and shown nowhere."""


class Parser(argparse.ArgumentParser):
    """Parser whose errors are one line, as all others."""

    former_options: Mapping[str, str] = {}
    """Former spellings of this command's options, with the present ones."""
    _fill: Callable[[], None] | None = None

    def put_off(self, fill: Callable[[], None], name: str) -> None:
        """Add the options of the command of this name by `fill`, when they are needed."""
        self._fill, self.former_options = fill, _FORMER_OPTIONS.get(name, {})

    def complete(self) -> None:
        """Add the options that were put off."""
        fill, self._fill = self._fill, None
        if fill is not None:
            fill()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments whose options may have their former spellings."""
        self.complete()
        given = list(sys.argv[1:] if args is None else args)
        ends = given.index("--") if "--" in given else len(given)
        current = [self._current(one) for one in given[:ends]]
        if any(CONFIG in action.option_strings for action in self._actions):
            current = with_config(self, current)
        return super().parse_known_args([*current, *given[ends:]], namespace)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments; what no option takes is an error of the command that was given."""
        found, rest = self.parse_known_args(args, namespace)
        if rest:
            prog = getattr(found, "parser", self).prog
            raise InputError(f"unrecognized arguments: {' '.join(rest)} (see {prog} --help)")
        return found

    def _current(self, argument: str) -> str:
        option, equals, value = argument.partition("=")
        return self.former_options.get(option, option) + equals + value

    def error(self, message: str) -> NoReturn:
        """Raise InputError; alternatives are joined by a word, which argparse leaves out."""
        found = _ONE_OF.fullmatch(message)
        if found is not None:
            message = f"{' or '.join(found[1].split())} is required"
        raise InputError(f"{message} (see {self.prog} --help)")


def add_common(parser: argparse.ArgumentParser, *, suppressed: bool) -> None:
    """Add options that may precede or follow the sub-command."""

    def default(value: object) -> Any:
        # A sub-command's default would overwrite the value before the sub-command.
        return argparse.SUPPRESS if suppressed else value

    group = parser.add_argument_group("messages")
    group.add_argument("--verbose", action="store_true", default=default(False), help="log more")
    group.add_argument(
        "--log-format",
        choices=("text", "json"),
        default=default("text"),
        help="format of log lines on standard error (default: text)",
    )
    group.add_argument(
        "--debug",
        action="store_true",
        default=default(False),
        help="show tracebacks of internal errors",
    )


class Files(NamedTuple):
    """Paths among the arguments of a command."""

    inputs: list[Path]
    """Files and folders to read."""
    outputs: dict[Path, tuple[Kind, ...]]
    """Files to write, and the kinds that each may replace."""
    folders: list[Path]
    """Folders to write to."""


def files_of(options: argparse.Namespace) -> Files:
    """Return the paths that were given to a command, by their use."""
    files = Files([], {}, [])
    for action in options.parser._actions:
        value = getattr(options, action.dest, None)
        for path in value if isinstance(value, list) else [value]:
            if not isinstance(path, Path):
                continue
            if isinstance(action.type, OutputFile):
                if path in files.outputs:
                    raise InputError(f"{path}: is given for two outputs; give each a name")
                files.outputs[path] = action.type.kinds
            elif action.type is folder_here:
                files.folders.append(path)
            else:
                files.inputs.append(path)
    return files


def a_console() -> "Console":
    """Return a console without highlights; in a file or a pipe no sentence is wrapped."""
    from rich.console import Console

    class PipeConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # Rich would exit with 1, a failure

    return PipeConsole(soft_wrap=not sys.stdout.isatty(), highlight=False)
