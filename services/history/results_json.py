"""The JSON file of a run, whole after every crossing at the cost of one crossing.

A file that is written anew with every crossing grows with the square of their number: 51 GB for a
thousand. Here a crossing takes the place of the file's end, and the end is written behind it. The
file is the same byte for byte as if it had been written at once. Who is killed between the two
leaves a file that is cut off; the recording beside it, which is synced first, has everything, and
the next run writes the JSON file anew from it (`result_files`).
"""

import logging
import os
from pathlib import Path

from schemas.results import BridgeResult, Crossing, Header, results, results_json
from services.common.files import write_atomically

_log = logging.getLogger(__name__)
_NONE = '"crossings": []'
"""How a results file without crossings says so; in a string the quotes would be escaped."""
_INDENT = "  "
"""A crossing stands in a list that stands in the file."""


class GrowingJson:
    """Results in a JSON file; it is made with the first one, and replaces what was there.

    States of bridges are due a while after their results, when the file's end is told anew.
    """

    def __init__(self, path: Path, header: Header) -> None:
        self.path = path
        self._header = header
        self._end = 0
        """Where the end of the file begins: behind the last crossing."""
        self._size = 0

    def add(self, crossing: Crossing, bridges: dict[str, BridgeResult]) -> None:
        """Add a crossing, and let `bridges` be those of the file. OSError if that fails."""
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

    def retell(self, bridges: dict[str, BridgeResult]) -> None:
        """Let `bridges` be those of the file, of which the crossings stay. OSError if that fails.

        Without a crossing there is no file yet, and somebody else's is left alone.
        """
        if self._size and self._is_ours():
            _, end = results_json(results(self._header, [], bridges)).rsplit(_NONE, 1)
            self._write(b"", f"\n ]{end}".encode())

    def _write(self, added: bytes, tail: bytes) -> None:
        """Write behind the last crossing."""
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
        """Whether the file is as it was left: another program may have taken or changed it."""
        if self._size == 0:
            return False
        is_ours = self.path.is_file() and self.path.stat().st_size == self._size
        if not is_ours:
            _log.warning("%s: was moved or changed; results go on in a new file there", self.path)
        return is_ours


def _write_at(descriptor: int, offset: int, data: bytes) -> None:
    while data:
        written = os.pwrite(descriptor, data, offset)
        data, offset = data[written:], offset + written
