"""The command `driveby recover`: rewrite a damaged recording for every reader."""

import json
from pathlib import Path

from services.common.errors import InputError
from services.common.progress import reading_bar
from services.recordings.recovery import (
    Recovery,
    describe,
    recover_recording,
    recovered_path,
)

EXIT_CLEAN, EXIT_LOSSY = 0, 3


def recover_command(
    *, source: Path, output: Path | None, set_aside: bool, as_json: bool, force: bool = False
) -> tuple[int, str]:
    """Recover one recording; return 0 (nothing was lost) or 3, and a summary.

    It is written to `output`, or beside the recording, where `force` replaces a recording. With
    `set_aside` the damaged file is then renamed to `….mcap.crashed`, so that a folder holds every
    recording once. Raise InputError and FailureError as `recover_recording` does, with nothing
    changed.
    """
    if set_aside and output is not None:
        raise InputError("--set-aside goes with the usual name beside the recording, not with -o")
    target = output or recovered_path(source)
    with reading_bar("recovering", [source]) as next_file:
        recovery = recover_recording(
            source, target, force=force, set_aside=set_aside, progress=next_file()
        )
    plain = f"{target}: {describe(recovery)}"
    line = json.dumps(_as_json(target, recovery)) if as_json else plain
    return EXIT_LOSSY if recovery.is_lossy else EXIT_CLEAN, line


def _as_json(target: Path, recovery: Recovery) -> dict[str, object]:
    return {"recording": str(target)} | recovery._asdict() | {"lossy": recovery.is_lossy}
