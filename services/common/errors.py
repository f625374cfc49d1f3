"""Errors that end a command: two with one line for the user, and an interruption."""

from schemas.errors import InputError, one_line

__all__ = ["EXIT_INTERRUPTED", "FailureError", "InputError", "one_line"]

EXIT_INTERRUPTED = 130
"""Exit code that a shell reports for a program ended by SIGINT, and that our commands return."""


class FailureError(Exception):
    """A failure that is not bad input (disk full, no answer): exit code 1."""

    def __init__(self, line: str) -> None:
        super().__init__(one_line(line))
