"""The command `driveby fuse`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from services.cli.parser import Subcommand
from services.cli.parsing import a_console
from services.common.kinds import RESULTS
from services.common.options import (
    baseline_option,
    fuse_suspect_option,
    output_option,
    positional,
)


@dataclass(frozen=True, kw_only=True)
class FuseOptions:
    """Options of `driveby fuse`: results to fuse, and outputs."""

    results: tuple[Path, ...] = positional(
        "results files to fuse", Path, nargs="+", metavar="RESULTS.json"
    )
    json: Path | None = output_option(
        "JSON file of all crossings and the fused estimates", "OUT.json", RESULTS
    )
    baseline: Path | None = baseline_option()
    fuse_suspect: bool = fuse_suspect_option()


def _fuse(asked: FuseOptions) -> int:
    from services.cli.fuse import fuse_command

    return fuse_command(asked, a_console())


COMMAND: Final = Subcommand(
    FuseOptions,
    "driveby fuse monday.json tuesday.json --json week.json",
    _fuse,
)
