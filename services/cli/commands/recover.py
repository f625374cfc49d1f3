"""The command `driveby recover`: a new, readable file from a damaged recording."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from services.cli.parser import Subcommand
from services.common.errors import InputError
from services.common.kinds import MCAP
from services.common.options import flag, force_option, output_option, positional

if TYPE_CHECKING:
    from services.recordings.recovery import Recovery

EXIT_CLEAN, EXIT_LOSSY = 0, 3


@dataclass(frozen=True, kw_only=True)
class RecoverOptions:
    """Options of `driveby recover`: a damaged recording, and its treatment."""

    recording: Path = positional(
        "damaged recording to read, which is not changed", Path, metavar="REC.mcap"
    )
    output: Path | None = output_option(
        "recording to write (default: REC.recovered.mcap next to it)",
        "OUT.mcap",
        MCAP,
        flags=("-o", "--output"),
    )
    set_aside: bool = flag(
        "rename the damaged recording to REC.mcap.crashed afterwards (REC.mcap.crashed-2 if that "
        "exists)"
    )
    force: bool = force_option()
    json: bool = flag("print the counts as JSON")


def _recover(asked: RecoverOptions) -> int:
    """Recover one recording and print a summary; return 0 (nothing was lost) or 3.

    Raise InputError and FailureError as `recover_recording` does, with nothing changed.
    """
    from services.common.progress import reading_bar
    from services.recordings.recovery import describe, recover_recording, recovered_path

    source, target = asked.recording, asked.output or recovered_path(asked.recording)
    if asked.set_aside and asked.output is not None:
        raise InputError("--set-aside goes with the usual name next to the recording, not with -o")
    with reading_bar("recovering", [source]) as next_file:
        recovery = recover_recording(
            source, target, force=asked.force, set_aside=asked.set_aside, progress=next_file()
        )
    plain = f"{target}: {describe(recovery)}"
    if recovery.set_aside_as is not None:
        plain += f"; {source} is renamed to {recovery.set_aside_as}"
    print(json.dumps(_as_json(target, recovery)) if asked.json else plain)
    return EXIT_LOSSY if recovery.is_lossy else EXIT_CLEAN


def _as_json(target: Path, recovery: "Recovery") -> dict[str, object]:
    return {"recording": str(target)} | recovery._asdict() | {"lossy": recovery.is_lossy}


COMMAND: Final = Subcommand(
    RecoverOptions,
    "driveby recover run.mcap -o whole.mcap",
    _recover,
)
