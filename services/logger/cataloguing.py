"""Catalogue rows of the files that the logger has closed.

A row requires reading the file once more, with packages that would add half of the logger's memory
to it and never give it back. So a process of low priority writes the rows of all files that were
closed within a minute. Those left when the logger ends are written in this process, up to a size
and a time that do not delay the end.
"""

import contextlib
import logging
import math
import threading
import time
from pathlib import Path
from queue import Empty, SimpleQueue

from services.catalogue.index import catalog_closed, has_packages
from services.common.child_process import run_gently

_log = logging.getLogger(__name__)
_COLLECT_S = 60.0
"""Interval of starting a process: nothing waits for a row, and files are closed in groups."""
_MAX_FILES = 1000
"""Largest number of files for one process, whose arguments are limited."""
_AT_END_BYTES = 32 << 20
"""Size of the files whose rows are written at the end, about a second of work."""
_AT_END_S = 5.0
"""Time for those rows after the first, as each waits twice for a disk that may be slow."""


class Cataloguing:
    """A thread that adds the rows of closed files to the catalogue of a folder until closed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._closed: SimpleQueue[Path] = SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="catalogue", daemon=True)
        self._thread.start()

    def add(self, recording: Path) -> None:
        """Queue the row of a recording that was just closed."""
        if has_packages():
            self._closed.put(recording)

    def close(self) -> None:
        """Add the rows of the last files, unless that takes long, and stop.

        A process that is at work is ended.
        """
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        missing = 0
        try:
            while not self._closing.wait(_COLLECT_S):
                missing = self._write_in_children(self._take())
        except Exception:  # recording matters more, and `driveby catalog` adds a missing row
            _log.exception("the catalogue cannot be updated; recording continues")
        missing += self._write_last(self._take())
        if missing:
            _log.info(
                "%d closed files are not in the catalogue yet; `driveby catalog %s` adds them",
                *(missing, self._folder),
            )

    def _write_last(self, recordings: list[Path]) -> int:
        """Return the number of files for which there is no time, also because they are large."""
        left_bytes, deadline_s = _AT_END_BYTES, math.inf
        for number, recording in enumerate(recordings):
            with contextlib.suppress(FileNotFoundError):
                left_bytes -= recording.stat().st_size
            if left_bytes < 0 or time.monotonic() >= deadline_s:
                return len(recordings) - number
            catalog_closed(self._folder, recording)
            # From here on: the first row loads the packages.
            deadline_s = min(deadline_s, time.monotonic() + _AT_END_S)
        return 0

    def _take(self) -> list[Path]:
        taken: list[Path] = []
        while True:
            try:
                taken.append(self._closed.get_nowait())
            except Empty:
                return taken

    def _write_in_children(self, recordings: list[Path]) -> int:
        """Return the number of files that are left because the logger ends."""
        for first in range(0, len(recordings), _MAX_FILES):
            paths = map(str, (self._folder, *recordings[first : first + _MAX_FILES]))
            done = run_gently(["services.catalogue.closed", *paths], self._closing)
            if done is None:
                return len(recordings) - first
            for line in done.log.splitlines():
                _log.warning("%s", line)
        return 0
