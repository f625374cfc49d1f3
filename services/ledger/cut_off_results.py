"""Files that a killed worker left incomplete in its folder of results.

A recording without END is copied, as far as it is intact, and gets END and index under the same
name: the JSON file next to it and later runs refer to that name. Files that were to be renamed
never were, and are removed.
"""

import logging
import os
import re
from pathlib import Path
from typing import Final

from services.common.errors import FailureError, InputError
from services.common.files import sync
from services.common.naming import count_of
from services.ledger.worker_results import files_of_workers
from services.recordings.recording import is_being_written, is_closed
from services.recordings.recovery import put_aside, recover_recording

_log = logging.getLogger(__name__)
_INCOMPLETE: Final = re.compile(
    r"\.{1,2}results-\d{8}T\d{6}Z(_\d+)?"
    r"(\.recovered\.mcap|(\.recovered)?\.[0-9a-f]{8}\.part\.(json|mcap))"
)


def recover_cut_off_results(folder: Path) -> None:
    """Complete the recordings of killed workers, and remove what they had not renamed.

    Each is a line in the log; a file that cannot be read or written is a warning and stays as it
    is. To be called by the only worker of the folder.
    """
    for path in sorted(folder.glob(".*")):
        if _INCOMPLETE.fullmatch(path.name) and path.is_file():
            path.unlink(missing_ok=True)
            _log.info("%s: removed, a killed worker had not completed it", path)
    for path in files_of_workers(folder, "mcap"):
        try:
            if not is_being_written(path) and not is_closed(path):
                _complete(path)
        except (InputError, FailureError, OSError) as error:
            _log.warning("results of a killed worker stay cut off: %s", error)


def _complete(path: Path) -> None:
    times = path.stat()
    complete = path.with_name(f".{path.stem}.recovered.mcap")
    try:
        # Without an event: the file holds what its worker published, and nothing else.
        messages = recover_recording(path, complete, adds_event=False).messages
    except InputError as error:
        if "holds nothing" not in str(error):
            raise
        messages = 0
    if not messages:
        complete.unlink(missing_ok=True)
        aside = put_aside(path)
        _log.info("%s: killed before its first message; set aside as %s", path, aside.name)
        return
    os.utime(complete, ns=(times.st_atime_ns, times.st_mtime_ns))  # earlier runs expire by age
    complete.replace(path)
    sync(path.parent)
    # How many messages were lost does not matter: what has no result is identified again.
    kept = f"{count_of(messages, 'message')} kept"
    _log.info(
        "%s: its worker was killed; %s; crossings without a result are identified again", path, kept
    )
