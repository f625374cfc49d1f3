"""Entry point of `driveby`: parse arguments, call one function, map errors to exit codes.

Exit codes: 0 success, 1 failure, 2 bad input; 3 for `recover`, `catalog`, `identify --into` and
`history add`: success, but something is lost. Functions are imported when they are called, so that
`driveby --help` does not wait for compilers and viewers.
"""

import argparse
import errno
import gc
import io
import logging
import os
import sys
import traceback
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final, NoReturn

from services.cli.announcing import subject_of
from services.cli.closed_pipe import to_null, tolerating_closed_pipe
from services.cli.completion import SHELLS, commands_of, completion
from services.cli.parser import add_command
from services.cli.parsing import Files, Handler, Parser, add_common, files_of
from services.cli.table import COMMANDS, check_needs, name_of
from services.common.errors import EXIT_INTERRUPTED, FailureError, InputError
from services.common.files import check_kind, is_unicode, name_error
from services.common.log_lines import configure_logging
from services.common.outputs import declared
from services.common.parquet_files import spare_pandas

_OBJECTS_BETWEEN_SEARCHES: Final = 20_000
_SERVICES: Final = ("logger", "worker", "truck", "gateway", "cluster")
"""Commands that run until they are stopped, and whose log is their only output."""
_COUNTS_AT_EXIT: Final = ("_duckdb", "duckdb")
"""Modules made with nanobind, whose types are in cycles that a last collection frees."""
_LARGEST_CHECKED: Final = 1 << 20
"""Maximum size in bytes of a site file that is read once more for warnings."""
EXIT_FAILED: Final = 1
EXIT_BAD_INPUT: Final = 2
_BAD_NAMES: Final = frozenset(
    (errno.ENAMETOOLONG, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.ELOOP)
)
"""Errors of the system that another name avoids."""
EXIT_BROKEN_PIPE: Final = 141
"""Exit code that a shell reports for SIGPIPE, as `EXIT_INTERRUPTED` for SIGINT."""


def _warn_of_site(path: object) -> None:
    """Log unusual values in the site file of a command; the command reports errors."""
    if not isinstance(path, Path) or not path.is_file() or path.stat().st_size > _LARGEST_CHECKED:
        return
    from schemas.site_file import parse_site, read_site_text
    from schemas.site_usual import warnings_of

    try:
        text = read_site_text(path)
        found = warnings_of(parse_site(text, str(path)), text)
    except InputError:
        return
    for line in found:
        logging.getLogger(__name__).warning("%s: %s", path, line)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    # Our matrices are small: threads that wait for each other at every column cost up to fifty
    # times the work itself when other processes want the cores too.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # No plugin inspects our models, and searching for plugins takes time.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # Imports make a million objects that stay: a search for reference cycles among them after every
    # 700 new ones takes 0.1 s of an identification.
    gc.set_threshold(_OBJECTS_BETWEEN_SEARCHES)
    try:
        options = _parser().parse_args(arguments)
    except InputError as error:
        return _print_error(str(error), EXIT_BAD_INPUT)
    is_json = options.log_format == "json"
    # The log is a service's only output.
    verbose = options.verbose or name_of(options) in _SERVICES
    level = logging.INFO if verbose else logging.WARNING
    configure_logging(options.log_format, level, subject_of(options))
    fail = partial(_print_error, is_json=is_json)
    handler: Handler = options.handler
    # A name may be no Unicode, and a line with it must not fail.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        check_needs(options)
        files = files_of(options)
        _check_names(files)
        with declared(files.inputs, files.outputs):
            for path, kinds in files.outputs.items():
                check_kind(path, kinds)
            _warn_of_site(getattr(options, "site", None))
            with tolerating_closed_pipe(is_needed=bool(files.outputs or files.folders)):
                code = handler(options)
        sys.stdout.flush()
    except InputError as error:
        return fail(str(error), EXIT_BAD_INPUT)
    except FailureError as error:
        return fail(str(error), EXIT_FAILED)
    except KeyboardInterrupt:
        return fail("interrupted", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # The reader of our output has closed it; Python would fail again when it flushes at exit.
        to_null(sys.stdout)
        return EXIT_BROKEN_PIPE
    except Exception as error:
        if options.debug:
            traceback.print_exc()
        if isinstance(error, UnicodeEncodeError) and error.reason == "surrogates not allowed":
            return fail(f"{error.object[:200]}: is not a name in UTF-8; rename it", EXIT_BAD_INPUT)
        if isinstance(error, OSError) and error.filename is not None:
            code = EXIT_BAD_INPUT if error.errno in _BAD_NAMES else EXIT_FAILED
            return fail(str(name_error(Path(os.fsdecode(error.filename)), error)), code)
        what = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        hint = "" if options.debug else "; run with --debug for the traceback"
        return fail(f"internal error, please report: {what}{hint}", EXIT_FAILED)
    return code


def _check_names(files: Files) -> None:
    """Raise InputError for impossible names of files, and relative ones without a folder."""
    try:
        Path.cwd()
    except OSError as error:
        raise InputError("the working directory no longer exists, change to another one") from error
    for path in (*files.outputs, *files.folders):
        if not is_unicode(str(path)):  # libraries that write cannot use such a name
            raise InputError(f"{path}: the name is not UTF-8; give another name to write")
    for path in (*files.inputs, *files.outputs, *files.folders):
        try:
            path.lstat()
        except OSError as error:
            if error.errno == errno.ENAMETOOLONG:
                raise name_error(path, error) from error


def program() -> int:
    """Run `main` in a process of its own, which ends with it.

    The last search for reference cycles at the end of Python is skipped: 0.15 s. It is not where a
    library counts remaining objects at the very end, and prints a line for each.
    """
    spare_pandas()
    code = main()
    if not any(name in sys.modules for name in _COUNTS_AT_EXIT):
        gc.freeze()
    return code


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="driveby",
        description="Estimate the stiffness of every bridge element "
        "from a truck that crosses the bridge.",
        epilog="example: driveby simulate --scenario 6 --noise 25 -o run.mcap "
        "&& driveby identify run.mcap",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    parser.add_argument(
        "--print-completion",
        action=_Completion,
        choices=SHELLS,
        help="print a completion script for this shell and exit",
    )
    add_common(parser, suppressed=False)
    commands = parser.add_subparsers(metavar="COMMAND", required=True, parser_class=Parser)
    for name in COMMANDS:
        add_command(commands, name)
    return parser


def whole_parser() -> argparse.ArgumentParser:
    """Return the parser with the options of every command."""
    parser = _parser()
    for command in commands_of(parser).values():
        command.complete()
    return parser


class _Version(argparse.Action):
    def __call__(self, *_: object, **__: object) -> NoReturn:
        from importlib.metadata import version

        print(f"driveby {version('driveby')}")
        sys.exit(0)


def _print_error(line: str, code: int, *, is_json: bool = False) -> int:
    if is_json:
        logging.getLogger("driveby").error("%s", line)
    else:
        print(f"driveby: {line}", file=sys.stderr)
    return code


class _Completion(argparse.Action):
    def __call__(self, _: object, __: object, value: object, ___: object = None) -> NoReturn:
        print(completion(whole_parser(), str(value)), end="")
        sys.exit(0)


if __name__ == "__main__":
    sys.exit(main())
