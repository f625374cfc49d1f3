"""The JSON file of a run, complete after every crossing at the cost of one crossing.

Rewriting the whole file for every crossing takes a time that grows with the square of their number
(51 GB for a thousand). Here a crossing overwrites the file's end, and the end is written again
behind it. The file is the same byte for byte as one written at once. A process killed between the
two leaves a truncated file; the recording next to it, which is synced first, is complete, and the
next run writes the JSON file again from it (`runs`).
"""

import logging
import os
from pathlib import Path

from schemas.results import BridgeResult, CrossingResult, ResultHeader, results, results_json
from services.common.files import write_atomically

_log = logging.getLogger(__name__)
_NONE = '"crossings": []'
"""Text of a results file without crossings; within a string its quotes would be escaped."""
_INDENT = "  "
"""Indentation of a crossing: an item of a list within the file."""


class AppendableResults:
    """Results in a JSON file, created with the first result in place of an older file.

    States of bridges follow a while after their results; the file's end is then written again.
    """

    def __init__(self, path: Path, header: ResultHeader) -> None:
        self.path = path
        self._header = header
        self._end = 0
        """Offset of the file's end, directly behind the last crossing, in bytes."""
        self._size = 0

    def add(self, crossing: CrossingResult, bridges: dict[str, BridgeResult]) -> None:
        """Append a crossing and replace the states by `bridges`. Raise OSError on failure."""
        head, end = results_json(results(self._header, [], bridges)).rsplit(_NONE, 1)
        text = crossing.model_dump_json(indent=1)  # a line break in a string is written as \n
        entry = "\n".join(_INDENT + line for line in text.split("\n"))
        tail = f"\n ]{end}".encode()
        if not self._is_ours():
            first = f'{head}"crossings": [\n{entry}'.encode()
            write_atomically(self.path, first + tail)
            self._end, self._size = len(first), len(first) + len(tail)
            return
        self._write(f",\n{entry}".encode(), tail)

    def replace_bridges(self, bridges: dict[str, BridgeResult]) -> None:
        """Replace the states by `bridges` and keep its crossings. Raise OSError on failure.

        Without a crossing there is no file yet; a file of another program is left unchanged.
        """
        if self._size and self._is_ours():
            _, end = results_json(results(self._header, [], bridges)).rsplit(_NONE, 1)
            self._write(b"", f"\n ]{end}".encode())

    def _write(self, added: bytes, tail: bytes) -> None:
        """Write `added` behind the last crossing, then the file's end."""
        descriptor = os.open(self.path, os.O_WRONLY)
        try:
            _write_at(descriptor, self._end, added + tail)
            size = self._end + len(added) + len(tail)
            if size < self._size:
                os.ftruncate(descriptor, size)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        self._end, self._size = self._end + len(added), size

    def _is_ours(self) -> bool:
        """Return whether the file is unchanged; another program may have moved or edited it."""
        if self._size == 0:
            return False
        is_ours = self.path.is_file() and self.path.stat().st_size == self._size
        if not is_ours:
            _log.warning("%s: moved or changed; results continue in a new file there", self.path)
        return is_ours


def _write_at(descriptor: int, offset: int, data: bytes) -> None:
    while data:
        written = os.pwrite(descriptor, data, offset)
        data, offset = data[written:], offset + written
