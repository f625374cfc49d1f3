"""The command `driveby fuse`."""

from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.cli.settings import FuseOptions


def _fuse(asked: FuseOptions) -> int:
    from services.cli.fuse import fuse_command

    return fuse_command(asked, a_console())


COMMAND: Final = Subcommand(
    FuseOptions,
    "driveby fuse monday.json tuesday.json --json week.json",
    _fuse,
)
