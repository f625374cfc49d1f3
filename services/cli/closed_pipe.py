"""Standard output whose reader may leave, while a command still has files to write."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast


class ClosedPipeOutput:
    """A stream that writes to the given one, and drops text once the pipe is closed."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.is_closed_pipe = False

    def write(self, text: str) -> int:
        """Write text, or drop it."""
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._drop()
            return len(text)

    def flush(self) -> None:
        """Flush the stream, or drop its content."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._drop()

    def _drop(self) -> None:
        self.is_closed_pipe = True
        to_null(self._stream)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def to_null(stream: TextIO) -> None:
    """Let a stream with a closed pipe write to nowhere: Python would fail when it ends."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


@contextmanager
def tolerating_closed_pipe(*, is_needed: bool) -> Iterator[None]:
    """Let the block print to a closed pipe; raise BrokenPipeError after it, if it did."""
    if not is_needed:
        yield
        return
    output = ClosedPipeOutput(sys.stdout)
    before, sys.stdout = sys.stdout, cast(TextIO, output)
    try:
        yield
        output.flush()
    finally:
        sys.stdout = before
    if output.is_closed_pipe:
        raise BrokenPipeError
