"""The two ways in which a command ends badly, each with one line for the user."""

from schemas.errors import InputError

__all__ = ["FailureError", "InputError"]


class FailureError(Exception):
    """Something failed that was not bad input (disk full, nobody answers): exit code 1."""

    def __init__(self, line: str) -> None:
        super().__init__(" ".join(line.split()))
