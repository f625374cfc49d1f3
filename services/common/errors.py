"""The ways in which a command ends badly: two with one line for the user, and an interruption."""

from schemas.errors import InputError, one_line

__all__ = ["EXIT_INTERRUPTED", "FailureError", "InputError", "one_line"]

EXIT_INTERRUPTED = 130
"""What a shell reports of a program that SIGINT ended, and so do our own commands."""


class FailureError(Exception):
    """Something failed that was not bad input (disk full, nobody answers): exit code 1."""

    def __init__(self, line: str) -> None:
        super().__init__(one_line(line))
